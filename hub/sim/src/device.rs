//! The scanner's end of a line: the trait of every simulated scanner, and its transmitter.
//!
//! To drive a scanner, call [`Device::poll_transmit`] until it returns `None`, and pass the host's bytes to
//! [`Device::receive`]. Repeat both at the time that [`Device::poll_timeout`] returns. `Transmission` sends one
//! telegram or one single byte at the rate of the line, in the chunks that the receiver's hardware delivers. `TxQueue`
//! sends the packets and replies of a rotating scanner, one after the other.

use std::collections::VecDeque;

use scanhub_drivers::lms::variant::{BYTES_PER_REVOLUTION, MIRROR_PERIOD};
use scanhub_schema::{Nanos, line_time};

use crate::request_decoder::{Arrival, DroppedRequest};

/// A simulated scanner.
pub trait Device {
    /// Returns the next chunk whose transmission is complete at `now`, or `None` if there is no such chunk.
    fn poll_transmit(&mut self, now: Nanos) -> Option<Chunk>;

    /// Returns the time at which the next chunk is complete, or `None` if the scanner sends nothing.
    fn poll_timeout(&self) -> Option<Nanos>;

    /// Receives a byte of the host. Before, call [`Device::poll_transmit`] with `arrival.not_after` until it returns
    /// `None`.
    fn receive(&mut self, byte: u8, arrival: Arrival);

    /// Switches the power off and on. Returns whether a telegram was aborted.
    fn power_cycle(&mut self, now: Nanos) -> bool;

    /// Makes the voltage dip at `now`, so that the scanner restarts. Returns whether a telegram was aborted.
    fn brown_out(&mut self, now: Nanos) -> bool {
        self.power_cycle(now)
    }

    /// Aborts the current telegram. A stream continues with a whole telegram.
    fn abort(&mut self, now: Nanos);

    /// Returns the rate of the line in bits per second.
    fn rate(&self) -> u32;

    /// Returns whether the scanner streams.
    fn streams(&self) -> bool;

    /// Returns the length of a telegram if all telegrams have the same length. Otherwise each telegram contains its
    /// length.
    fn telegram_len(&self) -> Option<usize> {
        None
    }

    /// Returns the last request that the scanner dropped because of the gaps between its bytes. Each dropped request is
    /// returned at most once.
    fn take_dropped(&mut self) -> Option<DroppedRequest> {
        None
    }

    /// Returns the number of received requests to change the permanent settings, whether the scanner executed or
    /// refused them.
    fn eeprom_writes(&self) -> u64 {
        0
    }
}

/// Bytes that the host's hardware delivers at once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Chunk {
    /// Up to 62 bytes. There are none if the chunk only ends a telegram that was aborted during a pause. An LMS pauses
    /// after every 508 bytes of a telegram.
    pub bytes: Vec<u8>,
    /// Rate of the line in bits per second.
    pub rate: u32,
    /// Whether the line is idle after these bytes.
    pub idle_after: bool,
    /// Position in the telegram.
    pub part: ChunkKind,
}

/// The position of a chunk in its telegram.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ChunkKind {
    /// A single ACK or NAK.
    Acknowledge,
    /// Bytes of a telegram, without its last byte.
    Telegram,
    /// The last bytes of a telegram.
    End(SentTelegram),
}

/// A telegram that was sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SentTelegram {
    /// Whether the telegram is a reply. Otherwise it is data of the stream.
    pub is_reply: bool,
    /// The complete telegram, including bytes that were not sent because it was aborted.
    pub telegram: Vec<u8>,
    /// Whether the telegram was aborted by a request or a power cycle.
    pub aborted: bool,
}

/// Number of bytes that the receiving hardware collects before its driver receives them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChunkSize {
    /// A 16550's FIFO: 16 bytes.
    Uart,
    /// A full-speed USB packet of a common adapter, without its two status bytes: 62 bytes.
    Usb,
}

impl ChunkSize {
    /// Returns the number of bytes: 16 or 62.
    pub fn bytes(self) -> usize {
        match self {
            ChunkSize::Uart => 16,
            ChunkSize::Usb => 62,
        }
    }
}

/// Transmission of bytes without gaps from a start time on, except for the pauses of an LMS between two revolutions of
/// its mirror.
#[derive(Debug)]
pub(crate) struct Transmission<T> {
    bytes: Vec<u8>,
    /// Number of bytes to send. It is smaller than the length of the telegram if the transmission was aborted.
    send_len: usize,
    taken_len: usize,
    start_ns: Nanos,
    rate: u32,
    chunk: usize,
    /// Value that the sender attached, for use at the end of the transmission.
    pub(crate) tag: T,
}

