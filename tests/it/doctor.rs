//! `scanhub doctor` on working setups: it prints a line for each check and a remedy for each problem, and changes
//! nothing.

use std::path::Path;

use crate::testkit::{KILL, Outcome, Program, REAL_REPLY_TIME, TERM, TestEnv, wait_until};
use rustix::fs::inotify::{self, CreateFlags, WatchFlags};
use rustix::io::Errno;
use rustix::process::Signal;
use serde_json::Value;

/// Returns the state and the text of the check `name`. The text is the finding followed by the remedy. `port` is the
/// port that the check must belong to, or `None` for a check without a port.
fn state<'a>(findings: &'a [Value], name: &str, port: Option<&str>) -> (&'a str, String) {
    let found = findings.iter().find(|line| line["name"] == name && line["port"].as_str() == port);
    let found = found.unwrap_or_else(|| panic!("no {name} of {port:?}: {findings:#?}"));
    let text = |key: &str| found[key].as_str().unwrap_or_default();
    let needs_remedy = matches!(text("state"), "warning" | "failed");
    assert_eq!(text("remedy").is_empty(), !needs_remedy, "{found}");
    (text("state"), format!("{} {}", text("finding"), text("remedy")))
}

/// Runs `doctor`, which must exit with `code`. All lines that it prints must have class `check`, except for an error at
/// the end.
fn doctor(env: &TestEnv, arguments: &[&str], code: i32) -> (Vec<Value>, Outcome) {
    checks(run(env, arguments), code)
}

/// Runs [`doctor`] for the scanner at `port`. On a busy machine, a simulated scanner may reply too late. In this case,
/// `doctor` is run again.
fn doctor_of_port(port: &str, env: &TestEnv, arguments: &[&str], code: i32) -> (Vec<Value>, Outcome) {
    let is_late =
        |line: &Value| line["name"] == "sensor" && line["port"] == port && line["state"] == "failed";
    let mut outcome = run(env, arguments);
    wait_until("the scanner replies", || {
        let has_replied = !outcome.of_class("check").iter().any(is_late);
        if !has_replied {
            outcome = run(env, arguments);
        }
        has_replied
    });
    checks(outcome, code)
}

fn run(env: &TestEnv, arguments: &[&str]) -> Outcome {
    env.run(&[&["doctor", "--json", "--no-system-config"], arguments].concat())
}

fn checks(outcome: Outcome, code: i32) -> (Vec<Value>, Outcome) {
    assert_eq!(outcome.exit_code, Some(code), "{outcome}");
    let findings = outcome.of_class("check");
    let errors = outcome.of_class("error");
    assert_eq!(findings.len() + errors.len(), outcome.lines().len());
    assert_eq!(errors.len(), usize::from(code != 0), "{outcome}");
    (findings, outcome)
}

#[test]
fn page_has_a_line_for_each_check() {
    let page = include_str!("../../docs/doctor.md");
    let lines = page.lines().filter_map(|line| line.strip_prefix("| `")?.split('`').next());
    assert_eq!(lines.collect::<Vec<_>>(), scanhub_tools::doctor::CHECKS);
}

#[test]
fn doctor_accepts_a_working_setup() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--baud=38400", REAL_REPLY_TIME]);
    let port = env.path_argument("front");
    let (findings, _) = doctor_of_port(&port, &env, &[&port], 0);
    for name in ["memory", "domain", "leftovers", "descriptors"] {
        assert_eq!(state(&findings, name, None).0, "ok", "{findings:#?}");
    }
    // Opening the port sets the adapter to low latency, so `doctor` must check the latency after it has opened the
    // port.
    let place = |name: &str| findings.iter().position(|line| line["name"] == name);
    assert!(place("latency") > place("access"), "{findings:#?}");
    for name in ["port", "holder", "access", "rate", "settings", "power-on", "health"] {
        assert_eq!(state(&findings, name, Some(&port)).0, "ok", "{findings:#?}");
    }
    let (found, text) = state(&findings, "sensor", Some(&port));
    assert!(found == "ok" && text.contains("LMS200") && text.contains("38400 Bd"), "{text}");
    let outcome = env.run(&["doctor", &port, "--no-system-config"]);
    let text = String::from_utf8_lossy(&outcome.stdout);
    assert!(text.contains("ok       sensor") && text.contains(&port), "{outcome}");
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0);
}

