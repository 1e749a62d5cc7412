//! Driver of protocol state machines on an open port, for a user at a terminal: [`run_protocol`] runs any state machine
//! until it is done. [`search`] uses it to find the scanner, and [`detect`] to identify a rotating scanner. In the hub,
//! the thread of a link does the same, but without an end.

use std::fmt;
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, poll};
use scanhub_drivers::line::{
    Action, DeviceInfo, Event, HealthStatus, Protocol, ScannerSession as _, SessionStats, Values,
};
use scanhub_drivers::search::{Coverage, FoundScanner, PortKind, Search};
use scanhub_drivers::{Model, Session, Settings, features};
use scanhub_port::{Port, clock};
use scanhub_schema::{Failure, Family, Kind, MILLIS, Nanos};

/// A rotating scanner that was detected, and what was received from it.
#[derive(Clone, Debug)]
pub(crate) struct DetectedScanner {
    pub(crate) family: Family,
    /// Model that matches the received packets. Other models may match them, too.
    pub(crate) model: Option<Model>,
    /// Name of the model, or a number such as `0x95` if scanhub does not know the model.
    pub(crate) model_text: Option<String>,
    /// Rate of the line, in bits per second.
    pub(crate) rate: u32,
    pub(crate) stats: SessionStats,
    /// The scanner's reply to a request for its identity and health; `None` if it streams without a request.
    pub(crate) introduction: Option<DeviceInfo>,
    /// Number of packets with measured data.
    pub(crate) packets: u64,
    /// Points per second; 0 before the first complete revolution.
    pub(crate) points_per_second: f64,
    /// Revolutions per second; 0 before the first complete one.
    pub(crate) revolutions_per_second: f64,
    /// Problem of the scanner, as text.
    pub(crate) problem: Option<String>,
}

impl DetectedScanner {
    /// Returns the number of points per revolution.
    pub(crate) fn points(&self) -> f64 {
        if self.revolutions_per_second > 0.0 {
            self.points_per_second / self.revolutions_per_second
        } else {
            0.0
        }
    }

    /// Returns the share of bytes that belong to no packet, 0 to 1. A fragment at the start of the stream does not
    /// count.
    pub(crate) fn damaged(&self) -> f64 {
        self.stats.damaged as f64 / (self.stats.in_telegrams + self.stats.damaged).max(1) as f64
    }

    /// Returns whether the line damages most bytes, which makes every conclusion from the undamaged bytes unreliable.
    pub(crate) fn is_unreliable(&self) -> bool {
        self.damaged() > UNRELIABLE_DAMAGE
    }

    /// Returns the share of damaged bytes and the remedy, as text, if the line damages more than one byte in a hundred.
    pub(crate) fn line_problem(&self) -> Option<String> {
        let damaged = self.damaged();
        (damaged > MAX_DAMAGED)
            .then(|| format!("{:.0} % of the bytes are damaged on the line: {LINE_REMEDY}", 100.0 * damaged))
    }
}

impl fmt::Display for DetectedScanner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = self.model.map_or("a scanner".to_owned(), |model| model.name.to_uppercase());
        write!(f, "{name} at {} Bd", self.rate)
    }
}

/// Result of a search that has found no scanner.
#[derive(Clone, Debug)]
pub(crate) struct NotFound {
    /// Number of bytes received.
    pub(crate) bytes: u64,
    /// Families and rates that the search has tried.
    pub(crate) coverage: Vec<Coverage>,
}

/// Searches `port` for a scanner of any family, or of `only` one, as the hub does. Calls `on_rate` with each rate.
///
/// # Errors
///
/// Returns [`Kind::PortMissing`] if the port disappears, and [`Kind::Interrupted`] if `stop` is set.
pub(crate) fn search(
    port: &Port,
    only: Option<Family>,
    stop: &AtomicBool,
    mut on_rate: impl FnMut(u32),
) -> Result<Result<FoundScanner, NotFound>, Failure> {
    let kind = if port.baud().is_none() { PortKind::Server } else { PortKind::Serial };
    let start = clock::now();
    let mut search = Search::new(kind, None, start).with_rate_change();
    if let Some(family) = only {
        search = search.restricted_to(family);
    }
    let mut shown_rate = None;
    let mut procedure = Procedure::new(|search: &Search| {
        if shown_rate != search.rate() {
            shown_rate = search.rate();
            shown_rate.into_iter().for_each(&mut on_rate);
        }
        let rounds = if search.stats().read == 0 { MAX_SILENT_ROUNDS } else { MAX_ROUNDS };
        search.rounds() < rounds || clock::now() < start + MIN_SEARCH_TIME
    });
    run_protocol(port, &mut search, &mut procedure, stop)?;
    let not_found = || NotFound { bytes: search.stats().read, coverage: search.coverage() };
    Ok(search.found().ok_or_else(not_found))
}

