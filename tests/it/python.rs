//! Tests of the Python package next to a hub. Python scripts check properties that are visible only in Python, and the
//! tests compare the samples that the scripts print with those that `echo` prints. If the package was not built from
//! these sources, the tests are skipped.

mod read;

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::testkit::{
    INT, KILL, Outcome, Program, TERM, TestEnv, TestGateway, client_python, in_a_network, is_class, number,
    output, python, python_for, skip, wait_until,
};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Header, Status, Topic, Verdict, Zones};
use scanhub_shm::{HubLock, Node, Payload, PortFactory, WakeSender};
use serde_json::{Value, json};

/// Returns the command that runs the script `name` of the package's tests, or `None` if no suitable Python is
/// installed.
fn check(name: &str) -> Option<Command> {
    let mut command = client_python()?;
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/python/tests");
    command.arg(scripts.join(name).with_extension("py")).env_remove("SCANHUB_DOMAIN");
    Some(command)
}

/// Returns the command of [`check`], with the domain and the root of `env` as first arguments.
pub(crate) fn check_on(env: &TestEnv, name: &str) -> Option<Command> {
    let mut command = check(name)?;
    let domain = env.domain();
    let root = domain.root().parent().expect("a parent directory");
    command.arg(domain.name()).arg(root);
    Some(command)
}

fn assert_success(command: Command) {
    let outcome = Program::start(command).wait();
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    print!("{}", String::from_utf8_lossy(&outcome.stdout));
}

fn streaming(env: &TestEnv) -> (Program, Program) {
    let simulator = env.simulator(&["front"], &["--seed=61", "--baud=500000"]);
    let hub = env.hub(&[&env.link("front"), "--set=background.scans=20"]);
    (simulator, hub)
}

#[test]
fn python_reads_golden_samples() {
    let Some(mut command) = check("samples") else { return };
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors/v2"));
    assert_success(command);
}

#[test]
fn arrays_are_views_of_shared_memory() {
    let env = TestEnv::new();
    let Some(command) = check_on(&env, "views") else { return };
    let _running = streaming(&env);
    assert_success(command);
}

#[test]
fn python_tasks_run_in_uvloop() {
    let env = TestEnv::new();
    let Some(mut command) = check_on(&env, "views") else { return };
    if python_for("uvloop", "uvloop").is_none() {
        return;
    }
    let _running = streaming(&env);
    command.arg("uvloop");
    assert_success(command);
}

#[test]
fn refuses_impossible_subscriptions() {
    let env = TestEnv::new();
    let Some(command) = check_on(&env, "refusals") else { return };
    assert_success(command);
}

/// Takes the lock of a hub and creates the doorbell of `front`. The caller creates the topics.
fn hub_without_sensors(env: &TestEnv) -> (HubLock, Node, WakeSender) {
    let lock = HubLock::acquire(env.domain().root()).expect("no hub runs");
    let node = scanhub_shm::hub_node(&env.domain()).expect("a node");
    let waker = WakeSender::new(&node, "front").expect("shared memory");
    (lock, node, waker)
}

#[test]
fn python_reports_a_layout_mismatch() {
    let env = TestEnv::new();
    let Some(command) = check_on(&env, "mismatch") else { return };
    let (lock, node, _waker) = hub_without_sensors(&env);
    let service = Topic::Scan.service("front").as_str().try_into().expect("a name");
    let _scan = node.service_builder(&service).publish_subscribe::<u64>().create().expect("a service");
    lock.report_ready().expect("the lock is open");
    assert_success(command);
}

