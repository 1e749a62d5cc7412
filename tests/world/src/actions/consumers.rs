//! Actions of subscribers and users: subscribers come late and leave, are killed while they hold samples, and stop for a while.
//! Users send requests to a link.

use scanhub_schema::{MILLIS, Topic, Verb};

use super::{Key, Kind, SENSOR};
use crate::consumer::Habit;
use crate::plan::Action;
use crate::shared::{Change, Who};
use crate::world::World;

const TOPIC: Key = Key::new("topic", 0, 6);
/// All topics of a link.
const ANY_TOPIC: Key = Key::new("topic", 0, Topic::OF_LINKS.len() as u64 - 1);
const HOLDS: Key = Key::new("holds", 0, 4);

/// A subscriber attaches, and leaves after a while.
pub(super) const COMES: Kind = Kind {
    name: "consumer_comes",
    per_minute: 6.0,
    keys: &[SENSOR, TOPIC, HOLDS, Key::new("every_ms", 0, 500), Key::new("span_ms", 10, 20_000)],
    act: |world, action| come(world, action, false),
};

/// A subscriber attaches, and is killed after a while.
pub(super) const KILLED: Kind = Kind {
    name: "consumer_killed",
    per_minute: 6.0,
    keys: &[SENSOR, TOPIC, HOLDS, Key::new("every_ms", 0, 500), Key::new("span_ms", 10, 20_000)],
    act: |world, action| come(world, action, true),
};

/// A subscriber attaches between two samples of a scan, and leaves between two others. In a world with such actions, some
/// topics have no other subscribers.
pub(super) const AMID: Kind = Kind {
    name: "consumer_amid",
    per_minute: 20.0,
    keys: &[
        SENSOR,
        ANY_TOPIC,
        Key::new("habit", 0, 3),
        Key::new("holds", 0, 4),
        Key::new("sends", 0, 12),
        Key::new("span_ms", 10, 20_000),
    ],
    act: come_amid,
};

fn come_amid(world: &mut World, action: &Action) {
    let topic = Topic::OF_LINKS[action.value("topic") as usize % Topic::OF_LINKS.len()];
    let habit = match action.value("habit") {
        0 => Habit::Slow { every_ms: 50 },
        1 => Habit::Listener,
        _ => Habit::Prompt,
    };
    let (holds, span_ms) = (action.value("holds") as usize, action.value("span_ms"));
    let what = Who::Comes { topic, habit, holds, span_ms };
    let change = Change { sensor: world.sensor(action), sends: action.value("sends"), what };
    world.shared.changes.borrow_mut().push(change);
}

/// A subscriber does not run for a while.
pub(super) const STOPS: Kind = Kind {
    name: "consumer_stops",
    per_minute: 6.0,
    keys: &[Key::new("which", 0, 1_000), Key::new("span_ms", 10, 10_000)],
    act: stop,
};

/// Attaches a subscriber. One that polls every 0 ms is prompt.
fn come(world: &mut World, action: &Action, is_killed: bool) {
    let topic = Topic::OF_LINKS[action.value("topic") as usize % Topic::OF_LINKS.len()];
    let habit = match action.value("every_ms") {
        0 | 1 => Habit::Prompt,
        every_ms => Habit::Slow { every_ms },
    };
    let holds = action.value("holds") as usize;
    if let Some(number) = world.attach(world.sensor(action), topic, habit, holds) {
        world.later(action.value("span_ms"), move |world| world.detach(number, is_killed));
    }
}

/// Stops a subscriber that is not prompt.
fn stop(world: &mut World, action: &Action) {
    let until = world.now() + action.value("span_ms") * MILLIS;
    let mut slow: Vec<_> = world.consumers.iter_mut().filter(|consumer| !consumer.is_prompt()).collect();
    let which = action.value("which") as usize % slow.len().max(1);
    if let Some(consumer) = slow.get_mut(which) {
        consumer.stop(&world.shared, until);
    }
}

/// A user pauses a sensor, and resumes it.
pub(super) const PAUSE: Kind = Kind {
    name: "pause",
    per_minute: 2.0,
    keys: &[SENSOR, Key::new("span_ms", 10, 6_000)],
    act: pause_sensor,
};

fn pause_sensor(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.wants.asks.push((sensor, Verb::Pause));
    world.later(action.value("span_ms"), move |world| world.wants.asks.push((sensor, Verb::Resume)));
}

/// A user restarts the session of a link, or resets, freezes, thaws or shows its background.
pub(super) const RESYNC: Kind =
    Kind { name: "resync", per_minute: 3.0, keys: &[SENSOR, Key::new("verb", 0, 4)], act: ask_link };

fn ask_link(world: &mut World, action: &Action) {
    let verbs = [Verb::Resync, Verb::Reset, Verb::Freeze, Verb::Thaw, Verb::Show];
    let verb = verbs[action.value("verb") as usize % verbs.len()];
    world.wants.asks.push((world.sensor(action), verb));
}
