//! Tests of `scanhub record`: however the recorder ended, the file has everything that the hub published during the
//! recording, and readers of other projects can read the file.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::Path;

use crate::testkit;
use crate::testkit::{
    HUP, INT, KILL, Outcome, Program, RecordedMessage, Recording, TERM, TestEnv, contiguous_topic_seqs, hash,
    is_class, number, output, python,
};
use serde_json::Value;

/// Starts two sensors and waits until both stream.
fn sensors(env: &TestEnv, flags: &[&str]) -> [Program; 2] {
    let simulator = env.simulator(&["front", "rear"], flags);
    let hub = env.hub(&[env.link("front"), env.link("rear")]);
    for sensor in ["front", "rear"] {
        env.await_info(sensor, |info| info["state"] == "streaming");
    }
    [simulator, hub]
}

/// Starts a recorder with these flags, which writes to `walk.mcap`, and waits until it has written at least `count`
/// samples.
fn start_recorder(env: &TestEnv, flags: &[&str], count: u64) -> Program {
    let file = env.path_argument("walk.mcap");
    let mut recorder = env.start(&[&["record", "--json", "-o", &file], flags].concat());
    await_samples(&mut recorder, count);
    recorder
}

fn await_samples(recorder: &mut Program, count: u64) -> Value {
    recorder.await_line("samples", |line| line["class"] == "recording" && number(line, "samples") >= count)
}

/// Asserts that the recorder ended successfully, and returns its last line.
fn recorder_summary(outcome: &Outcome) -> Value {
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let lines = outcome.lines();
    let last = lines.last().unwrap_or_else(|| panic!("{outcome}"));
    assert_eq!(last["class"], "recorded", "{outcome}");
    last.clone()
}

#[test]
fn records_each_sample_exactly_once() {
    let env = TestEnv::new();
    let others = sensors(&env, &["--world=room", "--seed=3"]);
    let file = env.path("walk.mcap");
    let outcome = env.run(&["record", "--json", "--for=3s", "-o", &env.path_argument("walk.mcap")]);
    let end = recorder_summary(&outcome);
    let recording = Recording::read_complete(&file);
    let topics: BTreeSet<_> = recording.messages.iter().map(|message| message.topic.as_str()).collect();
    let usual = ["telegram", "marks", "zones", "foreground", "status"];
    let expected = ["front", "rear"].map(|sensor| usual.map(|topic| format!("{sensor}/{topic}")));
    assert_eq!(topics, expected.iter().flatten().map(String::as_str).collect());
    assert_eq!(number(&end, "samples"), recording.messages.len() as u64);
    assert_eq!(number(&end, "bytes"), std::fs::metadata(&file).unwrap().len());
    assert_eq!(number(&end, "dropped"), 0);
    assert!(recording.messages.iter().all(|message| message.encoding == "scanhub.v2"));
    for line in outcome.of_class("summary") {
        let topic = format!("{}/{}", line["sensor"].as_str().unwrap(), line["topic"].as_str().unwrap());
        assert_eq!(number(&line, "received"), recording.of(&topic).len() as u64, "{line}");
    }
    for sensor in ["front", "rear"] {
        let telegrams = recording.of(&format!("{sensor}/telegram"));
        assert!(telegrams.len() > 2, "{} telegrams", telegrams.len());
        contiguous_topic_seqs(&telegrams);
        let truth = env.truth(sensor);
        let sent: HashSet<_> = truth.iter().map(|sent| &sent.hash).collect();
        assert!(telegrams.iter().all(|message| sent.contains(&hash(message.payload()))), "never sent");
        for message in &telegrams {
            assert_eq!(
                (message.sequence, message.schema.as_str()),
                (message.topic_seq() as u32, "scanhub.Telegram.v2")
            );
        }
        // Samples that were derived from one telegram have the same log time as the telegram.
        let times: BTreeMap<_, _> =
            telegrams.iter().map(|message| (message.seq(), message.log_time)).collect();
        let marks = recording.of(&format!("{sensor}/marks"));
        let same = |message: &&&RecordedMessage| {
            times.get(&message.seq()).is_none_or(|time| *time == message.log_time)
        };
        assert_eq!(marks.iter().filter(same).count(), marks.len());
    }
    let [facts] = &recording.metadata("scanhub")[..] else { panic!("{:?}", recording.metadata) };
    assert_eq!((facts["part"].as_str(), facts["started"].len()), ("1", 20), "{facts:?}");
    let [run_note] = &recording.metadata("scanhub.run")[..] else { panic!("{:?}", recording.metadata) };
    assert_eq!(run_note["hub_pid"], others[1].pid().to_string());
}

