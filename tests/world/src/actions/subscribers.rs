//! Actions of subscribers and users. Subscribers attach late and leave, are killed while they hold samples, and stop
//! for a while. Users send requests to a link.

use scanhub_schema::{MILLIS, Topic, Verb};

use super::{ActionKey, ActionKind, SENSOR};
use crate::scenario::Action;
use crate::shared::{ChangeKind, SubscriberChange};
use crate::subscriber::Behavior;
use crate::world::World;

const TOPIC: ActionKey = ActionKey::new("topic", 0, 6);
/// All topics of a link.
const ANY_TOPIC: ActionKey = ActionKey::new("topic", 0, Topic::OF_LINKS.len() as u64 - 1);
const HELD_SAMPLES: ActionKey = ActionKey::new("holds", 0, 4);

/// Attaches a subscriber, which leaves after `span_ms`.
pub(super) const ATTACH: ActionKind = ActionKind {
    name: "consumer_comes",
    per_minute: 6.0,
    keys: &[
        SENSOR,
        TOPIC,
        HELD_SAMPLES,
        ActionKey::new("every_ms", 0, 500),
        ActionKey::new("span_ms", 10, 20_000),
    ],
    act: |world, action| attach_subscriber(world, action, false),
};

/// Attaches a subscriber, which is killed after `span_ms`.
pub(super) const ATTACH_AND_KILL: ActionKind = ActionKind {
    name: "consumer_killed",
    per_minute: 6.0,
    keys: &[
        SENSOR,
        TOPIC,
        HELD_SAMPLES,
        ActionKey::new("every_ms", 0, 500),
        ActionKey::new("span_ms", 10, 20_000),
    ],
    act: |world, action| attach_subscriber(world, action, true),
};

/// Attaches a subscriber between two samples of a scan. The subscriber leaves between two samples of a later scan. In a
/// world with such actions, some topics have no other subscribers.
pub(super) const ATTACH_BETWEEN_SAMPLES: ActionKind = ActionKind {
    name: "consumer_amid",
    per_minute: 20.0,
    keys: &[
        SENSOR,
        ANY_TOPIC,
        ActionKey::new("habit", 0, 3),
        ActionKey::new("holds", 0, 4),
        ActionKey::new("sends", 0, 12),
        ActionKey::new("span_ms", 10, 20_000),
    ],
    act: attach_between_samples,
};

fn attach_between_samples(world: &mut World, action: &Action) {
    let topic = Topic::OF_LINKS[action.value("topic") as usize % Topic::OF_LINKS.len()];
    let behavior = match action.value("habit") {
        0 => Behavior::Slow { every_ms: 50 },
        1 => Behavior::Listener,
        _ => Behavior::Prompt,
    };
    let (holds, span_ms) = (action.value("holds") as usize, action.value("span_ms"));
    let what = ChangeKind::Attach { topic, behavior, max_held: holds, span_ms };
    let change =
        SubscriberChange { sensor: world.sensor(action), after_sends: action.value("sends"), kind: what };
    world.shared.changes.borrow_mut().push(change);
}

/// Stops a subscriber for `span_ms`.
pub(super) const STALL_SUBSCRIBER: ActionKind = ActionKind {
    name: "consumer_stops",
    per_minute: 6.0,
    keys: &[ActionKey::new("which", 0, 1_000), ActionKey::new("span_ms", 10, 10_000)],
    act: stall_subscriber,
};

/// Attaches a subscriber. The subscriber is prompt if `every_ms` is 0 or 1.
fn attach_subscriber(world: &mut World, action: &Action, is_killed: bool) {
    let topic = Topic::OF_LINKS[action.value("topic") as usize % Topic::OF_LINKS.len()];
    let behavior = match action.value("every_ms") {
        0 | 1 => Behavior::Prompt,
        every_ms => Behavior::Slow { every_ms },
    };
    let holds = action.value("holds") as usize;
    if let Some(number) = world.attach(world.sensor(action), topic, behavior, holds) {
        world.schedule(action.value("span_ms"), move |world| world.detach(number, is_killed));
    }
}

/// Stops one of the subscribers that are not prompt. The subscriber continues at the end of the action.
fn stall_subscriber(world: &mut World, action: &Action) {
    let until = world.now() + action.value("span_ms") * MILLIS;
    let mut slow: Vec<_> =
        world.subscribers.iter_mut().filter(|subscriber| !subscriber.is_prompt()).collect();
    let which = action.value("which") as usize % slow.len().max(1);
    if let Some(subscriber) = slow.get_mut(which) {
        subscriber.stall(&world.shared, until);
    }
}

/// Pauses a sensor, and resumes it after `span_ms`.
pub(super) const PAUSE: ActionKind = ActionKind {
    name: "pause",
    per_minute: 2.0,
    keys: &[SENSOR, ActionKey::new("span_ms", 10, 6_000)],
    act: pause_sensor,
};

fn pause_sensor(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.hub_requests.sensor_requests.push((sensor, Verb::Pause));
    world.schedule(action.value("span_ms"), move |world| {
        world.hub_requests.sensor_requests.push((sensor, Verb::Resume))
    });
}

/// Restarts the session of a link, or resets, freezes, thaws or publishes its background.
pub(super) const RESYNC: ActionKind = ActionKind {
    name: "resync",
    per_minute: 3.0,
    keys: &[SENSOR, ActionKey::new("verb", 0, 4)],
    act: send_request,
};

fn send_request(world: &mut World, action: &Action) {
    let verbs = [Verb::Resync, Verb::Reset, Verb::Freeze, Verb::Thaw, Verb::Show];
    let verb = verbs[action.value("verb") as usize % verbs.len()];
    world.hub_requests.sensor_requests.push((world.sensor(action), verb));
}
