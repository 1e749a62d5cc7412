//! Topic `lines`, from the line to subscribers, for every scanner family and with the keys of a link. The hub detects
//! lines only while the topic has a subscriber.

use crate::testkit::{INT, TERM, TestEnv, checked_topic_seqs, is_class, number};
use serde_json::Value;

const STREAM_FLAGS: [&str; 2] = ["--seed=51", "--baud=500000"];

fn list<'a>(line: &'a Value, key: &str) -> &'a [Value] {
    line[key].as_array().unwrap_or_else(|| panic!("no {key}: {line}"))
}

#[test]
fn lines_are_published_with_settings_of_each_link() {
    let env = TestEnv::new();
    let set = ["--set=lines.refine=true", "--set=link.rear.lines.max=2"].map(str::to_owned);
    let hub = env.hub(&[&[env.link("front"), env.link("rear")], &set[..]].concat());
    let simulator = env.simulator(&["front", "rear"], &STREAM_FLAGS);
    env.await_info("front", |info| info["state"] == "streaming");
    // The topic exists before it has a subscriber.
    let topics = env.run(&["list", "--json"]);
    let topic = |line: &&Value| line["topic"] == "lines" && line["sensor"] == "front";
    let topic = topics.lines().iter().find(topic).cloned().unwrap_or_else(|| panic!("{topics}"));
    assert_eq!((&topic["payload"], number(&topic, "subscribers")), (&"scanhub.Lines.v2".into(), 0));
    let mut subscribers =
        [&["front/scan", "front/lines"], &["rear/scan", "rear/lines"]].map(|topics| env.echo(topics));
    let found =
        subscribers.each_mut().map(|subscriber| subscriber.await_lines(20, "lines", is_class("lines")));
    for line in &found[0] {
        assert!(number(line, "points") > 200 && line["overflow"] == false, "{line}");
        assert!(list(line, "lines").len() > 2 && !list(line, "corners").is_empty(), "{line}");
        let noise_m = line["noise_m"].as_f64().unwrap_or_default();
        assert!((0.001..0.03).contains(&noise_m), "{line}");
    }
    assert!(found[1].iter().all(|line| list(line, "lines").len() <= 2 && line["overflow"] == true));
    for subscriber in subscribers {
        let outcome = subscriber.end(INT);
        let seqs = |class| {
            let lines = outcome.of_class(class);
            lines.iter().map(|line| number(line, "seq")).collect::<Vec<_>>()
        };
        // The lines of a scan have the same `seq` as the scan.
        let (of_lines, of_scans) = (seqs("lines"), seqs("scan"));
        assert!(of_lines.iter().filter(|seq| of_scans.contains(seq)).count() > 10, "{outcome}");
        checked_topic_seqs(&outcome, "scan");
        checked_topic_seqs(&outcome, "lines");
    }
    assert_eq!(number(&env.info("front")["counters"], "loan_failed"), 0);
    assert_eq!((hub.end(TERM).exit_code, simulator.end(TERM).exit_code), (Some(0), Some(0)));
}

#[test]
fn rotating_scanner_has_line_features() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--family=ld", "--model=ld19", "--world=room", "--seed=7"]);
    let _hub = env.hub(&[env.link("front"), "--set=link.front.family=ld".to_owned()]);
    let mut echo = env.echo(&["front/lines"]);
    let found = echo.await_lines(20, "lines", is_class("lines"));
    assert!(found.iter().all(|line| list(line, "lines").len() > 2), "{found:?}");
}
