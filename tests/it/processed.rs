//! Tests of the topics that the hub derives from scans: marks, zones, foreground and background with each scan, and one
//! sample of topic `zones` with the verdict `unknown` when scans stop. The commands for the background are tested, too.

use crate::testkit;
use crate::testkit::{INT, Outcome, TERM, TestEnv, checked_topic_seqs, is_class, number, wait_until};
use serde_json::Value;

const STREAM_FLAGS: [&str; 2] = ["--seed=51", "--baud=500000"];

fn background(env: &TestEnv, arguments: &[&str]) -> Outcome {
    env.run(&[&["background", "front"], arguments, &["--json"]].concat())
}

/// Asserts that the verb `background front` with these arguments succeeds.
fn background_accepted(env: &TestEnv, arguments: &[&str]) {
    let outcome = background(env, arguments);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
}

fn model(env: &TestEnv) -> Value {
    let outcome = background(env, &["show"]);
    let [line] = &outcome.lines()[..] else { panic!("not one line: {outcome}") };
    line.clone()
}

fn is_unknown(line: &Value) -> bool {
    line["class"] == "zones" && line["verdict"] == "unknown"
}

fn await_streaming(env: &TestEnv) {
    env.await_info("front", |info| info["state"] == "streaming");
}

#[test]
fn each_scan_has_its_marks_zones_and_foreground() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("front")]);
    let topics = ["scan", "marks", "zones", "foreground"];
    let mut subscribers = topics.map(|topic| env.echo(&[&format!("front/{topic}")]));
    // Before the first scan, the verdict is `unknown`, and the radii are those of the configuration.
    let first = subscribers[2].await_line("the first sample", is_class("zones"));
    assert_eq!((&first["verdict"], number(&first, "topic_seq")), (&"unknown".into(), 0), "{first}");
    assert_eq!(
        (number(&first["zones"][0], "radius_mm"), number(&first["zones"][1], "radius_mm")),
        (1000, 600)
    );
    let simulator = env.simulator(&["front"], &STREAM_FLAGS);
    let known = |line: &Value| line["class"] != "notice" && !is_unknown(line) && line["stale"] != true;
    let lines = subscribers.each_mut().map(|subscriber| subscriber.await_lines(40, "a sample", known));
    let [scans, marks, zones, foregrounds] = &lines;
    for (lines, name) in lines.iter().zip(topics) {
        let of_scans = lines.iter().filter_map(|line| {
            let scan = scans.iter().find(|scan| scan["seq"] == line["seq"])?;
            assert_eq!(line["stamp_ns"], scan["stamp_ns"], "{name}");
            Some(line)
        });
        assert!(of_scans.count() > 0, "{name}: {lines:?}");
    }
    // The simulated room has reflectors, and the simulated scanner reports them. The background is not known yet, so no
    // beam is foreground.
    assert!(marks.iter().all(|line| line["available"] == true));
    assert!(marks.iter().any(|line| line["marks"].as_array().is_some_and(|marks| !marks.is_empty())));
    assert!(zones.iter().all(|line| number(line, "nearest_mm") > 0 && line["verdict"] != "unknown"));
    assert!(foregrounds.iter().all(|line| line["beams"].as_array().is_some_and(Vec::is_empty)));
    // A late subscriber does not count the samples before its start as missed.
    let late = env.run(&["echo", "--json", "front/marks", "front/foreground", "-n", "20"]);
    ["marks", "foreground"].iter().for_each(|topic| drop(checked_topic_seqs(&late, topic)));
    for (subscriber, topic) in subscribers.into_iter().zip(topics) {
        checked_topic_seqs(&subscriber.end(INT), topic);
    }
    let info = env.info("front");
    assert_eq!(number(&info["counters"], "loan_failed"), 0, "{info}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
}

