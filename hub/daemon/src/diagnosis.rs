//! Diagnosis of the problem that a link's status reports:
//!
//! - the problem of the session, or a unit that differs from the configured unit
//! - more bytes than the line can carry, or a line that damages most bytes
//! - bytes of another scanner, or a scanner that restarts
//! - settings of the port that another process changed
//! - subscribers that receive nothing
//!
//! Every change of the message is a log line. Numbers in a message are therefore rounded, and a number in a message
//! stays while the measured one varies only a little.

use std::path::Path;

use scanhub_config::Link;
use scanhub_drivers::line::{Notice, ScannerSession as _};
use scanhub_drivers::{PortSession, Problem, line, search};
use scanhub_port::{PortSpec, SettingsChange};
use scanhub_schema::{Family, MILLIS, Nanos, State, Status};

use crate::link_stats::LineHealth;

/// Problems of one link.
pub(crate) struct Diagnosis<'a> {
    link: &'a Link,
    /// Findings that the message was made from; `None` if the message must be made again.
    findings: Option<Findings>,
    /// Message about the problem; empty if there is none.
    message: String,
    /// Message that the last connection closed without delivering a byte; otherwise empty.
    empty_connection: String,
    /// Device of the open port, for a message that has no room for the configured name.
    device: Option<String>,
    /// Rate of the bytes that arrive while nothing is streaming.
    byte_rate: ByteRate,
    /// Family of the scanner. `None` while the session searches for it.
    family: Option<Family>,
    /// Time of the scanner's last telegram. `None` before the first one.
    last_telegram: Option<Nanos>,
    /// Time of the latest telegram since the last update; `None` if none has arrived.
    new_telegram: Option<Nanos>,
    /// Whether the scanner has streamed since the port was opened.
    has_streamed: bool,
    /// Message that the scanner was exchanged, until the session has found the new scanner. Otherwise empty.
    exchange: String,
    /// Time of the last update.
    now: Nanos,
    /// Settings of the port that another process changed.
    settings_change: Option<ReportedChange>,
    /// Whether the port delivers more than its line can carry.
    is_flooded: bool,
    /// Share of the bytes that the line damages, in percent, while it damages most of them.
    damaged_percent: Option<u32>,
    /// Highest number of restarts of the scanner within 10 s, since there were last 10 s without a restart.
    restarts: u64,
    /// Attached subscribers that receive nothing, as of the last status.
    starved: usize,
    /// Number of consecutive statuses at which subscribers received nothing.
    starved_statuses: u32,
    /// Measuring mode of the last status, so that a mode without marks is logged only once.
    logged_mode: u8,
}

/// A change of the port's settings by another process, and the message about it.
struct ReportedChange {
    change: SettingsChange,
    message: String,
    /// Time until which the message is shown.
    until: Nanos,
}

/// Findings that a message is made from.
#[derive(Clone, Copy, PartialEq)]
struct Findings {
    state: State,
    problem: Option<Problem>,
    /// Rate of the bytes that arrive while the session is [missing](line::Session::missing) something, or was
    /// interrupted.
    bytes_per_second: Option<u64>,
    /// Whether bytes arrive that do not come from the scanner that has streamed.
    is_exchanged: bool,
    other_model: Option<&'static str>,
    unit_mm: Option<u8>,
    notice: Option<Notice>,
}

impl<'a> Diagnosis<'a> {
    /// Creates the diagnosis of `link`, without a problem.
    pub(crate) fn new(link: &'a Link) -> Self {
        Diagnosis {
            link,
            findings: None,
            message: String::new(),
            empty_connection: String::new(),
            device: None,
            byte_rate: ByteRate::default(),
            family: None,
            last_telegram: None,
            new_telegram: None,
            has_streamed: false,
            exchange: String::new(),
            now: 0,
            settings_change: None,
            is_flooded: false,
            damaged_percent: None,
            restarts: 0,
            starved: 0,
            starved_statuses: 0,
            logged_mode: Status::MODE_UNKNOWN,
        }
    }

