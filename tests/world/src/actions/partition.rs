//! Nothing passes the network for a while.

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "partition", per_minute: 4.0, keys: &[Key::new("span_ms", 20, 8_000)], act };

fn act(world: &mut World, action: &Action) {
    let now = world.now();
    world.remote.part(true, now);
    world.later(action.value("span_ms"), |world| {
        let now = world.now();
        world.remote.part(false, now);
    });
}
