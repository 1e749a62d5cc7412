//! Framing of packets with a fixed length, in a stream that may lack bytes: the check of a packet, and the buffer of a framer.
//!
//! An 8-bit checksum is right by chance in 1 of 256 cases, and a packet that lost bytes includes the beginning of the next one.
//! A packet that contains another header is therefore accepted only if a header follows it, or if the bytes from the inner
//! header on are not a packet.

use scanhub_schema::Nanos;

/// Format of packets that have a fixed length and begin with a header of two bytes.
pub trait Format {
    /// Reason why bytes that begin like a packet are not one.
    type Reject;

    /// Returns the length of a packet, in bytes.
    fn packet_len(&self) -> usize;

    /// Returns whether `bytes` may be the beginning of a header. No bytes may be.
    fn begins(&self, bytes: &[u8]) -> bool;

    /// Checks the bytes of a packet.
    ///
    /// # Errors
    ///
    /// Returns why they are not a packet.
    fn check(&self, packet: &[u8]) -> Result<(), Self::Reject>;
}

/// Result of checking for a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameCheck<R> {
    /// A packet.
    Packet,
    /// No packet. Contains the reason if the bytes begin like one and the check failed.
    NoPacket(Option<R>),
    /// More bytes are needed.
    Incomplete,
    /// A packet, unless another one begins inside it. More bytes are needed to decide.
    Held,
}

/// Checks whether a packet begins at the first byte of `open`. If `is_released`, incomplete packets inside it are ignored.
fn check_frame<F: Format>(format: &F, open: &[u8], is_released: bool) -> FrameCheck<F::Reject> {
    let len = format.packet_len();
    if !format.begins(open) {
        return FrameCheck::NoPacket(None);
    }
    let Some(packet) = open.get(..len) else { return FrameCheck::Incomplete };
    if let Err(reject) = format.check(packet) {
        return FrameCheck::NoPacket(Some(reject));
    }
    if open.len() >= len + HEADER_LEN && format.begins(&open[len..]) {
        return FrameCheck::Packet;
    }
    for offset in (1..len).filter(|&inside| format.begins(&open[inside..])) {
        match open.get(offset..offset + len).map(|inner| format.check(inner)) {
            Some(Ok(())) => return FrameCheck::NoPacket(None),
            Some(Err(_)) => {}
            None if is_released => {}
            None => return FrameCheck::Held,
        }
    }
    FrameCheck::Packet
}

/// Counters of a framer. They only increase, and `read == in_packets + discarded + buffered`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ByteCounters {
    /// Bytes committed.
    pub read: u64,
    /// Bytes of packets that were returned.
    pub in_packets: u64,
    /// Bytes that were in no packet.
    pub discarded: u64,
    /// Packets that were returned.
    pub packets: u64,
    /// Discarded headers whose packet had a wrong checksum.
    pub rejected_checksum: u64,
}

/// Buffer of a framer: up to `N` open bytes, which are neither in a packet nor discarded yet.
#[derive(Clone, Debug)]
pub struct Buffer<const N: usize> {
    bytes: [u8; N],
    /// `bytes[start..end]` are open.
    start: usize,
    end: usize,
    /// Time without a byte after which no more bytes are in flight.
    hold: Nanos,
    /// Whether a packet is held back, because another one may begin inside it.
    is_held: bool,
    /// Whether it does not have to be held back any longer.
    is_released: bool,
    counters: ByteCounters,
}

impl<const N: usize> Buffer<N> {
    /// Creates an empty buffer. A packet that is held back is released when the line was idle for `hold`.
    pub fn new(hold: Nanos) -> Self {
        let counters = ByteCounters::default();
        Buffer { bytes: [0; N], start: 0, end: 0, hold, is_held: false, is_released: false, counters }
    }

    /// Returns the free space for the next bytes. Write to its beginning, then call [`Buffer::commit`]. Invalidates the results
    /// of [`Buffer::take`].
    pub fn read_buffer(&mut self) -> &mut [u8] {
        self.bytes.copy_within(self.start..self.end, 0);
        self.end -= self.start;
        self.start = 0;
        &mut self.bytes[self.end..]
    }

    /// Adds the first `len` bytes of [`Buffer::read_buffer`].
    ///
    /// # Panics
    ///
    /// Panics if there was no space for them.
    pub fn commit(&mut self, len: usize) {
        self.end += len;
        assert!(self.end <= N, "more bytes committed than there was room");
        self.counters.read += len as u64;
        self.is_released &= len == 0;
    }

    /// Checks whether a packet begins at the open byte number `at`.
    pub fn check_frame<F: Format>(&mut self, format: &F, at: usize) -> FrameCheck<F::Reject> {
        let check = check_frame(format, &self.open_bytes()[at..], self.is_released);
        self.is_held |= matches!(check, FrameCheck::Held);
        check
    }

    /// Begins to check the open bytes again.
    pub fn begin_check(&mut self) {
        self.is_held = false;
    }

    /// Returns how long the line must be idle until [`Buffer::release`] releases a packet that is held back. `None` if there is
    /// none.
    pub fn hold(&self) -> Option<Nanos> {
        self.is_held.then_some(self.hold)
    }

    /// Handles a read that found nothing. No byte has arrived for `idle`.
    pub fn release(&mut self, idle: Nanos) {
        self.is_released |= self.is_held && idle >= self.hold;
    }

    /// Returns the open bytes.
    pub fn open_bytes(&self) -> &[u8] {
        &self.bytes[self.start..self.end]
    }

    /// Returns the number of the first open byte among all committed bytes, from 0.
    pub fn offset(&self) -> u64 {
        self.counters.read - (self.end - self.start) as u64
    }

    /// Takes the first `len` open bytes, which are `packets` packets. Returns their position for [`Buffer::taken_bytes`].
    pub fn take(&mut self, len: usize, packets: usize) -> usize {
        let at = self.start;
        self.start += len;
        self.counters.packets += packets as u64;
        self.counters.in_packets += len as u64;
        at
    }

    /// Makes the last `len` bytes that were taken, which are `packets` packets, open again.
    pub fn unread(&mut self, len: usize, packets: usize) {
        self.start -= len;
        self.counters.packets -= packets as u64;
        self.counters.in_packets -= len as u64;
    }

    /// Returns `len` bytes that [`Buffer::take`] took at position `at`.
    pub fn taken_bytes(&self, at: usize, len: usize) -> &[u8] {
        &self.bytes[at..at + len]
    }

    /// Discards the first `len` open bytes.
    pub fn discard(&mut self, len: usize) {
        self.start += len;
        self.counters.discarded += len as u64;
    }

    /// Discards all open bytes, for example because the rate of the line changes.
    pub fn clear(&mut self) {
        self.discard(self.end - self.start);
        (self.is_held, self.is_released) = (false, false);
    }

    /// Counts a discarded header whose packet had a wrong checksum.
    pub fn reject_checksum(&mut self) {
        self.counters.rejected_checksum += 1;
    }

    /// Returns the counters.
    pub fn byte_counters(&self) -> &ByteCounters {
        &self.counters
    }
}

/// Moves the first of `bytes` into `spare`. Returns their number.
pub(crate) fn fill(buffer: &mut [u8], bytes: &mut &[u8]) -> usize {
    let len = buffer.len().min(bytes.len());
    let (now, later) = bytes.split_at(len);
    buffer[..len].copy_from_slice(now);
    *bytes = later;
    len
}

/// Length of a header, in bytes.
const HEADER_LEN: usize = 2;
