//! The voltage of a scanner dips, and it restarts by itself.

use super::{Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind { name: "brown_out", per_minute: 1.5, keys: &[SENSOR], act };

fn act(world: &mut World, action: &Action) {
    world.port(world.sensor(action), |tty, log, now| {
        tty.advance(now, log);
        tty.sensor.brown_out();
    });
}
