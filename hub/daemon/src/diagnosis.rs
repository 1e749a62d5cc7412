//! Finds the problem of a link that its status reports: the session's problem, a unit other than the configured one, more
//! bytes than the line can carry, a line that damages most bytes, bytes of another scanner, settings that another process
//! changed, a scanner that restarts, and subscribers that receive nothing.

use std::path::Path;

use config::Link;
use port::{Alteration, Source};
use scanhub_drivers::line::{Notice, Session as _};
use scanhub_drivers::{PortSession, Trouble, line, search};
use schema::{Family, MILLIS, Nanos, State, Status};

use crate::byte_rate::{ByteRate, with_commas};
use crate::recent::LineHealth;

/// What is known to be wrong with one link.
pub(crate) struct Diagnosis<'a> {
    link: &'a Link,
    /// What the words were made from; nothing if they have to be made.
    facts: Option<Facts>,
    /// What is wrong, in words; empty if nothing is.
    words: String,
    /// Why the port went away the last time, if it did so without a byte.
    doubt: String,
    /// Device of the open port, for a message that has no room for the configured name.
    device: Option<String>,
    /// Rate of the bytes that arrive while nothing is streaming.
    byte_rate: ByteRate,
    /// Family of the scanner. `None` while the session searches for it.
    family: Option<Family>,
    /// Number of telegrams of the session, and the time of the scanner's last one. `None` before the first one.
    telegrams: u64,
    last_telegram: Option<Nanos>,
    /// Whether the scanner has streamed since the port was opened.
    has_streamed: bool,
    /// Message that the scanner was exchanged, until the next one is found. Otherwise empty.
    exchange: String,
    /// Time of the last update.
    now: Nanos,
    /// Settings that another process changed.
    altered: Option<Altered>,
    /// The port brings more than its line can.
    is_flooded: bool,
    /// Share of the bytes that the line damages, in percent, while it damages most of them.
    damaged_percent: Option<u32>,
    /// The most restarts of the scanner in 10 s since the last 10 s without one.
    restarts: u64,
    /// Consumers that got nothing, as of the last status.
    unserved: usize,
    /// Statuses in a row that said that there are some.
    unserved_for: u32,
    /// The measuring mode of which was said whether it has marks.
    told_mode: u8,
}

/// A change of the port's settings by another process, and the message about it.
struct Altered {
    alteration: Alteration,
    words: String,
    /// Time until which the message is shown.
    until: Nanos,
}

/// What the words are made from.
#[derive(Clone, Copy, PartialEq)]
struct Facts {
    state: State,
    trouble: Option<Trouble>,
    /// Rate of the bytes that arrive while the session is [missing](line::Session::missing) something, or was
    /// interrupted.
    bytes_per_second: Option<u64>,
    /// Whether bytes arrive that are not of the scanner that has streamed.
    is_exchanged: bool,
    other_model: Option<&'static str>,
    unit_mm: Option<u8>,
    notice: Option<Notice>,
}

impl<'a> Diagnosis<'a> {
    /// Nothing is wrong with `link` yet.
    pub(crate) fn new(link: &'a Link) -> Self {
        Diagnosis {
            link,
            facts: None,
            words: String::new(),
            doubt: String::new(),
            device: None,
            byte_rate: ByteRate::default(),
            family: None,
            telegrams: 0,
            last_telegram: None,
            has_streamed: false,
            exchange: String::new(),
            now: 0,
            altered: None,
            is_flooded: false,
            damaged_percent: None,
            restarts: 0,
            unserved: 0,
            unserved_for: 0,
            told_mode: Status::MODE_UNKNOWN,
        }
    }

