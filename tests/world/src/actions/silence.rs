//! Nothing arrives for a while, or everything arrives late.

use lms::Nanos;
use sim::fault::Faults;

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "silence",
    per_minute: 4.0,
    keys: &[SENSOR, Key::new("is_late", 0, 1), Key::new("span_ms", 20, 4_000)],
    act,
};

fn act(world: &mut World, action: &Action) {
    let faults = faults(action, world.now());
    world.fault(action, &faults);
}

/// What it does to the bytes on the line from `now` on.
pub(super) fn faults(action: &Action, now: Nanos) -> Faults {
    let (span, at) = (action.value("span_ms") as f64 / 1e3, now as f64 / 1e9 + 1e-3);
    match action.value("is_late") {
        0 => Faults { silence: span, silence_at: at, ..Faults::default() },
        _ => Faults { stall: span, stall_at: at, ..Faults::default() },
    }
}
