//! Faults of networks and programs, observed at the other end of the gateway's cable. The gateway survives each fault,
//! counts the datagrams that it cannot send, and sends again after the fault has ended.

use crate::testkit::{
    INT, KILL, Machine, Outcome, Program, Receiver, Relay, Robot, TERM, TestEnv, decode_datagram,
    in_a_network, ip, is_class, number, skip, wait_until,
};
use scanhub_network::lan::GatewayTable;
use scanhub_schema::datagram::{Datagram, DatagramPayload};
use scanhub_schema::{Topic, Verdict, Zones};
use serde_json::Value;

fn is_scan(datagram: &Datagram<'_>) -> bool {
    datagram.head.topic == Topic::Scan.number()
}

/// Waits until the gateway reports that the destination `to` has the state `state`.
fn await_link(gateway: &mut Program, to: &str, state: &str) {
    let is_it = |line: &Value| line["class"] == "lan_link" && line["to"] == to && line["state"] == state;
    gateway.await_line(state, is_it);
}

/// Waits until the gateway has counted at least `min_increase` more failed datagrams to `to` than in its first
/// statistics. The gateway prints statistics every second.
fn await_failures(gateway: &mut Program, to: &str, min_increase: u64) {
    let count =
        |line: &Value| (line["class"] == "lan_to" && line["to"] == to).then(|| number(line, "send_failed"));
    let before = count(&gateway.await_line("statistics", |line| count(line).is_some())).unwrap_or_default();
    gateway.await_line("failures", |line| count(line).is_some_and(|failed| failed >= before + min_increase));
}

/// Returns the number of datagrams to `to` that were sent, and the number of those that could not be sent.
fn sent_and_failed(outcome: &Outcome, to: &str) -> (u64, u64) {
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let last = outcome.of_class("lan_to").into_iter().rfind(|line| line["to"] == to);
    let last = last.unwrap_or_else(|| panic!("no {to}: {outcome}"));
    (number(&last, "sent"), number(&last, "send_failed"))
}

/// Returns the number of datagrams that a receiver has received, and the number that it counts as lost.
fn count_received_and_lost(received: &[Vec<u8>]) -> (u64, u64) {
    let mut table = Box::new(GatewayTable::new(&Topic::ALL));
    received.iter().for_each(|bytes| assert!(table.receive(bytes, 1, 0).is_ok()));
    let sums = table.rows().map(|row| (row.received, row.lost()));
    sums.fold((0, 0), |sum, row| (sum.0 + row.0, sum.1 + row.1))
}

#[test]
fn gateway_counts_losses_without_cable_or_address() {
    in_a_network("lan::link_failures::gateway_counts_losses_without_cable_or_address", || {
        let robot = Robot::new(&["front"]);
        let receiver = Receiver::new(robot.machine.test_address());
        let mut gateway = robot.gateway::<&str>(&[]);
        receiver.wait_for_datagrams(10, is_scan);
        let there = robot.machine.machine_address();
        let address = format!("{there}/24 dev eth0");
        let pulls = [
            ("ip link set eth0 down".to_owned(), "ip link set eth0 up".to_owned()),
            (format!("ip address del {address}"), format!("ip address add {address}")),
        ];
        for (pull, plug) in pulls {
            robot.machine.run_command(&pull);
            await_link(&mut gateway, "eth0", "down");
            await_failures(&mut gateway, "eth0", 150);
            robot.machine.run_command(&plug);
            receiver.wait_for_datagrams(20, is_scan);
            await_link(&mut gateway, "eth0", "up");
        }
        let outcome = gateway.end(TERM);
        let (sent, failed) = sent_and_failed(&outcome, "eth0");
        let (received, lost) = count_received_and_lost(&receiver.finish());
        assert_eq!(received + lost, sent + failed, "each number was received, lost or failed");
        // Either `failed` or `lost` may be greater. When the link fails, the kernel accepts a few datagrams and drops
        // them. When the link is back, the gateway counts datagrams as failed until it checks the link again, up to a
        // second later.
        assert!(failed >= 300 && lost >= 300, "{lost} lost, {failed} counted");
    });
}

#[test]
fn full_send_queue_counts_failed_datagrams() {
    in_a_network("lan::link_failures::full_send_queue_counts_failed_datagrams", || {
        let robot = Robot::new(&["front"]);
        let receiver = Receiver::new(robot.machine.test_address());
        let mut gateway = robot.gateway::<&str>(&[]);
        receiver.wait_for_datagrams(10, is_scan);
        if !robot.machine.try_run_command("tc qdisc add dev eth0 root tbf rate 128kbit burst 2kb limit 4kb") {
            skip("tc", "tc is not installed, or the kernel has no tbf");
            return;
        }
        await_link(&mut gateway, "eth0", "failing");
        await_failures(&mut gateway, "eth0", 100);
        // Replacing the queue of the interface drops the datagrams in the old queue.
        robot.machine.run_command("tc qdisc change dev eth0 root tbf rate 1gbit burst 100kb limit 1mb");
        receiver.wait_for_datagrams(20, is_scan);
        await_link(&mut gateway, "eth0", "recovered");
        let outcome = gateway.end(TERM);
        let (sent, failed) = sent_and_failed(&outcome, "eth0");
        // The kernel delivered all datagrams that it accepted, and the gateway counted all others as failed. Every lost
        // datagram is therefore reported.
        assert_eq!(count_received_and_lost(&receiver.finish()), (sent, failed));
        assert!(failed >= 100, "{failed}");
    });
}

