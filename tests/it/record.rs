//! `scanhub record`: everything that the hub published while it ran is in the file, however it was ended, and others read it.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::Path;

use crate::testkit;
use crate::testkit::{
    HUP, INT, KILL, Kept, Outcome, Program, Recording, TERM, TestEnv, hash, is_class, number, output, python,
    unbroken,
};
use serde_json::Value;

/// Two sensors that stream.
fn sensors(env: &TestEnv, flags: &[&str]) -> [Program; 2] {
    let simulator = env.simulator(&["front", "rear"], flags);
    let hub = env.hub(&[env.link("front"), env.link("rear")]);
    for sensor in ["front", "rear"] {
        env.await_info(sensor, |info| info["state"] == "streaming");
    }
    [simulator, hub]
}

/// A recorder of these flags into `walk.mcap`, of which `count` samples are written at least.
fn recorder(env: &TestEnv, flags: &[&str], count: u64) -> Program {
    let file = env.word("walk.mcap");
    let mut recorder = env.start(&[&["record", "--json", "-o", &file], flags].concat());
    await_samples(&mut recorder, count);
    recorder
}

fn await_samples(recorder: &mut Program, count: u64) -> Value {
    recorder.await_line("samples", |line| line["class"] == "recording" && number(line, "samples") >= count)
}

/// The last line, which says that it came to its end.
fn recorded(outcome: &Outcome) -> Value {
    assert_eq!(outcome.code, Some(0), "{outcome}");
    let lines = outcome.lines();
    let last = lines.last().unwrap_or_else(|| panic!("{outcome}"));
    assert_eq!(last["class"], "recorded", "{outcome}");
    last.clone()
}

#[test]
fn what_was_sent_is_in_the_file_once() {
    let env = TestEnv::new();
    let others = sensors(&env, &["--world=room", "--seed=3"]);
    let file = env.path("walk.mcap");
    let outcome = env.run(&["record", "--json", "--for=3s", "-o", &env.word("walk.mcap")]);
    let end = recorded(&outcome);
    let recording = Recording::whole(&file);
    let topics: BTreeSet<_> = recording.kept.iter().map(|kept| kept.topic.as_str()).collect();
    let usual = ["telegram", "marks", "zones", "foreground", "status"];
    let wanted = ["front", "rear"].map(|sensor| usual.map(|topic| format!("{sensor}/{topic}")));
    assert_eq!(topics, wanted.iter().flatten().map(String::as_str).collect());
    assert_eq!(number(&end, "samples"), recording.kept.len() as u64);
    assert_eq!(number(&end, "bytes"), std::fs::metadata(&file).unwrap().len());
    assert_eq!(number(&end, "dropped"), 0);
    assert!(recording.kept.iter().all(|kept| kept.encoding == "scanhub.v2"));
    for line in outcome.of_class("summary") {
        let topic = format!("{}/{}", line["sensor"].as_str().unwrap(), line["topic"].as_str().unwrap());
        assert_eq!(number(&line, "received"), recording.of(&topic).len() as u64, "{line}");
    }
    for sensor in ["front", "rear"] {
        let telegrams = recording.of(&format!("{sensor}/telegram"));
        assert!(telegrams.len() > 2, "{} telegrams", telegrams.len());
        unbroken(&telegrams);
        let truth = env.truth(sensor);
        let sent: HashSet<_> = truth.iter().map(|sent| &sent.hash).collect();
        assert!(telegrams.iter().all(|kept| sent.contains(&hash(kept.payload()))), "never sent");
        for kept in &telegrams {
            assert_eq!(
                (kept.sequence, kept.schema.as_str()),
                (kept.topic_seq() as u32, "scanhub.Telegram.v2")
            );
        }
        // What came from one telegram has its time.
        let times: BTreeMap<_, _> = telegrams.iter().map(|kept| (kept.seq(), kept.log_time)).collect();
        let marks = recording.of(&format!("{sensor}/marks"));
        let same = |kept: &&&Kept| times.get(&kept.seq()).is_none_or(|time| *time == kept.log_time);
        assert_eq!(marks.iter().filter(same).count(), marks.len());
    }
    let [facts] = &recording.notes("scanhub")[..] else { panic!("{:?}", recording.notes) };
    assert_eq!((facts["part"].as_str(), facts["started"].len()), ("1", 20), "{facts:?}");
    let [life] = &recording.notes("scanhub.life")[..] else { panic!("{:?}", recording.notes) };
    assert_eq!(life["hub_pid"], others[1].pid().to_string());
}

