//! Tests of the topic `motion`, from the line to its subscribers: the hub computes it only while it has subscribers,
//! keys of a link configure it, and the background method `moving` uses it.

use crate::testkit::{INT, TERM, TestEnv, checked_topic_seqs, is_class, number};
use serde_json::Value;

const STREAM_FLAGS: [&str; 2] = ["--seed=51", "--baud=500000"];

#[test]
fn standing_robot_has_no_motion_and_learns_background() {
    let env = TestEnv::new();
    let set = ["--set=motion.max_step=0.3", "--set=link.rear.background.method=moving"].map(str::to_owned);
    let hub = env.hub(&[&[env.link("front"), env.link("rear")], &set[..]].concat());
    let simulator = env.simulator(&["front", "rear"], &STREAM_FLAGS);
    env.await_info("front", |info| info["state"] == "streaming");
    // The topic exists before it has a subscriber.
    let topics = env.run(&["list", "--json"]);
    let topic = topics.lines().into_iter().find(|line| line["topic"] == "motion");
    let topic = topic.unwrap_or_else(|| panic!("{topics}"));
    assert_eq!((&topic["payload"], number(&topic, "subscribers")), (&"scanhub.Motion.v2".into(), 0));
    let mut front = env.echo(&["front/scan", "front/motion"]);
    let mut rear = env.echo(&["rear/foreground", "rear/background"]);
    let found = front.await_lines(30, "motion", is_class("motion"));
    assert_eq!((&found[0]["method"], found[0]["dx_m"].is_null()), (&"first".into(), true));
    for line in &found[1..] {
        let [dx, dy, x] = ["dx_m", "dy_m", "x_m"].map(|key| line[key].as_f64().unwrap_or(1.0));
        assert!(dx.hypot(dy) < 0.02 && x.abs() < 0.05, "{line}");
        for key in ["covariance", "pose_covariance"] {
            assert!(line[key].as_array().is_some_and(|numbers| numbers.len() == 9), "{line}");
        }
        assert!(["beams", "points", "lines", "both"].contains(&line["method"].as_str().unwrap()), "{line}");
    }
    rear.await_lines(20, "a foreground", is_class("foreground"));
    let known = |line: &Value| line["class"] == "background" && number(line, "known_beams") > 0;
    rear.await_line("a known background", known);
    let refused = env.run(&["background", "rear", "load", "none.json"]);
    assert_ne!(refused.exit_code, Some(0), "{refused}");
    let outcome = front.end(INT);
    let (of_motion, of_scans) = (outcome.of_class("motion"), outcome.of_class("scan"));
    // The motion of each scan has the same `seq` as the scan.
    let seqs = |lines: &[Value]| lines.iter().map(|line| number(line, "seq")).collect::<Vec<_>>();
    let (of_scans, of_motion) = (seqs(&of_scans), seqs(&of_motion));
    assert!(of_motion.iter().filter(|seq| of_scans.contains(seq)).count() > 20, "{outcome}");
    checked_topic_seqs(&outcome, "scan");
    checked_topic_seqs(&outcome, "motion");
    drop(rear);
    assert_eq!(number(&env.info("front")["counters"], "loan_failed"), 0);
    assert_eq!((hub.end(TERM).exit_code, simulator.end(TERM).exit_code), (Some(0), Some(0)));
}
