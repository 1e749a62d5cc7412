//! Judges of verdicts that robots accept, next to the hub and on another machine.

use scanhub_schema::datagram::Packed;
use scanhub_schema::{MILLIS, Nanos, Topic, Verdict, Zones};

use super::{Judge, Say};
use crate::actions::objects_inside;
use crate::event::Event;
use crate::plan::Plan;
use crate::remote::Terms;
use crate::setup::Setup;

/// Judge: a robot never accepts a clear verdict for longer than promised while an object is inside a circle.
///
/// The promise (`docs/topics.md`): a verdict is valid for two periods and 20 ms in the hub, for 20 ms more in a subscriber, and
/// unknown after that. A scan shows the objects at the time of its measurement and is then on the line for a while. A circle is
/// violated by a number of scans in a row, each of which may be as late as a verdict is valid in the hub.
pub(crate) struct LocalVerdict {
    sensors: Vec<OfSensor>,
}

struct OfSensor {
    /// When something is inside.
    inside: Vec<(Nanos, Nanos)>,
    bound: Nanos,
    /// Since when it is believed that the way is clear, if it is.
    clear_since: Option<Nanos>,
}

impl LocalVerdict {
    pub(crate) fn new(setup: &Setup, plan: &Plan) -> LocalVerdict {
        let sensor = |number: usize| {
            let bound = bound(setup, number);
            let inside = objects_inside(plan, number, setup.sensors.len());
            OfSensor { inside, bound, clear_since: None }
        };
        LocalVerdict { sensors: (0..setup.sensors.len()).map(sensor).collect() }
    }
}

impl Judge for LocalVerdict {
    fn name(&self) -> &'static str {
        "verdict"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Believes { sensor, verdict } => {
                let of = &mut self.sensors[sensor];
                of.check(sensor, at, say);
                of.clear_since = (verdict == Verdict::Clear).then_some(at);
            }
            Event::Over { .. } => {
                let sensors = self.sensors.iter_mut().enumerate();
                sensors.for_each(|(sensor, of)| of.check(sensor, at, say));
            }
            _ => {}
        }
    }
}

impl OfSensor {
    fn check(&mut self, sensor: usize, at: Nanos, say: &mut Say<'_>) {
        let Some(since) = self.clear_since else { return };
        for &(from, until) in &self.inside {
            let end = at.min(until);
            if end > since && end > from + self.bound {
                let (was, bound) = ((end - from) / MILLIS, self.bound / MILLIS);
                say.broken(format!(
                    "sensor {sensor}: clear, and something inside for {was} ms, bound {bound}"
                ));
            }
        }
    }
}

/// For so long it may be believed that nothing is inside a circle of sensor `number`, although something is.
fn bound(setup: &Setup, number: usize) -> Nanos {
    let (period, told_after) = setup.sensors[number].times();
    let in_hub = 2 * period + GRACE;
    told_after + setup.min_scans * in_hub + GRACE + SLACK
}

/// What is added to the two periods in the hub, and once more with a consumer.
const GRACE: Nanos = 20 * MILLIS;
/// Threads and timers are late by no more than this, all together.
const SLACK: Nanos = 3 * MILLIS;

/// Judge: a remote robot never accepts a clear verdict for longer than promised while an object is inside a circle.
///
/// The promise has two halves. A gateway is a subscriber of the hub like a robot, so it sends no clear zones for longer than a
/// robot next to the hub accepts them. From its arrival on (`docs/topics.md`: the delay on the network is unknown), a verdict is
/// valid for two periods as sent and 40 ms, at least half a second and at most 5.04 s, and unknown after that.
pub(crate) struct RemoteVerdict {
    begin_ns: u64,
    sensors: Vec<RemoteSensor>,
}

struct RemoteSensor {
    /// When something is inside.
    inside: Vec<(Nanos, Nanos)>,
    /// Time for which a robot next to the hub may accept another verdict.
    bound: Nanos,
    /// Time until which the last published verdict is valid.
    until: Nanos,
    believed: Verdict,
}

impl RemoteVerdict {
    pub(crate) fn new(setup: &Setup, plan: &Plan, terms: &Terms) -> RemoteVerdict {
        let sensor = |number: usize| {
            let inside = objects_inside(plan, number, setup.sensors.len());
            // In a bridge the newest of those that go out waits until the next one comes.
            let (period, _) = setup.sensors[number].times();
            let waits = if terms.are_bridges { terms.every.get() * period } else { 0 };
            let bound = bound(setup, number) + waits;
            RemoteSensor { inside, bound, until: 0, believed: Verdict::Unknown }
        };
        let sensors = (0..setup.sensors.len()).map(sensor).collect();
        RemoteVerdict { begin_ns: terms.clocks.monotonic_ns, sensors }
    }
}

impl Judge for RemoteVerdict {
    fn name(&self) -> &'static str {
        "remote_verdict"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Transmitted { datagram, .. } if datagram.head.topic == Topic::Zones.number() => {
                let sensor = usize::from(datagram.head.sensor);
                let of = &self.sensors[sensor];
                if is_clear(datagram.payload)
                    && let Some((from, _)) =
                        of.inside.iter().find(|(from, until)| from + of.bound < at && at < *until)
                {
                    let (was, bound) = ((at - from) / MILLIS, of.bound / MILLIS);
                    say.broken(format!(
                        "sensor {sensor}: clear is sent, and something inside for {was} ms, bound {bound}"
                    ));
                }
            }
            Event::Republished { sensor, topic: Topic::Zones, header, .. } => {
                let of = &mut self.sensors[sensor];
                of.check(sensor, at, say);
                let stands = (2_000 * u64::from(header.period_us) + MARGIN).max(LEAST);
                if stands > MOST {
                    say.broken(format!("sensor {sensor}: a verdict that stands for {} ms", stands / MILLIS));
                }
                of.until = header.stamp_last_ns - self.begin_ns + stands;
            }
            Event::RemoteBelieves { sensor, verdict } => {
                let of = &mut self.sensors[sensor];
                of.believed = verdict;
                of.check(sensor, at, say);
            }
            Event::Over { .. } => {
                let sensors = self.sensors.iter().enumerate();
                sensors.for_each(|(sensor, of)| of.check(sensor, at, say));
            }
            _ => {}
        }
    }
}

impl RemoteSensor {
    /// Checks that the accepted verdict is still valid. A verdict that the robot drops now was accepted until now.
    fn check(&self, sensor: usize, at: Nanos, say: &mut Say<'_>) {
        if self.believed != Verdict::Unknown && at > self.until {
            let late = (at - self.until) / MILLIS;
            say.broken(format!("sensor {sensor}: {:?}, which stands no more since {late} ms", self.believed));
        }
    }
}

fn is_clear(payload: &[u8]) -> bool {
    let mut zones = Zones::default();
    zones.unpack(payload) && zones.verdict() == Verdict::Clear
}

/// Margin after two periods, and the shortest and the longest validity of a verdict.
const MARGIN: Nanos = 40 * MILLIS;
const LEAST: Nanos = 500 * MILLIS;
const MOST: Nanos = 5_040 * MILLIS;
