//! One telegram (or single byte) on its way out: which of its bytes have passed the line at a given time, and in which
//! chunks the receiver's hardware hands them over. Refuses to know what the bytes mean and who asked for them.

use scanhub_drivers::lms::variant::{BYTES_PER_TURN, MIRROR_TURN};
use schema::{Nanos, line_time};

/// How many bytes the receiving hardware collects before its driver sees them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChunkSize {
    /// A 16550's FIFO: 16 bytes.
    Uart,
    /// A full-speed USB packet of a common adapter without its two status bytes: 62.
    Usb,
}

impl ChunkSize {
    /// Bytes: 16 or 62.
    pub fn bytes(self) -> usize {
        match self {
            ChunkSize::Uart => 16,
            ChunkSize::Usb => 62,
        }
    }
}

/// Bytes that leave one after the other from a point in time on.
#[derive(Debug)]
pub(crate) struct Transmission<T> {
    bytes: Vec<u8>,
    /// How many of them leave: all, or fewer if it was broken off.
    leaving: usize,
    handed: usize,
    start_ns: Nanos,
    rate: u32,
    chunk: usize,
    /// What the sender wants to know at its end.
    pub(crate) tag: T,
}

impl<T> Transmission<T> {
    /// `bytes` (at least one) from `start_ns` on.
    pub(crate) fn new(bytes: Vec<u8>, start_ns: Nanos, rate: u32, chunk: ChunkSize, tag: T) -> Self {
        let leaving = bytes.len();
        Transmission { bytes, leaving, handed: 0, start_ns, rate, chunk: chunk.bytes(), tag }
    }

    /// When the next chunk is complete.
    pub(crate) fn next_chunk_ns(&self) -> Nanos {
        self.through_ns(self.chunk_end())
    }

    /// When its last byte is through.
    pub(crate) fn end_ns(&self) -> Nanos {
        self.through_ns(self.leaving)
    }

    /// When its first byte begins.
    pub(crate) fn start_ns(&self) -> Nanos {
        self.start_ns
    }

    /// Starts at `at_ns` if it would have started earlier; only before its first byte was taken.
    pub(crate) fn start_no_earlier(&mut self, at_ns: Nanos) {
        self.start_ns = self.start_ns.max(at_ns);
    }

    /// Rate of the line.
    pub(crate) fn rate(&self) -> u32 {
        self.rate
    }

    /// The next chunk, if it is complete at `now`, and whether the line is idle after it. It is empty where everything
    /// that leaves was taken: broken off between two bursts.
    pub(crate) fn take_chunk(&mut self, now: Nanos) -> Option<(&[u8], bool)> {
        if self.next_chunk_ns() > now {
            return None;
        }
        let (from, to) = (self.handed, self.chunk_end());
        self.handed = to;
        Some((&self.bytes[from..to], to == self.leaving || to % BYTES_PER_TURN == 0))
    }

    /// Whether every byte that leaves was taken.
    pub(crate) fn is_done(&self) -> bool {
        self.handed == self.leaving
    }

    /// Whether it was broken off before its last byte.
    pub(crate) fn is_broken(&self) -> bool {
        self.leaving < self.bytes.len()
    }

    /// Ends it with the byte that is in the transmitter at `now`.
    pub(crate) fn break_off(&mut self, now: Nanos) {
        let byte_ns = line_time(1, self.rate);
        let begun = (0..self.leaving).take_while(|&i| self.through_ns(i + 1) - byte_ns <= now).count();
        self.leaving = begun.max(self.handed).max(1);
    }

    /// All bytes, those that did not leave too.
    pub(crate) fn into_parts(self) -> (Vec<u8>, T) {
        (self.bytes, self.tag)
    }

    /// When `count` (at least 1) bytes are through. Where 508 bytes need less than a mirror turn, the rest waits for
    /// the next turn.
    fn through_ns(&self, count: usize) -> Nanos {
        let rate = self.rate;
        let turns = (count - 1) / BYTES_PER_TURN;
        let turn_ns = MIRROR_TURN.max(line_time(BYTES_PER_TURN, rate));
        self.start_ns + turns as Nanos * turn_ns + line_time(count - turns * BYTES_PER_TURN, rate)
    }

    fn chunk_end(&self) -> usize {
        let turn_end = (self.handed / BYTES_PER_TURN + 1) * BYTES_PER_TURN;
        (self.handed + self.chunk).min(turn_end).min(self.leaving)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use schema::MICROS;

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
    fn half_degree_at_500k_comes_in_two_bursts() {
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
    fn a_slow_line_does_not_pause() {
        let chunks = times(Transmission::new(vec![7; 732], 5, 38_400, ChunkSize::Uart, ()));
        let longest = chunks.windows(2).map(|w| w[1].1 - w[0].1).max().unwrap();
        assert!(longest <= line_time(16, 38_400) + 1);
        assert_eq!(chunks.last().unwrap().1, 5 + line_time(508, 38_400) + line_time(224, 38_400));
    }

    #[test]
    fn broken_off_after_the_byte_in_the_transmitter() {
        let mut transmission = Transmission::new(vec![7; 732], 0, 500_000, ChunkSize::Uart, ());
        assert!(transmission.take_chunk(320 * MICROS).is_some());
        transmission.break_off(405 * MICROS);
        // Byte 20 began at 400 us.
        assert_eq!(transmission.end_ns(), 420 * MICROS);
        assert_eq!(transmission.take_chunk(420 * MICROS), Some((&[7; 5][..], true)));
        assert!(transmission.is_done() && transmission.is_broken());
    }
}
