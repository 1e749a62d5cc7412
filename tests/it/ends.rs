//! Ends of programs: how they exit after a signal, after SIGKILL and after the reader of a pipe has closed it, and
//! which files they leave.

use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::os::unix::fs::symlink;
use std::process::Stdio;

use crate::testkit;
use crate::testkit::{INT, KILL, Program, TERM, TestEnv, exists_or_is_symlink, is_class, spawn, wait_until};
use rustix::pipe::{PipeFlags, pipe_with};
use serde_json::Value;

/// Starts a hub with one sensor, which plays a recording of 4000 scans in real time.
fn hub(env: &TestEnv) -> Program {
    let scans: Vec<u8> = (0..4000).flat_map(testkit::scan).collect();
    let file = env.file("scans", scans);
    env.hub(&["--link", &format!("front=file:{file}")])
}

#[test]
fn hub_exits_on_sigint_and_sigterm_without_leftovers() {
    for signal in [INT, TERM] {
        let env = TestEnv::new();
        let simulator = env.simulator(&["front"], &["--baud=500000"]);
        let hub = env.hub(&[env.link("front"), env.link("rear")]);
        let mut subscriber = env.echo(&["front/scan"]);
        subscriber.await_lines(3, "a scan", is_class("scan"));
        assert!(!env.leftover_files().is_empty(), "the hub should have files in shared memory");
        assert_eq!(hub.end(signal).exit_code, Some(0), "{signal:?}");
        // Shared memory stays allocated until the subscriber has exited, too.
        assert_eq!(subscriber.end(INT).exit_code, Some(0));
        wait_until("shared memory is freed", || env.leftover_files().is_empty());
        assert_eq!(simulator.end(signal).exit_code, Some(0));
        assert!(!exists_or_is_symlink(&env.path("front")), "the symlink of the simulator still exists");
    }
}

#[test]
fn interrupted_echo_reports_its_sample_count() {
    let env = TestEnv::new();
    let _hub = hub(&env);
    for signal in [INT, TERM] {
        for (bounds, code) in [(&[][..], 0), (&["-n", "100000"], 130), (&["--for", "5m"], 130)] {
            let mut subscriber = env.start(&[&["echo", "--json", "front/scan"], bounds].concat());
            subscriber.await_lines(3, "a scan", is_class("scan"));
            let outcome = subscriber.end(signal);
            assert_eq!(outcome.exit_code, Some(code), "{}", outcome.stderr);
            let (lines, scans) = (outcome.lines(), outcome.of_class("scan").len() as u64);
            let end: Vec<_> = lines.iter().skip_while(|line| line["class"] != "summary").collect();
            assert_eq!((end[0]["received"].as_u64(), &end[0]["missed"]), (Some(scans), &0.into()));
            let error = end.get(1).map(|line| line["kind"].as_str());
            assert_eq!(error, (code == 130).then_some(Some("interrupted")));
        }
    }
    // A program that has printed all requested samples exits with 0, not as interrupted.
    let outcome = env.run(&["echo", "--json", "front/scan", "-n", "5"]);
    assert_eq!((outcome.exit_code, outcome.of_class("scan").len()), (Some(0), 5), "{outcome}");
}

#[test]
fn closed_output_pipe_is_no_failure() {
    let env = TestEnv::new();
    let _hub = hub(&env);
    for format in ["--json", "--csv"] {
        let mut command = env.command(&["echo", "front/scan", format]);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut echo = spawn(command).expect("the program starts");
        let mut line = String::new();
        let mut reader = BufReader::with_capacity(1, echo.stdout.take().expect("a pipe"));
        let read = reader.read_line(&mut line);
        drop(reader);
        let outcome = echo.wait_with_output().expect("the program exits");
        assert!(read.is_ok() && line.len() > 100, "{line:?}");
        let errors = String::from_utf8_lossy(&outcome.stderr);
        assert_eq!((outcome.status.code(), &*errors), (Some(0), ""));
    }
}

#[test]
fn every_line_is_one_write() {
    let env = TestEnv::new();
    let _hub = hub(&env);
    // The pipe is in packet mode (`O_DIRECT`). It preserves the boundaries of writes, so each read returns the bytes of
    // one write.
    let (read, write) = pipe_with(PipeFlags::DIRECT | PipeFlags::CLOEXEC).expect("a pipe");
    let mut command = env.command(&["echo", "--json", "front/scan", "front/telegram", "front/status"]);
    command.stdin(Stdio::null()).stdout(write).stderr(Stdio::null());
    let mut echo = spawn(command).expect("the program starts");
    for _ in 0..60 {
        let mut buffer = [0; 8192];
        let len = rustix::io::read(&read, &mut buffer).expect("a line");
        let whole = buffer[..len].ends_with(b"\n") && buffer[..len].starts_with(b"{");
        assert!(whole, "a line was written in several parts: {:?}", String::from_utf8_lossy(&buffer[..len]));
    }
    echo.kill().expect("echo can be killed");
    echo.wait().expect("echo can be waited for");
}

#[test]
fn killed_echo_leaves_complete_lines() {
    let env = TestEnv::new();
    let _hub = hub(&env);
    for number in 0..5 {
        let path = env.path(&format!("lines{number}"));
        let file = File::create(&path).expect("a file");
        let mut command = env.command(&["echo", "--json", "front/scan", "front/telegram"]);
        command.stdin(Stdio::null()).stdout(file).stderr(Stdio::null());
        let mut echo = spawn(command).expect("the program starts");
        wait_until("some lines are written", || {
            fs::metadata(&path).is_ok_and(|metadata| metadata.len() > 40_000)
        });
        echo.kill().expect("echo can be killed");
        echo.wait().expect("echo can be waited for");
        let text = fs::read_to_string(&path).expect("the output is UTF-8 text");
        assert!(text.ends_with('\n'), "an incomplete line remains");
        let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).expect(line)).collect();
        assert!(lines.len() > 10);
    }
}

#[test]
fn simulator_replaces_only_its_own_symlinks() {
    let env = TestEnv::new();
    let (port, mine) = (env.path("front"), env.file("mine", "mine"));
    // A new simulator replaces the symlink that a killed simulator left.
    let simulator = env.simulator(&["front"], &[] as &[&str]);
    let old = fs::read_link(&port).expect("a symlink");
    assert_eq!(simulator.end(KILL).exit_code, None);
    assert_eq!(fs::read_link(&port).ok(), Some(old));
    let simulator = env.simulator(&["front"], &[] as &[&str]);
    assert!(fs::metadata(&port).is_ok(), "the port has no target");
    assert_eq!(simulator.end(INT).exit_code, Some(0));
    assert!(!exists_or_is_symlink(&port));
    // A simulator never replaces other files, or symlinks that no simulator created.
    symlink(&mine, &port).expect("a symlink");
    let link = env.path_argument("front");
    for place in [&mine, &link] {
        let outcome = env.run(&["simulate", "--port", place]);
        assert_eq!(outcome.exit_code, Some(4), "{outcome}");
        assert!(outcome.stderr.contains(place), "{outcome}");
    }
    assert_eq!(fs::read(&mine).ok(), Some(b"mine".to_vec()));
    assert_eq!(fs::read_link(&port).ok(), Some(mine.into()));
}
