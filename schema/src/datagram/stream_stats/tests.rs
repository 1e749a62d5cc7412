//! The account against gateways that restart, crowd and share a number. What a network does to it is in `tests/account.rs`.

use super::super::{HEAD, Head};
use super::*;
use crate::Zones;
use crate::datagram::{Announced, Packed};

fn zones(head: Head) -> Vec<u8> {
    let mut buffer = [0; 100];
    let len = Zones::unknown().pack(&mut buffer[HEAD..]).unwrap();
    head.seal(&mut buffer, len).unwrap().to_vec()
}

fn head(hub: u64, epoch: u32, sequence: u32) -> Head {
    Head { topic: Topic::Zones.number(), revision: 1, hub, epoch, sequence, ..Head::default() }
}

fn announce(hub: u64, next: u32) -> Vec<u8> {
    let mut announce = Announce::new(1, "front", "");
    for topic in [Topic::Zones, Topic::Telegram] {
        announce.add(Announced { topic: topic.number(), group: 81, port: 22_200, next });
    }
    let mut buffer = [0; 200];
    let len = announce.pack(&mut buffer[HEAD..]).unwrap();
    Head { topic: 0, ..head(hub, 1, 0) }.seal(&mut buffer, len).unwrap().to_vec()
}

fn fresh(account: &mut StreamStats, bytes: &[u8]) -> Result<Fresh, DatagramError> {
    at(account, bytes, 0)
}

fn at(account: &mut StreamStats, bytes: &[u8], now_ms: u64) -> Result<Fresh, DatagramError> {
    account.receive(bytes, 1, now_ms * 1_000_000).map(|(_, fresh)| fresh)
}

fn knows(account: &StreamStats, hub: u64, epoch: u32) -> bool {
    account.since_ns(hub, epoch).is_some()
}

/// 64 gateways that are known to deliver.
fn full() -> StreamStats {
    let mut account = StreamStats::new(&Topic::ALL);
    for (number, now_ms) in [(0, 0), (1, 1000)] {
        for hub in 0..64 {
            assert_eq!(at(&mut account, &zones(head(hub, 1, number)), now_ms), Ok(Fresh::New));
        }
    }
    account
}

#[test]
fn a_greater_epoch_retires_the_older_one_of_its_hub() {
    let mut account = StreamStats::new(&Topic::ALL);
    for (hub, epoch, expected) in [
        (1, 7, Ok(Fresh::New)),
        (2, 3, Ok(Fresh::New)),
        (1, 6, Err(DatagramError::Epoch)),
        (1, 8, Ok(Fresh::New)),
        (1, 7, Err(DatagramError::Epoch)),
        (2, 3, Ok(Fresh::Duplicate)),
    ] {
        assert_eq!(fresh(&mut account, &zones(head(hub, epoch, 0))), expected, "{hub} {epoch}");
    }
    let rows: Vec<_> = account.rows().map(|row| (row.hub, row.epoch, row.received)).collect();
    assert_eq!(rows, [(1, 7, 1), (1, 8, 1), (2, 3, 1)]);
    assert_eq!(account.refused(DatagramError::Epoch), 2);
}

#[test]
fn what_is_refused_changes_nothing() {
    let mut account = StreamStats::new(&Topic::ALL);
    let damaged = |head: Head| {
        let mut buffer = [0; 60];
        head.seal(&mut buffer, 3).unwrap().to_vec()
    };
    let refused = [
        (DatagramError::Payload, damaged(head(1, 2, 0))),
        (DatagramError::Payload, zones(Head { revision: 0, ..head(1, 2, 0) })),
        (DatagramError::Skipped, zones(Head { topic: 255, revision: 0, ..head(1, 2, 0) })),
    ];
    for (refusal, bytes) in &refused {
        assert_eq!(fresh(&mut account, bytes), Err(*refusal));
    }
    assert_eq!(account.rows().count(), 0);
    assert_eq!(fresh(&mut account, &zones(head(1, 1, 0))), Ok(Fresh::New), "epoch 2 was not believed");
    assert_eq!(account.refused(DatagramError::Payload), 2);
}

