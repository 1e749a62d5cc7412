//! Tests of a hub whose port is a recording: the hub publishes every telegram once and in order, whatever bytes are
//! between the telegrams. At the end of the recording, the link is silent.

use std::path::PathBuf;

use crate::testkit;
use crate::testkit::{INT, KILL, Outcome, Program, TestEnv, bytes_of, contiguous_numbers, number, skip};
use scanhub_drivers::lms;
use scanhub_drivers::lms::variant::{Mode, Unit};
use serde_json::Value;

/// Starts a hub that plays `file` (with `option` appended to its name), and a subscriber of `topics`. The subscriber
/// starts before the hub, and therefore receives the very first sample. Returns the outcome of the subscriber, and the
/// line that `info` prints for the link at the end.
fn play(env: &TestEnv, file: &str, option: &str, topics: &[&str]) -> (Outcome, Value) {
    let before = env.hub(&["--link=a=/no/such/port"]);
    let mut subscriber = env.echo(topics);
    assert_eq!(before.end(KILL).exit_code, None);
    subscriber.await_line("hub_gone", |line| line["kind"] == "hub_gone");
    let hub = env.hub(&["--link", &format!("a=file:{file}{option}")]);
    let info = await_end(env);
    subscriber.await_line("the end", |line| line["state"] == "silent");
    let outcome = subscriber.end(INT);
    assert_eq!(hub.end(INT).exit_code, Some(0));
    (outcome, info)
}

/// Waits until the recording has ended, and returns the line that `info` prints for the link. Asserts that every byte
/// of the recording is counted.
fn await_end(env: &TestEnv) -> Value {
    let info = env.await_info("a", |info| info["state"] == "silent");
    assert_eq!(info["last_error"], "the recording is at its end");
    let counter = |name: &str| number(&info["counters"], name);
    let parts = ["bytes_in_telegrams", "bytes_acknowledge", "bytes_discarded", "bytes_buffered"].map(counter);
    assert_eq!(counter("bytes_read"), parts.into_iter().sum::<u64>(), "{info}");
    assert_eq!(counter("loan_failed"), 0);
    info
}

/// Returns a stream, and the intact telegrams in it. The stream has replies, scans, noise between the telegrams, and
/// one damaged scan.
fn stream(scans: u16) -> (Vec<u8>, Vec<Vec<u8>>) {
    let configuration = lms::reply::configuration_reply(0, Mode(1), Unit::Mm, 0x10).bytes().to_vec();
    let mode = lms::reply::mode_reply(0, true, 0x10).bytes().to_vec();
    let mut random = fastrand::Rng::with_seed(31);
    let mut noise = move |len: usize| -> Vec<u8> { (0..len).map(|_| random.u8(..)).collect() };
    let (mut bytes, mut whole) = (noise(100), Vec::new());
    for (number, telegram) in
        [configuration, mode].into_iter().chain((0..scans).map(testkit::scan)).enumerate()
    {
        if number == 4 {
            // Damage this telegram: ten of its bytes are missing.
            bytes.extend([&telegram[..300], &telegram[310..]].concat());
            continue;
        }
        bytes.extend(&telegram);
        whole.push(telegram);
        bytes.extend(noise(if number % 3 == 0 { 57 } else { 0 }));
    }
    (bytes, whole)
}

fn check(outcome: &Outcome, expected: &[Vec<u8>]) {
    assert_eq!(outcome.exit_code, Some(0), "{}", outcome.stderr);
    let telegrams = outcome.of_class("telegram");
    let received: Vec<_> = telegrams.iter().map(bytes_of).collect();
    assert!(received == expected, "{} telegrams instead of {}", received.len(), expected.len());
    assert_eq!(
        (contiguous_numbers(&telegrams, "seq")[0], contiguous_numbers(&telegrams, "topic_seq")[0]),
        (0, 0)
    );
}

#[test]
fn marks_of_a_recording_need_the_configured_mode() {
    let env = TestEnv::new();
    let bytes = (0..4).flat_map(testkit::scan).collect::<Vec<u8>>();
    let link = format!("--link=a=file:{}", env.file("recording", &bytes));
    let hub = env.hub(&[&link]);
    await_end(&env);
    let info = env.run(&["info", "a"]).to_string();
    assert!(info.contains("does not contain its measuring mode; set link.a.mode"), "{info}");
    assert_eq!(env.info("a")["marks"]["available"], Value::Null);
    assert_eq!(hub.end(INT).exit_code, Some(0));
    let hub = env.hub(&[&link, "--set=link.a.mode=0x01"]);
    await_end(&env);
    let info = env.info("a");
    assert_eq!((&info["marks"]["available"], &info["mode"]), (&Value::Bool(true), &Value::from(1)), "{info}");
    assert_eq!(hub.end(INT).exit_code, Some(0));
}

