//! Tests of a hub that is killed or ended and started again while its subscribers run: the subscribers report this and
//! continue on their own, and the new hub adopts the sensor's stream.

use std::collections::{BTreeMap, HashSet};

use crate::testkit::{
    INT, KILL, MEASURED_VALUES, TERM, TestEnv, bytes_of, contiguous_numbers, hash, is_class, number,
};
use serde_json::Value;

#[test]
fn subscribers_survive_several_hub_restarts() {
    // If a hub gets no CPU time, its topics become stale. But clients report `hub_gone` only for a hub that has ended.
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=21"]);
    let link = [env.lms_link("front")];
    let mut hub = env.hub(&link);
    let mut telegrams = env.echo(&["front/telegram"]);
    let mut scans = env.echo(&["front/scan", "front/status"]);
    for how in [KILL, KILL, TERM, KILL] {
        telegrams.await_lines(25, "a measured telegram", |line| line["command"] == MEASURED_VALUES);
        scans.await_lines(25, "a scan", is_class("scan"));
        let code = hub.end(how).exit_code;
        assert_eq!(code, (how == TERM).then_some(0));
        for subscriber in [&mut telegrams, &mut scans] {
            subscriber.await_line("hub_gone", |line| line["kind"] == "hub_gone");
        }
        hub = env.hub(&link);
        for subscriber in [&mut telegrams, &mut scans] {
            subscriber.await_line("hub_back", |line| line["kind"] == "hub_back");
        }
    }
    telegrams.await_lines(25, "a measured telegram", |line| line["command"] == MEASURED_VALUES);
    scans.await_lines(25, "a scan", is_class("scan"));
    let info = env.info("front");
    let (telegrams, scans) = (telegrams.end(INT), scans.end(INT));
    assert_eq!((telegrams.exit_code, scans.exit_code), (Some(0), Some(0)), "{}", telegrams.stderr);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));

    let notices = telegrams.of_class("notice");
    let kinds = notices.iter().map(|line| line["kind"].as_str().unwrap_or_default());
    // On a busy machine, a hub takes long to start, so the client may also report stale topics.
    let changes: Vec<_> = kinds.filter(|kind| *kind != "stale").collect();
    assert_eq!(changes, ["hub_gone", "hub_back"].repeat(4));
    let truth = env.truth("front");
    let sent: HashSet<_> = truth.iter().map(|sent| &sent.hash).collect();
    let runs = split_by_boot(telegrams.of_class("telegram"));
    assert_eq!(runs.len(), 5);
    for run in &runs {
        // A telegram that consists of parts of two others could have a right checksum by chance, but the simulator
        // never sent it.
        assert!(run.iter().all(|line| sent.contains(&hash(&bytes_of(line)))), "never sent");
        contiguous_numbers(run, "seq");
        contiguous_numbers(run, "topic_seq");
    }
    // A subscriber that waits for a hub receives all samples of the hub from the first one on.
    assert!(runs[1..].iter().all(|run| number(&run[0], "topic_seq") == 0));
    let runs = split_by_boot(scans.of_class("scan"));
    assert!(runs.len() == 5 && runs[1..].iter().all(|run| number(&run[0], "topic_seq") == 0));
    for summary in telegrams.of_class("summary").iter().chain(&scans.of_class("summary")) {
        assert_eq!(summary["missed"], 0);
    }

    // The first hub found the scanner and set its baud rate. The last hub uses this rate, too.
    assert_eq!((&info["state"], &info["baud"]), (&"streaming".into(), &500_000.into()));
    let states: Vec<_> = scans.of_class("status").iter().map(|line| line["state"].clone()).collect();
    let first = states.iter().position(|state| state == "streaming").expect("an intact scan");
    let later: HashSet<_> = states[first..].iter().filter_map(Value::as_str).collect();
    // A test in virtual time checks that a new hub does not interrupt a stream. Here, the simulator may be so late that
    // the hub detects a silence, and other states may occur, too.
    assert!(later.is_superset(&HashSet::from(["probing", "streaming"])), "{later:?}");
    assert_eq!(env.simulator_totals("front").1, 0, "EEPROM");
}

/// Groups `lines` by the run of the hub that published them. The order of the runs and of their lines stays the same.
fn split_by_boot(lines: Vec<Value>) -> Vec<Vec<Value>> {
    let mut order = Vec::new();
    let mut runs = BTreeMap::<String, Vec<Value>>::new();
    for line in lines {
        let boot = line["boot"].as_str().unwrap_or_default().to_owned();
        if !runs.contains_key(&boot) {
            order.push(boot.clone());
        }
        runs.entry(boot).or_default().push(line);
    }
    order.iter().filter_map(|boot| runs.remove(boot)).collect()
}
