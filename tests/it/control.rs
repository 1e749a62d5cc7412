//! What users ask of a running hub: a sensor is stopped, streams again, is begun anew with; and what is refused.

use crate::testkit;
use crate::testkit::{INT, Outcome, REAL_ANSWERS, TERM, TestEnv, is_class, number, sequence, until};
use serde_json::Value;

fn control(env: &TestEnv, sensor: &str, verb: &str) -> Outcome {
    env.run(&["control", sensor, verb, "--json"])
}

/// Asks for `verb`, which must be taken.
fn taken(env: &TestEnv, sensor: &str, verb: &str) {
    let outcome = control(env, sensor, verb);
    let [line] = &outcome.lines()[..] else { panic!("not one line: {outcome}") };
    assert_eq!(outcome.code, Some(0), "{outcome}");
    assert_eq!(
        *line,
        serde_json::json!({ "class": "control", "sensor": sensor, "verb": verb, "outcome": "taken" })
    );
}

fn await_state(env: &TestEnv, sensor: &str, state: &str) -> Value {
    env.await_info(sensor, |info| info["state"] == state)
}

#[test]
fn a_paused_sensor_stops_and_a_resumed_one_goes_on_without_a_gap() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("front"), env.link("rear")]);
    let mut consumers = ["front/telegram", "front/scan", "rear/scan"].map(|topic| env.echo(&[topic]));
    let simulator = env.simulator(&["front", "rear"], &["--seed=31", "--baud=500000", REAL_ANSWERS]);
    for consumer in &mut consumers[1..] {
        consumer.await_lines(20, "a scan", is_class("scan"));
    }
    taken(&env, "front", "pause");
    await_state(&env, "front", "paused");
    // It is the sensor that was stopped: it sends nothing any more while the other one goes on.
    let mut sent = 0;
    until("the sensor is stopped", || {
        let before = std::mem::replace(&mut sent, env.truth("front").len());
        consumers[2].await_lines(10, "a scan of the other sensor", is_class("scan"));
        before == sent
    });
    // The second of two statuses is one of the pause.
    let statuses = env.run(&["echo", "front/status", "-n", "2", "--timeout", "5s"]);
    assert_eq!(statuses.code, Some(0), "{statuses}");
    let paused = env.info("front");
    consumers[2].await_lines(40, "a scan of the other sensor", is_class("scan"));
    let later = env.info("front");
    assert_eq!((&later["state"], &later["last_error"]), (&"paused".into(), &"".into()));
    assert_eq!(later["counters"]["telegrams"], paused["counters"]["telegrams"]);
    assert_eq!(env.truth("front").len(), sent);
    // Once more changes nothing.
    taken(&env, "front", "pause");
    taken(&env, "front", "resume");
    let before = number(&paused["counters"], "telegrams");
    consumers[1].await_lines(40, "a scan after the pause", |line| {
        line["class"] == "scan" && number(line, "seq") >= before
    });
    let resumed = await_state(&env, "front", "streaming");
    assert_eq!(resumed["counters"]["resyncs"], 0, "{resumed}");

    let [telegrams, scans, others] = consumers.map(|consumer| consumer.end(INT));
    for (outcome, class) in [(&telegrams, "telegram"), (&scans, "scan"), (&others, "scan")] {
        sequence(&outcome.of_class(class), "topic_seq");
        assert_eq!(outcome.of_class("summary")[0]["missed"], 0);
    }
    sequence(&telegrams.of_class("telegram"), "seq");
    assert_eq!(hub.end(TERM).code, Some(0));
    assert_eq!(simulator.end(TERM).code, Some(0));
    assert_eq!((env.simulated("front").1, env.simulated("rear").1), (0, 0), "EEPROM");
}

#[test]
fn a_resync_is_counted_and_ends_a_pause() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=32", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front")]);
    await_state(&env, "front", "streaming");
    taken(&env, "front", "resync");
    let resyncs = |info: &Value| number(&info["counters"], "resyncs");
    env.await_info("front", |info| info["state"] == "streaming" && resyncs(info) == 1);
    taken(&env, "front", "pause");
    await_state(&env, "front", "paused");
    taken(&env, "front", "resync");
    env.await_info("front", |info| info["state"] == "streaming" && resyncs(info) == 2);
}

#[test]
fn an_absent_sensor_can_be_paused_and_stays_so_when_it_comes() {
    let env = TestEnv::new();
    let _hub = env.hub(&[env.link("front")]);
    await_state(&env, "front", "absent");
    taken(&env, "front", "pause");
    let refused = control(&env, "front", "resync");
    let error = &refused.of_class("error")[0];
    assert_eq!((refused.code, &error["kind"]), (Some(1), &"failed".into()), "{refused}");
    assert_eq!(error["message"], "front: the port is away");
    let simulator = env.simulator(&["front"], &["--seed=33", "--baud=500000"]);
    await_state(&env, "front", "paused");
    // It went and came again.
    assert_eq!(simulator.end(TERM).code, Some(0));
    await_state(&env, "front", "absent");
    let _simulator = env.simulator(&["front"], &["--seed=33", "--baud=500000"]);
    let info = await_state(&env, "front", "paused");
    // Each time it was told to stop, and said so; it did not send a scan.
    assert!(number(&info["counters"], "telegrams") <= 2, "{info}");
    taken(&env, "front", "resume");
    await_state(&env, "front", "streaming");
}

#[test]
fn what_is_not_there_or_takes_no_requests_is_refused() {
    let env = TestEnv::new();
    let outcome = control(&env, "front", "pause");
    assert_eq!((outcome.code, &outcome.of_class("error")[0]["kind"]), (Some(3), &"no_hub".into()));

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
        assert_eq!((outcome.code, &error["kind"]), (Some(code), &kind.into()), "{outcome}");
        assert_eq!(error["message"], message);
        assert!(error["hint"].as_str().is_some_and(|hint| hint.contains("front")), "{outcome}");
    }
    let usage = env.run(&["control", "front", "stop"]);
    assert_eq!(usage.code, Some(2), "{usage}");
    assert!(usage.errors.contains("pause, resume, resync"), "{usage}");
}

#[test]
fn many_ask_at_once_and_some_are_killed_while_they_do() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=34", "--baud=500000"]);
    let hub = env.hub(&[env.link("front")]);
    await_state(&env, "front", "streaming");
    for _ in 0..3 {
        let asking: Vec<_> =
            (0..10).map(|number| (number, env.start(&["control", "front", "pause", "--json"]))).collect();
        for (number, program) in asking {
            if number % 2 == 0 {
                // Killed at whatever it is doing.
                drop(program.end(testkit::KILL));
                continue;
            }
            let outcome = program.wait();
            // Taken, or told to come back.
            assert!(matches!(outcome.code, Some(0 | 75)), "{outcome}");
            assert_eq!(outcome.lines().len(), 1, "{outcome}");
        }
    }
    // The killed ones may still take the places of all that may ask at a time.
    until("there is room to ask", || {
        let outcome = control(&env, "front", "resume");
        assert!(matches!(outcome.code, Some(0 | 75)), "{outcome}");
        outcome.code == Some(0)
    });
    await_state(&env, "front", "streaming");
    assert_eq!(hub.end(TERM).code, Some(0));
}
