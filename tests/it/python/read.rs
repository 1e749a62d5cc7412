//! Tests that `scanhub.read` returns exactly the samples that a replay of the recording publishes, bit for bit.

use std::path::Path;
use std::process::Command;

use scanhub_config::Sources;
use scanhub_daemon::{PlaybackOptions, PlaybackRate, ReadOptions, ReadSample, RecordingReader, Replay};
use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_drivers::{ld, lms};
use scanhub_schema::{
    Background, Flags, Foreground, Header, Lines, MILLIS, Marks, Motion, Quality, Reasons, Scan, Topic, Zones,
};
use scanhub_shm::{Node, Payload, Subscriber};
use scanhub_sim::device::Device;
use scanhub_sim::ld::{LdSettings, LdSimulator};
use scanhub_sim::room::Room;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::{assert_success, check};
use crate::pages::text_on;
use crate::recorded_world::recorded_world;
use crate::replayed::recorded_rooms::{self, SENSORS};
use crate::replayed::step_through;
use crate::testkit::{Program, TestEnv, client_python, in_own_process, python_for};

/// Settings with which the hub learns the background within the recording, and with which people enter the zones.
const READ_SETTINGS: &str = r#"
background.scans = 40
zones.radii = [2.5, 1.5]
[[link]]
name = "rear"
port = "/dev/ttyUSB0"
zones.radii = [3.0, 2.0]
"#;

/// Samples of all topics except `status`, in the form in which the script `read.py` prints them.
#[derive(Default)]
struct PublishedSamples {
    samples: Vec<Value>,
    telegrams: u64,
}

macro_rules! subscribers {
    ($($name:ident: $payload:ty),*) => {
        struct Subscribers {
            sensor: String,
            $($name: Subscriber<$payload>,)*
        }

        impl Subscribers {
            fn attach(node: &Node, sensor: &str) -> Subscribers {
                Subscribers { sensor: sensor.to_owned(), $($name: attach::<$payload>(node, sensor),)* }
            }

            fn take(&self, published: &mut PublishedSamples) {
                $(while let Some(sample) = <$payload as Payload>::receive(&self.$name).expect("a working subscriber") {
                    let bytes = Payload::bytes(<$payload as Payload>::read(&sample));
                    published.note(&self.sensor, <$payload as Payload>::TOPIC, sample.user_header(), bytes);
                })*
            }
        }
    };
}

subscribers!(
    telegram: [u8], scan: Scan, zones: Zones, marks: Marks, lines: Lines, motion: Motion, foreground: Foreground,
    background: Background
);

fn attach<P: Payload + ?Sized>(node: &Node, sensor: &str) -> Subscriber<P> {
    let service = P::open(node, sensor).expect("a topic").expect("an existing topic");
    P::subscriber(node, &service).expect("a free slot")
}

impl PublishedSamples {
    fn note(&mut self, sensor: &str, topic: Topic, header: &Header, payload: &[u8]) {
        self.telegrams += u64::from(topic == Topic::Telegram);
        let reasons: Vec<_> = Reasons::names(header.reasons).collect();
        let mut flags: Vec<_> = Flags::names(header.flags & !Flags::STAMP_ESTIMATED).collect();
        flags.sort_unstable();
        let quality = if header.quality == Quality::Clean as u8 { "clean" } else { "suspect" };
        let period_us = Some(header.period_us).filter(|period_us| *period_us != 0);
        let took_ns = header.stamp_last_ns - header.stamp_first_ns;
        let digest: String = Sha256::digest(payload).iter().map(|byte| format!("{byte:02x}")).collect();
        let numbers = (header.seq, header.topic_seq);
        self.samples.push(json!([
            sensor,
            topic.name(),
            numbers.1,
            numbers.0,
            quality,
            reasons,
            flags,
            period_us,
            header.wall_ns,
            took_ns,
            digest
        ]));
    }
}

