//! The listener is killed, and another one is started after a while.

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "listener_killed", per_minute: 3.0, keys: &[Key::new("away_ms", 5, 5_000)], act };

fn act(world: &mut World, action: &Action) {
    world.remote.kill_listener(&world.shared);
    world.later(action.value("away_ms"), |world| world.remote.begin_listener(&world.shared));
}
