//! Another process, which had the port open before the hub, sets it to another rate.

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "altered", per_minute: 2.0, keys: &[SENSOR, Key::new("rate", 0, 4)], act };

fn act(world: &mut World, action: &Action) {
    let rate = RATES[action.value("rate") as usize];
    let sensor = world.sensor(action);
    world.port(sensor, |tty, log, now| tty.alter(rate, log, now));
}

/// Rates that programs try, in bits per second.
const RATES: [u32; 5] = [9_600, 38_400, 57_600, 115_200, 500_000];
