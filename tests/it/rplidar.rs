//! Tests of a hub with simulated RPLIDARs: the hub identifies each scanner and selects a mode. It publishes whole
//! revolutions on an even grid, and the packets as they arrived. It stops the motor if this is configured. It changes
//! no settings that a scanner stores.

use serde_json::Value;

use crate::replay_packets::{recorder, replay, samples, scan};
use crate::testkit::{INT, Program, TERM, TestEnv, contiguous_numbers, is_class, number};

/// Starts a simulated scanner of this model, with the flags `more` in addition.
fn simulator(env: &TestEnv, model: &str, more: &[&str]) -> Program {
    let model = format!("--model={model}");
    let arguments = ["--family=rplidar", &model, "--world=room", "--seed=7"];
    env.simulator(&["front"], &[&arguments[..], more].concat())
}

/// Starts a hub with one link with these settings.
fn hub(env: &TestEnv, settings: &[&str]) -> Program {
    let set = ["family=rplidar"].iter().chain(settings).map(|setting| format!("--set=link.front.{setting}"));
    env.hub(&[vec![env.link("front")], set.collect()].concat())
}

fn text<'a>(line: &'a Value, key: &str) -> &'a str {
    line[key].as_str().unwrap_or_else(|| panic!("no {key}: {line}"))
}

#[test]
fn identifies_scanner_and_publishes_its_revolutions() {
    let env = TestEnv::new();
    let hub = hub(&env, &[]);
    let mut scans = env.echo(&["front/scan"]);
    let telegrams = env.echo(&["front/telegram"]);
    let simulator = simulator(&env, "a1", &[]);
    // On a busy machine, the simulator is late and cannot send some packets in time, so some revolutions are
    // incomplete.
    scans.await_lines(8, "a complete scan", |line| is_class("scan")(line) && line["incomplete"].is_null());
    let info = env.await_info("front", |info| info["hz"].as_f64().is_some_and(|hz| hz > 6.0));
    assert_eq!(
        (text(&info, "family"), text(&info, "model"), text(&info, "state")),
        ("rplidar", "a1", "streaming")
    );
    assert_eq!((number(&info, "baud"), text(&info, "last_error")), (115_200, ""), "{info}");
    // On a busy machine, the hub may count revolutions as lost, because the simulator is late. But no byte is damaged.
    assert_eq!(info["damaged"].as_f64(), Some(0.0), "{info}");
    let scans = scans.end(INT).of_class("scan");
    contiguous_numbers(&scans, "topic_seq");
    let counts: Vec<u64> = scans.iter().map(|scan| number(scan, "count")).collect();
    assert!(counts[0] > 300 && counts.iter().all(|count| *count == counts[0]), "{counts:?}");
    let telegrams = telegrams.end(INT).of_class("telegram");
    let kinds = |kind: &str| telegrams.iter().filter(|line| line["kind"] == kind).count();
    assert!(kinds("reply") > 3 && kinds("data") > 50, "{} and {}", kinds("reply"), kinds("data"));
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0, "stored settings were changed");
}

#[test]
fn configured_model_and_mode_are_used() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, "s1", &[]);
    let _hub = hub(&env, &["model=s1", "mode=standard", "beams=500"]);
    let mut telegrams = env.echo(&["front/telegram"]);
    for scan in env.echo(&["front/scan"]).await_lines(5, "a scan", is_class("scan")) {
        assert_eq!((text(&scan, "family"), number(&scan, "count")), ("rplidar", 500), "{scan}");
    }
    // The kind of packet that has only a single point has no checksum.
    let data = telegrams.await_line("packets", |line| line["kind"] == "data");
    assert!(data["checked"].is_null() && number(&data, "length") == 5 * number(&data, "packets"), "{data}");
    let info = env.await_info("front", |info| info["state"] == "streaming");
    assert_eq!((number(&info, "baud"), text(&info, "model")), (256_000, "s1"), "{info}");
}

#[test]
fn reports_unsupported_mode() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, "a1", &[]);
    let _hub = hub(&env, &["mode=ultradense"]);
    let info = env.await_info("front", |info| info["state"] == "streaming" && info["last_error"] != "");
    assert!(text(&info, "last_error").contains("does not support mode ultradense"), "{info}");
}

