//! The disk is full for a while.

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "disk_full", per_minute: 2.0, keys: &[Key::new("span_ms", 100, 20_000)], act };

fn act(world: &mut World, action: &Action) {
    world.shared.disk_is_full.set(true);
    world.later(action.value("span_ms"), |world| world.shared.disk_is_full.set(false));
}
