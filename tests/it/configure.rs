//! `scanhub configure` with and without a terminal. It writes the scanner's EEPROM once after the answer `yes`, and
//! never without this answer.

use std::fs::File;
use std::io::{Read, Write};
use std::process::Stdio;
use std::thread;

use crate::testkit;
use crate::testkit::{Child, INT, TERM, TestEnv, number, spawn, terminal, wait_until};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// A running `scanhub configure` in a terminal, in which the test answers the program's question.
struct ConfigureSession {
    process: Child,
    /// User's side of the terminal.
    keys: File,
}

/// Result of a session.
struct ConfigureOutcome {
    code: Option<i32>,
    out: String,
    errors: String,
}

impl ConfigureSession {
    fn start(env: &TestEnv, arguments: &[&str]) -> ConfigureSession {
        let (keys, screen) = terminal();
        let mut command = env.command(&[&["configure"], arguments].concat());
        command.stdin(Stdio::from(screen.try_clone().unwrap()));
        command.stdout(Stdio::piped()).stderr(Stdio::from(screen));
        ConfigureSession { process: spawn(command).unwrap(), keys }
    }

    /// Reads until the program asks its question, calls `act` to answer it, and waits until the program exits.
    fn answer_questions(mut self, act: impl FnOnce(&mut File, u32)) -> ConfigureOutcome {
        let mut stdout = self.process.stdout.take().unwrap();
        let out = thread::spawn(move || {
            let mut text = String::new();
            stdout.read_to_string(&mut text).map(|_| text).unwrap()
        });
        let mut errors = Vec::new();
        let mut byte = [0];
        // Reading fails as soon as no program has the terminal open.
        while !errors.ends_with(b"Type yes: ") && self.keys.read(&mut byte).is_ok_and(|len| len > 0) {
            errors.push(byte[0]);
        }
        if errors.ends_with(b"Type yes: ") {
            act(&mut self.keys, self.process.id());
        }
        while self.keys.read(&mut byte).is_ok_and(|len| len > 0) {
            errors.push(byte[0]);
        }
        let code = self.process.wait().unwrap().code();
        ConfigureOutcome { code, out: out.join().unwrap(), errors: String::from_utf8(errors).unwrap() }
    }

    fn type_text(self, text: &str) -> ConfigureOutcome {
        self.answer_questions(|keys, _| keys.write_all(text.as_bytes()).unwrap())
    }
}

impl ConfigureOutcome {
    fn lines(&self) -> Vec<Value> {
        self.out.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|_| panic!("{line}"))).collect()
    }
}

fn signal(pid: u32, signal: Signal) {
    kill_process(Pid::from_raw(pid as i32).unwrap(), signal).unwrap();
}

fn probe(env: &TestEnv, port: &str) -> Value {
    let outcome = env.search(&["probe", &env.path_argument(port), "--json"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    outcome.lines()[0].clone()
}

#[test]
fn confirmed_configuration_is_written_once() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--baud=38400"]);
    let port = env.path_argument("front");
    let before = probe(&env, "front");
    let result =
        ConfigureSession::start(&env, &[&port, "unit=cm", "mode=fields-ab", "--json"]).type_text("yes\n");
    assert_eq!(result.code, Some(0), "{}\n{}", result.out, result.errors);
    let lines = result.lines();
    let items: Vec<_> = lines.iter().map(|line| (&line["class"], &line["item"], &line["offset"])).collect();
    assert_eq!(items[0], (&"difference".into(), &"measuring mode".into(), &5.into()), "{lines:?}");
    assert_eq!(items[1], (&"difference".into(), &"unit".into(), &6.into()), "{lines:?}");
    let configured = &lines[2];
    assert_eq!(
        (&configured["class"], &configured["written"]),
        (&"configured".into(), &Value::Bool(true)),
        "{configured}"
    );
    assert_eq!(configured["before"], before["configuration"]);
    // Stdout is a pipe, so the program prints the difference and the question to the terminal.
    let shown = result.errors.split("Type yes").next().unwrap();
    assert!(shown.contains("unit: 01h (1 mm) -> 00h (10 mm)"), "{}", result.errors);
    let after = probe(&env, "front");
    assert_eq!(configured["after"], after["configuration"]);
    assert_eq!((number(&after, "unit_mm"), number(&after, "mode")), (10, 4), "{after}");
    assert_eq!((number(&after, "operating_mode"), number(&after, "baud")), (0x25, 38_400), "{after}");

    // Restore the old configuration. `probe` printed its value before the change. This run of `configure` is without
    // `--json`.
    let backup = format!("configuration={}", before["configuration"].as_str().unwrap());
    let result = ConfigureSession::start(&env, &[&port, &backup]).type_text("yes\n");
    assert_eq!(result.code, Some(0), "{}", result.errors);
    assert!(result.out.contains("unit: 00h (10 mm) -> 01h (1 mm)"), "{}", result.out);
    assert!(result.out.contains("to go back: scanhub configure"), "{}", result.out);
    assert_eq!(probe(&env, "front")["configuration"], before["configuration"]);

    // The scanner now has this configuration, so the program changes nothing and asks no question.
    let outcome = env.run(&["configure", &port, &backup, "unit=mm"]);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    assert!(String::from_utf8_lossy(&outcome.stdout).contains("nothing to change"), "{outcome}");
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 2);
}