impl<T> Transmission<T> {
    /// Creates a transmission of `bytes` (at least one) that starts at `start_ns`.
    pub(crate) fn new(bytes: Vec<u8>, start_ns: Nanos, rate: u32, chunk: ChunkSize, tag: T) -> Self {
        let leaving = bytes.len();
        Transmission { bytes, send_len: leaving, taken_len: 0, start_ns, rate, chunk: chunk.bytes(), tag }
    }

    /// Returns the time at which the next chunk is complete.
    pub(crate) fn next_chunk_ns(&self) -> Nanos {
        self.end_of_bytes_ns(self.chunk_end())
    }

    /// Returns the time at which the last byte ends.
    pub(crate) fn end_ns(&self) -> Nanos {
        self.end_of_bytes_ns(self.send_len)
    }

    /// Returns the time at which the first byte starts.
    pub(crate) fn start_ns(&self) -> Nanos {
        self.start_ns
    }

    /// Delays the start to `at_ns`, unless the start is later already. Call this function before the first byte was
    /// taken.
    pub(crate) fn start_no_earlier(&mut self, at_ns: Nanos) {
        self.start_ns = self.start_ns.max(at_ns);
    }

    /// Returns the rate of the line in bits per second.
    pub(crate) fn rate(&self) -> u32 {
        self.rate
    }

    /// Returns the next chunk if it is complete at `now`, and whether the line is idle after the chunk. The chunk is
    /// empty if the transmission was aborted during the pause after the last chunk.
    pub(crate) fn take_chunk(&mut self, now: Nanos) -> Option<(&[u8], bool)> {
        if self.next_chunk_ns() > now {
            return None;
        }
        let (from, to) = (self.taken_len, self.chunk_end());
        self.taken_len = to;
        Some((&self.bytes[from..to], to == self.send_len || to % BYTES_PER_REVOLUTION == 0))
    }

    /// Returns whether all bytes to send were taken.
    pub(crate) fn is_done(&self) -> bool {
        self.taken_len == self.send_len
    }

    /// Returns whether the transmission was aborted before its last byte.
    pub(crate) fn is_aborted(&self) -> bool {
        self.send_len < self.bytes.len()
    }

    /// Ends the transmission with the byte that is in the transmitter at `now`.
    pub(crate) fn abort(&mut self, now: Nanos) {
        let byte_ns = line_time(1, self.rate);
        let started =
            (0..self.send_len).take_while(|&i| self.end_of_bytes_ns(i + 1) - byte_ns <= now).count();
        self.send_len = started.max(self.taken_len).max(1);
    }

    /// Returns all bytes, including those that were not sent, and the tag.
    pub(crate) fn into_parts(self) -> (Vec<u8>, T) {
        (self.bytes, self.tag)
    }

    /// Returns the time at which the first `count` (at least 1) bytes end. An LMS sends at most 508 bytes per
    /// revolution of its mirror. If the line carries 508 bytes in less time than a revolution, the LMS pauses after
    /// them until the next revolution. Packets of rotating scanners are shorter.
    fn end_of_bytes_ns(&self, count: usize) -> Nanos {
        let rate = self.rate;
        let revolutions = (count - 1) / BYTES_PER_REVOLUTION;
        let revolution_ns = MIRROR_PERIOD.max(line_time(BYTES_PER_REVOLUTION, rate));
        self.start_ns
            + revolutions as Nanos * revolution_ns
            + line_time(count - revolutions * BYTES_PER_REVOLUTION, rate)
    }

    fn chunk_end(&self) -> usize {
        let revolution_end = (self.taken_len / BYTES_PER_REVOLUTION + 1) * BYTES_PER_REVOLUTION;
        (self.taken_len + self.chunk).min(revolution_end).min(self.send_len)
    }
}

/// Transmit queue of a rotating scanner. It sends one telegram after the other.
#[derive(Debug)]
pub(crate) struct TxQueue {
    /// The transmissions in the order of their start. The tag is true if the telegram is a reply.
    queue: VecDeque<Transmission<bool>>,
    chunk: ChunkSize,
    rate: u32,
    free_ns: Nanos,
}

impl TxQueue {
    /// Creates a queue that sends at `rate` bits per second, in chunks of the size `chunk`.
    pub(crate) fn new(rate: u32, chunk: ChunkSize) -> TxQueue {
        TxQueue { queue: VecDeque::new(), chunk, rate, free_ns: 0 }
    }

