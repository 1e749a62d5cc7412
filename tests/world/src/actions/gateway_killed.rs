//! The gateway is killed, or ends in order, and another one is started after a while.

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "gateway_killed",
    per_minute: 3.0,
    keys: &[Key::new("in_order", 0, 1), Key::new("away_ms", 5, 5_000)],
    act,
};

fn act(world: &mut World, action: &Action) {
    world.remote.end_gateway(&world.shared, action.value("in_order") == 0);
    world.later(action.value("away_ms"), |world| world.remote.begin_gateway(&world.shared));
}
