//! Parser that splits a stream of bytes, in both directions, into items: the telegrams of the scanner that the framer
//! finds, and between them requests, acknowledgements, damaged and incomplete telegrams, and other bytes. Every byte is
//! in exactly one item.

use std::io;

use scanhub_drivers::lms::explain::name;
use scanhub_drivers::lms::framer::{Framer, FramerEvent, VETO_HOLD_TIME};
use scanhub_drivers::lms::telegram::{
    ACK, FRAME_LEN, MAX_LENGTH, MAX_TELEGRAM, NAK, REPLY, STX, Telegram, crc,
};

/// A part of the stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Item<'a> {
    /// A telegram with a valid checksum.
    Telegram(Telegram<'a>),
    /// A telegram of the announced length with a wrong checksum.
    Broken {
        /// The whole telegram.
        bytes: &'a [u8],
        /// The checksum that was computed from its bytes.
        expected: u16,
    },
    /// The start of a telegram. Other bytes follow before the announced length is reached.
    Cut {
        /// The bytes of the telegram.
        bytes: &'a [u8],
        /// The announced length.
        announced: usize,
    },
    /// Acknowledgement: a single byte before a reply.
    Ack,
    /// Negative acknowledgement: a single byte instead of a reply.
    Nak,
    /// Bytes that belong to no telegram.
    Other(&'a [u8]),
}

/// Function that receives each item with its position in the stream.
pub(crate) type Sink<'s> = dyn FnMut(u64, Item<'_>) -> io::Result<()> + 's;

/// Parser that splits bytes into items. The bytes may arrive in pieces.
#[derive(Default)]
pub(crate) struct StreamParser {
    framer: Framer,
    /// Bytes whose items were not reported yet.
    pending: Vec<u8>,
    /// Position of the first of the pending bytes in the stream.
    base: u64,
}

impl StreamParser {
    /// Adds `bytes` of the stream, and passes the items that are complete to `sink`.
    pub(crate) fn feed(&mut self, mut bytes: &[u8], sink: &mut Sink<'_>) -> io::Result<()> {
        while !bytes.is_empty() {
            let buffer = self.framer.read_buffer();
            let (taken, remaining) = bytes.split_at(bytes.len().min(buffer.len()));
            buffer[..taken.len()].copy_from_slice(taken);
            self.framer.commit(taken.len());
            self.pending.extend(taken);
            bytes = remaining;
            self.drain(sink)?;
            if self.pending.len() > MAX_PENDING {
                self.report_old(sink)?;
            }
        }
        Ok(())
    }

    /// Ends the stream, and passes the remaining items to `sink`.
    pub(crate) fn end(&mut self, sink: &mut Sink<'_>) -> io::Result<()> {
        self.framer.release(VETO_HOLD_TIME);
        self.drain(sink)?;
        report_gap(&self.pending, self.base, false, sink)
    }

    fn drain(&mut self, sink: &mut Sink<'_>) -> io::Result<()> {
        while let Some(found) = self.framer.poll() {
            let FramerEvent::Telegram(framed) = found else { continue };
            let at = (framed.offset - self.base) as usize;
            report_gap(&self.pending[..at], self.base, true, sink)?;
            sink(framed.offset, Item::Telegram(framed.telegram))?;
            let end = at + framed.telegram.bytes().len();
            self.pending.drain(..end);
            self.base += end as u64;
        }
        Ok(())
    }

    /// Reports old bytes that the framer has dropped, up to a position at which no telegram is split.
    fn report_old(&mut self, sink: &mut Sink<'_>) -> io::Result<()> {
        let max = self.pending.len() - 2 * MAX_TELEGRAM;
        let across = whole_telegrams(&self.pending).find(|&(at, telegram)| at + telegram.bytes().len() > max);
        let end = across.map_or(max, |(at, _)| at.min(max));
        report_gap(&self.pending[..end], self.base, false, sink)?;
        self.pending.drain(..end);
        self.base += end as u64;
        Ok(())
    }
}

/// Reports the items before a telegram of the scanner, or at the end.
fn report_gap(bytes: &[u8], base: u64, before_reply: bool, sink: &mut Sink<'_>) -> io::Result<()> {
    let mut reported = 0;
    let mut after_telegram = false;
    for (at, telegram) in whole_telegrams(bytes) {
        report_fragments(&bytes[reported..at], base + reported as u64, (after_telegram, false), sink)?;
        sink(base + at as u64, Item::Telegram(telegram))?;
        reported = at + telegram.bytes().len();
        after_telegram = true;
    }
    report_fragments(&bytes[reported..], base + reported as u64, (after_telegram, before_reply), sink)
}

/// Returns the telegrams with a valid checksum in `bytes`, in either direction, with their positions. They do not
/// overlap.
fn whole_telegrams(bytes: &[u8]) -> impl Iterator<Item = (usize, Telegram<'_>)> {
    let mut from = 0;
    std::iter::from_fn(move || {
        loop {
            let at = from + bytes[from..].iter().position(|&byte| byte == STX)?;
            from = at + 1;
            let len = announced_len(&bytes[at..]).unwrap_or(0);
            if let Some(telegram) = bytes.get(at..at + len).and_then(Telegram::check) {
                from = at + len;
                return Some((at, telegram));
            }
        }
    })
}

