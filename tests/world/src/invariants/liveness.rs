//! Invariants on recovery: soon after the last fault, each link and each remote robot works again.

use std::rc::Rc;

use scanhub_schema::{MILLIS, Nanos, State, Status, Topic, Verdict, Zones};

use super::{Invariant, ViolationReporter};
use crate::event::{Event, RevolutionFigures};
use crate::family::Family;
use crate::remote::{LinkSettings, MAX_DRAIN_TIME, RECONNECT_INTERVAL};
use crate::setup::Setup;

/// Invariant: soon after the last fault, each link reports that it streams, and publishes measured values. The link
/// publishes scans as soon as the scanner has reported the mode that defines the meaning of the bits in its values. The
/// session repeats the request for the mode from time to time. If the scanner was replaced by one of another family,
/// the search for the new scanner starts after ten seconds without data.
pub(crate) struct Liveness {
    faults_cleared_at: Option<Nanos>,
    sensors: Vec<SensorProgress>,
}

struct SensorProgress {
    family: Rc<dyn Family>,
    reports_streaming: bool,
    /// Time at which the search for a scanner of another family begins.
    search_starts_at: Nanos,
    /// Whether telegrams with measured values have been published, and whether scans have been published.
    has_arrived: [bool; 2],
    /// Time of the first telegram, and time of the first scan, without the time for which the scanner waited for its
    /// motor.
    first_at: [Option<Nanos>; 2],
    /// Time of the scanner's last reply before the first telegram, and time of the first measurement after that reply.
    answered_at: Nanos,
    measured_at: Option<Nanos>,
}

impl Liveness {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> Liveness {
        let sensor = |family: &Rc<dyn Family>| SensorProgress {
            family: family.clone(),
            reports_streaming: false,
            search_starts_at: 0,
            has_arrived: [false; 2],
            first_at: [None; 2],
            answered_at: 0,
            measured_at: None,
        };
        Liveness { faults_cleared_at: None, sensors: sensors.iter().map(sensor).collect() }
    }
}

impl Invariant for Liveness {
    fn name(&self) -> &'static str {
        "liveness"
    }

    fn figures(&self) -> RevolutionFigures {
        let last = |which: usize| self.sensors.iter().filter_map(|of| of.first_at[which]).max().unwrap_or(0);
        RevolutionFigures { data_ns: last(0), scan_ns: last(1), ..RevolutionFigures::default() }
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::FaultsCleared => {
                self.faults_cleared_at = Some(at);
                self.sensors.iter_mut().for_each(|of| of.has_arrived = [false; 2]);
            }
            Event::ScannerExchanged { sensor } if self.sensors[sensor].family.families().len() > 1 => {
                self.sensors[sensor].search_starts_at = at + SEARCH_TIMEOUT;
            }
            Event::Sent { sensor, telegram }
                if telegram.is_reply && self.sensors[sensor].first_at[0].is_none() =>
            {
                let of = &mut self.sensors[sensor];
                (of.answered_at, of.measured_at) = (at, None);
            }
            Event::Measured { sensor, points } => {
                let of = &mut self.sensors[sensor];
                of.measured_at = of.measured_at.or(points.first().map(|first| first.at_ns));
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(&sample.bytes);
                self.sensors[sensor].reports_streaming = status.state() == Some(State::Streaming);
            }
            Event::Published { sensor, sample } => {
                let of = &mut self.sensors[sensor];
                let is_data =
                    || of.family.telegrams(&sample.bytes).into_iter().any(|unit| of.family.is_data(unit));
                let which = match sample.topic {
                    Topic::Telegram if is_data() => 0,
                    Topic::Scan => 1,
                    _ => return,
                };
                if of.first_at[which].is_none() {
                    let waited = of.measured_at.unwrap_or(0).saturating_sub(of.answered_at);
                    of.first_at[which] = Some(at.saturating_sub(waited));
                }
                let is_back = of.reports_streaming && !of.has_arrived[which];
                of.has_arrived[which] |= of.reports_streaming;
                if let Some(healed) = self.faults_cleared_at.map(|healed| healed.max(of.search_starts_at))
                    && is_back
                    && at > healed + RECOVERY_LIMITS[which]
                {
                    let (topic, after) = (sample.topic, (at - healed) / MILLIS);
                    reporter.report(format!("sensor {sensor}: {topic:?} {after} ms later"));
                }
            }
            Event::WorldEnded { .. } => {
                let sensors = self.sensors.iter().enumerate();
                let is_due = |of: &SensorProgress| {
                    of.search_starts_at == 0 || at > of.search_starts_at + RECOVERY_LIMITS[1]
                };
                let is_back = |of: &SensorProgress| of.reports_streaming && of.has_arrived == [true; 2];
                for (sensor, _) in sensors.filter(|(_, of)| is_due(of) && !is_back(of)) {
                    reporter.report(format!("sensor {sensor} does not stream at the end"));
                }
            }
            _ => {}
        }
    }
}

