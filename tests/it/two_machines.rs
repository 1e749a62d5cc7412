//! Tests of a hub and its gateway on one machine, and of listeners on other machines. A relay between them drops,
//! duplicates and reorders datagrams, and logs the datagrams that it forwards.

use std::collections::{BTreeMap, BTreeSet};

use crate::testkit::{
    INT, Machine, Outcome, Program, Relay, Robot, TERM, TestEnv, decode_datagram, in_a_network, is_class,
    number, wait_until,
};
use scanhub_schema::Topic;
use scanhub_schema::datagram::Announce;
use serde_json::Value;

/// Number of datagrams that the relay forwards while it is faulty, which takes some seconds.
const ROUGH_DATAGRAMS: usize = 2000;

/// A sensor's number and a topic's number.
type StreamKey = (u8, u8);

/// Starts a gateway that sends all topics of all sensors.
fn gateway(robot: &Robot) -> Program {
    robot.gateway(&Topic::OF_LINKS.map(|topic| format!("--topic=*/{}", topic.name())))
}

fn listener(env: &TestEnv, words: &[&str]) -> Program {
    env.start(&[&["listen", "--json"], words].concat()).ready()
}

/// Returns the counters that a listener reports for each stream: received, lost, duplicate, reordered.
fn reported_counters(outcome: &Outcome, names: &BTreeMap<String, u8>) -> BTreeMap<StreamKey, [u64; 4]> {
    assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    let refused = outcome.of_class("lan_refused");
    let counts = refused[0].as_object().expect("an object");
    assert!(counts.values().filter_map(Value::as_u64).all(|count| count == 0), "{counts:?}");
    let row = |line: Value| {
        let numbers = ["received", "lost", "duplicate", "reordered"].map(|key| number(&line, key));
        (stream(&line, names), numbers)
    };
    outcome.of_class("lan").into_iter().map(row).collect()
}

fn stream(line: &Value, names: &BTreeMap<String, u8>) -> StreamKey {
    let text = |key: &str| line[key].as_str().unwrap_or_else(|| panic!("no {key}: {line}"));
    let topic = Topic::parse(text("topic")).map_or(Announce::NUMBER, Topic::number);
    (names[text("sensor")], topic)
}

/// Returns the numbers of the sensors that are announced in `log`, by the name of the sensor.
fn announced_names(log: &[Vec<u8>]) -> BTreeMap<String, u8> {
    let announce = |bytes: &Vec<u8>| {
        let datagram = decode_datagram(bytes);
        let is_one = datagram.head.topic == Announce::NUMBER;
        let announce = is_one.then(|| Announce::unpack(datagram.payload)).flatten()?;
        Some((announce.sensor().to_owned(), datagram.head.sensor))
    };
    log.iter().filter_map(announce).collect()
}

/// Computes the counters of a listener that received `log`, as docs/datagram.md defines them. Unlike a listener, this
/// function has the whole log and uses sets of numbers.
fn expected_counters(log: &[Vec<u8>]) -> BTreeMap<StreamKey, [u64; 4]> {
    #[derive(Default)]
    struct StreamLog {
        numbers: BTreeSet<u32>,
        /// Next sequence number in the first announcement, if the announcement arrived before any sample of the stream.
        announced_first: Option<u32>,
        announced_last: u32,
        duplicate: u64,
        reordered: u64,
    }
    let mut streams: BTreeMap<StreamKey, StreamLog> = BTreeMap::new();
    for bytes in log {
        let datagram = decode_datagram(bytes);
        let (sensor, topic) = (datagram.head.sensor, datagram.head.topic);
        let log_of_stream = streams.entry((sensor, topic)).or_default();
        let is_overtaken = log_of_stream.numbers.last().is_some_and(|last| *last > datagram.head.sequence);
        match log_of_stream.numbers.insert(datagram.head.sequence) {
            true => log_of_stream.reordered += u64::from(is_overtaken),
            false => {
                log_of_stream.duplicate += 1;
                continue;
            }
        }
        if topic != Announce::NUMBER {
            continue;
        }
        for announced in Announce::unpack(datagram.payload).expect("an announcement").topics() {
            let log_of_stream = streams.entry((sensor, announced.topic)).or_default();
            if log_of_stream.numbers.is_empty() {
                log_of_stream.announced_first.get_or_insert(announced.next);
            }
            log_of_stream.announced_last = log_of_stream.announced_last.max(announced.next);
        }
    }
    let counters = |(stream, stream_log): (StreamKey, StreamLog)| {
        let first =
            stream_log.announced_first.into_iter().chain(stream_log.numbers.first().copied()).min()?;
        let end = stream_log.numbers.last().map_or(0, |last| last + 1).max(stream_log.announced_last);
        let received = stream_log.numbers.len() as u64;
        let lost = u64::from(end - first) - received;
        (end > first).then_some((stream, [received, lost, stream_log.duplicate, stream_log.reordered]))
    };
    streams.into_iter().filter_map(counters).collect()
}

