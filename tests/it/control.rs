//! `scanhub control` with a running hub: pauses, resumes and resyncs a sensor, and rejects invalid requests.

use crate::testkit;
use crate::testkit::{
    INT, Outcome, REAL_REPLY_TIME, TERM, TestEnv, contiguous_numbers, is_class, number, wait_until,
};
use serde_json::Value;

fn control(env: &TestEnv, sensor: &str, verb: &str) -> Outcome {
    env.run(&["control", sensor, verb, "--json"])
}

/// Sends the request `verb`, which the hub must accept.
fn control_accepted(env: &TestEnv, sensor: &str, verb: &str) {
    let outcome = control(env, sensor, verb);
    let [line] = &outcome.lines()[..] else { panic!("exactly one line was expected: {outcome}") };
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert_eq!(
        *line,
        serde_json::json!({ "class": "control", "sensor": sensor, "verb": verb, "outcome": "taken" })
    );
}

fn await_state(env: &TestEnv, sensor: &str, state: &str) -> Value {
    env.await_info(sensor, |info| info["state"] == state)
}

#[test]
fn paused_sensor_stops_and_resumes_without_a_gap() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("front"), env.link("rear")]);
    let mut subscribers = ["front/telegram", "front/scan", "rear/scan"].map(|topic| env.echo(&[topic]));
    let simulator = env.simulator(&["front", "rear"], &["--seed=31", "--baud=500000", REAL_REPLY_TIME]);
    for subscriber in &mut subscribers[1..] {
        subscriber.await_lines(20, "a scan", is_class("scan"));
    }
    control_accepted(&env, "front", "pause");
    await_state(&env, "front", "paused");
    // Check that the request stopped the right scanner. That scanner sends no more telegrams, while the other scanner
    // continues to stream.
    let mut sent = 0;
    wait_until("the sensor is stopped", || {
        let before = std::mem::replace(&mut sent, env.truth("front").len());
        subscribers[2].await_lines(10, "a scan of the other sensor", is_class("scan"));
        before == sent
    });
    // The hub sends the status repeatedly during the pause. The second status received here was therefore sent after
    // the pause had begun.
    let statuses = env.run(&["echo", "front/status", "-n", "2", "--timeout", "5s"]);
    assert_eq!(statuses.exit_code, Some(0), "{statuses}");
    let paused = env.info("front");
    subscribers[2].await_lines(40, "a scan of the other sensor", is_class("scan"));
    let later = env.info("front");
    assert_eq!((&later["state"], &later["last_error"]), (&"paused".into(), &"".into()));
    assert_eq!(later["counters"]["telegrams"], paused["counters"]["telegrams"]);
    assert_eq!(env.truth("front").len(), sent);
    // Pausing a sensor again changes nothing.
    control_accepted(&env, "front", "pause");
    control_accepted(&env, "front", "resume");
    let before = number(&paused["counters"], "telegrams");
    subscribers[1].await_lines(40, "a scan after the pause", |line| {
        line["class"] == "scan" && number(line, "seq") >= before
    });
    let resumed = await_state(&env, "front", "streaming");
    assert_eq!(resumed["counters"]["resyncs"], 0, "{resumed}");

    let [telegrams, scans, others] = subscribers.map(|subscriber| subscriber.end(INT));
    for (outcome, class) in [(&telegrams, "telegram"), (&scans, "scan"), (&others, "scan")] {
        contiguous_numbers(&outcome.of_class(class), "topic_seq");
        assert_eq!(outcome.of_class("summary")[0]["missed"], 0);
    }
    contiguous_numbers(&telegrams.of_class("telegram"), "seq");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!((env.simulator_totals("front").1, env.simulator_totals("rear").1), (0, 0), "EEPROM");
}