/// Waits until a late joiner receives the sample of topic `zones` that the hub publishes when scans stop, with the
/// verdict `unknown`. Returns this sample.
fn await_silence_sample(env: &TestEnv) -> Value {
    let mut last = Value::Null;
    wait_until("an unknown verdict of the hub", || {
        let late = env.run(&["echo", "--json", "front/zones", "-n", "1", "--timeout", "60s"]);
        assert_eq!(late.exit_code, Some(0), "{late}");
        last = late.lines()[0].clone();
        is_unknown(&last) && last["stale"].is_null()
    });
    last
}

#[test]
fn silence_is_published_once_and_to_late_joiners() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &STREAM_FLAGS);
    let _hub = env.hub(&[env.link("front")]);
    await_streaming(&env);
    let mut zones = env.echo(&["front/zones"]);
    let mut scans = env.echo(&["front/scan"]);
    zones.await_lines(20, "a verdict", |line| line["class"] == "zones" && !is_unknown(line));
    assert_eq!(env.run(&["control", "front", "pause"]).exit_code, Some(0));
    env.await_info("front", |info| info["state"] == "paused");
    let unknown = await_silence_sample(&env);
    // After five more statuses, the hub still has not published another sample of topic `zones`.
    let mut statuses = env.echo(&["front/status", "front/scan", "front/background"]);
    let statuses = statuses.await_lines(5, "a status", is_class("status"));
    // A subscriber that attaches during the pause receives no scan, and the hub does not report an error because of
    // this.
    assert!(statuses.iter().all(|status| status["last_error"] == ""), "{statuses:?}");
    assert_eq!(env.run(&["control", "front", "resume"]).exit_code, Some(0));
    let next = zones.await_line("the next verdict", |line| {
        // A line that the client prints because it has detected a silence itself has no `topic_seq`.
        line["class"] == "zones" && line["topic_seq"].as_u64() > unknown["topic_seq"].as_u64()
    });
    assert_eq!(number(&next, "topic_seq"), number(&unknown, "topic_seq") + 1);
    assert!(number(&next, "seq") > number(&unknown, "seq"), "it must belong to a scan: {next}");
    scans.await_lines(20, "a scan", is_class("scan"));
    env.kill_port_simulator(simulator, "front");
    let absent = env.await_info("front", |info| info["state"] == "absent");
    let line = await_silence_sample(&env);
    let last = scans.end(INT).of_class("scan").pop().expect("a scan");
    // The sample has the `seq` of the last telegram, but a later stamp.
    assert!(number(&line, "seq") >= number(&last, "seq"), "{line}");
    assert!(number(&line, "stamp_ns") > number(&last, "stamp_ns"), "{line}");
    assert_eq!(absent["last_error"].as_str().map(str::is_empty), Some(false));
}

