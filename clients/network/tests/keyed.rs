//! Golden datagrams with a MAC, in `tests/vectors/keyed.json`. The tests build them from values, and check that the
//! receiver handles them as the list says. Readers in other languages are tested with the same list. Do not change the
//! bytes, because other programs contain them.

#[path = "../../../tests/it/lan/keyed_vectors.rs"]
mod keyed_vectors;

use keyed_vectors::{read_vectors, text, unhex};
use scanhub_network::lan::incoming::{Incoming, ReceiveOutcome};
use scanhub_network::lan::{Key, WallTimestamp};
use scanhub_schema::datagram::{
    Announce, Announced, Datagram, DatagramError, DatagramPayload, HEADER_LEN, Head, PORT, group,
};
use scanhub_schema::{Family, Topic, Zones};
use serde_json::Value;

const SECOND_NS: u64 = 1_000_000_000;
/// Time of the first announcement.
const START_S: u64 = 1_700_000_100;

/// Topics in the first announcements.
const ANNOUNCED: [Topic; 3] = [Topic::Telegram, Topic::Scan, Topic::Zones];

/// Lines of the list that the test builds.
struct VectorList(Vec<String>);

fn key() -> Key {
    Key::new(&std::array::from_fn(|at| at as u8))
}

fn head(topic: Topic, sequence: u32) -> Head {
    Head {
        topic: topic.number(),
        hub: 0x1122_3344_5566_7788,
        epoch: 1_700_000_000,
        sequence,
        stamp_ns: START_S * SECOND_NS,
        sensor: 1,
        revision: 1,
        counter: 0x1234,
        ..Head::default()
    }
}

/// Returns a datagram with a MAC of `key`.
fn sealed_datagram(key: &Key, head: Head, payload: &[u8]) -> Vec<u8> {
    let mut buffer = vec![0; HEADER_LEN + payload.len() + 16];
    buffer[HEADER_LEN..HEADER_LEN + payload.len()].copy_from_slice(payload);
    head.seal_with(&mut buffer, payload.len(), |covered| key.mac(covered)).expect("there is room").to_vec()
}

/// Returns a changed datagram with the right checksum, and with a new MAC if `is_signed`.
fn changed_datagram(datagram: &[u8], is_signed: bool, change: impl FnOnce(&mut Vec<u8>)) -> Vec<u8> {
    let mut bytes = datagram.to_vec();
    change(&mut bytes);
    bytes[44..HEADER_LEN].fill(0);
    if is_signed {
        let end = bytes.len() - 16;
        let mac = key().mac(&bytes[..end]);
        bytes[end..].copy_from_slice(&mac);
    }
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI).checksum(&bytes).to_le_bytes();
    bytes[44..HEADER_LEN].copy_from_slice(&crc);
    bytes
}

fn zones() -> Vec<u8> {
    let mut buffer = [0; 100];
    let len = Zones::unknown().pack(&mut buffer).expect("there is room");
    buffer[..len].to_vec()
}

/// Returns an announcement of three topics that is sent at `at_s`.
fn announcement(epoch: u32, sequence: u32, at_s: u64, next: [u32; 3]) -> Vec<u8> {
    announcement_of(epoch, sequence, at_s, ANNOUNCED.into_iter().zip(next))
}

/// Returns an announcement of topics and their next numbers that is sent at `at_s`.
fn announcement_of(
    epoch: u32,
    sequence: u32,
    at_s: u64,
    topics: impl Iterator<Item = (Topic, u32)>,
) -> Vec<u8> {
    let mut announce = Announce::new(0x99AA_BBCC_DDEE_FF00, "front", "LMS200;301063;V02.30");
    for (topic, next) in topics {
        announce.add(Announced { topic: topic.number(), group: group(topic), port: PORT, next });
    }
    let mut buffer = [0; 400];
    let len = announce.pack(&mut buffer).expect("there is room");
    let head =
        Head { topic: 0, epoch, stamp_ns: at_s * SECOND_NS, counter: 0, ..head(Topic::Zones, sequence) };
    sealed_datagram(&key(), head, &buffer[..len])
}

impl VectorList {
    fn add(&mut self, name: &str, after_s: u64, bytes: &[u8], mac: &str, outcome: &str) {
        let digits: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        self.0.push(format!(
            "{{\"name\":\"{name}\",\"at_s\":{},\"mac\":\"{mac}\",\"outcome\":\"{outcome}\",\"bytes\":\"{digits}\"}}",
            START_S + after_s
        ));
    }
}

