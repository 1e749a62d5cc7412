//! The adapter is pulled out and comes back under another name, and later under its own.

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "replug_elsewhere",
    per_minute: 1.5,
    keys: &[SENSOR, Key::new("out_ms", 1, 1_000), Key::new("span_ms", 100, 6_000)],
    act,
};

fn act(world: &mut World, action: &Action) {
    let (sensor, span_ms) = (world.sensor(action), action.value("span_ms"));
    world.port(sensor, |tty, log, now| tty.unplug(log, now));
    world.later(action.value("out_ms"), move |world| {
        world.port(sensor, |tty, log, now| tty.plug(true, log, now));
        world.later(span_ms, move |world| {
            world.port(sensor, |tty, log, now| {
                tty.unplug(log, now);
                tty.plug(false, log, now);
            });
        });
    });
}