    /// Looks at `session`, at `now`. The state of the link, and whether anything is new since the last look.
    pub(crate) fn examine(&mut self, session: &PortSession, now: Nanos) -> (State, bool) {
        if self.altered.take_if(|altered| now >= altered.until).is_some() {
            self.facts = None;
        }
        self.now = now;
        let bytes_per_second = self.measure(session, now);
        let state = if self.is_doubtful(session) { State::Absent } else { state_of(session) };
        let facts = Facts {
            state,
            trouble: session.trouble(),
            bytes_per_second,
            is_exchanged: self.is_exchanged(session, bytes_per_second),
            other_model: session.other_model().map(|model| model.name),
            unit_mm: session.unit_mm(),
            notice: session.notice(),
        };
        let is_new = self.facts != Some(facts);
        if is_new {
            // What is good to know is no error.
            if let Some(notice) = facts.notice.filter(|notice| !notice.is_fault)
                && self.facts.is_none_or(|before| before.notice != Some(notice))
            {
                tracing::info!("{}: {}", self.link.name, notice.text);
            }
            self.facts = Some(facts);
            self.words = self.trouble(session);
            if let Some(rate) = facts.bytes_per_second.filter(|_| facts.is_exchanged) {
                self.exchange = self.bytes_of_another_kind(session, rate);
            } else if self.family.is_some() {
                self.exchange.clear();
            }
        }
        (state, is_new)
    }

    /// Measures the rate of the bytes that arrive at `now`. Returns it while the session is missing something, or was
    /// interrupted.
    fn measure(&mut self, session: &PortSession, now: Nanos) -> Option<u64> {
        let account = session.account();
        if session.family() != self.family {
            (self.family, self.last_telegram, self.has_streamed) = (session.family(), None, false);
        }
        if account.telegrams != self.telegrams {
            (self.telegrams, self.last_telegram) = (account.telegrams, Some(now));
        }
        if session.state() == line::State::Streaming {
            self.has_streamed = true;
            self.byte_rate = ByteRate::default();
            return None;
        }
        self.byte_rate.note(now, account.read);
        let is_shown = self.is_silent_for(SILENCE) || session.missing().is_some();
        if is_shown { self.byte_rate.shown(now, account.read) } else { None }
    }

    /// Returns whether telegrams have arrived, and then none for at least `span`.
    fn is_silent_for(&self, span: Nanos) -> bool {
        self.last_telegram.is_some_and(|at| self.now >= at + span)
    }

    /// Returns whether another scanner must have been connected: a stream of bytes arrives, but no telegram of the scanner that
    /// has streamed. If the line has damaged most bytes before, it may damage all of them now.
    fn is_exchanged(&self, session: &PortSession, bytes_per_second: Option<u64>) -> bool {
        session.state() != line::State::Paused
            && self.has_streamed
            && self.is_silent_for(EXCHANGED_AFTER)
            && self.damaged_percent.is_none()
            && bytes_per_second.is_some_and(|rate| rate >= STREAM_BYTES)
    }

    /// Handles that the port has been opened, as `device` if that is known.
    pub(crate) fn open(&mut self, device: Option<&Path>) {
        self.device = device.map(|device| device.display().to_string());
        self.byte_rate = ByteRate::default();
        (self.telegrams, self.last_telegram, self.has_streamed) = (0, None, false);
        self.exchange.clear();
        // This describes the previous connection.
        self.damaged_percent = None;
    }

    /// Notes the `alteration` that the hub has undone at `now`. `program` searches for the program that made it. A message that
    /// already names the alteration stays: a program that keeps changing the port is not worth a search each time.
    pub(crate) fn note_altered(
        &mut self,
        alteration: Alteration,
        program: impl FnOnce() -> Option<String>,
        now: Nanos,
    ) {
        let words = match self.altered.take() {
            Some(altered) if altered.alteration == alteration => altered.words,
            _ => {
                self.facts = None;
                program().map_or_else(|| alteration.to_string(), |program| format!("{alteration}; {program}"))
            }
        };
        self.altered = Some(Altered { alteration, words, until: now + ALTERED_SHOWN });
    }

    /// What is wrong, in words; empty if nothing is.
    pub(crate) fn explanation(&self) -> &str {
        &self.words
    }

    /// The session is over: what is wrong is not what was.
    pub(crate) fn forget(&mut self) {
        self.facts = None;
    }

    /// Why the port went away, if it did so without a byte; else empty. While it may do so again, it is not said to be
    /// there.
    pub(crate) fn doubt(&mut self, why: String) {
        self.doubt = why;
    }

    /// Notes whether the port brings more than its line can.
    pub(crate) fn watch_flood(&mut self, is_flooded: bool) {
        if std::mem::replace(&mut self.is_flooded, is_flooded) != is_flooded {
            self.facts = None;
        }
    }