#[test]
fn memory_is_bounded() {
    let mut account = full();
    assert_eq!(at(&mut account, &zones(head(64, 1, 0)), 1000), Err(DatagramError::Capacity));
    assert_eq!(at(&mut account, &zones(head(1, 1, 2)), 1000), Ok(Fresh::New), "all go on");
    for sensor in 1..=240 {
        for hub in 0..4 {
            let bytes = zones(Head { sensor, ..head(hub, 1, 0) });
            assert_eq!(at(&mut account, &bytes, 1000), Ok(Fresh::New));
        }
    }
    let more = zones(Head { sensor: 241, ..head(1, 1, 0) });
    assert_eq!(at(&mut account, &more, 3999), Err(DatagramError::Capacity));
    assert_eq!((account.rows().count(), account.refused(DatagramError::Capacity)), (ROWS, 2));
    assert_eq!(account.given_up(), GivenUp::default());
    // Those that were silent for three seconds make room; what was received of them stays in the sum.
    assert_eq!(at(&mut account, &more, 4000), Ok(Fresh::New));
    assert_eq!(at(&mut account, &zones(head(64, 1, 0)), 4000), Ok(Fresh::New));
    let sum = account.given_up();
    assert_eq!((sum.lives, sum.displaced, sum.lost), (1, 1, 0), "one went for the row, and left its place");
    let counted: u64 = account.rows().map(|row| row.received).sum();
    assert_eq!(counted + sum.received, 128 + 1 + 4 * 240 + 2);
}

#[test]
fn a_true_gateway_is_heard_at_once_after_any_number_of_invented_ones() {
    let mut account = StreamStats::new(&Topic::ALL);
    for number in 0..2 {
        assert_eq!(at(&mut account, &zones(head(9999, 1, number)), 1000 * u64::from(number)), Ok(Fresh::New));
    }
    for (now_ms, bytes) in [(1001, announce(0, 10)), (1002, zones(head(0, 1, 0)))] {
        for hub in 0..1000 {
            let mut forged = bytes.clone();
            forged[8..10].copy_from_slice(&(hub as u16).to_le_bytes());
            let Datagram { mut head, payload, .. } = Datagram::read(&bytes).unwrap();
            head.hub = hub;
            forged[HEAD..].copy_from_slice(payload);
            let forged = head.seal(&mut forged, payload.len()).unwrap();
            assert!(at(&mut account, forged, now_ms).is_ok());
        }
    }
    assert_eq!(at(&mut account, &zones(head(7777, 1, 0)), 1003), Ok(Fresh::New));
    assert!(knows(&account, 9999, 1) && knows(&account, 7777, 1), "{:?}", account.given_up());
    assert_eq!(account.given_up().displaced, account.given_up().lives);
}

#[test]
fn two_gateways_with_one_number_and_one_epoch_are_never_mixed() {
    let mut account = StreamStats::new(&Topic::ALL);
    let mut hear = |from: u64, bytes: &[u8], now_ms: u64| {
        account.receive(bytes, from, now_ms * 1_000_000).map(|(_, fresh)| fresh)
    };
    let announce = |boot: u64, number: u32| {
        let mut buffer = [0; 200];
        let len = Announce::new(boot, "front", "").pack(&mut buffer[HEAD..]).unwrap();
        Head { topic: 0, ..head(5, 1, number) }.seal(&mut buffer, len).unwrap().to_vec()
    };
    for n in 0..30_u32 {
        let now_ms = 100 * u64::from(n);
        if n % 10 == 0 {
            assert_eq!(hear(1, &announce(7, n / 10), now_ms), Ok(Fresh::New));
            assert_eq!(hear(2, &announce(8, n / 10), now_ms), Err(DatagramError::Twin));
        }
        assert_eq!(hear(1, &zones(head(5, 1, n)), now_ms), Ok(Fresh::New));
        assert_eq!(hear(2, &zones(head(5, 1, 500 + n)), now_ms + 50), Err(DatagramError::Twin));
    }
    // The other one goes on alone: it never stands in for the first one.
    assert_eq!(hear(2, &zones(head(5, 1, 100)), 5899), Err(DatagramError::Twin));
    assert_eq!(hear(2, &zones(head(5, 1, 101)), 60_000), Err(DatagramError::Twin));
    assert_eq!(hear(1, &zones(head(5, 1, 30)), 60_001), Ok(Fresh::New));
    assert!(account.is_shared(5, 1));
    assert_eq!(account.refused(DatagramError::Twin), 35);
}

