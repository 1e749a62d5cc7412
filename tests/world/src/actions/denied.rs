//! A port cannot be opened for a while although it exists: without permission, because another program has it, or because
//! the driver refuses the rate.

use scanhub_port::PortError;

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "denied",
    per_minute: 2.0,
    keys: &[SENSOR, Key::new("reason", 0, 2), Key::new("span_ms", 100, 5_000)],
    act,
};

fn act(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    let error = match action.value("reason") {
        0 => PortError::Denied,
        1 => PortError::Busy,
        _ => PortError::Rate { wanted: 500_000, given: 115_200 },
    };
    world.port(sensor, |tty, _, _| tty.refuses = Some(error));
    world.later(action.value("span_ms"), move |world| {
        world.port(sensor, |tty, _, _| tty.refuses = None);
    });
}
