//! `scanhub listen` with hostile input: damaged datagrams of every kind, and valid datagrams with senseless content.

use crate::testkit::{INT, Program, TestEnv, TestGateway, in_a_network, number};
use scanhub_schema::datagram::{DatagramError, DatagramPayload, HEADER_LEN, Head, MTU_ETHERNET};
use scanhub_schema::{Foreground, Marks, Scan, ScanHead, Status, Topic, Verdict, Zones};
use serde_json::Value;

const DAMAGED_COUNT: u64 = 100_000;

/// Number of datagrams for which the listener's receive buffer has room on every machine.
const BATCH_SIZE: u64 = 50;

fn resident_kb(program: &Program) -> u64 {
    let path = format!("/proc/{}/status", program.pid());
    let text = std::fs::read_to_string(path).expect("the program runs");
    let line = text.lines().find(|line| line.starts_with("VmRSS")).expect("the status has VmRSS");
    line.split_whitespace().nth(1).and_then(|number| number.parse().ok()).expect("kB")
}

/// Returns a valid datagram of each topic.
fn valid_datagrams(sender: &mut TestGateway) -> Vec<Vec<u8>> {
    let scan = Scan::of(ScanHead::lms(361, -90_000, 500, 1, 13), &[0; 361]);
    vec![
        sender.next_datagram(Topic::Scan, &*scan),
        sender.next_datagram(Topic::Marks, &Marks { count: 5, ..Marks::default() }),
        sender.next_datagram(Topic::Zones, &Zones::unknown()),
        sender.next_datagram(Topic::Foreground, &*Foreground::of(361)),
        sender.next_datagram(Topic::Status, &Status::default()),
        sender.next_telegram(&[0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A]),
    ]
}

#[test]
fn damaged_datagrams_are_refused_in_constant_memory() {
    in_a_network("listen_hostile::damaged_datagrams_are_refused_in_constant_memory", || {
        let env = TestEnv::new();
        let mut program = env.start(&["listen", "--json", "--topic=zones"]).ready();
        let mut sender = TestGateway::new(0xabcd, 7, 0, "front");
        let whole = valid_datagrams(&mut TestGateway::new(0xabcd, 7, 1, "rear"));
        let mut random = fastrand::Rng::with_seed(6);
        let mut kb = 0;
        for n in 0..DAMAGED_COUNT {
            let mut bytes = whole[random.usize(..whole.len())].clone();
            match random.u8(..4) {
                0 => (0..random.usize(1..4)).for_each(|_| {
                    let bit = random.usize(..8 * bytes.len());
                    bytes[bit / 8] ^= 1 << (bit % 8);
                }),
                1 => bytes.truncate(random.usize(..bytes.len())),
                2 => bytes.extend((0..random.usize(1..40)).map(|_| random.u8(..))),
                _ => {
                    let begin = random.usize(..bytes.len());
                    bytes[begin..].iter_mut().for_each(|byte| *byte = random.u8(..));
                    bytes[begin] ^= 1;
                }
            }
            // If a bit was flipped twice, the datagram is intact again. Damage it then.
            if whole.contains(&bytes) {
                bytes[0] ^= 0x80;
            }
            sender.send_bytes(Topic::Zones, &bytes);
            if n % BATCH_SIZE == BATCH_SIZE - 1 {
                let seq = sender.next[usize::from(Topic::Zones.number())];
                sender.send(Topic::Zones, &Zones { verdict: Verdict::Stop as u8, ..Zones::unknown() });
                program.await_line("the valid datagram", |line| line["topic_seq"] == seq);
            }
            if n == DAMAGED_COUNT / 10 {
                kb = resident_kb(&program);
            }
        }
        let grown_kb = resident_kb(&program).saturating_sub(kb);
        assert!(grown_kb < 512, "{grown_kb} kB more");
        let outcome = program.end(INT);
        let refused = &outcome.of_class("lan_refused")[0];
        let all: u64 = DatagramError::ALL.iter().map(|reason| number(refused, reason.name())).sum();
        assert_eq!(all, DAMAGED_COUNT, "{refused}");
        for reason in ["short", "magic", "version", "header", "length", "crc"] {
            assert!(number(refused, reason) > 0, "{reason}: {refused}");
        }
        let lines = outcome.of_class("lan");
        let [line] = &lines[..] else { panic!("{lines:?}") };
        assert_eq!((number(line, "received"), number(line, "lost")), (DAMAGED_COUNT / BATCH_SIZE, 0));
    });
}