#[test]
fn ambiguous_values_make_no_scans_until_mode_is_set() {
    let env = TestEnv::new();
    // In 14 bits, this value is 8.6 m. In 13 bits, it would be 0.4 m.
    let scan = lms::measured::encode(0, Unit::Mm, &[8600; 181], 0x10);
    let file = env.file("recording", scan.bytes().repeat(100));
    let message = "the recording does not contain its measuring mode: no scans; set link.a.mode";
    let (outcome, _) = play(&env, &file, "", &["a/telegram", "a/scan", "a/status"]);
    assert_eq!((outcome.of_class("telegram").len(), outcome.of_class("scan").len()), (100, 0), "{outcome}");
    assert!(outcome.of_class("status").iter().any(|line| line["last_error"] == message), "{outcome}");
    let log = env.path("a.log").display().to_string();
    let refused = env.run(&["convert", &file, &log]);
    assert!(
        refused.exit_code == Some(66) && refused.stderr.contains("does not contain its measuring mode"),
        "{refused}"
    );
    let hub = env.hub(&[&format!("--link=a=file:{file}"), "--set=link.a.mode=0x04"]);
    let outcome = env.run(&["echo", "--json", "a/scan", "-n", "1", "--timeout=30s"]);
    let ranges: Vec<_> = outcome.of_class("scan").iter().map(|scan| scan["ranges"][7].clone()).collect();
    assert_eq!(ranges, [8600], "{outcome}");
    assert_eq!(hub.end(INT).exit_code, Some(0));
    // If no value in the recording has more than 13 bits, the values are not ambiguous.
    let plain = env.file("plain", testkit::scan(1).repeat(2));
    let (hub, words) = (env.hub(&[&format!("--link=a=file:{plain}")]), "no value has more than 13 bits");
    assert_eq!(await_end(&env)["counters"]["telegrams"], 2);
    let outcome = hub.end(INT);
    assert!(outcome.stderr.contains(words), "{outcome}");
}

#[test]
fn subscriber_at_start_gets_the_whole_recording() {
    let env = TestEnv::new();
    let (bytes, whole) = stream(14);
    let file = env.file("recording", &bytes);
    let hub = env.hub(&[&format!("--link=a=file:{file}?rate=max")]);
    // The hub waits for a second before it plays the recording. This is long enough for the subscriber to attach to its
    // topic.
    let outcome = env.run(&["echo", "--json", "a/telegram", "-n", &whole.len().to_string(), "--timeout=30s"]);
    check(&outcome, &whole);
    assert_eq!(hub.end(INT).exit_code, Some(0));
}

#[test]
fn file_without_a_telegram_does_not_stream() {
    let env = TestEnv::new();
    let hub = env.hub(&[&format!("--link=a=file:{},family=lms", env.file("noise", vec![0x42; 4000]))]);
    let info = await_end(&env);
    assert_eq!(info["counters"]["bytes_discarded"], 4000);
    let outcome = hub.end(INT);
    assert!(outcome.stderr.contains("there is no telegram in the recording"), "{outcome}");
    assert!(!outcome.stderr.contains("streaming"), "{outcome}");
}

#[test]
fn reflectors_of_a_recording_are_marks() {
    let Some(data) = data() else { return };
    let recording = data.join("captures/reflector_levels_cm_18s.bin");
    let env = TestEnv::new();
    let link = format!("--link=a=file:{}", recording.display());
    let hub = env.hub(&[&link, "--set=link.a.mode=0x01"]);
    let outcome = env.run(&["echo", "--json", "a/marks", "-n", "20"]);
    let found = |line: &Value| line["marks"].as_array().map_or(0, Vec::len);
    assert!(outcome.of_class("marks").iter().any(|line| found(line) == 5), "{outcome}");
    assert_eq!(hub.end(INT).exit_code, Some(0));
}

#[test]
fn plays_a_recording_at_maximum_rate() {
    let env = TestEnv::new();
    // Use no more scans than fit into a subscriber's buffer, because the hub does not wait for subscribers.
    let (bytes, whole) = stream(14);
    let file = env.file("recording", &bytes);
    let (outcome, info) = play(&env, &file, "?rate=max", &["a/telegram", "a/status"]);
    check(&outcome, &whole);
    let [read, telegrams] = ["bytes_read", "telegrams"].map(|name| number(&info["counters"], name));
    assert_eq!((read, telegrams), (bytes.len() as u64, whole.len() as u64));
    assert_eq!(info["port"], format!("file:{file}?rate=max"));
}

