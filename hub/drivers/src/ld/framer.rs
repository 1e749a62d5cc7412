//! Finds packets in a stream of bytes of which some are missing, without ever throwing away an intact one.
//!
//! Knows no clock.

use crate::line;
use crate::line::framing::{Verdict, judge};
use crate::line::{Buffer, Tally, suspect};
use scanhub_schema::{MILLIS, Nanos};

use crate::ld::packet::{HEADER, LEN, Packet, Reject};

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
#[derive(Clone, Debug, Default)]
pub struct Framer {
    buffer: Buffer<CAPACITY>,
    /// A packet waits for a header inside it.
    is_held: bool,
    /// It shall not any more.
    is_released: bool,
    /// Bytes were discarded since the last packet.
    damage: bool,
}

struct Format;

impl line::framing::Format for Format {
    type Reject = Reject;

    fn packet_len(&self) -> usize {
        LEN
    }

    fn begins(&self, bytes: &[u8]) -> bool {
        let len = bytes.len().min(HEADER.len());
        bytes[..len] == HEADER[..len]
    }

    fn check(&self, packet: &[u8]) -> Result<(), Reject> {
        packet.first_chunk().map_or(Err(Reject::Checksum), Packet::check).map(|_| ())
    }
}

impl Framer {
    /// Room for the next bytes, never empty after [`Framer::advance`] answered `None`: write into its beginning, then
    /// [`Framer::commit`].
    pub fn spare(&mut self) -> &mut [u8] {
        self.buffer.spare()
    }

    /// The first `len` bytes of [`Framer::spare`] are valid now.
    pub fn commit(&mut self, len: usize) {
        self.buffer.commit(len);
        self.is_released &= len == 0;
    }

    /// The next packets, `most` at most; `None` until more bytes come.
    pub fn advance(&mut self, most: usize) -> Option<Span> {
        self.is_held = false;
        loop {
            match self.judge(0) {
                Verdict::Packet => break,
                Verdict::Open | Verdict::Held => return None,
                Verdict::Nothing(rejected) => self.discard(rejected),
            }
        }
        let mut packets = 1;
        while packets < most && matches!(self.judge(packets * LEN), Verdict::Packet) {
            packets += 1;
        }
        let is_damaged = core::mem::take(&mut self.damage) && self.tally().packets > 0;
        let offset = self.buffer.offset();
        let at = self.buffer.take(packets * LEN, packets);
        Some(Span { at, packets, offset, reasons: if is_damaged { suspect::NEIGHBOUR } else { 0 } })
    }

    /// The bytes at a span that [`Framer::advance`] answered last.
    pub fn bytes(&self, span: Span) -> &[u8] {
        self.buffer.taken(span.at, span.packets * LEN)
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
        self.buffer.clear();
        (self.is_held, self.is_released, self.damage) = (false, false, false);
    }

    /// What became of the bytes.
    pub fn tally(&self) -> &Tally {
        self.buffer.tally()
    }

    /// Bytes whose fate is open.
    pub fn buffered(&self) -> usize {
        self.buffer.open().len()
    }

    fn judge(&mut self, at: usize) -> Verdict<Reject> {
        let verdict = judge(&Format, &self.buffer.open()[at..], self.is_released);
        self.is_held |= verdict == Verdict::Held;
        verdict
    }

    /// Gives up the first open byte and all behind it up to the next that a packet may begin with.
    fn discard(&mut self, rejected: Option<Reject>) {
        if rejected == Some(Reject::Checksum) {
            self.buffer.reject_checksum();
        }
        let behind = &self.buffer.open()[1..];
        let skipped = 1 + behind.iter().position(|&byte| byte == HEADER[0]).unwrap_or(behind.len());
        self.buffer.discard(skipped);
        self.damage = true;
    }
}

/// What a tty keeps for a reader who is late, and a piece of a packet.
const CAPACITY: usize = 4_096 + 2 * LEN;
/// A packet takes 2.04 ms at 230,400 baud; after so long without a byte none is under way.
const HOLD: Nanos = 4 * MILLIS;