/// A hostile sender can put the right checksum on senseless content.
#[test]
fn listener_survives_valid_datagrams_with_bad_content() {
    in_a_network("listen_hostile::listener_survives_valid_datagrams_with_bad_content", || {
        let env = TestEnv::new();
        let words = ["listen", "--json", "--publish", "--timeout=20s"];
        let mut program = env.start(&words).ready();
        let mut sender = TestGateway::new(0xabcd, 7, 0, "front");
        sender.wait_until_published(&mut program, &[Topic::Zones]);
        let mut random = fastrand::Rng::with_seed(7);
        let mut kb = 0;
        let mut counted = 0;
        for n in 0..20_000_u32 {
            let mut buffer = [0; MTU_ETHERNET];
            let len = random.usize(..600);
            buffer[HEADER_LEN..HEADER_LEN + len].iter_mut().for_each(|byte| *byte = random.u8(..));
            if random.bool() {
                let _ = Zones::unknown().pack(&mut buffer[HEADER_LEN..]);
            }
            let head = Head {
                // One third of the datagrams have headers of parts.
                part: [0, 0, random.u8(..4)][n as usize % 3],
                parts: [1, 1, 3][n as usize % 3],
                topic: random.u8(..9),
                flags: random.u8(..) & !1,
                hub: random.u64(..100),
                epoch: random.u32(..4),
                sequence: random.u32(..),
                stamp_ns: random.u64(..),
                sensor: random.u8(..),
                family: random.u8(..4),
                revision: random.u16(..3),
                counter: random.u32(..),
            };
            sender.send_bytes(Topic::Zones, head.seal(&mut buffer, len).expect("the payload fits"));
            if n % 50 == 49 {
                // This sensor already has a slot in the listener's table, so the listener receives it in spite of all
                // the other datagrams.
                sender.send(Topic::Zones, &Zones::unknown());
                counted += 1;
                std::thread::yield_now();
            }
            if n == 15_000 {
                kb = resident_kb(&program);
            }
        }
        assert!(resident_kb(&program).saturating_sub(kb) < 2048, "memory grew from {kb} kB");
        let outcome = program.end(INT);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
        let reports_flood = |it: &&Value| {
            it["message"]
                .as_str()
                .is_some_and(|message| message.contains("more is sent than there is room for"))
        };
        assert_eq!(outcome.of_class("notice").iter().filter(reports_flood).count(), 1, "{outcome}");
        let lines = outcome.of_class("lan");
        assert!(lines.len() <= 1024, "{} lines", lines.len());
        let own = lines.iter().find(|it| it["hub"] == "000000000000abcd" && it["topic"] == "zones");
        let own = own.unwrap_or_else(|| panic!("the sender was evicted: {lines:?}"));
        // If the last datagrams of this sensor did not fit into the receive buffer, the listener cannot count them.
        let known = number(own, "received") + number(own, "lost");
        assert!((1..=counted).contains(&known), "{known} of {counted}");
        let sensors = &outcome.of_class("lan_published")[0]["sensors"];
        let sensors = sensors.as_array().map(Vec::len).unwrap_or_default();
        assert!((1..=16).contains(&sensors), "{sensors} sensors were published");
    });
}

#[test]
fn invalid_arguments_are_refused_with_a_remedy() {
    let env = TestEnv::new();
    for (words, code, kind, hint) in [
        (&["--interface=none0"][..], 78, "configuration", "there are "),
        (&["--topic=scam"], 2, "usage", "zones"),
        (&["--topic=front/zones"], 2, "usage", "zones"),
        (&["--name=robot"], 78, "configuration", "NAME=HUB"),
        (&["--name=robot=0000000000000001"], 78, "configuration", "but not robot, for example"),
        (&["--hub=robot1"], 78, "configuration", "--name robot1="),
        (&["--nonsense"], 2, "usage", "--help"),
    ] {
        let outcome = env.run(&[&["listen", "--json"], words].concat());
        let lines = outcome.lines();
        let error = lines.last().unwrap_or_else(|| panic!("{outcome}"));
        assert_eq!((outcome.exit_code, &error["kind"]), (Some(code), &kind.into()), "{outcome}");
        assert!(error["hint"].as_str().is_some_and(|text| text.contains(hint)), "{outcome}");
    }
}

#[test]
fn reports_timeouts_and_an_occupied_port() {
    in_a_network("listen_hostile::reports_timeouts_and_an_occupied_port", || {
        let env = TestEnv::new();
        for words in [&["--timeout=100ms"][..], &["-n5", "--for=100ms"]] {
            let outcome = env.run(&[&["listen", "--json"], words].concat());
            assert_eq!(outcome.exit_code, Some(3), "{outcome}");
            let lines = outcome.lines();
            let error = lines.last().unwrap_or_else(|| panic!("{outcome}"));
            assert_eq!(error["kind"], "timeout", "{outcome}");
            assert_eq!(outcome.of_class("lan_refused").len(), 1, "the statistics must be printed anyway");
        }
        assert_eq!(env.run(&["listen", "--json", "--for=100ms"]).exit_code, Some(0));
        let holder = std::net::UdpSocket::bind("0.0.0.0:22200").expect("the port is free");
        let outcome = env.run(&["listen", "--json"]);
        assert_eq!(outcome.exit_code, Some(1), "{outcome}");
        assert!(
            outcome.lines()[0]["message"].as_str().is_some_and(|text| text.contains("22200")),
            "{outcome}"
        );
        drop(holder);
    });
}
