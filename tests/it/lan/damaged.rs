//! Datagrams with damaged content but a right checksum, and the result with which `schema` reads each of them.

use fastrand::Rng;
use scanhub_schema::Topic;
use scanhub_schema::datagram::{Announce, Datagram, HEADER_LEN, Head, MTU_ETHERNET};
use serde_json::{Value, json};

use super::{describe, vectors};

/// Returns `count` damaged copies of the golden datagrams. They are the same in every run.
pub(crate) fn datagrams(count: u32) -> Vec<(Vec<u8>, Value)> {
    let mut random = Rng::with_seed(6);
    let mut golden: Vec<Vec<u8>> = vectors::vectors().into_iter().map(|vector| vector.bytes).collect();
    golden.retain(|bytes| Datagram::read(bytes).is_ok());
    let datagrams: Vec<(Vec<u8>, Value)> = (0..count)
        .map(|_| {
            let golden = Datagram::read(&golden[random.usize(..golden.len())]).expect("a datagram");
            let damaged = damage(&mut random, &golden);
            let expected = expected(&damaged);
            (damaged, expected)
        })
        .collect();
    let sound = datagrams.iter().filter(|(_, expected)| expected["refusal"].is_null()).count() as u32;
    assert!((count / 10..count * 9 / 10).contains(&sound), "{sound} of {count} damaged datagrams are valid");
    datagrams
}

/// Returns the result with which `schema` reads a datagram, in the format of the list of golden datagrams.
pub(crate) fn expected(bytes: &[u8]) -> Value {
    let sound = Datagram::read(bytes).and_then(|datagram| datagram.check_payload().map(|_| datagram));
    match sound {
        Ok(datagram) => json!({ "head": describe::head(&datagram), "payload": describe::payload(&datagram) }),
        Err(refusal) => json!({ "refusal": refusal.name() }),
    }
}

/// Changes a few bytes of header and payload, or the length of the payload. Leaves texts and other values that are not
/// numbers as they are, because languages print these differently.
fn damage(random: &mut Rng, datagram: &Datagram<'_>) -> Vec<u8> {
    let mut payload = datagram.payload.to_vec();
    let is_spared = |at: usize| match Topic::of_number(datagram.head.topic) {
        Some(Topic::Status) => (24..336).contains(&at) || at >= 560,
        None => (40..64).contains(&at),
        // Do not change the number of tracks, either, because it determines where the texts are.
        Some(Topic::Tracks) => {
            at < 2 || !(8..8 + 80 * usize::from(datagram.payload[0])).contains(&at) || at % 80 >= 56
        }
        Some(Topic::Events) => at >= 16,
        Some(_) => false,
    };
    for _ in 0..random.usize(..4) {
        // The start of a payload has most of its counts, so half of the changes are limited to the first 48 bytes.
        let end = if random.bool() { payload.len() } else { payload.len().min(48) };
        let at = random.usize(..end.max(1));
        if at < payload.len() && !is_spared(at) {
            payload[at] = match random.u8(..4) {
                0 => random.u8(..),
                1 => random.u8(..4),
                2 => payload[at].wrapping_add(1),
                _ => payload[at].wrapping_sub(1),
            };
        }
    }
    match random.u8(..8) {
        0 => payload.truncate(random.usize(..=payload.len())),
        1 => payload.extend(std::iter::repeat_with(|| random.u8(..)).take(20)),
        _ => {}
    }
    let mut head = Head { flags: datagram.head.flags & !1, sequence: random.u32(..), ..datagram.head };
    if random.u8(..20) == 0 {
        head.revision = random.u16(..3);
    }
    if random.u8(..20) == 0 && head.topic != Topic::Status.number() && head.topic != Announce::NUMBER {
        head.topic = [1, 2, 3, 4, 5, 6, 8, 255][random.usize(..8)];
    }
    let mut buffer = [0; MTU_ETHERNET];
    buffer[HEADER_LEN..HEADER_LEN + payload.len()].copy_from_slice(&payload);
    head.seal(&mut buffer, payload.len()).expect("the payload fits").to_vec()
}
