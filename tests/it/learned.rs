//! Saved backgrounds: a hub starts with the background that the previous hub learned, even if that hub was killed. The
//! hub does not use a saved background that would be wrong: at another pose, after a reset, with other settings, or for
//! a recording.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;

use crate::testkit;
use crate::testkit::{KILL, Outcome, Program, TERM, TestEnv, is_class, number};
use serde_json::Value;

/// Setting with which a hub learns the background within a test.
const QUICK_LEARNING: &str = "--set=background.scans=20";
/// Setting with which a hub does not learn a background within a test, so that a known background must come from a
/// file.
const SLOW_LEARNING: &str = "--set=background.scans=8191";

/// World with a wall around the sensor, 3 m ahead.
const ROOM_WORLD: &str = "[noise]\nerrors = 0\ntail = 0\n\n\
     [[thing]]\nline = [[3000, -500], [3000, 3000], [-3000, 3000], [-3000, -500]]\n";
/// Post in the world of [`ROOM_WORLD`], 1.5 m ahead of the sensor.
const POST: &str = "\n[[thing]]\nradius_mm = 150\npose = [0, 1500]\n";

fn simulator(env: &TestEnv, world: &str) -> Program {
    let world = env.file("world.toml", world);
    env.simulator(&["front"], &["--seed=17", "--baud=500000", &format!("--world={world}")])
}

fn file(env: &TestEnv) -> PathBuf {
    env.path("state/scanhub").join(env.domain().name()).join("front.background.json")
}

fn show_background(env: &TestEnv) -> Value {
    let outcome = env.run(&["background", "front", "show", "--json"]);
    let [line] = &outcome.lines()[..] else { panic!("exactly one line was expected: {outcome}") };
    line.clone()
}

fn known_beams(env: &TestEnv) -> u64 {
    number(&show_background(env), "known_beams")
}

/// Runs a hub until it has published scans, calls `action`, and returns the outcome of the hub.
fn with_streaming_hub(env: &TestEnv, flags: &[&str], action: impl FnOnce()) -> Outcome {
    let link = env.link("front");
    let hub = env.hub(&[&[link.as_str()], flags].concat());
    let mut scans = env.echo(&["front/scan"]);
    scans.await_lines(3, "a scan", is_class("scan"));
    action();
    drop(scans);
    let outcome = hub.end(TERM);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    outcome
}

/// Runs a first hub that learns the background of the room and saves it.
fn save_background_of_room(env: &TestEnv) {
    with_streaming_hub(env, &[QUICK_LEARNING], || {
        testkit::wait_until("the room is learned", || known_beams(env) > 350)
    });
    assert!(file(env).exists());
}

#[test]
fn post_placed_between_hub_runs_is_foreground_at_once() {
    for how in [TERM, KILL] {
        let env = TestEnv::new();
        let room = simulator(&env, ROOM_WORLD);
        let hub = env.hub(&[&env.link("front"), QUICK_LEARNING]);
        testkit::wait_until("the room is learned and saved", || {
            let shown = show_background(&env);
            number(&shown, "known_beams") > 350 && shown["kept_wall_ns"].is_u64()
        });
        assert_eq!(
            fs::metadata(file(&env)).expect("the background is saved").permissions().mode() & 0o777,
            0o600
        );
        hub.end(how);
        room.end(TERM);

        let _simulator = simulator(&env, &[ROOM_WORLD, POST].concat());
        let hub = env.hub(&[&env.link("front"), SLOW_LEARNING]);
        let mut subscriber = env.echo(&["front/foreground"]);
        let first = subscriber.await_line("foreground", is_class("foreground"));
        // The post is 11 degrees wide. In the first scan, two of the beams that meet the post may not be foreground
        // yet.
        let (beams, generation) =
            (first["beams"].as_array().map_or(0, Vec::len), number(&first, "generation"));
        assert!((18..=26).contains(&beams) && generation == 1, "{first}");
        let nearest = number(&first["segments"][0], "nearest_mm");
        assert!((1300..1400).contains(&nearest), "{first}");
        let text = env.run(&["background", "front", "show"]);
        assert!(
            String::from_utf8_lossy(&text.stdout).contains(" beams known, 0 far, in 1 mm, kept "),
            "{text}"
        );
        let log = hub.end(TERM).stderr;
        assert!(log.contains("front: starts with the background saved "), "{log}");
    }
}