/// Identifies the rotating scanner that a search has found at `port`. Returns the scanner if more packets arrived than
/// could match by chance; otherwise the number of bytes received.
///
/// Sends nothing to a scanner that streams without a request. From other scanners it requests identity and health, lets
/// them measure for a second, and stops them as a hub does.
///
/// # Errors
///
/// Returns [`Kind::PortMissing`] if the port disappears, and [`Kind::Interrupted`] if `stop` is set.
pub(crate) fn detect(
    port: &Port,
    found: FoundScanner,
    stop: &AtomicBool,
) -> Result<Result<DetectedScanner, u64>, Failure> {
    let listen_only = features(found.family).streams_unrequested;
    let settings = Settings { fixed_rate: found.rate.is_none(), listen_only, ..Settings::default() };
    let start = clock::now();
    let mut session = Session::begin(found.family, &settings, start);
    if let Some(rate) = found.rate {
        session.set_start_rate(rate, start);
    }
    let mut detection = Detection {
        start,
        packets: 0,
        measures_since: None,
        revolutions: 0,
        period: 0,
        points_per_second: 0.0,
        introduction: None,
        introduced_at: 0,
        dtr: None,
    };
    let driven = run_protocol(port, &mut session, &mut detection, stop);
    let mut problem = session.problem().map(|problem| problem.to_string());
    let Detection { packets, period, points_per_second, introduction, .. } = detection;
    let is_error = |introduction: &DeviceInfo| introduction.condition == HealthStatus::Error;
    if packets == 0 && introduction.as_ref().is_some_and(|introduction| !is_error(introduction)) {
        problem.get_or_insert_with(|| "it replies, but does not start to measure".to_owned());
    }
    let (stats, model) = (session.stats(), session.model());
    let model_text = session.model_text().map(|text| text.to_lowercase());
    // Stops a scanner that measures on request, and its motor, as a hub does when it exits.
    let measures = introduction.as_ref().is_some_and(|introduction| !is_error(introduction));
    let ended = match &driven {
        Err(failure) if failure.kind != Kind::Interrupted => Ok(0),
        _ if measures && session.end(clock::now()) => drain(port, &mut session, &mut EndTask),
        _ => Ok(0),
    };
    driven?;
    ended.map_err(|error| port_lost(port, &error))?;
    if packets < MIN_PACKETS && introduction.is_none() {
        return Ok(Err(stats.read));
    }
    Ok(Ok(DetectedScanner {
        family: found.family,
        model,
        model_text,
        rate: session.rate(),
        stats,
        introduction,
        packets,
        points_per_second: f64::from(points_per_second),
        revolutions_per_second: if period > 0 { 1e9 / period as f64 } else { 0.0 },
        problem,
    }))
}

/// Returns the failure for a port called `name` at which a search has found a scanner, but which then sent only `bytes`
/// bytes and too few packets.
pub(crate) fn not_detected(name: &str, found: FoundScanner, bytes: u64) -> Failure {
    let FoundScanner { family, rate, .. } = found;
    let rate = rate.map_or(String::new(), |rate| format!(" at {rate} Bd"));
    let what = format!(
        "{name}: a scanner of family {}{rate} was found, but then {bytes} bytes without its packets arrived",
        family.name()
    );
    Failure::new(Kind::Timeout, what, "check its power and the cable, and try again")
}

/// Detection of a rotating scanner: decides when enough was received.
struct Detection {
    start: Nanos,
    packets: u64,
    /// Time of the first packet.
    measures_since: Option<Nanos>,
    revolutions: u32,
    /// Period of the last revolution.
    period: Nanos,
    points_per_second: f32,
    introduction: Option<DeviceInfo>,
    introduced_at: Nanos,
    /// State of the line DTR that the session requested last.
    dtr: Option<bool>,
}

impl Task<Session> for Detection {
    /// Takes over the scanner's identity and health once the session has received them. From then on, the session may
    /// control the scanner's motor. Returns false if the scanner reports an error, because the session would restart
    /// the scanner next.
    fn may_continue(&mut self, port: &Port, session: &Session) -> io::Result<bool> {
        if self.introduction.is_some() {
            return Ok(true);
        }
        self.introduction = session.device_info();
        self.introduced_at = clock::now();
        match (&self.introduction, self.dtr) {
            (Some(info), _) if info.condition == HealthStatus::Error => Ok(false),
            (Some(_), Some(on)) => port.set_dtr(on).map(|()| true),
            _ => Ok(true),
        }
    }

