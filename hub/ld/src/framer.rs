//! Finds packets in a stream of bytes of which some are missing, without ever throwing away an intact one.
//!
//! The checksum has 8 bits, so of bytes that only begin like a packet 1 of 256 passes it, and would take the head of the
//! next one along. So a packet in which another header begins is believed only if a header follows it, or if what begins
//! inside turns out to be none. Knows no clock; accounts for every byte: in [`Tally`] always
//! `read == in_packets + discarded + buffered`.

use line::{MILLIS, Nanos, suspect};

use crate::packet::{HEADER, LEN, Packet, Reject};

/// What became of the bytes; every field only grows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Bytes committed.
    pub read: u64,
    /// Bytes of packets that were handed out.
    pub in_packets: u64,
    /// Bytes that were in nothing.
    pub discarded: u64,
    /// Packets that were handed out.
    pub packets: u64,
    /// Headers among the discarded bytes of which the checksum was wrong.
    pub rejected_checksum: u64,
    /// Those of which the angles were none.
    pub rejected_angle: u64,
    /// Those that passed, but another packet began inside and passed as well.
    pub rejected_overlap: u64,
}

/// Packets without anything between them, in the framer's buffer until the next bytes come.
#[derive(Clone, Copy, Debug)]
pub struct Span {
    at: usize,
    /// How many.
    pub packets: usize,
    /// Number of the first byte among all bytes committed, from 0.
    pub offset: u64,
    /// Bits of [`suspect`]; 0 is clean.
    pub reasons: u8,
}

/// The framer with its buffer.
#[derive(Clone, Debug)]
pub struct Framer {
    buffer: [u8; CAPACITY],
    /// `buffer[start..end]` are the bytes whose fate is open.
    start: usize,
    end: usize,
    /// A packet waits for a header inside it.
    is_held: bool,
    /// It shall not any more.
    is_released: bool,
    /// Bytes were discarded since the last packet.
    damage: bool,
    tally: Tally,
}

/// What begins at a place.
enum Verdict {
    Packet,
    Nothing(Option<Rejected>),
    Open,
}

enum Rejected {
    As(Reject),
    Overlap,
}

impl Default for Framer {
    fn default() -> Self {
        Framer {
            buffer: [0; CAPACITY],
            start: 0,
            end: 0,
            is_held: false,
            is_released: false,
            damage: false,
            tally: Tally::default(),
        }
    }
}

impl Framer {
    /// Room for the next bytes, never empty after [`Framer::advance`] answered `None`: write into its beginning, then
    /// [`Framer::commit`].
    pub fn spare(&mut self) -> &mut [u8] {
        self.buffer.copy_within(self.start..self.end, 0);
        self.end -= self.start;
        self.start = 0;
        &mut self.buffer[self.end..]
    }

    /// The first `len` bytes of [`Framer::spare`] are valid now.
    pub fn commit(&mut self, len: usize) {
        self.end += len;
        assert!(self.end <= CAPACITY, "more bytes committed than there was room");
        self.tally.read += len as u64;
        self.is_released &= len == 0;
    }

    /// The next packets, `most` at most; `None` until more bytes come.
    pub fn advance(&mut self, most: usize) -> Option<Span> {
        self.is_held = false;
        loop {
            match self.judge(self.start) {
                Verdict::Packet => break,
                Verdict::Open => return None,
                Verdict::Nothing(rejected) => self.discard(rejected),
            }
        }
        let at = self.start;
        let offset = self.tally.read - (self.end - at) as u64;
        let mut packets = 1;
        while packets < most && matches!(self.judge(at + packets * LEN), Verdict::Packet) {
            packets += 1;
        }
        self.start += packets * LEN;
        let is_damaged = core::mem::take(&mut self.damage) && self.tally.packets > 0;
        self.tally.packets += packets as u64;
        self.tally.in_packets += (packets * LEN) as u64;
        Some(Span { at, packets, offset, reasons: if is_damaged { suspect::NEIGHBOUR } else { 0 } })
    }

    /// The bytes at a span that [`Framer::advance`] answered last.
    pub fn bytes(&self, span: Span) -> &[u8] {
        &self.buffer[span.at..span.at + span.packets * LEN]
    }

    /// How long the line must be idle until [`Framer::release`] may let the packet pass that waits; `None` if none does.
    pub fn hold(&self) -> Option<Nanos> {
        self.is_held.then_some(HOLD)
    }

    /// A read found nothing, and no byte came for `idle`: gives up waiting for headers inside a packet.
    pub fn release(&mut self, idle: Nanos) {
        self.is_released |= self.is_held && idle >= HOLD;
    }

    /// Gives up all bytes that are still open, for example because the line's rate changes.
    pub fn clear(&mut self) {
        self.tally.discarded += (self.end - self.start) as u64;
        (self.start, self.end) = (0, 0);
        (self.is_held, self.is_released, self.damage) = (false, false, false);
    }

    /// What became of the bytes.
    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// Bytes whose fate is open.
    pub fn buffered(&self) -> usize {
        self.end - self.start
    }

    fn judge(&mut self, at: usize) -> Verdict {
        let open = &self.buffer[at..self.end];
        if !begins(open) {
            return Verdict::Nothing(None);
        }
        let Some(bytes) = open.first_chunk() else { return Verdict::Open };
        if let Err(reject) = Packet::check(bytes) {
            return Verdict::Nothing(Some(Rejected::As(reject)));
        }
        let is_followed = open.get(LEN..LEN + HEADER.len()) == Some(&HEADER[..]);
        let rivals = (1..LEN).filter(|&inside| begins(&open[inside..]));
        for inside in rivals.filter(|_| !is_followed) {
            match open[inside..].first_chunk().map(Packet::check) {
                Some(Ok(_)) => return Verdict::Nothing(Some(Rejected::Overlap)),
                Some(Err(_)) => {}
                None if self.is_released => {}
                None => {
                    self.is_held = true;
                    return Verdict::Open;
                }
            }
        }
        Verdict::Packet
    }

    /// Gives up the first open byte and all behind it up to the next that a packet may begin with.
    fn discard(&mut self, rejected: Option<Rejected>) {
        match rejected {
            Some(Rejected::As(Reject::Checksum)) => self.tally.rejected_checksum += 1,
            Some(Rejected::As(Reject::Angle)) => self.tally.rejected_angle += 1,
            Some(Rejected::Overlap) => self.tally.rejected_overlap += 1,
            None => {}
        }
        let behind = &self.buffer[self.start + 1..self.end];
        let skipped = 1 + behind.iter().position(|&byte| byte == HEADER[0]).unwrap_or(behind.len());
        self.start += skipped;
        self.tally.discarded += skipped as u64;
        self.damage = true;
    }
}

/// Whether a header may begin here, as far as there are bytes; nothing may become one.
fn begins(bytes: &[u8]) -> bool {
    let len = bytes.len().min(HEADER.len());
    bytes[..len] == HEADER[..len]
}

/// What a tty keeps for a reader who is late, and a piece of a packet.
const CAPACITY: usize = 4_096 + 2 * LEN;
/// A packet takes 2.04 ms at 230,400 baud; after so long without a byte none is under way.
const HOLD: Nanos = 4 * MILLIS;
