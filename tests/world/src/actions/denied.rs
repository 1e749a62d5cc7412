//! A port cannot be opened for a while although it is there: without permission, or because another program has it.

use port::PortError;

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "denied",
    per_minute: 2.0,
    keys: &[SENSOR, Key::new("is_busy", 0, 1), Key::new("span_ms", 100, 5_000)],
    act,
};

fn act(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    let error = if action.value("is_busy") > 0 { PortError::Busy } else { PortError::Denied };
    world.port(sensor, |tty, _, _| tty.refuses = Some(error));
    world.later(action.value("span_ms"), move |world| {
        world.port(sensor, |tty, _, _| tty.refuses = None);
    });
}