#[test]
fn motor_stops_without_subscribers() {
    let env = TestEnv::new();
    let simulator = simulator(&env, "a1", &[]);
    let hub = hub(&env, &["idle=stop"]);
    let paused = |info: &Value| info["state"] == "paused";
    env.await_info("front", paused);
    let mut scans = env.echo(&["front/scan"]);
    scans.await_lines(3, "a scan", is_class("scan"));
    assert_eq!(text(&env.info("front"), "state"), "streaming");
    scans.end(INT);
    // A subscriber to `status` alone does not need a scanner that measures, so the hub stops the motor.
    let _status = env.echo(&["front/status"]);
    env.await_info("front", paused);
    assert_eq!((hub.end(TERM).exit_code, simulator.end(TERM).exit_code), (Some(0), Some(0)));
    assert_eq!(env.simulator_totals("front").1, 0);
}

#[test]
fn probe_identifies_scanner_and_checks_its_line() {
    let env = TestEnv::new();
    for (model, rate) in [("a1", 115_200), ("s2", 1_000_000)] {
        let simulator = simulator(&env, model, &[]);
        let outcome = env.search(&["probe", &env.path_argument("front"), "--json"]);
        let [found] = &outcome.lines()[..] else { panic!("{outcome}") };
        assert_eq!(
            (outcome.exit_code, text(found, "family"), text(found, "model")),
            (Some(0), "rplidar", model),
            "{outcome}"
        );
        assert_eq!((number(found, "baud"), text(found, "health")), (rate, "good"), "{found}");
        assert!(text(found, "identity").contains("firmware"), "{found}");
        assert_eq!(simulator.end(TERM).exit_code, Some(0));
        assert_eq!(env.simulator_totals("front").1, 0);
        assert!(number(found, "packets") > 20 && found["damaged"].as_f64() == Some(0.0), "{found}");
        assert!(found["problem"].is_null(), "{found}");
        let sent = env.truth("front");
        assert!(sent[..2].iter().all(|sent| sent.is_reply), "the first replies must be identity and health");
    }
}

/// The scanner has a model ID that this version does not know.
#[test]
fn unknown_model_is_shown_with_its_id() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, "s2", &["--fault=id=0x95"]);
    let probed = env.search(&["probe", &env.path_argument("front"), "--json"]);
    let [found] = &probed.lines()[..] else { panic!("{probed}") };
    assert_eq!((text(found, "family"), &found["model"]), ("rplidar", &"0x95".into()), "{found}");
    assert!(text(found, "identity").starts_with("model 0x95 (unknown), firmware 1.02"), "{found}");

    let hub = env.hub(&[env.link("front")]);
    let info = env.await_info("front", |info| info["state"] == "streaming");
    assert_eq!((text(&info, "model"), text(&info, "type")), ("0x95", "0x95 denseboost 1.02"), "{info}");
    assert_eq!(text(&info, "mode"), "denseboost", "{info}");
    assert_eq!((number(&info, "angle_deg"), text(&info, "last_error")), (360, ""), "{info}");
    let mut scans = env.echo(&["front/scan"]);
    for scan in scans.await_lines(5, "a scan", is_class("scan")) {
        assert!(number(&scan, "count").abs_diff(3_200) < 100, "not the number of measured points: {scan}");
    }
    let info = env.run(&["info", "front"]).to_string();
    assert!(info.contains("0x95 (unknown)") && info.contains("denseboost 1.02"), "{info}");
    let outcome = hub.end(TERM);
    assert!(
        outcome.stderr.contains("front: found rplidar model 0x95 (unknown) at 1000000 baud"),
        "{outcome}"
    );
}

