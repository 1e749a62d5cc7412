//! Actions of a scanner and of the scene that it measures.

use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::room::Changes;

use super::{Key, Kind, SENSOR};
use crate::event::Event;
use crate::family::Ailment;
use crate::plan::{Action, Plan};
use crate::world::World;

/// Another scanner is connected to the line, at some rate, idle or already streaming.
pub(super) const EXCHANGE: Kind = Kind {
    name: "exchange",
    per_minute: 1.5,
    keys: &[SENSOR, Key::new("rate", 0, 3), Key::new("streams", 0, 1)],
    act: exchange_scanner,
};

fn exchange_scanner(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.port(sensor, |tty, log, now| {
        tty.advance(now, log);
        tty.sensor.exchange(action);
    });
    world.shared.tell(&Event::Exchanged { sensor });
}

/// A scanner's power goes off and on.
pub(super) const POWER_CYCLE: Kind =
    Kind { name: "power_cycle", per_minute: 2.0, keys: &[SENSOR], act: power_cycle };

fn power_cycle(world: &mut World, action: &Action) {
    world.port(world.sensor(action), |tty, log, now| {
        tty.advance(now, log);
        tty.sensor.power_cycle();
    });
}

/// The voltage of a scanner dips, and the scanner restarts.
pub(super) const BROWN_OUT: Kind =
    Kind { name: "brown_out", per_minute: 1.5, keys: &[SENSOR], act: brown_out };

fn brown_out(world: &mut World, action: &Action) {
    world.port(world.sensor(action), |tty, log, now| {
        tty.advance(now, log);
        tty.sensor.brown_out();
    });
}

/// A scanner misbehaves for a while: it overlooks requests, refuses them, or replies twice or late. Shares are in percent.
pub(super) const HABITS: Kind = Kind {
    name: "habits",
    per_minute: 1.5,
    keys: &[
        SENSOR,
        Key::new("overlooks", 0, 50),
        Key::new("naks", 0, 50),
        Key::new("doubles", 0, 50),
        Key::new("late_ms", 0, 1_500),
        Key::new("mute", 0, 1),
        Key::new("span_ms", 500, 15_000),
    ],
    act: misbehave,
};

fn misbehave(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.port(sensor, |tty, _, _| tty.sensor.misbehave(Some(action)));
    world.later(action.value("span_ms"), move |world| {
        world.port(sensor, |tty, _, _| tty.sensor.misbehave(None));
    });
}

/// The head of a scanner turns slower or faster for a while and changes its speed gradually, as motors do. Scanners without
/// full revolutions ignore the action. The speed is in percent of the usual one.
pub(super) const PACE: Kind = Kind {
    name: "pace",
    per_minute: 3.0,
    keys: &[SENSOR, Key::new("percent", 60, 125), Key::new("span_ms", 1_000, 10_000)],
    act: change_pace,
};

fn change_pace(world: &mut World, action: &Action) {
    let (sensor, share) = (world.sensor(action), action.value("percent") as f64 / 1e2);
    let set = move |world: &mut World, share: f64| {
        world.port(sensor, |tty, log, now| {
            tty.advance(now, log);
            tty.sensor.set_pace(share);
        });
    };
    set(world, share);
    world.later(action.value("span_ms"), move |world| set(world, 1.0));
}

/// Something holds the head of a scanner for a while. Scanners without a rotating head ignore the action.
pub(super) const HOLD: Kind =
    Kind { name: "hold", per_minute: 1.0, keys: &[SENSOR, Key::new("span_ms", 50, 5_000)], act: hold_head };

fn hold_head(world: &mut World, action: &Action) {
    // Whatever holds the head releases it when the world heals.
    let span = (action.value("span_ms") * MILLIS).min(world.until_healed());
    world.ail(action, Ailment::Held { span });
}

/// A scanner reports that it may fail soon, or that it does not measure. Some still report so after they have booted. Scanners
/// without a health status ignore the action.
pub(super) const UNWELL: Kind = Kind {
    name: "unwell",
    per_minute: 1.0,
    keys: &[SENSOR, Key::new("status", 1, 2), Key::new("stubborn", 0, 1), Key::new("span_ms", 100, 10_000)],
    act: fall_ill,
};

fn fall_ill(world: &mut World, action: &Action) {
    let (status, is_stubborn) = (action.value("status") as u8, action.value("stubborn") > 0);
    world.ail(action, Ailment::Unwell { status, is_stubborn });
    world.ail_later(action, Ailment::Unwell { status: 0, is_stubborn: false });
}

/// A scanner that measures ignores every request for a while, even the request to stop. Scanners without such a fault ignore
/// the action.
pub(super) const DEAF: Kind =
    Kind { name: "deaf", per_minute: 1.0, keys: &[SENSOR, Key::new("span_ms", 100, 8_000)], act: make_deaf };

fn make_deaf(world: &mut World, action: &Action) {
    world.ail(action, Ailment::Deaf(true));
    world.ail_later(action, Ailment::Deaf(false));
}

/// An object is inside a circle for a while: a post ahead of a sensor, inside the larger circle or inside both. Plans know only
/// this action from the start, because the scans are measured before.
pub(crate) const OBJECT: Kind = Kind {
    name: "object",
    per_minute: 12.0,
    keys: &[SENSOR, Key::new("near", 0, 1), Key::new("span_ms", 50, 15_000)],
    act: |_, _| (),
};

/// Returns the time spans of objects inside a circle of `sensor`, and whether each object is near. The world has this number of
/// `sensors`.
fn spans(plan: &Plan, sensor: usize, sensors: usize) -> Vec<(Nanos, Nanos, bool)> {
    let is_its = |action: &&Action| {
        action.name() == OBJECT.name && action.value("sensor") as usize % sensors == sensor
    };
    let span = |action: &Action| {
        let from = action.at_ms * MILLIS;
        (from, from + action.value("span_ms") * MILLIS, action.value("near") > 0)
    };
    plan.actions.iter().filter(is_its).map(span).collect()
}

/// Returns the time spans in which an object is inside a circle of `sensor`. Spans that overlap are joined.
pub(crate) fn objects_inside(plan: &Plan, sensor: usize, sensors: usize) -> Vec<(Nanos, Nanos)> {
    let mut joined: Vec<(Nanos, Nanos)> = Vec::new();
    for (from, until, _) in spans(plan, sensor, sensors) {
        match joined.last_mut().filter(|(_, end)| from <= *end) {
            Some((_, end)) => *end = until.max(*end),
            None => joined.push((from, until)),
        }
    }
    joined
}

/// Returns the changes of the scene of `sensor`: room 1 has the post inside the larger circle, room 2 inside both.
pub(crate) fn scene_changes(plan: &Plan, sensor: usize, sensors: usize) -> Changes {
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
