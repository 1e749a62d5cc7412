//! A sensor's power goes off and on.

use super::{Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind { name: "power_cycle", per_minute: 2.0, keys: &[SENSOR], act };

fn act(world: &mut World, action: &Action) {
    world.port(world.sensor(action), |tty, log, now| {
        tty.advance(now, log);
        tty.sensor.power_cycle();
    });
}
