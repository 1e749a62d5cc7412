//! A user pauses a sensor, and resumes it.

use scanhub_schema::Verb;

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "pause", per_minute: 2.0, keys: &[SENSOR, Key::new("span_ms", 10, 6_000)], act };

fn act(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.wants.asks.push((sensor, Verb::Pause));
    world.later(action.value("span_ms"), move |world| world.wants.asks.push((sensor, Verb::Resume)));
}