    /// Sets the line DTR, which controls the motor, but leaves the motor as it is before the scanner has replied.
    fn set_dtr(&mut self, port: &Port, on: bool) -> io::Result<()> {
        self.dtr = Some(on);
        if self.introduction.is_some() { port.set_dtr(on) } else { Ok(()) }
    }

    fn on_event(&mut self, event: Event<'_>) {
        match event {
            Event::Telegram(received) if !received.is_reply => {
                self.measures_since.get_or_insert_with(clock::now);
                self.packets += received.count as u64;
            }
            Event::Telegram(_) => {}
            Event::Scan(scan) => {
                self.revolutions += 1;
                self.period = scan.period;
                if let Values::Points { per_second, .. } = scan.values {
                    self.points_per_second = per_second;
                }
            }
        }
    }

    fn deadline(&mut self, _: &Session, now: Nanos) -> Option<Nanos> {
        let is_detected = self.packets >= MIN_PACKETS;
        let limit = match (&self.introduction, self.measures_since) {
            (Some(info), _) if info.condition == HealthStatus::Error => now,
            (Some(_), Some(since)) => since + MEASURING_TIME,
            (Some(_), None) => self.introduced_at + SPIN_UP_TIMEOUT,
            (None, Some(since)) if is_detected && self.revolutions >= MIN_REVOLUTIONS => {
                since + MEASURING_TIME
            }
            (None, _) if is_detected => self.start + REVOLUTIONS_TIMEOUT,
            (None, _) => self.start + FIRST_TIMEOUT,
        };
        (now < limit).then_some(limit)
    }
}

/// Task at the end of a session. It ignores all events.
struct EndTask;

impl Task<Session> for EndTask {}

/// Task for a protocol that ends by itself, such as requests to an LMS. Calls `progress` before each wait, and ends
/// early if `progress` returns false. If the port rejects a rate, logs the rate once, and the protocol continues
/// without it.
pub(crate) struct Procedure<F> {
    progress: F,
    refused: Vec<u32>,
}

impl<F> Procedure<F> {
    pub(crate) fn new(progress: F) -> Procedure<F> {
        Procedure { progress, refused: Vec::new() }
    }
}

impl<P, F: FnMut(&P) -> bool> Task<P> for Procedure<F> {
    fn deadline(&mut self, protocol: &P, _: Nanos) -> Option<Nanos> {
        (self.progress)(protocol).then_some(Nanos::MAX)
    }

    fn on_refused(&mut self, port: &Port, rate: u32, error: &io::Error) {
        if self.refused.contains(&rate) {
            return;
        }
        self.refused.push(rate);
        match port {
            Port::Tty(tty) => tracing::warn!("{}: {error}", tty.device().display()),
            Port::Tcp(_) => tracing::warn!("{error}"),
        }
    }
}

/// Remedy for a line that damages bytes.
pub(crate) const LINE_REMEDY: &str =
    "a shorter or shielded cable, ground next to the signal, 3.3 V levels; another adapter";
/// Maximum share of damaged bytes on a good line.
const MAX_DAMAGED: f64 = 0.01;
/// Share of damaged bytes above which conclusions from the undamaged bytes are unreliable.
pub(crate) const UNRELIABLE_DAMAGE: f64 = 0.5;

/// Maximum number of rounds of a search on a silent line.
const MAX_SILENT_ROUNDS: usize = 2;
/// Maximum number of rounds of a search if bytes have arrived. A scanner may miss a request, and the line may damage
/// the reply.
const MAX_ROUNDS: usize = 4;
/// Minimum time of a search. It matters if the family is known, because the rounds are then short.
const MIN_SEARCH_TIME: Nanos = 1_000 * MILLIS;
/// Minimum number of packets that identify a scanner. Other bytes match a checksum of 8 bits now and then, but not that
/// often.
const MIN_PACKETS: u64 = 20;
/// Minimum number of complete revolutions for a measurement of the head's speed.
const MIN_REVOLUTIONS: u32 = 5;
/// Timeout for the first packets or the first reply of a scanner that was found. It allows for repeated requests,
/// because replies may be damaged.
const FIRST_TIMEOUT: Nanos = 2_000 * MILLIS;
/// Minimum time for which measured data are received.
const MEASURING_TIME: Nanos = 1_000 * MILLIS;
/// Timeout for the first packet of a scanner whose motor has to spin up. It allows for many damaged replies.
const SPIN_UP_TIMEOUT: Nanos = 7_000 * MILLIS;
/// Timeout for [`MIN_REVOLUTIONS`]. It is long enough for a head that makes two revolutions per second.
const REVOLUTIONS_TIMEOUT: Nanos = 4_000 * MILLIS;