fn vector_list() -> String {
    let mut list = VectorList(Vec::new());
    let epoch = head(Topic::Zones, 0).epoch;
    let zone = |sequence| sealed_datagram(&key(), head(Topic::Zones, sequence), &zones());
    let mut right = |name: &str, after_s, bytes: &[u8], outcome: &str| {
        list.add(name, after_s, bytes, "right", outcome);
    };
    right("nothing was announced", 0, &zone(40), "untimely");
    right("announced too long ago", 0, &announcement(epoch, 2, START_S - 6, [0, 7, 30]), "untimely");
    right("announced by a clock ahead", 0, &announcement(epoch, 2, START_S + 6, [0, 7, 30]), "untimely");
    right("the announcement", 3, &announcement(epoch, 3, START_S, [0, 7, 41]), "taken");
    right("before the announcement", 3, &zone(40), "stale");
    right("the first", 3, &zone(41), "taken");
    right("the first again", 3, &zone(41), "duplicate");
    right("a later announcement", 60, &announcement(epoch, 5, START_S + 1, [0, 7, 42]), "taken");
    right("an announcement again", 60, &announcement(epoch, 3, START_S, [0, 7, 41]), "duplicate");
    right("one that was overtaken", 60, &announcement(epoch, 4, START_S, [0, 7, 41]), "taken");
    right(
        "a topic that was not announced",
        60,
        &sealed_datagram(&key(), head(Topic::Marks, 0), &[0; 4]),
        "untimely",
    );
    // With these lengths, the datagram ends near the end of a block of the hash. The 48 bytes of the header precede the
    // payload.
    for (sequence, len) in [6, 7, 8, 15, 16, 17, 71, 72, 814].into_iter().enumerate() {
        let head = Head { family: Family::Ld as u8, ..head(Topic::Telegram, sequence as u32) };
        let payload: Vec<u8> = (0..len).map(|at| at as u8).collect();
        right(&format!("{len} bytes"), 60, &sealed_datagram(&key(), head, &payload), "taken");
    }
    let longer = changed_datagram(&zone(43), true, |bytes| {
        bytes[5] = 56;
        bytes.splice(HEADER_LEN..HEADER_LEN, 0xA0..0xA8);
    });
    right("a longer header", 60, &longer, "taken");
    let later = Head { revision: 2, ..head(Topic::Zones, 44) };
    right(
        "a longer payload",
        60,
        &sealed_datagram(&key(), later, &[&zones()[..], b"later"].concat()),
        "taken",
    );
    let scan = scan();
    let part = |sequence, part: usize| {
        let parts = scan.chunks(528).collect::<Vec<_>>();
        let head = Head { part: part as u8, parts: parts.len() as u8, ..head(Topic::Scan, sequence) };
        sealed_datagram(&key(), head, parts[part])
    };
    right("a part of what was before", 60, &part(6, 0), "stale");
    right("the first part", 60, &part(7, 0), "part");
    right("the last part", 60, &part(7, 2), "part");
    right("the part between", 60, &part(7, 1), "taken");
    let mut other =
        |name: &str, bytes: &[u8], mac: &str, outcome: &str| list.add(name, 60, bytes, mac, outcome);
    let mut plain = vec![0; 200];
    let payload = zones();
    plain[HEADER_LEN..HEADER_LEN + payload.len()].copy_from_slice(&payload);
    let plain = head(Topic::Zones, 45).seal(&mut plain, payload.len()).expect("there is room");
    other("no MAC", plain, "none", "unauthenticated");
    let another = Key::new(&[8; 32]);
    other("another key", &sealed_datagram(&another, head(Topic::Zones, 45), &payload), "wrong", "mac");
    other(
        "its last bit",
        &changed_datagram(&zone(45), false, |bytes| *bytes.last_mut().unwrap() ^= 1),
        "wrong",
        "mac",
    );
    other(
        "a payload changed",
        &changed_datagram(&zone(45), false, |bytes| bytes[HEADER_LEN] = 0),
        "wrong",
        "mac",
    );
    other("a number changed", &changed_datagram(&zone(45), false, |bytes| bytes[20] ^= 1), "wrong", "mac");
    other("a part changed", &changed_datagram(&part(8, 1), false, |bytes| bytes[33] = 2), "wrong", "mac");
    other(
        "a scan of an unknown hub",
        &changed_datagram(&part(8, 1), false, |bytes| bytes[8] ^= 1),
        "wrong",
        "mac",
    );
    let mut right = |name: &str, after_s, bytes: &[u8], outcome: &str| {
        list.add(name, after_s, bytes, "right", outcome);
    };
    right("what was changed, as it was", 60, &zone(45), "taken");
    right("far ahead", 60, &zone(5000), "taken");
    right("behind the window", 60, &zone(5000 - 1024), "stale");
    right("the last of the window", 60, &zone(5000 - 1023), "taken");
    right("it again", 60, &zone(5000 - 1023), "duplicate");
    let next_zone = |sequence| {
        sealed_datagram(&key(), Head { epoch: epoch + 1, ..head(Topic::Zones, sequence) }, &zones())
    };
    right("a later run, not announced", 60, &next_zone(0), "untimely");
    right(
        "announced when it was recorded",
        70,
        &announcement(epoch + 1, 0, START_S + 60, [0; 3]),
        "untimely",
    );
    right("a later run", 70, &announcement(epoch + 1, 1, START_S + 70, [0, 0, u32::MAX]), "taken");
    right("before its numbers wrap", 70, &next_zone(u32::MAX), "taken");
    right("after they did", 70, &next_zone(1), "taken");
    right("between", 70, &next_zone(0), "taken");
    right("before it began", 70, &next_zone(u32::MAX - 1), "stale");
    right("of the run before", 70, &zone(5001), "epoch");
    right("its announcement", 70, &announcement(epoch, 90, START_S + 70, [0; 3]), "epoch");
    let all = announcement_of(epoch + 1, 2, START_S + 70, Topic::ALL.into_iter().zip(std::iter::repeat(5)));
    right("all topics", 70, &all, "taken");
    for topic in Topic::ALL.into_iter().filter(|topic| !ANNOUNCED.contains(topic)) {
        let golden = golden_datagram(topic.name());
        let golden = Datagram::read(&golden).expect("a datagram");
        for (name, sequence, outcome) in
            [("before", 4, "stale"), ("first", 5, "taken"), ("first again", 5, "duplicate")]
        {
            let head = Head { epoch: epoch + 1, sequence, ..golden.head };
            let bytes = sealed_datagram(&key(), head, golden.payload);
            right(&format!("{}, {name}", topic.name()), 70, &bytes, outcome);
        }
    }
    format!(
        "{{\"key\":\"{}\",\"steps\":[\n{}\n]}}\n",
        (0..32).map(|byte| format!("{byte:02x}")).collect::<String>(),
        list.0.join(",\n")
    )
}