    /// Updates the diagnosis from `session` at `now`. Returns the state of the link, and whether anything has changed.
    pub(crate) fn update(&mut self, session: &PortSession, now: Nanos) -> (State, bool) {
        if self.settings_change.take_if(|altered| now >= altered.until).is_some() {
            self.findings = None;
        }
        self.now = now;
        let bytes_per_second = self.measure_byte_rate(session, now);
        let state = if self.may_disconnect(session) { State::Absent } else { state_of(session) };
        let findings = Findings {
            state,
            problem: session.problem(),
            bytes_per_second,
            is_exchanged: self.is_exchanged(session, bytes_per_second),
            other_model: session.unexpected_model().map(|model| model.name),
            unit_mm: session.unit_mm(),
            notice: session.notice(),
        };
        let is_new = self.findings != Some(findings);
        if is_new {
            // A notice that is not a fault only goes to the log.
            if let Some(notice) = findings.notice.filter(|notice| !notice.is_fault)
                && self.findings.is_none_or(|before| before.notice != Some(notice))
            {
                tracing::info!("{}: {}", self.link.name, notice.text);
            }
            self.findings = Some(findings);
            self.message = self.problem(session);
            if let Some(rate) = findings.bytes_per_second.filter(|_| findings.is_exchanged) {
                self.exchange = self.bytes_of_other_scanner(session, rate);
            } else if self.family.is_some() {
                self.exchange.clear();
            }
        }
        (state, is_new)
    }

    /// Measures the rate of the bytes that arrive at `now`. Returns it while the session is missing something, or was
    /// interrupted.
    fn measure_byte_rate(&mut self, session: &PortSession, now: Nanos) -> Option<u64> {
        let stats = session.stats();
        if session.family() != self.family {
            (self.family, self.last_telegram, self.has_streamed) = (session.family(), None, false);
        }
        self.last_telegram = self.new_telegram.take().or(self.last_telegram);
        if session.state() == line::State::Streaming {
            self.has_streamed = true;
            self.byte_rate = ByteRate::default();
            return None;
        }
        self.byte_rate.note(now, stats.read);
        let is_shown = self.is_silent_for(MIN_SILENCE) || session.missing_transmission().is_some();
        if is_shown { self.byte_rate.reported_rate(now, stats.read) } else { None }
    }

    /// Returns whether telegrams have arrived, and then none for at least `span`.
    fn is_silent_for(&self, span: Nanos) -> bool {
        self.last_telegram.is_some_and(|at| self.now >= at + span)
    }

    /// Returns whether another scanner must have been connected: a stream of bytes arrives, but no telegram of the
    /// scanner that has streamed. Returns `false` if the line has damaged most bytes before, because it may damage all
    /// of them now.
    fn is_exchanged(&self, session: &PortSession, bytes_per_second: Option<u64>) -> bool {
        session.state() != line::State::Paused
            && self.has_streamed
            && self.is_silent_for(MIN_EXCHANGE_SILENCE)
            && self.damaged_percent.is_none()
            && bytes_per_second.is_some_and(|rate| rate >= MIN_STREAM_RATE)
    }

    /// Handles that the port has been opened. `device` is the device that the port's name resolved to, if known.
    pub(crate) fn on_port_opened(&mut self, device: Option<&Path>) {
        self.device = device.map(|device| device.display().to_string());
        self.byte_rate = ByteRate::default();
        (self.last_telegram, self.new_telegram, self.has_streamed) = (None, None, false);
        self.exchange.clear();
        // The share of damaged bytes belongs to the previous connection.
        self.damaged_percent = None;
    }

    /// Notes the `change` that the hub has undone at `now`. `program` searches for the program that made it. If the
    /// current message already names the change, the message stays. A program that keeps changing the port therefore
    /// does not cause a search every time.
    pub(crate) fn note_settings_change(
        &mut self,
        change: SettingsChange,
        program: impl FnOnce() -> Option<String>,
        now: Nanos,
    ) {
        let message = match self.settings_change.take() {
            Some(reported) if reported.change == change => reported.message,
            _ => {
                self.findings = None;
                program().map_or_else(|| change.to_string(), |program| format!("{change}; {program}"))
            }
        };
        self.settings_change = Some(ReportedChange { change, message, until: now + SETTINGS_CHANGE_TIME });
    }

    /// Notes a telegram that arrived at `now`.
    pub(crate) fn note_telegram(&mut self, now: Nanos) {
        self.new_telegram = Some(now);
    }

    /// Returns whether the message must be made again.
    pub(crate) fn is_outdated(&self) -> bool {
        self.findings.is_none()
    }

    /// Returns the message about the problem; an empty string if there is none.
    pub(crate) fn message(&self) -> &str {
        &self.message
    }

    /// Handles the end of the session. The next session has its own problems.
    pub(crate) fn end_session(&mut self) {
        self.findings = None;
    }

