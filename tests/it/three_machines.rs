//! Tests with three machines that a router connects: two rooms with a hub each, and a machine that receives from both.
//! The router runs in the test's own network, which has a cable to each of the three machines.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::testkit::{
    INT, KILL, Machine, Outcome, Program, TerminalSession, TestEnv, can_open_terminal, in_a_network,
    is_class, number, skip, wait_until,
};

/// Returns the path of `scanhub-bridge`, or skips the test if the bridge is not built. `cargo build` alone does not
/// build it.
fn bridge_program() -> Option<PathBuf> {
    let default_path = Path::new(env!("CARGO_BIN_EXE_scanhub")).with_file_name("scanhub-bridge");
    if !default_path.is_file() {
        skip("bridge", "there is no scanhub-bridge beside the program (cargo build -p scanhub-bridge)");
        return None;
    }
    Some(default_path)
}

/// Returns a command that runs the bridge with these flags, in the network and the domain of `env`.
fn command(env: &TestEnv, flags: &[&str]) -> Command {
    let inner = env.command(flags);
    let own = OsStr::new(env!("CARGO_BIN_EXE_scanhub"));
    let bridge = bridge_program().expect("the bridge");
    let words: Vec<_> = std::iter::once(inner.get_program()).chain(inner.get_args()).collect();
    let words = words.into_iter().map(|word| if word == own { bridge.as_os_str() } else { word });
    let words: Vec<_> = words.collect();
    let mut command = Command::new(words[0]);
    command.args(&words[1..]);
    for (key, value) in inner.get_envs() {
        match value {
            Some(value) => command.env(key, value),
            None => command.env_remove(key),
        };
    }
    command
}

/// Starts a bridge and waits until it is ready. Returns the bridge and its hub ID.
fn bridge(env: &TestEnv, flags: &[&str]) -> (Program, String) {
    let mut program = Program::start(command(env, &[&["--json"], flags].concat()));
    let begin = program.await_line("the first line", is_class("bridge_ready"));
    (program, begin["hub"].as_str().unwrap_or_default().to_owned())
}

/// Runs a bridge with `--check`. Returns its exit code, and the state and text of each finding.
fn run_check(env: &TestEnv, flags: &[&str]) -> (Option<i32>, Vec<(String, String)>) {
    let outcome: Outcome = Program::start(command(env, &[&["--json", "--check"], flags].concat())).wait();
    let text_of = |line: &serde_json::Value, key: &str| line[key].as_str().unwrap_or_default().to_owned();
    let findings = outcome.of_class("bridge_check");
    (
        outcome.exit_code,
        findings.iter().map(|line| (text_of(line, "state"), text_of(line, "finding"))).collect(),
    )
}

#[test]
fn third_machine_receives_two_rooms() {
    in_a_network("three_machines::third_machine_receives_two_rooms", || {
        if bridge_program().is_none() {
            return;
        }
        let machines = [2, 3, 4].map(Machine::new);
        let to: Vec<String> =
            machines.iter().map(|it| format!("--connect=tcp/{}:7447", it.test_address())).collect();
        let middle = TestEnv::new();
        let router = || bridge(&middle, &["--listen=tcp/0.0.0.0:7447"]).0;
        let first = router();

        let rooms = [TestEnv::on(&machines[0]), TestEnv::on(&machines[1])];
        let watcher = TestEnv::on(&machines[2]);
        let sensors =
            rooms.each_ref().map(|room| room.simulator(&["front"], &["--seed=61", "--baud=500000"]));
        let hubs = rooms.each_ref().map(|room| room.hub(&[room.link("front")]));
        let bridges = [bridge(&rooms[0], &[&to[0]]), bridge(&rooms[1], &[&to[1]])];
        let names = [0, 1].map(|room| format!("--name=room{room}={}", bridges[room].1));
        let (mut here, _) = bridge(&watcher, &[&to[2], "--publish", &names[0], &names[1]]);
        for _ in &rooms {
            here.await_line("a room", |line| line["kind"] == "published");
        }

        // On the third machine, verbs can use the sensors of both rooms like local sensors.
        for room in ["room0.front", "room1.front"] {
            let ages = watcher.run(&["latency", &format!("{room}/scan"), "-n20", "--json"]);
            let line = ages.of_class("latency").pop();
            assert!(
                ages.exit_code == Some(0) && line.is_some_and(|line| number(&line, "received") > 0),
                "{ages}"
            );
        }
        let (mut near, mut far) = (rooms[1].echo(&["front/scan"]), watcher.echo(&["room1.front/scan"]));
        let scan = near.await_lines(10, "a scan", is_class("scan")).pop().expect("ten scans");
        let is_it =
            |line: &serde_json::Value| line["class"] == "scan" && number(line, "seq") >= number(&scan, "seq");
        let same = far.await_line("the same or a newer scan", is_it);
        assert!(same["seq"] != scan["seq"] || same["ranges"] == scan["ranges"], "{same}");
        if can_open_terminal() {
            let watch = TerminalSession::start(&watcher.command(&["watch"]), (100, 30));
            watch.wait_for_text("room0.front");
            watch.wait_for_text("room1.front");
        }
        let (code, found) = run_check(&watcher, &[&to[2]]);
        assert!(code == Some(0) && found.len() == 1 && found[0].0 == "ok", "{found:?}");
        assert!(bridges.iter().all(|(_, hub)| found[0].1.contains(hub)), "{found:?}");

        // A killed `watch` leaves its subscriber slots. They become free only after the publishers have cleaned up.
        wait_until("the end of the subscription", || watcher.subscribers("room0.front/zones") == 0);

        // Without the router, the programs in a room continue to receive from their own hub. On other machines, the
        // verdict of the room becomes `unknown`.
        let mut zones = watcher.echo(&["room0.front/zones"]);
        zones.await_line("a verdict", |line| line["class"] == "zones" && line["verdict"] != "unknown");
        let mut local = rooms[0].start(&["hz", "--json", "front/scan"]);
        drop(first.end(KILL));
        zones.await_line("unknown verdict", |line| line["class"] == "zones" && line["verdict"] == "unknown");
        let (code, found) = run_check(&watcher, &[&to[2]]);
        assert!(code == Some(5) && found[0].0 == "failed" && found[0].1.contains("no router"), "{found:?}");
        let second = router();
        zones.await_line("a verdict again", |line| line["class"] == "zones" && line["verdict"] != "unknown");
        let rate =
            local.await_line("a rate", |line| line["class"] == "hz" && line["received"].as_u64() > Some(100));
        assert_eq!(rate["missed"], 0, "{rate}");

        for program in [near, far, zones, local, here, second] {
            drop(program.end(INT));
        }
        for ((program, _), hub) in bridges.into_iter().zip(hubs) {
            drop(program.end(INT));
            assert_eq!(hub.end(INT).exit_code, Some(0));
        }
        drop(sensors);
        wait_until("no files are left", || {
            rooms.iter().chain([&watcher]).all(|env| env.leftover_files().is_empty())
        });
    });
}
