//! `scanhub background` with a running hub: shows, saves, resets and loads the background model, and rejects files that
//! do not fit the sensor.

use std::fs;

use crate::testkit;
use crate::testkit::{Outcome, Program, TERM, TestEnv, is_class, number};
use serde_json::Value;

/// Setting with which the hub learns a wall within a second.
const QUICK_LEARNING: &str = "--set=background.scans=20";

fn simulator(env: &TestEnv) -> Program {
    env.simulator(&["front"], &["--seed=41", "--baud=500000", "--world=bare"])
}

fn run_background(env: &TestEnv, arguments: &[&str]) -> Outcome {
    env.run(&[&["background", "front", "--json"], arguments].concat())
}

/// Runs `background front` with these arguments, and returns the only line of its output.
fn background_line(env: &TestEnv, arguments: &[&str]) -> Value {
    let outcome = run_background(env, arguments);
    let [line] = &outcome.lines()[..] else { panic!("exactly one line was expected: {outcome}") };
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let mut line = line.clone();
    // Remove the time at which the hub saved the model, because the hub may save it at any time. A file does not
    // contain this time.
    line.as_object_mut().map(|line| line.remove("kept_wall_ns"));
    line
}

/// Waits until most beams are known, freezes the model, and returns it.
fn learn_background(env: &TestEnv) -> Value {
    testkit::wait_until("the background is learned", || {
        number(&background_line(env, &["show"]), "known_beams") > 300
    });
    background_line(env, &["freeze"]);
    background_line(env, &["show"])
}

#[test]
fn saved_background_can_be_loaded_again() {
    let env = TestEnv::new();
    let simulator_of_first = simulator(&env);
    let hub = env.hub(&[&env.link("front"), QUICK_LEARNING]);
    let mut subscriber = env.echo(&["front/background"]);
    let model = learn_background(&env);
    assert_eq!(
        (&model["class"], &model["sensor"], &model["frozen"]),
        (&"background".into(), &"front".into(), &true.into())
    );
    assert_eq!(
        (number(&model, "count"), &model["first_angle_deg"], &model["step_deg"]),
        (361, &(-90.0).into(), &0.5.into())
    );
    assert_eq!(model["ranges"].as_array().map(Vec::len), Some(361));

    let file = env.path_argument("model.json");
    let saved = background_line(&env, &["save", &file]);
    assert_eq!((&saved["class"], &saved["file"]), (&"saved".into(), &file.as_str().into()));
    let written: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    assert_eq!(written, model, "the file differs from the output of show");

    background_line(&env, &["reset"]);
    let empty = background_line(&env, &["show"]);
    assert_eq!(
        (number(&empty, "known_beams"), number(&empty, "generation")),
        (0, number(&model, "generation") + 1)
    );
    let loaded = background_line(&env, &["load", &file]);
    assert_eq!(loaded["outcome"], "taken");
    let back = background_line(&env, &["show"]);
    assert_eq!((&back["ranges"], &back["far"]), (&model["ranges"], &model["far"]));
    assert_eq!(number(&back, "generation"), number(&model, "generation") + 2);
    let text = env.run(&["background", "front", "show"]);
    assert!(String::from_utf8_lossy(&text.stdout).starts_with("front: generation "), "{text}");

    // Subscribers receive a sample for each new generation of the background.
    subscriber.await_line("the loaded model", |line| {
        line["class"] == "background" && line["generation"] == back["generation"]
    });
    drop(subscriber);
    assert_eq!(hub.end(TERM).exit_code, Some(0));

    // A hub that starts with the file has the background of the file at once. No scan has changed this background yet,
    // because no scanner is connected.
    drop(simulator_of_first);
    let begin = format!("--set=link.front.background.start={file}");
    let _hub = env.hub(&[&env.link("front"), QUICK_LEARNING, &begin]);
    let at_start = background_line(&env, &["show"]);
    assert_eq!(at_start["ranges"], model["ranges"]);
    // The scans of the sensor fit the loaded background, so the hub continues with this background.
    let _simulator = simulator(&env);
    let mut scans = env.echo(&["front/scan"]);
    scans.await_lines(5, "a scan", |line| line["class"] == "scan");
    let after = background_line(&env, &["show"]);
    assert_eq!(after["generation"], at_start["generation"]);
    assert!(number(&after, "known_beams") >= number(&at_start, "known_beams"), "{after}");
}

