//! Everything in a stream of bytes, in both directions: the sensor's telegrams as the framer finds them, and what is
//! between them: requests, acknowledgements, damaged and incomplete telegrams, and other bytes. Every byte is in exactly
//! one item.

use std::io;

use scanhub_drivers::lms::crc::crc;
use scanhub_drivers::lms::explain::name;
use scanhub_drivers::lms::framer::{Found, Framer, VETO_HOLD};
use scanhub_drivers::lms::telegram::{ACK, FRAME, MAX_LENGTH, MAX_TELEGRAM, NAK, REPLY, STX, Telegram};

/// A part of the stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Item<'a> {
    /// A telegram with a right checksum.
    Telegram(Telegram<'a>),
    /// As long as it says, but with a wrong checksum.
    Broken {
        /// All of it.
        bytes: &'a [u8],
        /// The checksum of its bytes.
        expected: u16,
    },
    /// The head of a telegram that goes on as something else.
    Cut {
        /// What there is of it.
        bytes: &'a [u8],
        /// How long it would have been.
        announced: usize,
    },
    /// A single byte before a reply.
    Ack,
    /// A single byte instead of one.
    Nak,
    /// In nothing.
    Other(&'a [u8]),
}

/// Who is told what was found, and at which byte of the stream.
pub(super) type Sink<'s> = dyn FnMut(u64, Item<'_>) -> io::Result<()> + 's;

/// Finds items in bytes that come piece by piece.
#[derive(Default)]
pub(super) struct Finder {
    framer: Framer,
    /// Bytes that were not told yet.
    pending: Vec<u8>,
    /// Number of the first of them in the stream.
    base: u64,
}

impl Finder {
    /// More bytes.
    pub(super) fn feed(&mut self, mut bytes: &[u8], sink: &mut Sink<'_>) -> io::Result<()> {
        while !bytes.is_empty() {
            let spare = self.framer.spare();
            let (now, later) = bytes.split_at(bytes.len().min(spare.len()));
            spare[..now.len()].copy_from_slice(now);
            self.framer.commit(now.len());
            self.pending.extend(now);
            bytes = later;
            self.drain(sink)?;
            if self.pending.len() > MOST_PENDING {
                self.relieve(sink)?;
            }
        }
        Ok(())
    }

    /// There is no more.
    pub(super) fn end(&mut self, sink: &mut Sink<'_>) -> io::Result<()> {
        self.framer.release(VETO_HOLD);
        self.drain(sink)?;
        between(&self.pending, self.base, false, sink)
    }

    fn drain(&mut self, sink: &mut Sink<'_>) -> io::Result<()> {
        while let Some(found) = self.framer.poll() {
            let Found::Telegram(framed) = found else { continue };
            let at = (framed.offset - self.base) as usize;
            between(&self.pending[..at], self.base, true, sink)?;
            sink(framed.offset, Item::Telegram(framed.telegram))?;
            let end = at + framed.telegram.bytes().len();
            self.pending.drain(..end);
            self.base += end as u64;
        }
        Ok(())
    }

    /// Tells what the framer has given up long ago, up to a place where no telegram is cut in two.
    fn relieve(&mut self, sink: &mut Sink<'_>) -> io::Result<()> {
        let most = self.pending.len() - 2 * MAX_TELEGRAM;
        let across = whole(&self.pending).find(|&(at, telegram)| at + telegram.bytes().len() > most);
        let end = across.map_or(most, |(at, _)| at.min(most));
        between(&self.pending[..end], self.base, false, sink)?;
        self.pending.drain(..end);
        self.base += end as u64;
        Ok(())
    }
}

/// Tells what lies before a telegram of the sensor's, or at the end.
fn between(bytes: &[u8], base: u64, before_reply: bool, sink: &mut Sink<'_>) -> io::Result<()> {
    let mut told = 0;
    let mut after_telegram = false;
    for (at, telegram) in whole(bytes) {
        scraps(&bytes[told..at], base + told as u64, (after_telegram, false), sink)?;
        sink(base + at as u64, Item::Telegram(telegram))?;
        told = at + telegram.bytes().len();
        after_telegram = true;
    }
    scraps(&bytes[told..], base + told as u64, (after_telegram, before_reply), sink)
}

