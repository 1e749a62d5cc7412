//! Bounds for the arrival time of a byte. A port reports only the time at which a read returned, and the number of
//! bytes in the read.

use scanhub_schema::{Nanos, line_time};

/// Log of the last `CAPACITY` reads. Each entry has the offset of the first byte after the read, and the time of the
/// read.
#[derive(Clone, Debug, Default)]
pub struct ReadLog {
    reads: [(u64, Nanos); ReadLog::CAPACITY],
    next: usize,
    total: u64,
}

/// Timing of a stream. Bytes are `byte_ns` nanoseconds apart on average. The bytes of one packet may arrive all at
/// once, or at the bit rate of a line.
#[derive(Clone, Copy, Debug)]
pub struct StreamTiming {
    /// Mean time from one byte to the next, in nanoseconds.
    pub byte_ns: f64,
    /// Length of a packet, in bytes.
    pub packet_len: usize,
    /// Bit rate of the line, in bits per second. `None` if the bytes of a packet may arrive all at once.
    pub line_rate: Option<u32>,
}

impl ReadLog {
    /// Number of stored reads. A packet may arrive in pieces of 16 bytes, and the last piece may also contain the
    /// beginning of the next packet. Eight pieces cover two packets of an LDROBOT.
    const CAPACITY: usize = 8;

    /// Adds a read of `len` bytes that returned at `now`. Ignores an empty read.
    pub fn note_read(&mut self, now: Nanos, len: usize) {
        if len > 0 {
            self.total += len as u64;
            self.reads[self.next % ReadLog::CAPACITY] = (self.total, now);
            self.next += 1;
        }
    }

    /// Returns the number of bytes read so far.
    pub fn total(&self) -> u64 {
        self.total
    }

    /// Returns the latest time at which the byte at `offset` can have arrived. The later bytes of the same read arrived
    /// after this byte, at `line_rate` bits per second. The byte arrived after the previous read, because that read did
    /// not return it.
    pub fn latest(&self, offset: u64, line_rate: Option<u32>) -> Nanos {
        let oldest = self.next.saturating_sub(ReadLog::CAPACITY);
        let mut latest = Nanos::MAX;
        for n in (oldest..self.next).rev() {
            let (end, now) = self.reads[n % ReadLog::CAPACITY];
            if end <= offset {
                break;
            }
            let line_delay = line_rate.map_or(0, |baud| line_time((end - offset - 1) as usize, baud));
            let (_, before) = if n > oldest { self.reads[(n - 1) % ReadLog::CAPACITY] } else { (0, 0) };
            latest = latest.min(now.saturating_sub(line_delay).max(before));
        }
        latest
    }

    /// Returns the earliest time at which the byte at `offset` can have arrived. Returns `None` if this time is
    /// unknown, because the log has no earlier read or because the byte may have been in a backlog. A read contains a
    /// backlog if it has more bytes than the scanner can have sent since the previous read.
    pub fn earliest(&self, offset: u64, timing: StreamTiming) -> Option<Nanos> {
        // The last read of a backlog in a full tty is shorter than the reads before it. The tty may return some more
        // bytes a moment later. These bytes were buffered too.
        let is_backlog_end = |n: usize| {
            n > self.oldest() + 2
                && self.read(n - 2).0 - self.read(n - 3).0 >= MAX_TTY_READ as u64
                && self.has_backlog(n - 1, timing)
        };
        let n = self.read_containing(offset).filter(|&n| !is_backlog_end(n))?;
        self.earliest_in_read(n, offset, timing)
    }

    /// Returns the [`earliest`](Self::earliest) arrival time of the byte at `offset`. Assumes that bytes are missing
    /// before this byte, and that the byte is not at the end of a backlog. If a full tty had a backlog and almost no
    /// bytes follow this byte, the time is known: the byte arrived when the tty had space again, or shortly before.
    pub fn earliest_after_gap(&self, offset: u64, timing: StreamTiming) -> Option<Nanos> {
        let n = self.read_containing(offset)?;
        self.earliest_in_read(n, offset, timing).or_else(|| {
            // `first` is the first of the consecutive reads up to read `n` that had more bytes than the scanner can
            // have sent since the previous read.
            let first = (self.oldest() + 1..=n).rev().take_while(|&n| self.has_backlog(n, timing)).last()?;
            let ((begin, since), (end, now)) = (self.read(first - 1), self.read(n));
            let delay = end.saturating_sub(offset + ADAPTER_BUFFER_LEN) as f64 * timing.byte_ns;
            let was_full = end - begin >= MAX_TTY_READ as u64;
            (was_full && delay <= 1.25 * now.saturating_sub(since) as f64).then_some(since)
        })
    }

