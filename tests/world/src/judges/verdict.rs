//! A robot never believes that its way is clear for longer than promised while something is inside a circle.
//!
//! The promise (`docs/topics.md`): a verdict stands for two periods and 20 ms in the hub, and for 20 ms more with a consumer,
//! then it is unknown. A scan tells what is there when it is measured, and is on the line for a while after that; a circle is
//! violated by so many scans in a row, each of which may come as late as a verdict stands in the hub.

use scanhub_schema::{MILLIS, Nanos, Verdict};

use super::{Judge, Say};
use crate::actions::object;
use crate::event::Event;
use crate::plan::Plan;
use crate::setup::Setup;

/// What robots believe.
pub(crate) struct OfRobot {
    sensors: Vec<OfSensor>,
}

struct OfSensor {
    /// When something is inside.
    inside: Vec<(Nanos, Nanos)>,
    bound: Nanos,
    /// Since when it is believed that the way is clear, if it is.
    clear_since: Option<Nanos>,
}

impl OfRobot {
    pub(crate) fn new(setup: &Setup, plan: &Plan) -> OfRobot {
        let sensor = |number: usize| {
            let bound = bound(setup, number);
            let inside = object::inside(plan, number, setup.sensors.len());
            OfSensor { inside, bound, clear_since: None }
        };
        OfRobot { sensors: (0..setup.sensors.len()).map(sensor).collect() }
    }
}

impl Judge for OfRobot {
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
pub(super) fn bound(setup: &Setup, number: usize) -> Nanos {
    let (period, told_after) = setup.sensors[number].times();
    let in_hub = 2 * period + GRACE;
    told_after + setup.min_scans * in_hub + GRACE + SLACK
}

/// What is added to the two periods in the hub, and once more with a consumer.
const GRACE: Nanos = 20 * MILLIS;
/// Threads and timers are late by no more than this, all together.
const SLACK: Nanos = 3 * MILLIS;
