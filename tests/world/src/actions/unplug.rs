//! The adapter is pulled out, and plugged in again.

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "unplug", per_minute: 3.0, keys: &[SENSOR, Key::new("span_ms", 1, 6_000)], act };

fn act(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.port(sensor, |tty, log, now| tty.unplug(log, now));
    world.later(action.value("span_ms"), move |world| {
        world.port(sensor, |tty, log, now| tty.plug(false, log, now));
    });
}