    /// Returns the index of the oldest stored read.
    fn oldest(&self) -> usize {
        self.next.saturating_sub(ReadLog::CAPACITY)
    }

    /// Returns the offset of the byte after read `n`, and the time of the read.
    fn read(&self, n: usize) -> (u64, Nanos) {
        self.reads[n % ReadLog::CAPACITY]
    }

    /// Returns the index of the read that contains the byte at `offset`. If this byte has not been read, returns the
    /// index of the newest read. Returns `None` if the log has no earlier read.
    fn read_containing(&self, offset: u64) -> Option<usize> {
        (self.oldest() + 1..self.next).rev().find(|&n| self.read(n - 1).0 <= offset)
    }

    /// Returns whether read `n` had more bytes than the scanner can have sent since the previous read.
    fn has_backlog(&self, n: usize, timing: StreamTiming) -> bool {
        let ((begin, before), (end, now)) = (self.read(n - 1), self.read(n));
        (end - begin) as f64 * timing.byte_ns > 1.25 * now.saturating_sub(before) as f64
    }

    /// Returns the earliest time at which the byte at `offset`, in read `n`, can have arrived. Returns `None` if read
    /// `n` may contain a backlog.
    fn earliest_in_read(&self, n: usize, offset: u64, timing: StreamTiming) -> Option<Nanos> {
        let ((begin, before), (end, now)) = (self.read(n - 1), self.read(n));
        let is_backlog_end = n > self.oldest() + 1 && begin - self.read(n - 2).0 >= MAX_TTY_READ as u64;
        let sent = (end - begin).saturating_sub(timing.packet_len as u64) as f64 * timing.byte_ns;
        // After a full read, a tty may return some more bytes a moment later. Their time of arrival is unknown.
        if offset >= end || is_backlog_end || sent > 1.25 * now.saturating_sub(before) as f64 {
            return None;
        }
        let line_time = |bytes: u64| timing.line_rate.map_or(0, |baud| line_time(bytes as usize, baud));
        let packet = timing.packet_len as u64;
        // After the previous read, the line still needed time for the bytes of this packet that are in this read.
        let before = (before + line_time((offset + 1 - begin).min(packet))).min(now);
        // Every adapter can buffer `ADAPTER_BUFFER_LEN` bytes. In a read of at most this length, no bytes are missing
        // after this byte: an adapter that had dropped later bytes would have dropped this byte as well. The number of
        // later bytes then limits the age of this byte.
        let idle = (packet as f64 * timing.byte_ns) as Nanos;
        let delay =
            ((end - offset) as f64 * timing.byte_ns) as Nanos + idle.saturating_sub(line_time(packet));
        let arrival = if end - begin <= ADAPTER_BUFFER_LEN { now.saturating_sub(delay) } else { 0 };
        Some(arrival.max(before))
    }
}

