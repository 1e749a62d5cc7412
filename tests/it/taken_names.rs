//! Tests of names that are already in use. Sensors, trackers and mounts share one name space per domain. A name belongs
//! to the first process that publishes under this name. If another program has the name of a link, the hub waits until
//! the name is free. A program does not wait: it reports an error and exits.

use std::sync::atomic::{AtomicU32, Ordering};

use serde_json::{Value, json};

use crate::testkit::{INT, KILL, Outcome, Program, TERM, TestEnv, contiguous_numbers, is_class, scan};

/// Starts a simulated mount that publishes its angles as `name`.
fn start_mount(env: &TestEnv, name: &str) -> Program {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let port =
        format!("--port={}", env.path_argument(&format!("mount-{}", NEXT.fetch_add(1, Ordering::Relaxed))));
    env.start(&["simulate", "--json", "--world=tilt", &port, &format!("--angles={name}")])
}

/// Returns the message with which programs report that `holder` uses the name `name`.
fn name_taken_message(name: &str, holder: &Program) -> String {
    format!("the name {name} is published by process {} (scanhub)", holder.pid())
}

/// Asserts that a program has reported `message` as an error about a name in use, and has exited. Programs whose stdout
/// only has the line `ready` report errors on stderr.
fn assert_refused(outcome: &Outcome, message: &str) {
    let mut lines = outcome.stderr.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let error = lines.next_back().unwrap_or_default();
    let expected = (Some(75), &json!("name_held"), &json!(message));
    assert_eq!((outcome.exit_code, &error["kind"], &error["message"]), expected, "{outcome}");
}

#[test]
fn link_waits_for_a_name_in_use() {
    for signal in [INT, KILL] {
        let env = TestEnv::new();
        let holder = start_mount(&env, "front").ready();
        let _simulator = env.simulator(&["front", "rear"], &["--baud=500000"]);
        let mut hub = env.start(&["run", "--json", &env.link("front"), &env.link("rear")]);
        let ready = hub.await_line("ready", is_class("ready"));
        assert!(ready["waiting"].as_array().is_some_and(|names| names.contains(&json!("front"))), "{ready}");

        let words = name_taken_message("front", &holder);
        let info = env.info("front");
        let error = info["last_error"].as_str().unwrap_or_default();
        assert!(info["state"] == "absent" && error.starts_with(&words), "{info}");
        let list = env.run(&["list"]);
        let listed = String::from_utf8_lossy(&list.stdout).into_owned();
        assert!(listed.lines().any(|line| line.starts_with(&format!("front: {words}"))), "{list}");
        // The program that has the name still publishes its topic, and the other links stream.
        env.await_info("rear", |info| info["state"] == "streaming");
        env.echo(&["front/tilt"]).await_lines(20, "angles", is_class("tilt"));
        // A second program with this name reports the same message as the hub.
        assert_refused(&start_mount(&env, "front").wait(), &words);

        let mut waiting = env.echo(&["front/scan"]);
        drop(holder.end(signal));
        env.await_info("front", |info| info["state"] == "streaming" && info["last_error"] == "");
        let mut late = env.echo(&["front/scan"]);
        for echo in [&mut waiting, &mut late] {
            echo.await_lines(60, "scans", is_class("scan"));
        }
        let [waiting, late] = [waiting, late].map(|echo| echo.end(INT));
        for outcome in [&waiting, &late] {
            assert_eq!(outcome.of_class("summary")[0]["missed"], 0, "{outcome}");
        }
        let scans = waiting.of_class("scan");
        assert_eq!(scans[0]["topic_seq"], 0, "{waiting}");
        contiguous_numbers(&scans, "topic_seq");

        // Now the hub uses the name.
        assert_refused(&start_mount(&env, "front").wait(), &name_taken_message("front", &hub));
        let outcome = hub.end(TERM);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let lines = outcome.stderr.lines().filter(|line| line.contains(&format!("front: absent: {words}")));
        assert_eq!(lines.count(), 1, "one line for one reason: {outcome}");
        // The last publisher in a domain removes everything when it exits, including the files that a killed publisher
        // left.
        assert_eq!(start_mount(&env, "front").ready().end(INT).exit_code, Some(0));
        assert!(env.leftover_files().is_empty(), "{:?}", env.leftover_files());
    }
}

#[test]
fn ready_line_names_links_that_wait_for_their_name() {
    let env = TestEnv::new();
    let _holder = start_mount(&env, "front").ready();
    let mut hub = env.start(&["run", &env.link("front"), &env.link("rear")]);
    let ready = hub.next_text();
    let end = "sensors: front, rear; waiting for the port of rear; waiting for the name of front";
    assert!(ready.ends_with(end), "{ready}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn killed_hub_does_not_keep_its_names() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--baud=500000"]);
    let hub = env.hub(&[env.link("front")]);
    assert_eq!(hub.end(KILL).exit_code, None);
    let mut hub = env.start(&["run", "--json", &env.link("front")]);
    let ready = hub.await_line("ready", is_class("ready"));
    assert_eq!(ready["waiting"], Value::Array(Vec::new()), "{ready}");
    let outcome = hub.end(TERM);
    assert!(outcome.exit_code == Some(0) && !outcome.stderr.contains("is published by"), "{outcome}");
    // A hub that has exited normally does not keep its names, either.
    let holder = start_mount(&env, "front").ready();
    assert_eq!(holder.end(INT).exit_code, Some(0));
}

#[test]
fn program_is_refused_the_name_of_another_program() {
    let env = TestEnv::new();
    let first = start_mount(&env, "mount").ready();
    assert_refused(&start_mount(&env, "mount").wait(), &name_taken_message("mount", &first));
    assert_eq!(first.end(INT).exit_code, Some(0));
    let second = start_mount(&env, "mount").ready();
    assert_eq!(second.end(INT).exit_code, Some(0));
    assert!(env.leftover_files().is_empty(), "{:?}", env.leftover_files());
}

/// A replay does not wait for the names of its sensors, because all links of a replay start together.
#[test]
fn recording_is_refused_the_name_of_a_program() {
    let env = TestEnv::new();
    let holder = start_mount(&env, "front").ready();
    let port = env.file("front.bin", [scan(1), scan(2)].concat());
    let link = format!("--link=front=file:{port},family=lms");
    assert_refused(&env.run(&["run", "--json", &link]), &name_taken_message("front", &holder));
}
