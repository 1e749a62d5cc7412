//! Whole telegrams suffer for a while: their ends are lost, their length fields are others, they come twice, the sensor breaks
//! them off.

use scanhub_sim::fault::Faults;

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

/// Shares are in percent.
pub(crate) const KIND: Kind = Kind {
    name: "telegrams",
    per_minute: 3.0,
    keys: &[
        SENSOR,
        Key::new("truncate", 0, 30),
        Key::new("length", 0, 30),
        Key::new("repeat", 0, 30),
        Key::new("abort", 0, 30),
        Key::new("span_ms", 20, 10_000),
    ],
    act,
};

fn act(world: &mut World, action: &Action) {
    world.fault(action, &faults(action));
}

/// What it does to the bytes on the line.
pub(super) fn faults(action: &Action) -> Faults {
    let share = |name| action.value(name) as f64 / 1e2;
    Faults {
        truncate: share("truncate"),
        length: share("length"),
        repeat: share("repeat"),
        abort: share("abort"),
        ..Faults::default()
    }
}
