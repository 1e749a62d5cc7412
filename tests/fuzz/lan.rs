//! Invariants for datagrams from a network: each datagram is refused, or the contents of the datagram can be encoded
//! again.

use scanhub_network::lan::{EvictedTotals, GatewayTable, MAX_ROWS, SequenceStatus};
use scanhub_schema::Topic;
use scanhub_schema::datagram::{
    Announce, Datagram, DatagramError, DatagramPayload, HEADER_LEN, Head, MTU_ETHERNET,
};

/// Splits `data` into datagrams and checks three invariants. Each datagram is counted once. A refused datagram changes
/// nothing but the count of refusals. An accepted datagram can be encoded again.
///
/// A datagram in `data` starts with a mode byte and a length of two bytes. If the mode is even, the following bytes are
/// the datagram itself. If the mode is odd, they are a short header and a payload, from which this function makes a
/// datagram with a right checksum.
pub(crate) fn lan(data: &[u8]) {
    let mut table = Box::new(GatewayTable::new(&Topic::ALL));
    let mut rest = data;
    let (mut given, mut accepted) = (0, 0);
    while let [mode, low, high, after @ ..] = rest {
        let len = usize::from(u16::from_le_bytes([*low, *high])).min(after.len());
        let (piece, after) = after.split_at(len);
        rest = after;
        let mut buffer = [0; MTU_ETHERNET];
        let bytes = if mode & 1 == 0 { Some(piece) } else { sealed_datagram(piece, &mut buffer) };
        let Some(bytes) = bytes else { continue };
        let before = counters(&table);
        // Datagrams come from two senders, which one bit of the mode selects. A datagram arrives every half second.
        let (from, now_ns) = (u64::from(mode >> 1 & 1), 500_000_000 * given);
        let result = table.receive(bytes, from, now_ns);
        given += 1;
        match result {
            Ok((datagram, fresh)) => {
                accepted += 1;
                assert_eq!(Datagram::read(bytes), Ok(datagram));
                assert!(datagram.check_payload().is_ok());
                can_be_reencoded(&datagram);
                is_damage_detected(bytes, data);
                assert_ne!(
                    table.receive(bytes, from, now_ns).map(|(_, again)| again),
                    Ok(SequenceStatus::New),
                    "{fresh:?} and new again"
                );
                given += 1;
                accepted += 1;
            }
            Err(refusal) => {
                assert_eq!(counters(&table), before, "{refusal:?}");
                let read = Datagram::read(bytes).map(|_| ());
                assert!(read == Err(refusal) || read.is_ok() && refusal > DatagramError::Crc, "{refusal:?}");
            }
        }
    }
    let refused: u64 = DatagramError::ALL.iter().map(|&refusal| table.refused(refusal)).sum();
    let given_up = table.evicted();
    let in_rows: u64 = table.rows().map(|row| row.received + row.duplicate).sum();
    let counted = in_rows + given_up.received + given_up.duplicate;
    assert_eq!((given, accepted), (counted + refused, counted));
    assert!(table.rows().count() <= MAX_ROWS);
}

/// Returns the counts of received, lost, duplicate and reordered datagrams of each row, and the totals of evicted rows.
fn counters(table: &GatewayTable) -> (Vec<[u64; 4]>, EvictedTotals) {
    let rows = table.rows().map(|row| [row.received, row.lost(), row.duplicate, row.reordered]);
    (rows.collect(), table.evicted())
}

/// Returns a datagram with a valid checksum, or `None` if `piece` is too short. The header can name only a few hubs,
/// epochs and sensors, so that many datagrams belong to the same stream.
fn sealed_datagram<'a>(piece: &[u8], buffer: &'a mut [u8]) -> Option<&'a [u8]> {
    let (short, payload) = piece.split_first_chunk::<10>()?;
    let head = Head {
        topic: short[0],
        flags: short[1] & !1,
        hub: u64::from(short[2]),
        epoch: u32::from(short[3] & 3),
        sequence: u32::from_le_bytes([short[4], short[5], short[6], short[7]]),
        sensor: short[8],
        revision: u16::from(short[9] & 3),
        part: short[9] >> 2 & 3,
        parts: 1 + (short[9] >> 4 & 3),
        ..Head::default()
    };
    buffer.get_mut(HEADER_LEN..HEADER_LEN + payload.len())?.copy_from_slice(payload);
    head.seal(buffer, payload.len())
}

/// Decodes a payload, encodes it and decodes it again. Checks that both decoded payloads have the same contents.
fn can_be_reencoded(datagram: &Datagram<'_>) {
    fn reencode<T: DatagramPayload + ?Sized>(payload: &[u8])
    where
        Box<T>: Default,
    {
        let (mut first, mut second) = ([0; 2_000], [0; 2_000]);
        let mut value = Box::<T>::default();
        assert!(T::unpack_into(&mut value, payload));
        let len = value.pack(&mut first).expect("room");
        assert!(T::unpack_into(&mut value, &first[..len]));
        assert_eq!(value.pack(&mut second), Some(len));
        // Compare the bytes of the payloads, because a number in them may be NaN, which does not equal itself.
        assert_eq!(first, second);
    }
    let payload = datagram.payload;
    let Some(topic) = Topic::of_number(datagram.head.topic) else {
        let announce = Announce::unpack(payload).expect("an announcement");
        let mut room = [0; 2_000];
        let len = announce.pack(&mut room).expect("room");
        return assert_eq!(Announce::unpack(&room[..len]), Some(announce));
    };
    macro_rules! by_topic {
        ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
            match topic { $(Topic::$topic => reencode::<scanhub_schema::payload_type!($payload)>(payload),)* }
        };
    }
    scanhub_schema::for_each_topic!(by_topic);
}

/// Checks that the checksum detects one to three changed bits. The checksum can do this, because its Hamming distance
/// at these lengths is 4.
fn is_damage_detected(bytes: &[u8], offsets: &[u8]) {
    let mut damaged = bytes.to_vec();
    let mut at = 0;
    for (number, place) in offsets.iter().rev().take(3).enumerate() {
        at = (at * 256 + usize::from(*place)) % (8 * bytes.len());
        damaged[at / 8] ^= 1 << (at % 8);
        let is_changed = damaged != bytes;
        assert!(!is_changed || Datagram::read(&damaged).is_err(), "{number}: bit {at} of {bytes:02x?}");
    }
}
