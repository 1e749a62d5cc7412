//! Somebody on the network who has no key, or another one, or only what went by before; or the clocks of both machines are
//! apart for a while. Gateway and listener of a world in which this happens have a key.

use super::{Key, Kind};
use crate::plan::Action;
use crate::remote::Forgery;
use crate::world::World;

/// `what`: 0 no MAC, 1 another key, 2 a MAC of something else, 3 a recording that is sent again, 4 clocks that are apart.
pub(crate) const KIND: Kind = Kind {
    name: "key_errors",
    per_minute: 6.0,
    keys: &[
        Key::new("what", 0, 4),
        Key::new("count", 1, 400),
        Key::new("apart_s", 8, 600),
        Key::new("span_ms", 20, 8_000),
    ],
    act,
};

fn act(world: &mut World, action: &Action) {
    let count = action.value("count") as usize;
    let forgery = match action.value("what") {
        0 => Forgery::Plain,
        1 => Forgery::OtherKey,
        2 => Forgery::OtherMac,
        3 => Forgery::Recording,
        _ => {
            // Behind as often as ahead.
            let apart_s = action.value("apart_s") as i64;
            let apart_s = if count.is_multiple_of(2) { apart_s } else { -apart_s };
            world.remote.set_apart(apart_s * 1_000_000_000);
            return world.later(action.value("span_ms"), |world| world.remote.set_apart(0));
        }
    };
    world.remote.forge(&world.shared, forgery, count);
}
