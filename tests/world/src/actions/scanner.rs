//! Actions on a scanner and on the scene that it measures.

use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::room::Changes;

use super::{ActionKey, ActionKind, SENSOR};
use crate::event::Event;
use crate::family::ScannerFault;
use crate::scenario::{Action, Scenario};
use crate::world::World;

/// Connects another scanner to the line. The action defines the rate of the scanner, and whether the scanner is idle or
/// streams already.
pub(super) const EXCHANGE: ActionKind = ActionKind {
    name: "exchange",
    per_minute: 1.5,
    keys: &[SENSOR, ActionKey::new("rate", 0, 3), ActionKey::new("streams", 0, 1)],
    act: exchange_scanner,
};

fn exchange_scanner(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.with_port(sensor, |tty, log, now| {
        tty.advance(now, log);
        tty.sensor.exchange(action);
    });
    world.shared.log_event(&Event::ScannerExchanged { sensor });
}

/// Turns the power of a scanner off and on.
pub(super) const POWER_CYCLE: ActionKind =
    ActionKind { name: "power_cycle", per_minute: 2.0, keys: &[SENSOR], act: power_cycle };

fn power_cycle(world: &mut World, action: &Action) {
    world.with_port(world.sensor(action), |tty, log, now| {
        tty.advance(now, log);
        tty.sensor.power_cycle();
    });
}

/// Makes the voltage of a scanner dip, so that the scanner restarts.
pub(super) const BROWN_OUT: ActionKind =
    ActionKind { name: "brown_out", per_minute: 1.5, keys: &[SENSOR], act: brown_out };

fn brown_out(world: &mut World, action: &Action) {
    world.with_port(world.sensor(action), |tty, log, now| {
        tty.advance(now, log);
        tty.sensor.brown_out();
    });
}

/// Makes a scanner overlook or refuse requests, or reply twice or late, for `span_ms`. Keys that are shares are in
/// percent.
pub(super) const PROTOCOL_QUIRKS: ActionKind = ActionKind {
    name: "habits",
    per_minute: 1.5,
    keys: &[
        SENSOR,
        ActionKey::new("overlooks", 0, 50),
        ActionKey::new("naks", 0, 50),
        ActionKey::new("doubles", 0, 50),
        ActionKey::new("late_ms", 0, 1_500),
        ActionKey::new("mute", 0, 1),
        ActionKey::new("span_ms", 500, 15_000),
    ],
    act: misbehave,
};

fn misbehave(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.with_port(sensor, |tty, _, _| tty.sensor.misbehave(Some(action)));
    world.schedule(action.value("span_ms"), move |world| {
        world.with_port(sensor, |tty, _, _| tty.sensor.misbehave(None));
    });
}

/// Makes the head of a scanner rotate slower or faster for `span_ms`. The speed is given in percent of the usual speed.
/// The speed changes gradually, like the speed of a motor. Scanners without full revolutions ignore the action.
pub(super) const HEAD_SPEED: ActionKind = ActionKind {
    name: "pace",
    per_minute: 3.0,
    keys: &[SENSOR, ActionKey::new("percent", 60, 125), ActionKey::new("span_ms", 1_000, 10_000)],
    act: change_speed,
};

fn change_speed(world: &mut World, action: &Action) {
    let (sensor, share) = (world.sensor(action), action.value("percent") as f64 / 1e2);
    let set = move |world: &mut World, share: f64| {
        world.with_port(sensor, |tty, log, now| {
            tty.advance(now, log);
            tty.sensor.set_speed(share);
        });
    };
    set(world, share);
    world.schedule(action.value("span_ms"), move |world| set(world, 1.0));
}

/// Blocks the head of a scanner for `span_ms`. Scanners without a rotating head ignore the action.
pub(super) const HEAD_HELD: ActionKind = ActionKind {
    name: "hold",
    per_minute: 1.0,
    keys: &[SENSOR, ActionKey::new("span_ms", 50, 5_000)],
    act: hold_head,
};

fn hold_head(world: &mut World, action: &Action) {
    // The head must be free again when all faults are cleared, so the time is limited.
    let span = (action.value("span_ms") * MILLIS).min(world.time_until_faults_clear());
    world.inject_scanner_fault(action, ScannerFault::HeadHeld { span });
}

