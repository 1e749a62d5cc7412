//! Consumers come late and leave, are killed while they hold samples, and stop for a while.

use scanhub_schema::{MILLIS, Topic};

use super::{Key, Kind, SENSOR};
use crate::consumer::Habit;
use crate::plan::Action;
use crate::world::World;

const TOPIC: Key = Key::new("topic", 0, 6);
const HOLDS: Key = Key::new("holds", 0, 4);

pub(crate) const COMES: Kind = Kind {
    name: "consumer_comes",
    per_minute: 6.0,
    keys: &[SENSOR, TOPIC, HOLDS, Key::new("every_ms", 0, 500), Key::new("span_ms", 10, 20_000)],
    act: |world, action| come(world, action, false),
};

pub(crate) const KILLED: Kind = Kind {
    name: "consumer_killed",
    per_minute: 6.0,
    keys: &[SENSOR, TOPIC, HOLDS, Key::new("every_ms", 0, 500), Key::new("span_ms", 10, 20_000)],
    act: |world, action| come(world, action, true),
};

pub(crate) const STOPS: Kind = Kind {
    name: "consumer_stops",
    per_minute: 6.0,
    keys: &[Key::new("which", 0, 1_000), Key::new("span_ms", 10, 10_000)],
    act: stop,
};

/// One that looks every 0 ms is a prompt one.
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

/// Prompt ones always run.
fn stop(world: &mut World, action: &Action) {
    let until = world.now() + action.value("span_ms") * MILLIS;
    let mut slow: Vec<_> = world.consumers.iter_mut().filter(|consumer| !consumer.is_prompt()).collect();
    let which = action.value("which") as usize % slow.len().max(1);
    if let Some(consumer) = slow.get_mut(which) {
        consumer.stop(&world.shared, until);
    }
}