#[test]
fn suggested_command_makes_marks_available() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--baud=38400", "--mode=0x00"]);
    let port = env.path_argument("front");
    let marks = |hub: testkit::Program| {
        let reported = env.await_info("front", |info| !info["marks"]["available"].is_null())["marks"].clone();
        let outcome = env.run(&["echo", "--json", "front/marks", "-n", "3"]);
        let lines = outcome.of_class("marks");
        assert!(lines.iter().all(|line| line["available"] == reported["available"]), "{outcome}");
        let doctor = env.run(&["doctor", &port, "--json", "--no-system-config"]).of_class("check");
        let found =
            doctor.iter().find(|line| line["name"] == "marks").expect("doctor checks the marks").clone();
        let ended = hub.end(TERM);
        assert_eq!(ended.exit_code, Some(0), "{ended}");
        (reported, found, ended.stderr)
    };
    let (reported, found, log) = marks(env.hub(&[env.link("front")]));
    let command = format!("scanhub configure {port} mode=0x01");
    assert_eq!(reported, serde_json::json!({ "available": false, "remedy": command }));
    assert_eq!(
        (&found["state"], &found["remedy"]),
        (&"warning".into(), &format!("stop the hub first: {command}").into())
    );
    assert!(log.contains(&command), "{log}");

    let words: Vec<&str> = command.split(' ').skip(2).collect();
    let result = ConfigureSession::start(&env, &words).type_text("yes\n");
    assert_eq!(result.code, Some(0), "{}", result.errors);
    let (reported, found, log) = marks(env.hub(&[env.link("front")]));
    assert_eq!(reported, serde_json::json!({ "available": true, "remedy": null }));
    assert_eq!(found["state"], "ok");
    assert!(!log.contains("scanhub configure"), "{log}");
}

#[test]
fn reports_command_that_restores_previous_settings() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--baud=38400"]);
    let port = env.path_argument("front");
    let done = |settings: &[&str]| {
        let result = ConfigureSession::start(&env, &[&[&port[..]], settings].concat()).type_text("yes\n");
        assert_eq!(result.code, Some(0), "{}", result.errors);
        assert!(result.errors.contains("EEPROM wears out after a few thousand writes."), "{}", result.errors);
        result.out
    };
    let hex = probe(&env, "front")["configuration"].as_str().unwrap().to_owned();
    let out = done(&["power_on_baud=keep"]);
    let change = "9600 Bd -> 38400 Bd: the present rate of the line becomes permanent";
    assert!(out.contains(change), "{out}");
    let back = format!("to go back: scanhub configure {port} power_on_baud=9600\n");
    assert!(out.contains(&back), "{out}");
    assert_eq!(probe(&env, "front")["permanent_rate"], true);
    // The scanner does not report which permanent rate it had before, so the program cannot print how to restore it.
    let out = done(&["power_on_baud=9600"]);
    assert!(out.contains("cannot be restored") && !out.contains("to go back"), "{out}");
    assert_eq!(probe(&env, "front")["permanent_rate"], false);
    let out = done(&["unit=cm", "power_on_baud=keep"]);
    assert!(out.contains(&format!("{port} configuration={hex} power_on_baud=9600\n")), "{out}");
}