#[test]
fn whatever_ends_it_the_file_is_finished() {
    let env = TestEnv::new();
    let _others = sensors(&env, &[]);
    for signal in [INT, TERM, HUP] {
        let outcome = recorder(&env, &["--force", "*/telegram"], 30).end(signal);
        let end = recorded(&outcome);
        let recording = Recording::whole(&env.path("walk.mcap"));
        assert_eq!(number(&end, "samples"), recording.kept.len() as u64);
        unbroken(&recording.of("front/telegram"));
        unbroken(&recording.of("rear/telegram"));
    }
}

#[test]
fn files_are_packed_as_they_are_told() {
    let env = TestEnv::new();
    let _others = sensors(&env, &["--world=room"]);
    let file = env.word("walk.mcap");
    let bytes_each = [(&[][..], "zstd"), (&["--compression=lz4"], "lz4"), (&["--compression=none"], "")].map(
        |(flags, wanted)| {
            let words = [&["record", "--json", "--force", "-o", &file][..], flags].concat();
            let mut recorder = env.start(&words);
            recorder
                .await_line("samples", |line| is_class("recording")(line) && number(line, "samples") > 1_500);
            let samples = number(&recorded(&recorder.end(INT)), "samples");
            assert_eq!(Recording::whole(&env.path("walk.mcap")).kept.len() as u64, samples);
            let bytes = std::fs::read(&file).unwrap();
            let chunks = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
            assert!(chunks.len() > 1 && chunks.iter().all(|chunk| chunk.compression == wanted), "{wanted}");
            bytes.len() as u64 / samples
        },
    );
    let [zstd, lz4, none] = bytes_each;
    assert!(zstd < lz4 && lz4 < none && 3 * zstd < 2 * none, "{bytes_each:?}");
    assert_eq!(env.run(&["record", "--compression=zip"]).code, Some(2));
}

#[test]
fn a_kill_leaves_all_that_was_told() {
    let env = TestEnv::new();
    let _others = sensors(&env, &[]);
    let mut recorder = recorder(&env, &[], 1);
    let told = await_samples(&mut recorder, 300);
    assert_eq!(recorder.end(KILL).code, None);
    let recording = Recording::left(&env.path("walk.mcap"));
    assert!(recording.kept.len() as u64 >= number(&told, "samples"), "{told}: {}", recording.kept.len());
    unbroken(&recording.of("front/telegram"));
    let Some(mut python) = python("mcap") else { return };
    python.args(["tests/testkit/read.py", "left", &env.word("walk.mcap")]);
    assert_eq!(said(python)["messages"], recording.kept.len());
}

/// What the reader of other people, which `python` starts, says.
fn said(mut python: std::process::Command) -> Value {
    let outcome = output(python.current_dir(env!("CARGO_MANIFEST_DIR"))).unwrap();
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
    serde_json::from_slice(&outcome.stdout).unwrap()
}