/// A recorder that attaches to a running stream misses the replies that the scanner sent before. The stream file into
/// which the recording is converted nevertheless has these replies.
#[test]
fn stream_file_has_the_recorded_scans() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("front")]);
    let mut echo = env.echo(&["front/scan"]);
    let simulator = simulator(&env, "s1", &[]);
    echo.await_lines(2, "a scan", is_class("scan"));
    let recorders = [recorder(&env, "all.mcap", &["--all"]), recorder(&env, "default.mcap", &[])];
    env.echo(&["front/scan"]).await_lines(40, "a scan with both recorders", is_class("scan"));
    for recorder in recorders {
        assert_eq!(recorder.end(INT).exit_code, Some(0));
    }
    // The second line is a status from after the end of the recorders.
    env.echo(&["front/status"]).await_lines(2, "a status", is_class("status"));
    let is_late = number(&env.info("front"), "lost_on_line") > 0;
    assert_eq!((echo.end(INT).exit_code, hub.end(TERM).exit_code), (Some(0), Some(0)));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    let (recording, stream) = (env.path_argument("default.mcap"), env.path_argument("default.bin"));
    let outcome = env.run(&["convert", &recording, &stream]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    replay(&env, "default.bin", &[]);
    let ranges = |name: &str| -> Vec<Vec<u16>> {
        let scans = samples(&env.path(name), "front/scan").into_iter();
        scans.map(|(_, payload)| scan(&payload).ranges().to_vec()).collect()
    };
    let (recorded, replayed) = (ranges("all.mcap"), ranges("replayed.mcap"));
    // The recorder of the default topics started and ended later than the recorder of all topics.
    let begin = recorded.iter().position(|scan| *scan == replayed[0]).expect("the first one was recorded");
    let both = (recorded.len() - begin).min(replayed.len());
    // On a busy machine, a recorder may miss samples, and the line may be late or lose bytes. The scans may then
    // differ, so the test compares them only if nothing was missed or lost.
    let has_lost = env.truth("front").iter().any(|sent| sent.fault.is_some());
    let is_unbroken = |name: &str, topic: &str| {
        let numbers: Vec<u64> =
            samples(&env.path(name), topic).iter().map(|(header, _)| header.topic_seq).collect();
        numbers.windows(2).all(|pair| pair[1] == pair[0] + 1)
    };
    let topics =
        [("default.mcap", "front/telegram"), ("all.mcap", "front/scan"), ("replayed.mcap", "front/scan")];
    if !has_lost && !is_late && topics.into_iter().all(|(name, topic)| is_unbroken(name, topic)) {
        let differs =
            recorded[begin..].iter().zip(&replayed).position(|(recorded, replayed)| recorded != replayed);
        assert!(both > 25 && differs.is_none(), "{begin} {both}: {differs:?}");
    }

    let words = ["replay", "--json", "--no-system-config", "--hold", "--rate=max", &stream];
    let player = env.start(&words).ready();
    let info = env.await_info("front", |info| info["last_error"] == "the recording is at its end");
    assert_eq!((text(&info, "model"), text(&info, "type")), ("s1", "S1 denseboost 1.02"), "{info}");
    assert_eq!(player.end(TERM).exit_code, Some(0));
}

#[test]
fn reports_line_that_damages_most_bytes() {
    let env = TestEnv::new();
    let port = env.path_argument("front");
    let _simulator = simulator(&env, "s2", &["--fault=loss=0.01,burst=1"]);
    let probed = env.search(&["probe", &port, "--json"]);
    let [found] = &probed.lines()[..] else { panic!("{probed}") };
    // If the modes are reported late, on a busy machine, the session uses the standard mode. The line damages fewer of its
    // packets, because they are short.
    assert!(found["damaged"].as_f64().is_some_and(|share| share > 0.03), "{found}");
    assert!(text(found, "problem").contains("of the bytes are damaged on the line"), "{found}");

    let outcome = env.run(&["doctor", &port, "--json", "--no-system-config"]);
    let of = |name: &str| {
        let found = outcome.of_class("check");
        let found = found.into_iter().find(|line| line["name"] == name && !line["port"].is_null());
        found.unwrap_or_else(|| panic!("no {name}: {outcome}"))
    };
    assert!(text(&of("rate"), "finding").contains("1000000 Bd is in use"), "{outcome}");
    let line_loss = of("line-loss");
    let percent =
        text(&line_loss, "finding").split_once(" % of the bytes damaged").map(|(percent, _)| percent);
    let percent: f64 = percent.unwrap_or_else(|| panic!("{outcome}")).parse().expect("a percentage");
    // The finding has one decimal, so at 50.0 % both are right.
    let is_right = match (text(&line_loss, "state"), outcome.exit_code) {
        ("failed", Some(5)) => percent >= 50.0,
        ("warning", Some(0)) => (3.0..=50.0).contains(&percent),
        _ => false,
    };
    assert!(is_right, "{outcome}");
    // The line may damage every reply to the request for the health, and the check then has a warning.
    assert!(["ok", "warning"].contains(&text(&of("health"), "state")), "{outcome}");

    let _hub = hub(&env, &["model=s2"]);
    let mut status = env.echo(&["front/status"]);
    let reports_damage = |line: &Value| text(line, "last_error").contains("bytes are damaged on the line");
    let is_standard = |line: &Value| line["type"].as_str().is_some_and(|kind| kind.contains(" standard "));
    status.await_line("the report of damage on the line", |line| reports_damage(line) || is_standard(line));
    status.await_lines(3, "a status", is_class("status"));
    let statuses = status.end(INT).of_class("status");
    assert!(!statuses.iter().any(|line| text(line, "last_error").contains("head")), "{statuses:#?}");
}

