//! `scanhub listen --publish`: every verb can use remote sensors like local ones. This is also true after lost
//! datagrams, and after programs were restarted or killed.

use std::time::Duration;

use crate::testkit::{
    INT, KILL, Program, TERM, TestEnv, TestGateway, in_a_network, number, output, wait_at_least, wait_until,
};
use rustix::process::{Pid, Resource, Rlimit, getrlimit, prlimit};
use scanhub_schema::datagram::Announce;
use scanhub_schema::{Marks, Scan, ScanHead, State, Status, Topic, Verdict, Zones};
use serde_json::{Value, json};

const HUB_ID: u64 = 0x5f3a_12bc_00d1_e2f3;
const SENSOR_NAME: &str = "robot1.front";

fn publisher(env: &TestEnv) -> Program {
    env.start(&["listen", "--json", "--publish", "--name=robot1=5f3a12bc00d1e2f3"]).ready()
}

/// Starts a listener, and waits until it has published the sensor that `sender` announces.
fn start_and_publish(env: &TestEnv, sender: &mut TestGateway) -> Program {
    let mut program = publisher(env);
    let topics = [Topic::Zones, Topic::Scan, Topic::Status, Topic::Telegram];
    assert_eq!(sender.wait_until_published(&mut program, &topics)["sensor"], SENSOR_NAME);
    // Send a status, because verbs that list sensors wait for the status of each sensor.
    sender.send(Topic::Status, &Status { state: State::Starting as u8, ..Status::default() });
    program
}

/// Returns whether a line has zones that the gateway sent. During a silence, a client also prints lines with zones that
/// it creates itself.
fn is_zones(line: &Value) -> bool {
    line["class"] == "zones" && line["stale"] != true
}

fn zones(verdict: Verdict) -> Zones {
    Zones { verdict: verdict as u8, ..Zones::unknown() }
}