    /// Stores `message`, which says that the last connection closed without delivering a byte. An empty `message` means
    /// that the last connection delivered bytes. While the next connection may also close in this way, the port counts
    /// as absent.
    pub(crate) fn note_empty_connection(&mut self, message: String) {
        self.empty_connection = message;
    }

    /// Notes whether the port delivers more than its line can carry.
    pub(crate) fn note_flood(&mut self, is_flooded: bool) {
        if std::mem::replace(&mut self.is_flooded, is_flooded) != is_flooded {
            self.findings = None;
        }
    }

    /// Handles that the port was closed, which also ends a flood.
    pub(crate) fn end_flood(&mut self) {
        self.is_flooded = false;
    }

    /// Notes the state of the line in the last ten seconds. Called once per status.
    pub(crate) fn note_line(&mut self, line: LineHealth) {
        // `damaged` counts only while scans arrive. If there is a problem and telegrams still arrive, bytes outside
        // telegrams therefore count as damaged too.
        let has_problem = self.findings.is_some_and(|findings| findings.problem.is_some());
        let is_received = has_problem && line.telegrams >= MIN_TELEGRAMS;
        let share = if is_received { line.damaged.max(line.discarded) } else { line.damaged };
        let percent = (100.0 * share).round() as u32;
        let damaged_percent = match self.damaged_percent {
            // Without telegrams, the bytes may come from another scanner, so do not conclude that the line damages
            // them.
            None if self.family.is_none() || self.is_silent_for(MIN_SILENCE) => None,
            None => Some(percent).filter(|&percent| percent >= UNRELIABLE_PERCENT),
            // A number that changes every second would be logged every second.
            Some(before) if before.abs_diff(percent) < PERCENT_STEP => Some(before),
            Some(_) => Some(percent).filter(|&percent| percent >= UNRELIABLE_PERCENT - PERCENT_STEP),
        };
        let restarts = if line.restarts == 0 { 0 } else { self.restarts.max(line.restarts) };
        if (damaged_percent, restarts) != (self.damaged_percent, self.restarts) {
            (self.damaged_percent, self.restarts) = (damaged_percent, restarts);
            self.findings = None;
        }
    }

    /// Notes how many subscribers are attached but receive nothing. Called once per status.
    pub(crate) fn note_starved_subscribers(&mut self, starved: usize) {
        let before = self.starved_statuses;
        self.starved = starved;
        self.starved_statuses = if starved > 0 { before.saturating_add(1) } else { 0 };
        if self.starved_statuses == MAX_STARVED_STATUSES
            || before >= MAX_STARVED_STATUSES && self.starved_statuses == 0
        {
            // Subscribers that do receive samples read the message in the status.
            self.findings = None;
        }
        if self.starved_statuses == MAX_STARVED_STATUSES {
            tracing::warn!("{}: {}", self.link.name, self.starved_message());
        }
    }

    /// Logs once that the measuring mode of `status` has no marks, and the command that changes it. This is not an
    /// error.
    pub(crate) fn log_missing_marks(&mut self, status: &Status) {
        if std::mem::replace(&mut self.logged_mode, status.mode) != status.mode
            && let Some(mode) = status.missing_reflector_mode()
        {
            let (name, port) = (&self.link.name, status.port());
            let remedy = format!("scanhub configure {port} mode={mode:#04x}");
            tracing::info!("{name}: marks are unavailable; stop the hub and run `{remedy}`");
        }
    }

    /// Returns whether the port may close again before it delivers anything, as it did the last time. A serial server
    /// that serves another client accepts each connection and closes it.
    fn may_disconnect(&self, session: &PortSession) -> bool {
        let is_silent = session.stats().read == 0 && session.problem().is_none();
        !self.empty_connection.is_empty() && is_silent && session.state() == line::State::Probing
    }

