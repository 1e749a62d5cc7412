//! Connection of a link to its port. The link streams while the port exists, polls for it while it is missing, and
//! opens it again under the same name, even if the name then belongs to another device. While another process publishes
//! under the sensor's name, the link does not open the port and waits for the name. Each reason is logged once.

use std::io;

use scanhub_drivers::PortSession;
use scanhub_drivers::line::{Control, Identity, Protocol as _, ScannerSession as _};
use scanhub_port::{PortError, PortSpec};
use scanhub_schema::{Failure, Flags, Kind, MILLIS, Nanos, State};

use crate::control::{ControlQueue, PauseTarget};
use crate::link::LinkState;
use crate::platform::{Platform, PortIo, Wait, WaitSource, WakeReason};
use crate::session_driver::{OpenLine, SessionDriver};

/// A link to a port that may disappear and come back. It is a state machine: [`on_wakeup`](Self::on_wakeup) takes the
/// reason why a wait ended and returns what to wait for next.
pub struct LiveLink<'a, S: Platform> {
    core: LinkState<'a, S>,
    driver: SessionDriver<'a, S>,
    phase: Phase<S::Port>,
    /// Consecutive connections that closed without delivering a byte.
    empty_connections: u32,
    has_begun: bool,
    /// Whether another process has had the sensor's name since the link was created.
    lacks_name: bool,
}

/// A port that was just opened.
struct OpenedPort<L> {
    line: L,
    /// Whether the port has the baud rate with which the session starts.
    has_rate: bool,
    /// Whether a service manager kept the line of a killed hub open, with the bytes that it has received.
    is_kept: bool,
}

/// State of the port.
enum Phase<L> {
    Open(Box<OpenLine<L>>),
    /// The port is not open. The link tries to open it at `retry_at`, and the next wait ends at `until`.
    Unavailable {
        reason: PortUnavailable,
        retry_at: Nanos,
        until: Nanos,
    },
    /// A connection is being made. The next wait ends at `until`.
    Opening {
        reason: PortUnavailable,
        until: Nanos,
    },
}

impl<'a, S: Platform> LiveLink<'a, S> {
    /// Takes the name of `link`, number `number` in the configuration, and creates its topics for the run `boot` of the
    /// hub. Publishes the first status, and tries to open the port. The caller then calls
    /// [`on_wakeup`](Self::on_wakeup) with a timeout.
    ///
    /// # Errors
    ///
    /// Returns an error of kind [`PortNotTty`](scanhub_schema::Kind::PortNotTty) if the port is not a serial line at
    /// all, an error of kind [`ResourceExhausted`](scanhub_schema::Kind::ResourceExhausted) if descriptors or memory
    /// run out, and the errors of [`Platform::transport`]. It is not an error if the port is missing, in use or
    /// forbidden, or rejects the baud rate, or if another process has the name: the link then waits.
    pub fn new(
        link: &'a scanhub_config::Link,
        number: u8,
        boot: u64,
        platform: &'a S,
        control: ControlQueue,
    ) -> Result<Self, Failure> {
        // Take the name before creating the topics, because a subscriber that finds a topic sleeps at its doorbell,
        // which must exist by then.
        let name_failure = match platform.take_name() {
            Ok(()) => None,
            Err(failure) if failure.kind == Kind::NameHeld => Some(failure),
            Err(failure) => return Err(failure),
        };
        let mut core = LinkState::new(link, number, boot, platform, control)?;
        core.begin();
        let driver = SessionDriver::new(&core);
        let saved_identity = driver.saved_identity(platform.now());
        let phase = Phase::unavailable(PortUnavailable::default(), 0);
        let lacks_name = name_failure.is_some();
        let mut live = LiveLink { core, driver, phase, empty_connections: 0, has_begun: false, lacks_name };
        if let Some(failure) = name_failure {
            live.schedule_retry(PortUnavailable::without_name(failure));
            return Ok(live);
        }
        match live.open_first() {
            Ok(Some(port)) => {
                // If the line was closed since the previous hub, another scanner may be connected, or the same scanner
                // may be in another mode.
                let identity = saved_identity.filter(|_| port.is_kept);
                live.start_session(port, identity);
                Ok(live)
            }
            Ok(None) => {
                let message = format!("{}: not connected yet", link.port.name());
                live.schedule_retry(PortUnavailable { message, ..PortUnavailable::default() });
                Ok(live)
            }
            // Other programs that open ports play no recordings, so the hint of [`PortError`] does not mention
            // recordings.
            Err(error @ PortError::NotTty) => {
                let failure = platform.explain(&error, &link.port);
                let hint = format!("{}, or file:PATH for a recording", failure.hint);
                Err(Failure { hint, ..failure })
            }
            Err(error @ PortError::ResourceExhausted(_)) => Err(platform.explain(&error, &link.port)),
            Err(error) => {
                let mut reason = PortUnavailable::default();
                reason.update(&error, platform.now(), |error| one_line(platform.explain(error, &link.port)));
                live.schedule_retry(reason);
                Ok(live)
            }
        }
    }

