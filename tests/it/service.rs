//! Tests of the hub as a service. The hub reports when it is ready, and notifies the watchdog only while its links
//! work. It stores its ports in the service manager, so that no data is lost that arrives after a hub was killed and
//! before the next one runs.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use crate::testkit::{
    INT, KILL, MEASURED_VALUES, Program, TERM, TestEnv, bytes_of, hash, is_class, number, wait_until,
};
use rustix::process::Signal;
use serde_json::Value;

const KILL_COUNT: usize = 6;

#[test]
fn restart_after_kill_loses_only_the_partial_telegram() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    let mut supervisor = env.supervisor();
    let flags = [env.link("front")];
    let mut hub = env.service(&mut supervisor, &flags, None).ready();
    supervisor.wait_for_message("FDNAME=front");
    supervisor.wait_for_message("READY=1");
    let mut telegrams = env.echo(&["front/telegram"]);
    let mut boots = HashSet::new();
    for _ in 0..KILL_COUNT {
        await_next_run(&mut telegrams, &mut boots);
        kill_between_telegrams(&env, hub, &simulator, &mut telegrams);
        hub = env.service(&mut supervisor, &flags, None).ready();
        supervisor.wait_for_message("READY=1");
    }
    await_next_run(&mut telegrams, &mut boots);
    // Now only the service manager has the line open. The line must still be locked.
    kill_between_telegrams(&env, hub, &simulator, &mut telegrams);
    let elsewhere = TestEnv::new();
    let other = elsewhere.hub(&flags);
    assert!(
        other.has_printed(|line| line["waiting"] == serde_json::json!(["front"])),
        "the program found the line free"
    );
    assert_eq!(other.end(TERM).exit_code, Some(0));
    hub = env.service(&mut supervisor, &flags, None).ready();
    await_next_run(&mut telegrams, &mut boots);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    supervisor.wait_for_message("STOPPING=1");
    let got = telegrams.end(INT);
    assert_eq!(simulator.end(TERM).exit_code, Some(0));

    let lines = got.of_class("telegram");
    let mut runs = HashMap::<&str, Vec<_>>::new();
    for line in &lines {
        runs.entry(line["boot"].as_str().unwrap_or_default()).or_default().push(line.clone());
    }
    assert_eq!(runs.len(), KILL_COUNT + 2);
    // On a busy machine, the client may miss samples, but it reports how many.
    let notices = got.of_class("notice");
    let notices = notices.iter().filter(|line| line["kind"] == "missed");
    let missed: u64 = notices.map(|line| number(line, "missed")).sum();
    let gaps = |run: &Vec<Value>| {
        let numbers: Vec<u64> = run.iter().map(|line| number(line, "seq")).collect();
        assert!(numbers.is_sorted_by(|one, next| one < next), "out of order: {numbers:?}");
        numbers[numbers.len() - 1] - numbers[0] + 1 - numbers.len() as u64
    };
    assert!(runs.values().map(gaps).sum::<u64>() <= missed, "a gap that was not reported: {got}");
    let received: Vec<_> = lines.iter().filter(|line| line["command"] == MEASURED_VALUES).collect();
    let received: Vec<String> = received.iter().map(|line| hash(&bytes_of(line))).collect();
    let truth: Vec<_> = env.truth("front").into_iter().filter(|sent| sent.is_intact_scan()).collect();
    let at =
        |hash: &String| truth.iter().position(|sent| &sent.hash == hash).expect("a telegram that was sent");
    let span = &truth[at(&received[0])..=at(&received[received.len() - 1])];
    // A killed hub loses only one telegram, whose first bytes it had read.
    let last_of = |run: &Vec<Value>| {
        let last = run.iter().rfind(|line| line["command"] == MEASURED_VALUES).expect("a measured telegram");
        at(&hash(&bytes_of(last)))
    };
    let cut: HashSet<usize> = runs.values().map(|run| last_of(run) + 1).collect();
    let lost: Vec<usize> = span.iter().map(|sent| at(&sent.hash)).collect();
    let lost: Vec<usize> = lost.into_iter().filter(|&sent| !received.contains(&truth[sent].hash)).collect();
    let unexplained = lost.iter().filter(|sent| !cut.contains(sent)).count() as u64;
    assert!(unexplained <= missed, "{lost:?} lost, cut {cut:?}, {missed} missed by the client");
    let mut sorted: Vec<_> = received.iter().map(at).collect();
    assert!(sorted.is_sorted(), "out of order");
    sorted.dedup();
    assert_eq!(sorted.len(), received.len(), "a telegram was received twice");
    println!("{} of {} telegrams lost by {} kills", lost.len(), span.len(), KILL_COUNT + 1);
    assert_eq!(env.simulator_totals("front").1, 0, "EEPROM writes");
}

/// Stops `simulator` until `telegrams` has printed everything that the line has carried, kills `hub`, and lets the
/// simulator continue. A part of the last telegram may still be in the simulator, because the line had no room for it.
fn kill_between_telegrams(env: &TestEnv, hub: Program, simulator: &Program, telegrams: &mut Program) {
    simulator.signal(Signal::STOP);
    let sent = env.truth("front");
    let last = &sent.iter().rev().filter(|sent| sent.is_intact_scan()).nth(1).expect("scans were sent").hash;
    wait_until("the last telegram is printed", || {
        telegrams.prints(|line| line["class"] == "telegram" && hash(&bytes_of(line)) == *last)
    });
    assert_eq!(hub.end(KILL).exit_code, None);
    simulator.signal(Signal::CONT);
}

