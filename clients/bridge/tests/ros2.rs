//! The bridge as a ROS 2 node, checked by independent implementations of the wire format (zenoh-ros2-sdk and rosbags
//! from PyPI, see ros2.py). The setup is two simulated sensors, their hub, the bridge as a router, and subscribers of
//! the hub.

use std::fs::{self, DirBuilder, File};
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;

#[path = "../../../tests/testkit/child.rs"]
mod child;

use child::{Child, output, spawn, status, succeeds};

const BRIDGE: &str = env!("CARGO_BIN_EXE_scanhub-bridge");
/// Returns the path of `scanhub` next to the bridge, and builds it if it does not exist.
fn scanhub() -> PathBuf {
    let program = Path::new(BRIDGE).with_file_name("scanhub");
    if !program.is_file() {
        let built = status(Command::new(env!("CARGO")).args(["build", "--quiet", "--package=scanhub"]));
        assert!(built.is_ok_and(|status| status.success()), "cargo cannot build scanhub");
    }
    program
}

/// A temporary directory that contains a domain.
struct TestDirectory(TempDir);

impl TestDirectory {
    fn new() -> TestDirectory {
        let place = TempDir::new().expect("a new directory");
        for part in ["root", "state"] {
            DirBuilder::new().mode(0o700).create(place.path().join(part)).expect("a new directory");
        }
        TestDirectory(place)
    }

    fn path(&self, name: &str) -> String {
        self.0.path().join(name).display().to_string()
    }

    /// Starts a program in the domain. The program ends with the test.
    fn start(&self, program: &Path, arguments: &[&str], out: Stdio) -> RunningProgram {
        let mut command = Command::new(program);
        command.args(arguments).args(["--domain", "ros2", "--root", &self.path("root")]);
        command.env("STATE_DIRECTORY", self.path("state")).env_remove("ROS_DOMAIN_ID");
        command.stdin(Stdio::null()).stdout(out).stderr(Stdio::null());
        RunningProgram(spawn(command).expect("a program"))
    }
}

struct RunningProgram(Child);

impl RunningProgram {
    /// Ends the program with SIGTERM, and returns its exit code.
    fn end(mut self) -> Option<i32> {
        self.0.signal(rustix::process::Signal::TERM).expect("it lives");
        self.0.wait().ok().and_then(|status| status.code())
    }
}

/// Prints why a test is skipped. Fails if the environment requires `need`.
fn skip(need: &str, why: &str) {
    let required = std::env::var("SCANHUB_REQUIRE").unwrap_or_default();
    assert!(!required.split(',').any(|name| name == need), "{need} is required: {why}");
    eprintln!("skipped: {why}");
}

/// Returns a Python interpreter that has the independent implementations, if there is one.
fn python() -> Option<PathBuf> {
    let made = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/venv/bin/python");
    let python = std::env::var_os("SCANHUB_PYTHON").map_or(made, PathBuf::from);
    succeeds(Command::new(&python).args(["-c", "import zenoh_ros2_sdk, rosbags"])).then_some(python)
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a port").port()
}

