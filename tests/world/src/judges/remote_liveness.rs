//! When nothing goes wrong any more, a remote robot knows soon what the hub knows: at the next announcement its sensor has a
//! name, and the next zones that are due go out. It knows it from then on, unless the zones come so seldom that the first ones,
//! which do not say their period yet, are too old before the second ones come (`docs/topics.md`).

use scanhub_schema::{MILLIS, Nanos, Topic, Verdict, Zones};

use super::{Judge, Say};
use crate::event::Event;
use crate::remote::{RECONNECTED, ROUND, Terms};
use crate::setup::Setup;

/// What is known where.
pub(crate) struct RemoteLiveness {
    is_healed: bool,
    sensors: Vec<OfSensor>,
}

struct OfSensor {
    /// From known zones in the hub to known ones here, at most.
    soon: Nanos,
    /// Zones come less often than a verdict stands whose period is not known.
    is_slow: bool,
    /// Since when the hub says what it knows, if it does.
    said_since: Option<Nanos>,
    is_known: bool,
    /// It was known since all was well.
    came: bool,
}

impl RemoteLiveness {
    pub(crate) fn new(setup: &Setup, terms: &Terms) -> RemoteLiveness {
        let sensor = |of: usize| {
            let (period, _) = setup.sensors[of].times();
            let every = terms.every.get() * period;
            // A router that comes back with all else is found within so long, and what waited goes out.
            let over_router = if terms.are_bridges { RECONNECTED + ROUND } else { 0 };
            let soon = ANNOUNCED + every + period + terms.delay_ns + over_router + SLACK;
            OfSensor { soon, is_slow: every > OFTEN, said_since: None, is_known: false, came: false }
        };
        RemoteLiveness { is_healed: false, sensors: (0..setup.sensors.len()).map(sensor).collect() }
    }
}

impl Judge for RemoteLiveness {
    fn name(&self) -> &'static str {
        "remote_liveness"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Healed => {
                self.is_healed = true;
                self.sensors.iter_mut().for_each(|of| (of.said_since, of.came) = (None, of.is_known));
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Zones => {
                let zones: Zones = bytemuck::pod_read_unaligned(&sample.bytes);
                let of = &mut self.sensors[sensor];
                match zones.verdict() {
                    Verdict::Unknown => of.said_since = None,
                    _ => _ = of.said_since.get_or_insert(at),
                }
                of.check(sensor, at, self.is_healed, say);
            }
            Event::RemoteBelieves { sensor, verdict } => {
                let of = &mut self.sensors[sensor];
                of.check(sensor, at, self.is_healed, say);
                of.is_known = verdict != Verdict::Unknown;
                of.came |= of.is_known;
            }
            Event::Over { .. } => {
                for (sensor, of) in self.sensors.iter().enumerate() {
                    of.check(sensor, at, self.is_healed, say);
                }
            }
            Event::ListenerEnds { sensors, .. } if self.is_healed && sensors != self.sensors.len() => {
                say.broken(format!("{sensors} sensors are published at the end"));
            }
            _ => {}
        }
    }
}

impl OfSensor {
    fn check(&self, sensor: usize, at: Nanos, is_healed: bool, say: &mut Say<'_>) {
        if is_healed
            && !(self.is_known || self.is_slow && self.came)
            && let Some(since) = self.said_since.filter(|since| at > since + self.soon)
        {
            let (ms, soon) = ((at - since) / MILLIS, self.soon / MILLIS);
            say.broken(format!("sensor {sensor}: nothing is known {ms} ms later, bound {soon}"));
        }
    }
}

/// Zones that are sent at least so often are always known.
const OFTEN: Nanos = 230 * MILLIS;
/// Between two announcements.
const ANNOUNCED: Nanos = 1_000 * MILLIS;
/// Threads and timers are late by no more than this, all together.
const SLACK: Nanos = 3 * MILLIS;