    /// The port is closed: what it brought is no flood any more.
    pub(crate) fn end_flood(&mut self) {
        self.is_flooded = false;
    }

    /// Notes the state of the line in the last ten seconds, once a status.
    pub(crate) fn watch_line(&mut self, line: LineHealth) {
        // Where scans do not arrive, bytes of a scanner that was received count too, unless nothing is wrong.
        let is_troubled = self.facts.is_some_and(|facts| facts.trouble.is_some());
        let is_received = is_troubled && line.telegrams >= FEW_TELEGRAMS;
        let share = if is_received { line.damaged.max(line.discarded) } else { line.damaged };
        let percent = (100.0 * share).round() as u32;
        let damaged_percent = match self.damaged_percent {
            // Another scanner may have sent bytes without any telegram among them.
            None if self.family.is_none() || self.is_silent_for(SILENCE) => None,
            None => Some(percent).filter(|&percent| percent >= MOST_DAMAGED),
            // A number that changes every second would be logged every second.
            Some(before) if before.abs_diff(percent) < COARSE => Some(before),
            Some(_) => Some(percent).filter(|&percent| percent >= MOST_DAMAGED - COARSE),
        };
        let restarts = if line.restarts == 0 { 0 } else { self.restarts.max(line.restarts) };
        if (damaged_percent, restarts) != (self.damaged_percent, self.restarts) {
            (self.damaged_percent, self.restarts) = (damaged_percent, restarts);
            self.facts = None;
        }
    }

    /// Notes how many consumers are attached and get nothing, once a status.
    pub(crate) fn watch_unserved(&mut self, consumers: usize) {
        let before = self.unserved_for;
        self.unserved = consumers;
        self.unserved_for = if consumers > 0 { before.saturating_add(1) } else { 0 };
        if self.unserved_for == UNSERVED_LIMIT || before >= UNSERVED_LIMIT && self.unserved_for == 0 {
            // Whoever is served shall read it in the status.
            self.facts = None;
        }
        if self.unserved_for == UNSERVED_LIMIT {
            tracing::warn!("{}: {}", self.link.name, self.unserved());
        }
    }

    /// Logs once that the measuring mode of `status` has no marks, and the command that changes it. This is not an error.
    pub(crate) fn tell_mode(&mut self, status: &Status) {
        if std::mem::replace(&mut self.told_mode, status.mode) != status.mode
            && let Some(mode) = status.missing_reflector_mode()
        {
            let (name, port) = (&self.link.name, status.port());
            let remedy = format!("scanhub configure {port} mode={mode:#04x}");
            tracing::info!("{name}: marks are unavailable; stop the hub and run `{remedy}`");
        }
    }

    /// Whether the port may go away again before it brings anything, as it did the last time: a serial server that
    /// serves somebody else takes each connection and closes it.
    fn is_doubtful(&self, session: &PortSession) -> bool {
        let is_silent = session.account().read == 0 && session.trouble().is_none();
        !self.doubt.is_empty() && is_silent && session.state() == line::State::Probing
    }