/// Returns the golden datagram called `name`.
fn golden_datagram(name: &str) -> Vec<u8> {
    let list: Value =
        serde_json::from_str(include_str!("../../../tests/vectors/datagram.json")).expect("JSON");
    let vectors = list["vectors"].as_array().expect("a list");
    let vector = vectors.iter().find(|vector| vector["name"] == name).expect("a vector of this name");
    unhex(vector["bytes"].as_str().expect("bytes"))
}

/// Returns the payload of the golden scan.
fn scan() -> Vec<u8> {
    golden_datagram("scan").split_off(HEADER_LEN)
}

#[test]
fn keyed_datagrams_match_golden_bytes() {
    let (built, golden) = (vector_list(), text());
    for (number, (built, golden)) in built.lines().zip(golden.lines()).enumerate() {
        assert_eq!(built, golden, "line {number}");
    }
    assert_eq!(built.len(), golden.len());
}

#[test]
fn receiver_handles_keyed_datagrams_as_listed() {
    let keyed = read_vectors();
    let key = Key::new(&unhex(&keyed.key).try_into().expect("the length of a key"));
    let mut incoming = Incoming::with_key(&Topic::ALL, key.clone(), Default::default());
    let mut whole = Vec::new();
    for step in keyed.steps {
        let mac = match Datagram::read(&step.bytes).expect("a datagram").mac {
            Some(mac) if key.is_of(&step.bytes, mac) => "right",
            Some(_) => "wrong",
            None => "none",
        };
        assert_eq!(mac, step.mac, "{}", step.name);
        let arrival = WallTimestamp { monotonic_ns: step.at_s * SECOND_NS, wall_ns: step.at_s * SECOND_NS };
        let outcome = match incoming.receive(&step.bytes, 1, arrival, &mut whole) {
            ReceiveOutcome::Refused { reason: why, .. } => why.name(),
            ReceiveOutcome::Untimely { .. } => DatagramError::Untimely.name(),
            ReceiveOutcome::Part => "part",
            ReceiveOutcome::Announced(_) | ReceiveOutcome::Sample(_) => "taken",
            // An announcement that was overtaken contains nothing new, but is not a duplicate.
            ReceiveOutcome::Duplicate if step.outcome == "taken" => "taken",
            ReceiveOutcome::Duplicate => "duplicate",
            ReceiveOutcome::Ignored | ReceiveOutcome::Foreign => "ignored",
        };
        assert_eq!(outcome, step.outcome, "{}", step.name);
    }
}