#[test]
fn counts_and_reports_restarts_of_the_scanner() {
    let env = TestEnv::new();
    let _simulator = simulator(&env, "a1", &["--fault=brownout_at=4,brownout_every=3"]);
    let hub = hub(&env, &["model=a1"]);
    let restarts = |info: &Value| number(&info["counters"], "scanner_restarts");
    let info = env.await_info("front", |info| text(info, "last_error").contains("times in 10 s"));
    assert!(restarts(&info) >= 2, "{info}");
    assert!(text(&info, "last_error").ends_with("is its supply strong enough?"), "{info}");
    let log = hub.end(TERM).stderr;
    assert!(log.contains("the scanner restarted"), "{log}");
    let restart_messages: Vec<_> =
        log.lines().map(|line| line.split_once("the scanner restarted").map(|(_, end)| end)).collect();
    let is_repeated = restart_messages.windows(2).any(|pair| pair[0].is_some() && pair[0] == pair[1]);
    assert!(!is_repeated, "a count was logged twice: {log}");
}

#[test]
fn doctor_reports_health_of_the_scanner() {
    let env = TestEnv::new();
    let port = env.path_argument("front");
    let health = |code: i32| {
        let outcome = env.run(&["doctor", &port, "--json", "--no-system-config"]);
        assert_eq!(outcome.exit_code, Some(code), "{outcome}");
        let found = outcome.of_class("check");
        let of =
            |name: &str| found.iter().find(|line| line["name"] == name && !line["port"].is_null()).cloned();
        let sensor = of("sensor").unwrap_or_else(|| panic!("no sensor: {outcome}"));
        assert!(text(&sensor, "finding").contains("A1 at 115200 Bd, family rplidar, firmware"), "{sensor}");
        of("health").unwrap_or_else(|| panic!("no health: {outcome}"))
    };
    let healthy = simulator(&env, "a1", &[]);
    assert_eq!(text(&health(0), "state"), "ok");
    assert_eq!(healthy.end(TERM).exit_code, Some(0));
    let _faulty = simulator(&env, "a1", &["--fault=health=2"]);
    let health_of_faulty = health(5);
    assert!(
        text(&health_of_faulty, "state") == "failed"
            && text(&health_of_faulty, "finding").contains("has stopped measuring"),
        "{health_of_faulty}"
    );
}

#[test]
fn clears_resettable_error_and_reports_persistent_one() {
    let env = TestEnv::new();
    let hub = hub(&env, &[]);
    let cleared = simulator(&env, "a1", &["--fault=health=2"]);
    env.await_info("front", |info| info["state"] == "streaming");
    env.kill_port_simulator(cleared, "front");
    env.await_info("front", |info| info["state"] == "absent");
    let persistent = simulator(&env, "a1", &["--fault=health=2,stubborn=1"]);
    let info = env.await_info("front", |info| text(info, "last_error").contains("has stopped measuring"));
    assert_ne!(info["state"], "streaming", "{info}");
    // When a healthy scanner is connected instead, it streams without a restart of the hub.
    env.kill_port_simulator(persistent, "front");
    let _well = simulator(&env, "a1", &[]);
    env.await_info("front", |info| info["state"] == "streaming" && info["last_error"] == "");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}