#[test]
fn whoever_follows_a_silent_gateway_begins_anew() {
    let mut account = StreamStats::new(&Topic::ALL);
    let mut hear = |from: u64, bytes: &[u8], now_ms: u64| {
        account.receive(bytes, from, now_ms * 1_000_000).map(|(_, fresh)| fresh)
    };
    for n in 0..30 {
        assert_eq!(hear(1, &zones(head(5, 1, 200 + n)), 100 * u64::from(n)), Ok(Fresh::New));
    }
    // Its numbers begin anew, and none of the first one's count as lost.
    assert_eq!(hear(2, &zones(head(5, 1, 100)), 5899), Err(DatagramError::Twin));
    assert_eq!(hear(2, &zones(head(5, 1, 101)), 5900), Ok(Fresh::New));
    assert!(!account.is_shared(5, 1), "a new life");
    let rows: Vec<_> = account.rows().map(|row| (row.received, row.lost())).collect();
    assert_eq!(rows, [(1, 0)]);
    let given_up = account.given_up();
    assert_eq!((given_up.lives, given_up.displaced, given_up.received, given_up.lost), (1, 0, 30, 0));
    assert_eq!(account.refused(DatagramError::Twin), 1);
}

#[test]
fn what_is_retired_makes_room_and_stays_in_the_sum() {
    let mut account = full();
    let fresh = |account: &mut StreamStats, bytes: &[u8]| at(account, bytes, 1000);
    assert_eq!(fresh(&mut account, &zones(head(5, 1, 4))), Ok(Fresh::New));
    // A gateway that starts again is heard, though all places are taken.
    assert_eq!(fresh(&mut account, &zones(head(5, 2, 0))), Ok(Fresh::New));
    let mut given_up = GivenUp { lives: 1, received: 3, lost: 2, ..GivenUp::default() };
    assert_eq!((account.given_up(), account.rows().count()), (given_up, 64));
    assert_eq!(
        fresh(&mut account, &zones(head(5, 1, 5))),
        Err(DatagramError::Epoch),
        "given up is not forgotten"
    );
    assert!(knows(&account, 5, 2) && !knows(&account, 5, 1));
    // A damaged one gives up nothing.
    let mut buffer = [0; 60];
    let damaged = head(5, 3, 0).seal(&mut buffer, 3).unwrap();
    assert_eq!(fresh(&mut account, damaged), Err(DatagramError::Payload));
    assert!(knows(&account, 5, 2) && !knows(&account, 5, 3));
    // As many sensors as there is room for, in a life that is retired then: one row more, and it goes.
    for sensor in 1..=240 {
        for hub in 0..4 {
            let bytes = zones(Head { sensor, ..head(hub, 1, 0) });
            assert_eq!(fresh(&mut account, &bytes), Ok(Fresh::New));
        }
    }
    assert_eq!(fresh(&mut account, &zones(head(2, 9, 0))), Ok(Fresh::New));
    given_up = GivenUp { lives: 2, received: 3 + 242, ..given_up };
    assert_eq!((account.given_up(), account.rows().count()), (given_up, ROWS - 240));
    let counted: u64 = account.rows().map(|row| row.received).sum();
    assert_eq!(counted + given_up.received, 128 + 2 + 4 * 240 + 1);
}

#[test]
fn announcements_count_for_topics_that_are_listened_to() {
    let mut account = StreamStats::new(&[Topic::Zones]);
    assert_eq!(fresh(&mut account, &announce(1, 10)), Ok(Fresh::New));
    assert_eq!(account.rows().map(|row| row.topic).collect::<Vec<_>>(), [0], "nothing sent, nothing to tell");
    assert_eq!(fresh(&mut account, &announce(1, 12)), Ok(Fresh::Duplicate));
    let rows: Vec<_> = account.rows().map(|row| (row.topic, row.received, row.lost())).collect();
    assert_eq!(rows, [(0, 1, 0), (Topic::Zones.number(), 0, 2)]);
}