#[test]
fn resync_is_counted_and_ends_a_pause() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=32", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    await_state(&env, "front", "streaming");
    control_accepted(&env, "front", "resync");
    let resyncs = |info: &Value| number(&info["counters"], "resyncs");
    env.await_info("front", |info| info["state"] == "streaming" && resyncs(info) == 1);
    control_accepted(&env, "front", "pause");
    await_state(&env, "front", "paused");
    control_accepted(&env, "front", "resync");
    env.await_info("front", |info| info["state"] == "streaming" && resyncs(info) == 2);
}

#[test]
fn absent_sensor_can_be_paused_before_it_appears() {
    let env = TestEnv::new();
    let _hub = env.hub(&[env.link("front")]);
    await_state(&env, "front", "absent");
    control_accepted(&env, "front", "pause");
    let refused = control(&env, "front", "resync");
    let error = &refused.of_class("error")[0];
    assert_eq!((refused.exit_code, &error["kind"]), (Some(1), &"failed".into()), "{refused}");
    assert_eq!(error["message"], "front: the port is unavailable");
    let simulator = env.simulator(&["front"], &["--seed=33", "--baud=500000"]);
    await_state(&env, "front", "paused");
    // The scanner is disconnected and connected again.
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    await_state(&env, "front", "absent");
    let _simulator = env.simulator(&["front"], &["--seed=33", "--baud=500000"]);
    let info = await_state(&env, "front", "paused");
    // The sensor stays paused. Its scanner has replied to requests, but has sent no scan.
    assert!(number(&info["counters"], "telegrams") <= 2, "{info}");
    control_accepted(&env, "front", "resume");
    await_state(&env, "front", "streaming");
}

#[test]
fn rejects_requests_to_missing_hub_sensor_or_session() {
    let env = TestEnv::new();
    let outcome = control(&env, "front", "pause");
    assert_eq!((outcome.exit_code, &outcome.of_class("error")[0]["kind"]), (Some(3), &"no_hub".into()));

    let scans: Vec<u8> = (0..4000).flat_map(testkit::scan).collect();
    let file = env.file("scans", scans);
    let _hub = env.hub(&["--link", &format!("front=file:{file}")]);
    for (sensor, code, kind, message) in [
        ("side", 3, "no_topic", "the hub has no sensor side"),
        ("front", 1, "failed", "front: a recording has no session to restart"),
        ("Front", 2, "usage", "sensor name \"Front\" is not possible"),
    ] {
        let outcome = control(&env, sensor, "resync");
        let error = &outcome.of_class("error")[0];
        assert_eq!((outcome.exit_code, &error["kind"]), (Some(code), &kind.into()), "{outcome}");
        assert_eq!(error["message"], message);
        assert!(error["hint"].as_str().is_some_and(|hint| hint.contains("front")), "{outcome}");
    }
    let usage = env.run(&["control", "front", "stop"]);
    assert_eq!(usage.exit_code, Some(2), "{usage}");
    assert!(usage.stderr.contains("pause, resume, resync"), "{usage}");
}

#[test]
fn concurrent_and_killed_control_clients_are_handled() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=34", "--baud=500000"]);
    let hub = env.hub(&[env.link("front")]);
    await_state(&env, "front", "streaming");
    for _ in 0..3 {
        let asking: Vec<_> =
            (0..10).map(|number| (number, env.start(&["control", "front", "pause", "--json"]))).collect();
        for (number, program) in asking {
            if number % 2 == 0 {
                // Kill the client at an arbitrary moment.
                drop(program.end(testkit::KILL));
                continue;
            }
            let outcome = program.wait();
            // The hub accepts the request (0), or it is busy and the client must try again (75).
            assert!(matches!(outcome.exit_code, Some(0 | 75)), "{outcome}");
            assert_eq!(outcome.lines().len(), 1, "{outcome}");
        }
    }
    // The hub may be busy for a short time, because the killed programs may still hold all slots for requests.
    wait_until("the hub accepts a request", || {
        let outcome = control(&env, "front", "resume");
        assert!(matches!(outcome.exit_code, Some(0 | 75)), "{outcome}");
        outcome.exit_code == Some(0)
    });
    await_state(&env, "front", "streaming");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}
