//! Tests of unusable ports. Each cause has its own message and remedy. The hub exits only if a port is not a serial
//! line. For every other problem, it waits until the port can be used.

use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::{PermissionsExt, chown, symlink};
use std::os::unix::process::CommandExt;

use crate::testkit::{self, Program, TERM, TestEnv, TestLine, is_class, skip, succeeds};
use rustix::process::geteuid;
use serde_json::Value;

/// An unprivileged user who owns no files.
const UNPRIVILEGED_UID: u32 = 65534;

/// Asserts that a hub with the port `port` exits with code 4 and an error of `kind`. Returns the message and the hint
/// of the error.
fn assert_refused(env: &TestEnv, port: &str, kind: &str) -> String {
    let outcome = env.run(&["run", "--json", &format!("--link=front={port}")]);
    assert_eq!(outcome.exit_code, Some(4), "{outcome}");
    message_and_hint(&outcome.stderr, kind)
}

/// Asserts that the last line of `log` is an error of `kind`, and returns the message and the hint of the error.
fn message_and_hint(log: &str, kind: &str) -> String {
    let line: Value = serde_json::from_str(log.lines().last().unwrap_or_default())
        .unwrap_or_else(|error| panic!("{error}: {log}"));
    assert_eq!(line["kind"], kind, "{line}");
    ["message", "hint"].map(|key| line[key].as_str().unwrap_or_default().to_owned()).join("\n")
}

#[test]
fn hub_ends_at_a_port_that_is_not_a_serial_line() {
    let env = TestEnv::new();
    let directory = env.path_argument("directory");
    std::fs::create_dir(&directory).expect("a directory");
    let file = env.file("file", "");
    for (port, message) in [
        (directory.as_str(), "it is a directory"),
        (file.as_str(), "name a tty"),
        ("/dev/null", "not a serial line"),
        (&format!("{file}/front"), "not a serial line"),
    ] {
        let text = assert_refused(&env, port, "port_not_tty");
        assert!(text.contains(port) && text.contains(message), "{text}");
    }
}

