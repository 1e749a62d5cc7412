//! Tests of recordings for ROS 2, which are either made live or converted later. Readers of other projects can read
//! every message. A message has the same values, frame and time as the published scan.

use std::collections::BTreeMap;
use std::process::Command;

use crate::testkit::{INT, MEASURED_VALUES, Recording, TestEnv, is_class, number, output, python};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::Unit;
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::{Code, Header, Pose, Scan, file};
use serde_json::Value;

/// Poses of two sensors. The sensor `rear` is mounted upside down.
const FRONT_POSE: Pose = Pose { x_m: 0.3, y_m: 0.1, yaw_rad: 0.25, upside_down: 0, reserved: [0; 7] };
const REAR_POSE: Pose = Pose { x_m: -0.25, y_m: 0.0, yaw_rad: -2.5, upside_down: 1, reserved: [0; 7] };

fn link(env: &TestEnv, name: &str, pose: &Pose) -> Vec<String> {
    let mut words = vec![env.link(name)];
    let numbers = [("x", pose.x_m), ("y", pose.y_m), ("yaw", pose.yaw_rad)];
    words.extend(numbers.map(|(key, value)| format!("--set=link.{name}.pose.{key}={value:?}")));
    words.push(format!("--set=link.{name}.pose.upside_down={}", pose.upside_down == 1));
    words
}

type PublishedScan = (Header, Box<Scan>);

/// Returns the scans of a recording as the hub published them, by ROS topic and wall-clock stamp. No two scans of a
/// sensor have the same wall-clock stamp.
fn published_scans(recording: &Recording) -> BTreeMap<(String, u64), PublishedScan> {
    let of = |sensor: &str| {
        let scan_messages = recording.of(&format!("{sensor}/scan"));
        let scans = scan_messages.into_iter().map(|message| {
            let (header, payload) = file::split_message(&message.data).expect("a message of the hub");
            let mut scan = Box::default();
            assert!(Scan::unpack_into(&mut scan, payload));
            ((format!("/{sensor}/scan"), header.wall_ns), (header, scan))
        });
        scans.collect::<Vec<_>>()
    };
    let mut by_time = BTreeMap::new();
    for (key, scan) in [of("front"), of("rear")].concat() {
        let other = by_time.insert(key.clone(), scan);
        assert!(other.is_none(), "two scans have the stamp {key:?}");
    }
    by_time
}

/// Runs the independent reader `verb` on the file at `path` and returns all messages that the reader prints.
fn run_reader(mut python: Command, verb: &str, path: &str) -> Vec<Value> {
    python.args(["tests/testkit/read.py", verb, path]).current_dir(env!("CARGO_MANIFEST_DIR"));
    let outcome = output(python).expect("Python");
    assert!(outcome.status.success(), "{verb} {path}: {}", String::from_utf8_lossy(&outcome.stderr));
    serde_json::from_slice(&outcome.stdout).expect("a list of messages")
}

fn real(line: &Value, key: &str) -> f64 {
    line[key].as_f64().unwrap_or_else(|| panic!("no {key}: {line}"))
}

/// Asserts that a message has exactly the values of the published scan.
fn check_scan(message: &Value, (header, scan): &(Header, Box<Scan>)) {
    let sensor = message["topic"].as_str().and_then(|topic| topic.split('/').nth(1));
    assert_eq!(message["frame"].as_str(), sensor);
    assert_eq!(
        number(message, "stamp_ns"),
        header.wall_ns.checked_add_signed(scan.beam_ns(0)).expect("a time after 1970")
    );
    let near =
        |key: &str, expected: f64| assert!((real(message, key) - expected).abs() < 1e-6, "{key}: {message}");
    near("angle_min", scan.angle_deg(0).to_radians());
    near("angle_max", scan.angle_deg(scan.beams() - 1).to_radians());
    near("angle_increment", scan.step);
    near("scan_time", f64::from(header.period_us) / 1e6);
    near("time_increment", 0.0);
    let ranges = message["ranges"].as_array().expect("ranges");
    assert_eq!(
        (ranges.len(), &message["intensities"]),
        (scan.beams(), &scan.intensities().iter().collect::<Vec<_>>().into())
    );
    for (i, range) in ranges.iter().enumerate() {
        match (scan.distance_mm(i), scan.code(i)) {
            (Some(mm), _) => {
                let metres = mm as f32 / 1000.0;
                assert_eq!(range.as_f64().map(|range| range as f32), Some(metres), "beam {i}");
                let within = real(message, "range_min") as f32..=real(message, "range_max") as f32;
                assert!(within.contains(&metres), "beam {i}: {metres} is not in {within:?}");
            }
            (None, Some(Code::NoReturn | Code::Beyond)) => assert_eq!(range, "inf", "beam {i}"),
            (None, _) => assert_eq!(range, "nan", "beam {i}"),
        }
    }
}

