//! `scanhub gateway`: an independent receiver checks and counts everything that it sends. Each test has its own network
//! namespace.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, UdpSocket};

use crate::testkit::{
    INT, KILL, Outcome, Receiver, TERM, TestEnv, decode_datagram, hash, in_a_network, is_class, number, skip,
    wait_until,
};
use scanhub_network::lan::GatewayTable;
use scanhub_schema::datagram::{Announce, Datagram, DatagramPayload};
use scanhub_schema::{Scan, Topic, Verdict, Zones};
use serde_json::{Value, json};

const STREAM_FLAGS: [&str; 2] = ["--seed=61", "--baud=500000"];
const LOOPBACK: Ipv4Addr = Ipv4Addr::LOCALHOST;

fn has_topic(topic: Topic) -> impl Fn(&Datagram<'_>) -> bool {
    move |datagram| datagram.head.topic == topic.number()
}

fn is_from(sensor: u8, topic: Topic) -> impl Fn(&Datagram<'_>) -> bool {
    move |datagram| (datagram.head.sensor, datagram.head.topic) == (sensor, topic.number())
}

/// Returns the final statistics of the gateway, which are the lines after its last notice.
fn last_statistics(outcome: &Outcome) -> Vec<Value> {
    let lines = outcome.lines();
    let mut last: Vec<Value> = lines.into_iter().rev().take_while(|line| line["class"] != "notice").collect();
    last.retain(|line| line["class"] == "lan");
    let mut rows = Vec::new();
    last.retain(|line| {
        let key = (line["sensor"].clone(), line["topic"].clone());
        let is_first = !rows.contains(&key);
        rows.push(key);
        is_first
    });
    last
}

/// Asserts that the received datagrams match two counts for each topic: the counters of the gateway, and the numbers in
/// its last announcement.
fn check_counters(received: &[Vec<u8>], outcome: &Outcome) {
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let mut table = Box::new(GatewayTable::new(&Topic::ALL));
    received.iter().for_each(|bytes| assert!(table.receive(bytes, 1, 0).is_ok()));
    let lines = last_statistics(outcome);
    assert_eq!(table.rows().count(), lines.len(), "{lines:#?}");
    for row in table.rows() {
        let topic = Topic::of_number(row.topic).map_or("announce", Topic::name);
        let name = received.iter().find_map(|bytes| {
            let datagram = decode_datagram(bytes);
            let is_own = (datagram.head.sensor, datagram.head.topic) == (row.sensor, Announce::NUMBER);
            is_own.then(|| Announce::unpack(datagram.payload).map(|it| it.sensor().to_owned())).flatten()
        });
        let name = name.expect("each sensor is announced");
        let line = lines.iter().find(|line| line["sensor"] == name.as_str() && line["topic"] == topic);
        let line = line.unwrap_or_else(|| panic!("no {name}/{topic}: {lines:#?}"));
        assert_eq!((row.received, row.lost(), row.duplicate), (number(line, "sent"), 0, 0), "{line}");
        assert_eq!(number(line, "send_failed"), 0, "{line}");
        assert_eq!(line["hub"], format!("{:016x}", row.hub));
        let bytes = received.iter().filter(|bytes| is_in_row(bytes, row.sensor, row.topic)).map(Vec::len);
        assert_eq!(bytes.sum::<usize>() as u64, number(line, "bytes"), "{line}");
    }
}

fn is_in_row(bytes: &[u8], sensor: u8, topic: u8) -> bool {
    let head = decode_datagram(bytes).head;
    (head.sensor, head.topic) == (sensor, topic)
}

