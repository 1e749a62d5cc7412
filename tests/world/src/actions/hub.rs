//! Actions on the hub's process and its host: exit, resources, configuration and clock.

use scanhub_schema::MILLIS;

use super::{ActionKey, ActionKind};
use crate::event::Event;
use crate::scenario::Action;
use crate::world::{HubEnding, World};

/// Kills the hub. Another hub starts after `away_ms`.
pub(super) const KILL_HUB: ActionKind = ActionKind {
    name: "kill_hub",
    per_minute: 3.0,
    keys: &[ActionKey::new("away_ms", 20, 4_000)],
    act: |world, action| end_hub(world, action, true),
};

/// Ends the hub in an orderly way. Another hub starts after `away_ms`.
pub(super) const END_HUB: ActionKind = ActionKind {
    name: "end_hub",
    per_minute: 1.5,
    keys: &[ActionKey::new("away_ms", 20, 4_000)],
    act: |world, action| end_hub(world, action, false),
};

fn end_hub(world: &mut World, action: &Action, is_killed: bool) {
    let back_at = world.now() + action.value("away_ms") * MILLIS;
    world.hub_requests.ending = Some(HubEnding { is_killed, restart_at: back_at });
}

/// Stops the hub's process for `span_ms`.
pub(super) const STALL: ActionKind = ActionKind {
    name: "stall",
    per_minute: 4.0,
    keys: &[ActionKey::new("span_ms", 5, 5_000)],
    act: stall_hub,
};

fn stall_hub(world: &mut World, action: &Action) {
    let until = world.now() + action.value("span_ms") * MILLIS;
    world.stalled_until = world.stalled_until.max(until);
    world.shared.log_event(&Event::Stalled { until: world.stalled_until });
}

/// Changes the configuration to a valid or an invalid one, and requests that the hub reload it.
pub(super) const RELOAD: ActionKind = ActionKind {
    name: "reload",
    per_minute: 4.0,
    keys: &[ActionKey::new("edition", 0, 2)],
    act: reload_configuration,
};

fn reload_configuration(world: &mut World, action: &Action) {
    world.edition.set(action.value("edition"));
    world.hub_requests.reload = true;
}

/// Fills the disk for `span_ms`.
pub(super) const DISK_FULL: ActionKind = ActionKind {
    name: "disk_full",
    per_minute: 2.0,
    keys: &[ActionKey::new("span_ms", 100, 20_000)],
    act: fill_disk,
};

fn fill_disk(world: &mut World, action: &Action) {
    world.shared.disk_is_full.set(true);
    world.schedule(action.value("span_ms"), |world| world.shared.disk_is_full.set(false));
}

/// Makes every attempt of the hub to get memory for a sample fail for `span_ms`.
pub(super) const NO_MEMORY: ActionKind = ActionKind {
    name: "no_memory",
    per_minute: 2.0,
    keys: &[ActionKey::new("span_ms", 5, 3_000)],
    act: exhaust_memory,
};

fn exhaust_memory(world: &mut World, action: &Action) {
    world.shared.topics.borrow_mut().lacks_memory = true;
    world.schedule(action.value("span_ms"), |world| world.shared.topics.borrow_mut().lacks_memory = false);
}

/// Makes the hub run out of file descriptors for `span_ms`.
pub(super) const NO_DESCRIPTORS: ActionKind = ActionKind {
    name: "no_descriptors",
    per_minute: 2.0,
    keys: &[ActionKey::new("span_ms", 100, 5_000)],
    act: exhaust_descriptors,
};

fn exhaust_descriptors(world: &mut World, action: &Action) {
    world.shared.lacks_descriptors.set(true);
    world.schedule(action.value("span_ms"), |world| world.shared.lacks_descriptors.set(false));
}

/// Sets the wall clock forward or back.
pub(super) const WALL_STEP: ActionKind = ActionKind {
    name: "wall_step",
    per_minute: 2.0,
    keys: &[ActionKey::new("is_back", 0, 1), ActionKey::new("seconds", 1, 1_000_000)],
    act: step_wall_clock,
};

fn step_wall_clock(world: &mut World, action: &Action) {
    let (ahead, by) = (&world.shared.wall_offset, action.value("seconds") * 1_000_000_000);
    ahead.set(if action.value("is_back") > 0 { ahead.get() - by } else { ahead.get() + by });
}
