//! `scanhub listen` with datagrams that the test sends. The tests check the printed lines of every topic, the counters,
//! and which datagrams the listener refuses.

use std::io::Read;
use std::time::Duration;

use crate::testkit::{
    self, INT, Outcome, Program, TestEnv, TestGateway, in_a_network, is_class, number, skip, spawn, succeeds,
    terminal, wait_at_least, wait_until, wall_ns,
};
use scanhub_network::lan::WINDOW_LEN;
use scanhub_schema::datagram::{DatagramError, HEADER_LEN};
use scanhub_schema::{
    Background, BackgroundHead, Early, Foreground, Line, Lines, Mark, Marks, Motion, MotionMethod, Scan,
    ScanHead, State, Status, Topic, Verdict, Zones,
};
use serde_json::{Value, json};

const HUB_ID: u64 = 0x5f3a_12bc_00d1_e2f3;

/// A reply with the shortest possible status. The listener does not check the checksum of a telegram, so this one is
/// arbitrary.
const TELEGRAM_BYTES: [u8; 9] = [0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A];

fn scan() -> Box<Scan> {
    Scan::of(ScanHead::lms(3, 0, 500, 10, 13), &[100, 0x1FFF, 300])
}

fn zones(verdict: Verdict) -> Zones {
    Zones { verdict: verdict as u8, ..Zones::unknown() }
}

fn listener(env: &TestEnv, words: &[&str]) -> Program {
    env.start(&[&["listen", "--json"], words].concat()).ready()
}

/// Returns the counters of a topic for one epoch of the gateway: received, lost, duplicate and reordered datagrams.
fn counters(outcome: &Outcome, epoch: u32, topic: &str) -> [u64; 4] {
    let lines = outcome.of_class("lan");
    let found: Vec<_> = lines.iter().filter(|it| it["epoch"] == epoch && it["topic"] == topic).collect();
    let [line] = found[..] else { panic!("not one line of {topic}: {outcome}") };
    ["received", "lost", "duplicate", "reordered"].map(|key| testkit::number(line, key))
}

fn refusals(outcome: &Outcome) -> Value {
    let mut lines = outcome.of_class("lan_refused");
    assert_eq!(lines.len(), 1, "{outcome}");
    lines.remove(0)
}