#[test]
fn gateway_sends_all_samples_of_two_sensors() {
    in_a_network("gateway::gateway_sends_all_samples_of_two_sensors", || {
        let env = TestEnv::new();
        let receiver = Receiver::new(LOOPBACK);
        let _simulator = env.simulator(&["front", "rear"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front"), env.link("rear")]);
        let gateway = env.gateway(&["--interface=lo"]);
        receiver.wait_for_datagrams(1, is_from(1, Topic::Scan));
        let mut echo = env.echo(&["front/scan"]);
        let lines = echo.await_lines(40, "a scan", is_class("scan"));
        receiver.wait_for_datagrams(40, is_from(1, Topic::Scan));
        let outcome = gateway.end(TERM);
        let received = receiver.finish();
        check_counters(&received, &outcome);
        let sensors: Vec<_> = last_statistics(&outcome).iter().map(|line| line["topic"].clone()).collect();
        for topic in ["announce", "scan", "marks", "zones", "foreground", "background", "status"] {
            assert_eq!(sensors.iter().filter(|it| *it == topic).count(), 2, "{topic}");
        }
        // If a local subscriber received a scan, the datagram of this scan has the same content.
        let scans: Vec<_> =
            received.iter().map(|bytes| decode_datagram(bytes)).filter(is_from(0, Topic::Scan)).collect();
        let mut same = 0;
        for line in &lines {
            let of_line = |it: &&Datagram<'_>| u64::from(it.head.counter) == number(line, "seq");
            let Some(datagram) = scans.iter().find(of_line) else { continue };
            let mut scan = Box::default();
            assert!(Scan::unpack_into(&mut scan, datagram.payload));
            let ranges: Vec<_> = (0..scan.beams()).map(|i| Value::from(scan.range(i))).collect();
            assert_eq!(line["ranges"], Value::from(ranges));
            assert_eq!(datagram.head.stamp_ns, number(line, "wall_ns"));
            same += 1;
        }
        let is_front = |line: &&Value| line["sensor"] == "front" && line["topic"] == "scan";
        let missed = number(
            last_statistics(&outcome).iter().find(is_front).expect("the statistics have a line of the topic"),
            "missed",
        );
        assert!(same > 0 && same + missed >= 40, "{same} scans were sent, {missed} missed");
        // The last datagram of each sensor is an announcement, which has the number of datagrams that were sent for
        // each topic.
        let last: Vec<_> = received.iter().rev().take(2).map(|bytes| decode_datagram(bytes)).collect();
        for datagram in &last {
            let announce = Announce::unpack(datagram.payload).expect("an announcement");
            assert!(announce.kind().starts_with("LMS"), "{announce:?}");
            for announced in announce.topics() {
                let of_topic = |bytes: &&Vec<u8>| is_in_row(bytes, datagram.head.sensor, announced.topic);
                assert_eq!(received.iter().filter(of_topic).count(), announced.next as usize);
            }
        }
        drop(echo.end(INT));
    });
}

#[test]
fn thinned_topics_keep_samples_of_the_same_scans() {
    in_a_network("gateway::thinned_topics_keep_samples_of_the_same_scans", || {
        let env = TestEnv::new();
        let receiver = Receiver::new(LOOPBACK);
        let _simulator = env.simulator(&["front", "rear"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front"), env.link("rear")]);
        env.await_info("front", |info| info["state"] == "streaming");
        let flags = ["--interface=lo", "--topic=front/scan:every=4", "--topic=front/zones:every=4"];
        let gateway = env.gateway(&flags);
        receiver.wait_for_datagrams(20, is_from(0, Topic::Scan));
        let outcome = gateway.end(TERM);
        let received = receiver.finish();
        check_counters(&received, &outcome);
        let counters = |topic: Topic| {
            let expected = |datagram: &Datagram<'_>| has_topic(topic)(datagram) && !is_unknown(datagram);
            let of_topic = received.iter().map(|bytes| decode_datagram(bytes)).filter(expected);
            of_topic.map(|datagram| datagram.head.counter).collect::<Vec<_>>()
        };
        let (scans, zones) = (counters(Topic::Scan), counters(Topic::Zones));
        assert!(scans.len() >= 20 && scans.iter().all(|counter| counter % 4 == 0), "{scans:?}");
        // On a busy machine, the gateway misses some scans.
        assert!(zones.iter().filter(|counter| scans.contains(counter)).count() >= 10, "{zones:?}");
        assert!(zones.iter().all(|counter| counter % 4 == 0), "{zones:?}");
        for bytes in &received {
            let head = decode_datagram(bytes).head;
            let topics = [Announce::NUMBER, Topic::Scan.number(), Topic::Zones.number()];
            assert!(head.sensor == 0 && topics.contains(&head.topic), "{head:?}");
        }
    });
}

fn is_unknown(datagram: &Datagram<'_>) -> bool {
    let mut zones = Zones::unknown();
    datagram.head.topic == Topic::Zones.number()
        && zones.unpack(datagram.payload)
        && zones.verdict() == Verdict::Unknown
}

#[test]
fn bare_telegrams_equal_the_bytes_of_the_line() {
    in_a_network("gateway::bare_telegrams_equal_the_bytes_of_the_line", || {
        let env = TestEnv::new();
        let (usual, front, rear) =
            (Receiver::new(LOOPBACK), Receiver::at(LOOPBACK, 22_201), Receiver::at(LOOPBACK, 22_202));
        let mut waiting = env.gateway(&["--interface=lo", "--bare"]);
        waiting.await_line("no hub", |line| line["kind"] == "hub_gone");
        let _simulator = env.simulator(&["front", "rear"], &STREAM_FLAGS);
        let hub = env.hub(&[env.link("front"), env.link("rear")]);
        wait_until("telegrams", || front.datagrams().len() >= 50 && rear.datagrams().len() >= 50);
        assert_eq!(hub.end(TERM).exit_code, Some(0));
        let outcome = waiting.end(INT);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        assert!(usual.finish().is_empty(), "nothing goes to the port of what has a header");
        for (receiver, name) in [(front, "front"), (rear, "rear")] {
            let received = receiver.finish();
            let sent: Vec<_> = env.truth(name).into_iter().map(|sent| sent.hash).collect();
            assert!(received.iter().all(|bytes| sent.contains(&hash(bytes))), "{name}");
            let lines = last_statistics(&outcome);
            let line = lines
                .iter()
                .find(|line| line["sensor"] == name)
                .expect("the statistics have a line of the topic");
            assert_eq!((number(line, "sent"), &line["topic"]), (received.len() as u64, &"telegram".into()));
        }
    });
}

#[test]
fn copies_are_equal_despite_an_unreachable_host() {
    in_a_network("gateway::copies_are_equal_despite_an_unreachable_host", || {
        let env = TestEnv::new();
        let (receiver, copies) = (Receiver::new(LOOPBACK), Receiver::at(LOOPBACK, 30_000));
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        let flags = ["--interface=lo", "--to=127.0.0.1:9", "--to=localhost:30000"];
        let mut gateway = env.gateway(&flags);
        let failing = gateway.await_line("report of the unreachable host", is_class("lan_link"));
        assert_eq!((&failing["to"], &failing["state"]), (&"127.0.0.1:9".into(), &"failing".into()));
        receiver.wait_for_datagrams(30, has_topic(Topic::Scan));
        let outcome = gateway.end(TERM);
        let received = receiver.finish();
        check_counters(&received, &outcome);
        assert_eq!(copies.finish(), received);
        let to = |name: &str| {
            let lines = outcome.of_class("lan_to");
            lines
                .into_iter()
                .rfind(|line| line["to"] == name)
                .expect("the statistics have a line of the topic")
        };
        let (dead, copy) = (to("127.0.0.1:9"), to("localhost:30000"));
        assert!(number(&dead, "send_failed") > 0 && number(&dead, "reported") > 0, "{dead}");
        assert_eq!((number(&copy, "sent"), number(&copy, "send_failed")), (received.len() as u64, 0));
        assert_eq!(number(&to("lo"), "send_failed"), 0);
    });
}

#[test]
fn gateway_sends_copies_over_ipv6() {
    in_a_network("gateway::gateway_sends_copies_over_ipv6", || {
        let Ok(copies) = UdpSocket::bind("[::1]:30000") else {
            skip("ipv6", "this network has no IPv6");
            return;
        };
        let env = TestEnv::new();
        let receiver = Receiver::new(LOOPBACK);
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        let gateway = env.gateway(&["--interface=lo", "--topic=front/zones", "--to=[::1]:30000"]);
        receiver.wait_for_datagrams(10, has_topic(Topic::Zones));
        let outcome = gateway.end(TERM);
        let received = receiver.finish();
        check_counters(&received, &outcome);
        copies.set_nonblocking(true).expect("a socket");
        let mut bytes = [0; 2048];
        for datagram in &received {
            let len = copies.recv(&mut bytes).expect("as many as in the groups");
            assert!(bytes[..len] == datagram[..], "the same");
        }
        assert!(copies.recv(&mut bytes).is_err(), "and no more");
    });
}

#[test]
fn replaced_hub_and_gateway_change_boot_and_epoch() {
    in_a_network("gateway::replaced_hub_and_gateway_change_boot_and_epoch", || {
        let env = TestEnv::new();
        let receiver = Receiver::new(LOOPBACK);
        let mut first = env.gateway(&["--interface=lo"]);
        first.await_line("no hub", |line| line["kind"] == "hub_gone");
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let links = [env.link("front")];
        let hub = env.hub(&links);
        first.await_line("the hub", |line| line["kind"] == "hub_back");
        receiver.wait_for_datagrams(10, has_topic(Topic::Scan));
        hub.end(KILL);
        // In place of the missing zones, the gateway sends zones with the verdict `unknown` to its listeners.
        wait_until("the gateway sends unknown zones", || {
            let received = receiver.datagrams();
            let last = received.iter().map(|bytes| decode_datagram(bytes)).rfind(has_topic(Topic::Zones));
            last.is_some_and(|last| is_unknown(&last))
        });
        let _hub = env.hub(&links);
        first.await_line("the next hub", |line| line["kind"] == "hub_back");
        receiver.wait_for_datagrams(10, has_topic(Topic::Scan));
        let outcome = first.end(TERM);
        let second = env.gateway(&["--interface=lo"]);
        receiver.wait_for_datagrams(10, has_topic(Topic::Scan));
        drop(second.end(TERM));
        let received = receiver.finish();
        let of_second = received
            .iter()
            .position(|bytes| decode_datagram(bytes).head.epoch != decode_datagram(&received[0]).head.epoch);
        let (of_first, of_second) = received.split_at(of_second.expect("another run"));
        check_counters(of_first, &outcome);
        let mut boots: Vec<_> =
            of_first.iter().filter_map(|bytes| read_announcement(bytes)).map(|it| it.boot).collect();
        boots.dedup();
        assert_eq!(boots.len(), 2, "two hubs: {boots:x?}");
        let (before, after) = (decode_datagram(&of_first[0]).head, decode_datagram(&of_second[0]).head);
        assert!(after.hub == before.hub && after.epoch > before.epoch);
    });
}

fn read_announcement(bytes: &[u8]) -> Option<Announce> {
    let datagram = decode_datagram(bytes);
    (datagram.head.topic == Announce::NUMBER).then(|| Announce::unpack(datagram.payload)).flatten()
}

#[test]
fn oversized_telegrams_are_reported_and_counted() {
    in_a_network("gateway::oversized_telegrams_are_reported_and_counted", || {
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        // With `--bare`, a datagram is a telegram without a header, so it cannot be split into parts. Telegrams of
        // scans have 732 bytes; replies are shorter.
        let mut gateway = env.gateway(&["--interface=lo", "--mtu=700", "--bare"]);
        let report = gateway.await_line("the report of samples that are too long", is_class("lan_link"));
        assert_eq!((&report["to"], &report["state"]), (&"front/telegram".into(), &"failing".into()));
        gateway.await_line("statistics", |line| line["class"] == "lan" && number(line, "send_failed") >= 20);
        let outcome = gateway.end(TERM);
        assert_eq!((outcome.exit_code, outcome.of_class("lan_link").len()), (Some(0), 1), "{outcome}");
        let lines = last_statistics(&outcome);
        let telegrams = lines
            .iter()
            .find(|line| line["topic"] == "telegram")
            .expect("the statistics have a line of the topic");
        assert!(number(telegrams, "bytes") <= 700 * number(telegrams, "sent"), "{telegrams}");
    });
}

#[test]
fn samples_sent_in_parts_are_reassembled() {
    in_a_network("gateway::samples_sent_in_parts_are_reassembled", || {
        let env = TestEnv::new();
        let receiver = Receiver::at(LOOPBACK, 30_000);
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        let mut echo = env.echo(&["front/scan"]);
        let mut listener = env.start(&["listen", "--json", "--topic=scan", "--topic=telegram"]).ready();
        let topics = ["--topic=*/scan", "--topic=*/telegram"];
        let gateway =
            env.gateway(&[&["--interface=lo", "--to=127.0.0.1:30000", "--mtu=576"], &topics[..]].concat());
        listener.await_lines(20, "a scan", is_class("scan"));
        let last = number(&listener.await_line("a scan", is_class("scan")), "seq");
        echo.await_line("the last of these samples", |line| {
            line["class"] == "scan" && number(line, "seq") >= last
        });
        let (remote, own) = (listener.end(INT), echo.end(INT));
        assert_eq!(gateway.end(TERM).exit_code, Some(0));
        let own: BTreeMap<_, _> = own
            .of_class("scan")
            .into_iter()
            .map(|scan| (number(&scan, "seq"), scan["ranges"].clone()))
            .collect();
        let scans = remote.of_class("scan");
        let known: Vec<_> =
            scans.iter().filter_map(|scan| Some((scan, own.get(&number(scan, "seq"))?))).collect();
        assert!(
            known.len() >= 20 && known.iter().all(|(scan, ranges)| scan["ranges"] == **ranges),
            "{remote}"
        );
        assert!(remote.of_class("lan_refused").iter().all(|line| line["payload"] == 0), "{remote}");
        // The scans of the room have intensities, so their payload has 1095 bytes and must be sent in parts.
        let received = receiver.finish();
        assert!(received.iter().all(|bytes| bytes.len() <= 576));
        let parts = |topic: Topic| {
            received
                .iter()
                .filter_map(|bytes| Datagram::read(bytes).ok())
                .filter(has_topic(topic))
                .map(|it| it.head.parts)
                .max()
        };
        assert_eq!([Topic::Scan, Topic::Telegram].map(parts), [Some(3), Some(2)]);
    });
}

#[test]
fn gateway_without_interface_sends_no_multicast() {
    in_a_network("gateway::gateway_without_interface_sends_no_multicast", || {
        let env = TestEnv::new();
        let groups = Receiver::new(LOOPBACK);
        let _simulator = env.simulator(&["front"], &STREAM_FLAGS);
        let _hub = env.hub(&[env.link("front")]);
        let copies = Receiver::at(LOOPBACK, 30_000);
        let mut gateway = env.start_gateway(&["--to=127.0.0.1:30000"]);
        let begin = gateway.await_line("line of class gateway", is_class("gateway"));
        assert_eq!((&begin["interface"], &begin["to"]), (&json!(null), &json!(["127.0.0.1:30000"])));
        copies.wait_for_datagrams(30, |datagram| datagram.head.topic == Topic::Scan.number());
        let outcome = gateway.end(TERM);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let to = outcome.of_class("lan_to").pop().expect("the statistics have a line of the topic");
        assert_eq!((&to["to"], number(&to, "send_failed")), (&json!("127.0.0.1:30000"), 0), "{outcome}");
        assert_eq!(copies.finish().len() as u64, number(&to, "sent"));
        let is_scan = |line: &&Value| line["topic"] == "scan";
        let scan = outcome.of_class("lan").iter().rfind(is_scan).cloned().expect("a row");
        assert!(number(&scan, "sent") >= 30 && number(&scan, "send_failed") == 0, "{scan}");
        assert!(groups.finish().is_empty(), "datagrams were sent to multicast groups");
    });
}