/// Returns `samples` sorted by sensor, topic and `topic_seq`. Drops statuses, and drops the zones before the first
/// telegram, because a subscriber of a replay attaches too late for them. If `has_stamps` is false, the recording has
/// no stamps, and the times come from the clock of the run. They are then replaced by null.
fn sorted(samples: Vec<Value>, has_stamps: bool) -> Vec<Value> {
    let mut samples: Vec<Value> = samples
        .into_iter()
        .filter(|it| it[1] != "status" && (&it[1], &it[2]) != (&"zones".into(), &0.into()))
        .collect();
    if !has_stamps {
        samples.iter_mut().for_each(|it| (it[8], it[9]) = (Value::Null, Value::Null));
    }
    samples.sort_by_key(|it| (it[0].to_string(), it[1].to_string(), it[2].as_u64()));
    samples
}

/// Asserts that a replay of `file` with the settings in `config` publishes the samples that [`RecordingReader`]
/// returns. If `read` is given, it is the command that prints what `scanhub.read` returns, which must be the same
/// samples.
fn compare(
    env: &TestEnv,
    read: Option<&Command>,
    file: &str,
    config: &str,
    sensors: &[&str],
    has_stamps: bool,
) {
    let sources = Sources { files: vec![config.into()], ..Sources::default() };
    let place = Path::new(file);
    let replay = Replay {
        file: place,
        sensor: None,
        family: None,
        sources: &sources,
        options: PlaybackOptions { rate: PlaybackRate::Max, ..PlaybackOptions::default() },
        holds: true,
    };
    let mut published = PublishedSamples::default();
    step_through(
        &env.domain(),
        &replay,
        |node| sensors.iter().map(|name| Subscribers::attach(node, name)).collect::<Vec<_>>(),
        |subscribers| {
            subscribers.iter().for_each(|it| it.take(&mut published));
            published.telegrams
        },
    );
    let replayed = sorted(published.samples, has_stamps);
    let is_same = |samples: Vec<Value>| {
        let samples = sorted(samples, has_stamps);
        for (sample, replayed) in samples.iter().zip(&replayed) {
            assert_eq!(sample, replayed, "{file}");
        }
        assert_eq!(samples.len(), replayed.len(), "{file}");
    };
    let topics: Vec<_> = RecordingReader::topics().collect();
    let options = ReadOptions { file: place, sensor: None, family: None, sources: &sources, topics: &topics };
    let mut computed = PublishedSamples::default();
    for ReadSample { sensor, topic, header, words, len } in
        RecordingReader::open(&options).expect("a recording")
    {
        computed.note(&sensor, topic, &header, &bytemuck::cast_slice(&words)[..len]);
    }
    is_same(computed.samples);
    if let Some(command) = read {
        let mut read = Command::new(command.get_program());
        read.args(command.get_args()).args(["dump", file, config]).env_remove("SCANHUB_CONFIG");
        let outcome = Program::start(read).wait();
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        is_same(outcome.lines());
    }
    for topic in ["telegram", "scan", "zones", "marks", "lines", "motion", "foreground", "background"] {
        let count = replayed.iter().filter(|it| it[1] == topic).count();
        let expected = if topic == "background" { 2 } else { 20 };
        assert!(count >= expected, "{file}: {count} samples of {topic}");
    }
}

#[test]
fn python_read_equals_a_replay_bit_for_bit() {
    in_own_process("python::read::python_read_equals_a_replay_bit_for_bit", || {
        let read = check("read");
        let read = read.as_ref();
        let env = TestEnv::new();
        let config = env.file("robot.toml", READ_SETTINGS);
        let rooms = env.path("rooms.mcap");
        recorded_rooms::record(&env.domain(), &rooms, 110, Some(70), |_, _| {});
        compare(&env, read, &env.path_argument("rooms.mcap"), &config, &SENSORS.map(|(name, _)| name), true);
        compare(&env, read, &log(&env), &config, &["front"], true);
        compare(&env, read, &stream(&env), &config, &["front"], false);
        let config = env.file("other.toml", "background.scans = 40\n");
        compare(&env, read, &packets(&env), &config, &["front"], false);
    });
}

