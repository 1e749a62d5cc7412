//! The hub on a network: everything that is sent is heard, checked and counted by a receiver that knows nothing of the
//! gateway. Each test has a network of its own.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, UdpSocket};

use crate::testkit::{
    INT, KILL, Outcome, Receiver, TERM, TestEnv, hash, in_a_network, is_class, number, read, skip, until,
};
use scanhub_network::lan::GatewayTable;
use scanhub_schema::datagram::{Announce, Datagram, Packed};
use scanhub_schema::{Scan, Topic, Verdict, Zones};
use serde_json::{Value, json};

const STREAM: [&str; 2] = ["--seed=61", "--baud=500000"];
const LO: Ipv4Addr = Ipv4Addr::LOCALHOST;

fn of_topic(topic: Topic) -> impl Fn(&Datagram<'_>) -> bool {
    move |datagram| datagram.head.topic == topic.number()
}

fn from(sensor: u8, topic: Topic) -> impl Fn(&Datagram<'_>) -> bool {
    move |datagram| (datagram.head.sensor, datagram.head.topic) == (sensor, topic.number())
}

/// The last lines of an account: those behind the last object of another class.
fn account(outcome: &Outcome) -> Vec<Value> {
    let lines = outcome.lines();
    let mut last: Vec<Value> = lines.into_iter().rev().take_while(|line| line["class"] != "notice").collect();
    last.retain(|line| line["class"] == "lan");
    let mut seen = Vec::new();
    last.retain(|line| {
        let key = (line["sensor"].clone(), line["topic"].clone());
        let is_first = !seen.contains(&key);
        seen.push(key);
        is_first
    });
    last
}

/// What was heard is exactly what the gateway says that it sent, topic by topic, and what it announced last.
fn agrees(heard: &[Vec<u8>], outcome: &Outcome) {
    assert_eq!(outcome.code, Some(0), "{outcome}");
    let mut ours = Box::new(GatewayTable::new(&Topic::ALL));
    heard.iter().for_each(|bytes| assert!(ours.receive(bytes, 1, 0).is_ok()));
    let lines = account(outcome);
    assert_eq!(ours.rows().count(), lines.len(), "{lines:#?}");
    for row in ours.rows() {
        let topic = Topic::of_number(row.topic).map_or("announce", Topic::name);
        let name = heard.iter().find_map(|bytes| {
            let datagram = read(bytes);
            let is_own = (datagram.head.sensor, datagram.head.topic) == (row.sensor, Announce::NUMBER);
            is_own.then(|| Announce::unpack(datagram.payload).map(|it| it.sensor().to_owned())).flatten()
        });
        let name = name.expect("each sensor is announced");
        let line = lines.iter().find(|line| line["sensor"] == name.as_str() && line["topic"] == topic);
        let line = line.unwrap_or_else(|| panic!("no {name}/{topic}: {lines:#?}"));
        assert_eq!((row.received, row.lost(), row.duplicate), (number(line, "sent"), 0, 0), "{line}");
        assert_eq!(number(line, "send_failed"), 0, "{line}");
        assert_eq!(line["hub"], format!("{:016x}", row.hub));
        let bytes = heard.iter().filter(|bytes| from_row(bytes, row.sensor, row.topic)).map(Vec::len);
        assert_eq!(bytes.sum::<usize>() as u64, number(line, "bytes"), "{line}");
    }
}

fn from_row(bytes: &[u8], sensor: u8, topic: u8) -> bool {
    let head = read(bytes).head;
    (head.sensor, head.topic) == (sensor, topic)
}