#[test]
fn unusable_or_unwanted_background_is_not_loaded() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, ROOM_WORLD);
    save_background_of_room(&env);
    let kept = fs::read(file(&env)).expect("the background is saved");
    let empty = |flags: &[&str], why: &str| {
        let flags = [&[SLOW_LEARNING], flags].concat();
        let outcome = with_streaming_hub(&env, &flags, || assert_eq!(known_beams(&env), 0, "{flags:?}"));
        assert!(outcome.stderr.contains(why), "{outcome}\n{}", outcome.stderr);
        assert_eq!(fs::read(file(&env)).expect("the file still exists"), kept, "{flags:?}");
    };
    empty(&["--set=link.front.pose.x=0.2"], "the background starts empty: ");
    empty(&["--set=link.front.pose.yaw=0.1"], "belongs to another pose");
    empty(
        &["--set=link.front.unit=cm"],
        "361 beams in units of 1 mm, the link is configured for 361 beams in units of 10 mm",
    );
    empty(&["--set=background.keep=false"], "");
    empty(&["--set=background.start=empty"], "");
    // Files that are truncated, of another sensor, or damaged. After the loop, other users can write to the file.
    let text = String::from_utf8(kept.clone()).expect("text");
    for (wrong, why) in [
        (text[..text.len() / 2].to_owned(), "cut short"),
        (text.replacen("\"front\"", "\"rear\"", 1), "is the background of rear"),
        (text.replacen("\"known_beams\":", "\"known_beams\":9", 1), "is not a background model"),
        ("\u{0}\u{1}".to_owned(), "is not a background model"),
    ] {
        fs::write(file(&env), &wrong).expect("the file can be written");
        let outcome =
            with_streaming_hub(&env, &[SLOW_LEARNING], || assert_eq!(known_beams(&env), 0, "{why}"));
        assert!(outcome.stderr.contains(why), "{why}: {}", outcome.stderr);
    }
    fs::write(file(&env), &kept).expect("the file can be written");
    fs::set_permissions(file(&env), fs::Permissions::from_mode(0o666)).expect("the mode can be set");
    empty(&[], "others can write it");
    // The unchanged file with the right mode is accepted.
    fs::set_permissions(file(&env), fs::Permissions::from_mode(0o600)).expect("the mode can be set");
    with_streaming_hub(&env, &[SLOW_LEARNING], || assert!(known_beams(&env) > 350));
    // A reset deletes the saved background, so that no hub loads it again.
    for (flags, content) in [
        (vec![SLOW_LEARNING], &kept[..]),
        // A reset also deletes a file that the hub has rejected.
        (vec![SLOW_LEARNING, "--set=link.front.pose.x=0.2"], &kept),
        (vec![SLOW_LEARNING], b"cut short"),
    ] {
        fs::write(file(&env), content).expect("the file can be written");
        with_streaming_hub(&env, &flags, || {
            assert_eq!(env.run(&["background", "front", "reset"]).exit_code, Some(0));
            testkit::wait_until("the file is deleted", || !file(&env).exists());
        });
    }
}

#[test]
fn background_is_not_saved_unless_configured() {
    let env = TestEnv::new();
    let simulator = simulator(&env, ROOM_WORLD);
    let is_known = || testkit::wait_until("the room is learned", || known_beams(&env) > 350);
    with_streaming_hub(&env, &[QUICK_LEARNING, "--set=background.keep=false"], || {
        is_known();
        assert!(show_background(&env)["kept_wall_ns"].is_null());
    });
    assert!(!file(&env).exists());
    simulator.end(TERM);

    // A background of a recording is not saved, and a saved background is not loaded for a recording.
    let log: String = (0..60)
        .map(|scan| {
            let at = 1000.0 + f64::from(scan) / 50.0;
            format!("FLASER 181 {} 0 0 0 0 0 0 {at} host {at}\n", vec!["1.5"; 181].join(" "))
        })
        .collect();
    let log = env.file("log", log);
    let is_played = |hub: Program, words: &str| {
        testkit::wait_until("the room is learned", || known_beams(&env) == 181);
        assert!(show_background(&env)["kept_wall_ns"].is_null(), "{words}");
        hub.end(TERM);
        assert!(!file(&env).exists(), "{words}");
    };
    let link = format!("--link=front=file:{log}");
    let resolution = "--set=link.front.resolution=1";
    is_played(env.hub(&[&link, QUICK_LEARNING, resolution]), "file:");
    let words = ["replay", "--json", "--no-system-config", &log, "--hold", QUICK_LEARNING, resolution];
    is_played(env.start(&words).ready(), "replay");
}
