//! A scanner says that it may fail soon, or that it does not measure; some still say so after they booted. What has nothing of that kind does not care.

use super::{Key, Kind, SENSOR};
use crate::family::Ailment;
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "unwell",
    per_minute: 1.0,
    keys: &[SENSOR, Key::new("status", 1, 2), Key::new("stubborn", 0, 1), Key::new("span_ms", 100, 10_000)],
    act,
};

fn act(world: &mut World, action: &Action) {
    let (status, is_stubborn) = (action.value("status") as u8, action.value("stubborn") > 0);
    world.ail(action, Ailment::Unwell { status, is_stubborn });
    world.ail_later(action, Ailment::Unwell { status: 0, is_stubborn: false });
}
