//! Tests with a bridge on each of two machines: topics of one machine's hub are available on the other.

use std::cell::Cell;
use std::process::Command;

use scanhub_schema::datagram::Datagram;
use serde_json::Value;
use zenoh::Wait;

use crate::testkit::{INT, TestEnv, number, output, succeeds, wait_until, write_program};
use crate::{
    NO_FLAGS, address, assert_counters_agree, bridge, bridge_without_peer, final_counters, open_peer,
    refusal_count, wait_until_linked,
};

/// Returns `seq` and ranges of `count` scans of the topic `name`.
fn scans(env: &TestEnv, name: &str, count: &str) -> Vec<(u64, Value)> {
    let outcome = env.run(&["echo", name, "--json", "-n", count, "--timeout", "20s"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    outcome.of_class("scan").iter().map(|line| (number(line, "seq"), line["ranges"].clone())).collect()
}

#[test]
fn hub_is_published_on_another_machine_without_loss() {
    let (robot, desk) = (TestEnv::new(), TestEnv::new());
    let _sensor = robot.simulator(&["front"], NO_FLAGS);
    let at = address("tcp");
    let (mut there, id) = bridge(&robot, &["--listen", &at]);
    let (mut here, _) =
        bridge(&desk, &["--connect", &at, "--publish", "--hub=robot1", &format!("--name=robot1={id}")]);
    wait_until_linked(&mut here);
    wait_until_linked(&mut there);
    let hub = robot.hub(&[robot.link("front")]);
    let line = here.await_line("a sensor", |line| line["kind"] == "published");
    assert_eq!(line["sensor"], "robot1.front");

    // Both sides receive the same scans.
    let mut far = desk.echo(&["robot1.front/scan"]);
    let near = scans(&robot, "front/scan", "20");
    let last = near.last().expect("scans").0;
    far.await_line("the last of them", |line| line["class"] == "scan" && number(line, "seq") >= last);
    let far = far.end(INT);
    let far = far.of_class("scan");
    let both: Vec<_> = far.iter().map(|line| (number(line, "seq"), &line["ranges"])).collect();
    // On a busy machine, a newer scan replaces a queued one.
    let pairs =
        near.iter().filter_map(|(seq, ranges)| Some((ranges, both.iter().find(|far| far.0 == *seq)?.1)));
    let pairs: Vec<_> = pairs.collect();
    assert!(pairs.len() > 5 && pairs.iter().all(|(near, far)| near == far), "{} scans", pairs.len());

    // A late joiner gets status and background at once.
    let late = TestEnv::new();
    let (mut latest, _) = bridge(&late, &["--connect", &at, "--publish"]);
    latest.await_line("a sensor", |line| line["kind"] == "published");
    let own = format!("{id}.front");
    late.await_info(&own, |info| info["state"] == "streaming");
    let background = late.run(&["echo", &format!("{own}/background"), "--json", "-n1", "--timeout=20s"]);
    assert_eq!(background.exit_code, Some(0), "{background}");

    // When the hub exits, zones become unknown, and its bridge waits for the next hub.
    let mut zones = desk.echo(&["robot1.front/zones"]);
    hub.end(INT);
    zones.await_line("nothing is known", |line| line["class"] == "zones" && line["verdict"] == "unknown");
    let (sent, latest) = (there.end(INT), latest.end(INT));
    let received = here.end(INT);
    assert_eq!(
        (sent.exit_code, received.exit_code, latest.exit_code),
        (Some(0), Some(0), Some(0)),
        "{sent}{received}"
    );
    assert_eq!(assert_counters_agree(&sent, &received), 0, "{received}");
    // The late joiner lost nothing, because samples that were sent before it connected do not count.
    let (all, of_latest) =
        (final_counters(&sent, &["sent"]), final_counters(&latest, &["received", "lost", "duplicate"]));
    assert!(of_latest["front/scan"][0] > 0, "{latest}");
    for (name, row) in &of_latest {
        let sent = all.get(name).map_or(0, |sent| sent[0]);
        assert!(row[1] == 0 && row[0] <= sent, "{name}: {row:?} of {all:?}");
    }
    for reason in ["crc", "payload", "key", "long", "overrun", "twin"] {
        assert_eq!(
            (refusal_count(&received, reason), refusal_count(&latest, reason)),
            (0, 0),
            "{reason}: {received}"
        );
    }
}

/// Returns the keys of all replies that a plain Zenoh client gets to a query.
fn answers(session: &zenoh::Session, query: &str) -> Vec<String> {
    let replies = session.get(query).wait().expect("a query");
    let mut keys = Vec::new();
    while let Ok(reply) = replies.recv() {
        let sample = reply.into_result().unwrap_or_else(|error| panic!("{query}: {error:?}"));
        let payload = sample.payload().to_bytes();
        Datagram::read(&payload).unwrap_or_else(|error| panic!("{query}: {error:?}"));
        keys.push(sample.key_expr().as_str().to_owned());
    }
    keys.sort();
    keys
}

#[test]
fn plain_zenoh_client_gets_samples_and_query_replies() {
    let robot = TestEnv::new();
    let _sensors = robot.simulator(&["front", "rear"], NO_FLAGS);
    let at = address("tcp");
    let (mut there, id) = bridge(&robot, &["--listen", &at]);
    let client = open_peer(&at);
    wait_until_linked(&mut there);
    let hub = robot.hub(&[robot.link("front"), robot.link("rear")]);
    let keys = |names: &[&str]| names.iter().map(|name| format!("scanhub/{id}/{name}")).collect::<Vec<_>>();
    let all = keys(&[
        "front/announce",
        "front/background",
        "front/status",
        "rear/announce",
        "rear/background",
        "rear/status",
    ]);
    // Scans are not sent as `express`, because a router has room for only two `express` samples.
    let samples = client.declare_subscriber("scanhub/*/*/scan").wait().expect("a subscriber");
    for _ in 0..5 {
        assert!(!samples.recv().expect("a scan").express());
    }
    wait_until("all answers exist", || answers(&client, "scanhub/**") == all);
    assert_eq!(answers(&client, "**"), all);
    assert_eq!(answers(&client, "scanhub/*/*/announce"), keys(&["front/announce", "rear/announce"]));
    assert_eq!(answers(&client, &format!("scanhub/{id}/rear/*")), all[3..]);
    assert_eq!(answers(&client, &all[1]), all[1..2]);
    assert_eq!(answers(&client, "scanhub/*/*/scan"), all[..0], "no scan is kept");

    // Without a hub, the bridge still announces the hub's sensors, but neither the hub nor the sensors have a token.
    assert_eq!(hub.end(INT).exit_code, Some(0));
    let tokens = || {
        let replies = client.liveliness().get("scanhub/*/*/@live").wait().expect("a query");
        std::iter::from_fn(|| replies.recv().ok()).count()
    };
    wait_until("the tokens are gone", || tokens() == 0);
    let changes = client.liveliness().declare_subscriber("scanhub/*/*/@live").wait().expect("a subscriber");
    let announcements = client.declare_subscriber("scanhub/*/*/announce").wait().expect("a subscriber");
    for _ in 0..4 {
        announcements.recv().expect("an announcement");
    }
    assert!(matches!(changes.try_recv(), Ok(None)), "a token of a hub that has ended");
}

#[test]
fn unknown_sensor_in_frame_flag_fails_without_router() {
    let robot = TestEnv::new();
    let _sensor = robot.simulator(&["front"], NO_FLAGS);
    let _hub = robot.hub(&[robot.link("front")]);
    robot.await_info("front", |info| info["state"] == "streaming");
    let outcome = robot.run(&["bridge", "--connect=tcp/127.0.0.1:1", "--ros2", "--frame=nothere=x"]);
    assert_eq!(outcome.exit_code, Some(3), "{outcome}");
    assert!(outcome.stderr.contains("nothere") && outcome.stderr.contains("front"), "{outcome}");
}

#[test]
fn both_directions_go_through_one_connection() {
    let (left, right) = (TestEnv::new(), TestEnv::new());
    let (_one, _other) = (left.simulator(&["front"], NO_FLAGS), right.simulator(&["rear"], NO_FLAGS));
    let (_left_hub, _right_hub) = (left.hub(&[left.link("front")]), right.hub(&[right.link("rear")]));
    let at = address("tcp");
    let (mut one, left_id) = bridge(&left, &["--listen", &at, "--publish", "--send"]);
    let (mut other, right_id) = bridge(&right, &["--connect", &at, "--publish", "--send"]);
    let published = |line: &Value| line["kind"] == "published";
    assert_eq!(one.await_line("its sensor", published)["sensor"], format!("{right_id}.rear"));
    assert_eq!(other.await_line("its sensor", published)["sensor"], format!("{left_id}.front"));
    wait_until("both have both", || left.sensor_count() == 2 && right.sensor_count() == 2);
    let (one, other) = (one.end(INT), other.end(INT));
    // Received samples are not sent back.
    for outcome in [&one, &other] {
        let published = outcome.of_class("bridge_published");
        assert_eq!(
            published.last().expect("an account")["sensors"].as_array().map(Vec::len),
            Some(1),
            "{outcome}"
        );
    }
}

impl TestEnv {
    /// Returns the number of sensors that have topics in this domain.
    fn sensor_count(&self) -> usize {
        let topics = self.run(&["list", "--json"]).of_class("topic");
        let mut sensors: Vec<_> = topics.iter().map(|line| line["sensor"].to_string()).collect();
        sensors.sort();
        sensors.dedup();
        sensors.len()
    }
}

/// Runs a copy of `scanhub` as `scanhub bridge`. The copy is alone in its directory, or next to a script with the name
/// `scanhub-bridge`. Returns the line that the copy prints.
fn error_of_lone_program(env: &TestEnv, bridge_script: Option<&str>) -> String {
    let program = env.command(&["bridge", "--connect=tcp/127.0.0.1:1"]).get_program().to_owned();
    let alone = env.path("scanhub");
    // Another process writes the copy, for the reason that `write_program` explains.
    assert!(succeeds(Command::new("cp").arg(program).arg(&alone)), "can be copied");
    if let Some(script) = bridge_script {
        write_program(env.path("scanhub-bridge"), format!("#!/bin/sh\n{script}\n"));
    }
    let outcome = output(Command::new(&alone).arg("bridge").env("PATH", env.path("nothing"))).expect("runs");
    let errors = String::from_utf8_lossy(&outcome.stderr).into_owned();
    assert_eq!(outcome.status.code(), Some(78), "{errors}");
    assert!(errors.trim_end().lines().count() == 1, "in one line: {errors}");
    assert!(errors.contains("cargo install --path clients/bridge"), "{errors}");
    errors
}

#[test]
fn missing_or_older_bridge_program_is_reported() {
    let env = TestEnv::new();
    assert!(error_of_lone_program(&env, None).contains("is not installed"));
    let other = error_of_lone_program(&env, Some("echo scanhub-bridge 0.0.7"));
    assert!(other.contains("version 0.0.7") && other.contains(env!("CARGO_PKG_VERSION")), "{other}");
}

#[test]
fn bridge_waits_for_a_router_and_then_connects() {
    let (robot, middle) = (TestEnv::new(), TestEnv::new());
    let at = address("tcp");
    let mut there = bridge_without_peer(&robot, &["--connect", &at]);
    let is = |line: &Value, state: &str| line["class"] == "bridge_link" && line["state"] == state;
    let (waits, why) = (Cell::new(false), Cell::new(false));
    there.await_line("that it waits, and why", |line| {
        let says = |key: &str, text: &str| line[key].as_str().is_some_and(|reported| reported.contains(text));
        waits.set(waits.get() || is(line, "waiting") && says("message", &at));
        why.set(why.get() || is(line, "failing") && says("finding", "no router is reached"));
        waits.get() && why.get()
    });
    assert!(!there.prints(|line| line["class"] == "bridge_ready"));
    // A bridge that listens reports that it is ready when other programs can connect.
    let _router = bridge(&middle, &["--listen", &at]);
    let socket = at.strip_prefix("tcp/").expect("tcp");
    std::net::TcpStream::connect(socket).expect("it listens");
    there.await_line("its begin", |line| line["class"] == "bridge_ready");
    wait_until_linked(&mut there);
    assert_eq!(there.end(INT).exit_code, Some(0));
}

#[test]
fn publishes_only_selected_topics() {
    let (robot, desk) = (TestEnv::new(), TestEnv::new());
    let _sensor = robot.simulator(&["front"], NO_FLAGS);
    let at = address("tcp");
    let (there, id) = bridge(&robot, &["--listen", &at]);
    let name = format!("--name=robot1={id}");
    let (mut here, _) =
        bridge(&desk, &["--connect", &at, "--publish", &name, "--topic=*/scan", "--topic=*/status"]);
    let _hub = robot.hub(&[robot.link("front")]);
    here.await_line("a sensor", |line| line["kind"] == "published");
    assert_eq!(scans(&desk, "robot1.front/scan", "5").len(), 5);
    desk.await_info("robot1.front", |info| info["state"] == "streaming");
    let topics = desk.run(&["list", "--json"]).of_class("topic");
    let topics: Vec<_> = topics.iter().map(|line| line["topic"].clone()).collect();
    assert_eq!(topics, ["scan", "status"]);
    let (sent, received) = (there.end(INT), here.end(INT));
    let rows = final_counters(&received, &["received", "lost"]);
    let names: Vec<_> = rows.keys().map(String::as_str).collect();
    assert_eq!(names, ["front/announce", "front/scan", "front/status"], "{received}");
    assert!(rows.values().all(|row| row[1] == 0) && final_counters(&sent, &["sent"]).len() > 3, "{received}");
    for wrong in ["front/scan", "*/scan:every=2"] {
        let outcome = desk.run(&["bridge", "--connect", &at, "--publish", &format!("--topic={wrong}")]);
        assert_eq!(outcome.exit_code, Some(2), "{outcome}");
    }
}

#[test]
fn invalid_arguments_are_refused_at_startup() {
    let env = TestEnv::new();
    let code = |flags: &[&str]| env.run(&[&["bridge", "--json"], flags].concat()).exit_code;
    assert_eq!(code(&[]), Some(78), "no router is named");
    assert_eq!(code(&["--connect=nonsense"]), Some(78));
    assert_eq!(code(&["--connect=tcp/127.0.0.1:1", "--topic=front/scam"]), Some(2));
    assert_eq!(code(&["--connect=tcp/127.0.0.1:1", "--publish", "--hub=robot1"]), Some(78));
    assert_eq!(code(&["--connect=tcp/127.0.0.1:1", "--config=/nowhere"]), Some(66));
    assert_eq!(
        code(&["--connect=tcp/127.0.0.1:1", &format!("--config={}", env.file("c", "{ mode: 'king' }"))]),
        Some(78)
    );
    assert_eq!(code(&["--no-such-flag"]), Some(2));
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = taken.local_addr().expect("bound").port();
    let outcome = env.run(&["bridge", "--json", &format!("--listen=tcp/127.0.0.1:{port}")]);
    assert_eq!(outcome.exit_code, Some(78), "{outcome}");
    assert!(outcome.to_string().contains("in use"), "{outcome}");
}