#[test]
fn two_sensors_go_out_whole() {
    in_a_network("gateway::two_sensors_go_out_whole", || {
        let env = TestEnv::new();
        let receiver = Receiver::new(LO);
        let _simulator = env.simulator(&["front", "rear"], &STREAM);
        let _hub = env.hub(&[env.link("front"), env.link("rear")]);
        let gateway = env.gateway(&["--interface=lo"]);
        receiver.await_more(1, from(1, Topic::Scan));
        let mut echo = env.echo(&["front/scan"]);
        let lines = echo.await_lines(40, "a scan", is_class("scan"));
        receiver.await_more(40, from(1, Topic::Scan));
        let outcome = gateway.end(TERM);
        let heard = receiver.finish();
        agrees(&heard, &outcome);
        let sensors: Vec<_> = account(&outcome).iter().map(|line| line["topic"].clone()).collect();
        for topic in ["announce", "scan", "marks", "zones", "foreground", "background", "status"] {
            assert_eq!(sensors.iter().filter(|it| *it == topic).count(), 2, "{topic}");
        }
        // What a consumer here sees is what one there can read.
        let scans: Vec<_> = heard.iter().map(|bytes| read(bytes)).filter(from(0, Topic::Scan)).collect();
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
        let missed = number(account(&outcome).iter().find(is_front).expect("its account"), "missed");
        assert!(same > 0 && same + missed >= 40, "{same} scans were sent, {missed} missed");
        // The last word is an announcement of each, which says how much was sent.
        let last: Vec<_> = heard.iter().rev().take(2).map(|bytes| read(bytes)).collect();
        for datagram in &last {
            let announce = Announce::unpack(datagram.payload).expect("an announcement");
            assert!(announce.kind().starts_with("LMS"), "{announce:?}");
            for announced in announce.topics() {
                let of_topic = |bytes: &&Vec<u8>| from_row(bytes, datagram.head.sensor, announced.topic);
                assert_eq!(heard.iter().filter(of_topic).count(), announced.next as usize);
            }
        }
        drop(echo.end(INT));
    });
}