#[test]
fn background_can_be_saved_frozen_reset_and_loaded() {
    let env = TestEnv::new();
    let _hub = env.hub(&[env.link("front"), "--set=background.scans=20".into()]);
    let mut generations = env.echo(&["front/background"]);
    // The world has a wall and no people, so the hub learns the background within a second. On a busy machine, the
    // subscriber may start too late and miss the first sample, which is empty. The second generation is frozen before
    // the hub learns anything, so it stays empty.
    let _simulator = env.simulator(&["front"], &["--seed=52", "--baud=500000", "--world=bare"]);
    let first = generations.await_line("the first generation", is_class("background"));
    assert_eq!((number(&first, "generation"), number(&first, "count")), (0, 361), "{first}");
    assert!(number(&first, "known_beams") == 0 || number(&first, "topic_seq") > 0, "{first}");
    wait_until("a learned background", || number(&model(&env), "known_beams") > 300);
    let file = env.path_argument("model.json");
    background_accepted(&env, &["save", &file]);
    let saved: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();

    background_accepted(&env, &["freeze"]);
    assert_eq!(model(&env)["frozen"], true);
    background_accepted(&env, &["reset"]);
    let second = generations.await_line("the second generation", |line| line["generation"] == 1);
    assert_eq!((number(&second, "generation"), number(&second, "known_beams")), (1, 0), "{second}");
    // While the background is frozen, scans do not change it.
    let scans = env.run(&["echo", "--json", "front/foreground", "-n", "60"]);
    assert!(scans.of_class("foreground").iter().all(|line| number(line, "generation") == 1), "{scans}");
    assert_eq!(number(&model(&env), "known_beams"), 0);
    background_accepted(&env, &["load", &file]);
    let third = generations.await_line("the third generation", |line| line["generation"] == 2);
    assert_eq!(
        (number(&third, "generation"), &third["ranges"], &third["far"]),
        (2, &saved["ranges"], &saved["far"])
    );
    background_accepted(&env, &["thaw"]);
    assert_eq!(model(&env)["frozen"], false);

    // The hub rejects a model with another resolution or another unit.
    for (key, value, words) in [
        (
            "unit_mm",
            10,
            "the model has 361 beams in units of 10 mm, the sensor's scans have 361 beams in units of 1 mm",
        ),
        (
            "count",
            181,
            "the model has 181 beams in units of 1 mm, the sensor's scans have 361 beams in units of 1 mm",
        ),
    ] {
        let mut other = saved.clone();
        other[key] = value.into();
        if key == "count" {
            other["step_deg"] = 1.0.into();
            other["ranges"] = vec![Value::from(1000); 181].into();
            other["far"] = Vec::<Value>::new().into();
            other["known_beams"] = 181.into();
        }
        let refused = background(&env, &["load", &env.file("other.json", other.to_string())]);
        let error = &refused.of_class("error")[0];
        assert_eq!(
            (refused.exit_code, error["message"].as_str()),
            (Some(78), Some(&*format!("front: {words}"))),
            "{refused}"
        );
    }
    assert_eq!(number(&model(&env), "generation"), 2);
    let outcome = generations.end(INT);
    // After every 20 scans from which the hub has learned, it publishes the generation again.
    let lines = outcome.of_class("background");
    let mut received: Vec<u64> = lines.iter().map(|line| number(line, "generation")).collect();
    received.dedup();
    assert_eq!(received, [0, 1, 2]);

    // A hub can also start with a saved background.
    drop(_hub);
    let _hub = env.hub(&[env.link("front"), format!("--set=link.front.background.start={file}")]);
    let at_start = env.echo(&["front/background"]).await_line("the model", is_class("background"));
    assert_eq!((number(&at_start, "generation"), &at_start["ranges"]), (1, &saved["ranges"]));
}

#[test]
fn background_is_published_with_every_scan_or_never() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front", "rear"], &STREAM_FLAGS);
    let set = ["--set=link.front.background.publish=every-scan", "--set=link.rear.background.method=off"];
    let _hub = env.hub(&[&[env.link("front"), env.link("rear")][..], &set.map(String::from)].concat());
    let mut both = [env.echo(&["front/background"]), env.echo(&["front/scan"])];
    let [models, scans] = both.each_mut().map(|subscriber| {
        subscriber
            .await_lines(30, "a sample", |line| line["class"] == "background" || line["class"] == "scan")
    });
    assert_eq!((models.len(), scans.len()), (30, 30));
    let mut rear = env.echo(&["rear/foreground", "rear/background", "rear/zones"]);
    rear.await_lines(30, "a verdict", |line| line["class"] == "zones" && !is_unknown(line));
    let outcome = rear.end(INT);
    assert_eq!(
        (outcome.of_class("foreground").len(), outcome.of_class("background").len()),
        (0, 0),
        "{outcome}"
    );
    let refused = env.run(&["background", "rear", "show", "--json"]);
    let error = &refused.of_class("error")[0];
    assert_eq!((refused.exit_code, &error["kind"]), (Some(78), &"configuration".into()), "{refused}");
    assert_eq!(error["message"], "rear: background.method is \"off\", no background is kept");
    assert!(error["hint"].as_str().is_some_and(|hint| hint.contains("link.rear.background.method=multi")));
}

