//! Combined verdict of a robot with and without early warnings. Programs in Rust, Python and C and the command `leds`
//! use the same warnings, and they use them only on request.

use std::process::Command;

use crate::client_c::installed::{InstalledLibrary, source};
use crate::early::POST_WORLD;
use crate::python::check_on;
use crate::testkit::{INT, Program, TERM, TestEnv, wait_until};
use scanhub_client::{Publication, PublishSession, RobotSubscriber, SensorPublisher};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Early, Header, Topic, Verdict, WakeEvent, Zones};
use serde_json::Value;

#[test]
fn python_robot_subscribes_to_warnings_until_exit() {
    let env = TestEnv::new();
    let Some(mut command) = check_on(&env, "robot") else { return };
    command.args(["--early", "front"]);
    let flags = ["--seed=28", "--baud=500000", &format!("--world={}", env.file("post.toml", POST_WORLD))];
    let (hub, simulator) = (env.hub(&[env.link("front")]), env.simulator(&["front"], &flags));
    let mut robot = Program::start(command);
    robot.await_line("the post", |line| line["verdict"] == "stop");
    wait_until("the program is attached to the warnings", || env.subscribers("front/early") == 1);
    robot.await_line("the post, after that", |line| line["verdict"] == "stop");
    assert_eq!(robot.end(INT).exit_code, Some(0));
    wait_until("no program is attached to the warnings", || env.subscribers("front/early") == 0);
    assert_eq!((hub.end(TERM).exit_code, simulator.end(TERM).exit_code), (Some(0), Some(0)));
}

/// Sensor whose zones and warnings the test publishes itself.
struct SimulatedSensor {
    zones: Publication<Zones>,
    early: Publication<Early>,
    sensor: SensorPublisher,
}

impl SimulatedSensor {
    /// Creates the sensor `robot1.front`, the only one in the domain of `env`.
    fn new(env: &TestEnv) -> SimulatedSensor {
        let topics = [Topic::Zones, Topic::Early];
        let session = PublishSession::open(&env.domain(), &topics, TopicLimits::default())
            .expect("the name is not in use");
        let sensor = session.sensor("robot1.front").expect("a name");
        let (zones, early) = (
            sensor.topic().expect("the topic can be created"),
            sensor.topic().expect("the topic can be created"),
        );
        SimulatedSensor { zones, early, sensor }
    }

    /// Returns a header for results of the scan with the number `seq`. The period in the header is so long that the
    /// zones remain valid during the test.
    fn header_of_scan(&self, seq: u64) -> Header {
        Header { seq, period_us: 1_000_000_000, ..self.zones.header() }
    }

    fn publish_zones(&mut self, seq: u64, verdict: Verdict) {
        let header = self.header_of_scan(seq);
        let zones = Zones { verdict: verdict as u8, ..Zones::unknown() };
        self.zones.send_with(&header, |sample| *sample = zones).expect("a sample can be sent");
        self.sensor.wake(WakeEvent::Telegram).expect("subscribers can be woken");
    }

    fn publish_warning(&mut self, seq: u64, flags: u8) {
        let header = self.header_of_scan(seq);
        let stop = Early { verdict: 2, flags, beam: 40, distance_mm: 500, bytes_seen: 240, beams_seen: 116 };
        self.early.send_with(&header, |sample| *sample = stop).expect("a sample can be sent");
        self.sensor.wake(WakeEvent::Early).expect("subscribers can be woken");
    }
}

/// Starts programs that print the verdict of `robot1.front`. Each program is started twice, with and without early
/// warnings. The flag in the result is true for a program that uses warnings.
fn start_robots(env: &TestEnv) -> Vec<(bool, Program)> {
    let mut commands = Vec::new();
    for early in [false, true] {
        if let Some(mut command) = check_on(env, "robot") {
            command.args(early.then_some("--early")).arg("robot1.front");
            commands.push((early, command));
        }
        let Some(installed) = InstalledLibrary::installed() else { continue };
        for wait_method in ["doorbell", "poll"] {
            let mut command = Command::new(installed.compile(env, &source("robot.c"), &[]));
            command.args([wait_method, "robot1.front"]).args(early.then_some("early"));
            command.env("SCANHUB_DOMAIN", env.domain().name()).env_remove("XDG_RUNTIME_DIR");
            command.env(
                "RUNTIME_DIRECTORY",
                env.domain().root().parent().expect("the domain has a parent directory"),
            );
            commands.push((early, command));
        }
    }
    commands.into_iter().map(|(early, command)| (early, Program::start(command))).collect()
}

/// Returns the verdict in a line. Programs in C print the number of the verdict instead of its name.
fn verdict(line: &Value) -> Option<Verdict> {
    let is_reported =
        |verdict: &Verdict| line["verdict"] == verdict.name() || line["verdict"] == *verdict as u64;
    Verdict::ALL.into_iter().find(is_reported)
}