#[test]
fn remote_sensor_is_published_as_local_topics() {
    in_a_network("listen_publish::remote_sensor_is_published_as_local_topics", || {
        let env = TestEnv::new();
        let mut sender = TestGateway::new(HUB_ID, 7, 3, "front");
        let program = start_and_publish(&env, &mut sender);
        let mut echo = env.echo(&["robot1.front/zones", "robot1.front/scan", "robot1.front/telegram"]);
        let mut hz = env.start(&["hz", "--json", "robot1.front/zones"]);
        wait_until("hz is attached", || env.subscribers("robot1.front/zones") == 2);
        let scan = Scan::of(ScanHead::lms(2, -90_000, 500, 10, 13), &[11, 12]);
        let mut status = Status { state: State::Streaming as u8, since_ns: 5, ..Status::default() };
        status.set_port("/dev/ttyUSB7");
        sender.counter = 40;
        let telegram = sender.next_telegram(&[0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A]);
        sender.send_bytes(Topic::Telegram, &telegram);
        sender.send(Topic::Scan, &*scan);
        sender.send(Topic::Zones, &zones(Verdict::Slow));
        sender.send(Topic::Status, &status);
        let line = echo.await_line("zones", is_zones);
        assert_eq!((&line["sensor"], &line["verdict"]), (&json!(SENSOR_NAME), &json!("slow")));
        assert_eq!((&line["seq"], &line["boot"]), (&json!(40), &json!("000000000000b007")));
        assert_eq!(line["wall_ns"], sender.stamp_ns);
        let since_start_ns = std::fs::read_to_string("/proc/uptime").expect("Linux");
        let uptime_s: f64 =
            since_start_ns.split(' ').next().and_then(|text| text.parse().ok()).expect("seconds");
        let age_s = uptime_s - number(&line, "stamp_ns") as f64 / 1e9;
        assert!((-1.0..60.0).contains(&age_s), "the stamp differs from the arrival by {age_s} s");
        // Two samples are lost, and one sample arrives late and twice.
        let (late, lost) = (sender.next_datagram(Topic::Zones, &zones(Verdict::Stop)), 2);
        sender.next[usize::from(Topic::Zones.number())] += lost;
        sender.send(Topic::Zones, &zones(Verdict::Clear));
        sender.send_bytes(Topic::Zones, &late);
        sender.send_bytes(Topic::Zones, &late);
        sender.send(Topic::Zones, &zones(Verdict::Slow));
        echo.await_lines(2, "zones", is_zones);
        hz.await_line("the rate of a second", |line| line["class"] == "hz" && line["received"] == 3);
        let outcome = echo.end(INT);
        let zones: Vec<_> = outcome.lines().into_iter().filter(is_zones).collect();
        let numbers: Vec<_> = zones.iter().map(|line| number(line, "topic_seq")).collect();
        assert_eq!(numbers, [0, 4, 5], "{outcome}");
        assert_eq!(outcome.of_class("scan")[0]["ranges"], json!([11, 12]));
        assert_eq!(outcome.of_class("telegram")[0]["data"], "02800300a00010160a");
        let summary = outcome.of_class("summary");
        let of_zones = summary.iter().find(|line| line["topic"] == "zones").expect("a summary");
        assert_eq!((&of_zones["received"], &of_zones["missed"]), (&json!(3), &json!(3)));
        assert_eq!(hz.end(INT).of_class("summary")[0]["missed"], 3);

        let info = env.await_info(SENSOR_NAME, |info| info["state"] == "streaming");
        assert_eq!(info["port"], "/dev/ttyUSB7");
        assert!(number(&info, "since_ns") > 5, "since_ns must use this machine's clock: {info}");
        let listed = env.run(&["list", "--json"]).of_class("topic");
        let topics: Vec<_> = listed.iter().map(|line| &line["topic"]).collect();
        assert_eq!(topics, ["telegram", "scan", "zones", "status"], "only announced topics exist");
        let domains = output(env.command(&["list", "--domains", "--json"])).expect("the program runs");
        assert!(String::from_utf8_lossy(&domains.stdout).contains(&program.pid().to_string()));
        env.await_info(SENSOR_NAME, |info| info["state"] == "silent" && info["last_error"] != "");

        let outcome = program.end(TERM);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let line = &outcome.of_class("lan_published")[0];
        assert_eq!(
            (&line["sensors"], &line["late"], &line["loan_failed"]),
            (&json!([SENSOR_NAME]), &json!(1), &json!(0))
        );
        assert_eq!(
            env.run(&["info", SENSOR_NAME, "--json"]).exit_code,
            Some(3),
            "the sensor is not published any more"
        );
    });
}

#[test]
fn subscribers_survive_a_killed_listener() {
    in_a_network("listen_publish::subscribers_survive_a_killed_listener", || {
        let env = TestEnv::new();
        let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
        let first = start_and_publish(&env, &mut sender);
        let mut echo = env.echo(&["robot1.front/zones"]);
        sender.send(Topic::Zones, &zones(Verdict::Clear));
        echo.await_line("zones", is_zones);
        assert_eq!(first.end(KILL).exit_code, None);
        echo.await_line("notice hub_gone", |line| line["kind"] == "hub_gone");
        for _ in 0..4 {
            sender.send(Topic::Zones, &zones(Verdict::Slow));
        }
        let second = start_and_publish(&env, &mut sender);
        echo.await_line("notice hub_back", |line| line["kind"] == "hub_back");
        sender.send(Topic::Zones, &zones(Verdict::Stop));
        echo.await_line("zones", |line| line["verdict"] == "stop");
        let outcome = echo.end(INT);
        assert_eq!(outcome.of_class("summary")[0]["missed"], 4, "{outcome}");
        assert_eq!(second.end(TERM).exit_code, Some(0));
        assert!(env.leftover_files().is_empty(), "{:?}", env.leftover_files());
    });
}