#[test]
fn raising_notice_handler_loses_no_sample() {
    let env = TestEnv::new();
    let Some(command) = check_on(&env, "notices") else { return };
    let (lock, node, _waker) = hub_without_sensors(&env);
    let limits = TopicLimits::default();
    let service = Status::create(&node, "front", &limits).expect("a service");
    let publisher = Status::publisher(&service, &limits).expect("a publisher");
    lock.report_ready().expect("the lock is open");
    let (stdin, mut lines) = std::io::pipe().expect("a pipe");
    let mut script = Program::start_with(command, stdin);
    wait_until("the subscriber", || service.dynamic_config().number_of_subscribers() == 1);
    lines.write_all(b"\n").expect("an open pipe");
    script.await_line("a waiting subscriber", is_class("waits"));
    // Publish a sample without ringing the doorbell, so that it does not wake the subscriber. The subscriber finds the
    // sample only when it checks whether the hub has ended.
    let mut sample = publisher.loan().expect("a loan");
    *sample.user_header_mut() = Header { topic_seq: 7, ..Header::default() };
    *sample.payload_mut() = Status::default();
    sample.send().expect("a connection");
    drop(lock);
    lines.write_all(b"\n").expect("an open pipe");
    let outcome = script.wait();
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
}

#[test]
fn python_publishes_and_releases_own_names() {
    let env = TestEnv::new();
    let Some(command) = check_on(&env, "own_names") else { return };
    assert_success(command);
    assert_eq!(env.leftover_files(), Vec::<std::path::PathBuf>::new());
}

/// Creates the conditions of a user without Rust and without a network.
#[test]
fn wheel_installs_without_compiler_and_network() {
    let Some(python) = client_python() else { return };
    let wheels = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/python/wheels");
    let wheels = std::fs::read_dir(wheels).into_iter().flatten().flatten().map(|entry| entry.path());
    let wheels: Vec<_> = wheels.filter(|path| path.extension().is_some_and(|it| it == "whl")).collect();
    if wheels.len() != 2 {
        skip(
            "python-packages",
            "there are no wheels of scanhub-client and numpy: clients/python/build.sh makes them",
        );
        return;
    }
    let env = TestEnv::new();
    let run = |mut command: Command| {
        let output =
            output(command.env("PATH", "/usr/bin:/bin").env_remove("PYTHONPATH")).expect("a started program");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    let place = env.path("empty");
    let mut make = Command::new(python.get_program());
    make.args(["-m", "venv"]).arg(&place);
    run(make);
    let empty = place.join("bin/python");
    let mut install = Command::new(&empty);
    install.args(["-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]).args(&wheels);
    run(install);
    let mut scripts = Command::new(&empty);
    scripts.args(["-c", "import scanhub, scanhub_lan; scanhub_lan.Guard"]);
    run(scripts);
    let size = |path: &PathBuf| std::fs::metadata(path).expect("a wheel").len();
    let own = wheels.iter().find(|path| path.to_string_lossy().contains("scanhub_client"));
    assert!(own.map(size).is_some_and(|bytes| bytes < 8_000_000), "{wheels:?}");
    let _running = streaming(&env);
    let readme = include_str!("../../clients/python/README.md");
    let example = readme.split("```python\n").nth(1).and_then(|text| text.split("```").next());
    let mut command = Command::new(empty);
    command.args(["-u", "-c", example.expect("an example")]).env("SCANHUB_DOMAIN", env.domain().name());
    command
        .env("RUNTIME_DIRECTORY", env.domain().root().parent().expect("a parent directory"))
        .env_remove("XDG_RUNTIME_DIR");
    command.env("PATH", "/usr/bin:/bin");
    let mut example = Program::start(command);
    let line = example.next_text();
    assert!(line.ends_with(" m"), "{line}");
}

/// The stubs declare all names and types of the module, and the examples use them correctly.
#[test]
fn python_types_match_the_stubs() {
    if python("mypy").is_none() || client_python().is_none() {
        return;
    }
    let env = TestEnv::new();
    let package = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/python");
    let [config, examples] =
        ["pyproject.toml", "examples"].map(|name| package.join(name).display().to_string());
    let strict = ["mypy", "--strict", "--config-file", &config];
    for words in [
        &[&strict[..], &[&examples]].concat()[..],
        &["mypy", "--strict", "-p", "scanhub"],
        &["mypy.stubtest", "scanhub"],
    ] {
        let mut command = client_python().expect("the same Python as before");
        let output =
            output(command.arg("-m").args(words).current_dir(env.path(""))).expect("a started program");
        assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stdout));
    }
}

#[test]
fn python_controls_background_and_streaming() {
    let env = TestEnv::new();
    let Some(command) = check_on(&env, "models") else { return };
    let _running = streaming(&env);
    assert_success(command);
}

#[test]
fn samples_equal_those_of_echo() {
    const TOPICS: [&str; 9] =
        ["telegram", "scan", "marks", "zones", "foreground", "background", "status", "lines", "motion"];
    let env = TestEnv::new();
    let topics = TOPICS.map(|topic| format!("front/{topic}"));
    let Some(mut command) = check_on(&env, "follow") else { return };
    let (_simulator, hub) = streaming(&env);
    let mut subscriber = Program::start({
        command.args(&topics);
        command
    });
    subscriber.await_line("a scan", is_class("scan"));
    let mut echo = env.start(&[&["echo", "--json"], &topics.each_ref().map(String::as_str)[..]].concat());
    for program in [&mut echo, &mut subscriber] {
        program.await_lines(2, "a background", is_class("background"));
        program.await_lines(40, "a scan", is_class("scan"));
        program.await_lines(2, "a status", is_class("status"));
    }
    let (echo, subscriber) = (echo.end(INT), ended_by_interrupt(subscriber));
    drop(hub);
    for topic in TOPICS {
        let printed = echo.of_class(topic);
        let same = subscriber.of_class(topic).iter().filter(|sample| is_printed_by(&printed, sample)).count();
        let expected = if ["background", "status"].contains(&topic) { 1 } else { 20 };
        assert!(same >= expected, "{topic}: {same} of {} are equal to the lines of echo", printed.len());
    }
}

/// Returns whether `echo` also printed `sample`. Panics if `echo` printed this sample with other values. Lines of a
/// status or a background have no `topic_seq`, so such a line is the same sample only if all keys match.
fn is_printed_by(echo: &[Value], sample: &Value) -> bool {
    let is_numbered = |line: &Value| line.get("topic_seq").is_some();
    let same = |line: &&Value| line["topic_seq"] == sample["topic_seq"] && line["boot"] == sample["boot"];
    if !echo.iter().any(is_numbered) {
        return echo.iter().any(|line| different_keys(line, sample).is_empty());
    }
    let Some(line) = echo.iter().find(same) else { return false };
    // `echo` and the script each decide for themselves whether a verdict is stale. If only one of them does, the keys
    // of the verdict differ, because a stale verdict has no values.
    let of_verdict = ["verdict", "nearest_mm", "nearest_beam", "zones", "invalid_beams", "stale"];
    let is_stale = [line, sample].iter().any(|line| line["stale"] == true);
    let mut differing = different_keys(line, sample);
    differing.retain(|key| !is_stale || !of_verdict.contains(&key.as_str()));
    assert!(differing.is_empty(), "{differing:?}: {line} {sample}");
    true
}

/// Returns the keys of `line` that are missing or different in `sample`.
fn different_keys<'a>(line: &'a Value, sample: &Value) -> Vec<&'a String> {
    let keys = line.as_object().expect("an object").keys();
    // In a status, `echo` derives the key `marks` from the mode. The package has the mode itself instead.
    keys.filter(|key| *key != "marks" || line["class"] == "marks")
        .filter(|key| line[*key] != sample[*key])
        .collect()
}

