//! `scanhub demo` without any setup. The demo succeeds, reports that no sample was lost, and leaves no files or
//! processes.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::testkit;
use crate::testkit::{
    HUP, INT, Outcome, Program, exists_or_is_symlink, number, output, shared_memory, wait_until,
};
use crate::web::{channels, connect_viewer};

/// Runs the demo with an empty environment. The function `end` waits until the demo exits. It may first do something
/// that makes the demo exit.
fn demo(arguments: &[&str], end: impl FnOnce(Program) -> Outcome) -> Outcome {
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    let place = tempfile::tempdir().expect("a directory");
    let [home, temporary] = ["home", "temporary"].map(|name| place.path().join(name));
    fs::create_dir(&temporary).expect("a directory");
    command.arg("demo").args(arguments).env_clear().env("XDG_STATE_HOME", &home).env("TMPDIR", &temporary);
    let program = Program::start(command);
    let name = format!("demo-{}", program.pid());
    let outcome = end(program);
    assert!(!exists_or_is_symlink(&home), "the demo created files in the home directory");
    assert_eq!(shared_memory(&format!("sh_{name}_")), [] as [&Path; 0]);
    assert_eq!(
        fs::read_dir(&temporary).expect("the directory exists").count(),
        0,
        "the directory of the demo still exists"
    );
    let uid = rustix::process::getuid().as_raw();
    assert!(
        !exists_or_is_symlink(format!("/tmp/scanhub-{uid}/{name}").as_ref()),
        "the domain of the demo still exists"
    );
    assert_eq!(outcome.leftover_processes, [] as [String; 0]);
    outcome
}

/// Returns the command lines of the processes that have `domain` as an argument.
fn processes(domain: &str) -> Vec<String> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let lines = entries.filter_map(|entry| fs::read_to_string(entry.path().join("cmdline")).ok());
    lines.filter(|line| line.split('\0').any(|word| word == domain)).collect()
}

/// Asserts that the summary lines, one for each of `names`, account for every telegram of a stream. Each telegram was
/// received, or the demo's subscriber missed it on a busy machine. If the subscriber missed any, the exit code and the
/// message must report this.
fn check_summaries(outcome: &Outcome, names: &[&str]) {
    let lines = outcome.of_class("summary");
    let sensors: Vec<_> = lines.iter().map(|line| line["sensor"].as_str().unwrap_or_default()).collect();
    assert_eq!(sensors, names, "{outcome}");
    let mut lost_in_all = 0;
    for line in &lines {
        assert_eq!((&line["class"], &line["state"]), (&"summary".into(), &"streaming".into()), "{outcome}");
        let [sent, received, lost, missed] =
            ["sent", "received", "lost", "missed"].map(|key| number(line, key));
        assert_eq!((sent - lost, number(line, "eeprom_writes")), (received, 0), "{outcome}");
        assert!(
            received > 0 && (lost == 0 || missed > 0),
            "samples were lost without a reported reason: {outcome}"
        );
        assert!(line["nearest_mm"].is_u64() && line["hub_cpu_percent"].is_f64(), "{outcome}");
        lost_in_all += lost;
    }
    check_exit_code(outcome, lost_in_all);
}

fn check_exit_code(outcome: &Outcome, lost: u64) {
    assert_eq!(outcome.exit_code, Some(if lost == 0 { 0 } else { 5 }), "{outcome}");
    if lost > 0 {
        let message = outcome.of_class("error")[0]["message"].to_string();
        let telegrams =
            if lost == 1 { "1 telegram was".to_owned() } else { format!("{lost} telegrams were") };
        assert!(
            message.starts_with(&format!("\"{telegrams} sent and not received: "))
                && message.contains("missed"),
            "{outcome}"
        );
    }
}

#[test]
fn demo_runs_with_each_family() {
    for (family, names) in [
        ("ld", &["front", "rear"][..]),
        ("rplidar", &["front", "rear"]),
        ("mixed", &["front", "side", "top"]),
    ] {
        let outcome = demo(&["--headless", "--for", "2s", "--json", "--family", family], Program::wait);
        check_summaries(&outcome, names);
        // The rate is ten revolutions per second, not hundreds of packets. The demo computes the rate from few scans,
        // so the rate is inaccurate on a busy machine.
        let last = &outcome.of_class("summary")[1];
        assert!(last["hz"].is_null() || last["hz"].as_f64().is_some_and(|hz| hz < 50.0), "{last}");
    }
    let outcome = demo(&["--family", "sick"], Program::wait);
    assert!(outcome.exit_code == Some(2) && outcome.stderr.contains("lms, ld, rplidar, mixed"), "{outcome}");
}