/// Returns the direction of the beam at `angle_deg` after the rotation by the quaternion of `transform`.
fn rotate(transform: &Value, angle_deg: f64) -> [f64; 3] {
    let [x, y, z, w] = ["qx", "qy", "qz", "qw"].map(|key| real(transform, key));
    let (b, a) = angle_deg.to_radians().sin_cos();
    [
        (1.0 - 2.0 * (y * y + z * z)) * a + 2.0 * (x * y - z * w) * b,
        2.0 * (x * y + z * w) * a + (1.0 - 2.0 * (x * x + z * z)) * b,
        2.0 * (x * z - y * w) * a + 2.0 * (y * z + x * w) * b,
    ]
}

/// Asserts that the last message on `/tf_static` has both sensors with their poses.
fn check_transforms(messages: &[Value]) {
    let of_frames: Vec<_> = messages.iter().filter(|line| line["topic"] == "/tf_static").collect();
    let last = of_frames.last().expect("a message with the poses");
    let known = last["transforms"].as_array().expect("transforms");
    assert_eq!(known.len(), 2, "{last}");
    for transform in known {
        assert_eq!(
            (&transform["frame"], number(transform, "stamp_ns")),
            (&"base_link".into(), number(last, "log_time"))
        );
        let pose = if transform["child"] == "front" { FRONT_POSE } else { REAR_POSE };
        assert_eq!(transform["child"], if pose == FRONT_POSE { "front" } else { "rear" });
        for (key, expected) in [("x", pose.x_m), ("y", pose.y_m), ("z", 0.0)] {
            assert!((real(transform, key) - expected).abs() < 1e-12, "{key}: {transform}");
        }
        for angle_deg in [-90.0, -10.0, 0.0, 45.0, 90.0] {
            let [x, y, z] = rotate(transform, angle_deg);
            let (wanted_x, wanted_y) = pose.direction(angle_deg.to_radians());
            let apart = (x - wanted_x).abs() + (y - wanted_y).abs() + z.abs();
            assert!(apart < 1e-9, "{transform}: {angle_deg} degrees go to {x} {y} {z}");
        }
    }
}

