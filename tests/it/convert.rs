//! `scanhub convert`: recordings in another form, as a user at a terminal and a script see it.

use std::process::Stdio;

use crate::testkit;
use crate::testkit::{Child, TestEnv, spawn};
use serde_json::json;

#[test]
fn a_stream_becomes_a_recording_that_plays() {
    let env = TestEnv::new();
    let bytes = (0..20).flat_map(testkit::scan).collect::<Vec<u8>>();
    let stream = env.file("a.bin", &bytes);
    let mcap = stream.replace("a.bin", "a.mcap");
    let outcome = env.run(&["convert", &stream, &mcap, "--json", "--sensor=left"]);
    assert_eq!(outcome.code, Some(0), "{outcome}");
    let line = outcome.of_class("converted").pop().unwrap_or_else(|| panic!("{outcome}"));
    let missing = json!({"telegrams": 0, "bytes": 0, "chunks": 0, "stamps": 0, "begin": false, "end": false, "checksum": false});
    assert_eq!(line["sensors"], json!(["left"]));
    assert_eq!((&line["telegrams"], &line["scans"], &line["missing"]), (&json!(20), &json!(20), &missing));
    assert_eq!((&line["from"], &line["to"]), (&json!("telegram stream"), &json!("MCAP")));
    // The telegrams as they were, to whoever reads stdout.
    let outcome = env.run(&["convert", &mcap, "-", "--sensor=left"]);
    assert_eq!(outcome.code, Some(0), "{outcome}");
    assert!(outcome.errors.contains("20 telegrams, 20 scans"), "{}", outcome.errors);
    // One who has had enough is no trouble, and is told nothing.
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    let mut command = env.command(&["convert", &mcap, "-"]);
    command.stdin(Stdio::null()).stdout(writer).stderr(Stdio::piped());
    let closed = spawn(command).and_then(Child::wait_with_output).expect("it ends");
    assert_eq!((closed.status.code(), &closed.stderr[..]), (Some(0), &b""[..]), "{closed:?}");
    // A simulated sensor has the recording.
    let _simulator =
        env.simulator(&["left"], &["--baud=500000", &format!("--replay={mcap}"), "--sensor=left"]);
    let _hub = env.hub(&[env.link("left")]);
    let outcome = env.run(&["echo", "left/scan", "-n", "3", "--json", "--timeout=30s"]);
    assert_eq!(outcome.of_class("scan").len(), 3, "{outcome}");
}

#[test]
fn bytes_between_telegrams_are_counted_by_whoever_reads_them() {
    let env = TestEnv::new();
    let mut random = fastrand::Rng::with_seed(5);
    let mut bytes = testkit::scan(1);
    bytes.extend((0..31_002).map(|_| random.u8(..)));
    bytes.extend((2..9).flat_map(testkit::scan));
    let stream = env.file("a.bin", &bytes);
    let mcap = stream.replace("a.bin", "a.mcap");
    let outcome = env.run(&["convert", &stream, &mcap, "--json"]);
    let line = outcome.of_class("converted").pop().unwrap_or_else(|| panic!("{outcome}"));
    assert_eq!((&line["telegrams"], &line["missing"]["bytes"]), (&json!(8), &json!(31_002)));
    assert_eq!(line["sensors"], json!(["front"]));
    let outcome = env.run(&["convert", &stream, &mcap, "--force"]);
    assert!(outcome.errors.contains("31002 bytes outside any telegram"), "{outcome}");
    let outcome = env.run(&["telegram", "decode", &stream, "--json"]);
    let summary = outcome.of_class("summary").pop().unwrap_or_else(|| panic!("{outcome}"));
    assert_eq!((&summary["telegrams"], &summary["bytes_discarded"]), (&json!(8), &json!(31_002)));
    assert!(env.run(&["telegram", "decode", &stream]).to_string().contains("31002 bytes in nothing"));
    let hub = env.hub(&[format!("--link=a=file:{stream}?rate=max")]);
    let info = env.await_info("a", |info| info["state"] == "silent");
    let counters = &info["counters"];
    assert_eq!((&counters["telegrams"], &counters["bytes_discarded"]), (&json!(8), &json!(31_002)));
    let outcome = hub.end(testkit::INT);
    assert!(outcome.errors.contains("missing: 31002 bytes outside any telegram"), "{outcome}");
}

#[test]
fn what_cannot_be_converted_is_refused() {
    let env = TestEnv::new();
    let stream = env.file("a.bin", testkit::scan(1));
    let there = env.file("there.bin", "mine");
    for (arguments, code, says) in [
        (["convert", &stream[..], &stream[..]], 73, "both read and written"),
        (["convert", &stream, &there], 73, "--force replaces it"),
        (["convert", &stream, "x.txt"], 2, "is not a known format"),
        (["convert", &there, "x.mcap"], 66, "no telegram in it"),
        (["convert", "/no/such/file", "x.mcap"], 66, "/no/such/file"),
    ] {
        let outcome = env.run(&arguments);
        assert!(outcome.code == Some(code) && outcome.errors.contains(says), "{outcome}");
    }
}
