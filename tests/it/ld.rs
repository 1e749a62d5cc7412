//! A hub on simulated scanners of LDROBOT: what they measure is published in scans of an even grid, and their packets as
//! they came. They have no EEPROM and are never spoken to.

use serde_json::Value;

use crate::testkit::{INT, Program, TERM, TestEnv, hash, is_class, is_there, number, sequence};

/// Bytes of a packet of twelve points.
const PACKET: usize = 47;
/// What its packets begin with.
const BEGIN: [u8; 2] = [0x54, 0x2C];

fn ld19(env: &TestEnv) -> Program {
    env.simulator(&["front"], &["--family=ld", "--model=ld19", "--world=room", "--seed=7"])
}

/// A hub of one link with these settings.
fn hub(env: &TestEnv, settings: &[&str]) -> Program {
    let set = ["family=ld"].iter().chain(settings).map(|setting| format!("--set=link.front.{setting}"));
    env.hub(&[vec![env.link("front")], set.collect()].concat())
}

/// Whether a line of class `scan` is of a whole turn in so many beams.
fn check_scan(scan: &Value, beams: usize) {
    let step = -360.0 / beams as f64;
    let values = |key: &str| scan[key].as_array().unwrap_or_else(|| panic!("no {key}: {scan}"));
    let of = |key: &str| scan[key].as_f64().unwrap_or_else(|| panic!("no {key}: {scan}"));
    assert_eq!((&scan["family"], number(scan, "unit_um")), (&"ld".into(), 1000));
    assert_eq!(number(scan, "count"), beams as u64);
    assert_eq!(of("first_angle_deg"), 0.0);
    assert!((of("step_deg") - step).abs() < 1e-6, "{}", of("step_deg"));
    let (ranges, levels, angles) = (values("ranges"), values("intensities"), values("angles_deg"));
    assert_eq!([ranges.len(), levels.len(), angles.len()], [beams; 3]);
    let mut exact = 0;
    for (beam, (angle, range)) in angles.iter().zip(ranges).enumerate() {
        assert_eq!(angle.is_null(), range.is_null(), "beam {beam}");
        let Some(angle) = angle.as_f64() else { continue };
        // An angle is in its own bin, and bin 0 lies on both sides of the scanner's zero.
        let off = (angle - step * beam as f64 + 180.0).rem_euclid(360.0) - 180.0;
        assert!(off.abs() <= step.abs() / 2.0 + 1e-3, "beam {beam} at {angle}");
        exact += usize::from(off.abs() > 1e-3);
    }
    assert!(exact > beams / 4, "{exact} of {beams} angles are not those of the grid");
}

#[test]
fn a_scanner_that_turns_is_published_like_any_other() {
    let env = TestEnv::new();
    let hub = hub(&env, &["model=ld19"]);
    let mut scans = env.echo(&["front/scan"]);
    let mut zones = env.echo(&["front/zones"]);
    let mut raw = env.start(&["echo", "--raw", "front/telegram"]);
    let simulator = ld19(&env);
    scans.await_lines(20, "a scan", is_class("scan"));
    zones.await_line("a verdict", |line| is_class("zones")(line) && line["verdict"] != "unknown");
    raw.await_bytes(100 * PACKET);
    let info = env.await_info("front", |info| info["hz"].as_f64().is_some_and(|hz| hz > 8.0));
    let facts = ["state", "type", "baud", "unit_mm", "angle_deg", "step_deg", "last_error"];
    let expected: [Value; 7] =
        ["streaming".into(), "LD19".into(), 230_400.into(), 1.into(), 360.into(), 0.8.into(), "".into()];
    assert_eq!(facts.map(|key| info[key].clone()), expected, "{info}");

    let scans = scans.end(INT).of_class("scan");
    sequence(&scans, "topic_seq");
    for scan in &scans {
        check_scan(scan, 450);
    }
    let outcome = raw.end(INT);
    let packets: Vec<&[u8]> = outcome.out.chunks(PACKET).collect();
    assert!(packets.iter().all(|packet| packet.len() == PACKET && packet.starts_with(&BEGIN)));
    assert_eq!(hub.end(TERM).code, Some(0));
    assert_eq!(simulator.end(TERM).code, Some(0));
    let truth = env.truth("front");
    let arrived: Vec<String> = packets.into_iter().map(hash).collect();
    let begin = truth.iter().position(|sent| sent.hash == arrived[0]).expect("it was sent");
    let sent = truth[begin..].iter().map(|sent| &sent.hash).take(arrived.len());
    assert!(sent.eq(&arrived), "not what it sent");
}

#[test]
fn a_model_is_found_out() {
    let env = TestEnv::new();
    let _simulator = ld19(&env);
    let _hub = hub(&env, &[]);
    let info = env.await_info("front", |info| info["state"] == "streaming" && info["type"] == "LD19");
    assert_eq!((number(&info, "baud"), &info["last_error"]), (230_400, &"".into()), "{info}");
    check_scan(&env.echo(&["front/scan"]).await_line("a scan", is_class("scan")), 450);
}

#[test]
fn beams_are_as_many_as_are_asked_for() {
    let env = TestEnv::new();
    let _simulator = ld19(&env);
    let _hub = hub(&env, &["model=ld19", "beams=300"]);
    for scan in env.echo(&["front/scan"]).await_lines(5, "a scan", is_class("scan")) {
        check_scan(&scan, 300);
        assert!(number(&scan, "collapsed") > 0, "450 points in 300 beams: {scan}");
    }
}

#[test]
fn a_scanner_that_goes_and_comes_back() {
    let env = TestEnv::new();
    let simulator = ld19(&env);
    let hub = hub(&env, &["model=ld19"]);
    let mut consumer = env.echo(&["front/scan", "front/status"]);
    consumer.await_lines(5, "a scan", is_class("scan"));
    env.kill_simulator(simulator, "front");
    assert!(!is_there(&env.path("front")));
    consumer.await_line("absent", |line| line["state"] == "absent");
    let _simulator = ld19(&env);
    consumer.await_line("streaming", |line| line["state"] == "streaming");
    for scan in consumer.await_lines(5, "a scan", is_class("scan")) {
        check_scan(&scan, 450);
    }
    let info = env.info("front");
    assert_eq!((number(&info["counters"], "reconnects"), &info["last_error"]), (1, &"".into()), "{info}");
    // One hub, one life: the numbers go on.
    sequence(&consumer.end(INT).of_class("scan"), "topic_seq");
    assert_eq!(hub.end(TERM).code, Some(0));
}
