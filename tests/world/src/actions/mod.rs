//! Actions of a plan: faults and events, each with its name, its keys and its effect. A plan draws, prints and parses all
//! actions alike. An action undoes its effect after a while, or when the world heals.

mod consumers;
mod hub;
mod line;
mod network;
mod scanner;

use scanhub_schema::{Nanos, Topic};
use scanhub_sim::fault::Faults;

use crate::plan::Action;
use crate::world::World;
pub(crate) use scanner::{objects_inside, scene_changes};

/// A kind of action.
#[derive(Debug)]
pub(crate) struct Kind {
    pub(crate) name: &'static str,
    /// Number of occurrences per minute in a world that has it.
    pub(crate) per_minute: f64,
    pub(crate) keys: &'static [Key],
    pub(crate) act: fn(&mut World, &Action),
}

/// A key of an action, and the range of its drawn values.
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

/// Number of the sensor that the action affects.
const SENSOR: Key = Key::new("sensor", 0, 1);

/// All kinds, in the order in which plans draw them.
pub(crate) const KINDS: &[Kind] = &[
    scanner::OBJECT,
    line::UNPLUG,
    line::REPLUG_ELSEWHERE,
    scanner::EXCHANGE,
    scanner::POWER_CYCLE,
    line::NOISE,
    line::GARBAGE,
    line::TELEGRAMS,
    line::SILENCE,
    scanner::HABITS,
    hub::STALL,
    hub::KILL_HUB,
    hub::END_HUB,
    hub::RELOAD,
    hub::DISK_FULL,
    hub::NO_MEMORY,
    hub::NO_DESCRIPTORS,
    line::DENIED,
    hub::WALL_STEP,
    consumers::COMES,
    consumers::KILLED,
    consumers::STOPS,
    consumers::PAUSE,
    consumers::RESYNC,
    network::NETWORK_LOSS,
    network::PARTITION,
    network::NETWORK_STALL,
    network::GATEWAY_KILLED,
    network::LISTENER_KILLED,
    scanner::PACE,
    network::KEY_ERRORS,
    scanner::BROWN_OUT,
    scanner::HOLD,
    scanner::UNWELL,
    scanner::DEAF,
    network::ROUTER_KILLED,
    line::ALTERED,
    consumers::AMID,
];

/// Returns whether gateway and listener of a world with these actions have a key.
pub(crate) fn have_key(actions: &[Action]) -> bool {
    actions.iter().any(|action| action.name() == network::KEY_ERRORS.name)
}

/// Returns whether gateway and listener of a world with these actions are bridges with a router between them.
pub(crate) fn are_bridges(actions: &[Action]) -> bool {
    !have_key(actions) && actions.iter().any(|action| action.name() == network::ROUTER_KILLED.name)
}

/// Returns the topics that lose their constant subscribers in a world with these actions. No judge needs them.
pub(crate) fn lonely_topics(actions: &[Action], seed: u64) -> Vec<Topic> {
    if actions.iter().all(|action| action.name() != consumers::AMID.name) {
        return Vec::new();
    }
    let mut random = fastrand::Rng::with_seed(seed ^ 0xA31D_0000_0000_0000);
    let topics = [Topic::Marks, Topic::Lines, Topic::Motion, Topic::Foreground, Topic::Background];
    topics.into_iter().filter(|_| random.u8(..4) > 0).collect()
}

/// Returns the faults that `action` causes on its line from `now` on, if it affects bytes.
pub(crate) fn faults(action: &Action, now: Nanos) -> Option<Faults> {
    let name = action.name();
    if name == line::SILENCE.name {
        return Some(line::silence_faults(action, now, Nanos::MAX));
    }
    type Of = (&'static Kind, fn(&Action) -> Faults);
    let of: [Of; 3] = [
        (&line::GARBAGE, line::garbage_faults),
        (&line::NOISE, line::noise_faults),
        (&line::TELEGRAMS, line::telegram_faults),
    ];
    of.into_iter().find(|(kind, _)| kind.name == name).map(|(_, faults)| faults(action))
}

impl Kind {
    /// Draws values for the keys. Where a range is wide, their logarithms are evenly distributed.
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
