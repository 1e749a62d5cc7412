//! Floods of random bytes and walls of start bytes come over the line for a while.

use scanhub_sim::fault::Faults;

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "garbage",
    per_minute: 3.0,
    keys: &[
        SENSOR,
        Key::new("flood", 0, 3_000),
        Key::new("wall", 0, 3_000),
        Key::new("every_ms", 20, 2_000),
        Key::new("span_ms", 20, 6_000),
    ],
    act,
};

fn act(world: &mut World, action: &Action) {
    world.fault(action, &faults(action));
}

/// What it does to the bytes on the line.
pub(super) fn faults(action: &Action) -> Faults {
    let every = action.value("every_ms") as f64 / 1e3;
    let (flood, wall) = (action.value("flood") as f64, action.value("wall") as f64);
    Faults { flood, flood_every: every, wall, wall_every: every, ..Faults::default() }
}
