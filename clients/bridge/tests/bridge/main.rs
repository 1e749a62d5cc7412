//! Tests of the program `scanhub-bridge` from outside, run as `scanhub bridge`: topics of a hub on another machine,
//! routers that restart, slow links and hostile peers. Routers are bridges that listen.

#[path = "../../../../tests/testkit/mod.rs"]
mod testkit;

mod access;
mod hostile;
mod machines;
mod page;
mod routers;
mod slow;

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::net::TcpListener;

use serde_json::Value;
use testkit::{Outcome, Program, TestEnv, number, wait_until};
use zenoh::{Config, Session, Wait};

/// Flags of a simulator without any changes.
const NO_FLAGS: &[&str] = &[];

/// Returns an address on the loopback at which no program listens.
fn address(protocol: &str) -> String {
    let port =
        TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a port").port();
    format!("{protocol}/127.0.0.1:{port}")
}

/// Starts a bridge with these flags, and waits until it listens or is connected. Returns the bridge and its hub ID. The
/// hub ID is empty if the bridge does not send.
fn bridge(env: &TestEnv, flags: &[&str]) -> (Program, String) {
    let mut program = bridge_without_peer(env, flags);
    let line = program.await_line("its begin", |line| line["class"] == "bridge_ready");
    (program, line["hub"].as_str().unwrap_or_default().to_owned())
}

/// Starts a bridge with these flags, without waiting for a connection.
fn bridge_without_peer(env: &TestEnv, flags: &[&str]) -> Program {
    env.start(&[&["bridge", "--json"], flags].concat())
}

/// Waits until the program reports a link.
fn wait_until_linked(program: &mut Program) {
    program.await_line("a link", |line| line["class"] == "bridge_link" && line["state"] == "up");
}

/// Starts a bridge that listens, in a domain without a hub.
fn router(env: &TestEnv, listen: &str, connect: &[&str]) -> Program {
    let listen = format!("--listen={listen}");
    let connect: Vec<_> = connect.iter().map(|address| format!("--connect={address}")).collect();
    let flags: Vec<_> = std::iter::once(listen.as_str()).chain(connect.iter().map(String::as_str)).collect();
    bridge(env, &flags).0
}

/// Returns a plain Zenoh client that is connected to the router at this address.
fn open_peer(at: &str) -> Session {
    let mut config = Config::default();
    for (key, value) in [
        ("mode", "\"client\""),
        ("connect/endpoints", &format!("[{at:?}]")),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(key, value).expect("a key of Zenoh");
    }
    // Retry, because the router may not accept connections yet.
    let mut session = None;
    wait_until("the router accepts connections", || {
        session = zenoh::open(config.clone()).wait().ok();
        session.is_some()
    });
    session.expect("a session")
}

/// Returns the values of `keys` in the last statistics of a bridge, by sensor and topic. Earlier statistics do not
/// count, because a received sensor may have had no name yet.
fn final_counters(outcome: &Outcome, keys: &[&str]) -> CounterValues {
    last_counters(&outcome.lines(), keys)
}

/// Returns the values of `keys` in the last statistics that a running bridge has printed.
fn current_counters(program: &mut Program, keys: &[&str]) -> CounterValues {
    let lines = RefCell::new(Vec::new());
    program.prints(|line| {
        lines.borrow_mut().push(line.clone());
        false
    });
    last_counters(&lines.into_inner(), keys)
}

type CounterValues = BTreeMap<String, Vec<u64>>;

fn last_counters(lines: &[Value], keys: &[&str]) -> CounterValues {
    let (mut rows, mut is_whole) = (BTreeMap::new(), false);
    for line in lines {
        // This line ends the statistics of received samples.
        is_whole |= line["class"] == "bridge_refused";
        if line["class"] != "bridge" || line[keys[0]].is_null() {
            continue;
        }
        if std::mem::take(&mut is_whole) {
            rows.clear();
        }
        let name = format!("{}/{}", text(&line["sensor"]), text(&line["topic"]));
        rows.insert(name, keys.iter().map(|key| line[key].as_u64().unwrap_or_default()).collect());
    }
    rows
}

/// Returns the count of this rejection reason in the last statistics.
fn refusal_count(outcome: &Outcome, reason: &str) -> u64 {
    outcome.of_class("bridge_refused").last().map_or(0, |line| number(line, reason))
}

fn text(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}

/// Checks that the counters of both bridges agree: for each topic, the number of received samples plus the number of
/// lost samples is the number of sent samples. Returns the number of lost samples.
fn assert_counters_agree(sent: &Outcome, received: &Outcome) -> u64 {
    let there = final_counters(sent, &["sent", "replaced"]);
    let here = final_counters(received, &["received", "lost", "replaced"]);
    assert!(there.len() > 4 && there.keys().eq(here.keys()), "{there:?}\n{here:?}");
    let mut lost = 0;
    for (name, row) in &there {
        assert_eq!(row[0], here[name][0] + here[name][1], "{name}: {there:?}\n{here:?}");
        // Announcements do not include their own counters.
        assert!(name.ends_with("/announce") || row[1] == here[name][2], "{name}: {there:?}\n{here:?}");
        lost += here[name][1];
    }
    lost
}