#[test]
fn listen_prints_samples_of_every_topic() {
    in_a_network("listen::listen_prints_samples_of_every_topic", || {
        let env = TestEnv::new();
        let mut program = listener(&env, &[]);
        let mut sender = TestGateway::new(HUB_ID, 7, 2, "front");
        sender.send(Topic::Zones, &zones(Verdict::Stop));
        let early = program.await_line("zones", is_class("zones"));
        assert_eq!((&early["sensor"], &early["age_ms"]), (&json!("#2"), &Value::Null));
        assert_eq!(early["boot"], Value::Null);
        sender.announce(&Topic::ALL);
        let named = program.await_line("a line with the name of the sensor", |line| line["kind"] == "named");
        assert_eq!((&named["number"], &named["sensor"]), (&json!(2), &json!("front")));
        sender.counter = 77;
        sender.stamp_ns = wall_ns() - 5_000_000;
        let mut marks = Marks { count: 1, ..Marks::default() };
        marks.mark_array[0] = Mark { angle_mdeg: 0, range_dmm: 12_345, ..Mark::default() };
        let mut status = Status { state: State::Streaming as u8, baud: 500_000, ..Status::default() };
        status.set_port("/dev/ttyUSB0");
        let mut foreground = Foreground::of(0);
        foreground.generation = 4;
        let background = Background::of(BackgroundHead { generation: 5, ..BackgroundHead::default() }, &[]);
        let mut lines = Lines { count: 1, noise_m: 0.25, ..Lines::default() };
        lines.line_array[0] = Line { r_m: 1.5, last: 7, points: 8, ..Line::default() };
        let motion = Motion { dx_m: 0.5, method: MotionMethod::Both as u8, ..Motion::default() };
        let telegram = sender.next_telegram(&TELEGRAM_BYTES);
        sender.send_bytes(Topic::Telegram, &telegram);
        sender.send(Topic::Scan, &*scan());
        sender.send(Topic::Marks, &marks);
        sender.send(Topic::Zones, &zones(Verdict::Slow));
        sender.send(Topic::Foreground, &*foreground);
        sender.send(Topic::Background, &*background);
        sender.send(Topic::Lines, &lines);
        sender.send(Topic::Motion, &motion);
        sender.send(Topic::Early, &Early { verdict: Verdict::Stop as u8, beam: 8, ..Early::default() });
        sender.send(Topic::Status, &status);
        program.await_line("the last sample", is_class("status"));
        let outcome = program.end(INT);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let lines = outcome.lines();
        for topic in Topic::OF_LINKS {
            let of_topic: Vec<_> = lines.iter().filter(|line| line["class"] == topic.name()).collect();
            let line = of_topic.last().unwrap_or_else(|| panic!("no {}: {outcome}", topic.name()));
            assert_eq!(line["sensor"], "front");
            assert_eq!(line["hub"], "5f3a12bc00d1e2f3");
            assert_eq!((&line["epoch"], &line["authenticated"]), (&json!(7), &json!(false)));
            let age_ms = line["age_ms"].as_f64().unwrap_or_else(|| panic!("no age: {line}"));
            assert!((5.0..20_000.0).contains(&age_ms), "{line}");
            if !matches!(topic, Topic::Background | Topic::Status) {
                assert_eq!((&line["seq"], &line["boot"]), (&json!(77), &json!("000000000000b007")));
                assert_eq!(line["wall_ns"], sender.stamp_ns);
            }
        }
        let line = |class| outcome.of_class(class).pop().unwrap_or_default();
        assert_eq!(line("telegram")["data"], "02800300a00010160a");
        assert_eq!(line("scan")["ranges"], json!([100, null, 300]));
        assert_eq!(line("marks")["marks"][0]["range_mm"], 1234.5);
        let lines = line("lines");
        assert_eq!([&lines["lines"][0]["r_m"], &lines["noise_m"]], [&json!(1.5), &json!(0.25)]);
        assert_eq!([&line("motion")["dx_m"], &line("motion")["method"]], [&json!(0.5), &json!("both")]);
        assert_eq!((&line("early")["verdict"], &line("early")["beam"]), (&json!("stop"), &json!(8)));
        assert_eq!((&line("zones")["verdict"], &line("zones")["topic_seq"]), (&json!("slow"), &json!(1)));
        assert_eq!(
            (&line("foreground")["generation"], &line("background")["generation"]),
            (&json!(4), &json!(5))
        );
        assert_eq!(line("status")["port"], "/dev/ttyUSB0");
        for (topic, received) in [("announce", 1), ("zones", 2), ("scan", 1), ("status", 1)] {
            assert_eq!(counters(&outcome, 7, topic), [received, 0, 0, 0], "{topic}");
        }
    });
}

#[test]
fn listen_prints_readable_text_without_json() {
    in_a_network("listen::listen_prints_readable_text_without_json", || {
        let env = TestEnv::new();
        let words = ["listen", "--interface=lo", "--topic=zones", "--name=robot1=5f3a12bc00d1e2f3", "-n2"];
        let program = env.start(&words);
        let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
        // The listener does not print when it is ready, so wait until it has joined a group.
        wait_until("the group is joined", || igmp_memberships().contains("514CFFEF"));
        sender.announce(&[Topic::Zones]);
        sender.send(Topic::Marks, &Marks::default());
        sender.send(Topic::Zones, &zones(Verdict::Clear));
        sender.next[usize::from(Topic::Zones.number())] += 3;
        sender.send(Topic::Zones, &zones(Verdict::Stop));
        let outcome = program.wait();
        let text = String::from_utf8_lossy(&outcome.stdout);
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        assert!(lines[0].starts_with("robot1.front/zones seq 0 topic_seq 0 at "), "{outcome}");
        assert!(
            lines[0].contains(" clear nothing near") && lines[1].contains(" stop nothing near"),
            "{outcome}"
        );
        assert!(lines[1].ends_with(" ms old"), "{outcome}");
        assert!(lines[2].starts_with("HUB"), "{outcome}");
        let rows = lines.iter().map(|line| line.split_whitespace().collect::<Vec<_>>());
        let of_zones = rows.into_iter().find(|row| row.contains(&"front/zones") && row.len() == 7);
        assert_eq!(of_zones, Some(vec!["robot1", "7", "front/zones", "2", "3", "0", "0"]), "{outcome}");
        assert_eq!(lines.last(), Some(&"refused: none"), "{outcome}");
        assert!(outcome.stderr.contains("listening on lo"), "{outcome}");
        assert!(outcome.stderr.contains("robot1.front/zones: missed 3"), "{outcome}");
    });
}

/// Returns the multicast groups that this network namespace has joined, as the kernel lists them.
fn igmp_memberships() -> String {
    std::fs::read_to_string("/proc/net/igmp").expect("the kernel has multicast")
}

