//! Golden datagrams of version 2, in `tests/vectors/datagram.json`. The tests build them from values and read the
//! values back. Do not change these tests: a different format needs a new version. `docs/datagram.md` explains the
//! bytes.

#[path = "datagram/describe.rs"]
mod describe;
#[path = "datagram/values.rs"]
mod values;
#[path = "../../tests/it/lan/vectors.rs"]
mod vectors;

use scanhub_schema::Family;
use scanhub_schema::datagram::{Datagram, DatagramError, HEADER_LEN, Head, LanFlags, MIN_MTU, MTU_SAFE};
use vectors::{Vector, bytes as vector, vectors};

/// Returns `datagram` after `change`, with a correct checksum.
fn changed(datagram: &[u8], change: impl FnOnce(&mut Vec<u8>)) -> Vec<u8> {
    let mut bytes = datagram.to_vec();
    change(&mut bytes);
    bytes[CRC_OFFSET..HEADER_LEN].fill(0);
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI).checksum(&bytes);
    bytes[CRC_OFFSET..HEADER_LEN].copy_from_slice(&crc.to_le_bytes());
    bytes
}

#[test]
fn built_datagrams_match_golden_bytes() {
    let mut built = 0;
    for (name, head, pack) in values::GOLDEN_DATAGRAMS {
        let mut buffer = [0xAA; MTU_SAFE];
        let len = pack(&mut buffer[HEADER_LEN..]).unwrap_or_else(|| panic!("{name} does not fit"));
        let datagram = head.seal(&mut buffer, len).expect("there is room");
        assert_eq!(datagram, vector(name), "{name}");
        built += 1;
    }
    assert_eq!(built, 22);
}

#[test]
fn datagrams_of_a_later_revision_match_golden_bytes() {
    let zones = Head { sequence: 5003, ..values::ZONES_HEAD };
    let datagram = sealed_datagram(zones, &vector("zones")[HEADER_LEN..]);
    let header = changed(&datagram, |bytes| {
        bytes[5] = 56;
        bytes.splice(HEADER_LEN..HEADER_LEN, 0xA0..0xA8);
    });
    assert_eq!(header, vector("longer_header"));
    let payload = [&vector("zones")[HEADER_LEN..], b"later"].concat();
    let datagram = sealed_datagram(Head { sequence: 5004, revision: 2, ..values::ZONES_HEAD }, &payload);
    assert_eq!(datagram, vector("longer_payload"));
}

/// The MAC is the first 16 bytes of HMAC-SHA256 over the datagram before the MAC, with a CRC of 0. The key is in the
/// list of golden datagrams.
#[test]
fn mac_follows_the_payload() {
    const KEY_BYTES: [u8; 16] =
        [0x1F, 0xA1, 0xF0, 0x6A, 0x94, 0xBD, 0x5B, 0x68, 0xBA, 0xC5, 0xCD, 0x71, 0xBC, 0x76, 0x3E, 0x48];
    let plain =
        sealed_datagram(Head { sequence: 5002, ..values::ZONES_HEAD }, &vector("zones")[HEADER_LEN..]);
    for (name, mac) in [("authenticated", KEY_BYTES), ("mac", [0; 16])] {
        let datagram = changed(&plain, |bytes| {
            bytes[7] |= LanFlags::AUTHENTICATED;
            bytes.extend(mac);
        });
        assert_eq!(datagram, vector(name), "{name}");
        assert_eq!(Datagram::read(&datagram).unwrap().mac, Some(&mac));
    }
}

/// A single part is not a valid payload. The crate `clients/network` tests that the parts together are a valid payload.
#[test]
fn scan_parts_match_golden_bytes() {
    let scan = vector("scan");
    let whole = Datagram::read(&scan).unwrap();
    let parts: Vec<&[u8]> = whole.payload.chunks(MIN_MTU - HEADER_LEN).collect();
    for (part, payload) in parts.iter().enumerate() {
        let head = Head { part: part as u8, parts: parts.len() as u8, ..whole.head };
        assert_eq!(sealed_datagram(head, payload), vector(&format!("scan_part_{part}")));
    }
    assert_eq!(parts.len(), 3);
}

