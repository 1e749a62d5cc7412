//! The head of a scanner turns slower or faster for a while; it takes its time to get there, as motors do. What does not turn
//! all around does not care.

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

/// The speed is in percent of the usual one.
pub(crate) const KIND: Kind = Kind {
    name: "pace",
    per_minute: 3.0,
    keys: &[SENSOR, Key::new("percent", 60, 125), Key::new("span_ms", 1_000, 10_000)],
    act,
};

fn act(world: &mut World, action: &Action) {
    let (sensor, share) = (world.sensor(action), action.value("percent") as f64 / 1e2);
    let set = move |world: &mut World, share: f64| {
        world.port(sensor, |tty, log, now| {
            tty.advance(now, log);
            tty.sensor.set_pace(share);
        });
    };
    set(world, share);
    world.later(action.value("span_ms"), move |world| set(world, 1.0));
}