    /// Returns whether the link waits for its port: it could not be opened, or the connection is not made yet.
    pub fn is_waiting(&self) -> bool {
        !matches!(self.phase, Phase::Open(_))
    }

    /// Returns whether the link waits for its name, because another process publishes under it.
    pub fn lacks_name(&self) -> bool {
        self.lacks_name
    }

    /// Returns whether the link has tried to open its port, with any result, or must not open it because it lacks its
    /// name.
    pub fn has_tried(&self) -> bool {
        match &self.phase {
            Phase::Open(_) => true,
            Phase::Unavailable { reason, .. } | Phase::Opening { reason, .. } => {
                self.lacks_name || reason.error.is_some()
            }
        }
    }

    /// Handles the end of a wait, for the reason `wake_reason`. Returns what to wait for next.
    pub fn on_wakeup(&mut self, wake_reason: WakeReason) -> Wait<'_, S::Port> {
        let (_, until) = self.phase.wait();
        if !std::mem::replace(&mut self.has_begun, true) {
            self.begin();
        } else if self.core.is_over(wake_reason, until) {
            match &mut self.phase {
                Phase::Open(open) => {
                    if let Err(error) = self.driver.on_wakeup(&mut self.core, open, wake_reason) {
                        self.on_line_lost(&error);
                    }
                }
                Phase::Unavailable { retry_at, .. } => {
                    let retry_at = *retry_at;
                    self.keep_waiting(wake_reason);
                    if self.core.platform.now() >= retry_at {
                        self.try_open();
                    }
                }
                Phase::Opening { .. } if wake_reason == WakeReason::Ready => self.try_open(),
                Phase::Opening { .. } => self.keep_waiting(wake_reason),
            }
        }
        let (on, until) = self.phase.wait();
        let until = self.core.next_deadline(until, matches!(on, WaitSource::Loss(_)));
        Wait { requests: &self.core.control, source: on, until }
    }

    /// Ends the session and saves the state of the link, because the hub ends.
    pub fn end(mut self) {
        if let Phase::Open(open) = &mut self.phase {
            // A line that is lost at this moment needs no last requests.
            let _ = self.driver.end(&self.core, open);
            self.core.close(&open.session);
        }
        self.core.end();
    }

    /// Opens the port at the start of the hub. Returns `None` if that needs a connection.
    fn open_first(&mut self) -> Result<Option<OpenedPort<S::Port>>, PortError> {
        let (source, baud) = (&self.core.link.port, self.driver.opening_rate(&self.core));
        if let PortSpec::Tcp { .. } = source {
            return Ok(None);
        }
        match self.take_kept(baud) {
            Some(port) => Ok(Some(port)),
            None => self.open(baud).transpose(),
        }
    }

    /// Returns the port that the service manager kept open while the previous hub was killed.
    fn take_kept(&self, baud: u32) -> Option<OpenedPort<S::Port>> {
        let LinkState { link, platform, .. } = self.core;
        let (name, source) = (&link.name, &link.port);
        let line = platform.take_kept_port(name, source, baud)?;
        tracing::info!("{name}: continues with {}, which the service manager kept open", source.name());
        Some(OpenedPort { line, has_rate: true, is_kept: true })
    }

    /// Opens the port at `baud`. If the port rejects `baud` during a search, it is opened at another rate, because the
    /// search skips rejected rates. Returns `None` while a connection is being made.
    fn open(&mut self, baud: u32) -> Option<Result<OpenedPort<S::Port>, PortError>> {
        let LinkState { link, platform, .. } = self.core;
        let (opened, has_rate) = match platform.open(&link.port, baud) {
            Some(Err(error @ PortError::Rate { .. })) if link.family().is_none() => {
                self.driver.log_rejected_rate(&self.core, baud, &error);
                (platform.open(&link.port, SUPPORTED_RATE), false)
            }
            opened => (opened, true),
        };
        opened.map(|opened| opened.map(|line| OpenedPort { line, has_rate, is_kept: false }))
    }

    /// Tries to take the name and to open the port. The result is known at once, or when the connection is made.
    fn try_open(&mut self) {
        let (link, platform) = (self.core.link, self.core.platform);
        let mut reason = self.phase.take_reason();
        if self.lacks_name
            && let Err(failure) = platform.take_name()
        {
            return self.schedule_retry(PortUnavailable::without_name(failure));
        }
        let baud = self.driver.opening_rate(&self.core);
        // While the link had no name, it has not taken the line that was kept for it.
        let kept = if std::mem::take(&mut self.lacks_name) { self.take_kept(baud) } else { None };
        match kept.map(Ok).or_else(|| self.open(baud)) {
            Some(Ok(port)) => {
                self.start_session(port, None);
                self.begin();
            }
            Some(Err(error)) => {
                reason.update(&error, platform.now(), |error| one_line(platform.explain(error, &link.port)));
                self.schedule_retry(reason);
            }
            None => self.phase = Phase::Opening { reason, until: platform.now() + OPENING_STATUS_PERIOD },
        }
    }

    /// Creates a session on a port that was just opened. If the `identity` of the scanner is given, the session accepts
    /// the scanner's running stream at once.
    fn start_session(
        &mut self,
        OpenedPort { line, has_rate, .. }: OpenedPort<S::Port>,
        identity: Option<Identity>,
    ) {
        let core = &mut self.core;
        let now = core.platform.now();
        core.platform.keep_open(&core.link.name, &line);
        core.diagnosis.on_port_opened(line.device());
        core.output.topics.set_flags(if line.is_simulated() { Flags::SIMULATED } else { 0 });
        let (family, memory) = (core.link.family(), self.driver.memory(core));
        let mut session = PortSession::begin(family, &core.link.settings(), memory, now);
        core.output.topics.set_family(family);
        if !has_rate {
            session.reject_rate(now);
        }
        if let Some(identity) = identity {
            session.restore_identity(identity);
        }
        if let Some((model, beams)) = self.driver.take_saved_beams() {
            session.restore_beams(model, beams);
        }
        if let Some(rate) = self.driver.known_rate(core) {
            tracing::debug!(
                "{}: the search begins at {} baud, where the scanner was found",
                core.link.name,
                rate.baud
            );
            session.hint_rate(rate);
        }
        if core.control.is_paused() {
            session.control(Control::Pause, now);
        }
        self.phase = Phase::Open(Box::new(OpenLine::new(line, session, core.link.max_rate(), now)));
    }

    /// Starts the session, if the port is open.
    fn begin(&mut self) {
        if let Phase::Open(open) = &mut self.phase
            && let Err(error) = self.driver.begin(&mut self.core, open)
        {
            self.on_line_lost(&error);
        }
    }

    /// Handles the loss of the line because of `error`.
    fn on_line_lost(&mut self, error: &io::Error) {
        let source = &self.core.link.port;
        let Phase::Open(open) =
            std::mem::replace(&mut self.phase, Phase::unavailable(PortUnavailable::default(), 0))
        else {
            return;
        };
        self.core.close(&open.session);
        let has_received = open.session.stats().read > 0;
        // Close the port now, because it cannot be opened again while it is open.
        drop(open);
        self.core.platform.release(&self.core.link.name);
        self.core.stats.reconnects += 1;
        self.empty_connections = if has_received { 0 } else { self.empty_connections + 1 };
        let message = format!("{} became unavailable: {error}", source.name());
        self.core.diagnosis.note_empty_connection(if has_received { String::new() } else { message.clone() });
        let failures = self.empty_connections;
        self.schedule_retry(PortUnavailable { failures, ..PortUnavailable::missing(message) });
    }

    /// Publishes that the port is unavailable, and schedules the next attempt to open it.
    fn schedule_retry(&mut self, reason: PortUnavailable) {
        self.core.diagnosis.end_session();
        self.core.publish_status(None, State::Absent, &reason.message);
        let retry_at = self.core.platform.now() + reason.retry_interval();
        let until = retry_at.min(self.core.next_status());
        self.phase = Phase::Unavailable { reason, retry_at, until };
    }

    /// Handles the end of a wait without a port, and sets the next deadline.
    fn keep_waiting(&mut self, wake_reason: WakeReason) {
        let core = &mut self.core;
        let (Phase::Unavailable { reason, .. } | Phase::Opening { reason, .. }) = &self.phase else { return };
        if wake_reason == WakeReason::Request {
            core.handle_requests(PauseTarget::NoPort);
        } else {
            core.publish_status(None, State::Absent, &reason.message);
        }
        match &mut self.phase {
            Phase::Open(_) => {}
            Phase::Unavailable { retry_at, until, .. } => *until = (*retry_at).min(core.next_status()),
            Phase::Opening { until, .. } => *until = core.platform.now() + OPENING_STATUS_PERIOD,
        }
    }
}

