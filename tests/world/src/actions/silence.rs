//! Nothing arrives for a while, or everything arrives late.

use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::fault::Faults;

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
    // What is held back when everything is made well again would still be.
    let faults = faults(action, world.now(), world.until_healed());
    world.fault(action, &faults);
}

/// What it does to the bytes on the line from `now` on, for so long at the `most`.
pub(super) fn faults(action: &Action, now: Nanos, most: Nanos) -> Faults {
    let span = (action.value("span_ms") * MILLIS).min(most) as f64 / 1e9;
    let at = now as f64 / 1e9 + 1e-3;
    match action.value("is_late") {
        0 => Faults { silence: span, silence_at: at, ..Faults::default() },
        _ => Faults { stall: span, stall_at: at, ..Faults::default() },
    }
}
