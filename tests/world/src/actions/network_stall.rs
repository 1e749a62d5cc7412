//! The gateway's process does not run for a while, or the listener's.

use scanhub_schema::MILLIS;

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "network_stall",
    per_minute: 4.0,
    keys: &[Key::new("is_listener", 0, 1), Key::new("span_ms", 5, 5_000)],
    act,
};

fn act(world: &mut World, action: &Action) {
    let until = world.now() + action.value("span_ms") * MILLIS;
    world.remote.stall(action.value("is_listener") > 0, until);
}