    fn trouble(&self, session: &PortSession) -> String {
        if self.is_doubtful(session) {
            return self.doubt.clone();
        }
        if self.is_flooded {
            return format!(
                "the server sends more than a line of {} baud carries; the hub reads at most twice that; the serial \
                 server must be in raw mode at that rate",
                self.link.max_rate()
            );
        }
        if let Some(altered) = &self.altered {
            return altered.words.clone();
        }
        // Damage and restarts explain most other findings, so they come first.
        if let Some(percent) = self.damaged_percent {
            return format!(
                "{percent} % of the bytes are damaged on the line: check the cable, its ground and termination, and the adapter"
            );
        }
        match self.restarts {
            0 => {}
            1 => return "the scanner restarted: is its supply strong enough?".to_owned(),
            count => {
                return format!("the scanner restarted {count} times in 10 s: is its supply strong enough?");
            }
        }
        let rate = self.facts.and_then(|facts| facts.bytes_per_second);
        if let Some(rate) = rate.filter(|_| self.facts.is_some_and(|facts| facts.is_exchanged)) {
            return self.bytes_of_another_kind(session, rate);
        }
        let account = session.account();
        let is_damaged = self.last_telegram.is_some() && account.discarded > account.read / 2;
        if let Some(rate) = rate.filter(|_| is_damaged && !self.has_streamed) {
            return format!(
                "{} bytes/s arrive, but few telegrams of the {} are intact: check the cable, its ground and termination, \
                 and the adapter",
                with_commas(rate),
                scanner_of(session)
            );
        }
        if let Some((missing, rate)) = session.missing().zip(rate) {
            return self.other_bytes(missing, rate);
        }
        // Soon the rate of the bytes gives a better message than "no answer".
        if session.missing().is_some() && self.byte_rate.is_settling(self.now, account.read) {
            return self.words.clone();
        }
        match session.trouble() {
            // Another family's scanner may be connected, or one at a rate that this family does not have.
            Some(Trouble::Search(trouble)) => self.search_trouble(trouble),
            // The search has just begun.
            Some(_) if self.family.is_none() && !self.exchange.is_empty() => self.exchange.clone(),
            Some(trouble) if session.missing().is_some() => self.silence(&trouble.to_string()),
            Some(trouble) => trouble.to_string(),
            None => self.mismatch(session).unwrap_or_else(|| match session.notice() {
                _ if self.unserved_for >= UNSERVED_LIMIT => self.unserved(),
                Some(notice) if notice.is_fault => notice.text.to_owned(),
                _ => String::new(),
            }),
        }
    }

    /// Returns the message that `rate` bytes per second arrive, but none of the `missing` transmissions.
    fn other_bytes(&self, missing: &str, rate: u64) -> String {
        let is_server = matches!(self.link.port, Source::Tcp { .. });
        let other_rate = if is_server { ", or does the server use another rate" } else { "" };
        let bytes = with_commas(rate);
        let words = format!("{bytes} bytes/s arrive, but no {missing}; is it another scanner{other_rate}?");
        self.with_remedy(&words)
    }

    /// Returns the message that `rate` bytes per second arrive that are not of the scanner of `session`, which has streamed
    /// before.
    fn bytes_of_another_kind(&self, session: &PortSession, rate: u64) -> String {
        let name = scanner_of(session);
        let is_server = matches!(self.link.port, Source::Tcp { .. });
        // The bytes are the same in both cases.
        let other = if is_server { "another rate of the server" } else { "a damaged line" };
        let bytes = with_commas(rate);
        let words =
            format!("{bytes} bytes/s arrive, but nothing from the {name}: another scanner, or {other}?");
        if self.link.family().is_none() {
            return format!("{words} The search begins after 10 s without it");
        }
        self.with_remedy(&words)
    }

    /// Returns `words` about a scanner that does not reply, and how to find out whether it belongs to another family, if the
    /// family is configured and both fit into a status. `scanhub probe` cannot search the port while the hub has it.
    fn silence(&self, words: &str) -> String {
        let Some(keys) = self.family_keys() else { return words.to_owned() };
        let words = format!("{words} Another scanner?");
        let name = &self.link.name;
        let both = |port: &str| {
            format!("{words} Remove {keys} from link {name}, or stop the hub and try: scanhub probe {port}")
        };
        let probe = |port: &str| format!("{words} Stop the hub and try: scanhub probe {port}");
        self.with_port(both).or_else(|| self.with_port(probe)).unwrap_or_else(|| self.with_remedy(&words))
    }

    /// Returns the keys of the link that name the family, as text. `None` if there are none, or if the link plays a recording.
    fn family_keys(&self) -> Option<String> {
        let keys = match &self.link.scanner.named_by[..] {
            [keys @ .., last] if !keys.is_empty() => format!("{} and {last}", keys.join(", ")),
            keys => keys.concat(),
        };
        (!keys.is_empty() && !matches!(self.link.port, Source::File { .. })).then_some(keys)
    }