#[test]
fn robots_handle_warnings_only_if_requested() {
    let env = TestEnv::new();
    let mut sensor = SimulatedSensor::new(&env);
    let mut robots = start_robots(&env);
    let builder = || RobotSubscriber::builder(&["robot1.front"]).in_domain(&env.domain());
    let mut in_rust = [(false, builder()), (true, builder().early())]
        .map(|(is_early, builder)| (is_early, builder.open().expect("a name")));
    let all = robots.len() as u64 + 2;
    wait_until("all programs are attached to zones, and some to warnings", || {
        for (_, robot) in &mut in_rust {
            robot.now().expect("a domain");
        }
        let subscribers = |topic: &str| env.subscribers(&format!("robot1.front/{topic}"));
        (subscribers("zones"), subscribers("early")) == (all, all / 2)
    });
    let mut await_verdict = |warned: bool, expected: Verdict| {
        for (_, robot) in in_rust.iter_mut().filter(|(early, _)| *early || !warned) {
            wait_until("the verdict in Rust", || robot.now().expect("a domain").verdict() == expected);
        }
        for (_, robot) in robots.iter_mut().filter(|(early, _)| *early || !warned) {
            let line = robot.await_line(expected.name(), |line| verdict(line) == Some(expected));
            assert_eq!(line["nearest_mm"].as_u64(), (expected == Verdict::Stop).then_some(500), "{line}");
        }
    };
    sensor.publish_zones(7, Verdict::Clear);
    await_verdict(false, Verdict::Clear);
    sensor.publish_warning(8, 0);
    await_verdict(true, Verdict::Stop);
    sensor.publish_warning(8, Early::WITHDRAWN);
    await_verdict(true, Verdict::Clear);
    sensor.publish_warning(8, 0);
    await_verdict(true, Verdict::Stop);
    sensor.publish_zones(8, Verdict::Clear);
    await_verdict(false, Verdict::Clear);
    sensor.publish_zones(9, Verdict::Slow);
    await_verdict(false, Verdict::Slow);
    assert_eq!(in_rust[0].1.now().expect("a domain").nearest(), None);
    for (early, robot) in robots {
        let outcome = robot.end(INT);
        let mut reported: Vec<Verdict> = outcome.of_class("robot").iter().filter_map(verdict).collect();
        reported.retain(|verdict| *verdict != Verdict::Unknown);
        reported.dedup();
        let (clear, stop, slow) = (Verdict::Clear, Verdict::Stop, Verdict::Slow);
        let expected = if early { vec![clear, stop, clear, stop, clear, slow] } else { vec![clear, slow] };
        assert_eq!(reported, expected, "{outcome}");
    }
}

#[test]
fn leds_show_warnings_and_withdrawals_if_requested() {
    for follows_early in [false, true] {
        let env = TestEnv::new();
        let mut sensor = SimulatedSensor::new(&env);
        let early: &[&str] = if follows_early { &["--early"] } else { &[] };
        let mut leds = env.start(&[&["leds", "robot1.front", "--hold=0s", "--json"], early].concat());
        let topics = ["robot1.front/zones", "robot1.front/early"];
        wait_until("the program is attached", || {
            topics.map(|topic| env.subscribers(topic)) == [1, follows_early.into()]
        });
        let mut shows = |is_of_warning: bool, expected: Verdict| {
            if follows_early || !is_of_warning {
                let is_it = |line: &Value| line["class"] == "leds" && verdict(line) == Some(expected);
                leds.await_line(expected.name(), is_it);
            }
        };
        sensor.publish_zones(7, Verdict::Clear);
        shows(false, Verdict::Clear);
        sensor.publish_warning(8, 0);
        shows(true, Verdict::Stop);
        sensor.publish_warning(8, Early::WITHDRAWN);
        shows(true, Verdict::Clear);
        sensor.publish_warning(9, 0);
        shows(true, Verdict::Stop);
        sensor.publish_zones(9, Verdict::Clear);
        shows(true, Verdict::Clear);
        sensor.publish_zones(10, Verdict::Slow);
        shows(false, Verdict::Slow);
        let outcome = leds.end(INT);
        let lights = outcome.of_class("leds");
        let mut shown: Vec<Verdict> = lights.iter().filter_map(verdict).collect();
        shown.retain(|verdict| *verdict != Verdict::Unknown);
        shown.dedup();
        let (clear, stop, slow) = (Verdict::Clear, Verdict::Stop, Verdict::Slow);
        let expected =
            if follows_early { vec![clear, stop, clear, stop, clear, slow] } else { vec![clear, slow] };
        assert_eq!(shown, expected, "{outcome}");
    }
}
