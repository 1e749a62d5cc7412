//! A sensor behaves badly for a while: it overlooks requests, refuses them, answers twice or late.

use lms::MILLIS;
use sim::machine::Habits;

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

/// Shares are in percent.
pub(crate) const KIND: Kind = Kind {
    name: "habits",
    per_minute: 1.5,
    keys: &[
        SENSOR,
        Key::new("overlooks", 0, 50),
        Key::new("naks", 0, 50),
        Key::new("doubles", 0, 50),
        Key::new("late_ms", 0, 1_500),
        Key::new("mute", 0, 1),
        Key::new("span_ms", 500, 15_000),
    ],
    act,
};

fn act(world: &mut World, action: &Action) {
    let share = |name| action.value(name) as f64 / 1e2;
    let habits = Habits {
        overlooks: share("overlooks"),
        naks: share("naks"),
        doubles: share("doubles"),
        late_reply_ns: action.value("late_ms") * MILLIS,
        mute: action.value("mute") > 0,
        ..Habits::default()
    };
    let sensor = world.sensor(action);
    world.port(sensor, |tty, _, _| tty.sensor.set_habits(habits));
    world.later(action.value("span_ms"), move |world| {
        world.port(sensor, |tty, _, _| tty.sensor.set_habits(Habits::default()));
    });
}
