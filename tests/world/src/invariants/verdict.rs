//! Invariants on the verdicts that robots accept, both next to the hub and on another machine.

use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::{MILLIS, Nanos, Topic, Verdict, Zones};

use super::{Invariant, ViolationReporter};
use crate::actions::objects_inside;
use crate::event::Event;
use crate::remote::LinkSettings;
use crate::scenario::Scenario;
use crate::setup::Setup;

/// Invariant: a robot does not accept a clear verdict for longer than documented while an object is inside a zone.
///
/// According to `docs/topics.md`, a verdict is valid for two periods and 20 ms in the hub, and for 20 ms more in a
/// subscriber. After that, the verdict is unknown. A scan shows the objects at the time of its measurement, and needs
/// some time on the line. A zone is violated only after a number of consecutive scans. The time between two of these
/// scans may be as long as a verdict is valid in the hub.
pub(crate) struct LocalVerdict {
    sensors: Vec<SensorVerdict>,
}

struct SensorVerdict {
    /// Time spans in which an object is inside a zone.
    object_spans: Vec<(Nanos, Nanos)>,
    max_delay: Nanos,
    /// Time since which the robot has accepted a clear verdict, or `None` if the accepted verdict is not clear.
    clear_since: Option<Nanos>,
}

impl LocalVerdict {
    pub(crate) fn new(setup: &Setup, scenario: &Scenario) -> LocalVerdict {
        let sensor = |number: usize| {
            let max_delay = max_clear_time(setup, number);
            let object_spans = objects_inside(scenario, number, setup.sensors.len());
            SensorVerdict { object_spans, max_delay, clear_since: None }
        };
        LocalVerdict { sensors: (0..setup.sensors.len()).map(sensor).collect() }
    }
}

impl Invariant for LocalVerdict {
    fn name(&self) -> &'static str {
        "verdict"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::VerdictAccepted { sensor, verdict } => {
                let of = &mut self.sensors[sensor];
                of.check(sensor, at, reporter);
                of.clear_since = (verdict == Verdict::Clear).then_some(at);
            }
            Event::WorldEnded { .. } => {
                let sensors = self.sensors.iter_mut().enumerate();
                sensors.for_each(|(sensor, of)| of.check(sensor, at, reporter));
            }
            _ => {}
        }
    }
}

impl SensorVerdict {
    fn check(&mut self, sensor: usize, at: Nanos, reporter: &mut ViolationReporter<'_>) {
        let Some(since) = self.clear_since else { return };
        for &(from, until) in &self.object_spans {
            let end = at.min(until);
            if end > since && end > from + self.max_delay {
                let (was, bound) = ((end - from) / MILLIS, self.max_delay / MILLIS);
                reporter.report(format!(
                    "sensor {sensor}: clear with an object inside for {was} ms, limit {bound}"
                ));
            }
        }
    }
}

/// Returns the maximum time for which a robot may accept a clear verdict of sensor `number` while an object is inside a
/// zone.
fn max_clear_time(setup: &Setup, number: usize) -> Nanos {
    let (period, scan_delay) = setup.sensors[number].scan_times();
    let in_hub = 2 * period + STALENESS_MARGIN;
    scan_delay + setup.min_scans * in_hub + STALENESS_MARGIN + TIMER_DELAY
}

/// Margin that is added to two periods in the hub, and once more in a subscriber.
const STALENESS_MARGIN: Nanos = 20 * MILLIS;
/// Maximum delay of all threads and timers together.
const TIMER_DELAY: Nanos = 3 * MILLIS;

/// Invariant: a remote robot does not accept a clear verdict for longer than documented while an object is inside a
/// zone.
///
/// The maximum time has two parts. The first part is the time on the hub's machine: a gateway subscribes like a robot,
/// so it sends clear zones for no longer than a robot next to the hub accepts them. The second part starts when the
/// zones arrive, because the delay on the network is unknown (`docs/topics.md`). From its arrival on, a verdict is
/// valid for two of the periods that the sender measured, plus 40 ms; at least for half a second and at most for 5.04
/// s. After that, the verdict is unknown.
pub(crate) struct RemoteVerdict {
    begin_ns: u64,
    sensors: Vec<RemoteSensor>,
}