#[test]
fn listeners_count_exactly_the_datagrams_they_lost() {
    in_a_network("two_machines::listeners_count_exactly_the_datagrams_they_lost", || {
        let (second, third) = (Machine::new(2), Machine::new(3));
        let robot = Robot::new(&["front", "rear"]);
        let relay = Relay::new(&robot.machine, 7);
        assert_eq!(relay.connect(&second), 0);
        let env = TestEnv::on(&second);
        let early = listener(&env, &["--stats"]);
        let gateway = gateway(&robot);
        wait_until("all topics of both sensors", || {
            expected_counters(&relay.forwarded()).len() == 2 * (Topic::OF_LINKS.len() + 1)
        });
        let smooth = relay.forwarded().len();
        relay.set_faulty(true);
        wait_until("half of the faulty datagrams", || relay.forwarded().len() > smooth + ROUGH_DATAGRAMS / 2);
        let env = TestEnv::on(&third);
        let late = listener(&env, &["--stats"]);
        let before_late = relay.connect(&third);
        wait_until("the other half", || relay.forwarded().len() > before_late + ROUGH_DATAGRAMS / 2);
        // Let the last announcement through, so that listeners can count the datagrams that were lost before it.
        relay.set_faulty(false);
        let sent = gateway.end(TERM);
        assert_eq!(sent.exit_code, Some(0), "{sent}");
        let sent: BTreeMap<_, _> = last_of_class(&sent, "lan")
            .iter()
            .map(|line| (stream(line, &announced_names(&relay.forwarded())), number(line, "sent")))
            .collect();
        wait_until("all sent datagrams", || relay.received().len() as u64 == sent.values().sum::<u64>());
        let (log, names) = (relay.forwarded(), announced_names(&relay.forwarded()));
        let (early, late) = (early.end(INT), late.end(INT));
        let early_counters = reported_counters(&early, &names);
        assert_eq!(early_counters, expected_counters(&log));
        assert_eq!(
            reported_counters(&late, &names),
            expected_counters(&log[before_late..]),
            "losses must be counted from the first datagram"
        );
        // A listener that ran from the start must count every datagram that was sent as received or lost.
        assert_eq!(early_counters.len(), sent.len());
        for (stream, [received, lost, ..]) in &early_counters {
            assert_eq!(received + lost, sent[stream], "{stream:?}");
        }
        let sum = |at: usize| early_counters.values().map(|numbers| numbers[at]).sum::<u64>();
        let [received, lost, duplicate, reordered] = std::array::from_fn(sum);
        eprintln!("{received} received, {lost} lost, {duplicate} duplicate, {reordered} reordered");
        assert!(
            lost > ROUGH_DATAGRAMS as u64 / 40
                && duplicate > ROUGH_DATAGRAMS as u64 / 100
                && reordered > ROUGH_DATAGRAMS as u64 / 100
        );
    });
}

/// Returns the last line of `class` for each sensor and topic.
fn last_of_class(outcome: &Outcome, class: &str) -> Vec<Value> {
    let key = |line: &Value| (line["sensor"].to_string(), line["topic"].to_string());
    let lines = outcome.of_class(class);
    let by_stream: BTreeMap<_, _> = lines.into_iter().map(|line| (key(&line), line)).collect();
    by_stream.into_values().collect()
}

#[test]
fn remote_sensor_works_like_a_local_one() {
    in_a_network("two_machines::remote_sensor_works_like_a_local_one", || {
        let second = Machine::new(2);
        let mut robot = Robot::new(&["front", "rear"]);
        let relay = Relay::new(&robot.machine, 7);
        relay.connect(&second);
        let gateway = gateway(&robot);
        let env = TestEnv::on(&second);
        let listener = listener(&env, &["--publish"]);
        wait_until("the first announcement", || !announced_names(&relay.forwarded()).is_empty());
        let hub = format!("{:016x}", decode_datagram(&relay.forwarded()[0]).head.hub);
        let (front, rear) = (format!("{hub}.front/scan"), format!("{hub}.rear/zones"));
        let topics = || env.run(&["list", "--json"]).of_class("topic").len();
        wait_until("both sensors are published", || topics() == 2 * Topic::OF_LINKS.len());
        let mut hz = env.start(&["hz", "--json", &front]);
        let mut there = robot.env.echo(&["front/scan"]);
        let mut here = env.echo(&[&front, &rear]);
        here.await_lines(40, "scans", is_class("scan"));
        // On a busy machine, each of the two subscribers may miss scans that the other one has received.
        let received_by_both = || {
            let scan = here.await_line("a scan", is_class("scan"));
            there.await_line("this scan or a later one", |line| line["seq"].as_u64() >= scan["seq"].as_u64());
            there.printed(|line| line["seq"] == scan["seq"]).map(|same| (scan, same))
        };
        let (scan, same) =
            std::iter::repeat_with(received_by_both).take(1000).flatten().next().expect("a scan");
        assert_eq!((&scan["ranges"], &scan["wall_ns"]), (&same["ranges"], &same["wall_ns"]));
        here.await_line("a verdict", |line| line["class"] == "zones" && line["stale"] != true);
        let rate =
            hz.await_line("a rate", |line| line["class"] == "hz" && line["received"].as_u64() > Some(30));
        assert_eq!(rate["missed"], 0, "{rate}");
        // Now the hub exits, and then the gateway and the listener. Subscribers of the remote sensor receive the
        // verdict `unknown`, and then a notice.
        drop(there.end(INT));
        assert_eq!(robot.take_hub().end(TERM).exit_code, Some(0));
        here.await_line("an unknown verdict", |line| line["verdict"] == "unknown");
        assert_eq!(gateway.end(TERM).exit_code, Some(0));
        assert_eq!(listener.end(TERM).exit_code, Some(0));
        here.await_line("the notice", |line| line["kind"] == "hub_gone");
        drop((here.end(INT), hz.end(INT)));
        assert!(env.leftover_files().is_empty(), "{:?}", env.leftover_files());
    });
}
