//! Another sensor is at the line, at some rate, idle or streaming already.

use super::{Key, Kind, SENSOR};
use crate::event::Event;
use crate::plan::Action;
use crate::world::World;

pub(crate) const KIND: Kind = Kind {
    name: "exchange",
    per_minute: 1.5,
    keys: &[SENSOR, Key::new("rate", 0, 3), Key::new("streams", 0, 1)],
    act,
};

fn act(world: &mut World, action: &Action) {
    let sensor = world.sensor(action);
    world.port(sensor, |tty, log, now| {
        tty.advance(now, log);
        tty.sensor.exchange(action);
    });
    world.shared.tell(&Event::Exchanged { sensor });
}
