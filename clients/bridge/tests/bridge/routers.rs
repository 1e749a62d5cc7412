//! Tests with routers between the machines: two in a row, and one that is killed and restarted.

use rustix::process::Signal;
use serde_json::Value;

use crate::testkit::{INT, KILL, TestEnv, number, wall_ns};
use crate::{NO_FLAGS, address, assert_counters_agree, bridge, router, wait_until_linked};

fn is_link(line: &Value, state: &str) -> bool {
    line["class"] == "bridge_link" && line["state"] == state
}

#[test]
fn losses_of_a_restarted_router_are_all_counted() {
    let (robot, desk, first, second) = (TestEnv::new(), TestEnv::new(), TestEnv::new(), TestEnv::new());
    let (near, far) = (address("tcp"), address("tcp"));
    let mut killed = router(&first, &near, &[]);
    let _second = router(&second, &far, &[&near]);
    let _sensor = robot.simulator(&["front"], NO_FLAGS);
    let (mut there, id) = bridge(&robot, &["--connect", &near]);
    let (mut here, _) = bridge(&desk, &["--connect", &far, "--publish", &format!("--name=robot1={id}")]);
    wait_until_linked(&mut there);
    wait_until_linked(&mut here);
    let _hub = robot.hub(&[robot.link("front")]);
    here.await_line("a sensor", |line| line["kind"] == "published");
    let mut local = robot.echo(&["front/scan"]);
    let mut remote = desk.echo(&["robot1.front/zones"]);
    for _ in 0..3 {
        // Ignore lines that were printed earlier but not read yet.
        let is_zones = |line: &Value, since_ns: u64| {
            let is_known = line["class"] == "zones" && line["stale"] != true && line["verdict"] != "unknown";
            is_known && number(line, "wall_ns") >= since_ns
        };
        let started = wall_ns();
        remote.await_line("zones", |line| is_zones(line, started));
        killed.end(KILL);
        there.await_line("the end of the link", |line| is_link(line, "down"));
        killed = router(&first, &near, &[]);
        there.await_line("the link", |line| is_link(line, "up"));
        let since = wall_ns();
        remote.await_line("zones", |line| is_zones(line, since));
    }
    local.await_line("a scan", |line| line["class"] == "scan");
    let local = local.end(INT);
    assert_eq!(local.of_class("summary")[0]["missed"], 0, "subscribers on the hub's machine: {local}");
    let sent = there.end(INT);
    // The last announcement passes through two routers.
    let announced = announcement_count(&sent);
    here.await_line("the last announcement", |line| {
        line["class"] == "bridge"
            && line["topic"] == "announce"
            && line["received"].as_u64() >= Some(1)
            && line["received"]
                .as_u64()
                .zip(line["lost"].as_u64())
                .is_some_and(|(received, lost)| received + lost >= announced)
    });
    assert_counters_agree(&sent, &here.end(INT));
}

/// The link to a stopped router ends after Zenoh's lease, even while a sample waits until the link has room for it.
#[test]
fn link_to_a_stopped_router_ends_and_is_restored() {
    let (robot, desk) = (TestEnv::new(), TestEnv::new());
    let _sensor = robot.simulator(&["front"], NO_FLAGS);
    let at = address("tcp");
    let (mut here, _) = bridge(&desk, &["--listen", &at, "--publish"]);
    let (mut there, _) = bridge(&robot, &["--connect", &at, "--topic=*/*"]);
    wait_until_linked(&mut there);
    let _hub = robot.hub(&[robot.link("front")]);
    let sensor = here.await_line("a sensor", |line| line["kind"] == "published")["sensor"].clone();
    here.signal(Signal::STOP);
    there.await_line("the end of the link", |line| is_link(line, "down"));
    here.signal(Signal::CONT);
    there.await_line("the link", |line| is_link(line, "up"));
    let mut zones = desk.echo(&[&format!("{}/zones", sensor.as_str().unwrap_or_default())]);
    let started = wall_ns();
    zones.await_line("zones after that", |line| {
        line["class"] == "zones" && number(line, "wall_ns") >= started
    });
    assert_eq!(there.end(INT).exit_code, Some(0));
}

/// Returns the number of announcements that were sent.
fn announcement_count(sent: &crate::testkit::Outcome) -> u64 {
    crate::final_counters(sent, &["sent"])
        .iter()
        .find(|(name, _)| name.ends_with("/announce"))
        .map_or(0, |(_, row)| row[0])
}
