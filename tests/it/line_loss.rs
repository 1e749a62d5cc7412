//! Line that loses bytes. The hub and its clients report the share of the stream that is lost, and this share agrees
//! with the log of the simulator.

use crate::testkit::{INT, TERM, TestEnv, is_class, number, wait_until};

/// Rate and mean length of the bursts of lost bytes that the paper measured on a line.
const BURST_FAULTS: &str = "--fault=loss=0.00135,burst=1.89";

#[test]
fn line_loss_is_reported_by_all_programs() {
    let env = TestEnv::new();
    let flags = ["--baud=500000", "--state=streaming", "--seed=5", BURST_FAULTS];
    let simulator = env.simulator(&["front"], &flags);
    let hub = env.hub(&[env.link("front")]);
    let mut subscriber = env.start(&["hz", "--json", "front/scan"]);
    let leds = env.start(&["leds", "front", "--json"]);
    env.await_info("front", |info| number(&info["counters"], "due_on_line") > 30);
    let begin = env.info("front");
    let first_sent = env.truth("front").len();
    let mut statuses = env.echo(&["front/status"]);
    // A scan is due every 26.7 ms, so 400 scans take more than ten seconds on any machine.
    for due in [200, 400] {
        let due = number(&begin["counters"], "due_on_line") + due;
        statuses.await_line("scans that were due", |line| {
            is_class("status")(line) && number(&line["counters"], "due_on_line") > due
        });
    }
    let end = env.info("front");
    // Scans that are missing count as lost only a second later, so the shares agree only approximately.
    let sent = &env.truth("front")[first_sent..];
    let damaged = sent.iter().filter(|sent| sent.fault.is_some()).count() as f64;
    let grown = |name: &str| number(&end["counters"], name) as f64 - number(&begin["counters"], name) as f64;
    let (lost, due) = (grown("lost_on_line"), grown("due_on_line"));
    let (share, truth) = (lost / due, damaged / sent.len() as f64);
    println!("{lost} of {due} lost, {damaged} of {} in truth", sent.len());
    assert!(due > 350.0 && (share - truth).abs() < 0.1, "{share} instead of {truth}: {end}");
    let damaged_share = end["damaged"].as_f64().unwrap_or_default();
    assert!((0.3..0.55).contains(&damaged_share), "{end}");
    assert_eq!(number(&end, "lost_on_line"), number(&end["counters"], "lost_on_line"));

    let text = env.run(&["info", "front"]).to_string();
    assert!(text.contains("of the bytes damaged") && text.contains("of the scans lost in 10 s"), "{text}");
    let outcome = env.run(&["doctor", &env.path_argument("front"), "--json"]);
    let checks = outcome.of_class("check");
    let check = checks.iter().find(|check| check["name"] == "line-loss").expect("doctor checks the line");
    assert_eq!(check["state"], "warning", "{check}");
    let found = check["finding"].as_str().unwrap_or_default();
    assert!(found.contains(" % lost on the line; "), "{check}");

    let line = subscriber.await_line("a rate with losses", |line| {
        line["class"] == "hz" && line["lost_on_line"].as_u64() > Some(50)
    });
    assert!(line["missed"] == 0 && line["damaged"].as_f64() > Some(0.3), "{line}");
    let outcome = subscriber.end(INT);
    let [summary] = &outcome.of_class("summary")[..] else { panic!("{outcome}") };
    assert!(summary["lost_on_line"].as_u64() > Some(50), "{summary}");
    assert!((0.3..0.55).contains(&summary["damaged"].as_f64().unwrap_or_default()), "{summary}");
    let outcome = leds.end(INT);
    let has_reason = |line: &serde_json::Value| {
        line["reason"].as_str().is_some_and(|reason| reason.ends_with(" % lost on the line"))
    };
    assert!(outcome.of_class("leds").iter().any(has_reason), "{outcome}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(INT).exit_code, Some(0));
}

#[test]
fn healthy_line_is_reported_as_lossless_at_once() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--baud=9600", "--seed=5"]);
    let hub = env.hub(&[env.link("front")]);
    let info = env.await_info("front", |info| number(&info["counters"], "due_on_line") > 60);
    let outcome = env.run(&["doctor", &env.path_argument("front"), "--json"]);
    let checks = outcome.of_class("check");
    let check = checks.iter().find(|check| check["name"] == "line-loss").expect("doctor checks the line");
    // On a busy machine, a simulated scanner may not run for a while. The hub then counts scans as lost.
    let lost = number(&env.info("front")["counters"], "lost_on_line");
    assert!(check["state"] == "ok" || lost > 0, "{check}");
    assert_eq!(info["damaged"], 0.0, "{info}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(INT).exit_code, Some(0));
}

/// On this line, some replies arrive intact, because they are short, but hardly any scan does.
#[test]
fn line_that_damages_nearly_all_scans_is_reported() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=5", "--fault=loss=0.02,burst=1"]);
    let hub = env.hub(&[format!("{},family=lms", env.link("front"))]);
    let error = |info: &serde_json::Value| info["last_error"].as_str().unwrap_or_default().to_owned();
    let info = env.await_info("front", |info| error(info).contains("few telegrams of the "));
    assert!(
        error(&info).ends_with("are intact: check the cable, its ground and termination, and the adapter"),
        "{info}"
    );
    let is_found = || {
        let outcome = env.run(&["doctor", &env.path_argument("front"), "--json"]);
        let checks = outcome.of_class("check");
        let check = checks.iter().find(|check| check["name"] == "line-loss").expect("doctor checks the line");
        check["state"] == "failed" && check["finding"].to_string().contains("were in no intact telegram")
    };
    wait_until("doctor reports the damage while the hub searches for the scanner", is_found);
    let info_reports =
        || env.run(&["info", "front"]).to_string().contains("bytes were in no intact telegram");
    wait_until("info reports the damage while the hub searches for the scanner", info_reports);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}