    /// Returns `words` and the remedy, if the family is configured and they fit into a status: the scanner may belong to
    /// another family.
    fn with_remedy(&self, words: &str) -> String {
        let Some(keys) = self.family_keys() else { return words.to_owned() };
        let name = &self.link.name;
        let remedies = [
            format!("Remove {keys} from link {name} and restart the hub: it finds the scanner"),
            format!("Remove {keys} from link {name}, restart the hub"),
            format!("Remove {keys} from the link"),
        ];
        let mut messages = remedies.into_iter().map(|remedy| format!("{words} {remedy}"));
        let message = messages.find(|message| message.len() <= Status::MAX_ERROR_LEN);
        message.unwrap_or_else(|| words.to_owned())
    }

    /// Returns why the search finds no scanner, with the port if the message then fits into a status.
    fn search_trouble(&self, trouble: search::Trouble) -> String {
        self.with_port(|port| trouble.message(port)).unwrap_or_else(|| trouble.to_string())
    }

    /// Returns the message for the name of the port, or else for its device. `None` if the port cannot be probed, or no message
    /// fits into a status.
    fn with_port(&self, message: impl Fn(&str) -> String) -> Option<String> {
        let ports = match self.link.port {
            Source::Tty(_) | Source::Tcp { .. } => vec![Some(self.link.port.name()), self.device.clone()],
            _ => Vec::new(),
        };
        let mut messages = ports.into_iter().flatten().map(|port| message(&port));
        messages.find(|message| message.len() <= Status::MAX_ERROR_LEN)
    }

    /// Returns how the configuration differs from what the scanner reports.
    fn mismatch(&self, session: &PortSession) -> Option<String> {
        let Link { name, scanner, .. } = self.link;
        let units = session.unit_mm().zip(scanner.settings.unit_mm);
        if let Some((is, expected)) = units.filter(|(is, expected)| is != expected) {
            return Some(format!(
                "the sensor measures in units of {is} mm, the configuration says {expected} mm; the unit is stored in its \
                 EEPROM, which the hub never writes"
            ));
        }
        if let Some(is) = session.other_model() {
            return Some(format!(
                "model {} is configured, but the scanner is a {} or compatible with it: set link.{name}.model",
                scanner.model().name,
                is.name
            ));
        }
        let (model, beams) = session.model().zip(session.beams())?;
        let room = self.link.max_beams();
        (beams < model.beams && beams == room && scanner.is_auto()).then(|| {
            format!(
                "the scanner measures {} points per revolution, but topics have room for {room}: set link.{name}.model or \
                 link.{name}.beams",
                model.beams
            )
        })
    }

    fn unserved(&self) -> String {
        let count = self.unserved;
        format!(
            "{count} consumers are attached but get nothing: raise the limit of open descriptors (ulimit -n)"
        )
    }
}

/// Returns the name of the scanner of `session`: its model's, or else its family's.
fn scanner_of(session: &PortSession) -> String {
    let family = session.family().map_or("", |family| family.name());
    session.model().map_or_else(|| format!("{family} scanner"), |model| model.name.to_owned())
}

/// The word for how far `session` is.
fn state_of(session: &PortSession) -> State {
    match session.state() {
        line::State::Probing => State::Probing,
        line::State::Switching => State::Switching,
        line::State::Starting => State::Starting,
        line::State::Streaming => State::Streaming,
        line::State::Silent => State::Silent,
        line::State::Paused => State::Paused,
    }
}

/// Share of damaged bytes from which on nothing is concluded from the others, in percent.
const MOST_DAMAGED: u32 = 50;
/// Steps in which that share is reported.
const COARSE: u32 = 10;
/// Minimum silence of a scanner after which damage is not concluded from bytes alone.
const SILENCE: Nanos = 1_000 * MILLIS;
/// Minimum silence of a scanner after which other bytes are reported as those of another scanner.
const EXCHANGED_AFTER: Nanos = 2_000 * MILLIS;
/// Minimum number of bytes per second of a stream: an LMS at 9,600 baud sends twice that. A boot message is shorter.
const STREAM_BYTES: u64 = 500;
/// Fewer telegrams in 10 s may be chance matches in the bytes of another scanner.
const FEW_TELEGRAMS: u64 = 3;
/// Time for which a status reports that another process changed the port's settings.
const ALTERED_SHOWN: Nanos = 10_000 * MILLIS;
/// Statuses after which consumers without samples are more than ones that are just attaching.
const UNSERVED_LIMIT: u32 = 3;
