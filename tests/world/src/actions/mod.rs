//! Actions of a scenario: faults and other events. Each action has a name, keys and an effect. All kinds of actions are
//! drawn, printed and parsed in the same way. An action undoes its effect after some time, or when all faults are
//! cleared.

mod hub;
mod line;
mod network;
mod scanner;
mod subscribers;

use scanhub_schema::{Nanos, Topic};
use scanhub_sim::fault::Faults;

use crate::scenario::Action;
use crate::world::World;
pub(crate) use scanner::{objects_inside, scene_changes};

/// A kind of action.
#[derive(Debug)]
pub(crate) struct ActionKind {
    pub(crate) name: &'static str,
    /// Mean number of occurrences per minute, in a scenario that contains this kind.
    pub(crate) per_minute: f64,
    pub(crate) keys: &'static [ActionKey],
    pub(crate) act: fn(&mut World, &Action),
}

/// A key of an action, with the range from which its value is drawn.
#[derive(Debug)]
pub(crate) struct ActionKey {
    pub(crate) name: &'static str,
    pub(crate) min: u64,
    pub(crate) max: u64,
}

impl ActionKey {
    const fn new(name: &'static str, min: u64, max: u64) -> ActionKey {
        ActionKey { name, min, max }
    }
}

/// Index of the sensor that the action affects.
const SENSOR: ActionKey = ActionKey::new("sensor", 0, 1);

/// All kinds of actions, in the order in which a scenario draws them.
pub(crate) const ACTION_KINDS: &[ActionKind] = &[
    scanner::OBJECT_INSIDE,
    line::UNPLUG,
    line::REPLUG_ELSEWHERE,
    scanner::EXCHANGE,
    scanner::POWER_CYCLE,
    line::NOISE,
    line::GARBAGE,
    line::TELEGRAMS,
    line::SILENCE,
    scanner::PROTOCOL_QUIRKS,
    hub::STALL,
    hub::KILL_HUB,
    hub::END_HUB,
    hub::RELOAD,
    hub::DISK_FULL,
    hub::NO_MEMORY,
    hub::NO_DESCRIPTORS,
    line::PORT_DENIED,
    hub::WALL_STEP,
    subscribers::ATTACH,
    subscribers::ATTACH_AND_KILL,
    subscribers::STALL_SUBSCRIBER,
    subscribers::PAUSE,
    subscribers::RESYNC,
    network::NETWORK_LOSS,
    network::PARTITION,
    network::NETWORK_STALL,
    network::GATEWAY_KILLED,
    network::LISTENER_KILLED,
    scanner::HEAD_SPEED,
    network::KEY_ERRORS,
    scanner::BROWN_OUT,
    scanner::HEAD_HELD,
    scanner::UNHEALTHY,
    scanner::IGNORED_REQUESTS,
    network::ROUTER_KILLED,
    line::RATE_ALTERED,
    subscribers::ATTACH_BETWEEN_SAMPLES,
];

/// Returns whether these actions need a gateway and a listener that have a key.
pub(crate) fn have_key(actions: &[Action]) -> bool {
    actions.iter().any(|action| action.name() == network::KEY_ERRORS.name)
}

/// Returns whether these actions need two bridges and a router instead of a gateway and a listener.
pub(crate) fn are_bridges(actions: &[Action]) -> bool {
    !have_key(actions) && actions.iter().any(|action| action.name() == network::ROUTER_KILLED.name)
}

/// Returns the topics that have no permanent subscriber in a world with these actions. No invariant needs a permanent
/// subscriber on these topics.
pub(crate) fn topics_without_constant_subscriber(actions: &[Action], seed: u64) -> Vec<Topic> {
    if actions.iter().all(|action| action.name() != subscribers::ATTACH_BETWEEN_SAMPLES.name) {
        return Vec::new();
    }
    let mut random = fastrand::Rng::with_seed(seed ^ 0xA31D_0000_0000_0000);
    let topics = [Topic::Marks, Topic::Lines, Topic::Motion, Topic::Foreground, Topic::Background];
    topics.into_iter().filter(|_| random.u8(..4) > 0).collect()
}

/// Returns the line faults of `action` if it starts at `now`, or `None` if the action does not affect bytes.
pub(crate) fn faults(action: &Action, now: Nanos) -> Option<Faults> {
    let name = action.name();
    if name == line::SILENCE.name {
        return Some(line::silence_faults(action, now, Nanos::MAX));
    }
    type FaultsOfKind = (&'static ActionKind, fn(&Action) -> Faults);
    let of: [FaultsOfKind; 3] = [
        (&line::GARBAGE, line::garbage_faults),
        (&line::NOISE, line::noise_faults),
        (&line::TELEGRAMS, line::telegram_faults),
    ];
    of.into_iter().find(|(kind, _)| kind.name == name).map(|(_, faults)| faults(action))
}

impl ActionKind {
    /// Draws a value for each key. If the range is wide, the logarithm of the value is distributed uniformly.
    pub(crate) fn draw(&self, random: &mut fastrand::Rng) -> Vec<u64> {
        let value = |key: &ActionKey| match key {
            ActionKey { min: minimum, max: maximum, .. } if *maximum > 20 * (*minimum).max(1) => {
                let (low, high) = (((*minimum).max(1) as f64).ln(), (*maximum as f64).ln());
                ((low + random.f64() * (high - low)).exp() as u64).clamp(*minimum, *maximum)
            }
            ActionKey { min: minimum, max: maximum, .. } => random.u64(*minimum..=*maximum),
        };
        self.keys.iter().map(value).collect()
    }
}
