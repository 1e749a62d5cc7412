//! `scanhub convert`: converts recordings to other formats, to files and to stdout.

use std::process::Stdio;

use crate::testkit;
use crate::testkit::{Child, TestEnv, spawn};
use serde_json::json;

#[test]
fn stream_converts_to_a_playable_recording() {
    let env = TestEnv::new();
    let bytes = (0..20).flat_map(testkit::scan).collect::<Vec<u8>>();
    let stream = env.file("a.bin", &bytes);
    let mcap = stream.replace("a.bin", "a.mcap");
    let outcome = env.run(&["convert", &stream, &mcap, "--json", "--sensor=left"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let line = outcome.of_class("converted").pop().unwrap_or_else(|| panic!("{outcome}"));
    let missing = json!({"telegrams": 0, "bytes": 0, "chunks": 0, "stamps": 0, "begin": false, "end": false, "checksum": false});
    assert_eq!(line["sensors"], json!(["left"]));
    assert_eq!((&line["telegrams"], &line["scans"], &line["missing"]), (&json!(20), &json!(20), &missing));
    assert_eq!((&line["from"], &line["to"]), (&json!("telegram stream"), &json!("MCAP")));
    // With `-` as output, the program writes the unchanged telegrams to stdout.
    let outcome = env.run(&["convert", &mcap, "-", "--sensor=left"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert!(outcome.stderr.contains("20 telegrams, 20 scans"), "{}", outcome.stderr);
    // If the reader of stdout closes the pipe early, the program prints no message and exits normally.
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    let mut command = env.command(&["convert", &mcap, "-"]);
    command.stdin(Stdio::null()).stdout(writer).stderr(Stdio::piped());
    let closed = spawn(command).and_then(Child::wait_with_output).expect("the program exits");
    assert_eq!((closed.status.code(), &closed.stderr[..]), (Some(0), &b""[..]), "{closed:?}");
    // A simulated scanner can play the recording.
    let _simulator =
        env.simulator(&["left"], &["--baud=500000", &format!("--replay={mcap}"), "--sensor=left"]);
    let _hub = env.hub(&[env.link("left")]);
    let outcome = env.run(&["echo", "left/scan", "-n", "3", "--json", "--timeout=30s"]);
    assert_eq!(outcome.of_class("scan").len(), 3, "{outcome}");
}

#[test]
fn every_reader_counts_bytes_between_telegrams() {
    let env = TestEnv::new();
    let mut random = fastrand::Rng::with_seed(5);
    let mut bytes = testkit::scan(1);
    bytes.extend((0..31_002).map(|_| random.u8(..)));
    bytes.extend((2..9).flat_map(testkit::scan));
    let stream = env.file("a.bin", &bytes);
    let mcap = stream.replace("a.bin", "a.mcap");
    let outcome = env.run(&["convert", &stream, &mcap]);
    assert!(
        outcome.exit_code == Some(66) && outcome.stderr.contains("lms 15 %"),
        "too few scans for this check: {outcome}"
    );
    let outcome = env.run(&["convert", &stream, &mcap, "--family=lms", "--json"]);
    let line = outcome.of_class("converted").pop().unwrap_or_else(|| panic!("{outcome}"));
    assert_eq!((&line["telegrams"], &line["missing"]["bytes"]), (&json!(8), &json!(31_002)));
    assert_eq!(line["sensors"], json!(["front"]));
    let outcome = env.run(&["convert", &stream, &mcap, "--family=lms", "--force"]);
    assert!(outcome.stderr.contains("31002 bytes that could not be used"), "{outcome}");
    let outcome = env.run(&["telegram", "decode", &stream, "--json"]);
    let summary = outcome.of_class("summary").pop().unwrap_or_else(|| panic!("{outcome}"));
    assert_eq!((&summary["telegrams"], &summary["bytes_discarded"]), (&json!(8), &json!(31_002)));
    assert!(env.run(&["telegram", "decode", &stream]).to_string().contains("31002 bytes in nothing"));
    let hub = env.hub(&[format!("--link=a=file:{stream}?rate=max,family=lms")]);
    let info = env.await_info("a", |info| info["state"] == "silent");
    let counters = &info["counters"];
    assert_eq!((&counters["telegrams"], &counters["bytes_discarded"]), (&json!(8), &json!(31_002)));
    let outcome = hub.end(testkit::INT);
    assert!(outcome.stderr.contains("missing: 31002 bytes that could not be used"), "{outcome}");
}

#[test]
fn reports_lines_dropped_from_a_log() {
    let env = TestEnv::new();
    let scan = |time: &str| format!("FLASER 181{} 1 2 3 1 2 3 {time} host 1\n", " 1.25".repeat(181));
    let lines = ["ODOM 1 2 3 0 0 0 9.5 host 1\n", &scan("10.123457"), &scan("11.5"), "SYNC laser\n"];
    let log = env.file("a.log", lines.concat());
    let outcome = env.run(&["convert", &log, &env.path_argument("a.mcap"), "--json"]);
    let line = outcome.of_class("converted").pop().unwrap_or_else(|| panic!("{outcome}"));
    let dropped = json!({"poses": 2, "odometry": 1, "remissions": 0, "lines": 1});
    assert_eq!((&line["log_dropped"], &line["marks"], &line["dropped"]), (&dropped, &json!(null), &json!(0)));
    let outcome = env.run(&["convert", &log, &env.path_argument("a.bin")]);
    let message = "; dropped from the log: 2 poses, 1 line of odometry, 1 other line";
    assert!(outcome.stderr.contains(message), "{outcome}");
    let outcome = env.run(&["convert", &env.path_argument("a.mcap"), &env.path_argument("b.log"), "--json"]);
    let line = outcome.of_class("converted").pop().unwrap_or_else(|| panic!("{outcome}"));
    assert_eq!(
        (&line["log_dropped"], &line["dropped"], &line["scans"]),
        (&json!(null), &json!(0), &json!(2))
    );
    let back = std::fs::read_to_string(env.path("b.log")).expect("a log");
    assert!(back.contains(" 10.123457 scanhub 0.000000\n"), "{back}");
}

#[test]
fn csv_of_a_recording_has_meters_and_marks() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--world=room", "--mode=0x01"]);
    let _hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let recording = env.path_argument("walk.mcap");
    assert_eq!(env.run(&["record", "-n", "100", "-o", &recording]).exit_code, Some(0));
    let [scans, marks] = ["scans.csv", "marks.csv"].map(|name| env.path_argument(name));
    let outcome = env.run(&["convert", &recording, &scans, "--meters", "--intensities"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let text = std::fs::read_to_string(&scans).expect("rows");
    let names: Vec<&str> = text.lines().next().expect("names").split(',').collect();
    let row: Vec<&str> = text.lines().nth(1).expect("a row").split(',').collect();
    let values = |begin: &str| -> Vec<&str> {
        names.iter().zip(&row).filter(|(name, _)| name.starts_with(begin)).map(|(_, value)| *value).collect()
    };
    let (ranges, intensities) = (values("range_"), values("intensity_"));
    assert_eq!((names.len(), names.len()), (row.len(), 8 + 2 * ranges.len()));
    assert_eq!((values("unit_um"), ranges.len()), (vec!["1000000"], intensities.len()));
    let meters: Vec<f64> = ranges.iter().filter_map(|range| range.parse().ok()).collect();
    assert!(meters.len() > 90 && meters.iter().all(|range| (0.0..82.0).contains(range)), "{ranges:?}");
    assert!(intensities.iter().all(|intensity| intensity.parse::<u8>().is_ok()), "{intensities:?}");
    let outcome = env.run(&["convert", &recording, &marks, "--topic=front/marks", "--json"]);
    let line = outcome.of_class("converted").pop().unwrap_or_else(|| panic!("{outcome}"));
    let text = std::fs::read_to_string(&marks).expect("rows");
    assert!(
        text.starts_with("seq,topic_seq,stamp_ns,wall_ns,quality,marks,mark,angle_deg,range_mm,"),
        "{text}"
    );
    let rows = text.lines().skip(1).filter(|row| row.split(',').nth(6) != Some("")).count();
    assert_eq!((&line["marks"], &line["telegrams"]), (&json!(rows), &json!(0)));
    let words = ["echo", "front/scan", "--csv", "--meters", "--intensities", "-n", "1", "--timeout=30s"];
    let outcome = env.run(&words);
    let text = String::from_utf8_lossy(&outcome.stdout).into_owned();
    assert!(text.contains(",intensity_0,") && text.contains(",1000000,"), "{outcome}");
}

#[test]
fn rejects_impossible_conversions() {
    let env = TestEnv::new();
    let stream = env.file("a.bin", testkit::scan(1));
    let there = env.file("there.bin", "mine");
    for (arguments, code, message) in [
        (["convert", &stream[..], &stream[..]], 73, "both read and written"),
        (["convert", &stream, &there], 73, "--force replaces it"),
        (["convert", &stream, "x.txt"], 2, "is not a known format"),
        (["convert", &there, "x.mcap"], 66, "no telegram in it"),
        (["convert", "/no/such/file", "x.mcap"], 66, "/no/such/file"),
    ] {
        let outcome = env.run(&arguments);
        assert!(outcome.exit_code == Some(code) && outcome.stderr.contains(message), "{outcome}");
    }
    for (output, option, message) in [
        ("x.mcap", "--meters", "scanhub convert IN OUT.csv --meters"),
        ("x.log", "--intensities", "scanhub convert IN OUT.csv --intensities"),
        ("x.bin", "--topic=front/marks", "scanhub convert IN OUT.csv --topic SENSOR/marks"),
        ("x.csv", "--topic=front/zones", "scanhub echo SENSOR/TOPIC --json"),
    ] {
        let outcome = env.run(&["convert", &stream, output, option]);
        assert!(outcome.exit_code == Some(2) && outcome.stderr.contains(message), "{outcome}");
    }
}