#[test]
fn reports_bad_settings_and_ports() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &[] as &[&str]);
    let (front, absent) = (env.path_argument("front"), env.path_argument("absent"));
    let links = [env.link("front"), env.link("absent"), "--link=null=/dev/null".into()];
    let mut arguments: Vec<&str> = links.iter().map(String::as_str).collect();
    arguments.extend(["--set", "link.front.unit=cm"]);
    let (findings, outcome) = doctor_of_port(&front, &env, &arguments, 5);
    assert!(state(&findings, "configuration", None).1.contains("front, absent, null"));
    let (found, text) = state(&findings, "settings", Some(&front));
    assert!(found == "warning" && text.contains("unit=cm"), "{text}");
    let (found, text) = state(&findings, "port", Some(&absent));
    assert!(found == "failed" && text.contains("no such port"), "{text}");
    let (found, text) = state(&findings, "access", Some("/dev/null"));
    assert!(!text.contains("file:"), "doctor sends no request to a recording: {text}");
    let of_null = findings.iter().filter(|line| line["port"] == "/dev/null");
    assert!(
        of_null.clone().count() > 0 && of_null.clone().all(|line| line["state"] != "ok"),
        "{findings:#?}"
    );
    assert!(found == "failed" && text.contains("not a serial line"), "{text}");
    assert_eq!(outcome.of_class("error")[0]["kind"], "check");
    assert_eq!(findings.iter().find(|line| line["port"] == front.as_str()).unwrap()["link"], "front");

    let (findings, _) = doctor(&env, &["--link=front=/dev/null", "--set", "link.front.angle=170"], 5);
    let (found, text) = state(&findings, "configuration", None);
    assert!(found == "failed" && text.contains("100 or 180"), "{text}");
}

/// A port can have several names, and the hub may have been started in another directory, so that relative names
/// differ.
#[test]
fn port_of_the_hub_is_found_by_any_of_its_names() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &[] as &[&str]);
    let (front, again, directory) = (env.path_argument("front"), env.path_argument("again"), env.path(""));
    std::os::unix::fs::symlink(&front, &again).expect("a link");
    let device = env.path("front").canonicalize().expect("a pty").display().to_string();
    // Without a hub, `doctor` finds the link in the configuration.
    let arguments = [&again, &env.link("front"), "--set", "link.front.unit=cm"];
    let (findings, _) = doctor_of_port(&again, &env, &arguments, 0);
    let (found, text) = state(&findings, "settings", Some(&again));
    assert!(found == "warning" && text.contains("unit=cm"), "{text}");

    let in_directory = |words: &[&str]| {
        let mut command = env.command(words);
        command.current_dir(&directory);
        Program::start(command)
    };
    let hub = in_directory(&["run", "--json", "--link=front=./front"]).ready();
    env.await_info("front", |info| info["state"] == "streaming");
    for name in [&front[..], &again, &device, "./front", "again"] {
        let outcome = in_directory(&["doctor", name, "--json", "--no-system-config"]).wait();
        let (findings, _) = checks(outcome, 0);
        for check in ["holder", "sensor", "line-errors", "line-loss"] {
            let found = findings.iter().find(|line| line["name"] == check && line["port"] == name);
            let found = found.unwrap_or_else(|| panic!("no {check} of {name}: {findings:#?}"));
            // On a busy machine, the simulator skips scans, which count as lost.
            let is_expected = found["state"] == "ok" || check == "line-loss" && found["state"] == "warning";
            assert!(is_expected && found["link"] == "front", "{found}");
        }
        for verb in [&["probe", name][..], &["configure", name, "unit=mm"]] {
            let outcome = in_directory(&[verb, &["--json"]].concat()).wait();
            let message = outcome.of_class("error")[0]["message"].to_string();
            assert!(
                outcome.exit_code == Some(4) && message.contains("its link front is streaming"),
                "{outcome}"
            );
        }
    }
    // Without arguments, `doctor` checks the links of the hub that is running. `doctor` runs in another directory than
    // the hub, so it finds the port under a different name.
    let (findings, _) = doctor(&env, &[], 0);
    let (found, text) = state(&findings, "sensor", Some(&env.path("./front").display().to_string()));
    assert!(found == "ok" && text.contains("link front of the hub: streaming"), "{text}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn doctor_warns_of_an_unhealthy_scanner() {
    let env = TestEnv::new();
    let dirty = env.simulator(&["dirty"], &["--type=lms291", "--pollution=20"]);
    let port = env.path_argument("dirty");
    let (findings, _) = doctor_of_port(&port, &env, &[&port], 0);
    let (found, text) = state(&findings, "health", Some(&port));
    assert!(found == "warning" && text.contains("window is dirty, 20 % clear"), "{text}");
    drop(dirty);
    let _broken = env.simulator(&["broken"], &["--type=lms211", "--status=0x13", "--error=3:18"]);
    let port = env.path_argument("broken");
    let (findings, _) = doctor_of_port(&port, &env, &[&port], 5);
    let (found, text) = state(&findings, "health", Some(&port));
    assert!(found == "failed" && text.contains("error 18: dirt on the window"), "{text}");
    let _former = env.simulator(&["former"], &["--permanent-baud=38400", "--status=0x12", "--error=2:18"]);
    let port = env.path_argument("former");
    let (findings, _) = doctor_of_port(&port, &env, &[&port], 0);
    assert_eq!(state(&findings, "health", Some(&port)).0, "warning");
    let (found, text) = state(&findings, "power-on", Some(&port));
    let remedy = format!("scanhub configure {port} power_on_baud=9600");
    assert!(found == "warning" && text.contains(&remedy), "{text}");
}