#[test]
fn unreachable_hosts_do_not_disturb_other_receivers() {
    in_a_network("lan::link_failures::unreachable_hosts_do_not_disturb_other_receivers", || {
        let robot = Robot::new(&["front"]);
        let here = robot.machine.test_address();
        ip("link set lo up");
        ip("address add 10.99.0.1/32 dev lo");
        let (receiver, copies) = (Receiver::new(here), Receiver::at(here, 30_000));
        let (no_route, no_host, copy) = ("10.99.0.1:30001", "10.76.1.77:30000", format!("{here}:30000"));
        let far = Receiver::at(here, 30_001);
        let flags = [no_route, no_host, &copy].map(|to| format!("--to={to}"));
        let mut gateway = robot.gateway(&flags);
        await_failures(&mut gateway, no_route, 100);
        assert!(far.datagrams().is_empty());
        robot.machine.run_command(&format!("ip route add 10.99.0.0/24 via {here}"));
        far.wait_for_datagrams(20, is_scan);
        await_link(&mut gateway, no_route, "recovered");
        let outcome = gateway.end(TERM);
        let received = receiver.finish();
        assert_eq!(count_received_and_lost(&received), sent_and_failed(&outcome, "eth0"));
        assert_eq!(sent_and_failed(&outcome, "eth0").1, 0);
        assert_eq!(copies.finish(), received, "the relay must forward all datagrams in order");
        assert_eq!(count_received_and_lost(&far.finish()).0, sent_and_failed(&outcome, no_route).0);
        let lines = outcome.of_class("lan_link");
        assert!(lines.iter().any(|line| line["to"] == no_host && line["state"] == "failing"), "{lines:?}");
        assert!(lines.iter().all(|line| line["to"] != copy.as_str() && line["to"] != "eth0"), "{lines:?}");
    });
}

#[test]
fn counters_are_right_after_killed_hubs_and_gateways() {
    in_a_network("lan::link_failures::counters_are_right_after_killed_hubs_and_gateways", || {
        let second = Machine::new(2);
        let mut robot = Robot::new(&["front"]);
        let relay = Relay::new(&robot.machine, 7);
        relay.connect(&second);
        let env = TestEnv::on(&second);
        let mut listener = env.start(&["listen", "--json", "--topic=scan"]).ready();
        // Waits for scans with another value of `key`, which belong to another run of the hub or the gateway.
        let mut await_new = |description: &str, key: &str, before: &Value| {
            let line =
                listener.await_line(description, |line| line["class"] == "scan" && line[key] != before[key]);
            listener.await_lines(20, "scans", is_class("scan"));
            line
        };
        let first = robot.gateway::<&str>(&[]);
        let of_first = await_new("the gateway", "epoch", &Value::Null);
        robot.take_hub().end(KILL);
        let verdict = |bytes: &Vec<u8>| {
            let (datagram, mut zones) = (decode_datagram(bytes), Zones::unknown());
            let is_zones = datagram.head.topic == Topic::Zones.number() && zones.unpack(datagram.payload);
            is_zones.then(|| zones.verdict())
        };
        wait_until("the gateway sends unknown zones", || {
            relay.forwarded().iter().rev().find_map(verdict) == Some(Verdict::Unknown)
        });
        robot.start();
        await_new("the next hub", "boot", &of_first);
        drop(first.end(KILL));
        let second = robot.gateway::<&str>(&[]);
        await_new("the next gateway", "epoch", &of_first);
        let last = second.end(TERM);
        let outcome = listener.end(INT);
        let of_epoch = |is_first: bool| {
            let lines = outcome.of_class("lan").into_iter().filter(|line| line["topic"] == "scan");
            let mut lines = lines.filter(|line| (line["epoch"] == of_first["epoch"]) == is_first);
            lines.next().unwrap_or_else(|| panic!("no statistics: {outcome}"))
        };
        for line in [of_epoch(true), of_epoch(false)] {
            assert!(number(&line, "received") >= 20 && line["lost"] == 0, "{line}");
        }
        let sent =
            last.of_class("lan").into_iter().rfind(|line| line["topic"] == "scan").expect("its account");
        assert_eq!(of_epoch(false)["received"], sent["sent"]);
    });
}