#[test]
fn python_read_has_arrays_and_errors() {
    let Some(mut read) = check("read") else { return };
    let env = TestEnv::new();
    let world = "room".parse().expect("a world");
    let remote = recorded_world(&env, &world, &["robot1.front", "robot1.rear"], 1);
    std::fs::rename(remote, env.path("remote.mcap")).expect("a file");
    env.file("no_mode.bin", lms::measured::encode(0, Unit::Mm, &[0x2345; 181], 0x10).bytes().repeat(9));
    let two = recorded_world(&env, &world, &["front", "rear"], 4);
    read.args(["check", &two, &log(&env), &packets(&env)]).arg(env.path(""));
    assert_success(read);
}

#[test]
fn program_on_the_page_runs() {
    let Some(mut program) = client_python() else { return };
    let env = TestEnv::new();
    let file = recorded_world(&env, &"room".parse().expect("a world"), &["front", "rear"], 4);
    std::fs::rename(file, env.path("walk.mcap")).expect("a file");
    env.file("robot.toml", READ_SETTINGS);
    let text = text_on("docs/python.md", "python,no_run", "import scanhub");
    program.args(["-c", &text]).current_dir(env.path(""));
    let outcome = Program::start(program).wait();
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let words = String::from_utf8_lossy(&outcome.stdout).into_owned();
    assert!(words.contains("front 5 ") && words.trim_end().ends_with(" s"), "{words}");
}

#[test]
fn example_plots_a_recording() {
    let Some(mut plot) = client_python() else { return };
    if python_for("matplotlib", "matplotlib").is_none() {
        return;
    }
    let env = TestEnv::new();
    let file = recorded_world(&env, &"room".parse().expect("a world"), &["front"], 8);
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/python/examples/plot_recording.py");
    plot.arg(example).args([&file, "--out", &env.path_argument("picture.png")]);
    assert_success(plot);
    let picture = std::fs::read(env.path("picture.png")).expect("a picture");
    assert!(picture.starts_with(b"\x89PNG"));
}

/// Writes a log of a simulated room. Between two of its scans, there is a pause of 1.7 s.
fn log(env: &TestEnv) -> String {
    let room = Room::new(&"demo".parse().expect("a world"), 7);
    let line = |scan: u64| {
        let at_ms = 1_000_000 + scan * 40 + if scan > 80 { 1_700 } else { 0 };
        let look = room.labeled_scan(Variant::HALF, Unit::Mm, Mode(1), at_ms * MILLIS);
        let ranges: Vec<_> =
            look.words[..181].iter().map(|word| format!("{:.2}", f64::from(*word) / 1e3)).collect();
        let at = at_ms as f64 / 1e3;
        format!("FLASER 181 {} 0 0 0 0 0 0 {at} host {at}\n", ranges.join(" "))
    };
    env.file("a.log", (0..110).map(line).collect::<String>())
}

/// Writes a stream file of a simulated room, with damaged bytes between the telegrams.
fn stream(env: &TestEnv) -> String {
    let room = Room::new(&"demo".parse().expect("a world"), 8);
    let mut bytes = lms::reply::configuration_reply(0, Mode(1), Unit::Mm, 0x10).bytes().to_vec();
    for scan in 0..110 {
        let at = scan * recorded_rooms::scan_period();
        let look = room.labeled_scan(Variant::HALF, Unit::Mm, Mode(1), at);
        let telegram = lms::measured::encode(0, Unit::Mm, &look.words, 0x10);
        bytes.extend(telegram.bytes());
        match scan % 30 {
            10 => bytes.extend([0x55; 7]),
            20 => bytes.truncate(bytes.len() - 9),
            _ => {}
        }
    }
    env.file("stream.bin", bytes)
}

/// Writes a stream file with the packets of a rotating scanner, as they would arrive on a line.
fn packets(env: &TestEnv) -> String {
    let room = Room::new(&"room".parse().expect("a world"), 7);
    let settings = LdSettings { seed: 7, ..LdSettings::of(ld::Model::Ld19) };
    let (mut scanner, mut bytes) = (LdSimulator::new(settings, room), Vec::new());
    for now in (0..6_000 * MILLIS).step_by(10 * MILLIS as usize) {
        while let Some(chunk) = scanner.poll_transmit(now) {
            bytes.extend(chunk.bytes);
        }
    }
    env.file("packets.bin", bytes)
}