#[test]
fn reports_a_silent_port_after_a_bounded_search() {
    let env = TestEnv::new();
    // The scanner does not reply to any request.
    let _simulator = env.simulator(&["front"], &["--fault=mute=1"]);
    let (findings, _) = doctor(&env, &[&env.path_argument("front")], 5);
    let (found, text) = state(&findings, "sensor", Some(&env.path_argument("front")));
    assert!(found == "failed" && text.contains("looked for lms at 9600"), "{text}");
}

#[test]
fn queries_a_running_hub_and_reports_a_killed_one() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--baud=500000"]);
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let before = env.info("front");
    let (port, link) = (env.path_argument("front"), env.link("front"));
    let (findings, _) = doctor(&env, &[&link], 0);
    // The name of a link is accepted in place of its port.
    let (named, _) = doctor(&env, &["front"], 0);
    assert_eq!(state(&named, "sensor", Some(&env.path_argument("front"))).0, "ok", "{named:#?}");
    let pid = format!("process {}", hub.pid());
    assert!(state(&findings, "domain", None).1.contains(&pid));
    assert!(state(&findings, "holder", Some(&port)).1.contains(&pid));
    assert!(state(&findings, "sensor", Some(&port)).1.contains("streaming"));
    let after = env.info("front");
    let counters = |info: &Value| (info["counters"]["aborted"].clone(), info["counters"]["resyncs"].clone());
    assert_eq!(counters(&before), counters(&after), "doctor changed the counters of the hub");

    assert_eq!(hub.end(KILL).exit_code, None);
    let (findings, _) = doctor(&env, &[&link], 0);
    let (found, text) = state(&findings, "leftovers", None);
    assert!(found == "warning" && text.contains("1 process died") && text.contains("scanhub run"), "{text}");
    assert!(!env.leftover_files().is_empty(), "doctor deleted files");
}

