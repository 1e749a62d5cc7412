//! A sensor that goes away and comes back at the same port while the hub and its consumers run on.

mod stage;

use stage::{INT, Stage, TERM, is_class, is_there, number, sequence};

#[test]
fn a_sensor_that_goes_and_comes_back() {
    let stage = Stage::new();
    let simulator = stage.simulator(&["front"], &["--seed=22"]);
    let hub = stage.hub(&[stage.link("front")]);
    let mut consumer = stage.echo(&["front/scan", "front/status"]);
    consumer.await_lines(10, "a scan", is_class("scan"));
    assert_eq!(simulator.end(INT).code, Some(0));
    assert!(!is_there(&stage.path("front")));
    let absent = consumer.await_line("absent", |line| line["state"] == "absent");
    assert!(absent["last_error"].as_str().is_some_and(|error| error.contains("front")), "{absent}");
    let _simulator = stage.simulator(&["front"], &["--seed=23"]);
    consumer.await_line("streaming", |line| line["state"] == "streaming");
    consumer.await_lines(10, "a scan", is_class("scan"));
    let info = stage.info("front");
    assert_eq!(number(&info["counters"], "reconnects"), 1, "{info}");
    assert_eq!(info["last_error"], "");
    let outcome = consumer.end(INT);
    // One hub, one life: the numbers go on.
    sequence(&outcome.of_class("scan"), "topic_seq");
    assert_eq!(hub.end(TERM).code, Some(0));
}