#[test]
fn recording_is_complete_after_every_signal() {
    let env = TestEnv::new();
    let _others = sensors(&env, &[]);
    for signal in [INT, TERM, HUP] {
        let outcome = start_recorder(&env, &["--force", "*/telegram"], 30).end(signal);
        let end = recorder_summary(&outcome);
        let recording = Recording::read_complete(&env.path("walk.mcap"));
        assert_eq!(number(&end, "samples"), recording.messages.len() as u64);
        contiguous_topic_seqs(&recording.of("front/telegram"));
        contiguous_topic_seqs(&recording.of("rear/telegram"));
    }
}

#[test]
fn compresses_with_the_chosen_format() {
    let env = TestEnv::new();
    let _others = sensors(&env, &["--world=room"]);
    let file = env.path_argument("walk.mcap");
    let bytes_each = [(&[][..], "zstd"), (&["--compression=lz4"], "lz4"), (&["--compression=none"], "")].map(
        |(flags, expected)| {
            let words = [&["record", "--json", "--force", "-o", &file][..], flags].concat();
            let mut recorder = env.start(&words);
            recorder
                .await_line("samples", |line| is_class("recording")(line) && number(line, "samples") > 1_500);
            let samples = number(&recorder_summary(&recorder.end(INT)), "samples");
            assert_eq!(Recording::read_complete(&env.path("walk.mcap")).messages.len() as u64, samples);
            let bytes = std::fs::read(&file).unwrap();
            let chunks = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
            assert!(
                chunks.len() > 1 && chunks.iter().all(|chunk| chunk.compression == expected),
                "{expected}"
            );
            bytes.len() as u64 / samples
        },
    );
    let [zstd, lz4, none] = bytes_each;
    assert!(zstd < lz4 && lz4 < none && 3 * zstd < 2 * none, "{bytes_each:?}");
    assert_eq!(env.run(&["record", "--compression=zip"]).exit_code, Some(2));
}

#[test]
fn killed_recorder_keeps_all_reported_samples() {
    let env = TestEnv::new();
    let _others = sensors(&env, &[]);
    let mut recorder = start_recorder(&env, &[], 1);
    let reported = await_samples(&mut recorder, 300);
    assert_eq!(recorder.end(KILL).exit_code, None);
    let recording = Recording::read_interrupted(&env.path("walk.mcap"));
    assert!(
        recording.messages.len() as u64 >= number(&reported, "samples"),
        "{reported}: {}",
        recording.messages.len()
    );
    contiguous_topic_seqs(&recording.of("front/telegram"));
    let Some(mut python) = python("mcap") else { return };
    python.args(["tests/testkit/read.py", "left", &env.path_argument("walk.mcap")]);
    assert_eq!(run_reader(python)["messages"], recording.messages.len());
}

/// Runs `python` with an independent MCAP reader and returns the output of this reader.
fn run_reader(mut python: std::process::Command) -> Value {
    let outcome = output(python.current_dir(env!("CARGO_MANIFEST_DIR"))).unwrap();
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
    serde_json::from_slice(&outcome.stdout).unwrap()
}