#[test]
fn follows_restarted_gateways_and_hubs() {
    in_a_network("listen_publish::follows_restarted_gateways_and_hubs", || {
        let env = TestEnv::new();
        let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
        let program = start_and_publish(&env, &mut sender);
        let mut echo = env.echo(&["robot1.front/zones"]);
        for _ in 0..3 {
            sender.send(Topic::Zones, &zones(Verdict::Clear));
        }
        // The gateway restarts. Two samples arrive before the restarted gateway announces its sensor.
        let mut again = TestGateway::new(HUB_ID, 8, 1, "front");
        again.send(Topic::Zones, &zones(Verdict::Slow));
        again.send(Topic::Zones, &zones(Verdict::Slow));
        again.announce(&[Topic::Zones]);
        again.send(Topic::Zones, &zones(Verdict::Stop));
        let line = echo.await_line("sample of the gateway's next run", |line| line["verdict"] == "stop");
        assert_eq!(line["topic_seq"], 5);
        // The hub restarts. Its gateway continues the sequence numbers, and `topic_seq` continues for the subscribers.
        again.boot = 0xb008;
        again.announce(&[Topic::Zones]);
        again.next[usize::from(Topic::Zones.number())] += 1;
        again.send(Topic::Zones, &zones(Verdict::Clear));
        let line = echo.await_line("sample of the hub's next run", |line| line["boot"] == "000000000000b008");
        assert_eq!(line["topic_seq"], 7);
        let outcome = echo.end(INT);
        assert_eq!(outcome.of_class("summary")[0]["missed"], 3, "{outcome}");
        let outcome = program.end(INT);
        let unnamed = number(&outcome.of_class("lan_published")[0], "unnamed");
        assert_eq!(unnamed, 2 + u64::from(sender.delivery_proofs), "{outcome}");
        assert_eq!(outcome.of_class("notice").iter().filter(|line| line["kind"] == "published").count(), 1);
    });
}

#[test]
fn one_domain_has_a_hub_and_two_remote_hubs() {
    in_a_network("listen_publish::one_domain_has_a_hub_and_two_remote_hubs", || {
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &["--seed=61", "--baud=500000"]);
        let mut one = TestGateway::new(HUB_ID, 7, 0, "front");
        let mut other = TestGateway::new(0xab, 7, 0, "front");
        let mut listener = start_and_publish(&env, &mut one);
        // A subscriber to a sensor without a prefix waits for the hub, even if the domain has other publishers.
        let mut early = env.start(&["echo", "--json", "front/scan"]);
        let absent = env.run(&["echo", "--json", "front/scan", "-n", "1"]);
        assert_eq!(
            (absent.exit_code, &absent.of_class("error")[0]["kind"]),
            (Some(3), &json!("no_topic")),
            "{absent}"
        );
        let hub = env.hub(&[env.link("front")]);
        early.await_line("a scan", |line| line["class"] == "scan");
        assert_eq!(early.end(INT).exit_code, Some(0));
        let second = publisher_refused(&env);
        assert!(second.contains(&format!("pid {}", listener.pid())), "{second}");
        other.wait_until_published(&mut listener, &[Topic::Zones, Topic::Status]);
        other.send(Topic::Status, &Status::default());
        let mut echo = env.echo(&["front/scan", "robot1.front/zones", "00000000000000ab.front/zones"]);
        one.send(Topic::Zones, &zones(Verdict::Stop));
        other.send(Topic::Zones, &zones(Verdict::Slow));
        for sensor in ["front", SENSOR_NAME, "00000000000000ab.front"] {
            echo.await_line(sensor, |line| line["sensor"] == sensor && line["class"] != "notice");
        }
        // The verdict of `robot` combines only the robot's own sensors, not those of other robots.
        let mut robot = env.start(&["echo", "--json", "robot/zones"]);
        robot.await_lines(3, "a verdict", |line| line["sensors"][0]["sensor"] == "front");
        let outcome = robot.end(INT);
        // On a busy machine, the scans of a sensor may be late. The sensor is then not part of the verdict.
        let is_own = |line: &Value| line["sensors"].as_array().is_some_and(|sensors| sensors.len() <= 1);
        assert!(outcome.of_class("zones").iter().all(is_own), "{outcome}");
        let absent = env.run(&["echo", "--json", "robot2.front/zones", "-n", "1"]);
        assert_eq!(
            (absent.exit_code, &absent.of_class("error")[0]["kind"]),
            (Some(3), &json!("no_topic")),
            "{absent}"
        );
        let refused = env.run(&["control", "robot1.front", "pause", "--json"]);
        assert_eq!(refused.exit_code, Some(2), "a remote sensor cannot be controlled: {refused}");
        assert_eq!(hub.end(TERM).exit_code, Some(0));
        one.send(Topic::Zones, &zones(Verdict::Clear));
        echo.await_line("sample of the remote sensor", |line| line["verdict"] == "clear");
        drop(echo);
        assert_eq!(listener.end(TERM).exit_code, Some(0));
        assert!(env.leftover_files().is_empty(), "{:?}", env.leftover_files());
    });
}