/// Maximum time from the last fault until the link streams, and maximum time until the link publishes scans. After a
/// second of silence, the hub searches for about 2.4 s (`docs/measured.md`), because the scanner may have another rate.
/// If the scanner's last bytes were damaged just before the faults were cleared, the session first repeats its requests
/// for up to 3 s. If a scanner streams without reporting its settings, the session requests them every ten seconds.
const RECOVERY_LIMITS: [Nanos; 2] = [5_500 * MILLIS, 11_000 * MILLIS];
/// Time without data from the scanner after which the search starts again.
const SEARCH_TIMEOUT: Nanos = 10_000 * MILLIS;

/// Invariant: soon after the last fault, a remote robot has the same verdict as the hub. The next announcement names
/// the sensor, and after this announcement the gateway sends the next zones. From then on, the robot's verdict is
/// `clear`, `slow` or `stop`. There is one exception: the gateway may send zones so rarely that the first zones, which
/// have no period yet, expire before the second zones arrive (`docs/topics.md`).
pub(crate) struct RemoteLiveness {
    are_faults_cleared: bool,
    sensors: Vec<RemoteSensor>,
}

struct RemoteSensor {
    /// Maximum time from a known verdict in the hub to a known verdict in the robot.
    max_delay: Nanos,
    /// Whether the interval of zones is longer than the time for which a verdict without a period is valid.
    is_slow: bool,
    /// Time since which the hub's verdicts have been known, or `None` if its last verdict is unknown.
    known_since: Option<Nanos>,
    is_known: bool,
    /// Whether the robot has had a known verdict since the last fault.
    has_recovered: bool,
}

impl RemoteLiveness {
    pub(crate) fn new(setup: &Setup, terms: &LinkSettings) -> RemoteLiveness {
        let sensor = |of: usize| {
            let (period, _) = setup.sensors[of].scan_times();
            let every = terms.send_interval.get() * period;
            // Maximum time until both bridges have connected to a router that starts when the faults are cleared, and
            // the sender has sent its queue.
            let over_router = if terms.are_bridges { RECONNECT_INTERVAL + MAX_DRAIN_TIME } else { 0 };
            let max_delay = ANNOUNCE_INTERVAL + every + period + terms.delay_ns + over_router + TIMER_DELAY;
            RemoteSensor {
                max_delay,
                is_slow: every > MAX_FREQUENT_INTERVAL,
                known_since: None,
                is_known: false,
                has_recovered: false,
            }
        };
        RemoteLiveness { are_faults_cleared: false, sensors: (0..setup.sensors.len()).map(sensor).collect() }
    }
}

impl Invariant for RemoteLiveness {
    fn name(&self) -> &'static str {
        "remote_liveness"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::FaultsCleared => {
                self.are_faults_cleared = true;
                self.sensors
                    .iter_mut()
                    .for_each(|of| (of.known_since, of.has_recovered) = (None, of.is_known));
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Zones => {
                let zones: Zones = bytemuck::pod_read_unaligned(&sample.bytes);
                let of = &mut self.sensors[sensor];
                match zones.verdict() {
                    Verdict::Unknown => of.known_since = None,
                    _ => _ = of.known_since.get_or_insert(at),
                }
                of.check(sensor, at, self.are_faults_cleared, reporter);
            }
            Event::RemoteVerdictAccepted { sensor, verdict } => {
                let of = &mut self.sensors[sensor];
                of.check(sensor, at, self.are_faults_cleared, reporter);
                of.is_known = verdict != Verdict::Unknown;
                of.has_recovered |= of.is_known;
            }
            Event::WorldEnded { .. } => {
                for (sensor, of) in self.sensors.iter().enumerate() {
                    of.check(sensor, at, self.are_faults_cleared, reporter);
                }
            }
            Event::ListenerEnded { sensors, .. }
                if self.are_faults_cleared && sensors != self.sensors.len() =>
            {
                reporter.report(format!("{sensors} sensors are published at the end"));
            }
            _ => {}
        }
    }
}

impl RemoteSensor {
    fn check(
        &self,
        sensor: usize,
        at: Nanos,
        are_faults_cleared: bool,
        reporter: &mut ViolationReporter<'_>,
    ) {
        if are_faults_cleared
            && !(self.is_known || self.is_slow && self.has_recovered)
            && let Some(since) = self.known_since.filter(|since| at > since + self.max_delay)
        {
            let (ms, soon) = ((at - since) / MILLIS, self.max_delay / MILLIS);
            reporter.report(format!("sensor {sensor}: no known verdict after {ms} ms, limit {soon}"));
        }
    }
}

/// Maximum interval between zones at which the first zones are valid until the second zones arrive.
const MAX_FREQUENT_INTERVAL: Nanos = 230 * MILLIS;
/// Interval between two announcements.
const ANNOUNCE_INTERVAL: Nanos = 1_000 * MILLIS;
/// Maximum delay of all threads and timers together.
const TIMER_DELAY: Nanos = 3 * MILLIS;