/// The telegrams with a right checksum in `bytes`, in either direction, that do not overlap, with their places.
fn whole(bytes: &[u8]) -> impl Iterator<Item = (usize, Telegram<'_>)> {
    let mut from = 0;
    std::iter::from_fn(move || {
        loop {
            let at = from + bytes[from..].iter().position(|&byte| byte == STX)?;
            from = at + 1;
            let len = announced(&bytes[at..]).unwrap_or(0);
            if let Some(telegram) = bytes.get(at..at + len).and_then(Telegram::check) {
                from = at + len;
                return Some((at, telegram));
            }
        }
    })
}

/// Tells bytes among which there is no whole telegram. An acknowledgement is one right behind a request or right before
/// a reply, as `neighbours` are there, or alone.
fn scraps(bytes: &[u8], base: u64, neighbours: (bool, bool), sink: &mut Sink<'_>) -> io::Result<()> {
    let (after_request, before_reply) = neighbours;
    let mut other = 0;
    let mut at = 0;
    while at < bytes.len() {
        let acknowledge = match bytes[at] {
            ACK => Some(Item::Ack),
            NAK => Some(Item::Nak),
            _ => None,
        };
        let placed = at == 0 && (after_request || bytes.len() == 1) || at + 1 == bytes.len() && before_reply;
        let (item, len) = match (acknowledge.filter(|_| placed), plausible(&bytes[at..])) {
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

/// Whole length of the telegram whose head `bytes` begin with.
fn announced(bytes: &[u8]) -> Option<usize> {
    let &[STX, _, low, high, ..] = bytes else { return None };
    let length = usize::from(u16::from_le_bytes([low, high]));
    (1..=MAX_LENGTH).contains(&length).then_some(length + FRAME)
}

/// The same, if a head with that address has that command.
fn plausible(bytes: &[u8]) -> Option<usize> {
    let len = announced(bytes)?;
    let is_reply = bytes[1] & REPLY != 0;
    name(*bytes.get(4)?, is_reply).is_some().then_some(len)
}

/// Bytes that may belong to nothing before some of them are told.
const MOST_PENDING: usize = 64 * 1024;

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
            assert_eq!(offset, next, "a byte is told twice, or not");
            next += len as u64;
            items.push((offset, words));
            Ok(())
        };
        let mut finder = Finder::default();
        for piece in bytes.chunks(piece) {
            finder.feed(piece, &mut sink).unwrap();
        }
        finder.end(&mut sink).unwrap();
        assert_eq!(next, bytes.len() as u64);
        items
    }

    #[test]
    fn a_conversation_on_both_lines() {
        let scan = lms::measured::encode(0, Unit::Mm, &[100; 361], 0x10);
        let mut bytes = vec![0xFF, 0x06, 0x33];
        bytes.extend(Request::Status.encode(0).bytes());
        bytes.push(NAK);
        bytes.extend(Request::Stop.encode(0).bytes());
        bytes.extend(&scan.bytes()[..50]);
        bytes.push(ACK);
        bytes.extend(reply::mode(0, true, 0x10).bytes());
        bytes.extend(scan.bytes());
        let mut damaged = reply::refused(0, 0x10).bytes().to_vec();
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
    fn noise_without_end_is_told_in_time() {
        let mut bytes = vec![0x55; 3 * MOST_PENDING];
        let request = Request::Type.encode(0);
        bytes[2 * MOST_PENDING..][..request.bytes().len()].copy_from_slice(request.bytes());
        let items = found(&bytes, 1000);
        assert_eq!(items.iter().filter(|(_, item)| item == "3A").count(), 1);
        assert_eq!(found(&[ACK], 1), [(0, "ack".to_owned())]);
        assert_eq!(found(&[], 1), []);
    }
}