#[test]
fn gateway_does_not_send_remote_sensors_again() {
    in_a_network("listen_publish::gateway_does_not_send_remote_sensors_again", || {
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &["--seed=62", "--baud=500000"]);
        let mut listener = env.start(&["listen", "--json", "--publish", "--interface=lo"]).ready();
        // The gateway waits for a hub, although the domain already has the listener, because the gateway never sends
        // topics that a listener publishes.
        let mut gateway = env.start(&["gateway", "--json", "--interface=lo", "--topic=front/scan"]);
        let id =
            gateway.await_line("line of class gateway", |line| line["class"] == "gateway")["hub"].clone();
        let hub = env.hub(&[env.link("front")]);
        let line = listener.await_line("a sensor", |line| line["kind"] == "published");
        let remote = format!("{}.front", id.as_str().unwrap_or_default());
        assert_eq!((&line["sensor"], &line["here"]), (&json!(remote), &json!(true)));
        let mut echo = env.echo(&["front/scan", &format!("{remote}/scan")]);
        echo.await_lines(40, "scans", |line| line["sensor"] == remote.as_str());
        let outcome = echo.end(INT);
        let scans = outcome.of_class("scan");
        let (here, there): (Vec<_>, Vec<_>) = scans.iter().partition(|line| line["sensor"] == "front");
        for line in &there[1..] {
            let same = here.iter().find(|it| it["seq"] == line["seq"]);
            let Some(same) = same else { continue };
            assert_eq!((&same["ranges"], &same["codes"]), (&line["ranges"], &line["codes"]));
            assert_eq!((&same["boot"], &same["wall_ns"]), (&line["boot"], &line["wall_ns"]));
            assert!(
                number(same, "stamp_ns") < number(line, "stamp_ns"),
                "the remote sample must have a later stamp"
            );
        }
        assert!(there.iter().filter(|line| here.iter().any(|it| it["seq"] == line["seq"])).count() > 30);
        assert_eq!((gateway.end(TERM).exit_code, hub.end(TERM).exit_code), (Some(0), Some(0)));
        let outcome = listener.end(TERM);
        let hubs: Vec<_> = outcome.of_class("lan").into_iter().map(|line| line["hub"].clone()).collect();
        assert!(hubs.iter().all(|hub| *hub == id), "{outcome}");
        assert_eq!(outcome.of_class("lan_published")[0]["sensors"], json!([remote]));
    });
}