/// Makes a scanner report a warning (1) or an error (2) as its health status for `span_ms`. A `stubborn` scanner still
/// reports the status after it has restarted. Scanners without a health status ignore the action.
pub(super) const UNHEALTHY: ActionKind = ActionKind {
    name: "unwell",
    per_minute: 1.0,
    keys: &[
        SENSOR,
        ActionKey::new("status", 1, 2),
        ActionKey::new("stubborn", 0, 1),
        ActionKey::new("span_ms", 100, 10_000),
    ],
    act: report_unhealthy,
};

fn report_unhealthy(world: &mut World, action: &Action) {
    let (status, is_stubborn) = (action.value("status") as u8, action.value("stubborn") > 0);
    world.inject_scanner_fault(action, ScannerFault::Unhealthy { status, is_stubborn });
    world.inject_scanner_fault_later(action, ScannerFault::Unhealthy { status: 0, is_stubborn: false });
}

/// Makes a scanner ignore every request while it measures, even the request to stop, for `span_ms`. Scanners without
/// this fault ignore the action.
pub(super) const IGNORED_REQUESTS: ActionKind = ActionKind {
    name: "deaf",
    per_minute: 1.0,
    keys: &[SENSOR, ActionKey::new("span_ms", 100, 8_000)],
    act: ignore_requests,
};

fn ignore_requests(world: &mut World, action: &Action) {
    world.inject_scanner_fault(action, ScannerFault::IgnoresRequests(true));
    world.inject_scanner_fault_later(action, ScannerFault::IgnoresRequests(false));
}

/// Puts a post ahead of a sensor for `span_ms`, inside the larger zone or inside both zones. A scanner receives all
/// changes of its scene when the world starts, so the effect of the action is empty.
pub(crate) const OBJECT_INSIDE: ActionKind = ActionKind {
    name: "object",
    per_minute: 12.0,
    keys: &[SENSOR, ActionKey::new("near", 0, 1), ActionKey::new("span_ms", 50, 15_000)],
    act: |_, _| (),
};

/// Returns the time spans in which an object is inside a zone of `sensor`, and for each span whether the object is in
/// both zones. The world has `sensors` sensors.
fn object_spans(scenario: &Scenario, sensor: usize, sensors: usize) -> Vec<(Nanos, Nanos, bool)> {
    let is_its = |action: &&Action| {
        action.name() == OBJECT_INSIDE.name && action.value("sensor") as usize % sensors == sensor
    };
    let span = |action: &Action| {
        let from = action.at_ms * MILLIS;
        (from, from + action.value("span_ms") * MILLIS, action.value("near") > 0)
    };
    scenario.actions.iter().filter(is_its).map(span).collect()
}

/// Returns the time spans in which an object is inside a zone of `sensor`. Spans that overlap are joined.
pub(crate) fn objects_inside(scenario: &Scenario, sensor: usize, sensors: usize) -> Vec<(Nanos, Nanos)> {
    let mut joined: Vec<(Nanos, Nanos)> = Vec::new();
    for (from, until, _) in object_spans(scenario, sensor, sensors) {
        match joined.last_mut().filter(|(_, end)| from <= *end) {
            Some((_, end)) => *end = until.max(*end),
            None => joined.push((from, until)),
        }
    }
    joined
}

/// Returns the changes of the scene of `sensor`. Room 0 has no post. In room 1, the post is inside the larger zone, and
/// in room 2, it is inside both zones.
pub(crate) fn scene_changes(scenario: &Scenario, sensor: usize, sensors: usize) -> Changes {
    let spans = object_spans(scenario, sensor, sensors);
    let mut times: Vec<Nanos> = spans.iter().flat_map(|&(from, until, _)| [from, until]).collect();
    times.sort_unstable();
    times.dedup();
    let room = |time: Nanos| {
        let there = spans.iter().filter(|&&(from, until, _)| from <= time && time < until);
        there.map(|&(.., is_near)| 1 + usize::from(is_near)).max().unwrap_or(0)
    };
    Changes::new(times.into_iter().map(|time| (time, room(time))).collect())
}
