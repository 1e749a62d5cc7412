//! The hub's process does not run for a while.

use scanhub_schema::MILLIS;

use super::{Key, Kind};
use crate::event::Event;
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "stall", per_minute: 4.0, keys: &[Key::new("span_ms", 5, 5_000)], act };

fn act(world: &mut World, action: &Action) {
    let until = world.now() + action.value("span_ms") * MILLIS;
    world.stalled_until = world.stalled_until.max(until);
    world.shared.tell(&Event::Stalled { until: world.stalled_until });
}