/// Reports bytes without a complete telegram. A byte counts as an acknowledgement directly after a request, directly
/// before a reply, or alone. `neighbors` states whether a request precedes the bytes, and whether a reply follows them.
fn report_fragments(bytes: &[u8], base: u64, neighbors: (bool, bool), sink: &mut Sink<'_>) -> io::Result<()> {
    let (after_request, before_reply) = neighbors;
    let mut other = 0;
    let mut at = 0;
    while at < bytes.len() {
        let acknowledge = match bytes[at] {
            ACK => Some(Item::Ack),
            NAK => Some(Item::Nak),
            _ => None,
        };
        let is_acknowledge =
            at == 0 && (after_request || bytes.len() == 1) || at + 1 == bytes.len() && before_reply;
        let (item, len) = match (acknowledge.filter(|_| is_acknowledge), plausible_len(&bytes[at..])) {
            (Some(item), _) => (item, 1),
            (None, Some(announced)) => match bytes.get(at..at + announced) {
                Some(bytes) => (Item::Broken { bytes, expected: crc(&bytes[..announced - 2]) }, announced),
                None => {
                    let acknowledged = before_reply && bytes.ends_with(&[ACK]);
                    let bytes = &bytes[at..bytes.len() - usize::from(acknowledged)];
                    (Item::Cut { bytes, announced }, bytes.len())
                }
            },
            (None, None) => {
                at += 1;
                continue;
            }
        };
        if other < at {
            sink(base + other as u64, Item::Other(&bytes[other..at]))?;
        }
        sink(base + at as u64, item)?;
        at += len;
        other = at;
    }
    if other < at { sink(base + other as u64, Item::Other(&bytes[other..at])) } else { Ok(()) }
}

/// Returns the length of the telegram whose head `bytes` start with.
fn announced_len(bytes: &[u8]) -> Option<usize> {
    let &[STX, _, low, high, ..] = bytes else { return None };
    let length = usize::from(u16::from_le_bytes([low, high]));
    (1..=MAX_LENGTH).contains(&length).then_some(length + FRAME_LEN)
}

/// Returns the [`announced_len`], if the command byte exists in the direction that the address byte states.
fn plausible_len(bytes: &[u8]) -> Option<usize> {
    let len = announced_len(bytes)?;
    let is_reply = bytes[1] & REPLY != 0;
    name(*bytes.get(4)?, is_reply).is_some().then_some(len)
}

/// Maximum number of pending bytes, whose items were not reported yet.
const MAX_PENDING: usize = 64 * 1024;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_drivers::lms;
    use scanhub_drivers::lms::command::Request;
    use scanhub_drivers::lms::reply;
    use scanhub_drivers::lms::variant::Unit;

    fn found(bytes: &[u8], piece: usize) -> Vec<(u64, String)> {
        let mut items = Vec::new();
        let mut next = 0;
        let mut sink = |offset: u64, item: Item<'_>| {
            let (len, words) = match item {
                Item::Telegram(telegram) => (telegram.bytes().len(), format!("{:02X}", telegram.command())),
                Item::Broken { bytes, expected } => (bytes.len(), format!("broken {expected:04X}")),
                Item::Cut { bytes, announced } => (bytes.len(), format!("{} of {announced}", bytes.len())),
                Item::Ack => (1, "ack".to_owned()),
                Item::Nak => (1, "nak".to_owned()),
                Item::Other(bytes) => (bytes.len(), format!("{} other", bytes.len())),
            };
            assert_eq!(offset, next, "a byte is reported twice, or never");
            next += len as u64;
            items.push((offset, words));
            Ok(())
        };
        let mut parser = StreamParser::default();
        for piece in bytes.chunks(piece) {
            parser.feed(piece, &mut sink).unwrap();
        }
        parser.end(&mut sink).unwrap();
        assert_eq!(next, bytes.len() as u64);
        items
    }

    #[test]
    fn splits_requests_and_replies() {
        let scan = lms::measured::encode(0, Unit::Mm, &[100; 361], 0x10);
        let mut bytes = vec![0xFF, 0x06, 0x33];
        bytes.extend(Request::Status.encode(0).bytes());
        bytes.push(NAK);
        bytes.extend(Request::Stop.encode(0).bytes());
        bytes.extend(&scan.bytes()[..50]);
        bytes.push(ACK);
        bytes.extend(reply::mode_reply(0, true, 0x10).bytes());
        bytes.extend(scan.bytes());
        let mut damaged = reply::refusal(0, 0x10).bytes().to_vec();
        damaged[6] ^= 1;
        bytes.extend(&damaged);
        let expected = [
            (0, "3 other"),
            (3, "31"),
            (10, "nak"),
            (11, "20"),
            (19, "50 of 732"),
            (69, "ack"),
            (70, "A0"),
            (79, "B0"),
            (811, "broken 337F"),
        ];
        for piece in [1, 7, 4096] {
            assert_eq!(
                found(&bytes, piece),
                expected.map(|(at, item)| (at, item.to_owned())),
                "pieces of {piece}"
            );
        }
    }

    #[test]
    fn reports_endless_noise_in_time() {
        let mut bytes = vec![0x55; 3 * MAX_PENDING];
        let request = Request::Type.encode(0);
        bytes[2 * MAX_PENDING..][..request.bytes().len()].copy_from_slice(request.bytes());
        let items = found(&bytes, 1000);
        assert_eq!(items.iter().filter(|(_, item)| item == "3A").count(), 1);
        assert_eq!(found(&[ACK], 1), [(0, "ack".to_owned())]);
        assert_eq!(found(&[], 1), []);
    }
}