#[test]
fn reused_sensor_number_is_a_separate_sensor() {
    in_a_network("listen_publish::reused_sensor_number_is_a_separate_sensor", || {
        let env = TestEnv::new();
        let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
        let mut program = start_and_publish(&env, &mut sender);
        let mut echo = env.echo(&["robot1.front/zones"]);
        sender.send(Topic::Zones, &zones(Verdict::Clear));
        echo.await_line("zones", is_zones);
        (sender.name, sender.boot) = ("rear".to_owned(), 0xb008);
        // An unknown sender may announce a topic twice, and the listener must accept this.
        let late = sender.announcement(&[Topic::Zones]);
        sender.announce(&[Topic::Zones, Topic::Zones]);
        let line = program.await_line("a sensor", |line| line["kind"] == "published");
        assert_eq!(line["sensor"], "robot1.rear");
        echo.await_line("unknown zones", |line| line["verdict"] == "unknown");
        env.await_info(SENSOR_NAME, |info| info["state"] == "silent");
        let mut rear = env.echo(&["robot1.rear/zones"]);
        sender.send(Topic::Zones, &zones(Verdict::Stop));
        rear.await_line("sample of the second sensor", |line| line["verdict"] == "stop");
        // The first sensor returns with another number, for which the listener has no counters. An announcement of the
        // other sensor that arrives late has no effect.
        let mut front = TestGateway::new(HUB_ID, 7, 1, "front");
        front.boot = 0xb008;
        front.next[usize::from(Topic::Zones.number())] = 40;
        front.announce(&[Topic::Zones]);
        sender.send_to_group(Announce::GROUP, &late);
        front.send(Topic::Zones, &zones(Verdict::Slow));
        let line = echo.await_line("sample of the first sensor", |line| line["verdict"] == "slow");
        assert_eq!(line["topic_seq"], 2, "the gateway must continue its numbers when the hub restarts");
        let outcome = echo.end(INT);
        assert!(outcome.of_class("zones").iter().all(|line| line["verdict"] != "stop"), "{outcome}");
        let (rear, program) = (rear.end(INT), program.end(INT));
        assert_eq!((rear.exit_code, program.exit_code), (Some(0), Some(0)));
        let rows = program.of_class("lan");
        let names: Vec<_> =
            rows.iter().filter(|line| line["topic"] == "zones").map(|line| &line["sensor"]).collect();
        assert_eq!(names, ["#0", "front"], "two sensors used number 0, so its counters have no name");
    });
}

#[test]
fn renumbered_sensors_are_not_mixed_up() {
    in_a_network("listen_publish::renumbered_sensors_are_not_mixed_up", || {
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front", "rear"], &["--seed=63", "--baud=500000"]);
        let mut listener = env.start(&["listen", "--json", "--publish", "--interface=lo"]).ready();
        let mut gateway = env.start(&["gateway", "--json", "--interface=lo"]);
        let id =
            gateway.await_line("line of class gateway", |line| line["class"] == "gateway")["hub"].clone();
        let remote = |name: &str| format!("{}.{name}", id.as_str().unwrap_or_default());
        let (front, rear) = (remote("front"), remote("rear"));
        let hub = env.hub(&[env.link("front"), env.link("rear")]);
        listener.await_line("a sensor", |line| line["kind"] == "published");
        listener.await_line("sample of the other sensor", |line| line["kind"] == "published");
        let topics = [&front, &rear].map(|name| ["status", "scan"].map(|topic| format!("{name}/{topic}")));
        let topics: Vec<_> = topics.iter().flatten().map(String::as_str).collect();
        let mut echo = env.echo(&topics);
        let is_scan =
            |line: &Value, name: &String| line["class"] == "scan" && line["sensor"] == name.as_str();
        let first = echo.await_line("scan of the first run", |line| is_scan(line, &front))["boot"].clone();
        assert_eq!(hub.end(TERM).exit_code, Some(0));
        let hub = env.hub(&[env.link("rear"), env.link("front")]);
        let is_next = |line: &Value, name| is_scan(line, name) && line["boot"] != first;
        let next = echo.await_line("sample of the next run", |line| is_next(line, &front))["boot"].clone();
        echo.await_line("scan of the other sensor in the next run", |line| is_next(line, &rear));
        assert_eq!(hub.end(TERM).exit_code, Some(0));
        // `front` now has the number that `rear` had, and the listener accepts the change at once.
        let _hub = env.hub(&[env.link("front")]);
        echo.await_line("scan of the remaining sensor", |line| is_next(line, &front) && line["boot"] != next);
        env.await_info(&rear, |info| info["state"] == "silent");
        for line in echo.end(INT).of_class("status") {
            let (sensor, port) =
                (line["sensor"].as_str().unwrap_or_default(), line["port"].as_str().unwrap_or_default());
            let name = sensor.rsplit('.').next().unwrap_or_default();
            assert!(port.ends_with(name), "{line}");
        }
        assert_eq!((gateway.end(TERM).exit_code, listener.end(TERM).exit_code), (Some(0), Some(0)));
    });
}