#[test]
fn ros_decoders_read_live_and_converted_messages() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front", "rear"], &["--world=room", "--seed=5", "--mode=0x01"]);
    let _hub = env.hub(&[link(&env, "front", &FRONT_POSE), link(&env, "rear", &REAR_POSE)].concat());
    for sensor in ["front", "rear"] {
        env.await_info(sensor, |info| info["state"] == "streaming");
    }
    // The recorder of all topics starts before the ROS recorder and ends after it, so it has all scans of the ROS
    // recording.
    let [all, live, later] = ["all.mcap", "live.mcap", "later.mcap"].map(|name| env.path_argument(name));
    let mut recorder_of_all = env.start(&["record", "--all", "--json", "-o", &all]);
    recorder_of_all
        .await_line("samples", |line| is_class("recording")(line) && number(line, "samples") >= 100);
    let mut recorder = env.start(&["record", "--ros2", "--json", "-o", &live]);
    recorder.await_line("scans", |line| is_class("recording")(line) && number(line, "samples") >= 100);
    let outcome = recorder.end(INT);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert_eq!(recorder_of_all.end(INT).exit_code, Some(0));
    let outcome = env.run(&["convert", &all, &later, "--ros2", "--json"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let converted = outcome.of_class("converted").pop().expect("a summary");
    assert_eq!(
        (&converted["to"], &converted["sensors"]),
        (&"ROS 2".into(), &Value::from(vec!["front", "rear"]))
    );

    let recording = Recording::read_complete(&env.path("all.mcap"));
    let published = published_scans(&recording);
    let is_at_an_end = |(topic, log_time): &(String, u64)| {
        let mut times = published.keys().filter(|(of, _)| of == topic).map(|(_, time)| time);
        let last = times.clone().next_back();
        Some(log_time) < times.next() || Some(log_time) > last
    };
    for (name, path) in [("live.mcap", &live), ("later.mcap", &later)] {
        let ros_recording = Recording::read_complete(&env.path(name));
        assert!(
            ros_recording.messages.iter().all(|message| message.encoding == "cdr"),
            "{name} has other messages"
        );
        let scans = ros_recording.messages.iter().filter(|message| message.topic != "/tf_static").count();
        assert!(scans > 60, "{name}: {scans} scans");
        if name == "later.mcap" {
            let telegrams = ["front/telegram", "rear/telegram"].map(|topic| recording.of(topic)).concat();
            let measured =
                telegrams.iter().filter(|message| u64::from(message.payload()[4]) == MEASURED_VALUES).count();
            assert_eq!((number(&converted, "scans"), scans), (scans as u64, measured));
        }
        for (verb, modules) in [("mcap_ros2", "mcap_ros2, mcap"), ("rosbags", "rosbags, mcap")] {
            let Some(python) = python(modules) else { continue };
            let messages = run_reader(python, verb, path);
            assert_eq!(messages.len(), ros_recording.messages.len(), "{verb} of {name}");
            let mut checked = 0;
            for line in messages.iter().filter(|line| line["topic"] != "/tf_static") {
                let topic = line["topic"].as_str().unwrap_or_default().to_owned();
                let key = (topic, number(line, "log_time"));
                match published.get(&key) {
                    Some(scan) => check_scan(line, scan),
                    // The recording of all topics may have a telegram without its scan at its start or end, because the
                    // recorder attaches to one topic after the other. Only messages there may be unknown.
                    None => assert!(is_at_an_end(&key), "{verb} of {name}: {key:?} was not published"),
                }
                checked += usize::from(published.contains_key(&key));
            }
            assert!(checked > 60, "{verb} of {name}: {checked} scans were published");
            check_transforms(&messages);
            if verb == "rosbags" {
                let of_frames = |line: &&Value| line["topic"] == "/tf_static";
                let all_latched =
                    messages.iter().filter(of_frames).all(|line| line["durability"] == "TRANSIENT_LOCAL");
                assert!(all_latched, "frames are not latched");
            }
        }
    }
}

#[test]
fn scan_is_also_written_as_points() {
    let env = TestEnv::new();
    let words: [u16; 361] =
        std::array::from_fn(|beam| if beam % 3 == 0 { 0x1FFF } else { 500 + beam as u16 });
    let stream = env.file("a.bin", lms::measured::encode(0, Unit::Mm, &words, 0x10).bytes().repeat(20));
    let file = env.path_argument("points.mcap");
    let outcome = env.run(&["convert", &stream, &file, "--mode=0", "--ros2", "--points"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let topics = |topic: &str| Recording::read_complete(&env.path("points.mcap")).of(topic).len();
    assert_eq!((topics("/front/scan"), topics("/front/points")), (20, 20));
    for (verb, modules) in [("mcap_ros2", "mcap_ros2, mcap"), ("rosbags", "rosbags, mcap")] {
        let Some(python) = python(modules) else { continue };
        let messages = run_reader(python, verb, &file);
        let of = |topic: &str| messages.iter().filter(|line| line["topic"] == topic).collect::<Vec<_>>();
        let (scans, clouds) = (of("/front/scan"), of("/front/points"));
        assert_eq!((scans.len(), clouds.len()), (20, 20), "{verb}");
        for (scan, cloud) in scans.iter().zip(&clouds) {
            assert_eq!((&cloud["stamp_ns"], &cloud["frame"]), (&scan["stamp_ns"], &scan["frame"]));
            assert_eq!(cloud["fields"], Value::from(vec!["x", "y", "z", "intensity"]));
            let ranges = scan["ranges"].as_array().expect("ranges").iter().enumerate();
            let readings: Vec<_> = ranges.filter_map(|(i, range)| Some((i, range.as_f64()?))).collect();
            let points = cloud["points"].as_array().expect("points");
            assert!(readings.len() == points.len() && points.len() > 200, "{verb}: {}", points.len());
            for ((beam, range), point) in readings.iter().zip(points) {
                let angle = real(scan, "angle_min") + *beam as f64 * real(scan, "angle_increment");
                let [x, y] = [0, 1].map(|axis| point[axis].as_f64().expect("a number"));
                let apart = (x - range * angle.cos()).hypot(y - range * angle.sin());
                assert!(apart < 1e-4, "{verb}: beam {beam} is {apart} m from its reading");
            }
        }
    }
    let outcome = env.run(&["convert", &stream, "b.mcap", "--points"]);
    assert!(outcome.exit_code == Some(2) && outcome.stderr.contains("--ros2 --points"), "{outcome}");
}

#[test]
fn stream_file_converts_to_ros_and_csv_with_its_mode() {
    let env = TestEnv::new();
    let words: [u16; 361] = std::array::from_fn(|beam| (beam as u16 % 8) << 13 | (500 + 11 * beam as u16));
    let scan = lms::measured::encode(0, Unit::Mm, &words, 0x10);
    let bytes = scan.bytes().repeat(20);
    let stream = env.file("a.bin", &bytes);
    let [bag, rows] = ["bag.mcap", "rows.csv"].map(|name| env.path_argument(name));
    for words in [&[&bag[..], "--ros2"][..], &[&rows]] {
        let outcome = env.run(&[&["convert", &stream], words].concat());
        assert_eq!(outcome.exit_code, Some(78), "{outcome}");
        assert!(outcome.stderr.contains("does not contain the measuring mode of front"), "{outcome}");
        assert!(outcome.stderr.contains("--mode"), "{outcome}");
        let outcome = env.run(&[&["convert", &stream, "--mode=0x01"], words].concat());
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    }
    let messages: Vec<_> = Recording::read_complete(&env.path("bag.mcap")).messages;
    assert_eq!(messages.len(), 20);
    assert!(
        messages
            .iter()
            .all(|message| message.topic == "/front/scan" && message.schema == "sensor_msgs/msg/LaserScan")
    );
    let text = std::fs::read_to_string(&rows).expect("a CSV file");
    let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!((lines.len(), lines[0].len()), (21, 8 + 361));
    assert_eq!(lines[0][..2], ["seq", "topic_seq"]);
    for (number, line) in lines[1..].iter().enumerate() {
        let words: Vec<String> = words.iter().map(|word| (word & 0x1FFF).to_string()).collect();
        assert_eq!((line[0], line[5..8].to_vec()), (&number.to_string()[..], vec!["1000", "-90", "0.5"]));
        assert_eq!(line[8..], words);
    }
    for (words, code, says) in [
        (&[&rows[..], "--ros2", "--force"][..], 2, "--ros2 makes an MCAP file"),
        (&["b.bin", "--mode=0x01"], 2, "--mode is for scans"),
        (&["b.csv", "--mode=0x77"], 78, "not a measuring mode with ranges"),
    ] {
        let outcome = env.run(&[&["convert", &stream], words].concat());
        assert!(outcome.exit_code == Some(code) && outcome.stderr.contains(says), "{outcome}");
    }
}