/// Number of bytes that every adapter can buffer while the host does not read.
const ADAPTER_BUFFER_LEN: u64 = 256;
/// Maximum number of bytes that one read of a tty returns.
pub(crate) const MAX_TTY_READ: usize = 4_095;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::MILLIS;

    #[test]
    fn latest_arrival_allows_for_line_time() {
        let mut arrivals = ReadLog::default();
        arrivals.note_read(1_000_000, 100);
        arrivals.note_read(1_500_000, 0);
        arrivals.note_read(2_000_000, 10);
        let byte = line_time(1, 1_000_000);
        assert_eq!(arrivals.latest(99, Some(1_000_000)), 1_000_000);
        assert_eq!(arrivals.latest(90, Some(1_000_000)), 1_000_000 - 9 * byte);
        assert_eq!(arrivals.latest(109, Some(1_000_000)), 2_000_000);
        assert_eq!(arrivals.latest(90, None), 1_000_000);
        // The next two reads return buffered bytes.
        arrivals.note_read(2_000_001, 30);
        assert_eq!(arrivals.latest(109, Some(1_000_000)), 2_000_000, "not before it was read");
        arrivals.note_read(3_000_000, 200);
        assert_eq!(arrivals.latest(139, Some(1_000_000)), 2_000_001, "faster than a line");
        assert_eq!(arrivals.latest(300, Some(1_000_000)), 3_000_000 - 39 * byte);
    }

    /// Returns the timing of a stream whose bytes arrive one by one, `byte_ns` nanoseconds apart.
    fn evenly(byte_ns: f64) -> StreamTiming {
        StreamTiming { byte_ns, packet_len: 0, line_rate: None }
    }

    #[test]
    fn backlogged_bytes_have_an_early_earliest_arrival() {
        let (mut arrivals, flow) = (ReadLog::default(), evenly(100_000.0));
        let at = |millis: Nanos| millis * MILLIS;
        arrivals.note_read(at(1_000), 50);
        arrivals.note_read(at(1_005), 50);
        assert_eq!(arrivals.earliest(10, flow), None, "nothing was read before");
        assert_eq!(arrivals.earliest(60, flow), Some(at(1_001)));
        arrivals.note_read(at(2_005), 100);
        assert_eq!(arrivals.earliest(100, flow), Some(at(1_995)), "nothing was sent before");
        arrivals.note_read(at(3_005), 4_000);
        assert_eq!(arrivals.earliest(4_100, flow), Some(at(2_005)), "others after it may have been dropped");
        arrivals.note_read(at(3_010), 700);
        assert_eq!(arrivals.earliest(4_300, flow), None, "all bytes were buffered");
        arrivals.note_read(at(3_015), 50);
        assert_eq!(arrivals.earliest(4_910, flow), Some(at(3_011)));
    }

    #[test]
    fn earliest_arrival_uses_packet_boundaries() {
        let (mut arrivals, flow) = (ReadLog::default(), evenly(100_000.0));
        let packets = StreamTiming { packet_len: 84, ..flow };
        let on_a_line = StreamTiming { line_rate: Some(400_000), ..packets };
        let at = |millis: Nanos| millis * MILLIS;
        arrivals.note_read(at(1_000), 84);
        // After a pause, a packet arrives at the speed of the line.
        arrivals.note_read(at(1_500), 16);
        arrivals.note_read(at(1_505), 68);
        assert_eq!(arrivals.earliest(167, flow), None);
        assert_eq!(arrivals.earliest(167, packets), Some(at(1_500)), "at once, and nothing since");
        assert_eq!(arrivals.earliest(167, on_a_line), Some(at(1_500) + line_time(68, 400_000)));
        // The bytes after a full read were buffered, even if there are only a few.
        arrivals.note_read(at(2_500), 4_095);
        arrivals.note_read(at(2_501), 60);
        assert_eq!(arrivals.earliest(4_300, packets), None);
        // The same applies to bytes after the last read of a backlog, which is shorter than a full read.
        arrivals.note_read(at(3_500), 4_095);
        arrivals.note_read(at(3_501), 4_056);
        arrivals.note_read(at(3_507), 70);
        let rest = 84 + 84 + 4_095 + 60 + 4_095 + 4_056;
        assert_eq!(arrivals.earliest(rest + 40, packets), None);
        assert_eq!(arrivals.earliest_after_gap(rest + 40, packets), Some(at(3_501)));
    }

    #[test]
    fn full_tty_buffer_has_space_after_a_read() {
        let mut arrivals = ReadLog::default();
        let packets = StreamTiming { packet_len: 84, ..evenly(15_000.0) };
        let at = |millis: Nanos| millis * MILLIS;
        arrivals.note_read(at(1_000), 420);
        // A tty may need some time before it returns more bytes.
        let reads = [(1_500, 4_095), (1_501, 4_095), (1_502, 900), (1_507, 4_095)];
        reads.iter().for_each(|&(ms, len)| arrivals.note_read(at(ms), len));
        let end = 420 + 3 * 4_095 + 900;
        assert_eq!(arrivals.earliest_after_gap(end - 100, packets), Some(at(1_500)));
        let early = arrivals.earliest_after_gap(end - 4_000, packets);
        assert_eq!(early, None, "it was buffered, or the bytes after it were");
        arrivals.note_read(at(1_508), 2_000);
        assert_eq!(arrivals.earliest_after_gap(end + 1_700, packets), Some(at(1_500)));
        assert_eq!(arrivals.earliest_after_gap(end + 500, packets), None);
        assert_eq!(arrivals.earliest(end + 1_700, packets), None);
        arrivals.note_read(at(1_513), 336);
        assert_eq!(arrivals.earliest_after_gap(end + 1_700, packets), Some(at(1_500)), "known later, too");
        assert_eq!(arrivals.earliest_after_gap(end + 2_100, packets), Some(at(1_508)), "as without a gap");
    }
}