#[test]
fn plays_a_recording_at_the_scanners_rate() {
    let env = TestEnv::new();
    let (bytes, whole) = stream(60);
    let file = env.file("recording", &bytes);
    let (outcome, _) = play(&env, &file, "", &["a/telegram", "a/scan", "a/status"]);
    check(&outcome, &whole);
    let scans = outcome.of_class("scan");
    assert_eq!((scans.len(), contiguous_numbers(&scans, "topic_seq")[0]), (whole.len() - 2, 0));
    // The reply at the start of the recording states mode 1, in which a value has 13 bits of range.
    for (scan, telegram) in scans.iter().zip(&whole[2..]) {
        let first = u16::from_le_bytes([telegram[7], telegram[8]]);
        assert_eq!(
            (scan["ranges"][0].as_u64(), &scan["unit_um"]),
            (Some(u64::from(first & 0x1FFF)), &1000.into())
        );
    }
    // The hub plays the stream in real time, which takes at least 59 periods of 26.64 ms. On a busy machine, it takes
    // longer.
    let stamps: Vec<_> = scans.iter().map(|scan| number(scan, "stamp_ns")).collect();
    let span_ms = (stamps[stamps.len() - 1] - stamps[0]) / 1_000_000;
    assert!(span_ms > 1_200, "{span_ms} ms");
}

#[test]
fn plays_a_carmen_log() {
    let env = TestEnv::new();
    let metres = |scan: usize, beam: usize| 1.0 + 0.25 * scan as f64 + 0.01 * beam as f64;
    let line = |scan: usize| {
        let ranges: Vec<_> = (0..181).map(|beam| format!("{:.2}", metres(scan, beam))).collect();
        format!("FLASER 181 {} 0 0 0 0 0 0 {scan}.5 host {scan}.5\n", ranges.join(" "))
    };
    let log = (0..10).fold("# a log\nPARAM robot_length 0.5\n".to_owned(), |log, scan| log + &line(scan));
    let file = env.file("log", log);
    let (outcome, _) = play(&env, &file, "?rate=max", &["a/scan", "a/status"]);
    let scans = outcome.of_class("scan");
    assert_eq!(scans.len(), 10, "{outcome}");
    for (number, scan) in scans.iter().enumerate() {
        let expected: Vec<Value> =
            (0..181).map(|beam| ((metres(number, beam) * 100.0).round() as u64).into()).collect();
        assert_eq!(
            (&scan["ranges"], &scan["step_deg"], &scan["unit_um"]),
            (&expected.into(), &1.0.into(), &10_000.into())
        );
    }
}

/// Returns the directory with recordings of real sensors, which are not part of the project: the directory in the
/// variable `SCANHUB_DATA`, or a default directory next to the project. Skips the test if the directory does not exist.
fn data() -> Option<PathBuf> {
    let default_folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let place = std::env::var_os("SCANHUB_DATA").map_or(default_folder, PathBuf::from);
    if place.is_dir() {
        return Some(place);
    }
    skip("recordings", format!("none of real sensors at {}", place.display()));
    None
}

/// Returns the counters of a hub that has read the file `name` of `data` to its end.
fn counters_of(data: &std::path::Path, name: &str) -> Value {
    let env = TestEnv::new();
    let path = data.join(name);
    let link = format!("--link=a=file:{}?rate=max,family=lms", path.display());
    let _hub: Program = env.hub(&[link]);
    await_end(&env)["counters"].clone()
}

#[test]
fn hub_plays_recordings_of_real_scanners() {
    let Some(data) = data() else { return };
    for (name, telegrams) in [
        ("captures/lms200_38400.bin", Some(427)),
        ("captures/reflector_levels_cm_18s.bin", Some(675)),
        ("captures/scan_interrupted_by_reply.bin", Some(1)),
        ("carmen/orebro-corrected.log.gz", Some(237)),
        ("carmen/intel-corrected.log.gz", Some(910)),
    ] {
        let counters = counters_of(&data, name);
        assert_eq!(counters["telegrams"].as_u64(), telegrams, "{name}: {counters}");
    }
    // These bytes were received at a wrong baud rate, so the hub must not accept any telegram.
    let counters = counters_of(&data, "captures/host19200_while_sensor_38400.bin");
    assert_eq!((&counters["telegrams"], &counters["bytes_discarded"]), (&0.into(), &7745.into()));
}
