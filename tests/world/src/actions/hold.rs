//! Something holds the head of a scanner for a while. What has nothing of that kind does not care.

use scanhub_schema::MILLIS;

use super::{Key, Kind, SENSOR};
use crate::family::Ailment;
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind =
    Kind { name: "hold", per_minute: 1.0, keys: &[SENSOR, Key::new("span_ms", 50, 5_000)], act };

fn act(world: &mut World, action: &Action) {
    // What holds it when everything is made well again lets it go.
    let span = (action.value("span_ms") * MILLIS).min(world.until_healed());
    world.ail(action, Ailment::Held { span });
}