impl<L: PortIo> Phase<L> {
    fn unavailable(reason: PortUnavailable, retry_at: Nanos) -> Phase<L> {
        Phase::Unavailable { reason, retry_at, until: retry_at }
    }

    /// Returns what to wait for, and until when.
    fn wait(&self) -> (WaitSource<'_, L>, Nanos) {
        match self {
            Phase::Open(open) => open.wait(),
            Phase::Unavailable { until, .. } => (WaitSource::Nothing, *until),
            Phase::Opening { until, .. } => (WaitSource::Opening, *until),
        }
    }

    /// Takes the reason why the port was unavailable until now.
    fn take_reason(&mut self) -> PortUnavailable {
        match self {
            Phase::Open(_) => PortUnavailable::default(),
            Phase::Unavailable { reason, .. } | Phase::Opening { reason, .. } => std::mem::take(reason),
        }
    }
}

/// Reason why a port is unavailable.
#[derive(Default)]
struct PortUnavailable {
    error: Option<PortError>,
    message: String,
    /// Time at which the message was made.
    since: Nanos,
    /// Number of consecutive attempts at which the port existed, but could not be opened or closed without delivering a
    /// byte.
    failures: u32,
}

impl PortUnavailable {
    /// Creates the reason that the port is missing. The `message` stays while the port is missing.
    fn missing(message: String) -> PortUnavailable {
        PortUnavailable { error: Some(PortError::Missing), message, ..PortUnavailable::default() }
    }

