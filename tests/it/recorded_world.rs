//! What sensors see of a world as a hub would have recorded it: stamped when it was measured, in no time, however busy the machine
//! of the test is.

use std::collections::BTreeMap;
use std::fs::File;

use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{MIRROR_PERIOD, Mode, Unit, Variant};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::Writer;
use scanhub_schema::{Header, Tilt, Topic};
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

use crate::testkit::TestEnv;

/// When the world begins, by the wall clock.
pub(crate) const START_NS: u64 = 1_700_000_000_000_000_000;
const TELEGRAM_NS: u64 = 14_640_000;
/// From one sensor's telegram to that of the next.
const SENSOR_OFFSET_NS: u64 = 9_000_000;
/// The sensors are well.
const STATUS_OK: u8 = 0x10;

/// A file with the telegrams of `sensors`, which look at `world` in its order for so many seconds: 361 beams in millimetres, at
/// 500,000 baud.
/// The angles of the first sensor's mount, if it has one, are in it as `mount/tilt`.
pub(crate) fn recorded_world(env: &TestEnv, world: &World, sensors: &[&str], seconds: u64) -> String {
    let file = env.path_argument("world.mcap");
    let rooms: Vec<Room> = (0..sensors.len() as u64).map(|port| Room::of_port(world, 5, port)).collect();
    let mut writer =
        Writer::begin(File::create(&file).expect("a file"), "", BTreeMap::new()).expect("begins");
    let period = Variant::HALF.revolutions() * MIRROR_PERIOD;
    let reports = (0..).map_while(|number| world.mount(0)?.report(number));
    let mut reports = reports.skip_while(|report| report.stamp_ns < 1_000_000_000).peekable();
    let mut angles = 0;
    for seq in 0..seconds * 1_000_000_000 / period {
        for (number, room) in rooms.iter().enumerate() {
            let end_ns = 1_000_000_000 + seq * period + number as u64 * SENSOR_OFFSET_NS;
            let telegram = if seq == 0 {
                lms::reply::configuration_reply(0, Mode(1), Unit::Mm, STATUS_OK)
            } else {
                lms::measured::encode(
                    0,
                    Unit::Mm,
                    &room.scan(Variant::HALF, Unit::Mm, Mode(1), end_ns),
                    STATUS_OK,
                )
            };
            let mut header = Header {
                seq,
                topic_seq: seq,
                stamp_first_ns: end_ns - TELEGRAM_NS,
                stamp_last_ns: end_ns,
                wall_ns: START_NS + end_ns - TELEGRAM_NS,
                boot: 7,
                sensor: number as u8,
                period_us: (period / 1000) as u32,
                ..Header::default()
            };
            header.set_sent_at(end_ns + 100_000);
            writer
                .write_sample(sensors[number], Topic::Telegram, &header, telegram.bytes())
                .expect("is written");
        }
        let now_ns = 1_000_000_000 + seq * period;
        while let Some(report) = reports.next_if(|report| report.arrival_ns <= now_ns) {
            // The stamps of the telegrams are this much before the end of their scans.
            let stamp_ns = report.stamp_ns - TELEGRAM_NS;
            let header = Header {
                seq: angles,
                topic_seq: angles,
                stamp_first_ns: stamp_ns,
                stamp_last_ns: stamp_ns,
                wall_ns: START_NS + stamp_ns,
                boot: 8,
                ..Header::default()
            };
            let tilt = Tilt { angle_rad: report.angle_rad, rate_rad_s: report.rate_rad_s };
            let mut room = [0; 64];
            let len = tilt.pack(&mut room).expect("there is room");
            writer.write_sample("mount", Topic::Tilt, &header, &room[..len]).expect("is written");
            angles += 1;
        }
        if seq % 40 == 0 {
            writer.close_chunk().expect("is written");
        }
    }
    writer.finish().expect("ends");
    file
}