#[test]
fn what_is_thinned_stays_together() {
    in_a_network("gateway::what_is_thinned_stays_together", || {
        let env = TestEnv::new();
        let receiver = Receiver::new(LO);
        let _simulator = env.simulator(&["front", "rear"], &STREAM);
        let _hub = env.hub(&[env.link("front"), env.link("rear")]);
        env.await_info("front", |info| info["state"] == "streaming");
        let flags = ["--interface=lo", "--topic=front/scan:every=4", "--topic=front/zones:every=4"];
        let gateway = env.gateway(&flags);
        receiver.await_more(20, from(0, Topic::Scan));
        let outcome = gateway.end(TERM);
        let heard = receiver.finish();
        agrees(&heard, &outcome);
        let counters = |topic: Topic| {
            let wanted = |datagram: &Datagram<'_>| of_topic(topic)(datagram) && !is_unknown(datagram);
            let of_topic = heard.iter().map(|bytes| read(bytes)).filter(wanted);
            of_topic.map(|datagram| datagram.head.counter).collect::<Vec<_>>()
        };
        let (scans, zones) = (counters(Topic::Scan), counters(Topic::Zones));
        assert!(scans.len() >= 20 && scans.iter().all(|counter| counter % 4 == 0), "{scans:?}");
        // On a busy machine the gateway misses some.
        assert!(zones.iter().filter(|counter| scans.contains(counter)).count() >= 10, "{zones:?}");
        assert!(zones.iter().all(|counter| counter % 4 == 0), "{zones:?}");
        for bytes in &heard {
            let head = read(bytes).head;
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
fn bare_telegrams_are_those_of_the_line() {
    in_a_network("gateway::bare_telegrams_are_those_of_the_line", || {
        let env = TestEnv::new();
        let (usual, front, rear) = (Receiver::new(LO), Receiver::at(LO, 22_201), Receiver::at(LO, 22_202));
        let mut waiting = env.gateway(&["--interface=lo", "--bare"]);
        waiting.await_line("no hub", |line| line["kind"] == "hub_gone");
        let _simulator = env.simulator(&["front", "rear"], &STREAM);
        let hub = env.hub(&[env.link("front"), env.link("rear")]);
        until("telegrams", || front.heard().len() >= 50 && rear.heard().len() >= 50);
        assert_eq!(hub.end(TERM).code, Some(0));
        let outcome = waiting.end(INT);
        assert_eq!(outcome.code, Some(0), "{outcome}");
        assert!(usual.finish().is_empty(), "nothing goes to the port of what has a header");
        for (receiver, name) in [(front, "front"), (rear, "rear")] {
            let heard = receiver.finish();
            let sent: Vec<_> = env.truth(name).into_iter().map(|sent| sent.hash).collect();
            assert!(heard.iter().all(|bytes| sent.contains(&hash(bytes))), "{name}");
            let lines = account(&outcome);
            let line = lines.iter().find(|line| line["sensor"] == name).expect("its account");
            assert_eq!((number(line, "sent"), &line["topic"]), (heard.len() as u64, &"telegram".into()));
        }
    });
}

#[test]
fn copies_are_the_same_and_a_dead_host_disturbs_nobody() {
    in_a_network("gateway::copies_are_the_same_and_a_dead_host_disturbs_nobody", || {
        let env = TestEnv::new();
        let (receiver, copies) = (Receiver::new(LO), Receiver::at(LO, 30_000));
        let _simulator = env.simulator(&["front"], &STREAM);
        let _hub = env.hub(&[env.link("front")]);
        let flags = ["--interface=lo", "--to=127.0.0.1:9", "--to=localhost:30000"];
        let mut gateway = env.gateway(&flags);
        let failing = gateway.await_line("the dead host", is_class("lan_link"));
        assert_eq!((&failing["to"], &failing["state"]), (&"127.0.0.1:9".into(), &"failing".into()));
        receiver.await_more(30, of_topic(Topic::Scan));
        let outcome = gateway.end(TERM);
        let heard = receiver.finish();
        agrees(&heard, &outcome);
        assert_eq!(copies.finish(), heard);
        let to = |name: &str| {
            let lines = outcome.of_class("lan_to");
            lines.into_iter().rfind(|line| line["to"] == name).expect("its account")
        };
        let (dead, copy) = (to("127.0.0.1:9"), to("localhost:30000"));
        assert!(number(&dead, "send_failed") > 0 && number(&dead, "reported") > 0, "{dead}");
        assert_eq!((number(&copy, "sent"), number(&copy, "send_failed")), (heard.len() as u64, 0));
        assert_eq!(number(&to("lo"), "send_failed"), 0);
    });
}

#[test]
fn copies_go_over_ipv6_too() {
    in_a_network("gateway::copies_go_over_ipv6_too", || {
        let Ok(copies) = UdpSocket::bind("[::1]:30000") else {
            skip("ipv6", "no IPv6 here");
            return;
        };
        let env = TestEnv::new();
        let receiver = Receiver::new(LO);
        let _simulator = env.simulator(&["front"], &STREAM);
        let _hub = env.hub(&[env.link("front")]);
        let gateway = env.gateway(&["--interface=lo", "--topic=front/zones", "--to=[::1]:30000"]);
        receiver.await_more(10, of_topic(Topic::Zones));
        let outcome = gateway.end(TERM);
        let heard = receiver.finish();
        agrees(&heard, &outcome);
        copies.set_nonblocking(true).expect("a socket");
        let mut bytes = [0; 2048];
        for datagram in &heard {
            let len = copies.recv(&mut bytes).expect("as many as in the groups");
            assert!(bytes[..len] == datagram[..], "the same");
        }
        assert!(copies.recv(&mut bytes).is_err(), "and no more");
    });
}

#[test]
fn hubs_and_gateways_are_replaced() {
    in_a_network("gateway::hubs_and_gateways_are_replaced", || {
        let env = TestEnv::new();
        let receiver = Receiver::new(LO);
        let mut first = env.gateway(&["--interface=lo"]);
        first.await_line("no hub", |line| line["kind"] == "hub_gone");
        let _simulator = env.simulator(&["front"], &STREAM);
        let links = [env.link("front")];
        let hub = env.hub(&links);
        first.await_line("the hub", |line| line["kind"] == "hub_back");
        receiver.await_more(10, of_topic(Topic::Scan));
        hub.end(KILL);
        // Who listens there learns that nothing is known any more.
        until("the last word", || {
            let heard = receiver.heard();
            let last = heard.iter().map(|bytes| read(bytes)).rfind(of_topic(Topic::Zones));
            last.is_some_and(|last| is_unknown(&last))
        });
        let _hub = env.hub(&links);
        first.await_line("the next hub", |line| line["kind"] == "hub_back");
        receiver.await_more(10, of_topic(Topic::Scan));
        let outcome = first.end(TERM);
        let second = env.gateway(&["--interface=lo"]);
        receiver.await_more(10, of_topic(Topic::Scan));
        drop(second.end(TERM));
        let heard = receiver.finish();
        let of_second = heard.iter().position(|bytes| read(bytes).head.epoch != read(&heard[0]).head.epoch);
        let (of_first, of_second) = heard.split_at(of_second.expect("another life"));
        agrees(of_first, &outcome);
        let mut boots: Vec<_> =
            of_first.iter().filter_map(|bytes| announced(bytes)).map(|it| it.boot).collect();
        boots.dedup();
        assert_eq!(boots.len(), 2, "two hubs: {boots:x?}");
        let (before, after) = (read(&of_first[0]).head, read(&of_second[0]).head);
        assert!(after.hub == before.hub && after.epoch > before.epoch);
    });
}

fn announced(bytes: &[u8]) -> Option<Announce> {
    let datagram = read(bytes);
    (datagram.head.topic == Announce::NUMBER).then(|| Announce::unpack(datagram.payload)).flatten()
}

#[test]
fn what_does_not_fit_is_told_and_counted() {
    in_a_network("gateway::what_does_not_fit_is_told_and_counted", || {
        let env = TestEnv::new();
        let _simulator = env.simulator(&["front"], &STREAM);
        let _hub = env.hub(&[env.link("front")]);
        // Telegrams by themselves cannot go in parts: those of scans have 732 bytes, replies are shorter.
        let mut gateway = env.gateway(&["--interface=lo", "--mtu=700", "--bare"]);
        let told = gateway.await_line("what does not fit", is_class("lan_link"));
        assert_eq!((&told["to"], &told["state"]), (&"front/telegram".into(), &"failing".into()));
        gateway.await_line("an account", |line| line["class"] == "lan" && number(line, "send_failed") >= 20);
        let outcome = gateway.end(TERM);
        assert_eq!((outcome.code, outcome.of_class("lan_link").len()), (Some(0), 1), "{outcome}");
        let lines = account(&outcome);
        let telegrams = lines.iter().find(|line| line["topic"] == "telegram").expect("its account");
        assert!(number(telegrams, "bytes") <= 700 * number(telegrams, "sent"), "{telegrams}");
    });
}

#[test]
fn what_is_longer_than_a_datagram_comes_in_parts_and_is_shown_whole() {
    in_a_network("gateway::what_is_longer_than_a_datagram_comes_in_parts_and_is_shown_whole", || {
        let env = TestEnv::new();
        let receiver = Receiver::at(LO, 30_000);
        let _simulator = env.simulator(&["front"], &STREAM);
        let _hub = env.hub(&[env.link("front")]);
        let mut echo = env.echo(&["front/scan"]);
        let mut listener = env.start(&["listen", "--json", "--topic=scan", "--topic=telegram"]).ready();
        let topics = ["--topic=*/scan", "--topic=*/telegram"];
        let gateway =
            env.gateway(&[&["--interface=lo", "--to=127.0.0.1:30000", "--mtu=576"], &topics[..]].concat());
        listener.await_lines(20, "a scan", is_class("scan"));
        let last = number(&listener.await_line("a scan", is_class("scan")), "seq");
        echo.await_line("the last of them", |line| line["class"] == "scan" && number(line, "seq") >= last);
        let (remote, own) = (listener.end(INT), echo.end(INT));
        assert_eq!(gateway.end(TERM).code, Some(0));
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
        // The room's scans have intensities: 1095 bytes of payload.
        let heard = receiver.finish();
        assert!(heard.iter().all(|bytes| bytes.len() <= 576));
        let parts = |topic: Topic| {
            heard
                .iter()
                .filter_map(|bytes| Datagram::read(bytes).ok())
                .filter(of_topic(topic))
                .map(|it| it.head.parts)
                .max()
        };
        assert_eq!([Topic::Scan, Topic::Telegram].map(parts), [Some(3), Some(2)]);
    });
}

#[test]
fn without_an_interface_nothing_goes_to_groups() {
    in_a_network("gateway::without_an_interface_nothing_goes_to_groups", || {
        let env = TestEnv::new();
        let groups = Receiver::new(LO);
        let _simulator = env.simulator(&["front"], &STREAM);
        let _hub = env.hub(&[env.link("front")]);
        let copies = Receiver::at(LO, 30_000);
        let mut gateway = env.gateway_at(&["--to=127.0.0.1:30000"]);
        let begin = gateway.await_line("its begin", is_class("gateway"));
        assert_eq!((&begin["interface"], &begin["to"]), (&json!(null), &json!(["127.0.0.1:30000"])));
        copies.await_more(30, |datagram| datagram.head.topic == Topic::Scan.number());
        let outcome = gateway.end(TERM);
        assert_eq!(outcome.code, Some(0), "{outcome}");
        let to = outcome.of_class("lan_to").pop().expect("an account");
        assert_eq!((&to["to"], number(&to, "send_failed")), (&json!("127.0.0.1:30000"), 0), "{outcome}");
        assert_eq!(copies.finish().len() as u64, number(&to, "sent"));
        let is_scan = |line: &&Value| line["topic"] == "scan";
        let scan = outcome.of_class("lan").iter().rfind(is_scan).cloned().expect("a row");
        assert!(number(&scan, "sent") >= 30 && number(&scan, "send_failed") == 0, "{scan}");
        assert!(groups.finish().is_empty(), "somebody else could have read it");
    });
}
