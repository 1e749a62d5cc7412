//! A port that goes away and comes back under its name while the hub and its consumers run on.

use crate::testkit::{
    INT, Line, Program, REAL_ANSWERS, TERM, TestEnv, bytes_of, hash, is_class, is_there, number, scan,
    sequence,
};
use rustix::fs::{FlockOperation, flock};
use serde_json::Value;

#[test]
fn a_sensor_that_goes_and_comes_back() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=22", REAL_ANSWERS]);
    let hub = env.hub(&[env.lms_link("front")]);
    let mut consumer = env.echo(&["front/scan", "front/status"]);
    consumer.await_lines(10, "a scan", is_class("scan"));
    assert_eq!(simulator.end(INT).code, Some(0));
    assert!(!is_there(&env.path("front")));
    let absent = consumer.await_line("absent", |line| line["state"] == "absent");
    assert!(absent["last_error"].as_str().is_some_and(|error| error.contains("front")), "{absent}");
    let _simulator = env.simulator(&["front"], &["--seed=23", REAL_ANSWERS]);
    consumer.await_line("streaming", |line| line["state"] == "streaming");
    consumer.await_lines(10, "a scan", is_class("scan"));
    let info = env.info("front");
    assert_eq!(number(&info["counters"], "reconnects"), 1, "{info}");
    assert_eq!(info["last_error"], "");
    let outcome = consumer.end(INT);
    // One hub, one life: the numbers go on.
    sequence(&outcome.of_class("scan"), "topic_seq");
    assert_eq!(hub.end(TERM).code, Some(0));
}

/// Sends telegrams until the consumer has one, with numbers of their own.
fn stream(line: &Line, consumer: &mut Program, seed: u16) {
    let scan = scan(seed);
    line.await_open();
    line.send(&scan);
    let sent = hash(&scan);
    consumer.await_line("a telegram", |line| is_class("telegram")(line) && hash(&bytes_of(line)) == sent);
}

#[test]
fn a_port_is_taken_back_under_its_name_whatever_device_it_is() {
    let env = TestEnv::new();
    let port = env.path("front");
    let hub = env.hub(&[env.lms_link("front")]);
    let mut consumer = env.echo(&["front/telegram", "front/status"]);
    // Another pty each time: the one before is still there when the next one is made.
    let mut line = Line::at(&port);
    for plugged in 1..=5 {
        // When the hub opens a line, it discards what has already arrived. It sends its first request after that.
        line.await_request();
        stream(&line, &mut consumer, plugged);
        std::fs::remove_file(&port).expect("the name is there");
        line = {
            let next = Line::at(&port);
            drop(line);
            next
        };
        let absent = consumer.await_line("absent", |line| line["state"] == "absent");
        let error = absent["last_error"].as_str().unwrap_or_default();
        assert!(error.contains("front went away: the line hung up"), "{absent}");
        assert_eq!(number(&absent["counters"], "reconnects"), u64::from(plugged), "{absent}");
    }
    line.await_request();
    stream(&line, &mut consumer, 6);
    let outcome = consumer.end(INT);
    assert_eq!(sequence(&outcome.of_class("telegram"), "seq"), [0, 1, 2, 3, 4, 5]);
    assert_eq!(hub.end(TERM).code, Some(0));
}

#[test]
fn a_name_that_moves_while_its_old_device_lives() {
    let env = TestEnv::new();
    let port = env.path("front");
    let old = Line::at(&port);
    let _hub = env.hub(&[env.lms_link("front")]);
    let mut consumer = env.echo(&["front/telegram", "front/status"]);
    stream(&old, &mut consumer, 1);
    std::fs::remove_file(&port).expect("the name is there");
    let new = Line::at(&port);
    // What streams is not left for what may stream.
    stream(&old, &mut consumer, 2);
    assert!(!new.is_open());
    drop(old);
    stream(&new, &mut consumer, 3);
}

#[test]
fn a_port_that_comes_back_in_other_hands() {
    let env = TestEnv::new();
    let port = env.path("front");
    let hub = env.hub(&[env.lms_link("front")]);
    env.await_info("front", |info| info["state"] == "absent");
    // This test holds it before it has its name.
    let line = Line::at(&env.path("elsewhere"));
    let holder = std::fs::File::open(env.path("elsewhere")).expect("a tty");
    flock(&holder, FlockOperation::LockExclusive).expect("a lock");
    std::fs::rename(env.path("elsewhere"), &port).expect("a name");
    let myself = format!("in use by process {} (", std::process::id());
    let said = |info: &Value| info["last_error"].as_str().is_some_and(|error| error.contains(&myself));
    let info = env.await_info("front", said);
    assert_eq!(info["state"], "absent");
    drop(holder);
    let mut consumer = env.echo(&["front/telegram"]);
    stream(&line, &mut consumer, 1);
    assert_eq!(hub.end(TERM).code, Some(0));
}