#[test]
fn doctor_fails_for_a_stopped_hub() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--baud=500000"]);
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    hub.signal(Signal::STOP);
    let (findings, _) = doctor(&env, &[&env.link("front")], 5);
    let (found, text) = state(&findings, "domain", None);
    let continued = format!("kill -CONT {}", hub.pid());
    assert!(found == "failed" && text.contains(&continued), "{text}");
    let port = env.path_argument("front");
    for name in ["sensor", "line-errors"] {
        let (found, text) = state(&findings, name, Some(&port));
        assert!(found == "skipped" && text.contains("does not publish"), "{text}");
    }
    // While the hub does not respond, `doctor` must not treat the name of the link as a port.
    let (named, _) = doctor(&env, &["front"], 5);
    assert_eq!(state(&named, "port", Some("front")).0, "skipped", "{named:#?}");
    hub.signal(Signal::CONT);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn hub_is_not_reported_as_leftover_of_another_root() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("absent")]);
    assert!(!env.leftover_files().is_empty(), "the domain has no shared memory");
    let domains = |root: &Path| Program::start(env.command_at(root, &["list", "--domains", "--json"])).wait();
    let domain = env.domain();
    let here = domains(domain.root().parent().unwrap()).of_class("domain");
    assert!(here.len() == 1 && here[0]["pid"] == hub.pid(), "{here:?}");
    let other = env.path("other");
    assert!(domains(&other).of_class("domain").is_empty());
    let outcome = Program::start(env.command_at(&other, &["doctor", "--json", "--no-system-config"])).wait();
    let findings = outcome.of_class("check");
    let (found, text) = state(&findings, "leftovers", None);
    assert_eq!((found, text.as_str()), ("ok", "none "), "{outcome}");
}

#[test]
fn does_not_open_a_port_held_by_another_program() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &[] as &[&str]);
    let holder = std::fs::File::options().read(true).write(true).open(env.path("front")).unwrap();
    let before = rustix::termios::tcgetattr(&holder).unwrap();
    let watch = inotify::init(CreateFlags::CLOEXEC | CreateFlags::NONBLOCK).unwrap();
    let device = env.path("front").canonicalize().unwrap();
    inotify::add_watch(&watch, &device, WatchFlags::OPEN).unwrap();
    // The test process has the port open, so `doctor` must not open the port.
    let (findings, _) = doctor(&env, &[&env.path_argument("front")], 5);
    assert_eq!(rustix::io::read(&watch, &mut [0; 64]), Err(Errno::AGAIN), "doctor opened the port");
    drop(std::fs::File::open(&device).unwrap());
    assert!(
        rustix::io::read(&watch, &mut [0; 64]).is_ok(),
        "the watch does not report that a port is opened"
    );
    let (found, text) = state(&findings, "holder", Some(&env.path_argument("front")));
    assert!(found == "failed" && text.contains(&format!("process {}", std::process::id())), "{text}");
    assert_eq!(state(&findings, "sensor", Some(&env.path_argument("front"))).0, "skipped");
    let after = rustix::termios::tcgetattr(&holder).unwrap();
    assert_eq!(before.output_speed(), after.output_speed());
}

#[test]
fn too_few_descriptors_for_a_hub_is_a_failure() {
    let env = TestEnv::new();
    let link = env.link("absent");
    let limited = |limit: u64, arguments: &[&str]| {
        let inner = env.command(arguments);
        let mut command = std::process::Command::new("sh");
        command.args(["-c", "ulimit -n \"$0\" && exec \"$@\"", &limit.to_string()]);
        command.arg(inner.get_program()).args(inner.get_args());
        command.env_remove("SCANHUB_CONFIG").env("SCANHUB_END_WITH_PARENT", "1");
        Program::start(command)
    };
    let doctor = |limit| {
        let outcome = limited(limit, &["doctor", "--json", "--no-system-config", &link]).wait();
        state(&outcome.of_class("check"), "descriptors", None).0.to_owned()
    };
    let run = ["run", "--json", &link];
    let refused = limited(40, &run).wait();
    assert_eq!(refused.exit_code, Some(75), "{refused}");
    let words = refused
        .stderr
        .split_once("descriptors are short: ")
        .expect("the message reports the shortage")
        .1
        .split(' ');
    let numbers: Vec<u64> = words.filter_map(|word| word.parse().ok()).collect();
    let enough = numbers[0] + numbers[1];
    assert_eq!(limited(enough - 1, &run).wait().exit_code, Some(75));
    assert_eq!(doctor(enough - 1), "failed");
    assert_eq!(limited(enough, &run).ready().end(TERM).exit_code, Some(0));
    assert_eq!(doctor(enough), "warning");
}