#[test]
fn hub_rejects_background_of_another_sensor() {
    let env = TestEnv::new();
    let no_hub = run_background(&env, &["show"]);
    assert_eq!((no_hub.exit_code, &no_hub.of_class("error")[0]["kind"]), (Some(3), &"no_hub".into()));

    let _simulator = simulator(&env);
    let rear = env.file("rear", testkit::scan(1));
    let hub = env.hub(&[&env.link("front"), &format!("--link=rear=file:{rear}"), QUICK_LEARNING]);
    let model = learn_background(&env);
    let file = env.path_argument("model.json");
    background_line(&env, &["save", &file]);
    let text = fs::read_to_string(&file).unwrap();

    let cut = env.file("cut.json", &text[..text.len() / 2]);
    let foreign = env.file("foreign.json", text.replacen("\"front\"", "\"rear\"", 1));
    let centimetres = env.file("cm.json", text.replacen("\"unit_mm\":1,", "\"unit_mm\":10,", 1));
    let scan = env.file("scan.json", "{\"class\":\"scan\"}");
    for (file, code, kind, why) in [
        (&cut, 66, "input", "cut short"),
        (&foreign, 78, "configuration", "is the background of rear, not of front"),
        (&centimetres, 78, "configuration", "361 beams in units of 10 mm"),
        (&scan, 66, "input", "its class is \"scan\""),
        (&env.path_argument("nothing.json"), 66, "input", "nothing.json"),
    ] {
        let outcome = run_background(&env, &["load", file]);
        let error = &outcome.of_class("error")[0];
        assert_eq!((outcome.exit_code, &error["kind"]), (Some(code), &kind.into()), "{outcome}");
        assert!(error["message"].as_str().is_some_and(|message| message.contains(why)), "{outcome}");
        assert!(error["hint"].as_str().is_some_and(|hint| !hint.is_empty()), "{outcome}");
    }
    let unchanged = background_line(&env, &["show"]);
    assert_eq!(unchanged, model);
    background_line(&env, &["load", &foreign, "--any-sensor"]);

    let unknown = env.run(&["background", "side", "show", "--json"]);
    let error = &unknown.of_class("error")[0];
    assert_eq!((unknown.exit_code, &error["hint"]), (Some(3), &"there are front, rear".into()), "{unknown}");
    let usage = env.run(&["background", "front", "melt"]);
    assert_eq!(usage.exit_code, Some(2), "{usage}");
    let mut subscriber = env.echo(&["front/foreground"]);
    subscriber.await_lines(5, "another scan", is_class("foreground"));
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn request_without_background_names_the_key() {
    let env = TestEnv::new();
    let _hub = env.hub(&[env.link("front").as_str(), "--set=background.method=off"]);
    let outcome = run_background(&env, &["show"]);
    let error = &outcome.of_class("error")[0];
    assert_eq!(outcome.exit_code, Some(78), "{outcome}");
    assert!(error["hint"].as_str().is_some_and(|hint| hint.contains("background.method")), "{outcome}");
}

#[test]
fn save_before_the_first_scan_is_an_error() {
    let env = TestEnv::new();
    let _hub = env.hub(&[env.link("front")]);
    assert_eq!(background_line(&env, &["show"])["count"], 0);
    let file = env.path("model.json");
    let outcome = run_background(&env, &["save", &file.display().to_string()]);
    assert_eq!(outcome.exit_code, Some(1), "{outcome}");
    assert!(!file.exists());
}
