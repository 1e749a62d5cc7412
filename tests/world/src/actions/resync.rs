//! A user has a link begin anew, or forgets its background.

use scanhub_schema::Verb;

use super::{Key, Kind, SENSOR};
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "resync", per_minute: 3.0, keys: &[SENSOR, Key::new("verb", 0, 4)], act };

fn act(world: &mut World, action: &Action) {
    let verbs = [Verb::Resync, Verb::Reset, Verb::Freeze, Verb::Thaw, Verb::Show];
    let verb = verbs[action.value("verb") as usize % verbs.len()];
    world.wants.asks.push((world.sensor(action), verb));
}