#[test]
fn recording_continues_after_a_restart_of_the_hub() {
    let env = TestEnv::new();
    let [_simulator, hub] = sensors(&env, &[]);
    let mut recorder = start_recorder(&env, &["*/telegram"], 30);
    assert_eq!(hub.end(KILL).exit_code, None);
    recorder.await_line("hub_gone", |line| line["kind"] == "hub_gone");
    // The next hub has a sensor with a new name, which the recorder must record, too.
    let other = env.hub(&[env.link("front"), env.link("rear").replace("rear=", "back=")]);
    recorder.await_line("hub_back", |line| line["kind"] == "hub_back");
    env.await_info("back", |info| info["state"] == "streaming");
    testkit::wait_until("the new sensor is recorded", || env.subscribers("back/telegram") > 0);
    let before = number(&await_samples(&mut recorder, 1), "samples");
    await_samples(&mut recorder, before + 200);
    recorder_summary(&recorder.end(TERM));
    drop(other);
    let recording = Recording::read_complete(&env.path("walk.mcap"));
    let telegrams = recording.of("front/telegram");
    let boots: BTreeSet<_> = telegrams.iter().map(|message| message.boot()).collect();
    let recorded_runs: BTreeSet<_> =
        recording.metadata("scanhub.run").iter().map(|run_note| run_note["boot"].clone()).collect();
    assert_eq!((boots.len(), recorded_runs.len()), (2, 2));
    assert_eq!(boots.iter().map(|boot| format!("{boot:016x}")).collect::<BTreeSet<_>>(), recorded_runs);
    assert!(!recording.of("back/telegram").is_empty());
}

#[test]
fn refuses_impossible_outputs_and_topics() {
    let env = TestEnv::new();
    let file = env.file("walk.mcap", "somebody's");
    let kind = |arguments: &[&str]| {
        let outcome = env.run(&[&["record", "--json"], arguments].concat());
        let lines = [outcome.lines(), stderr_lines(&outcome)].concat();
        let error = lines.into_iter().find(is_class("error")).unwrap_or_else(|| panic!("{outcome}"));
        (outcome.exit_code, error["kind"].as_str().unwrap_or_default().to_owned())
    };
    assert_eq!(kind(&["-o", &file]), (Some(73), "output".into()));
    assert_eq!(std::fs::read(&file).unwrap(), b"somebody's");
    assert_eq!(kind(&["-o", &env.path_argument("nowhere/walk.mcap")]), (Some(73), "output".into()));
    let hint = |arguments: &[&str]| {
        let outcome = env.run(&[&["record", "--json"], arguments].concat());
        assert_eq!(outcome.exit_code, Some(73), "{outcome}");
        outcome.of_class("error")[0]["hint"].as_str().unwrap().to_owned()
    };
    assert!(hint(&["-o", &env.path_argument("")]).starts_with("name a file in it"));
    for words in [&["-o", "/dev/full"][..], &["-o", "/dev/full", "--force"]] {
        assert!(hint(words).ends_with("- > /dev/full"), "{}", hint(words));
    }
    env.file("parts-0007.mcap", "somebody's");
    let earlier = hint(&["-o", &env.path_argument("parts.mcap"), "--split=1h"]);
    assert!(earlier.starts_with("--force continues after the last number"), "{earlier}");
    assert_eq!(kind(&["-o", "-", "--split", "1h"]), (Some(2), "usage".into()));
    assert_eq!(kind(&["--keep", "3"]), (Some(2), "usage".into()));
    assert_eq!(kind(&["--split", "3"]), (Some(2), "usage".into()));
    for words in [&["--ros2", "--all"][..], &["--ros2", "front/telegram"]] {
        let outcome = env.run(&[&["record", "-o", &env.path_argument("new.mcap")], words].concat());
        assert_eq!(outcome.exit_code, Some(2), "{outcome}");
        assert!(outcome.stderr.contains("records only ROS messages, and"), "{outcome}");
        assert!(
            outcome.stderr.contains("convert later: `scanhub convert IN.mcap OUT.mcap --ros2`"),
            "{outcome}"
        );
    }
    assert_eq!(kind(&["robot/zones"]), (Some(2), "usage".into()));
    assert_eq!(kind(&["front/scam"]), (Some(2), "usage".into()));
    // If no sample was recorded, no file remains.
    let new = env.path_argument("new.mcap");
    assert_eq!(kind(&["-o", &new, "--for", "5s"]), (Some(3), "no_hub".into()));
    assert!(!Path::new(&new).exists());
    let outcome = env.run(&["record", "-o", &new, "--for", "5s"]);
    assert!(!String::from_utf8_lossy(&outcome.stdout).contains("0 samples"), "{outcome}");
}

fn stderr_lines(outcome: &Outcome) -> Vec<Value> {
    outcome.stderr.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}
