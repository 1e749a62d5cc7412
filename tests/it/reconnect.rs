//! Tests of a port that disappears and comes back under the same name while the hub and its subscribers run.

use crate::testkit::{
    INT, Program, REAL_REPLY_TIME, TERM, TestEnv, TestLine, bytes_of, contiguous_numbers,
    exists_or_is_symlink, hash, is_class, number, scan,
};
use rustix::fs::{FlockOperation, flock};
use serde_json::Value;

#[test]
fn reconnects_to_a_returning_scanner() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=22", REAL_REPLY_TIME]);
    let hub = env.hub(&[env.lms_link("front")]);
    let mut subscriber = env.echo(&["front/scan", "front/status"]);
    subscriber.await_lines(10, "a scan", is_class("scan"));
    assert_eq!(simulator.end(INT).exit_code, Some(0));
    assert!(!exists_or_is_symlink(&env.path("front")));
    let absent = subscriber.await_line("absent", |line| line["state"] == "absent");
    assert!(absent["last_error"].as_str().is_some_and(|error| error.contains("front")), "{absent}");
    let _simulator = env.simulator(&["front"], &["--seed=23", REAL_REPLY_TIME]);
    subscriber.await_line("streaming", |line| line["state"] == "streaming");
    subscriber.await_lines(10, "a scan", is_class("scan"));
    let info = env.info("front");
    assert_eq!(number(&info["counters"], "reconnects"), 1, "{info}");
    assert_eq!(info["last_error"], "");
    let outcome = subscriber.end(INT);
    // During one run of the hub, `topic_seq` has no gap, even if the port was lost.
    contiguous_numbers(&outcome.of_class("scan"), "topic_seq");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

/// Sends a scan and waits until the subscriber has received it. Scans with different values of `seed` differ.
fn stream(line: &TestLine, subscriber: &mut Program, seed: u16) {
    let scan = scan(seed);
    line.wait_until_open();
    line.send(&scan);
    let sent = hash(&scan);
    subscriber.await_line("a telegram", |line| is_class("telegram")(line) && hash(&bytes_of(line)) == sent);
}

#[test]
fn reopens_a_port_by_name_on_each_new_device() {
    let env = TestEnv::new();
    let port = env.path("front");
    let hub = env.hub(&[env.lms_link("front")]);
    let mut subscriber = env.echo(&["front/telegram", "front/status"]);
    // Each new device is another pty, because the previous pty still exists when the next one is created.
    let mut line = TestLine::create(&port);
    for plugged in 1..=5 {
        // Wait for the first request of the hub. When the hub opens a line, it discards the bytes that have already
        // arrived, and sends its first request after that.
        line.wait_for_request();
        stream(&line, &mut subscriber, plugged);
        std::fs::remove_file(&port).expect("an existing link");
        line = {
            let next = TestLine::create(&port);
            drop(line);
            next
        };
        let absent = subscriber.await_line("absent", |line| line["state"] == "absent");
        let error = absent["last_error"].as_str().unwrap_or_default();
        assert!(error.contains("front became unavailable: the line hung up"), "{absent}");
        assert_eq!(number(&absent["counters"], "reconnects"), u64::from(plugged), "{absent}");
    }
    line.wait_for_request();
    stream(&line, &mut subscriber, 6);
    let outcome = subscriber.end(INT);
    assert_eq!(contiguous_numbers(&outcome.of_class("telegram"), "seq"), [0, 1, 2, 3, 4, 5]);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn follows_a_port_name_that_moves_to_another_device() {
    let env = TestEnv::new();
    let port = env.path("front");
    let old = TestLine::create(&port);
    let _hub = env.hub(&[env.lms_link("front")]);
    let mut subscriber = env.echo(&["front/telegram", "front/status"]);
    stream(&old, &mut subscriber, 1);
    std::fs::remove_file(&port).expect("an existing link");
    let new = TestLine::create(&port);
    // The hub keeps the port from which it receives a stream, even though the port's name now belongs to another
    // device.
    stream(&old, &mut subscriber, 2);
    assert!(!new.is_open());
    drop(old);
    stream(&new, &mut subscriber, 3);
}

#[test]
fn waits_for_a_returned_port_that_is_in_use() {
    let env = TestEnv::new();
    let port = env.path("front");
    let hub = env.hub(&[env.lms_link("front")]);
    env.await_info("front", |info| info["state"] == "absent");
    // The test holds a lock on the device before the device gets the name of the port.
    let line = TestLine::create(&env.path("elsewhere"));
    let holder = std::fs::File::open(env.path("elsewhere")).expect("a tty");
    flock(&holder, FlockOperation::LockExclusive).expect("a lock");
    std::fs::rename(env.path("elsewhere"), &port).expect("a name");
    let myself = format!("in use by process {} (", std::process::id());
    let names_this_process =
        |info: &Value| info["last_error"].as_str().is_some_and(|error| error.contains(&myself));
    let info = env.await_info("front", names_this_process);
    assert_eq!(info["state"], "absent");
    drop(holder);
    let mut subscriber = env.echo(&["front/telegram"]);
    stream(&line, &mut subscriber, 1);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}