    /// Returns the message about the problem of `session`; an empty string if there is none.
    fn problem(&self, session: &PortSession) -> String {
        if self.may_disconnect(session) {
            return self.empty_connection.clone();
        }
        if self.is_flooded {
            return format!(
                "the server sends more than a line of {} baud carries; the hub reads at most twice that; the serial \
                 server must be in raw mode at that rate",
                self.link.max_rate()
            );
        }
        if let Some(altered) = &self.settings_change {
            return altered.message.clone();
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
        let rate = self.findings.and_then(|findings| findings.bytes_per_second);
        if let Some(rate) = rate.filter(|_| self.findings.is_some_and(|findings| findings.is_exchanged)) {
            return self.bytes_of_other_scanner(session, rate);
        }
        let stats = session.stats();
        let is_damaged = self.last_telegram.is_some() && stats.discarded > stats.read / 2;
        if let Some(rate) = rate.filter(|_| is_damaged && !self.has_streamed) {
            return format!(
                "{} bytes/s arrive, but few telegrams of the {} are intact: check the cable, its ground and termination, \
                 and the adapter",
                with_commas(rate),
                scanner_name(session)
            );
        }
        if let Some((missing, rate)) = session.missing_transmission().zip(rate) {
            return self.unrecognized_bytes(missing, rate);
        }
        // Keep the message until the rate of the bytes is known, which gives a better message than "no reply".
        if session.missing_transmission().is_some() && self.byte_rate.is_settling(self.now, stats.read) {
            return self.message.clone();
        }
        match session.problem() {
            // The connected scanner may belong to another family, or use a baud rate that this family does not have.
            Some(Problem::Search(problem)) => self.search_problem(problem),
            // The search has just begun.
            Some(_) if self.family.is_none() && !self.exchange.is_empty() => self.exchange.clone(),
            Some(problem) if session.missing_transmission().is_some() => {
                self.without_reply(&problem.to_string())
            }
            Some(problem) => problem.to_string(),
            None => self.mismatch(session).unwrap_or_else(|| match session.notice() {
                _ if self.starved_statuses >= MAX_STARVED_STATUSES => self.starved_message(),
                Some(notice) if notice.is_fault => notice.text.to_owned(),
                _ => String::new(),
            }),
        }
    }

    /// Returns the message that `rate` bytes per second arrive, but none of the `missing` transmissions.
    fn unrecognized_bytes(&self, missing: &str, rate: u64) -> String {
        let is_server = matches!(self.link.port, PortSpec::Tcp { .. });
        let other_rate = if is_server { ", or does the server use another rate" } else { "" };
        let bytes = with_commas(rate);
        let text = format!("{bytes} bytes/s arrive, but no {missing}; is it another scanner{other_rate}?");
        self.with_remedy(&text)
    }

    /// Returns the message that `rate` bytes per second arrive that do not come from the scanner of `session`, which
    /// has streamed before.
    fn bytes_of_other_scanner(&self, session: &PortSession, rate: u64) -> String {
        let name = scanner_name(session);
        let is_server = matches!(self.link.port, PortSpec::Tcp { .. });
        // The hub cannot distinguish the two causes by the bytes.
        let other = if is_server { "another rate of the server" } else { "a damaged line" };
        let bytes = with_commas(rate);
        let text =
            format!("{bytes} bytes/s arrive, but nothing from the {name}: another scanner, or {other}?");
        if self.link.family().is_none() {
            return format!("{text} The search begins after 10 s without it");
        }
        self.with_remedy(&text)
    }

    /// Returns `text` about a scanner that does not reply. If the family is configured, adds how to find out whether
    /// the scanner belongs to another family, as far as this fits into a status. The user must stop the hub first,
    /// because `scanhub probe` cannot search a port that the hub has open.
    fn without_reply(&self, text: &str) -> String {
        let Some(keys) = self.family_keys() else { return text.to_owned() };
        let text = format!("{text} Another scanner?");
        let name = &self.link.name;
        let both = |port: &str| {
            format!("{text} Remove {keys} from link {name}, or stop the hub and try: scanhub probe {port}")
        };
        let probe = |port: &str| format!("{text} Stop the hub and try: scanhub probe {port}");
        self.with_port(both).or_else(|| self.with_port(probe)).unwrap_or_else(|| self.with_remedy(&text))
    }

    /// Returns the keys of the link that name the family, as text. `None` if there are none, or if the link plays a
    /// recording.
    fn family_keys(&self) -> Option<String> {
        let keys = match &self.link.scanner.named_by[..] {
            [keys @ .., last] if !keys.is_empty() => format!("{} and {last}", keys.join(", ")),
            keys => keys.concat(),
        };
        (!keys.is_empty() && !matches!(self.link.port, PortSpec::File { .. })).then_some(keys)
    }

    /// Returns `text`. If the family is configured, adds the remedy if it fits into a status: the scanner may belong to
    /// another family.
    fn with_remedy(&self, text: &str) -> String {
        let Some(keys) = self.family_keys() else { return text.to_owned() };
        let name = &self.link.name;
        let remedies = [
            format!("Remove {keys} from link {name} and restart the hub: it finds the scanner"),
            format!("Remove {keys} from link {name}, restart the hub"),
            format!("Remove {keys} from the link"),
        ];
        let mut messages = remedies.into_iter().map(|remedy| format!("{text} {remedy}"));
        let message = messages.find(|message| message.len() <= Status::MAX_ERROR_LEN);
        message.unwrap_or_else(|| text.to_owned())
    }

    /// Returns why the search finds no scanner, with the port if the message then fits into a status.
    fn search_problem(&self, problem: search::Problem) -> String {
        self.with_port(|port| problem.message(port)).unwrap_or_else(|| problem.to_string())
    }

    /// Returns `message` for the configured name of the port, or for its device if the first message does not fit into
    /// a status. `None` if the port cannot be probed, or if neither message fits.
    fn with_port(&self, message: impl Fn(&str) -> String) -> Option<String> {
        let ports = match self.link.port {
            PortSpec::Tty(_) | PortSpec::Tcp { .. } => vec![Some(self.link.port.name()), self.device.clone()],
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
        if let Some(is) = session.unexpected_model() {
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

    fn starved_message(&self) -> String {
        let count = self.starved;
        format!(
            "{count} subscribers are attached but get nothing: raise the limit of open descriptors (ulimit -n)"
        )
    }
}

/// Rate of the bytes that a session has read, over windows of some seconds.
#[derive(Clone, Copy, Debug, Default)]
struct ByteRate {
    /// Start of the window, and the number of bytes read by then.
    window: Option<(Nanos, u64)>,
    /// Result of the last complete window, in bytes per second; `None` before the first window is complete, or if
    /// almost nothing arrived.
    last_rate: Option<u64>,
    is_complete: bool,
    /// Consecutive windows in which almost nothing arrived.
    quiet_windows: u32,
    /// Rate in the last message, in bytes per second.
    reported: u64,
}

impl ByteRate {
    /// Notes that the session had read `read` bytes at `now`.
    fn note(&mut self, now: Nanos, read: u64) {
        let (since, before) = *self.window.get_or_insert((now, read));
        if !self.is_complete && read == before {
            // The first window begins with the first byte.
            self.window = Some((now, read));
            return;
        }
        if now >= since + RATE_WINDOW {
            let rate = self.window_rate(now, read);
            self.quiet_windows = if rate.is_some() { 0 } else { self.quiet_windows + 1 };
            // Noise near the limit must not change the message with every window: each change is a log line.
            if rate.is_some() || self.quiet_windows >= MAX_QUIET_WINDOWS {
                self.last_rate = rate;
            }
            self.is_complete = true;
            self.window = Some((now, read));
        }
    }

    /// Returns the rate in bytes per second, rounded for a message; `None` if almost nothing arrives, or while the rate
    /// [settles](Self::is_settling). The session has read `read` bytes at `now`. A rate that varies a little is
    /// returned unchanged, because a new message is a new log line.
    fn reported_rate(&mut self, now: Nanos, read: u64) -> Option<u64> {
        let rate = if self.is_complete { self.last_rate } else { self.window_rate(now, read) }?;
        if !(self.reported / 2..=self.reported * 2).contains(&rate) {
            self.reported = rounded(rate);
        }
        Some(self.reported)
    }

    /// Returns whether bytes have begun to arrive, but too recently to compute a rate.
    fn is_settling(&self, now: Nanos, read: u64) -> bool {
        let is_begun = |(since, before)| read > before + MAX_NOISE_BYTES && now < since + MIN_RATE_TIME;
        !self.is_complete && self.window.is_some_and(is_begun)
    }

    fn window_rate(&self, now: Nanos, read: u64) -> Option<u64> {
        let (since, before) = self.window?;
        let bytes = read.saturating_sub(before);
        (bytes > MAX_NOISE_BYTES && now >= since + MIN_RATE_TIME)
            .then(|| (bytes * 1_000 * MILLIS).div_ceil(now - since))
    }
}

/// Returns the name of the scanner of `session`: the name of its model, or of its family if the model is unknown.
fn scanner_name(session: &PortSession) -> String {
    let family = session.family().map_or("", |family| family.name());
    session.model().map_or_else(|| format!("{family} scanner"), |model| model.name.to_owned())
}

/// Converts the state of `session` into the state of its link.
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

/// Rounds to three significant digits.
fn rounded(rate: u64) -> u64 {
    let unit = 10_u64.pow(rate.checked_ilog10().unwrap_or(0).saturating_sub(2));
    (rate + unit / 2) / unit * unit
}

/// Writes `number` with a comma after every three digits.
fn with_commas(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Minimum share of damaged bytes, in percent, at which the status reports a damaged line. The undamaged bytes then
/// prove nothing about the scanner.
const UNRELIABLE_PERCENT: u32 = 50;
/// Minimum change of the share of damaged bytes, in percent, that changes the reported share.
const PERCENT_STEP: u32 = 10;
/// Minimum silence of a scanner after which damage is not concluded from bytes alone.
const MIN_SILENCE: Nanos = 1_000 * MILLIS;
/// Minimum silence of a scanner after which other bytes are reported as bytes of another scanner.
const MIN_EXCHANGE_SILENCE: Nanos = 2_000 * MILLIS;
/// Minimum number of bytes per second of a stream: an LMS at 9,600 baud sends twice that. A boot message is shorter.
const MIN_STREAM_RATE: u64 = 500;
/// Minimum number of telegrams in 10 s that prove that the scanner is received. Fewer telegrams may be chance matches
/// in the bytes of another scanner.
const MIN_TELEGRAMS: u64 = 3;
/// Time for which a status reports that another process changed the port's settings.
const SETTINGS_CHANGE_TIME: Nanos = 10_000 * MILLIS;
/// Number of consecutive statuses after which subscribers without samples are reported. Earlier, they may still be
/// attaching.
const MAX_STARVED_STATUSES: u32 = 3;
/// Time over which the rate of the bytes is measured. It is longer than a search at all baud rates, so that the baud
/// rate of the host's port does not change the result.
const RATE_WINDOW: Nanos = 5_000 * MILLIS;
/// Time from the first byte to the first rate. A scanner that returns is found within this time. A rate over a shorter
/// time would change quickly, and each change is a log line.
const MIN_RATE_TIME: Nanos = 2_000 * MILLIS;
/// Number of consecutive windows without bytes after which no rate is reported any more.
const MAX_QUIET_WINDOWS: u32 = 3;
/// Number of bytes that an adapter may deliver when a cable is plugged in.
const MAX_NOISE_BYTES: u64 = 64;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the rates that are shown for a line with `rate` bytes per second, sampled ten times a second for
    /// `seconds`.
    fn shown(
        bytes: &mut ByteRate,
        (from, seconds): (u64, u64),
        rate: impl Fn(u64) -> u64,
    ) -> Vec<Option<u64>> {
        let mut read = 0;
        let rates = (from * 10..(from + seconds) * 10).map(|tenth| {
            let now = tenth * 100 * MILLIS;
            read += rate(tenth) / 10;
            bytes.note(now, read);
            bytes.reported_rate(now, read)
        });
        let mut all: Vec<_> = rates.collect();
        all.dedup();
        all
    }

    #[test]
    fn shows_byte_rate_within_first_window_and_keeps_it() {
        let mut bytes = ByteRate::default();
        let steady = shown(&mut bytes, (0, 60), |tenth| if tenth % 2 == 0 { 12_000 } else { 12_840 });
        assert_eq!(steady.first(), Some(&None), "nothing was measured yet");
        assert_eq!(steady.len(), 2, "{steady:?}");
        assert!(steady[1].is_some_and(|rate| (12_000..=12_900).contains(&rate)), "{steady:?}");
    }

    #[test]
    fn detects_start_and_end_of_bytes_in_a_few_windows() {
        let mut bytes = ByteRate::default();
        assert_eq!(shown(&mut bytes, (0, 3_600), |_| 0), [None]);
        assert_eq!(shown(&mut bytes, (3_600, 10), |_| 17_625).last(), Some(&Some(17_600)));
        assert_eq!(shown(&mut bytes, (3_610, 20), |_| 0).last(), Some(&None));
        assert_eq!(shown(&mut bytes, (3_630, 10), |_| 10).last(), Some(&None), "noise of a cable");
    }

    #[test]
    fn noise_near_the_limit_does_not_change_the_message() {
        let mut bytes = ByteRate::default();
        let noise = |tenth| if tenth / 50 % 2 == 0 { 20 } else { 10 };
        let texts = shown(&mut bytes, (0, 600), noise);
        assert!(texts.len() <= 3, "{texts:?}");
    }

    #[test]
    fn rates_are_written_with_commas() {
        let numbers = [0, 999, 1_000, 12_400, 1_234_567].map(with_commas);
        assert_eq!(numbers, ["0", "999", "1,000", "12,400", "1,234,567"]);
        assert_eq!([7, 960, 1_234, 17_625].map(rounded), [7, 960, 1_230, 17_600]);
    }
}