    /// Sends `telegram` after all earlier telegrams, at `at_ns` at the earliest.
    pub(crate) fn send(&mut self, telegram: Vec<u8>, at_ns: Nanos, is_reply: bool) {
        let start_ns = at_ns.max(self.free_ns);
        let transmission = Transmission::new(telegram, start_ns, self.rate, self.chunk, is_reply);
        self.free_ns = transmission.end_ns();
        self.queue.push_back(transmission);
    }

    /// Returns the next chunk, if it is complete at `now`.
    pub(crate) fn take(&mut self, now: Nanos) -> Option<Chunk> {
        let rate = self.rate;
        let front = self.queue.front_mut()?;
        let (bytes, idle_after) = front.take_chunk(now)?;
        let bytes = bytes.to_vec();
        if !front.is_done() {
            return Some(Chunk { bytes, rate, idle_after, part: ChunkKind::Telegram });
        }
        let front = self.queue.pop_front()?;
        let aborted = front.is_aborted();
        let (telegram, is_reply) = front.into_parts();
        Some(Chunk {
            bytes,
            rate,
            idle_after,
            part: ChunkKind::End(SentTelegram { is_reply, telegram, aborted }),
        })
    }

    /// Returns the time at which the next chunk is complete, or `None` if the queue is empty.
    pub(crate) fn next_ns(&self) -> Option<Nanos> {
        self.queue.front().map(Transmission::next_chunk_ns)
    }

    /// Returns the time at which the last telegram ends.
    pub(crate) fn free_ns(&self) -> Nanos {
        self.free_ns
    }

    /// Aborts the current telegram and drops all others. Returns whether a telegram was aborted.
    pub(crate) fn abort(&mut self, now: Nanos) -> bool {
        self.queue.retain(|transmission| transmission.start_ns() <= now);
        let mut broken = false;
        self.free_ns = now;
        for transmission in &mut self.queue {
            transmission.abort(now);
            broken |= transmission.is_aborted();
            self.free_ns = transmission.end_ns().max(now);
        }
        broken
    }

    /// Drops the telegrams of the stream whose transmission has not started. Replies remain.
    pub(crate) fn drop_data(&mut self, now: Nanos) {
        self.queue.retain(|transmission| transmission.tag || transmission.start_ns() <= now);
        self.free_ns = self.queue.back().map_or(now, Transmission::end_ns);
    }

    /// Returns the rate of the line in bits per second.
    pub(crate) fn rate(&self) -> u32 {
        self.rate
    }
}

#[cfg(test)]
mod tests {
    use scanhub_schema::MICROS;

    use super::*;

    fn times(mut transmission: Transmission<()>) -> Vec<(usize, Nanos, bool)> {
        let mut all = Vec::new();
        while !transmission.is_done() {
            let at = transmission.next_chunk_ns();
            assert_eq!(transmission.take_chunk(at - 1), None);
            let (bytes, idle) = transmission.take_chunk(at).unwrap();
            all.push((bytes.len(), at, idle));
        }
        all
    }

    #[test]
    fn sends_half_degree_scan_at_500k_in_two_bursts() {
        let chunks = times(Transmission::new(vec![7; 732], 0, 500_000, ChunkSize::Uart, ()));
        assert_eq!(chunks.iter().map(|c| c.0).sum::<usize>(), 732);
        assert_eq!(chunks[0], (16, 320 * MICROS, false));
        assert_eq!(chunks[31], (12, 10_160 * MICROS, true));
        assert_eq!(chunks[32], (16, 13_640 * MICROS, false));
        assert_eq!(*chunks.last().unwrap(), (16, 17_800 * MICROS, true));
        let usb = times(Transmission::new(vec![7; 732], 0, 500_000, ChunkSize::Usb, ()));
        assert_eq!(usb.len(), 13);
    }

    #[test]
    fn slow_line_does_not_pause() {
        let chunks = times(Transmission::new(vec![7; 732], 5, 38_400, ChunkSize::Uart, ()));
        let longest = chunks.windows(2).map(|w| w[1].1 - w[0].1).max().unwrap();
        assert!(longest <= line_time(16, 38_400) + 1);
        assert_eq!(chunks.last().unwrap().1, 5 + line_time(508, 38_400) + line_time(224, 38_400));
    }

    #[test]
    fn aborted_transmission_ends_after_the_current_byte() {
        let mut transmission = Transmission::new(vec![7; 732], 0, 500_000, ChunkSize::Uart, ());
        assert!(transmission.take_chunk(320 * MICROS).is_some());
        transmission.abort(405 * MICROS);
        // Byte 20 began at 400 us.
        assert_eq!(transmission.end_ns(), 420 * MICROS);
        assert_eq!(transmission.take_chunk(420 * MICROS), Some((&[7; 5][..], true)));
        assert!(transmission.is_done() && transmission.is_aborted());
    }
}