#[test]
fn demo_with_a_mount_publishes_clouds() {
    let outcome = demo(&["--world", "tilt", "--headless", "--json"], |mut program| {
        let ready = program.await_line("ready", testkit::is_class("ready"));
        let domain = ready["domain"].as_str().expect("a name");
        // The demo reports `ready` before its child `tilt` has started.
        wait_until("hall is published", || {
            let list = run_in_demo(domain, &["list"]).wait();
            list.lines().iter().any(|line| line["sensor"] == "hall")
        });
        let mut echo = run_in_demo(domain, &["echo", "hall/obstacles"]);
        echo.await_lines(3, "a sweep", testkit::is_class("obstacles"));
        assert_eq!(echo.end(INT).exit_code, Some(0));
        program.end(INT)
    });
    let [front, hall] = &outcome.of_class("summary")[..] else { panic!("{outcome}") };
    assert_eq!(front["sensor"], "front", "{outcome}");
    check_exit_code(&outcome, number(front, "lost"));
    assert!(hall["sensor"] == "hall" && number(hall, "sweeps") >= 2, "{outcome}");
    let outcome = demo(&["--world", "tilt", "--family", "ld"], Program::wait);
    assert!(outcome.exit_code == Some(2) && outcome.stderr.contains("--family"), "{outcome}");
}

#[test]
fn headless_demo_runs_in_an_empty_environment() {
    let outcome = demo(&["--headless", "--for", "2s", "--json"], |mut program| {
        let ready = program.await_line("ready", testkit::is_class("ready"));
        let (domain, root) =
            (ready["domain"].as_str().expect("a name"), ready["root"].as_str().expect("a path"));
        assert_eq!(
            (domain, number(&ready, "pid")),
            (&*format!("demo-{}", program.pid()), u64::from(program.pid()))
        );
        // To subscribe, a program in another terminal needs only the name of the domain.
        let mut list = Command::new(env!("CARGO_BIN_EXE_scanhub"));
        list.args(["list", "--json", "--domain", domain]).env_clear();
        let list = output(list).expect("the program starts");
        assert!(
            list.status.success() && String::from_utf8_lossy(&list.stdout).contains("\"rear\""),
            "{list:?}"
        );
        assert!(root.ends_with(domain), "{root}");
        program.wait()
    });
    check_summaries(&outcome, &["front", "rear"]);
}

#[test]
fn demo_runs_if_the_runtime_path_is_too_long() {
    let directory = tempfile::tempdir().expect("a directory");
    let place = directory.path().join("long".repeat(20));
    fs::create_dir(&place).expect("a directory");
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    command.args(["demo", "--headless", "--for", "1s", "--json"]).env_clear().env("XDG_RUNTIME_DIR", &place);
    let outcome = Program::start(command).wait();
    let left = fs::read_dir(&place).expect("the directory exists").count();
    assert_eq!(left, 0, "{outcome}");
    check_summaries(&outcome, &["front", "rear"]);
}

