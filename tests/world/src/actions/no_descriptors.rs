//! Nothing can be opened for a while.

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "no_descriptors", per_minute: 2.0, keys: &[Key::new("span_ms", 100, 5_000)], act };

fn act(world: &mut World, action: &Action) {
    world.shared.lacks_descriptors.set(true);
    world.later(action.value("span_ms"), |world| world.shared.lacks_descriptors.set(false));
}