fn publisher_refused(env: &TestEnv) -> String {
    let outcome = env.run(&["listen", "--json", "--publish"]);
    assert_eq!(
        (outcome.exit_code, &outcome.lines()[0]["kind"]),
        (Some(1), &json!("domain_held")),
        "{outcome}"
    );
    outcome.lines()[0]["message"].as_str().unwrap_or_default().to_owned()
}

#[test]
fn samples_without_topic_are_counted_by_cause() {
    in_a_network("listen_publish::samples_without_topic_are_counted_by_cause", || {
        let env = TestEnv::new();
        let mut front = TestGateway::new(HUB_ID, 7, 3, "front");
        let mut program = publisher(&env);
        front.wait_until_published(&mut program, &[Topic::Zones]);
        let mut echo = env.echo(&["robot1.front/zones"]);
        let pid = program.pid();
        let used = std::fs::read_dir(format!("/proc/{pid}/fd")).expect("the program runs").count() as u64;
        let few = Rlimit { current: Some(used + 4), maximum: getrlimit(Resource::Nofile).maximum };
        prlimit(Pid::from_raw(pid as i32), Resource::Nofile, few).expect("the limit can be reduced");
        front.announce(&[Topic::Zones, Topic::Scan]);
        let line = program.await_line("a shortage", |line| line["kind"] == "problem");
        assert!(line["message"].to_string().contains("descriptors"), "{line}");
        front.send(Topic::Scan, &*Box::<Scan>::default());
        front.send(Topic::Marks, &Marks::default());
        let mut rear = TestGateway::new(HUB_ID, 7, 4, "rear");
        rear.announce(&[Topic::Zones]);
        rear.send(Topic::Zones, &zones(Verdict::Clear));
        // The other sensors, for which there is room, continue.
        front.send(Topic::Zones, &zones(Verdict::Slow));
        echo.await_line("zones", |line| is_zones(line) && line["verdict"] == "slow");
        let outcome = program.end(INT);
        let line = &outcome.of_class("lan_published")[0];
        assert_eq!((&line["sensors"], &line["shortage"]), (&json!([SENSOR_NAME]), &json!(2)), "{outcome}");
        assert_eq!(
            (&line["unannounced"], &line["unnamed"]),
            (&json!(1), &json!(front.delivery_proofs)),
            "{outcome}"
        );
    });
}

#[test]
fn publishes_at_most_16_remote_sensors() {
    in_a_network("listen_publish::publishes_at_most_16_remote_sensors", || {
        let env = TestEnv::new();
        let mut program = publisher(&env);
        let mut senders: Vec<_> =
            (0..17).map(|number| TestGateway::new(0xab, 7, number, &format!("s{number}"))).collect();
        // The listener publishes the first 16 sensors when their gateway has delivered for a second. These sensors then
        // deliver for another second, so that they are proven. The sensor with index 16 starts last.
        for (count, wait_ms) in [(16, 1100), (16, 1100), (17, 0)] {
            for sender in &mut senders[..count] {
                sender.announce(&[Topic::Zones]);
                sender.send(Topic::Zones, &zones(Verdict::Clear));
            }
            wait_at_least(Duration::from_millis(wait_ms));
        }
        let line =
            program.await_line("report of a sensor that does not fit", |line| line["kind"] == "problem");
        assert!(line["message"].as_str().is_some_and(|text| text.contains("16 published")), "{line}");
        let listed = env.run(&["list", "--json"]).of_class("topic");
        assert_eq!(listed.len(), 16);
        let outcome = program.end(INT);
        assert_eq!(outcome.of_class("lan_published")[0]["capacity"], 1, "{outcome}");
    });
}