    /// Creates the reason that the link must not open its port, because another process has its name.
    fn without_name(failure: Failure) -> PortUnavailable {
        PortUnavailable { message: one_line(failure), ..PortUnavailable::default() }
    }

    /// Notes that the port cannot be opened because of `error`. `explain` makes the message.
    fn update(&mut self, error: &PortError, now: Nanos, explain: impl FnOnce(&PortError) -> String) {
        let is_missing = *error == PortError::Missing;
        self.failures = if is_missing { 0 } else { self.failures + 1 };
        let has_changed = self.error.as_ref() != Some(error);
        // Another process than the one that the message names may hold the port by now.
        if has_changed || (!is_missing && now >= self.since + STALE_AFTER) {
            self.message = explain(error);
            self.since = now;
        }
        self.error = Some(error.clone());
    }

    /// Returns the time until the next attempt. For a missing port, the interval stays short, because an attempt only
    /// searches for the port's name. For a port that exists but cannot be opened, the interval grows. The first
    /// attempts follow quickly, because udev sets the group of a new device a moment after it appears.
    fn retry_interval(&self) -> Nanos {
        POLL_INTERVAL << self.failures.saturating_sub(1).min(MAX_DOUBLINGS)
    }
}

/// Returns `failure` as one line, for a status and a log.
fn one_line(failure: Failure) -> String {
    format!("{}; {}", failure.message, failure.hint)
}

/// Baud rate at which a port is opened that rejects the rate of a search. Every port supports it.
const SUPPORTED_RATE: u32 = 9_600;
/// Interval between attempts to open an unavailable port.
const POLL_INTERVAL: Nanos = 100 * MILLIS;
/// Maximum number of times that [`POLL_INTERVAL`] doubles, so the longest interval is 1.6 s.
const MAX_DOUBLINGS: u32 = 4;
/// Interval of the statuses while a connection is being made.
const OPENING_STATUS_PERIOD: Nanos = 1_000 * MILLIS;
/// Age after which a message about a port that cannot be opened is made again.
const STALE_AFTER: Nanos = 10_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn message_is_updated_only_if_the_error_changes() {
        let source = PortSpec::Tty("/dev/no-such-port".into());
        let explain = |error: &PortError| one_line(error.explain(&source));
        let mut reason = PortUnavailable::missing("it went".to_owned());
        reason.update(&PortError::Missing, 1, explain);
        assert_eq!((reason.message.as_str(), reason.retry_interval()), ("it went", POLL_INTERVAL));
        reason.update(&PortError::Busy, 2, explain);
        assert!(reason.message.contains("in use by another process; stop it first"), "{}", reason.message);
        assert_eq!((reason.since, reason.retry_interval()), (2, POLL_INTERVAL));
        for attempt in 3..20 {
            reason.update(&PortError::Busy, attempt, explain);
        }
        assert_eq!((reason.since, reason.retry_interval()), (2, 16 * POLL_INTERVAL));
        reason.update(&PortError::Busy, 2 + STALE_AFTER, explain);
        assert_eq!(reason.since, 2 + STALE_AFTER);
        reason.update(&PortError::Missing, 3 + STALE_AFTER, explain);
        assert!(reason.message.contains("no such port"), "{}", reason.message);
        assert_eq!(reason.retry_interval(), POLL_INTERVAL);
    }
}
