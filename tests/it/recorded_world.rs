//! What sensors see of a world as a hub would have recorded it: stamped when it was measured, in no time, however busy the machine
//! of the test is.

use std::collections::BTreeMap;
use std::fs::File;

use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{MIRROR_TURN, Mode, Unit, Variant};
use schema::file::Writer;
use schema::{Header, Topic};
use sim::room::Room;
use sim::world::World;

use crate::testkit::TestEnv;

/// When the world begins, by the wall clock.
pub(crate) const BEGIN_NS: u64 = 1_700_000_000_000_000_000;
const TELEGRAM_NS: u64 = 14_640_000;
/// From one sensor's telegram to that of the next.
const APART_NS: u64 = 9_000_000;
/// The sensors are well.
const WELL: u8 = 0x10;

/// A file with the telegrams of `sensors`, which look at `world` in its order for so many seconds: 361 beams in millimetres, at
/// 500,000 baud.
pub(crate) fn recorded_world(env: &TestEnv, world: &World, sensors: &[&str], seconds: u64) -> String {
    let file = env.word("world.mcap");
    let rooms: Vec<Room> = (0..sensors.len() as u64).map(|port| Room::of_port(world, 5, port)).collect();
    let mut writer =
        Writer::begin(File::create(&file).expect("a file"), "", BTreeMap::new()).expect("begins");
    let period = Variant::HALF.turns() * MIRROR_TURN;
    for seq in 0..seconds * 1_000_000_000 / period {
        for (number, room) in rooms.iter().enumerate() {
            let end_ns = 1_000_000_000 + seq * period + number as u64 * APART_NS;
            let telegram = if seq == 0 {
                lms::reply::configuration(0, Mode(1), Unit::Mm, WELL)
            } else {
                lms::measured::encode(0, Unit::Mm, &room.scan(Variant::HALF, Unit::Mm, Mode(1), end_ns), WELL)
            };
            let mut header = Header {
                seq,
                topic_seq: seq,
                stamp_first_ns: end_ns - TELEGRAM_NS,
                stamp_last_ns: end_ns,
                wall_ns: BEGIN_NS + end_ns - TELEGRAM_NS,
                boot: 7,
                sensor: number as u8,
                period_us: (period / 1000) as u32,
                ..Header::default()
            };
            header.set_sent_at(end_ns + 100_000);
            writer.sample(sensors[number], Topic::Telegram, &header, telegram.bytes()).expect("is written");
        }
        if seq % 40 == 0 {
            writer.close_chunk().expect("is written");
        }
    }
    writer.finish().expect("ends");
    file
}