#[test]
fn recording_has_zones_and_a_controllable_background() {
    let env = TestEnv::new();
    let scans: Vec<u8> = (0..4000).flat_map(testkit::scan).collect();
    let file = env.file("scans", scans);
    let _hub = env.hub(&["--link", &format!("front=file:{file}")]);
    let mut zones = env.echo(&["front/zones"]);
    zones.await_lines(10, "a verdict", |line| line["class"] == "zones" && line["verdict"] == "stop");
    background_accepted(&env, &["reset"]);
    background_accepted(&env, &["freeze"]);
    let shown = model(&env);
    assert_eq!(
        (number(&shown, "generation"), number(&shown, "count"), &shown["frozen"]),
        (1, 361, &true.into())
    );
    // The recording was made in mode 00h, in which a scanner does not report reflectors.
    let marks = env.run(&["echo", "--json", "front/marks", "-n", "1"]);
    assert_eq!(marks.of_class("marks")[0]["available"], false, "{marks}");
}

#[test]
fn slow_recording_has_no_false_silence() {
    let env = TestEnv::new();
    let ranges = vec!["2.0"; 181].join(" ");
    // The recording has ten scans per second, and one pause of 0.9 s. The hub would report a live sensor as silent
    // after a twentieth of this pause.
    let at_s = |scan: usize| 10.0 + 0.1 * scan as f64 + if scan < 6 { 0.0 } else { 0.9 };
    let line = |at_s: f64| format!("FLASER 181 {ranges} 0 0 0 0 0 0 {at_s} host {at_s}\n");
    let log: String = (0..12).map(at_s).map(line).collect();
    let _hub = env.hub(&["--link", &format!("front=file:{}", env.file("log", log))]);
    env.await_info("front", |info| info["state"] == "silent");
    // At the end of the recording, the sensor is silent, as a live sensor would be. Before the sample of this silence,
    // the hub published only the first sample and one verdict for each of the twelve scans.
    let mut last = Value::Null;
    wait_until("an unknown verdict", || {
        last = env.run(&["echo", "--json", "front/zones", "-n", "1"]).lines()[0].clone();
        // If the sample arrives late, on a busy machine, `echo` itself reports that the verdict is unknown.
        is_unknown(&last) && last["stale"].is_null()
    });
    assert_eq!((number(&last, "topic_seq"), number(&last, "seq")), (13, 11), "{last}");
}

#[test]
fn bad_pose_or_circles_are_rejected_with_position() {
    let env = TestEnv::new();
    for (text, words) in [
        ("[link.pose]\nx = nan\n", ":6:5: x = NaN"),
        ("[link.pose]\nx = 1.0\n", ":6:5: link front: no beam sees into the circle of 1 m"),
        ("[link.zones]\nradii = [0.6, 1.0]\n", ":6:9: radii = [0.6, 1.0]"),
        ("[link.zones]\nmargn = 0.1\n", ":6:1: unknown key `margn`"),
        ("[link.background]\nstart = \"/no/such/model\"\n", "/no/such/model"),
    ] {
        let link = "[[link]]\nname = \"front\"\nport = \"/dev/null\"\nangle = 180\n";
        let file = env.file("hub.toml", [link, text].concat());
        let outcome = env.run(&["run", "--config", &file, "--json"]);
        assert_eq!((outcome.exit_code, outcome.stdout.is_empty()), (Some(78), true), "{outcome}");
        assert!(outcome.stderr.contains(words), "{words}: {outcome}");
    }
    // `info` reports the sensor's pose.
    let set = ["link.front.pose.x=0.3", "link.front.pose.yaw=1.5", "link.front.pose.upside_down=true"];
    let set = set.map(|flag| format!("--set={flag}"));
    let _hub = env.hub(&[&[env.link("front")][..], &set].concat());
    let pose = env.info("front")["pose"].clone();
    assert_eq!(pose, serde_json::json!({ "x_m": 0.3, "y_m": 0.0, "yaw_rad": 1.5, "upside_down": true }));
}
