//! A link that is slower than what is sent: what arrives is new, what was replaced or lost is told exactly, and nobody on
//! the robot waits.

use std::process::Command;

use serde_json::Value;

use crate::testkit::{INT, TERM, TestEnv, in_a_network, skip, succeeds, until};
use crate::{Account, NO_FLAGS, account, account_so_far, address, agree, bridge, linked};

/// Lets no more than 0.5 Mbit/s through the loopback, whose packets are those of a network.
fn slow_down() -> bool {
    let run = |program: &str, words: &str| succeeds(Command::new(program).args(words.split(' ')));
    run("ip", "link set lo mtu 1500")
        && run("tc", "qdisc add dev lo root tbf rate 500kbit burst 5000 latency 200ms")
}

#[test]
fn on_a_slow_link_the_newest_comes_first() {
    in_a_network("slow::on_a_slow_link_the_newest_comes_first", || {
        let (robot, desk) = (TestEnv::new(), TestEnv::new());
        let _sensors = robot.simulator(&["front", "rear"], NO_FLAGS);
        if !slow_down() {
            return skip("tc", "the kernel has no tbf");
        }
        let at = address("tcp");
        let (mut there, id) = bridge(&robot, &["--listen", &at, "--topic=*/*"]);
        let (mut here, _) = bridge(&desk, &["--connect", &at, "--publish", &format!("--name=robot1={id}")]);
        linked(&mut there);
        linked(&mut here);
        let hub = robot.hub(&[robot.link("front"), robot.link("rear")]);
        here.await_line("a sensor", |line| line["kind"] == "published");
        let mut local = robot.echo(&["front/scan"]);
        let mut remote = desk.echo(&["robot1.front/scan"]);
        remote.await_lines(60, "a scan", |line: &Value| line["class"] == "scan");
        local.await_line("a scan", |line| line["class"] == "scan");
        let local = local.end(INT);
        assert_eq!(local.of_class("summary")[0]["lost"], 0, "{local}");
        // What waits on the link when a bridge ends is cut off: nothing new comes, and it gets empty.
        assert_eq!(hub.end(TERM).code, Some(0));
        let mut received = || account_so_far(&mut here, &["received", "lost"]);
        until("all samples have arrived", || {
            let samples = |account: Account| -> Vec<(String, u64)> {
                let rows = account.into_iter().filter(|(name, _)| !name.ends_with("/announce"));
                rows.map(|(name, row)| (name, row.iter().sum())).collect()
            };
            let sent = samples(account_so_far(&mut there, &["sent"]));
            sent.len() > 4 && sent == samples(received())
        });
        let sent = there.end(INT);
        let counts = account(&sent, &["sent"]);
        until("the last announcements have arrived", || {
            let received = received();
            counts.iter().all(|(name, row)| received.get(name).is_some_and(|it| it[0] + it[1] == row[0]))
        });
        let received = here.end(INT);
        agree(&sent, &received);
        let replaced: u64 = account(&sent, &["sent", "replaced"]).values().map(|row| row[1]).sum();
        assert!(replaced > 100, "it was not slow: {sent}");
    });
}
