//! What can go wrong: one file for each kind, with its name, its keys and what it does. A plan draws, prints and parses all of
//! them alike. What an action breaks it mends itself after a while, or when everything is made well again.

mod altered;
mod brown_out;
mod consumers;
mod deaf;
mod denied;
mod disk_full;
mod end_hub;
mod exchange;
mod garbage;
mod gateway_killed;
mod hold;
mod key_errors;
mod kill_hub;
mod listener_killed;
mod network_loss;
mod network_stall;
mod no_descriptors;
mod no_memory;
mod noise;
pub(crate) mod object;
mod pace;
mod partition;
mod pause;
mod power_cycle;
mod quirks;
mod reload;
mod replug_elsewhere;
mod resync;
mod router_killed;
mod silence;
mod stall;
mod telegrams;
mod unplug;
mod unwell;
mod wall_step;

use scanhub_schema::Nanos;
use scanhub_sim::fault::Faults;

use crate::plan::Action;
use crate::world::World;

/// A kind of action.
#[derive(Debug)]
pub(crate) struct Kind {
    pub(crate) name: &'static str,
    /// How often it happens in a world in which it does.
    pub(crate) per_minute: f64,
    pub(crate) keys: &'static [Key],
    pub(crate) act: fn(&mut World, &Action),
}

/// A key of an action, and between which values it is drawn.
#[derive(Debug)]
pub(crate) struct Key {
    pub(crate) name: &'static str,
    pub(crate) least: u64,
    pub(crate) most: u64,
}

impl Key {
    const fn new(name: &'static str, least: u64, most: u64) -> Key {
        Key { name, least, most }
    }
}

/// The sensor that it happens to.
const SENSOR: Key = Key::new("sensor", 0, 1);

/// All kinds. Their order is the order in which they are drawn.
pub(crate) const KINDS: &[Kind] = &[
    object::KIND,
    unplug::KIND,
    replug_elsewhere::KIND,
    exchange::KIND,
    power_cycle::KIND,
    noise::KIND,
    garbage::KIND,
    telegrams::KIND,
    silence::KIND,
    quirks::KIND,
    stall::KIND,
    kill_hub::KIND,
    end_hub::KIND,
    reload::KIND,
    disk_full::KIND,
    no_memory::KIND,
    no_descriptors::KIND,
    denied::KIND,
    wall_step::KIND,
    consumers::COMES,
    consumers::KILLED,
    consumers::STOPS,
    pause::KIND,
    resync::KIND,
    network_loss::KIND,
    partition::KIND,
    network_stall::KIND,
    gateway_killed::KIND,
    listener_killed::KIND,
    pace::KIND,
    key_errors::KIND,
    brown_out::KIND,
    hold::KIND,
    unwell::KIND,
    deaf::KIND,
    router_killed::KIND,
    altered::KIND,
];

/// Gateway and listener of a world with these actions have a key.
pub(crate) fn have_key(actions: &[Action]) -> bool {
    actions.iter().any(|action| action.name() == key_errors::KIND.name)
}

/// Gateway and listener of a world with these actions are bridges, and a router is between them.
pub(crate) fn are_bridges(actions: &[Action]) -> bool {
    !have_key(actions) && actions.iter().any(|action| action.name() == router_killed::KIND.name)
}

/// What `action` does to the bytes on a line from `now` on, if it is of such a kind.
pub(crate) fn faults(action: &Action, now: Nanos) -> Option<Faults> {
    let name = action.name();
    if name == silence::KIND.name {
        return Some(silence::faults(action, now, Nanos::MAX));
    }
    type Of = (&'static Kind, fn(&Action) -> Faults);
    let of: [Of; 3] = [
        (&garbage::KIND, garbage::faults),
        (&noise::KIND, noise::faults),
        (&telegrams::KIND, telegrams::faults),
    ];
    of.into_iter().find(|(kind, _)| kind.name == name).map(|(_, faults)| faults(action))
}

impl Kind {
    /// Values for its keys: small ones as often as great ones where the range is wide.
    pub(crate) fn draw(&self, random: &mut fastrand::Rng) -> Vec<u64> {
        let value = |key: &Key| match key {
            Key { least, most, .. } if *most > 20 * (*least).max(1) => {
                let (low, high) = (((*least).max(1) as f64).ln(), (*most as f64).ln());
                ((low + random.f64() * (high - low)).exp() as u64).clamp(*least, *most)
            }
            Key { least, most, .. } => random.u64(*least..=*most),
        };
        self.keys.iter().map(value).collect()
    }
}
