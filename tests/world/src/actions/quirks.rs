//! A sensor behaves badly for a while: it overlooks requests, refuses them, answers twice or late.

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

/// Shares are in percent.
pub(crate) const KIND: Kind = Kind {
    name: "habits",
    per_minute: 1.5,
    keys: &[
        SENSOR,
        Key::new("overlooks", 0, 50),
        Key::new("naks", 0, 50),
        Key::new("doubles", 0, 50),
        Key::new("late_ms", 0, 1_500),
        Key::new("mute", 0, 1),
        Key::new("span_ms", 500, 15_000),
    ],
    act,
};

fn act(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.port(sensor, |tty, _, _| tty.sensor.misbehave(Some(action)));
    world.later(action.value("span_ms"), move |world| {
        world.port(sensor, |tty, _, _| tty.sensor.misbehave(None));
    });
}
