//! Actions on the line and its port: damaged bytes and telegrams, and ports that are unplugged, cannot be opened or are
//! set to another rate.

use scanhub_port::PortError;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::fault::Faults;

use super::{ActionKey, ActionKind, SENSOR};
use crate::scenario::Action;
use crate::world::World;

/// Loses, flips, inserts and duplicates bytes on the line for `span_ms`. The keys `loss`, `flip`, `insert` and `double`
/// are shares in units of 1e-5.
pub(super) const NOISE: ActionKind = ActionKind {
    name: "noise",
    per_minute: 3.0,
    keys: &[
        SENSOR,
        ActionKey::new("loss", 0, 1_000),
        ActionKey::new("flip", 0, 1_000),
        ActionKey::new("insert", 0, 500),
        ActionKey::new("double", 0, 500),
        ActionKey::new("burst", 1, 40),
        ActionKey::new("span_ms", 20, 10_000),
    ],
    act: add_noise,
};

fn add_noise(world: &mut World, action: &Action) {
    world.inject_line_fault(action, &noise_faults(action));
}

/// Returns the line faults of a `noise` action.
pub(super) fn noise_faults(action: &Action) -> Faults {
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

/// Inserts floods of random bytes and long runs of start bytes into the line for `span_ms`.
pub(super) const GARBAGE: ActionKind = ActionKind {
    name: "garbage",
    per_minute: 3.0,
    keys: &[
        SENSOR,
        ActionKey::new("flood", 0, 3_000),
        ActionKey::new("wall", 0, 3_000),
        ActionKey::new("every_ms", 20, 2_000),
        ActionKey::new("span_ms", 20, 6_000),
    ],
    act: add_garbage,
};

fn add_garbage(world: &mut World, action: &Action) {
    world.inject_line_fault(action, &garbage_faults(action));
}

/// Returns the line faults of a `garbage` action.
pub(super) fn garbage_faults(action: &Action) -> Faults {
    let every = action.value("every_ms") as f64 / 1e3;
    let (flood, wall) = (action.value("flood") as f64, action.value("wall") as f64);
    Faults { flood, flood_every: every, wall, wall_every: every, ..Faults::default() }
}

/// Damages whole telegrams for `span_ms`: the line truncates them, changes their length fields or duplicates them, or
/// the scanner aborts them. The keys from `truncate` to `abort` are shares in percent.
pub(super) const TELEGRAMS: ActionKind = ActionKind {
    name: "telegrams",
    per_minute: 3.0,
    keys: &[
        SENSOR,
        ActionKey::new("truncate", 0, 30),
        ActionKey::new("length", 0, 30),
        ActionKey::new("repeat", 0, 30),
        ActionKey::new("abort", 0, 30),
        ActionKey::new("span_ms", 20, 10_000),
    ],
    act: damage_telegrams,
};

fn damage_telegrams(world: &mut World, action: &Action) {
    world.inject_line_fault(action, &telegram_faults(action));
}

/// Returns the line faults of a `telegrams` action.
pub(super) fn telegram_faults(action: &Action) -> Faults {
    let share = |name| action.value(name) as f64 / 1e2;
    Faults {
        truncate: share("truncate"),
        length: share("length"),
        repeat: share("repeat"),
        abort: share("abort"),
        ..Faults::default()
    }
}

/// Drops all bytes on the line for `span_ms`, or holds them back until the end of this time.
pub(super) const SILENCE: ActionKind = ActionKind {
    name: "silence",
    per_minute: 4.0,
    keys: &[SENSOR, ActionKey::new("is_late", 0, 1), ActionKey::new("span_ms", 20, 4_000)],
    act: silence_line,
};

fn silence_line(world: &mut World, action: &Action) {
    // Without the limit, the line would still hold back bytes after all faults are cleared.
    let faults = silence_faults(action, world.now(), world.time_until_faults_clear());
    world.inject_line_fault(action, &faults);
}

/// Returns the line faults of a `silence` action that starts at `now`. The faults last for at most `max_span`.
pub(super) fn silence_faults(action: &Action, now: Nanos, max_span: Nanos) -> Faults {
    let span = (action.value("span_ms") * MILLIS).min(max_span) as f64 / 1e9;
    let at = now as f64 / 1e9 + 1e-3;
    match action.value("is_late") {
        0 => Faults { silence: span, silence_at: at, ..Faults::default() },
        _ => Faults { stall: span, stall_at: at, ..Faults::default() },
    }
}

/// Unplugs the adapter, and plugs it in again after `span_ms`.
pub(super) const UNPLUG: ActionKind = ActionKind {
    name: "unplug",
    per_minute: 3.0,
    keys: &[SENSOR, ActionKey::new("span_ms", 1, 6_000)],
    act: unplug,
};

fn unplug(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.with_port(sensor, |tty, log, now| tty.unplug(log, now));
    world.schedule(action.value("span_ms"), move |world| {
        world.with_port(sensor, |tty, log, now| tty.plug(false, log, now));
    });
}

/// Unplugs the adapter, and plugs it in again under another name. After `span_ms`, the adapter gets its own name back.
pub(super) const REPLUG_ELSEWHERE: ActionKind = ActionKind {
    name: "replug_elsewhere",
    per_minute: 1.5,
    keys: &[SENSOR, ActionKey::new("out_ms", 1, 1_000), ActionKey::new("span_ms", 100, 6_000)],
    act: replug_elsewhere,
};

fn replug_elsewhere(world: &mut World, action: &Action) {
    let (sensor, span_ms) = (world.sensor(action), action.value("span_ms"));
    world.with_port(sensor, |tty, log, now| tty.unplug(log, now));
    world.schedule(action.value("out_ms"), move |world| {
        world.with_port(sensor, |tty, log, now| tty.plug(true, log, now));
        world.schedule(span_ms, move |world| {
            world.with_port(sensor, |tty, log, now| {
                tty.unplug(log, now);
                tty.plug(false, log, now);
            });
        });
    });
}

/// Makes the hub's attempts to open the port fail for `span_ms`. The reason is that the hub has no permission, that
/// another program has the port open, or that the driver rejects the rate.
pub(super) const PORT_DENIED: ActionKind = ActionKind {
    name: "denied",
    per_minute: 2.0,
    keys: &[SENSOR, ActionKey::new("reason", 0, 2), ActionKey::new("span_ms", 100, 5_000)],
    act: deny_port,
};

fn deny_port(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    let error = match action.value("reason") {
        0 => PortError::PermissionDenied,
        1 => PortError::Busy,
        _ => PortError::Rate { requested: 500_000, actual: 115_200 },
    };
    world.with_port(sensor, |tty, _, _| tty.open_error = Some(error));
    world.schedule(action.value("span_ms"), move |world| {
        world.with_port(sensor, |tty, _, _| tty.open_error = None);
    });
}

/// Sets the port to another rate, as a process that opened the port before the hub could do.
pub(super) const RATE_ALTERED: ActionKind = ActionKind {
    name: "altered",
    per_minute: 2.0,
    keys: &[SENSOR, ActionKey::new("rate", 0, 4)],
    act: alter_rate,
};

fn alter_rate(world: &mut World, action: &Action) {
    let rate = ALTERED_RATES[action.value("rate") as usize];
    let sensor = world.sensor(action);
    world.with_port(sensor, |tty, log, now| tty.alter(rate, log, now));
}

/// Rates to which the action `altered` sets a port, in bits per second. Programs often use these rates.
const ALTERED_RATES: [u32; 5] = [9_600, 38_400, 57_600, 115_200, 500_000];
