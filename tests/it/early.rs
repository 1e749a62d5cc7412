//! The topic `early`, from a line to a consumer: a warning comes before its telegram is complete, and either the zones of the
//! same number confirm it or it is taken back; it is there only while somebody follows it.

use std::collections::BTreeMap;

use crate::testkit::{INT, Outcome, TERM, TestEnv, hold_in_time, is_class, number};
use serde_json::Value;

/// A post in the smaller circle, to the right: in the first third of each telegram.
const POST: &str = "[noise]\nerrors = 0\n[[thing]]\nradius_mm = 60\npose = [460, 200]\n\
    [[thing]]\nline = [[-3000, -1000], [3000, -1000], [3000, 4000], [-3000, 4000], [-3000, -1000]]\n";

/// What `front/early` and `front/zones` say of a line with `faults`, until so many `lines` like `wanted` were heard.
fn heard(env: &TestEnv, faults: &[&str], lines: usize, wanted: impl Fn(&Value) -> bool) -> Outcome {
    let world = format!("--world={}", env.file("post.toml", POST));
    let flags = [&["--seed=28", "--baud=500000", &world], faults].concat();
    let (hub, simulator) = (env.hub(&[env.link("front")]), env.simulator(&["front"], &flags));
    let mut echo = env.echo(&["front/early", "front/zones"]);
    echo.await_lines(lines, "warnings", wanted);
    // The zones of the last one.
    echo.await_lines(3, "zones", is_class("zones"));
    let outcome = echo.end(INT);
    assert_eq!(number(&env.info("front")["counters"], "loan_failed"), 0);
    assert_eq!((hub.end(TERM).code, simulator.end(TERM).code), (Some(0), Some(0)));
    outcome
}

/// Checks that each warning of `outcome` was confirmed or withdrawn; how many were.
fn judge(outcome: &Outcome) -> (usize, usize) {
    let mut zones: BTreeMap<u64, Value> = BTreeMap::new();
    // A silence has the number of the scan before it, or none; what came too late is not said.
    let heard = |line: &Value| line["seq"].is_u64() && line["stale"] != true;
    for line in outcome.of_class("zones").into_iter().filter(heard) {
        zones.entry(number(&line, "seq")).or_insert(line);
    }
    let (&first, &last) = (zones.keys().next().expect("zones"), zones.keys().last().expect("zones"));
    let mut open: BTreeMap<u64, Value> = BTreeMap::new();
    let (mut confirmed, mut withdrawn) = (0, 0);
    for line in outcome.of_class("early") {
        let seq = number(&line, "seq");
        assert!(line["verdict"] == "stop" || line["verdict"] == "slow", "{line}");
        assert!(number(&line, "bytes_seen") < 732 && number(&line, "beams_seen") < 361, "{line}");
        if line["withdrawn"] == true {
            assert!(open.remove(&seq).is_some(), "nothing to take back: {line}");
            withdrawn += 1;
        } else {
            open.insert(seq, line);
        }
    }
    for (seq, line) in open.range(first..=last) {
        let of_scan = zones.get(seq).unwrap_or_else(|| panic!("no zones: {line}"));
        assert!(of_scan["verdict"] == "stop" || of_scan["verdict"] == line["verdict"], "{line} {of_scan}");
        confirmed += 1;
    }
    (confirmed, withdrawn)
}

#[test]
fn warnings_come_before_the_telegram_ends_and_its_zones_confirm_them() {
    hold_in_time(|| {
        let env = TestEnv::in_time();
        let outcome = heard(&env, &[], 20, is_class("early"));
        let (confirmed, withdrawn) = judge(&outcome);
        assert!(confirmed >= 18 && withdrawn == 0, "{confirmed} and {withdrawn}");
        // The post is in the first third, and the telegram is read in three.
        let first = |line: &&Value| number(line, "bytes_seen") < 500;
        let early = outcome.of_class("early");
        assert!(2 * early.iter().filter(first).count() > early.len(), "{outcome}");
    });
}

#[test]
fn a_warning_of_a_telegram_that_is_damaged_is_taken_back() {
    let env = TestEnv::new();
    let outcome = heard(&env, &["--fault=truncate=0.3"], 5, |line| line["withdrawn"] == true);
    let (confirmed, withdrawn) = judge(&outcome);
    assert!(confirmed > 0 && withdrawn >= 5, "{confirmed} and {withdrawn}");
}
