//! The background model of a running hub: shown, kept in a file, forgotten, taken back; and what is no model of it.

use std::fs;

use crate::testkit;
use crate::testkit::{Outcome, Program, TERM, TestEnv, is_class, number};
use serde_json::Value;

/// What a hub is told so that a wall is learned within a second.
const SOON: &str = "--set=background.scans=20";

fn simulator(env: &TestEnv) -> Program {
    env.simulator(&["front"], &["--seed=41", "--baud=500000", "--world=bare"])
}

fn ask(env: &TestEnv, order: &[&str]) -> Outcome {
    env.run(&[&["background", "front", "--json"], order].concat())
}

/// The one line that `order` yields.
fn told(env: &TestEnv, order: &[&str]) -> Value {
    let outcome = ask(env, order);
    let [line] = &outcome.lines()[..] else { panic!("not one line: {outcome}") };
    assert_eq!(outcome.code, Some(0), "{outcome}");
    let mut line = line.clone();
    // Meanwhile it is kept, and a file does not say so.
    line.as_object_mut().map(|line| line.remove("kept_wall_ns"));
    line
}

/// The model once most of its beams are known, held as it is.
fn learned(env: &TestEnv) -> Value {
    testkit::until("the background is learned", || number(&told(env, &["show"]), "known_beams") > 300);
    told(env, &["freeze"]);
    told(env, &["show"])
}

#[test]
fn what_was_saved_comes_back() {
    let env = TestEnv::new();
    let simulator_of_first = simulator(&env);
    let hub = env.hub(&[&env.link("front"), SOON]);
    let mut consumer = env.echo(&["front/background"]);
    let model = learned(&env);
    assert_eq!(
        (&model["class"], &model["sensor"], &model["frozen"]),
        (&"background".into(), &"front".into(), &true.into())
    );
    assert_eq!(
        (number(&model, "count"), &model["first_angle_deg"], &model["step_deg"]),
        (361, &(-90.0).into(), &0.5.into())
    );
    assert_eq!(model["ranges"].as_array().map(Vec::len), Some(361));

    let file = env.word("model.json");
    let saved = told(&env, &["save", &file]);
    assert_eq!((&saved["class"], &saved["file"]), (&"saved".into(), &file.as_str().into()));
    let written: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    assert_eq!(written, model, "a file is what is shown");

    told(&env, &["reset"]);
    let empty = told(&env, &["show"]);
    assert_eq!(
        (number(&empty, "known_beams"), number(&empty, "generation")),
        (0, number(&model, "generation") + 1)
    );
    let loaded = told(&env, &["load", &file]);
    assert_eq!(loaded["outcome"], "taken");
    let back = told(&env, &["show"]);
    assert_eq!((&back["ranges"], &back["far"]), (&model["ranges"], &model["far"]));
    assert_eq!(number(&back, "generation"), number(&model, "generation") + 2);
    let text = env.run(&["background", "front", "show"]);
    assert!(String::from_utf8_lossy(&text.out).starts_with("front: generation "), "{text}");

    // Who follows the topic is told of each generation.
    consumer.await_line("the loaded model", |line| {
        line["class"] == "background" && line["generation"] == back["generation"]
    });
    drop(consumer);
    assert_eq!(hub.end(TERM).code, Some(0));

    // A hub that begins with the file knows at once what that one had learned, before there is a scan that changes it.
    drop(simulator_of_first);
    let begin = format!("--set=link.front.background.start={file}");
    let _hub = env.hub(&[&env.link("front"), SOON, &begin]);
    let begun = told(&env, &["show"]);
    assert_eq!(begun["ranges"], model["ranges"]);
    // The sensor's scans fit it: they go on with it.
    let _simulator = simulator(&env);
    let mut scans = env.echo(&["front/scan"]);
    scans.await_lines(5, "a scan", |line| line["class"] == "scan");
    let after = told(&env, &["show"]);
    assert_eq!(after["generation"], begun["generation"]);
    assert!(number(&after, "known_beams") >= number(&begun, "known_beams"), "{after}");
}

#[test]
fn what_is_no_model_of_the_sensor_is_refused_and_the_hub_goes_on() {
    let env = TestEnv::new();
    let no_hub = ask(&env, &["show"]);
    assert_eq!((no_hub.code, &no_hub.of_class("error")[0]["kind"]), (Some(3), &"no_hub".into()));

    let _simulator = simulator(&env);
    let rear = env.file("rear", testkit::scan(1));
    let hub = env.hub(&[&env.link("front"), &format!("--link=rear=file:{rear}"), SOON]);
    let model = learned(&env);
    let file = env.word("model.json");
    told(&env, &["save", &file]);
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
        (&env.word("nothing.json"), 66, "input", "nothing.json"),
    ] {
        let outcome = ask(&env, &["load", file]);
        let error = &outcome.of_class("error")[0];
        assert_eq!((outcome.code, &error["kind"]), (Some(code), &kind.into()), "{outcome}");
        assert!(error["message"].as_str().is_some_and(|message| message.contains(why)), "{outcome}");
        assert!(error["hint"].as_str().is_some_and(|hint| !hint.is_empty()), "{outcome}");
    }
    let unchanged = told(&env, &["show"]);
    assert_eq!(unchanged, model);
    told(&env, &["load", &foreign, "--any-sensor"]);

    let unknown = env.run(&["background", "side", "show", "--json"]);
    let error = &unknown.of_class("error")[0];
    assert_eq!((unknown.code, &error["hint"]), (Some(3), &"there are front, rear".into()), "{unknown}");
    let usage = env.run(&["background", "front", "melt"]);
    assert_eq!(usage.code, Some(2), "{usage}");
    let mut consumer = env.echo(&["front/foreground"]);
    consumer.await_lines(5, "the hub goes on", is_class("foreground"));
    assert_eq!(hub.end(TERM).code, Some(0));
}

#[test]
fn where_no_background_is_kept_the_key_is_named() {
    let env = TestEnv::new();
    let _hub = env.hub(&[env.link("front").as_str(), "--set=background.method=off"]);
    let outcome = ask(&env, &["show"]);
    let error = &outcome.of_class("error")[0];
    assert_eq!(outcome.code, Some(78), "{outcome}");
    assert!(error["hint"].as_str().is_some_and(|hint| hint.contains("background.method")), "{outcome}");
}

#[test]
fn before_the_first_scan_there_is_nothing_to_save() {
    let env = TestEnv::new();
    let _hub = env.hub(&[env.link("front")]);
    assert_eq!(told(&env, &["show"])["count"], 0);
    let file = env.path("model.json");
    let outcome = ask(&env, &["save", &file.display().to_string()]);
    assert_eq!(outcome.code, Some(1), "{outcome}");
    assert!(!file.exists());
}