#[test]
fn subscription_receives_several_sensors() {
    let env = TestEnv::new();
    let Some(mut command) = check_on(&env, "follow") else { return };
    command.args(["front/scan", "rear/scan", "rear/status"]);
    let _simulator = env.simulator(&["front", "rear"], &["--seed=63", "--baud=500000"]);
    let _hub = env.hub(&[env.link("front"), env.link("rear")]);
    let mut subscriber = Program::start(command);
    for (sensor, topic, count) in [("front", "scan", 40), ("rear", "scan", 40), ("rear", "status", 2)] {
        subscriber.await_lines(count, sensor, |line| line["sensor"] == sensor && line["class"] == topic);
    }
    ended_by_interrupt(subscriber);
}

#[test]
fn python_subscription_survives_hub_restarts() {
    let env = TestEnv::new();
    let Some(mut command) = check_on(&env, "follow") else { return };
    command.args(["front/scan", "front/telegram", "front/zones"]);
    let _simulator = env.simulator(&["front"], &["--seed=62", "--baud=500000"]);
    // The subscriber starts before the hub.
    let mut subscriber = Program::start(command);
    let mut hub = env.hub(&[env.link("front")]);
    subscriber.await_line("hub_back", |line| line["kind"] == "hub_back");
    for how in [KILL, TERM, KILL] {
        subscriber.await_lines(20, "a scan", is_class("scan"));
        let code = hub.end(how).exit_code;
        assert_eq!(code, (how == TERM).then_some(0));
        subscriber.await_line("hub_gone", |line| line["kind"] == "hub_gone");
        hub = env.hub(&[env.link("front")]);
        subscriber.await_line("hub_back", |line| line["kind"] == "hub_back");
    }
    subscriber.await_lines(20, "a scan", is_class("scan"));
    let outcome = ended_by_interrupt(subscriber);
    let stale: Vec<Value> =
        outcome.of_class("zones").into_iter().filter(|line| line["stale"] == true).collect();
    assert!(stale.iter().all(|line| line["verdict"] == "unknown" && line["zones"] == json!([])));
    assert!(stale.len() >= 2, "killed hubs leave a silence: {stale:?}");
    for topic in ["scan", "telegram"] {
        let mut runs = BTreeMap::<String, Vec<Value>>::new();
        for line in outcome.of_class(topic) {
            let boot = line["boot"].as_str().expect("a boot ID").to_owned();
            let lines_of_run = runs.entry(boot).or_default();
            let python = &line["python"];
            // A subscriber that waits for a hub receives the hub's samples from the first one on.
            let next = lines_of_run.last().map_or(0, |last| number(last, "topic_seq") + 1);
            let is_first_hub = outcome.of_class(topic)[0]["boot"] == line["boot"];
            assert_eq!(python["restarted"], lines_of_run.is_empty() && !is_first_hub, "{line}");
            if !lines_of_run.is_empty() || !is_first_hub {
                assert_eq!(number(&line, "topic_seq"), next + number(python, "missed"), "{line}");
            }
            lines_of_run.push(line);
        }
        assert_eq!(runs.len(), 4, "{topic}");
    }
}

