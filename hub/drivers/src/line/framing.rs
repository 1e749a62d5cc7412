//! Framing of packets that have a fixed length, in a stream that may lack bytes.
//!
//! An 8-bit checksum is right by chance in 1 of 256 cases. If bytes of a packet were lost, the beginning of the next
//! packet appears inside the length of this packet. The framer therefore accepts a packet that contains another header
//! only in two cases: a header follows the packet, or the bytes from the inner header on are not a packet.

use scanhub_schema::Nanos;

/// Format of packets that have a fixed length and begin with a header of two bytes.
pub trait Format {
    /// Reason why bytes that begin with a header are not a packet.
    type Reject;

    /// Returns the length of a packet, in bytes.
    fn packet_len(&self) -> usize;

    /// Returns whether `bytes` begins with a header, or with the first part of a header. Returns `true` if `bytes` is
    /// empty.
    fn begins(&self, bytes: &[u8]) -> bool;

    /// Checks the bytes of a packet.
    ///
    /// # Errors
    ///
    /// Returns the reason why the bytes are not a packet.
    fn check(&self, packet: &[u8]) -> Result<(), Self::Reject>;
}

/// Result of a check for a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameCheck<R> {
    /// The bytes are a packet.
    Packet,
    /// The bytes are not a packet. Contains the reason if the bytes begin with a header but [`Format::check`] failed.
    NoPacket(Option<R>),
    /// The packet is not complete yet.
    Incomplete,
    /// The bytes are a packet, unless another packet begins inside them. The framer needs more bytes to decide.
    Held,
}

/// Checks whether a packet begins at the first byte of `open`. If `is_released`, ignores incomplete packets inside this
/// packet.
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
    /// Bytes of returned packets.
    pub in_packets: u64,
    /// Bytes that were not part of a packet.
    pub discarded: u64,
    /// Returned packets.
    pub packets: u64,
    /// Headers that the framer discarded because the checksum of the packet was wrong.
    pub rejected_checksum: u64,
}

/// Buffer of a framer, with room for `N` open bytes. An open byte has not been discarded, and is not part of a returned
/// packet.
#[derive(Clone, Debug)]
pub struct Buffer<const N: usize> {
    bytes: [u8; N],
    /// The open bytes are `bytes[start..end]`.
    start: usize,
    end: usize,
    /// Time without a byte after which the rest of a packet can no longer arrive.
    hold_time: Nanos,
    /// Whether the framer holds a packet back because another packet may begin inside this packet.
    is_held: bool,
    /// Whether the line has been idle long enough that the framer no longer holds packets back.
    is_released: bool,
    counters: ByteCounters,
}

impl<const N: usize> Buffer<N> {
    /// Creates an empty buffer. If the framer holds a packet back, the buffer releases it after the line was idle for
    /// `hold_time`.
    pub fn new(hold_time: Nanos) -> Self {
        let counters = ByteCounters::default();
        Buffer { bytes: [0; N], start: 0, end: 0, hold_time, is_held: false, is_released: false, counters }
    }

    /// Returns the free space for the next bytes. The caller writes to the beginning of this space and then calls
    /// [`Buffer::commit`]. Positions that [`Buffer::take`] returned become invalid.
    pub fn read_buffer(&mut self) -> &mut [u8] {
        self.bytes.copy_within(self.start..self.end, 0);
        self.end -= self.start;
        self.start = 0;
        &mut self.bytes[self.end..]
    }

    /// Adds the first `len` bytes of [`Buffer::read_buffer`] to the open bytes.
    ///
    /// # Panics
    ///
    /// Panics if the free space is shorter than `len` bytes.
    pub fn commit(&mut self, len: usize) {
        self.end += len;
        assert!(self.end <= N, "more bytes committed than there was room");
        self.counters.read += len as u64;
        self.is_released &= len == 0;
    }

    /// Checks whether a packet begins at index `at` of the open bytes.
    pub fn check_frame<F: Format>(&mut self, format: &F, at: usize) -> FrameCheck<F::Reject> {
        let check = check_frame(format, &self.open_bytes()[at..], self.is_released);
        self.is_held |= matches!(check, FrameCheck::Held);
        check
    }

    /// Starts a new check of the open bytes.
    pub fn begin_check(&mut self) {
        self.is_held = false;
    }

    /// Returns how long the line must be idle before [`Buffer::release`] releases a packet that is held back. Returns
    /// `None` if no packet is held back.
    pub fn hold_time(&self) -> Option<Nanos> {
        self.is_held.then_some(self.hold_time)
    }

    /// Handles a read that returned no bytes. `idle` is the time since the last byte.
    pub fn release(&mut self, idle: Nanos) {
        self.is_released |= self.is_held && idle >= self.hold_time;
    }

    /// Returns the open bytes.
    pub fn open_bytes(&self) -> &[u8] {
        &self.bytes[self.start..self.end]
    }

    /// Returns the offset of the first open byte, counted from the first committed byte.
    pub fn offset(&self) -> u64 {
        self.counters.read - (self.end - self.start) as u64
    }

    /// Takes the first `len` open bytes, which contain `packets` packets. Returns their position for
    /// [`Buffer::taken_bytes`].
    pub fn take(&mut self, len: usize, packets: usize) -> usize {
        let at = self.start;
        self.start += len;
        self.counters.packets += packets as u64;
        self.counters.in_packets += len as u64;
        at
    }

    /// Makes the last `len` taken bytes, which contain `packets` packets, open again.
    pub fn unread(&mut self, len: usize, packets: usize) {
        self.start -= len;
        self.counters.packets -= packets as u64;
        self.counters.in_packets -= len as u64;
    }

    /// Returns the `len` bytes at position `at`, which [`Buffer::take`] returned.
    pub fn taken_bytes(&self, at: usize, len: usize) -> &[u8] {
        &self.bytes[at..at + len]
    }

    /// Discards the first `len` open bytes, and counts them.
    pub fn discard(&mut self, len: usize) {
        self.start += len;
        self.counters.discarded += len as u64;
    }

    /// Discards all open bytes, for example because the baud rate changes.
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

/// Moves bytes from the front of `bytes` into `buffer` until `bytes` is empty or `buffer` is full. Returns the number
/// of bytes moved.
pub(crate) fn fill(buffer: &mut [u8], bytes: &mut &[u8]) -> usize {
    let len = buffer.len().min(bytes.len());
    let (now, later) = bytes.split_at(len);
    buffer[..len].copy_from_slice(now);
    *bytes = later;
    len
}

/// Length of a header, in bytes.
const HEADER_LEN: usize = 2;