/// Returns the number of scanhub's multicast groups that programs have joined on `interface`.
fn joined_groups(interface: &str) -> usize {
    let text = igmp_memberships();
    let mut lines = text.lines().skip_while(|line| line.split_whitespace().nth(1) != Some(interface)).skip(1);
    let groups = lines.by_ref().take_while(|line| line.starts_with("\t\t"));
    groups.filter(|line| line.contains("4CFFEF")).count()
}

/// Runs `ip` with these arguments, and returns whether the command succeeded.
fn ip(words: &str) -> bool {
    succeeds(std::process::Command::new("ip").args(words.split(' ')))
}

#[test]
fn statistics_are_redrawn_in_place_on_a_terminal() {
    in_a_network("listen::statistics_are_redrawn_in_place_on_a_terminal", || {
        let env = TestEnv::new();
        let (mut keys, screen) = terminal();
        let mut command = env.command(&["listen", "--stats", "--interface=lo"]);
        let null = std::process::Stdio::null;
        command.stdin(null()).stdout(screen).stderr(null());
        let mut process = spawn(command).expect("the program starts");
        wait_until("the groups are joined", || joined_groups("lo") == 4);
        TestGateway::new(HUB_ID, 7, 0, "front").send(Topic::Zones, &zones(Verdict::Clear));
        let mut text = String::new();
        let mut read = |expected: &str| {
            let mut bytes = [0; 4096];
            while !text.contains(expected) {
                let len =
                    keys.read(&mut bytes).unwrap_or_else(|error| panic!("no {expected:?}: {error}: {text}"));
                text.push_str(&String::from_utf8_lossy(&bytes[..len]));
            }
        };
        read("#0/zones");
        read("\x1b[3A\x1b[J");
        process.signal(INT).expect("the program runs");
        assert!(process.wait().expect("the program exits").success());
    });
}

#[test]
fn groups_are_joined_on_new_and_returning_interfaces() {
    in_a_network("listen::groups_are_joined_on_new_and_returning_interfaces", || {
        let make = || ip("link add scan0 type veth peer name far0") && ip("addr add 10.9.0.1/24 dev scan0");
        if !make() {
            skip("veth", "the kernel cannot create a pair of interfaces");
            return;
        }
        let env = TestEnv::new();
        for words in [&["--interface=scan0"][..], &[]] {
            let program = listener(&env, words);
            assert_eq!(joined_groups("scan0"), 0, "the interface is down");
            assert!(ip("link set scan0 up") && ip("link set far0 up"));
            wait_until("the groups are joined", || joined_groups("scan0") == 4);
            assert!(ip("link set far0 down") && ip("link set far0 up"));
            assert!(ip("link del scan0") && make() && ip("link set scan0 up") && ip("link set far0 up"));
            wait_until("the groups are joined again", || joined_groups("scan0") == 4);
            assert_eq!(joined_groups("lo"), if words.is_empty() { 4 } else { 0 });
            let outcome = program.end(INT);
            assert_eq!((outcome.exit_code, outcome.of_class("notice").len()), (Some(0), 0), "{outcome}");
            assert!(ip("link set scan0 down"));
        }
    });
}

#[test]
fn counts_lost_late_and_duplicate_samples_exactly() {
    in_a_network("listen::counts_lost_late_and_duplicate_samples_exactly", || {
        let env = TestEnv::new();
        let mut program = listener(&env, &["--topic=zones", "--topic=scan"]);
        let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
        sender.announce(&[Topic::Zones, Topic::Scan, Topic::Telegram]);
        // Prepare 100 samples of topic `zones`, and do not send them in order. Numbers 10, 11 and 50 are lost. Numbers
        // 20 and 21 are swapped, 30 arrives twice, and 40 arrives after 45.
        let datagrams: Vec<_> =
            (0..100).map(|_| sender.next_datagram(Topic::Zones, &zones(Verdict::Clear))).collect();
        let mut order: Vec<usize> = (0..100).filter(|n| ![10, 11, 40, 50].contains(n)).collect();
        order.swap(18, 19);
        order.insert(order.iter().position(|&n| n == 30).unwrap(), 30);
        order.insert(order.iter().position(|&n| n == 46).unwrap(), 40);
        for n in order {
            sender.send_bytes(Topic::Zones, &datagrams[n]);
        }
        // Two scans are lost, which the next announcement shows. The announcement also shows lost telegrams, but this
        // listener does not request telegrams.
        sender.send(Topic::Scan, &*scan());
        sender.next[usize::from(Topic::Scan.number())] += 2;
        sender.next[usize::from(Topic::Telegram.number())] += 9;
        sender.announce(&[Topic::Zones, Topic::Scan, Topic::Telegram]);
        sender.send(Topic::Scan, &*scan());
        program.await_lines(2, "scans", is_class("scan"));
        let outcome = program.end(INT);
        assert_eq!(counters(&outcome, 7, "zones"), [97, 3, 1, 2], "{outcome}");
        assert_eq!(counters(&outcome, 7, "scan"), [2, 2, 0, 0], "{outcome}");
        assert_eq!(counters(&outcome, 7, "announce"), [2, 0, 0, 0], "{outcome}");
        assert!(outcome.of_class("lan").iter().all(|line| line["topic"] != "telegram"), "{outcome}");
        let zones = outcome.of_class("zones");
        assert_eq!(zones.len(), 97);
        let late: Vec<_> =
            zones.iter().filter(|line| line["late"] == true).map(|line| &line["topic_seq"]).collect();
        assert_eq!(late, [20, 40]);
        let missed = |topic: &str| -> u64 {
            let notices = outcome.of_class("notice").into_iter().filter(|line| line["topic"] == topic);
            notices.map(|line| testkit::number(&line, "missed")).sum()
        };
        // Numbers 20 and 40 count as missed, because each of them arrived after a later number.
        assert_eq!((missed("zones"), missed("scan")), (5, 2));
    });
}