/// Without data, the combined verdict is never clear. The test first switches off one sensor and then kills the hub.
#[test]
fn python_robot_has_the_verdict_of_its_worst_sensor() {
    let env = TestEnv::new();
    let Some(mut named) = check_on(&env, "robot") else { return };
    named.args(["front", "rear"]);
    let Some(all) = check_on(&env, "robot") else { return };
    let mut subscribers = [named, all].map(Program::start);
    for subscriber in &mut subscribers {
        let first = subscriber.await_line("there is no hub", is_class("robot"));
        assert_eq!((&first["verdict"], &first["nearest_mm"]), (&"unknown".into(), &Value::Null), "{first}");
    }
    let _front = env.simulator(&["front"], &["--seed=64", "--baud=500000"]);
    let rear =
        env.start(&["simulate", "--json", "--baud=500000", &format!("--port={}", env.path_argument("rear"))]);
    let rear = rear.ready();
    // The verdict is clear, because the simulated room has no object within these radii.
    let hub = env.hub(&[&env.link("front"), &env.link("rear"), "--set=zones.radii=[0.02,0.01]"]);
    let are = |verdict: &'static str, front: &'static str, rear: &'static str| {
        move |line: &Value| {
            line["verdict"] == verdict && line["sensors"] == json!({ "front": front, "rear": rear })
        }
    };
    for subscriber in &mut subscribers {
        let line = subscriber.await_line("clear verdicts", are("clear", "clear", "clear"));
        // Both sensors have the verdict `clear`, so either of them may be reported as the worst one.
        let is_sensor = |key: &str| ["front", "rear"].contains(&line[key].as_str().unwrap_or_default());
        assert!(is_sensor("worst") && is_sensor("nearest_sensor") && line["nearest_mm"].is_u64(), "{line}");
        subscriber
            .await_line("a reply", |line| line["class"] == "now" && are("clear", "clear", "clear")(line));
    }
    env.kill_port_simulator(rear, "rear");
    for subscriber in &mut subscribers {
        let line =
            subscriber.await_line("an unknown verdict of the rear", are("unknown", "clear", "unknown"));
        assert_eq!(line["worst"], "rear", "{line}");
    }
    assert_eq!(hub.end(KILL).exit_code, None);
    for subscriber in &mut subscribers {
        subscriber
            .await_line("unknown verdicts after the end of the hub", are("unknown", "unknown", "unknown"));
    }
    for subscriber in subscribers {
        ended_by_interrupt(subscriber);
    }
}