/// Waits for telegrams of a run that is not in `boots`, and adds this run to `boots`. Skips lines of earlier runs,
/// which may still arrive.
fn await_next_run(telegrams: &mut Program, boots: &mut HashSet<String>) {
    let boot = |line: &Value| line["boot"].as_str().unwrap_or_default().to_owned();
    let is_new = |line: &Value| line["command"] == MEASURED_VALUES && !boots.contains(&boot(line));
    let lines = telegrams.await_lines(20, "a measured telegram", is_new);
    boots.insert(boot(&lines[0]));
}

#[test]
fn scans_resume_with_first_telegram_of_the_next_hub() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=8", "--baud=500000"]);
    let mut supervisor = env.supervisor();
    let flags = [env.link("front")];
    let hub = env.service(&mut supervisor, &flags, None).ready();
    supervisor.wait_for_message("FDNAME=front");
    let mut samples = env.echo(&["front/telegram", "front/scan"]);
    let scans = samples.await_lines(20, "a scan", is_class("scan"));
    let mut boot = scans[0]["boot"].clone();
    let (mut hub, mut tries) = (hub, 0);
    let (first, scan) = loop {
        assert_eq!(hub.end(KILL).exit_code, None);
        hub = env.service(&mut supervisor, &flags, None).ready();
        let of_next = |line: &Value| line["boot"] != boot;
        let first = samples
            .await_line("a measured telegram", |line| of_next(line) && line["command"] == MEASURED_VALUES);
        let scan = samples.await_line("its scan", |line| of_next(line) && line["class"] == "scan");
        // On a busy machine, a client may miss the first samples, and then reports this.
        let has_missed = samples.has_printed(|line| line["kind"] == "missed");
        if has_missed || scan["seq"] == first["seq"] {
            break (first, scan);
        }
        // On a busy machine, the identity that the previous hub saved may be too old (more than 3 s) when the next hub
        // starts. Then try again.
        assert!(tries < 10, "{scan} {first}");
        samples.await_lines(100, "a scan", |line| of_next(line) && line["class"] == "scan");
        (boot, tries) = (first["boot"].clone(), tries + 1);
    };
    assert!(
        number(&scan, "topic_seq") > 0 || number(&scan, "seq") <= number(&first, "seq"),
        "{scan} {first}"
    );
    assert_eq!(
        ["unit_um", "count"].map(|key| number(&scan, key)),
        ["unit_um", "count"].map(|key| number(&scans[0], key))
    );
    // The hub has the type from the saved identity. It requests the status again in any case.
    let info = env.await_info("front", |info| info["counters"]["telegrams"].as_u64() > Some(100));
    assert_eq!((&info["type"], &info["mode"]), (&"LMS200;301063;V02.30".into(), &1.into()), "{info}");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    drop(samples);
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
}

#[test]
fn hub_releases_stored_ports_it_cannot_use() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=6", "--baud=500000"]);
    let mut supervisor = env.supervisor();
    let hub = env.service(&mut supervisor, &[env.link("front")], None).ready();
    supervisor.wait_for_message("FDNAME=front");
    supervisor.wait_for_message("READY=1");
    assert_eq!(hub.end(KILL).exit_code, None);
    // The next hub has a link with another name, so no link of this hub has the stored port.
    let side = format!("--link=side={}", env.path_argument("side"));
    let hub = env.service(&mut supervisor, &[side], None).ready();
    supervisor.wait_for_message("FDSTOREREMOVE=1");
    supervisor.wait_for_message("STATUS=sensors: side");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    // The hub has closed the stored port, so the next hub can open this port.
    let hub = env.service(&mut supervisor, &[env.link("front")], None).ready();
    supervisor.wait_for_message("FDNAME=front");
    env.await_info("front", |info| info["state"] == "streaming");
    env.kill_port_simulator(simulator, "front");
    supervisor.wait_for_message("FDSTOREREMOVE=1");
    let info = env.await_info("front", |info| info["state"] == "absent");
    assert_eq!(number(&info["counters"], "reconnects"), 1);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

#[test]
fn renamed_link_takes_over_its_stored_port() {
    let env = TestEnv::new();
    let simulator = env.simulator(&["front"], &["--seed=7", "--baud=500000"]);
    let mut supervisor = env.supervisor();
    let hub = env.service(&mut supervisor, &[env.link("front")], None).ready();
    supervisor.wait_for_message("FDNAME=front");
    supervisor.wait_for_message("READY=1");
    assert_eq!(hub.end(KILL).exit_code, None);
    // The stored port is still locked. The hub cannot open the port again, but only take over the stored descriptor.
    let side = format!("--link=side={}", env.path_argument("front"));
    let hub = env.service(&mut supervisor, &[side], None).ready();
    supervisor.wait_for_message("FDSTOREREMOVE=1");
    supervisor.wait_for_message("FDNAME=side");
    supervisor.wait_for_message("READY=1");
    assert_eq!(hub.end(KILL).exit_code, None);
    // The link now has another port, so the hub releases the port that was stored under the link's name.
    let side = format!("--link=side={}", env.path_argument("nowhere"));
    let hub = env.service(&mut supervisor, &[side], None).ready();
    supervisor.wait_for_message("FDSTOREREMOVE=1");
    supervisor.wait_for_message("STATUS=sensors: side");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
}

#[test]
fn watchdog_is_fed_while_links_work() {
    let env = TestEnv::new();
    let mut supervisor = env.supervisor();
    // A link that waits for its missing port works, so the hub notifies the watchdog.
    let hub = env.service(&mut supervisor, &[env.link("front")], Some(Duration::from_secs(2))).ready();
    for _ in 0..3 {
        supervisor.wait_for_message("WATCHDOG=1");
    }
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    supervisor.wait_for_message("STOPPING=1");
}