#[test]
fn counts_each_epoch_and_each_hub_separately() {
    in_a_network("listen::counts_each_epoch_and_each_hub_separately", || {
        let env = TestEnv::new();
        let mut program = listener(&env, &["--topic=zones"]);
        let mut first = TestGateway::new(HUB_ID, 7, 0, "front");
        let mut other = TestGateway::new(1, 3, 0, "front");
        first.announce(&[Topic::Zones]);
        other.announce(&[Topic::Zones]);
        for _ in 0..3 {
            first.send(Topic::Zones, &zones(Verdict::Clear));
            other.send(Topic::Zones, &zones(Verdict::Stop));
        }
        let mut again = TestGateway::new(HUB_ID, 8, 0, "front");
        again.send(Topic::Zones, &zones(Verdict::Slow));
        first.send(Topic::Zones, &zones(Verdict::Clear));
        other.send(Topic::Zones, &zones(Verdict::Stop));
        program.await_line("the last sample of the other gateway", |line| {
            line["hub"] == "0000000000000001" && line["topic_seq"] == 3
        });
        let outcome = program.end(INT);
        assert_eq!(counters(&outcome, 7, "zones"), [3, 0, 0, 0], "{outcome}");
        assert_eq!(counters(&outcome, 8, "zones"), [1, 0, 0, 0], "{outcome}");
        assert_eq!(counters(&outcome, 3, "zones"), [4, 0, 0, 0], "{outcome}");
        assert_eq!(refusals(&outcome)["epoch"], 1, "{outcome}");
        let slow = outcome.of_class("zones").into_iter().find(|line| line["verdict"] == "slow");
        assert_eq!(
            slow.map(|line| line["sensor"].clone()),
            Some(json!("#0")),
            "the sensor is not announced in this run"
        );
    });
}

#[test]
fn counts_90_gateway_runs_in_a_bounded_table() {
    in_a_network("listen::counts_90_gateway_runs_in_a_bounded_table", || {
        const RUNS: u64 = 90;
        let env = TestEnv::new();
        let mut program = listener(&env, &["--topic=zones"]);
        for epoch in 1..=RUNS {
            let mut sender = TestGateway::new(HUB_ID, epoch as u32, 0, "front");
            sender.announce(&[Topic::Zones]);
            sender.send(Topic::Zones, &zones(Verdict::Clear));
            sender.next[usize::from(Topic::Zones.number())] += 2;
            sender.send(Topic::Zones, &zones(Verdict::Stop));
            program.await_line("sample of the next run", |line| {
                line["epoch"] == epoch && line["verdict"] == "stop"
            });
        }
        let outcome = program.end(INT);
        let lines = outcome.of_class("lan");
        assert_eq!(lines.len(), 2 * 64, "{outcome}");
        let evicted = &outcome.of_class("lan_evicted")[0];
        assert_eq!(evicted["runs"], RUNS - 64, "{outcome}");
        let sum = |key| number(evicted, key) + lines.iter().map(|line| number(line, key)).sum::<u64>();
        // In each run, an announcement arrives, and the first and the last of four samples of topic `zones`.
        assert_eq!((sum("received"), sum("lost")), (3 * RUNS, 2 * RUNS), "{outcome}");
        assert_eq!(refusals(&outcome)["capacity"], 0, "{outcome}");
        assert!(outcome.of_class("notice").iter().all(|line| line["kind"] == "missed"), "{outcome}");
    });
}

