//! Something is inside a circle for a while: a post ahead of a sensor, inside the larger circle or inside both. Of all that
//! happens only this is known from the start, for the scans are measured before.

use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::room::Changes;

use super::{Key, Kind, SENSOR};
use crate::plan::{Action, Plan};

pub(crate) const KIND: Kind = Kind {
    name: "object",
    per_minute: 12.0,
    keys: &[SENSOR, Key::new("near", 0, 1), Key::new("span_ms", 50, 15_000)],
    act: |_, _| (),
};

/// When something is inside a circle of `sensor` of so many `sensors`, and whether it is near.
fn spans(plan: &Plan, sensor: usize, sensors: usize) -> Vec<(Nanos, Nanos, bool)> {
    let is_its =
        |action: &&Action| action.name() == KIND.name && action.value("sensor") as usize % sensors == sensor;
    let span = |action: &Action| {
        let from = action.at_ms * MILLIS;
        (from, from + action.value("span_ms") * MILLIS, action.value("near") > 0)
    };
    plan.actions.iter().filter(is_its).map(span).collect()
}

/// The same as times from and until, those that overlap as one.
pub(crate) fn inside(plan: &Plan, sensor: usize, sensors: usize) -> Vec<(Nanos, Nanos)> {
    let mut joined: Vec<(Nanos, Nanos)> = Vec::new();
    for (from, until, _) in spans(plan, sensor, sensors) {
        match joined.last_mut().filter(|(_, end)| from <= *end) {
            Some((_, end)) => *end = until.max(*end),
            None => joined.push((from, until)),
        }
    }
    joined
}

/// How the view of `sensor` changes: room 1 has the post inside the larger circle, room 2 inside both.
pub(crate) fn changes(plan: &Plan, sensor: usize, sensors: usize) -> Changes {
    let spans = spans(plan, sensor, sensors);
    let mut times: Vec<Nanos> = spans.iter().flat_map(|&(from, until, _)| [from, until]).collect();
    times.sort_unstable();
    times.dedup();
    let room = |time: Nanos| {
        let there = spans.iter().filter(|&&(from, until, _)| from <= time && time < until);
        there.map(|&(.., is_near)| 1 + usize::from(is_near)).max().unwrap_or(0)
    };
    Changes::new(times.into_iter().map(|time| (time, room(time))).collect())
}
