//! A scanner that measures hears nothing for a while, not even that it shall stop. What has nothing of that kind does not care.

use super::{Key, Kind, SENSOR};
use crate::family::Ailment;
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "deaf", per_minute: 1.0, keys: &[SENSOR, Key::new("span_ms", 100, 8_000)], act };

fn act(world: &mut World, action: &Action) {
    world.ail(action, Ailment::Deaf(true));
    world.ail_later(action, Ailment::Deaf(false));
}
