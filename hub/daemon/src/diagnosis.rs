//! Finds the problem of a link that its status reports: the session's problem, a unit other than the configured one, more
//! bytes than the line can carry, a line that damages most bytes, bytes of another scanner, settings that another process
//! changed, a scanner that restarts, and subscribers that receive nothing.

use std::path::Path;

use config::{Link, Scanner};
use port::{Alteration, Source};
use scanhub_drivers::line::Session as _;
use scanhub_drivers::lms::Notice;
use scanhub_drivers::lms::variant::Unit;
use scanhub_drivers::{line, lms};
use schema::{MILLIS, Nanos, State, Status};

use crate::byte_rate::{ByteRate, with_commas};
use crate::driver::{Driver, Trouble};
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
    /// Rate of the bytes that arrive while the session is [missing](line::Session::missing) something.
    bytes_per_second: Option<u64>,
    other_model: Option<&'static str>,
    unit: Option<Unit>,
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
            altered: None,
            is_flooded: false,
            damaged_percent: None,
            restarts: 0,
            unserved: 0,
            unserved_for: 0,
            told_mode: Status::MODE_UNKNOWN,
        }
    }

    /// Looks at `driver`, at `now`. The state of the link, and whether anything is new since the last look.
    pub(crate) fn examine(&mut self, driver: &Driver, now: Nanos) -> (State, bool) {
        if self.altered.take_if(|altered| now >= altered.until).is_some() {
            self.facts = None;
        }
        let bytes_per_second = self.measure(driver, now);
        let state = if self.is_doubtful(driver) { State::Absent } else { state_of(driver) };
        let sensor = driver.lms().map(lms::Session::sensor);
        let facts = Facts {
            state,
            trouble: driver.trouble(),
            bytes_per_second,
            other_model: driver.other_model().map(|model| model.name),
            unit: sensor.and_then(|sensor| sensor.unit),
            notice: sensor.and_then(|sensor| sensor.notices().next()),
        };
        let is_new = self.facts != Some(facts);
        if is_new {
            // What is good to know is no error.
            if let Some(notice) = facts.notice.filter(|notice| !notice.is_fault())
                && self.facts.is_none_or(|before| before.notice != Some(notice))
            {
                tracing::info!("{}: {notice}", self.link.name);
            }
            self.facts = Some(facts);
            self.words = self.trouble(driver);
        }
        (state, is_new)
    }

    /// Measures the rate of the bytes that arrive at `now`. Returns it while the session is missing something.
    fn measure(&mut self, driver: &Driver, now: Nanos) -> Option<u64> {
        if driver.state() == line::State::Streaming {
            self.byte_rate = ByteRate::default();
            return None;
        }
        let read = driver.account().read;
        self.byte_rate.note(now, read);
        driver.missing().and_then(|_| self.byte_rate.shown(now, read))
    }

    /// Handles that the port has been opened, as `device` if that is known.
    pub(crate) fn open(&mut self, device: Option<&Path>) {
        self.device = device.map(|device| device.display().to_string());
        self.byte_rate = ByteRate::default();
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

    /// Says once that the measuring mode of `status` has no marks, which is no error, and what changes it.
    pub(crate) fn tell_mode(&mut self, status: &Status) {
        if std::mem::replace(&mut self.told_mode, status.mode) != status.mode
            && let Some(remedy) = status.reflector_remedy()
        {
            let name = &self.link.name;
            tracing::info!("{name}: marks are unavailable; stop the hub and run `{remedy}`");
        }
    }

    /// Whether the port may go away again before it brings anything, as it did the last time: a serial server that
    /// serves somebody else takes each connection and closes it.
    fn is_doubtful(&self, driver: &Driver) -> bool {
        let is_silent = driver.account().read == 0 && driver.trouble().is_none();
        !self.doubt.is_empty() && is_silent && driver.state() == line::State::Probing
    }

    fn trouble(&self, driver: &Driver) -> String {
        if self.is_doubtful(driver) {
            return self.doubt.clone();
        }
        if self.is_flooded {
            return format!(
                "the server sends more than a line of {} baud carries; the hub reads at most twice that; the serial \
                 server must be in raw mode at that rate",
                self.link.most_rate()
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
        if let Some((missing, rate)) = driver.missing().zip(rate) {
            return self.other_bytes(missing, rate);
        }
        let is_server = matches!(self.link.port, Source::Tcp { .. });
        match driver.trouble() {
            Some(Trouble::Lms(lms::Trouble::NoAnswer { .. })) if is_server => self.with_probe(&format!(
                "no answer at {} baud, the rate set in the serial server: power, cable, rate?",
                self.link.baud.rate()
            )),
            // Another family's scanner may be connected, or one at a rate that this family does not have.
            Some(trouble) if driver.missing().is_some() => self.with_probe(&trouble.to_string()),
            Some(trouble) => trouble.to_string(),
            None => self.mismatch(driver).unwrap_or_else(|| match driver.lms() {
                _ if self.unserved_for >= UNSERVED_LIMIT => self.unserved(),
                Some(session) => {
                    let fault = session.sensor().notices().find(|notice| notice.is_fault());
                    fault.map_or_else(String::new, |notice| notice.to_string())
                }
                None => String::new(),
            }),
        }
    }

    /// Returns the message that `rate` bytes per second arrive, but none of the `missing` transmissions.
    fn other_bytes(&self, missing: &str, rate: u64) -> String {
        let is_server = matches!(self.link.port, Source::Tcp { .. });
        let other_rate = if is_server { ", or does the server use another rate" } else { "" };
        let bytes = with_commas(rate);
        let words = format!("{bytes} bytes/s arrive, but no {missing}; is it another scanner{other_rate}?");
        self.try_probe(&words, "")
    }

    /// Returns `words` about a scanner that does not reply, with the command that searches for all scanners.
    fn with_probe(&self, words: &str) -> String {
        self.try_probe(words, " Another scanner?")
    }

    /// Returns `words` with a question and the command that probes the port, if it can be probed and the whole command fits
    /// into a status.
    fn try_probe(&self, words: &str, question: &str) -> String {
        let ports = match self.link.port {
            Source::Tty(_) | Source::Tcp { .. } => vec![Some(self.link.port.name()), self.device.clone()],
            _ => Vec::new(),
        };
        let message = |port: String| format!("{words}{question} Try: scanhub probe {port}");
        let mut messages = ports.into_iter().flatten().map(message);
        let whole = messages.find(|message| message.len() <= Status::MAX_ERROR_LEN);
        whole.unwrap_or_else(|| words.to_owned())
    }

    /// What the configuration says otherwise than the scanner.
    fn mismatch(&self, driver: &Driver) -> Option<String> {
        let unit = driver.lms().and_then(|session| session.sensor().unit);
        if let Some((is, expected)) = unit.zip(self.link.unit).filter(|(is, expected)| is != expected) {
            return Some(format!(
                "the sensor measures in units of {} mm, the configuration says {} mm; the unit is stored in its EEPROM, \
                 which the hub never writes",
                is.mm(),
                expected.mm()
            ));
        }
        let name = &self.link.name;
        if let Some((is, Scanner::Turning(turning))) = driver.other_model().zip(Some(self.link.scanner)) {
            return Some(format!(
                "model {} is configured, but the scanner is a {} or compatible with it: set link.{name}.model",
                turning.model.name, is.name
            ));
        }
        let (model, beams) = driver.model()?;
        let Scanner::Turning(turning) = self.link.scanner else { return None };
        (beams < model.beams && beams == self.link.beams() && turning.is_auto()).then(|| {
            format!(
                "the scanner measures {} points per revolution, but topics have room for {}: set link.{name}.model or \
                 link.{name}.beams",
                model.beams,
                self.link.beams()
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

/// The word for how far `session` is.
fn state_of(session: &Driver) -> State {
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
/// Fewer telegrams in 10 s may be chance matches in the bytes of another scanner.
const FEW_TELEGRAMS: u64 = 3;
/// Time for which a status reports that another process changed the port's settings.
const ALTERED_SHOWN: Nanos = 10_000 * MILLIS;
/// Statuses after which consumers without samples are more than ones that are just attaching.
const UNSERVED_LIMIT: u32 = 3;