#[test]
fn ros2_client_discovers_and_decodes_every_topic() {
    let Some(python) = python() else {
        return skip("python-packages", "there is no zenoh-ros2-sdk: .ci/run installs it");
    };
    let scanhub = scanhub();
    let test_domain = TestDirectory::new();
    let (front, rear, port) = (test_domain.path("front"), test_domain.path("rear"), free_port().to_string());
    let simulate = ["simulate", "--port", &front, "--port", &rear, "--baud=500000", "--seed=5"];
    let _simulator = test_domain.start(&scanhub, &simulate, Stdio::null());
    let [front, rear] = [format!("front={front}"), format!("rear={rear}")];
    let run = ["run", "--link", &front, "--link", &rear, "--set=link.front.pose.x=0.3"];
    let _hub = test_domain.start(&scanhub, &run, Stdio::null());
    let echoes = ["front", "rear"].map(|sensor| {
        let path = test_domain.path(&format!("{sensor}.jsonl"));
        let file = File::create(&path).expect("a file");
        (test_domain.start(&scanhub, &["echo", &format!("{sensor}/scan"), "--json"], file.into()), path)
    });
    let listen = format!("--listen=tcp/127.0.0.1:{port}");
    let flags = [&listen, "--ros2", "--domain-id=42", "--topic-prefix=robot1", "--frame=rear=back"];
    let bridge = test_domain.start(Path::new(BRIDGE), &flags, Stdio::null());
    let deadline = Instant::now() + Duration::from_secs(60);
    while !echoes.iter().all(|(_, path)| fs::metadata(path).is_ok_and(|file| file.len() > 0)) {
        assert!(Instant::now() < deadline, "no scans");
        thread::sleep(Duration::from_millis(50));
    }
    let mut checker = Command::new(python);
    checker.args(["-B", concat!(env!("CARGO_MANIFEST_DIR"), "/tests/ros2.py"), &port, "42", "5"]);
    let outcome = output(checker.args(echoes.iter().map(|(_, path)| path))).expect("Python");
    let (stdout, stderr) =
        (String::from_utf8_lossy(&outcome.stdout), String::from_utf8_lossy(&outcome.stderr));
    assert!(outcome.status.success(), "{stdout}{stderr}");
    let report: Value = serde_json::from_str(stdout.lines().last().unwrap_or_default()).expect("an object");
    check_scans(&report, "front");
    check_scans(&report, "rear");
    check_graph(&report);
    check_others(&report);
    assert_eq!(bridge.end(), Some(0));
}

/// Checks that all topics exist as a ROS node would declare them.
fn check_graph(report: &Value) {
    let topics = report["topics"].as_object().expect("topics");
    let words = ["foreground", "marks", "scan", "verdict", "zones"];
    let of = |sensor: &str| words.map(|word| format!("/robot1/{sensor}/{word}")).to_vec();
    let mut expected = [of("front"), of("rear")].concat();
    expected.extend(["/diagnostics".to_owned(), "/tf_static".to_owned()]);
    expected.sort();
    assert_eq!(topics.keys().cloned().collect::<Vec<_>>(), expected);
    for (name, topic) in topics {
        assert_eq!((&topic["hash"], &topic["hash"]), (&topic["rosbags_hash"], &topic["sdk_hash"]), "{name}");
        assert_eq!((topic["node"].as_str(), topic["namespace"].as_str()), (Some("scanhub"), Some("/")));
        let qos = ["reliability", "durability"].map(|key| topic[key].as_str().unwrap_or_default());
        let expected = match name.as_str() {
            "/diagnostics" => (["RELIABLE", "VOLATILE"], 10),
            "/tf_static" => (["RELIABLE", "TRANSIENT_LOCAL"], 1),
            _ => (["BEST_EFFORT", "VOLATILE"], 5),
        };
        assert_eq!((qos, topic["depth"].as_i64()), (expected.0, Some(expected.1)), "{name}");
    }
}

/// Checks that the decoded scans equal the measured scans, and that nearly all scans arrived. With best effort, a busy
/// machine drops late scans.
fn check_scans(report: &Value, sensor: &str) {
    let scans = &report["scans"][format!("/robot1/{sensor}/scan")];
    let number = |key: &str| scans[key].as_u64().unwrap_or_default();
    assert!(number("decoded") > 50, "{sensor}: {scans}");
    assert_eq!(number("matched"), number("decoded"), "{sensor}: {scans}");
    assert_eq!(scans["ranges_equal"], true, "{sensor}: {scans}");
    assert!(scans["angles"].as_f64().is_some_and(|apart| apart < 1e-6), "{sensor}: {scans}");
    let frame = if sensor == "rear" { "back" } else { "front" };
    assert_eq!((&scans["frames"], &scans["beams"]), (&[frame].as_slice().into(), &[361].as_slice().into()));
    // Adjacent beams of a half-degree scan come from two revolutions, so there is no time increment.
    assert_eq!(scans["time_increment"], Value::from([0.0].as_slice()), "{sensor}");
    let lost = number("published") - number("matched");
    assert!(100 * lost <= number("published") + 100, "{sensor}: {lost} lost: {scans}");
}

