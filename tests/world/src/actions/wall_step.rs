//! The wall clock is set.

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "wall_step",
    per_minute: 2.0,
    keys: &[Key::new("is_back", 0, 1), Key::new("seconds", 1, 1_000_000)],
    act,
};

fn act(world: &mut World, action: &Action) {
    let (ahead, by) = (&world.shared.wall_ahead, action.value("seconds") * 1_000_000_000);
    ahead.set(if action.value("is_back") > 0 { ahead.get() - by } else { ahead.get() + by });
}