#[test]
fn invalid_datagrams_match_golden_bytes() {
    let zones = vector("zones");
    let numbered = |head: Head| sealed_datagram(head, &zones[HEADER_LEN..]);
    let expected = [
        ("short", zones[..47].to_vec()),
        ("magic", changed(&zones, |bytes| bytes[3] = b'P')),
        ("version", changed(&zones, |bytes| bytes[4] = 1)),
        ("header", changed(&zones, |bytes| bytes[5] = 47)),
        ("header_beyond", changed(&zones, |bytes| bytes[5] = 77)),
        ("header_part", changed(&zones, |bytes| bytes[33..35].fill(2))),
        ("length", changed(&zones, |bytes| bytes.push(0))),
        ("unauthenticated", zones.clone()),
        (
            "epoch",
            numbered(Head { sequence: 5001, epoch: values::ZONES_HEAD.epoch - 1, ..values::ZONES_HEAD }),
        ),
        ("twin", numbered(Head { sequence: 5001, ..values::ZONES_HEAD })),
        ("stale", numbered(Head { sequence: 5000 - 1024, ..values::ZONES_HEAD })),
        ("capacity", numbered(Head { hub: 0xFEDC_BA98_7654_3210, ..values::ZONES_HEAD })),
        ("skipped", numbered(Head { topic: 255, ..values::ZONES_HEAD })),
        ("payload", changed(&zones, |bytes| bytes[HEADER_LEN + 1] = 3)),
        ("revision", numbered(Head { revision: 0, ..values::ZONES_HEAD })),
    ];
    for (name, datagram) in &expected {
        assert_eq!(*datagram, vector(name), "{name}");
    }
    let mut damaged = zones.clone();
    damaged[60] ^= 1;
    assert_eq!(damaged, vector("crc"));
}

/// `clients/network/tests/golden.rs` tests which valid datagrams a receiver refuses.
#[test]
fn golden_datagrams_are_decoded_or_refused_as_listed() {
    for Vector { name, bytes, description } in vectors() {
        let checked = Datagram::read(&bytes).and_then(|datagram| {
            datagram.check_payload()?;
            Ok(datagram)
        });
        match (description["refusal"].as_str(), checked) {
            (None, Ok(datagram)) => {
                assert_eq!(describe::head(&datagram), description["head"], "{name}");
                assert_eq!(describe::payload(&datagram), description["payload"], "{name}");
            }
            (None, Err(refused)) => panic!("{name}: {refused:?}"),
            (Some(refusal), Err(refused)) => assert_eq!(refused.name(), refusal, "{name}"),
            (Some(refusal), Ok(_)) => {
                let by_receivers =
                    ["unauthenticated", "mac", "epoch", "untimely", "twin", "stale", "capacity"];
                assert!(by_receivers.contains(&refusal), "{name} is accepted");
            }
        }
    }
}

#[test]
fn every_refusal_reason_has_a_golden_datagram() {
    let vectors = vectors();
    // The bytes of a datagram do not show that it was sent again.
    for reason in DatagramError::ALL.into_iter().filter(|reason| *reason != DatagramError::Untimely) {
        assert!(
            vectors.iter().any(|vector| vector.description["refusal"] == reason.name()),
            "{}",
            reason.name()
        );
    }
}

/// Checks the facts in `docs/datagram.md`: header fields without gaps, sizes, an example, and the reasons in their
/// order.
#[test]
fn page_matches_golden_datagrams() {
    let top = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let page = std::fs::read_to_string(top.join("docs/datagram.md")).unwrap();
    let section = |name: &str| {
        let (_, rest) = page.split_once(&format!("\n## {name}\n")).unwrap_or_else(|| panic!("no {name}"));
        rest.split("\n## ").next().unwrap_or_default()
    };
    let rows = |name: &str| -> Vec<Vec<&str>> {
        let rows = section(name).lines().filter(|line| line.starts_with("| "));
        rows.map(|row| row.split('|').map(str::trim).skip(1).collect()).collect()
    };
    let mut end = 0;
    for row in rows("Header").iter().skip(1) {
        assert_eq!(row[0].parse(), Ok(end), "{row:?}");
        end += row[1].parse::<usize>().unwrap();
    }
    assert_eq!(end, HEADER_LEN);
    let families = Family::ALL.map(|family| format!("{} {}", family as u8, family.name())).join(", ");
    assert!(section("Header").contains(&families), "{families}");
    let is_datagram = |row: &&Vec<&str>| row[0].starts_with('`');
    let sizes = rows("Payloads");
    let sizes =
        sizes.iter().filter(is_datagram).map(|row| (row[0].trim_matches('`'), row[1].parse().unwrap()));
    let vectors = vectors();
    let sound = vectors.iter().filter(|vector| vector.description["refusal"].is_null());
    assert!(sizes.eq(sound.map(|vector| (vector.name.as_str(), vector.bytes.len()))));
    let example =
        vector("zones").chunks(16).enumerate().fold(String::from("text\n"), |lines, (number, bytes)| {
            let digits: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
            format!("{lines}{:2}  {digits}\n", 16 * number)
        });
    assert_eq!(section("Payloads").split("```").nth(1), Some(example.as_str()));
    let reasons = rows("Refused datagrams");
    let reasons = reasons.iter().skip(1).map(|row| row[0].trim_matches('`'));
    assert!(reasons.eq(DatagramError::ALL.map(DatagramError::name)));
}

fn sealed_datagram(head: Head, payload: &[u8]) -> Vec<u8> {
    let mut buffer = [0; MTU_SAFE];
    buffer[HEADER_LEN..HEADER_LEN + payload.len()].copy_from_slice(payload);
    head.seal(&mut buffer, payload.len()).unwrap().to_vec()
}

/// Offset of the checksum.
const CRC_OFFSET: usize = 44;
