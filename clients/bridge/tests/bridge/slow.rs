//! Tests with a link that is too slow for the samples. Arriving samples are new, counters of replaced and lost samples
//! are exact, and no program on the robot waits.

use std::process::Command;

use rustix::process::Signal;
use serde_json::Value;

use crate::testkit::{INT, Outcome, Program, TERM, TestEnv, in_a_network, skip, succeeds, wait_until};
use crate::{
    CounterValues, NO_FLAGS, address, assert_counters_agree, bridge, current_counters, final_counters,
    wait_until_linked,
};

/// Limits the loopback to 0.5 Mbit/s, with the packet size of a network. Returns whether that succeeded.
fn limit_rate() -> bool {
    let run = |program: &str, words: &str| succeeds(Command::new(program).args(words.split(' ')));
    run("ip", "link set lo mtu 1500")
        && run("tc", "qdisc add dev lo root tbf rate 500kbit burst 5000 latency 200ms")
}

/// Waits until everything has arrived, and then ends the bridges. The hub must have exited, because only then does the
/// link become empty. A bridge that ends drops the samples that are still on its link. Returns the sender's output and
/// the number of lost samples.
fn end_after_delivery(mut sender: Program, mut receiver: Program) -> (Outcome, u64) {
    let mut received = || current_counters(&mut receiver, &["received", "lost"]);
    wait_until("all samples have arrived", || {
        let samples = |stats: CounterValues| -> Vec<(String, u64)> {
            let rows = stats.into_iter().filter(|(name, _)| !name.ends_with("/announce"));
            rows.map(|(name, row)| (name, row.iter().sum())).collect()
        };
        let sent = samples(current_counters(&mut sender, &["sent"]));
        sent.len() > 4 && sent == samples(received())
    });
    let sent = sender.end(INT);
    let counts = final_counters(&sent, &["sent"]);
    wait_until("the last announcements have arrived", || {
        let received = received();
        counts.iter().all(|(name, row)| received.get(name).is_some_and(|it| it[0] + it[1] == row[0]))
    });
    let lost = assert_counters_agree(&sent, &receiver.end(INT));
    (sent, lost)
}

#[test]
fn slow_link_delivers_the_newest_samples() {
    in_a_network("slow::slow_link_delivers_the_newest_samples", || {
        let (robot, desk) = (TestEnv::new(), TestEnv::new());
        let _sensors = robot.simulator(&["front", "rear"], NO_FLAGS);
        if !limit_rate() {
            return skip("tc", "the kernel has no tbf");
        }
        let at = address("tcp");
        let (mut there, id) = bridge(&robot, &["--listen", &at, "--topic=*/*"]);
        let (mut here, _) = bridge(&desk, &["--connect", &at, "--publish", &format!("--name=robot1={id}")]);
        wait_until_linked(&mut there);
        wait_until_linked(&mut here);
        let hub = robot.hub(&[robot.link("front"), robot.link("rear")]);
        here.await_line("a sensor", |line| line["kind"] == "published");
        let mut local = robot.echo(&["front/scan"]);
        let mut remote = desk.echo(&["robot1.front/scan"]);
        remote.await_lines(60, "a scan", |line: &Value| line["class"] == "scan");
        local.await_line("a scan", |line| line["class"] == "scan");
        let local = local.end(INT);
        assert_eq!(local.of_class("summary")[0]["missed"], 0, "{local}");
        assert_eq!(hub.end(TERM).exit_code, Some(0));
        let (sent, _) = end_after_delivery(there, here);
        let replaced: u64 = final_counters(&sent, &["sent", "replaced"]).values().map(|row| row[1]).sum();
        assert!(replaced > 100, "it was not slow: {sent}");
    });
}

/// Number of queued samples of topic `zones` that newer samples must replace before the stalled link continues. The
/// stall then lasts more than 1 s.
const MIN_REPLACED: u64 = 60;

/// Stops the receiving program until newer samples have replaced many others. Either the robot's bridge or the
/// receiving bridge listens.
fn stall(robot_listens: bool) {
    let (robot, desk) = (TestEnv::new(), TestEnv::new());
    let _sensor = robot.simulator(&["front"], NO_FLAGS);
    let at = address("tcp");
    let (robot_flag, desk_flag) = match robot_listens {
        true => ("--listen", "--connect"),
        false => ("--connect", "--listen"),
    };
    let send = || bridge(&robot, &[robot_flag, &at, "--topic=*/*"]).0;
    let receive = || bridge(&desk, &[desk_flag, &at, "--publish"]).0;
    // Start the listening bridge first.
    let (mut there, mut here);
    if robot_listens {
        (there, here) = (send(), receive());
    } else {
        here = receive();
        there = send();
    }
    wait_until_linked(&mut there);
    wait_until_linked(&mut here);
    let hub = robot.hub(&[robot.link("front")]);
    here.await_line("a sensor", |line| line["kind"] == "published");
    let replaced = |there: &mut Program| {
        current_counters(there, &["sent", "replaced"]).get("front/zones").map_or(0, |row| row[1])
    };
    here.signal(Signal::STOP);
    wait_until("many samples are replaced", || replaced(&mut there) > MIN_REPLACED);
    here.signal(Signal::CONT);
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    let (sent, lost) = end_after_delivery(there, here);
    // If a receiver is stopped for longer than 5 s, it loses the link and the samples on the link.
    let is_broken = sent.of_class("bridge_link").iter().any(|line| line["state"] == "down");
    assert!(lost == 0 || is_broken, "{lost} samples were not sent: {sent}");
}

#[test]
fn stalled_link_does_not_count_replaced_as_sent() {
    stall(true);
    stall(false);
}
