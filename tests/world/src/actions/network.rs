//! Actions on the network, and on the gateway and the listener.

use scanhub_schema::MILLIS;

use super::{ActionKey, ActionKind};
use crate::network::Faults;
use crate::remote::Forgery;
use crate::scenario::Action;
use crate::world::World;

/// Loses, duplicates, damages, delays and reorders datagrams for `span_ms`. The gateway's sockets refuse some
/// datagrams, too. The keys from `loss` to `refuse` are shares in thousandths.
pub(super) const NETWORK_LOSS: ActionKind = ActionKind {
    name: "network_loss",
    per_minute: 4.0,
    keys: &[
        ActionKey::new("loss", 0, 600),
        ActionKey::new("double", 0, 300),
        ActionKey::new("damage", 0, 200),
        ActionKey::new("refuse", 0, 200),
        ActionKey::new("delay_ms", 0, 500),
        ActionKey::new("jitter_ms", 0, 500),
        ActionKey::new("span_ms", 20, 15_000),
    ],
    act: lose_datagrams,
};

fn lose_datagrams(world: &mut World, action: &Action) {
    let share = |name| action.value(name) as f64 / 1e3;
    let faults = Faults {
        loss: share("loss"),
        duplicate: share("double"),
        damage: share("damage"),
        delay_ns: action.value("delay_ms") * MILLIS,
        jitter_ns: action.value("jitter_ms") * MILLIS,
        partition_ns: 0,
    };
    set_network_faults(world, faults, share("refuse"));
    world.schedule(action.value("span_ms"), |world| set_network_faults(world, Faults::default(), 0.0));
}

fn set_network_faults(world: &mut World, faults: Faults, refusal: f64) {
    let now = world.now();
    world.remote_machines.set_faults(faults, now);
    world.remote_machines.refusal_rate = refusal;
}

/// Cuts the network for `span_ms`.
pub(super) const PARTITION: ActionKind = ActionKind {
    name: "partition",
    per_minute: 4.0,
    keys: &[ActionKey::new("span_ms", 20, 8_000)],
    act: partition,
};

fn partition(world: &mut World, action: &Action) {
    let now = world.now();
    world.remote_machines.change_partitions(true, now);
    world.schedule(action.value("span_ms"), |world| {
        let now = world.now();
        world.remote_machines.change_partitions(false, now);
    });
}

/// Stops the process of the gateway or of the listener for `span_ms`.
pub(super) const NETWORK_STALL: ActionKind = ActionKind {
    name: "network_stall",
    per_minute: 4.0,
    keys: &[ActionKey::new("is_listener", 0, 1), ActionKey::new("span_ms", 5, 5_000)],
    act: stall_network,
};

fn stall_network(world: &mut World, action: &Action) {
    let until = world.now() + action.value("span_ms") * MILLIS;
    world.remote_machines.stall(action.value("is_listener") > 0, until);
}

/// Kills the gateway, or ends it in an orderly way. Another gateway starts after `away_ms`.
pub(super) const GATEWAY_KILLED: ActionKind = ActionKind {
    name: "gateway_killed",
    per_minute: 3.0,
    keys: &[ActionKey::new("in_order", 0, 1), ActionKey::new("away_ms", 5, 5_000)],
    act: kill_gateway,
};

fn kill_gateway(world: &mut World, action: &Action) {
    world.remote_machines.end_gateway(&world.shared, action.value("in_order") == 0);
    world.schedule(action.value("away_ms"), |world| world.remote_machines.begin_gateway(&world.shared));
}

/// Kills the listener. Another listener starts after `away_ms`.
pub(super) const LISTENER_KILLED: ActionKind = ActionKind {
    name: "listener_killed",
    per_minute: 3.0,
    keys: &[ActionKey::new("away_ms", 5, 5_000)],
    act: kill_listener,
};

fn kill_listener(world: &mut World, action: &Action) {
    world.remote_machines.kill_listener(&world.shared);
    world.schedule(action.value("away_ms"), |world| world.remote_machines.begin_listener(&world.shared));
}

/// Kills the router between two bridges. The router loses everything that it holds. Another router starts after
/// `away_ms`. A scenario with this action has bridges instead of a gateway and a listener. The exception is a scenario
/// in which another action needs a key: it has no router, and this action cuts the network instead.
pub(super) const ROUTER_KILLED: ActionKind = ActionKind {
    name: "router_killed",
    per_minute: 4.0,
    keys: &[ActionKey::new("away_ms", 5, 8_000)],
    act: kill_router,
};

fn kill_router(world: &mut World, action: &Action) {
    let now = world.now();
    world.remote_machines.kill_router(now);
    world.schedule(action.value("away_ms"), |world| world.remote_machines.begin_router(&world.shared));
}

/// Sends datagrams from a machine that does not have the key, or makes the clocks of the hub's machine and of the
/// listener's machine differ for `span_ms`. A scenario with this action has a gateway and a listener with a key.
///
/// Values of `what`: 0 no MAC, 1 another key, 2 the MAC of another datagram, 3 recorded datagrams that are sent again,
/// 4 clocks that differ.
pub(super) const KEY_ERRORS: ActionKind = ActionKind {
    name: "key_errors",
    per_minute: 6.0,
    keys: &[
        ActionKey::new("what", 0, 4),
        ActionKey::new("count", 1, 400),
        ActionKey::new("apart_s", 8, 600),
        ActionKey::new("span_ms", 20, 8_000),
    ],
    act: forge,
};

fn forge(world: &mut World, action: &Action) {
    let count = action.value("count") as usize;
    let forgery = match action.value("what") {
        0 => Forgery::Plain,
        1 => Forgery::OtherKey,
        2 => Forgery::OtherMac,
        3 => Forgery::Recording,
        _ => {
            // The clock is set back as often as forward.
            let apart_s = action.value("apart_s") as i64;
            let apart_s = if count.is_multiple_of(2) { apart_s } else { -apart_s };
            world.remote_machines.set_extra_clock_offset(apart_s * 1_000_000_000);
            return world
                .schedule(action.value("span_ms"), |world| world.remote_machines.set_extra_clock_offset(0));
        }
    };
    world.remote_machines.forge(&world.shared, forgery, count);
}
