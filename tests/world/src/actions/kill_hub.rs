//! The hub is killed, and another one is started after a while.

use scanhub_schema::MILLIS;

use super::{Key, Kind};
use crate::plan::Action;
use crate::world::{Ending, World};

pub(crate) const KIND: Kind =
    Kind { name: "kill_hub", per_minute: 3.0, keys: &[Key::new("away_ms", 20, 4_000)], act };

fn act(world: &mut World, action: &Action) {
    let back_at = world.now() + action.value("away_ms") * MILLIS;
    world.wants.end = Some(Ending { is_killed: true, back_at });
}