/// Checks that every other topic had messages, and checks the contents of the messages.
fn check_others(report: &Value) {
    for (name, count) in report["received"].as_object().expect("counts") {
        assert!(count.as_u64() > Some(0), "{name}: {report:#}");
    }
    let attachments = &report["attachments"];
    assert_eq!((&attachments["ascend"], &attachments["gids"]), (&true.into(), &1.into()), "{attachments}");
    assert_eq!(attachments["length"], Value::from([33].as_slice()));
    let frames = serde_json::json!([["base_link", "front"], ["base_link", "back"]]);
    let mut got = report["frames"].as_array().cloned().unwrap_or_default();
    got.sort_by_key(|pair| pair[1] != "front");
    assert_eq!(Value::from(got), frames);
    for (name, words) in [("front", "streaming"), ("rear", "streaming"), ("hub", "running")] {
        let line = serde_json::json!([format!("scanhub: {name}"), 0, words]);
        assert!(report["diagnostics"].as_array().is_some_and(|all| all.contains(&line)), "{report:#}");
    }
}

/// Runs the bridge commands of the page on a port of this machine. The first bridge listens, and the others connect to
/// it.
#[test]
fn examples_of_the_page_run() {
    let page =
        fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/ros2.md")).expect("the page");
    let lines: Vec<_> = page.lines().filter_map(|line| line.strip_prefix("scanhub bridge ")).collect();
    assert_eq!(lines.len(), 2, "{lines:?}");
    let (port, mut running) = (free_port().to_string(), Vec::new());
    for line in lines {
        let test_domain = TestDirectory::new();
        let line = line.replace("0.0.0.0", "127.0.0.1").replace("7447", &port);
        let words: Vec<&str> = line.split_whitespace().collect();
        let mut program = test_domain.start(Path::new(BRIDGE), &words, Stdio::piped());
        let mut first = String::new();
        let out = program.0.stdout.take().expect("a pipe");
        BufReader::new(out).read_line(&mut first).expect("a line");
        assert!(first.starts_with("bridge"), "{line}: {first:?}");
        running.push((program, test_domain));
    }
    for (program, _place) in running {
        assert_eq!(program.end(), Some(0));
    }
}

/// Runs the program with `flags` and `ROS_DOMAIN_ID` set to `domain`. Returns its exit code and stderr.
fn run_bridge(domain: &str, flags: &[&str]) -> (Option<i32>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub-bridge"));
    // No program listens on this port.
    command.args(["--connect=tcp/127.0.0.1:1", "--check"]).args(flags).env("ROS_DOMAIN_ID", domain);
    let output = output(command).expect("a program");
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn ros_settings_are_checked_only_with_ros2() {
    for domain in ["42", "abc"] {
        let (code, errors) = run_bridge(domain, &[]);
        assert!(code != Some(2) && !errors.contains("--ros2"), "{domain:?}: {code:?} {errors}");
    }
    for (domain, flags, words) in [
        ("abc", &["--ros2"][..], "ROS_DOMAIN_ID=abc"),
        ("233", &["--ros2"], "a number from 0 to 232"),
        ("", &["--ros2", "--frame=front=a", "--frame=front=b"], "front has two frames"),
        ("", &["--ros2", "--frame=front=base_link"], "the robot itself"),
        ("", &["--ros2", "--domain-id=233"], "0..=232"),
    ] {
        let (code, errors) = run_bridge(domain, flags);
        assert!(code == Some(2) && errors.contains(words), "{flags:?}: {code:?} {errors}");
    }
}
