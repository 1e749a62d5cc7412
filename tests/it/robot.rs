//! Tests of the combined verdict of a robot with two sensors: the verdict becomes `unknown` if a sensor or the hub
//! stops, and recovers after both run again.

use crate::testkit::{INT, KILL, Program, TERM, TestEnv, TestGateway, in_a_network, wait_until};
use scanhub_client::{Robot, RobotSubscriber};
use scanhub_schema::{Topic, Verdict, Zones};
use serde_json::{Value, json};

/// Setting with zones so small that the simulated room has no object in them.
const SMALL_ZONES: &str = "--set=zones.radii=[0.02,0.01]";

fn hub(env: &TestEnv) -> Program {
    env.hub(&[&env.link("front"), &env.link("rear"), SMALL_ZONES])
}

fn sensor(env: &TestEnv, name: &str) -> Program {
    let port = format!("--port={}", env.path_argument(name));
    env.start(&["simulate", "--json", "--baud=500000", &port]).ready()
}

/// Returns three verdicts in a line of `echo robot/zones`: those of the robot, of `front` and of `rear`.
fn verdicts(line: &Value) -> [&str; 3] {
    let of = |value: &Value, name: &str| {
        let sensors = value["sensors"].as_array()?;
        let is_it = |sensor: &&Value| sensor["sensor"] == name;
        sensors
            .iter()
            .find(is_it)
            .and_then(|sensor| ALL_VERDICTS.into_iter().find(|it| sensor["verdict"] == *it))
    };
    const ALL_VERDICTS: [&str; 4] = ["clear", "slow", "stop", "unknown"];
    let robot = ALL_VERDICTS.into_iter().find(|it| line["verdict"] == *it).unwrap_or("none");
    [robot, of(line, "front").unwrap_or("none"), of(line, "rear").unwrap_or("none")]
}