#[test]
fn any_answer_but_yes_writes_nothing() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--baud=500000"]);
    let port = env.path_argument("front");
    for answer in ["no\n", "y\n", "\n", "YES\n", "\x04"] {
        let result = ConfigureSession::start(&env, &[&port, "unit=cm"]).type_text(answer);
        assert_eq!(result.code, Some(1), "{answer:?}: {}", result.errors);
        assert!(result.errors.contains("nothing was written"), "{}", result.errors);
        assert!(result.errors.contains("\nscanhub: not confirmed"), "{answer:?}: {:?}", result.errors);
    }
    let result = ConfigureSession::start(&env, &[&port, "unit=cm"]).answer_questions(|_, pid| {
        signal(pid, INT);
    });
    assert_eq!(result.code, Some(130), "{}", result.errors);
    // Without a terminal, the program still prints the difference.
    let outcome = env.run(&["configure", &port, "unit=cm", "--json"]);
    assert_eq!(outcome.exit_code, Some(2), "{outcome}");
    assert_eq!(outcome.of_class("difference").len(), 1, "{outcome}");
    assert_eq!(outcome.of_class("error")[0]["kind"], "usage", "{outcome}");
    // Even with a terminal as stdin, the program does not ask its question if the user cannot see it.
    let (_keys, screen) = terminal();
    let mut unseen = env.command(&["configure", &port, "unit=cm"]);
    unseen.stdin(Stdio::from(screen)).stdout(Stdio::null()).stderr(Stdio::null());
    let mut process = spawn(unseen).unwrap();
    wait_until("configure exits without a question", || process.try_wait().unwrap().is_some());
    assert_eq!(process.wait().unwrap().code(), Some(2));
    assert_eq!(number(&probe(&env, "front"), "unit_mm"), 1);
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0);
}

#[test]
fn rejects_impossible_settings_without_writing() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--baud=500000"]);
    let port = env.path_argument("front");
    for (setting, code, words) in [
        ("unit=dm", 78, "mm or cm"),
        ("units=mm", 78, "did you mean unit"),
        ("mode=7", 78, "reflector3"),
        ("sensitivity=high", 78, "only the LMS 291"),
    ] {
        let outcome = env.run(&["configure", &port, setting]);
        assert_eq!(outcome.exit_code, Some(code), "{outcome}");
        assert!(outcome.stderr.contains(words), "{outcome}");
    }
    assert_eq!(env.run(&["configure", &port]).exit_code, Some(2));
    assert_eq!(env.run(&["configure", &port, "unit=cm", "--password=short"]).exit_code, Some(78));
    let wrong = ConfigureSession::start(&env, &[&port, "unit=cm", "--password=mistaken"]).type_text("yes\n");
    assert_eq!(wrong.code, Some(1), "{}", wrong.errors);
    for words in ["wrong password?", "nothing was written", "values on request"] {
        assert!(wrong.errors.contains(words), "{words}: {}", wrong.errors);
    }
    assert!(wrong.errors.contains(" ..\r\nscanhub: "), "{:?}", wrong.errors);
    // In this case, a hub has the port open.
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    let outcome = env.run(&["configure", &port, "unit=cm"]);
    assert_eq!(outcome.exit_code, Some(4), "{outcome}");
    assert!(outcome.stderr.contains(&format!("in use by the hub, process {};", hub.pid())), "{outcome}");
    assert_eq!(env.info("front")["state"], "streaming");
    drop(hub);
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 0);
}

#[test]
fn resumes_an_abandoned_stream_after_writing() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--baud=500000"]);
    let hub = env.hub(&[env.link("front")]);
    env.await_info("front", |info| info["state"] == "streaming");
    hub.end(testkit::KILL);
    let result =
        ConfigureSession::start(&env, &[&env.path_argument("front"), "availability=3"]).type_text("yes\n");
    assert_eq!(result.code, Some(0), "{}", result.errors);
    assert!(result.out.contains("now at: all values, continuously"), "{}", result.out);
    let sent = env.truth("front").len();
    wait_until("the scanner continues to stream", || env.truth("front").len() > sent + 20);
    assert_eq!(number(&probe(&env, "front"), "availability"), 1);
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 1);
}

#[test]
fn signals_do_not_interrupt_a_write_in_progress() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--baud=500000"]);
    let port = env.path_argument("front");
    let signals = [(Signal::HUP, "unit=cm", 10), (Signal::QUIT, "unit=mm", 1), (TERM, "unit=cm", 10)];
    for (sent, setting, unit_mm) in signals {
        let result =
            ConfigureSession::start(&env, &[&port, setting, "--json"]).answer_questions(|keys, pid| {
                let before = env.truth("front").len();
                keys.write_all(b"yes\n").unwrap();
                // Wait for two more telegrams in the log. The first one may have been sent before the question and
                // logged late.
                wait_until("the simulator has received a request", || env.truth("front").len() > before + 1);
                if sent == Signal::HUP {
                    // The signal HUP means that the terminal has been closed, so close it here, too.
                    *keys = File::open("/dev/null").unwrap();
                }
                signal(pid, sent);
            });
        assert_eq!(result.code, Some(0), "{sent:?}: {}", result.errors);
        assert_eq!(result.lines().last().unwrap()["written"], true, "{sent:?}: {}", result.out);
        assert_eq!(number(&probe(&env, "front"), "unit_mm"), unit_mm, "{sent:?}");
    }
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    assert_eq!(env.simulator_totals("front").1, 3);
}