#[test]
fn robot_without_a_hub_uses_remote_sensors() {
    in_a_network("python::robot_without_a_hub_uses_remote_sensors", || {
        let env = TestEnv::new();
        let Some(command) = check_on(&env, "robot") else { return };
        let mut listener =
            env.start(&["listen", "--json", "--publish", "--name=robot1=0000000000000001"]).ready();
        let mut front = TestGateway::new(1, 7, 0, "front");
        front.wait_until_published(&mut listener, &[Topic::Zones]);
        TestGateway::new(1, 7, 1, "mapper").wait_until_published(&mut listener, &[Topic::Scan]);
        let mut robot = Program::start(command);
        let are = |verdict: &'static str, sensor: &'static str| {
            move |line: &Value| line["verdict"] == verdict && line["sensors"] == json!({ sensor: verdict })
        };
        robot.await_line("an unknown verdict", are("unknown", "robot1.front"));
        // Send the verdict again and again, because a client that reads a verdict too late reports `unknown` instead.
        wait_until("clear", || {
            front.send(Topic::Zones, &Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() });
            robot.prints(are("clear", "robot1.front"))
        });
        wait_until("silence", || {
            let last = robot.last_printed(is_class("robot"));
            last.is_some_and(|line| are("unknown", "robot1.front")(&line))
        });
        // A second subscriber queries the current verdict only on request, and must find the remote sensor, too.
        let mut command = check_on(&env, "robot").expect("the same Python as before");
        command.arg("--asked");
        let (stdin, mut ask) = std::io::pipe().expect("a pipe");
        let mut busy = Program::start_with(command, stdin);
        let mut query_sensors = |busy: &mut Program| {
            front.send(Topic::Zones, &Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() });
            ask.write_all(b"\n").expect("an open pipe");
            busy.await_line("the current verdict", is_class("now"))["sensors"].clone()
        };
        wait_until("the remote sensor", || query_sensors(&mut busy).get("robot1.front").is_some());
        // While a hub runs, `robot` combines the sensors of the hub. When the hub exits, remote sensors do not replace
        // these sensors.
        let _simulator = env.simulator(&["front"], &["--seed=65", "--baud=500000"]);
        let hub = env.hub(&[&env.link("front"), "--set=zones.radii=[0.02,0.01]"]);
        wait_until("only the sensors of the hub", || query_sensors(&mut busy) == json!({"front": "clear"}));
        robot.await_line("no remote sensor", |line| {
            line["sensors"] == json!({}) && line["verdict"] == "unknown"
        });
        robot.await_line("only the sensors of the hub", are("clear", "front"));
        assert_eq!(hub.end(KILL).exit_code, None);
        robot.await_line("unknown verdicts after the end of the hub", are("unknown", "front"));
        let mut named = env.start(&["echo", "--json", "robot1.front/zones"]);
        // Send the verdict again and again, because a client that reads a verdict too late reports `unknown` instead.
        wait_until("a verdict of the named remote sensor", || {
            front.send(Topic::Zones, &Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() });
            named.prints(|line| line["verdict"] == "clear")
        });
        let outcome = ended_by_interrupt(robot);
        let last = outcome.of_class("robot").pop().expect("a line");
        assert!(are("unknown", "front")(&last), "{outcome}");
        assert_eq!(listener.end(TERM).exit_code, Some(0));
    });
}

/// Interrupts a script and asserts that the script ends normally, as after Ctrl-C.
fn ended_by_interrupt(subscriber: Program) -> Outcome {
    let outcome = subscriber.end(INT);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert_eq!(outcome.of_class("end").len(), 1, "{outcome}");
    outcome
}
