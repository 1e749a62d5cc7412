//! Tests of recordings that start while an RPLIDAR already streams, so that they lack the replies that identify the
//! scanner. The replay decodes the packets with the mode and the number of beams in the recorded status.

use scanhub_schema::Header;

use crate::replay_packets::{recorder, replay, samples, scan};
use crate::testkit::{INT, TERM, TestEnv, is_class};

/// Starts a recorder while an RPLIDAR streams with these settings. The recorder runs until a subscriber has received
/// `scans` scans.
fn record(env: &TestEnv, model: &str, settings: &[&str], scans: usize) {
    let words = ["--family=rplidar", &format!("--model={model}"), "--world=room", "--seed=5"];
    let faults = "--fault=loss=0.01,burst=40";
    let simulator = env.simulator(&["front"], &[&words[..], &[faults]].concat());
    let set = ["family=rplidar"].iter().chain(settings).map(|set| format!("--set=link.front.{set}"));
    let hub = env.hub(&[vec![env.link("front")], set.collect()].concat());
    env.await_info("front", |info| info["state"] == "streaming" && info["hz"].as_f64() > Some(5.0));
    let recorder = recorder(env, "all.mcap", &["--all"]);
    let mut echo = env.echo(&["front/scan"]);
    echo.await_lines(scans, "a scan", is_class("scan"));
    assert_eq!(recorder.end(INT).exit_code, Some(0));
    assert_eq!((echo.end(INT).exit_code, hub.end(TERM).exit_code), (Some(0), Some(0)));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
}

/// Asserts that the recorded scans are replayed in the same order and with the same flags. Finds a replayed scan by its
/// ranges, because sequence numbers differ. With a wrong mode or number of beams, no scan would match. Some scans need
/// not match: on a busy machine, stamps of packets are inexact, so the replay may detect gaps elsewhere and lack some
/// scans. (In virtual time, it lacks none.)
fn check(recorded: &[(Header, Vec<u8>)], replayed: &[(Header, Vec<u8>)]) {
    let (mut rest, mut compared) = (replayed, 0);
    for (header, payload) in recorded {
        let then = scan(payload);
        let found = rest.iter().position(|(_, payload)| scan(payload).ranges() == then.ranges());
        let Some(at) = found else { continue };
        let now = scan(&rest[at].1);
        assert_eq!((then.flags, then.collisions), (now.flags, now.collisions), "{}", header.seq);
        rest = &rest[at + 1..];
        compared += 1;
    }
    assert!(compared > 10, "{compared} of {} scans, {} replayed", recorded.len(), replayed.len());
}

#[test]
fn recorded_status_supplies_mode_and_beams() {
    // Packets of the modes express and dense begin with the same bytes, so packets alone do not show the mode.
    for (model, settings, beams) in [
        ("a1", ["model=a1", "mode=express", "beams=400"], 400),
        ("s1", ["model=auto", "mode=denseboost", "beams=700"], 700),
    ] {
        let env = TestEnv::new();
        record(&env, model, &settings, 60);
        let recorded = samples(&env.path("all.mcap"), "front/scan");
        assert!(recorded.iter().all(|(_, payload)| scan(payload).beams() == beams), "{model}");
        replay(&env, "all.mcap", &[]);
        check(&recorded, &samples(&env.path("replayed.mcap"), "front/scan"));
    }
}

#[test]
fn ambiguous_packets_need_a_configured_model_or_mode() {
    // Packets of the types 82h and 85h cannot be distinguished.
    for (model, mode) in [("a1", "express"), ("s1", "denseboost")] {
        let env = TestEnv::new();
        let mode = format!("mode={mode}");
        let words = ["--family=rplidar", &format!("--model={model}"), "--world=room", "--seed=5"];
        let simulator = env.simulator(&["front"], &words);
        let set = ["family=rplidar", &mode].map(|set| format!("--set=link.front.{set}"));
        let hub = env.hub(&[vec![env.link("front")], set.to_vec()].concat());
        // While the scanner streams, the hub sends no requests, so the recording has no replies.
        env.await_info("front", |info| info["state"] == "streaming");
        let recorder = recorder(&env, "telegrams.mcap", &["front/telegram"]);
        let mut echo = env.echo(&["front/scan"]);
        echo.await_lines(15, "a scan", is_class("scan"));
        assert_eq!(recorder.end(INT).exit_code, Some(0));
        assert_eq!((echo.end(INT).exit_code, hub.end(TERM).exit_code), (Some(0), Some(0)));
        assert_eq!(simulator.end(TERM).exit_code, Some(0));

        let (recording, rows) = (env.path_argument("telegrams.mcap"), env.path_argument("rows.csv"));
        for words in [vec!["replay", "--no-system-config", &recording], vec!["convert", &recording, &rows]] {
            let outcome = env.run(&words);
            assert_eq!(outcome.exit_code, Some(66), "{model}: {outcome}");
            let messages = ["does not say which kind of packets it has", "link.NAME.model or mode is set"];
            assert!(messages.iter().all(|words| outcome.stderr.contains(words)), "{model}: {outcome}");
        }
        // The remedy that the error message suggests works.
        replay(&env, "telegrams.mcap", &["--rate=max", &format!("--set=link.front.{mode}")]);
        assert!(samples(&env.path("replayed.mcap"), "front/scan").len() > 5, "{model}");
    }
}
