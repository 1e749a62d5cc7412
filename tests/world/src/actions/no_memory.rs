//! There is no memory for samples for a while.

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "no_memory", per_minute: 2.0, keys: &[Key::new("span_ms", 5, 3_000)], act };

fn act(world: &mut World, action: &Action) {
    world.shared.board.borrow_mut().lacks_memory = true;
    world.later(action.value("span_ms"), |world| world.shared.board.borrow_mut().lacks_memory = false);
}
