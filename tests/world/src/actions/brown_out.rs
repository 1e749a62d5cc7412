//! The voltage of a scanner dips: it starts anew by itself, and its greeting comes where measurements came. What has nothing of that kind does not care.

use super::{Kind, SENSOR};
use crate::family::Ailment;
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind { name: "brown_out", per_minute: 1.5, keys: &[SENSOR], act };

fn act(world: &mut World, action: &Action) {
    world.ail(action, Ailment::BrownOut);
}
