//! A remote robot never believes that its way is clear for longer than promised while something is inside a circle.
//!
//! The promise in two halves. A gateway is a consumer of the hub like any robot, so that it sends no clear zones for longer than
//! a robot beside the hub believes them. And from the arrival on (`docs/topics.md`: the way there is not known) a verdict stands
//! for two periods as sent and 40 ms, for half a second at least, and never for longer than 5.04 s; then it is unknown.

use scanhub_schema::datagram::Packed;
use scanhub_schema::{MILLIS, Nanos, Topic, Verdict, Zones};

use super::{Judge, Say, verdict};
use crate::actions::object;
use crate::event::Event;
use crate::plan::Plan;
use crate::remote::Terms;
use crate::setup::Setup;

/// What gateways say and remote robots believe.
pub(crate) struct RemoteVerdict {
    begin_ns: u64,
    sensors: Vec<OfSensor>,
}

struct OfSensor {
    /// When something is inside.
    inside: Vec<(Nanos, Nanos)>,
    /// For so long a robot beside the hub may believe otherwise.
    bound: Nanos,
    /// Until when what was published last stands.
    until: Nanos,
    believed: Verdict,
}

impl RemoteVerdict {
    pub(crate) fn new(setup: &Setup, plan: &Plan, terms: &Terms) -> RemoteVerdict {
        let sensor = |number: usize| {
            let inside = object::inside(plan, number, setup.sensors.len());
            // In a bridge the newest of those that go out waits until the next one comes.
            let (period, _) = setup.sensors[number].times();
            let waits = if terms.are_bridges { terms.every.get() * period } else { 0 };
            let bound = verdict::bound(setup, number) + waits;
            OfSensor { inside, bound, until: 0, believed: Verdict::Unknown }
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

impl OfSensor {
    /// What is believed is as old as it may be. (What a robot stops to believe just now it may have believed until now.)
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

/// What is added to two periods, the least time that a verdict stands, and the longest.
const MARGIN: Nanos = 40 * MILLIS;
const LEAST: Nanos = 500 * MILLIS;
const MOST: Nanos = 5_040 * MILLIS;
