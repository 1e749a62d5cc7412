//! The router between gateway and listener is killed with all that it holds, and another one is started after a while. Gateway
//! and listener of a world in which this happens are bridges, unless they have a key: then there is no router but the network,
//! through which nothing passes meanwhile.

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "router_killed", per_minute: 4.0, keys: &[Key::new("away_ms", 5, 8_000)], act };

fn act(world: &mut World, action: &Action) {
    let now = world.now();
    world.remote.kill_router(now);
    world.later(action.value("away_ms"), |world| world.remote.begin_router(&world.shared));
}
