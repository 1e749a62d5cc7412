//! The configuration is another one, good or bad, and the hub is told to read it.

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "reload", per_minute: 4.0, keys: &[Key::new("edition", 0, 2)], act };

fn act(world: &mut World, action: &Action) {
    world.edition.set(action.value("edition"));
    world.wants.reload = true;
}
