//! Recordings of simulated sensors with the stamps that a hub would give them. They are computed without waiting, and
//! do not depend on the load of the machine.

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

/// Wall-clock time at which the simulated world starts, in nanoseconds since 1970.
pub(crate) const START_NS: u64 = 1_700_000_000_000_000_000;
const TELEGRAM_NS: u64 = 14_640_000;
/// Time from a telegram of one sensor to the telegram of the next sensor, in nanoseconds.
const SENSOR_OFFSET_NS: u64 = 9_000_000;
/// Status byte of a scanner without a fault.
const STATUS_OK: u8 = 0x10;

/// Writes a recording with the telegrams of `sensors` and returns its path. The recording covers `seconds` seconds. The
/// first sensor is the one that `world` has for port 0, the second one that for port 1, and so on. Scans have 361 beams
/// in millimeters, at 500,000 baud. If the first sensor has a mount, the recording also has the mount's angles as
/// `mount/tilt`.
pub(crate) fn recorded_world(env: &TestEnv, world: &World, sensors: &[&str], seconds: u64) -> String {
    let file = env.path_argument("world.mcap");
    let rooms: Vec<Room> = (0..sensors.len() as u64).map(|port| Room::of_port(world, 5, port)).collect();
    let mut writer =
        Writer::begin(File::create(&file).expect("a file"), "", BTreeMap::new()).expect("a new recording");
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
                .expect("a written sample");
        }
        let now_ns = 1_000_000_000 + seq * period;
        while let Some(report) = reports.next_if(|report| report.arrival_ns <= now_ns) {
            // In this recording, the stamp of a telegram is earlier than the end of its scan by TELEGRAM_NS. Shift the
            // stamps of the angles by the same time.
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
            let len = tilt.pack(&mut room).expect("a buffer that is large enough");
            writer.write_sample("mount", Topic::Tilt, &header, &room[..len]).expect("a written sample");
            angles += 1;
        }
        if seq % 40 == 0 {
            writer.close_chunk().expect("a closed chunk");
        }
    }
    writer.finish().expect("a complete recording");
    file
}