#[test]
fn each_refused_datagram_is_counted_by_reason() {
    in_a_network("listen::each_refused_datagram_is_counted_by_reason", || {
        let env = TestEnv::new();
        let mut program = listener(&env, &["--topic=zones"]);
        let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
        sender.next[usize::from(Topic::Zones.number())] = 5000;
        let good = sender.next_datagram(Topic::Zones, &zones(Verdict::Clear));
        sender.send_bytes(Topic::Zones, &good);
        let with = |at: usize, byte: u8| {
            let mut bytes = good.clone();
            bytes[at] = byte;
            bytes
        };
        for bad in [
            &good[..HEADER_LEN - 1],
            &with(0, b'X'),
            &with(4, 1),
            &with(5, 47),
            &with(36, 0),
            &with(HEADER_LEN, 9),
        ] {
            sender.send_bytes(Topic::Zones, bad);
        }
        let number = usize::from(Topic::Zones.number());
        sender.epoch = 6;
        sender.send(Topic::Zones, &zones(Verdict::Clear));
        (sender.epoch, sender.next[number]) = (7, 5000 - WINDOW_LEN as u32);
        sender.send(Topic::Zones, &zones(Verdict::Clear));
        sender.next[number] = 5001;
        TestGateway::new(HUB_ID, 7, 0, "front").send(Topic::Zones, &zones(Verdict::Clear));
        // All other gateways in the table deliver for a second, so that the listener does not evict them.
        let mut others: Vec<_> = (0..63).map(|hub| TestGateway::new(hub, 7, 0, "front")).collect();
        for wait_ms in [1100, 0] {
            sender.send(Topic::Zones, &zones(Verdict::Slow));
            others.iter_mut().for_each(|other| other.send(Topic::Zones, &zones(Verdict::Clear)));
            wait_at_least(Duration::from_millis(wait_ms));
        }
        TestGateway::new(64, 7, 0, "front").send(Topic::Zones, &zones(Verdict::Clear));
        sender.send_empty(255);
        sender.send_empty(Topic::Zones.number());
        sender.send(Topic::Zones, &zones(Verdict::Stop));
        program.await_line("the last sample", |line| line["verdict"] == "stop");
        let outcome = program.end(INT);
        let refused = refusals(&outcome);
        for reason in DatagramError::ALL {
            // Three of the reasons need a listener with a key, and this listener has none.
            const KEY_ERRORS: [DatagramError; 3] =
                [DatagramError::Unauthenticated, DatagramError::Mac, DatagramError::Untimely];
            let expected = u64::from(!KEY_ERRORS.contains(&reason));
            assert_eq!(refused[reason.name()], expected, "{}: {outcome}", reason.name());
        }
        let keys: Vec<_> = DatagramError::ALL.iter().map(|reason| reason.name()).collect();
        let line = String::from_utf8_lossy(&outcome.stdout);
        let line = line.lines().last().unwrap_or_default();
        let places: Vec<_> = keys.iter().map(|key| line.find(&format!("\"{key}\""))).collect();
        assert!(places.iter().all(Option::is_some) && places.is_sorted(), "{line}");
    });
}

#[test]
fn reports_two_gateways_with_one_id_once() {
    in_a_network("listen::reports_two_gateways_with_one_id_once", || {
        let env = TestEnv::new();
        let mut program = listener(&env, &["--topic=zones", "--stats"]);
        // The gateway with the greater epoch sends first, so the listener refuses all datagrams of the other gateway.
        let mut gateways = [9, 7].map(|epoch| TestGateway::new(HUB_ID, epoch, 0, "front"));
        for _ in 0..80 {
            gateways.iter_mut().for_each(|gateway| gateway.send(Topic::Zones, &zones(Verdict::Clear)));
            // Send for several seconds, because the listener does not report a second gateway for datagrams within a
            // short time.
            wait_at_least(Duration::from_millis(50));
        }
        let line = program.await_line("notice with a remedy", |line| line["kind"] == "problem");
        let message = line["message"].as_str().unwrap_or_default();
        assert!(message.contains(&format!("{HUB_ID:016x}")) && message.contains("gateway-*"), "{line}");
        let outcome = program.end(INT);
        assert_eq!(outcome.of_class("notice").len(), 1, "{outcome}");
        assert_eq!(counters(&outcome, 9, "zones"), [80, 0, 0, 0]);
        assert_eq!(refusals(&outcome)["epoch"], 80);
    });
}