struct RemoteSensor {
    /// Time spans in which an object is inside a zone.
    object_spans: Vec<(Nanos, Nanos)>,
    /// Maximum time for which the gateway may send a clear verdict while an object is inside a zone.
    max_delay: Nanos,
    /// Time until which the last published verdict is valid.
    valid_until: Nanos,
    accepted: Verdict,
}

impl RemoteVerdict {
    pub(crate) fn new(setup: &Setup, scenario: &Scenario, terms: &LinkSettings) -> RemoteVerdict {
        let sensor = |number: usize| {
            let object_spans = objects_inside(scenario, number, setup.sensors.len());
            // A bridge may keep the newest sample in its queue until the next one arrives.
            let (period, _) = setup.sensors[number].scan_times();
            let waits = if terms.are_bridges { terms.send_interval.get() * period } else { 0 };
            let max_delay = max_clear_time(setup, number) + waits;
            RemoteSensor { object_spans, max_delay, valid_until: 0, accepted: Verdict::Unknown }
        };
        let sensors = (0..setup.sensors.len()).map(sensor).collect();
        RemoteVerdict { begin_ns: terms.initial_clocks.monotonic_ns, sensors }
    }
}

impl Invariant for RemoteVerdict {
    fn name(&self) -> &'static str {
        "remote_verdict"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Transmitted { datagram, .. } if datagram.head.topic == Topic::Zones.number() => {
                let sensor = usize::from(datagram.head.sensor);
                let of = &self.sensors[sensor];
                if is_clear(datagram.payload)
                    && let Some((from, _)) =
                        of.object_spans.iter().find(|(from, until)| from + of.max_delay < at && at < *until)
                {
                    let (was, bound) = ((at - from) / MILLIS, of.max_delay / MILLIS);
                    reporter.report(format!(
                        "sensor {sensor}: clear is sent with an object inside for {was} ms, limit {bound}"
                    ));
                }
            }
            Event::Republished { sensor, topic: Topic::Zones, header, .. } => {
                let of = &mut self.sensors[sensor];
                of.check(sensor, at, reporter);
                let stands = (2_000 * u64::from(header.period_us) + VALIDITY_MARGIN).max(MIN_VALIDITY);
                if stands > MAX_VALIDITY {
                    reporter.report(format!(
                        "sensor {sensor}: a verdict that is valid for {} ms",
                        stands / MILLIS
                    ));
                }
                of.valid_until = header.stamp_last_ns - self.begin_ns + stands;
            }
            Event::RemoteVerdictAccepted { sensor, verdict } => {
                let of = &mut self.sensors[sensor];
                of.accepted = verdict;
                of.check(sensor, at, reporter);
            }
            Event::WorldEnded { .. } => {
                let sensors = self.sensors.iter().enumerate();
                sensors.for_each(|(sensor, of)| of.check(sensor, at, reporter));
            }
            _ => {}
        }
    }
}

impl RemoteSensor {
    /// Checks that the accepted verdict is still valid. If the robot drops its verdict now, it accepted the verdict
    /// until now.
    fn check(&self, sensor: usize, at: Nanos, reporter: &mut ViolationReporter<'_>) {
        if self.accepted != Verdict::Unknown && at > self.valid_until {
            let late = (at - self.valid_until) / MILLIS;
            reporter
                .report(format!("sensor {sensor}: {:?}, which became stale {late} ms ago", self.accepted));
        }
    }
}

fn is_clear(payload: &[u8]) -> bool {
    let mut zones = Zones::default();
    zones.unpack(payload) && zones.verdict() == Verdict::Clear
}

/// Margin that is added to two periods; and minimum and maximum time for which a verdict is valid.
const VALIDITY_MARGIN: Nanos = 40 * MILLIS;
const MIN_VALIDITY: Nanos = 500 * MILLIS;
const MAX_VALIDITY: Nanos = 5_040 * MILLIS;