/// Callbacks of a program to which [`run_protocol`] passes the events and requests of a protocol.
pub(crate) trait Task<P> {
    /// Called before each action. Returns whether to carry it out; if not, the driver waits.
    fn may_continue(&mut self, port: &Port, protocol: &P) -> io::Result<bool> {
        let _ = (port, protocol);
        Ok(true)
    }

    /// Sets the line DTR, as the protocol requests.
    fn set_dtr(&mut self, port: &Port, on: bool) -> io::Result<()> {
        port.set_dtr(on)
    }

    /// Handles an event.
    fn on_event(&mut self, event: Event<'_>) {
        let _ = event;
    }

    /// Handles that the port rejects `rate`.
    fn on_refused(&mut self, port: &Port, rate: u32, error: &io::Error) {
        let _ = (port, rate, error);
    }

    /// Called before each wait. Returns the time at which the wait ends at the latest, or `None` to end the protocol.
    fn deadline(&mut self, protocol: &P, now: Nanos) -> Option<Nanos> {
        let _ = (protocol, now);
        None
    }
}

/// Runs `protocol` on `port` until it is done, or until `task` ends it.
///
/// # Errors
///
/// Returns [`Kind::PortMissing`] if the port disappears, and [`Kind::Interrupted`] if `stop` is set.
pub(crate) fn run_protocol<P: Protocol>(
    port: &Port,
    protocol: &mut P,
    task: &mut impl Task<P>,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    loop {
        let until = drain(port, protocol, task).map_err(|error| port_lost(port, &error))?;
        if protocol.is_done() {
            return Ok(());
        }
        let Some(limit) = task.deadline(protocol, clock::now()) else { return Ok(()) };
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::new(Kind::Interrupted, "interrupted", ""));
        }
        let (now, until) = (clock::now(), until.min(limit));
        let mut fds = [PollFd::new(port, PollFlags::IN)];
        // A signal that interrupts the wait only ends it early.
        let _ = poll(&mut fds, Some(&clock::poll_timeout(now, until.min(now + STOP_CHECK_INTERVAL))));
        let len = port.read(protocol.read_buffer()).map_err(|error| port_lost(port, &error))?;
        let now = clock::now();
        protocol.commit(now, len);
        if len == 0 && now >= until {
            protocol.handle_timeout(now);
        }
    }
}

/// Carries out the actions of `protocol` until it waits. Returns the end of the wait.
fn drain<P: Protocol>(port: &Port, protocol: &mut P, task: &mut impl Task<P>) -> io::Result<Nanos> {
    while task.may_continue(port, protocol)? {
        match protocol.poll_action() {
            Action::SetRate(rate) => {
                if let Some(error) = port.try_baud(rate)? {
                    task.on_refused(port, rate, &error);
                    protocol.reject_rate(clock::now());
                }
            }
            Action::SetDtr(on) => task.set_dtr(port, on)?,
            Action::Transmit { not_before, .. } => {
                sleep_until(not_before);
                if !protocol.restart_if_late(clock::now())
                    && let Action::Transmit { bytes, .. } = protocol.poll_action()
                {
                    port.write(bytes)?;
                    protocol.handle_transmitted(clock::now());
                }
            }
            Action::Event(event) => task.on_event(event),
            Action::SleepUntil(until) => {
                sleep_until(until);
                return Ok(until);
            }
            Action::Wait { until } => return Ok(until),
        }
    }
    Ok(clock::now())
}

fn sleep_until(at: Nanos) {
    std::thread::sleep(Duration::from_nanos(at.saturating_sub(clock::now())));
}

/// Returns the failure for a `port` that can no longer be used. A serial server that already has a client closes the
/// connection of another one.
fn port_lost(port: &Port, error: &std::io::Error) -> Failure {
    if let Port::Tcp(_) = port {
        return Failure::new(
            Kind::PortBusy,
            format!("the connection was closed: {error}"),
            "a serial server has one client at a time: end the other program that is connected to it, such as a hub, and try \
             again; if there is none, was the server switched off?",
        );
    }
    Failure::new(
        Kind::PortMissing,
        format!("the port became unavailable: {error}"),
        "was it unplugged? plug it in and try again",
    )
}

/// Interval between checks for an interrupt, and between reports of progress.
const STOP_CHECK_INTERVAL: Nanos = 100 * MILLIS;