#[test]
fn rejects_domain_flag_and_ignores_its_variable() {
    for option in ["--domain", "--root"] {
        let refused = demo(&["--headless", "--for", "1s", option, "other"], Program::wait);
        assert_eq!(refused.exit_code, Some(2), "{refused}");
        for word in [&format!("cannot be used with {option}")[..], "tip: leave out", "Usage: scanhub demo"] {
            assert!(refused.stderr.contains(word), "no {word:?}: {refused}");
        }
        let refused = demo(&[option, "other", "--json"], Program::wait);
        let line = &refused.of_class("error")[0];
        assert_eq!((refused.exit_code, &line["kind"]), (Some(2), &"usage".into()), "{refused}");
        assert!(line["hint"].as_str().is_some_and(|hint| hint.starts_with("leave out")), "{refused}");
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    command.args(["web", "--replay", "walk.mcap", "--domain", "other"]).env_clear();
    let refused = Program::start(command).wait();
    assert_eq!(refused.exit_code, Some(2), "{refused}");
    assert!(refused.stderr.contains("web --replay runs its own hub in its own domain"), "{refused}");

    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    command.args(["demo", "--headless", "--for", "1s", "--json"]).env_clear().env("SCANHUB_DOMAIN", "other");
    let outcome = Program::start(command).wait();
    let ready = &outcome.of_class("ready")[0];
    assert!(ready["domain"].as_str().is_some_and(|name| name.starts_with("demo-")), "{outcome}");
    check_summaries(&outcome, &["front", "rear"]);
}

/// Starts a verb of the program in the domain `domain` of a running demo.
fn run_in_demo(domain: &str, arguments: &[&str]) -> Program {
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    command.args(arguments).args(["--json", "--domain", domain]).env_clear();
    Program::start(command)
}

#[test]
fn house_demo_tracks_people_between_rooms() {
    let outcome = demo(&["--world", "house", "--headless", "--json"], |mut program| {
        let ready = program.await_line("ready", testkit::is_class("ready"));
        let domain = ready["domain"].as_str().expect("a name");
        // The demo reports `ready` before its child `track` has started.
        wait_until("people is published", || {
            let list = run_in_demo(domain, &["list"]).wait();
            list.lines().iter().any(|line| line["sensor"] == "people")
        });
        let mut echo = run_in_demo(domain, &["echo", "people/tracks", "people/events"]);
        let tracks = echo.await_line("a track that a sensor sees", |line| {
            line["tracks"].as_array().is_some_and(|tracks| {
                let is_seen = |track: &serde_json::Value| {
                    track["state"] == "confirmed"
                        && track["sensors"].as_array().is_some_and(|sensors| !sensors.is_empty())
                };
                tracks.iter().any(is_seen)
            })
        });
        assert_eq!((&tracks["class"], &tracks["sensor"]), (&"tracks".into(), &"people".into()));
        assert!(number(&tracks["tracks"][0], "id") > 0, "{tracks}");
        let door = echo.await_line("a passage through a door", |line| line["kind"] == "door");
        assert!(["left", "right"].iter().any(|name| door["door"] == *name), "{door}");
        assert!(number(&door, "id") > 0, "{door}");
        assert_eq!(echo.end(INT).exit_code, Some(0));
        program.end(INT)
    });
    check_summaries(&outcome, &["hall", "hall-door", "kitchen", "kitchen-door"]);
    let refused = demo(&["--world", "house", "--family", "mixed", "--headless"], Program::wait);
    assert!(refused.exit_code == Some(2) && refused.stderr.contains("the same family"), "{refused}");
}

#[test]
fn interrupted_demo_ends_all_its_processes() {
    // In addition to the demo itself, all of its child processes must end. SIGHUP is the signal that a program gets
    // when its terminal is closed.
    for signal in [INT, HUP] {
        let outcome = demo(&["--headless", "--json"], |program| {
            let name = format!("demo-{}", program.pid());
            wait_until("hub, simulator and subscribers run", || processes(&name).len() >= 4);
            wait_until("the domain exists", || !shared_memory(&format!("sh_{name}_")).is_empty());
            program.end(signal)
        });
        let lost = outcome.of_class("summary").iter().map(|line| number(line, "lost")).sum();
        check_exit_code(&outcome, lost);
    }
}

#[test]
fn second_interrupt_ends_the_demo_at_once() {
    let outcome = demo(&["--headless", "--json"], |mut program| {
        let ready = program.await_line("ready", testkit::is_class("ready"));
        let domain = ready["domain"].as_str().expect("a name");
        let mut echo = run_in_demo(domain, &["echo", "front/scan"]);
        echo.await_lines(2, "a scan", testkit::is_class("scan"));
        assert_eq!(echo.end(INT).exit_code, Some(0));
        // Stop the simulator, so that the demo waits for telegrams that never arrive.
        let simulator = process_of(domain, "simulate");
        rustix::process::kill_process(simulator, rustix::process::Signal::STOP).expect("the process runs");
        program.signal(INT);
        wait_until("the demo exits", || {
            program.signal(INT);
            program.has_ended()
        });
        program.wait()
    });
    assert_eq!(outcome.exit_code, Some(130), "{outcome}");
    assert_eq!(outcome.of_class("error")[0]["message"], "interrupted before all telegrams had arrived");
    assert_eq!(outcome.of_class("summary").len(), 2, "{outcome}");
}

/// Returns the ID of the process that runs `verb` for the demo in `domain`.
fn process_of(domain: &str, verb: &str) -> rustix::process::Pid {
    let entries = fs::read_dir("/proc").expect("procfs").flatten();
    let is_meant = |path: &Path| {
        let line = fs::read_to_string(path.join("cmdline")).unwrap_or_default();
        line.split('\0').nth(1) == Some(verb) && line.split('\0').any(|word| word == domain)
    };
    let found = entries.map(|entry| entry.path()).find(|path| is_meant(path)).expect("the process runs");
    let pid = found.file_name().and_then(|name| name.to_str()).and_then(|name| name.parse().ok());
    rustix::process::Pid::from_raw(pid.expect("a number")).expect("a process")
}

#[test]
fn demo_page_keeps_running_without_viewers() {
    let outcome = demo(&[], |mut program| {
        let url = loop {
            if let Some(url) = program.next_text().strip_prefix("browser: http://") {
                break url.to_owned();
            }
        };
        let host = url.trim_end_matches('/');
        let connect = || {
            let mut viewer = connect_viewer(host, "/", None).expect("the page is open");
            channels(&mut viewer, ["/front/scan"]);
            viewer
        };
        let mut first = connect();
        // First, one browser connects and reloads the page twice. Then a second viewer connects.
        for _ in 0..2 {
            drop(first);
            first = connect();
        }
        let second = connect();
        drop((first, second));
        connect();
        program.end(INT)
    });
    assert!([Some(0), Some(5)].contains(&outcome.exit_code), "{outcome}");
}

#[test]
fn demo_output_to_a_pipe_has_no_control_sequences() {
    let outcome = demo(&["--for", "2s"], Program::wait);
    assert!([Some(0), Some(5)].contains(&outcome.exit_code), "{outcome}");
    let text = String::from_utf8_lossy(&outcome.stdout);
    assert!(!text.contains('\x1b'), "the output has control sequences without a terminal: {text:?}");
    for word in [
        "scanhub demo",
        "front",
        "rear",
        "nearest",
        " lost",
        "scanhub echo front/scan --domain demo-",
        "browser: http://127.0.0.1:",
    ] {
        assert!(text.contains(word), "no {word:?}: {outcome}");
    }
}
