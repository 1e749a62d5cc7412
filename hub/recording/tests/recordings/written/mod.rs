//! Recording of two sensors as the hub writes it, with its contents.

use std::collections::BTreeMap;

use bytemuck::bytes_of;
use fastrand::Rng;
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::reply;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::{self, Compression, ENCODING_V1, ForeignChannel, Writer};
use scanhub_schema::{
    Background, Early, Flags, Foreground, Header, Lines, Marks, Motion, Scan, Status, Topic, Zones,
};

/// A telegram that was written into a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct WrittenTelegram {
    pub(crate) sensor: &'static str,
    pub(crate) header: Header,
    pub(crate) telegram: Vec<u8>,
}

/// Bytes of a recording, and its telegrams in order.
pub(crate) struct WrittenRecording {
    pub(crate) bytes: Vec<u8>,
    pub(crate) telegrams: Vec<WrittenTelegram>,
}

/// Returns a recording with `rounds` telegrams of each sensor and their results, and with a channel of another program.
/// Each chunk has four telegrams of each sensor.
pub(crate) fn recording(rounds: u64, seed: u64) -> WrittenRecording {
    recording_with(rounds, seed, Compression::None)
}

/// Returns the same recording as [`recording`], but with this compression.
pub(crate) fn recording_with(rounds: u64, seed: u64, compression: Compression) -> WrittenRecording {
    write_recording(rounds, seed, compression, |writer, sensor, topic, header, payload| {
        writer.write_sample(sensor, topic, header, payload).unwrap();
    })
}

/// Returns the same recording as [`recording`], but in the format of version 1 and with only these `topics`.
pub(crate) fn recording_of_version_1(rounds: u64, seed: u64, topics: &[Topic]) -> WrittenRecording {
    write_recording(rounds, seed, Compression::None, |writer, sensor, topic, header, payload| {
        if !topics.contains(&topic) {
            return;
        }
        let payload = match topic {
            Topic::Scan => version_1_scan(),
            // The fields are generation, counts, unit and flags, all 0.
            Topic::Foreground | Topic::Background => vec![0; 12],
            _ => payload.to_vec(),
        };
        let channel = ForeignChannel {
            topic: &format!("{sensor}/{}", topic.name()),
            encoding: ENCODING_V1,
            schema: (&file::schema_name(topic).replace(".v2", ".v1"), "as it was", ENCODING_V1),
            metadata: &[],
        };
        let channel = writer.add_channel(&channel).unwrap();
        let message = [bytes_of(header), &payload].concat();
        writer.write_message(channel, header.topic_seq as u32, header.wall_ns, &message).unwrap();
    })
}

/// Returns a scan of 361 beams in the format of version 1. Its bytes are also a valid scan in the current format.
pub(crate) fn version_1_scan() -> Vec<u8> {
    let mut payload = vec![0x69, 0x01, 10, 13];
    payload.extend(0_i32.to_le_bytes());
    payload.extend([500_u16.to_le_bytes(), [0, 1]].concat());
    payload.extend([256_u16; 361].map(u16::to_le_bytes).concat());
    payload.extend([0; 361]);
    payload
}

/// Creates a recording. Calls `write` to write each sample.
fn write_recording(
    rounds: u64,
    seed: u64,
    compression: Compression,
    mut write: impl FnMut(&mut Writer<Vec<u8>>, &str, Topic, &Header, &[u8]),
) -> WrittenRecording {
    let mut random = Rng::with_seed(seed);
    let facts = BTreeMap::from([("domain".to_owned(), "test".to_owned())]);
    let mut writer = Writer::begin_compressed(Vec::new(), "", compression, facts).unwrap();
    let cloud = ForeignChannel {
        topic: "/imu",
        encoding: "cdr",
        schema: ("sensor_msgs/msg/Imu", "float64 x", "ros2msg"),
        metadata: &[],
    };
    let imu = writer.add_channel(&cloud).unwrap();
    let mut telegrams = Vec::new();
    for round in 0..rounds {
        for (number, sensor) in SENSOR_NAMES.into_iter().enumerate() {
            let telegram = match round {
                0 => reply::configuration_reply(0, Mode(4), Unit::Mm, 0x10).bytes().to_vec(),
                // This reply has the same bytes each time.
                round if round % 16 == 7 => reply::mode_reply(0, true, 0x10).bytes().to_vec(),
                _ => scan(&mut random),
            };
            let header = header(round, number as u8, &mut random);
            write(&mut writer, sensor, Topic::Telegram, &header, &telegram);
            for (topic, payload) in results(&telegram, &mut random) {
                write(&mut writer, sensor, topic, &header, &payload);
            }
            telegrams.push(WrittenTelegram { sensor, header, telegram });
        }
        writer
            .write_message(imu, round as u32, WALL_NS + round * PERIOD_NS, &random.u64(..).to_le_bytes())
            .unwrap();
        if round % 4 == 3 {
            writer.close_chunk().unwrap();
        }
    }
    WrittenRecording { bytes: writer.finish().unwrap(), telegrams }
}

fn header(round: u64, sensor: u8, random: &mut Rng) -> Header {
    let first_ns = 5_000_000_000 + round * PERIOD_NS + u64::from(sensor) * 3_000_000;
    let mut header = Header {
        seq: 40 + round,
        topic_seq: 40 + round,
        stamp_first_ns: first_ns,
        stamp_last_ns: first_ns + 14_640_000,
        wall_ns: WALL_NS + first_ns,
        boot: 0x1122_3344_5566_7788,
        sensor,
        flags: Flags::SIMULATED,
        period_us: (PERIOD_NS / 1000) as u32,
        hub_pid: 4711,
        ..Header::default()
    };
    header.set_sent_at(first_ns + 14_640_000 + random.u64(50_000..3_000_000));
    header
}

fn scan(random: &mut Rng) -> Vec<u8> {
    let words: Vec<u16> = (0..181).map(|_| random.u16(..0x1FFF)).collect();
    measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
}

/// Returns the results that the hub would publish for a telegram. Only the sizes of these results are realistic.
fn results(telegram: &[u8], random: &mut Rng) -> Vec<(Topic, Vec<u8>)> {
    let packed = |payload: &dyn Fn(&mut [u8]) -> Option<usize>| {
        let mut room = [0; 4096];
        let len = payload(&mut room).unwrap();
        room[..len].to_vec()
    };
    let status = Status { mode: 4, unit_mm: 1, baud: 500_000, since_ns: random.u64(..), ..Status::default() };
    let mut scan = packed(&|room| Scan::zeroed(0).pack(room));
    // The scan also has the ranges as the telegram contains them.
    scan.extend_from_slice(&telegram[5..telegram.len() - 3]);
    vec![
        (Topic::Scan, scan),
        (Topic::Marks, packed(&|room| Marks::default().pack(room))),
        (Topic::Zones, packed(&|room| Zones::unknown().pack(room))),
        (Topic::Foreground, packed(&|room| Foreground::zeroed(0).pack(room))),
        (Topic::Background, packed(&|room| Background::zeroed(0).pack(room))),
        (Topic::Status, packed(&|room| status.pack(room))),
        (Topic::Lines, packed(&|room| Lines::default().pack(room))),
        (Topic::Motion, packed(&|room| Motion::default().pack(room))),
        (Topic::Early, packed(&|room| Early { verdict: 2, ..Early::default() }.pack(room))),
    ]
}

pub(crate) const SENSOR_NAMES: [&str; 2] = ["front", "rear"];
const WALL_NS: u64 = 1_700_000_000_000_000_000;
const PERIOD_NS: u64 = 26_640_000;
