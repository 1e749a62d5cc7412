//! The network loses, doubles, damages, delays and reorders datagrams for a while, and the gateway's sockets refuse some.

use scanhub_schema::MILLIS;

use super::{Key, Kind};
use crate::network::Faults;
use crate::plan::Action;
use crate::world::World;

/// Shares are in a thousandth.
pub(crate) const KIND: Kind = Kind {
    name: "network_loss",
    per_minute: 4.0,
    keys: &[
        Key::new("loss", 0, 600),
        Key::new("double", 0, 300),
        Key::new("damage", 0, 200),
        Key::new("refuse", 0, 200),
        Key::new("delay_ms", 0, 500),
        Key::new("jitter_ms", 0, 500),
        Key::new("span_ms", 20, 15_000),
    ],
    act,
};

fn act(world: &mut World, action: &Action) {
    let share = |name| action.value(name) as f64 / 1e3;
    let faults = Faults {
        loss: share("loss"),
        duplicate: share("double"),
        damage: share("damage"),
        delay_ns: action.value("delay_ms") * MILLIS,
        jitter_ns: action.value("jitter_ms") * MILLIS,
        partition_ns: 0,
    };
    set(world, faults, share("refuse"));
    world.later(action.value("span_ms"), |world| set(world, Faults::default(), 0.0));
}

fn set(world: &mut World, faults: Faults, refusal: f64) {
    let now = world.now();
    world.remote.set_faults(faults, now);
    world.remote.refusal = refusal;
}