#[test]
fn a_hub_that_comes_back_goes_on_in_the_file() {
    let env = TestEnv::new();
    let [_simulator, hub] = sensors(&env, &[]);
    let mut recorder = recorder(&env, &["*/telegram"], 30);
    assert_eq!(hub.end(KILL).code, None);
    recorder.await_line("hub_gone", |line| line["kind"] == "hub_gone");
    // It has another sensor than before, which is recorded, too.
    let other = env.hub(&[env.link("front"), env.link("rear").replace("rear=", "back=")]);
    recorder.await_line("hub_back", |line| line["kind"] == "hub_back");
    env.await_info("back", |info| info["state"] == "streaming");
    testkit::until("the new sensor is recorded", || env.subscribers("back/telegram") > 0);
    let before = number(&await_samples(&mut recorder, 1), "samples");
    await_samples(&mut recorder, before + 200);
    recorded(&recorder.end(TERM));
    drop(other);
    let recording = Recording::whole(&env.path("walk.mcap"));
    let telegrams = recording.of("front/telegram");
    let boots: BTreeSet<_> = telegrams.iter().map(|kept| kept.boot()).collect();
    let lives: BTreeSet<_> =
        recording.notes("scanhub.life").iter().map(|life| life["boot"].clone()).collect();
    assert_eq!((boots.len(), lives.len()), (2, 2));
    assert_eq!(boots.iter().map(|boot| format!("{boot:016x}")).collect::<BTreeSet<_>>(), lives);
    assert!(!recording.of("back/telegram").is_empty());
}

#[test]
fn what_cannot_be_recorded_is_refused() {
    let env = TestEnv::new();
    let file = env.file("walk.mcap", "somebody's");
    let kind = |arguments: &[&str]| {
        let outcome = env.run(&[&["record", "--json"], arguments].concat());
        let lines = [outcome.lines(), stderr_lines(&outcome)].concat();
        let error = lines.into_iter().find(is_class("error")).unwrap_or_else(|| panic!("{outcome}"));
        (outcome.code, error["kind"].as_str().unwrap_or_default().to_owned())
    };
    assert_eq!(kind(&["-o", &file]), (Some(73), "output".into()));
    assert_eq!(std::fs::read(&file).unwrap(), b"somebody's");
    assert_eq!(kind(&["-o", &env.word("nowhere/walk.mcap")]), (Some(73), "output".into()));
    let hint = |arguments: &[&str]| {
        let outcome = env.run(&[&["record", "--json"], arguments].concat());
        assert_eq!(outcome.code, Some(73), "{outcome}");
        outcome.of_class("error")[0]["hint"].as_str().unwrap().to_owned()
    };
    assert!(hint(&["-o", &env.word("")]).starts_with("name a file in it"));
    for words in [&["-o", "/dev/full"][..], &["-o", "/dev/full", "--force"]] {
        assert!(hint(words).ends_with("- > /dev/full"), "{}", hint(words));
    }
    env.file("parts-0007.mcap", "somebody's");
    let earlier = hint(&["-o", &env.word("parts.mcap"), "--split=1h"]);
    assert!(earlier.starts_with("--force continues after the last number"), "{earlier}");
    assert_eq!(kind(&["-o", "-", "--split", "1h"]), (Some(2), "usage".into()));
    assert_eq!(kind(&["--keep", "3"]), (Some(2), "usage".into()));
    assert_eq!(kind(&["--split", "3"]), (Some(2), "usage".into()));
    for words in [&["--ros2", "--all"][..], &["--ros2", "front/telegram"]] {
        let outcome = env.run(&[&["record", "-o", &env.word("new.mcap")], words].concat());
        assert_eq!(outcome.code, Some(2), "{outcome}");
        assert!(outcome.errors.contains("records only ROS messages, and"), "{outcome}");
        assert!(
            outcome.errors.contains("convert later: `scanhub convert IN.mcap OUT.mcap --ros2`"),
            "{outcome}"
        );
    }
    assert_eq!(kind(&["robot/zones"]), (Some(2), "usage".into()));
    assert_eq!(kind(&["front/scam"]), (Some(2), "usage".into()));
    // Nothing came, nothing stays.
    let new = env.word("new.mcap");
    assert_eq!(kind(&["-o", &new, "--for", "5s"]), (Some(3), "no_hub".into()));
    assert!(!Path::new(&new).exists());
    let outcome = env.run(&["record", "-o", &new, "--for", "5s"]);
    assert!(!String::from_utf8_lossy(&outcome.out).contains("0 samples"), "{outcome}");
}

fn stderr_lines(outcome: &Outcome) -> Vec<Value> {
    outcome.errors.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}