#[test]
fn hub_waits_for_missing_ports() {
    let env = TestEnv::new();
    symlink("/dev/ttyGone", env.path("dangling")).expect("a link");
    let hub = env.hub(&[
        "--link=gone=/dev/serial/by-id/usb-Nobody_Has_This-if00-port0",
        "--link=never=/dev/ttyNever",
        &format!("--link=dangling={}", env.path_argument("dangling")),
    ]);
    for (sensor, message) in [
        ("gone", "its adapter is not plugged in"),
        ("never", "/dev/ttyNever: no such port; "),
        ("dangling", "it points to /dev/ttyGone, which does not exist"),
    ] {
        let info = env.await_info(sensor, |info| info["state"] == "absent");
        assert!(info["last_error"].as_str().is_some_and(|error| error.contains(message)), "{info}");
    }
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

/// A user without permission for the port starts the hub. If the test runs as root, the permissions of other users are
/// removed and another user starts the hub. Otherwise, the permissions of the pty's owner are removed.
#[test]
fn hub_waits_for_a_port_without_permission() {
    let env = TestEnv::new();
    let _line = TestLine::create(&env.path("front"));
    let device = env.path("front").canonicalize().expect("a pty");
    let is_root = geteuid().is_root();
    let mode = if is_root { 0o600 } else { 0o000 };
    std::fs::set_permissions(&device, PermissionsExt::from_mode(mode))
        .expect("permission to change the mode");
    let home = env.path("home");
    std::fs::create_dir(&home).expect("a directory");
    let mut command = env.command_at(&home, &["run", "--json", &env.link("front")]);
    if is_root {
        chown(&home, Some(UNPRIVILEGED_UID), Some(UNPRIVILEGED_UID)).expect("permission of root");
        if !command_can_run(UNPRIVILEGED_UID) {
            skip("open-directory", "the program lies where only root may run it");
            return;
        }
        command.uid(UNPRIVILEGED_UID).gid(UNPRIVILEGED_UID);
    }
    let mut hub = Program::start(command);
    let ready = hub.await_line("ready", is_class("ready"));
    assert_eq!(ready["waiting"], serde_json::json!(["front"]), "{ready}");
    let outcome = hub.end(TERM);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let lines: Vec<_> = outcome.stderr.lines().filter(|line| line.contains("front: absent")).collect();
    let [text] = lines[..] else { panic!("not exactly one line for one reason: {outcome}") };
    let user = if is_root { "nobody" } else { "user" };
    let remedy = if is_root { "udev rule" } else { "chmod u+rw" };
    for part in [&env.path_argument("front"), "no permission", user, &format!("mode {mode:03o}"), remedy] {
        assert!(text.contains(part), "{part:?}: {text}");
    }
}

/// Returns whether `user` may start the program in the directory in which Cargo has built it.
fn command_can_run(user: u32) -> bool {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_scanhub"));
    succeeds(command.arg("--help").uid(user).gid(user))
}

#[test]
fn hub_waits_for_a_port_held_by_another_hub() {
    let env = TestEnv::new();
    let line = TestLine::create(&env.path("front"));
    let hub = env.hub(&[env.link("front")]);
    line.wait_until_open();
    let other = TestEnv::new();
    let _simulator = other.simulator(&["rear"], &["--seed=73", "--baud=500000"]);
    let mut second = other.start(&["run", "--json", &env.link("front"), &other.link("rear")]);
    let ready = second.await_line("ready", is_class("ready"));
    assert_eq!(
        (&ready["sensors"], &ready["waiting"]),
        (&serde_json::json!(["front", "rear"]), &serde_json::json!(["front"]))
    );
    let info = other.info("front");
    let text = info["last_error"].as_str().unwrap_or_default();
    let holder = format!("in use by process {} (scanhub); stop it first", hub.pid());
    assert!(info["state"] == "absent" && text.contains(&holder), "{info}");
    other.await_info("rear", |info| info["state"] == "streaming");
    let list = other.run(&["list"]);
    let reason = format!("front: {text}");
    assert!(String::from_utf8_lossy(&list.stdout).lines().any(|line| line == reason), "{list}");
    // A pty stays in exclusive mode after a process has closed it. The hub must therefore leave this mode before it
    // exits, so that the next process can open the port.
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    let taken = |info: &Value| info["state"] != "absent" && info["last_error"] == "";
    other.await_info("front", taken);
    line.wait_until_open();
    let outcome = second.end(TERM);
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let lines = outcome.stderr.lines().filter(|line| line.contains("front: absent")).count();
    assert_eq!(lines, 1, "not exactly one line for one reason: {outcome}");
}

#[test]
fn ready_text_names_ports_the_hub_waits_for() {
    let env = TestEnv::new();
    // No process listens at the first address. The server at the second address accepts no further connection.
    let free = TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a port");
    let mute = TcpListener::bind("127.0.0.1:0").expect("a port");
    rustix::net::listen(&mute, 0).expect("a socket");
    let _waiting = mute.local_addr().and_then(TcpStream::connect).expect("room for one connection");
    let servers = [("refused", free), ("mute", mute.local_addr().expect("an address"))];
    let servers = servers.map(|(name, address)| format!("--link={name}=tcp:{address}"));
    let links = [&[env.link("front"), env.link("rear")], &servers[..]].concat();
    let mut hub = env.start(&[&["run".to_owned()], &links[..]].concat());
    let ready = hub.next_text();
    let names = "front, rear, refused, mute";
    assert!(ready.ends_with(&format!(", sensors: {names}; waiting for the port of {names}")), "{ready}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

/// The field `waiting` does not list a server that accepts the connection at once.
#[test]
fn ready_line_omits_connected_serial_servers() {
    let env = TestEnv::new();
    let server = TcpListener::bind("127.0.0.1:0").expect("a port");
    let link = format!("--link=front=tcp:{}", server.local_addr().expect("an address"));
    let is_connected = || {
        let mut hub = env.start(&["run", "--json", &link]);
        let ready = hub.await_line("ready", is_class("ready"));
        assert_eq!((ready["sensors"].as_array().map(Vec::len), hub.end(TERM).exit_code), (Some(1), Some(0)));
        ready["waiting"] == serde_json::json!([])
    };
    // On a busy machine, the hub may connect only after it has printed the line. The test then starts the hub again.
    testkit::wait_until("the hub is connected when it is ready", is_connected);
}
