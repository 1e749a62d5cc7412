//! Tests that a receiver without a key accepts or refuses the golden datagrams of version 2, in
//! `tests/vectors/datagram.json`, as the file says. `schema/tests/datagram.rs` tests their bytes.

#[path = "../../../tests/it/lan/vectors.rs"]
mod vectors;

use scanhub_network::lan::{GatewayTable, SequenceStatus};
use scanhub_schema::Topic;
use scanhub_schema::datagram::{Datagram, DatagramError, HEADER_LEN, Head, MTU_SAFE};
use vectors::{Vector, bytes, vectors};

#[test]
fn receiver_treats_golden_datagrams_as_listed() {
    let zones = bytes("zones");
    let zones = Datagram::read(&zones).unwrap();
    for Vector { name, bytes: datagram, description } in vectors() {
        if description["with_key"] == true {
            continue;
        }
        let mut stats = GatewayTable::new(&Topic::ALL);
        for before in description["after"].as_array().into_iter().flatten() {
            stats.receive(&bytes(before.as_str().unwrap()), 1, 0).unwrap();
        }
        // These gateways send for a second, so that they are known to deliver.
        for (sequence, now_ns) in [(5000, 0), (5001, 1_000_000_000)] {
            for hub in 0..description["after_hubs"].as_u64().unwrap_or_default() {
                let bytes = sealed_datagram(Head { hub, sequence, ..zones.head }, zones.payload);
                stats.receive(&bytes, 1, now_ns).unwrap();
            }
        }
        let from = if description["from_another"] == true { 2 } else { 1 };
        let result = stats.receive(&datagram, from, 1_000_000_000).map(|(_, fresh)| fresh);
        let Some(refusal) = description["refusal"].as_str() else {
            assert_eq!(result, Ok(SequenceStatus::New), "{name}");
            continue;
        };
        let refused = result.unwrap_err();
        assert_eq!(refused.name(), refusal, "{name}");
        for reason in DatagramError::ALL {
            assert_eq!(stats.refused(reason), u64::from(reason == refused), "{name}, {}", reason.name());
        }
    }
}

fn sealed_datagram(head: Head, payload: &[u8]) -> Vec<u8> {
    let mut buffer = [0; MTU_SAFE];
    buffer[HEADER_LEN..HEADER_LEN + payload.len()].copy_from_slice(payload);
    head.seal(&mut buffer, payload.len()).unwrap().to_vec()
}