#[test]
fn dead_sensor_or_hub_makes_the_robot_unknown() {
    let env = TestEnv::new();
    let (_front, rear) = (sensor(&env, "front"), sensor(&env, "rear"));
    let first = hub(&env);
    let mut echo = env.start(&["echo", "--json", "robot/zones"]);
    let are = |expected: [&'static str; 3]| move |line: &Value| verdicts(line) == expected;
    let line = echo.await_line("clear verdicts", are(["clear", "clear", "clear"]));
    assert_eq!((&line["class"], &line["sensor"]), (&"zones".into(), &"robot".into()), "{line}");
    assert!(line.get("stale").is_none() && line["nearest_mm"].is_u64(), "{line}");

    env.kill_port_simulator(rear, "rear");
    // Either the hub or the client detects first that `rear` is absent. The samples of `front` are not stale, so
    // neither is the line.
    echo.await_line("a clear front without the rear", |line| {
        verdicts(line) == ["unknown", "clear", "unknown"] && line.get("stale").is_none()
    });

    assert_eq!(first.end(KILL).exit_code, None);
    let line =
        echo.await_line("unknown verdicts after the end of the hub", are(["unknown", "unknown", "unknown"]));
    assert_eq!(line["nearest_mm"], Value::Null, "{line}");

    let _rear = sensor(&env, "rear");
    let _second = hub(&env);
    echo.await_line("clear verdicts again", are(["clear", "clear", "clear"]));
    let outcome = echo.end(INT);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let summaries = outcome.of_class("summary");
    assert!(matches!(&summaries[..], [one] if one["sensor"] == "robot"), "{outcome}");
}

#[test]
fn robot_subscriber_receives_each_verdict_change() {
    let env = TestEnv::new();
    let mut robot =
        RobotSubscriber::builder(&["front", "rear"]).in_domain(&env.domain()).open().expect("valid names");
    let first = robot.next().expect("a verdict without a hub");
    assert_eq!((first.verdict(), first.worst()), (Verdict::Unknown, Some("front")));
    let _front = sensor(&env, "front");
    let hub = hub(&env);
    wait_until("a verdict of the front", || {
        let verdicts: Vec<_> = robot.next().expect("a hub").sensors().map(|(_, verdict)| verdict).collect();
        verdicts == [Verdict::Clear, Verdict::Unknown]
    });
    let _rear = sensor(&env, "rear");
    wait_until("a verdict of the rear", || robot.next().expect("a hub").verdict() == Verdict::Clear);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    wait_until("all verdicts are unknown", || {
        robot
            .now()
            .expect("a verdict without a hub")
            .sensors()
            .all(|(_, verdict)| verdict == Verdict::Unknown)
    });
}

/// On a machine without a hub, `robot` combines the sensors that the listener of this machine publishes.
#[test]
fn robot_without_a_hub_uses_remote_sensors() {
    in_a_network("robot::robot_without_a_hub_uses_remote_sensors", || {
        let env = TestEnv::new();
        let mut listener =
            env.start(&["listen", "--json", "--publish", "--name=robot1=0000000000000001"]).ready();
        let refused = env.run(&["echo", "robot/zones", "--json", "-n", "1", "--for=10s"]);
        let error = refused.of_class("error").remove(0);
        assert_eq!((refused.exit_code, &error["kind"]), (Some(3), &"no_topic".into()), "{refused}");
        assert!(error["hint"].as_str().is_some_and(|hint| hint.contains("scanhub listen")), "{error}");

        let mut front = TestGateway::new(1, 7, 0, "front");
        front.wait_until_published(&mut listener, &[Topic::Zones]);
        // A sensor that does not publish zones is not part of the robot.
        TestGateway::new(1, 7, 1, "mapper").wait_until_published(&mut listener, &[Topic::Scan]);
        let mut echo = env.start(&["echo", "--json", "robot/zones"]);
        let mut leds = env.start(&["leds", "--json", "robot", "--hold=0s"]);
        let own = |line: &Value, verdict: &str, sensor: &str| {
            let sensors = json!([{"sensor": sensor, "verdict": verdict}]);
            line["class"] == "zones" && line["verdict"] == verdict && line["sensors"] == sensors
        };
        echo.await_line("an unknown verdict", |line| own(line, "unknown", "robot1.front"));
        for (verdict, word) in [(Verdict::Slow, "slow"), (Verdict::Clear, "clear")] {
            front.send(Topic::Zones, &Zones { verdict: verdict as u8, ..Zones::unknown() });
            echo.await_line(word, |line| own(line, word, "robot1.front"));
        }
        echo.await_line("silence", |line| own(line, "unknown", "robot1.front") && line["stale"] == true);
        leds.await_line("slow", |line| line["verdict"] == "slow" && line["worst"] == "robot1.front");
        leds.await_line("silence", |line| line["verdict"] == "unknown" && line["red"] == true);

        // While a hub runs, `robot` combines the sensors of the hub. When the hub exits, remote sensors do not replace
        // these sensors.
        let _sensor = sensor(&env, "front");
        // A second subscriber queries the current verdict, and must find the remote sensor, too.
        let mut busy =
            RobotSubscriber::builder(&[]).in_domain(&env.domain()).open().expect("a robot without names");
        let names = |robot: &Robot| robot.sensors().map(|(name, _)| name.to_owned()).collect::<Vec<_>>();
        let mut query_names = |busy: &mut RobotSubscriber| {
            front.send(Topic::Zones, &Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() });
            wait_until("a verdict", || busy.try_next().expect("a working subscriber").is_some());
            names(busy.now().expect("a working subscriber"))
        };
        wait_until("the remote sensor", || query_names(&mut busy) == ["robot1.front"]);
        let own_hub = env.hub(&[&env.link("front"), SMALL_ZONES]);
        wait_until("only the sensors of the hub", || query_names(&mut busy) == ["front"]);
        drop(busy);
        echo.await_line("only the sensors of the hub", |line| own(line, "clear", "front"));
        assert_eq!(own_hub.end(KILL).exit_code, None);
        echo.await_line("unknown verdicts after the end of the hub", |line| own(line, "unknown", "front"));
        front.send(Topic::Zones, &Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() });
        let mut named = env.start(&["echo", "--json", "robot1.front/zones"]);
        named.await_line("a verdict of the named remote sensor", |line| line["verdict"] == "clear");
        let outcome = echo.end(INT);
        let lines = outcome.of_class("zones");
        let first_own =
            lines.iter().position(|line| own(line, "clear", "front")).expect("a verdict of the local hub");
        let is_own = |line: &Value| line["sensors"] == json!([]) || line["sensors"][0]["sensor"] == "front";
        assert!(lines[first_own..].iter().all(is_own), "{outcome}");
        assert_eq!(lines[lines.len() - 1]["verdict"], "unknown", "{outcome}");
        assert_eq!((leds.end(INT).exit_code, listener.end(TERM).exit_code), (Some(0), Some(0)));
    });
}

#[test]
fn robot_has_no_scans_and_cannot_be_a_link() {
    let env = TestEnv::new();
    let scan = env.run(&["echo", "--json", "robot/scan"]);
    assert_eq!((scan.exit_code, &scan.of_class("error")[0]["kind"]), (Some(2), &"usage".into()), "{scan}");
    let link = env.run(&["run", "--json", "--no-system-config", "--link=robot=/dev/ttyS0"]);
    assert_eq!(link.exit_code, Some(78), "{link}");
    assert!(link.stderr.contains("robot"), "{link}");
}
