//! The line loses, flips, inserts and doubles bytes for a while.

use scanhub_sim::fault::Faults;

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

/// Shares are in a hundred thousandth.
pub(crate) const KIND: Kind = Kind {
    name: "noise",
    per_minute: 3.0,
    keys: &[
        SENSOR,
        Key::new("loss", 0, 1_000),
        Key::new("flip", 0, 1_000),
        Key::new("insert", 0, 500),
        Key::new("double", 0, 500),
        Key::new("burst", 1, 40),
        Key::new("span_ms", 20, 10_000),
    ],
    act,
};

fn act(world: &mut World, action: &Action) {
    world.fault(action, &faults(action));
}

/// What it does to the bytes on the line.
pub(super) fn faults(action: &Action) -> Faults {
    let share = |name| action.value(name) as f64 / 1e5;
    let burst = action.value("burst") as f64;
    Faults {
        loss: share("loss"),
        flip: share("flip"),
        insert: share("insert"),
        double: share("double"),
        burst,
        flip_bits: burst,
        insert_burst: burst,
        ..Faults::default()
    }
}
