//! When a byte arrived, at the latest: the port only tells when a read returned and how many bytes it brought.

use schema::{Nanos, line_time};

/// Reads, newest last, by the number of the byte after their last one.
#[derive(Clone, Debug, Default)]
pub struct Arrivals {
    reads: [(u64, Nanos); Arrivals::CAPACITY],
    next: usize,
    total: u64,
}

/// How a scanner sends: bytes `byte_ns` nanoseconds apart on the whole, but those of a packet of `packet_len` maybe at once, or as
/// fast as a line of `pace` bits per second lets them.
#[derive(Clone, Copy, Debug)]
pub struct Flow {
    /// Nanoseconds from one byte to the next in the mean.
    pub byte_ns: f64,
    /// Bytes of a packet.
    pub packet_len: usize,
    /// Bits per second of the line, if it is one.
    pub pace: Option<u32>,
}

impl Arrivals {
    /// A packet in pieces of 16 bytes, and the one that begins inside it.
    const CAPACITY: usize = 8;

    /// A read at `now` brought `len` bytes.
    pub fn note(&mut self, now: Nanos, len: usize) {
        if len > 0 {
            self.total += len as u64;
            self.reads[self.next % Arrivals::CAPACITY] = (self.total, now);
            self.next += 1;
        }
    }

    /// How many bytes came.
    pub fn total(&self) -> u64 {
        self.total
    }

    /// When byte number `offset` was there for sure: what came behind it took its time on a line of `pace` bits per second,
    /// if it was one, but none of it was there when it was read before.
    pub fn latest(&self, offset: u64, pace: Option<u32>) -> Nanos {
        let oldest = self.next.saturating_sub(Arrivals::CAPACITY);
        let mut latest = Nanos::MAX;
        for n in (oldest..self.next).rev() {
            let (end, now) = self.reads[n % Arrivals::CAPACITY];
            if end <= offset {
                break;
            }
            let behind = pace.map_or(0, |baud| line_time((end - offset - 1) as usize, baud));
            let (_, before) = if n > oldest { self.reads[(n - 1) % Arrivals::CAPACITY] } else { (0, 0) };
            latest = latest.min(now.saturating_sub(behind).max(before));
        }
        latest
    }

    /// When byte number `offset` of a stream was there at the earliest; nothing where that is not known: more came at once than
    /// was sent since the read before, so it had waited.
    pub fn earliest(&self, offset: u64, flow: Flow) -> Option<Nanos> {
        // Of what waited in a tty that was full the last piece is shorter, and some more may come a moment later.
        let is_rest = |n: usize| {
            n > self.oldest() + 2
                && self.read(n - 2).0 - self.read(n - 3).0 >= TTY as u64
                && self.brought_more(n - 1, flow)
        };
        let n = self.read_of(offset).filter(|&n| !is_rest(n))?;
        self.came(n, offset, flow)
    }

    /// As [`earliest`](Self::earliest), of a byte before which others are missing, so that it is no rest of what waited. Of what
    /// had waited in a tty that was full it is known where nearly nothing waited behind it: it came when there was room again, or
    /// shortly before.
    pub fn earliest_behind_gap(&self, offset: u64, flow: Flow) -> Option<Nanos> {
        let n = self.read_of(offset)?;
        self.came(n, offset, flow).or_else(|| {
            // Since the first of those that brought more than was sent since the one before, one behind the other.
            let first = (self.oldest() + 1..=n).rev().take_while(|&n| self.brought_more(n, flow)).last()?;
            let ((begin, since), (end, now)) = (self.read(first - 1), self.read(n));
            let behind = end.saturating_sub(offset + ROOM) as f64 * flow.byte_ns;
            let was_full = end - begin >= TTY as u64;
            (was_full && behind <= 1.25 * now.saturating_sub(since) as f64).then_some(since)
        })
    }

    /// The oldest read that is known.
    fn oldest(&self) -> usize {
        self.next.saturating_sub(Arrivals::CAPACITY)
    }

    /// The number of the byte after the last one of read `n`, and when it was.
    fn read(&self, n: usize) -> (u64, Nanos) {
        self.reads[n % Arrivals::CAPACITY]
    }

    /// The read that brought byte number `offset`, or the newest one before.
    fn read_of(&self, offset: u64) -> Option<usize> {
        (self.oldest() + 1..self.next).rev().find(|&n| self.read(n - 1).0 <= offset)
    }

    /// Whether read `n` brought more than was sent since the one before.
    fn brought_more(&self, n: usize, flow: Flow) -> bool {
        let ((begin, before), (end, now)) = (self.read(n - 1), self.read(n));
        (end - begin) as f64 * flow.byte_ns > 1.25 * now.saturating_sub(before) as f64
    }

    /// When byte number `offset` of read `n` was there at the earliest, if all that waited before was read.
    fn came(&self, n: usize, offset: u64, flow: Flow) -> Option<Nanos> {
        let ((begin, before), (end, now)) = (self.read(n - 1), self.read(n));
        let is_rest = n > self.oldest() + 1 && begin - self.read(n - 2).0 >= TTY as u64;
        let sent = (end - begin).saturating_sub(flow.packet_len as u64) as f64 * flow.byte_ns;
        // Behind what a tty hands out at once it may hand out some more a moment later, which says nothing.
        if offset >= end || is_rest || sent > 1.25 * now.saturating_sub(before) as f64 {
            return None;
        }
        let line_time = |bytes: u64| flow.pace.map_or(0, |baud| line_time(bytes as usize, baud));
        let packet = flow.packet_len as u64;
        // The packet took its time on the line, as far as it is of this read.
        let before = (before + line_time((offset + 1 - begin).min(packet))).min(now);
        // So few find room anywhere: if they were dropped that came then, these would have been too.
        let idle = (packet as f64 * flow.byte_ns) as Nanos;
        let behind = ((end - offset) as f64 * flow.byte_ns) as Nanos + idle.saturating_sub(line_time(packet));
        let came = if end - begin <= ROOM { now.saturating_sub(behind) } else { 0 };
        Some(came.max(before))
    }
}

/// Bytes that every adapter keeps for a host that is late.
const ROOM: u64 = 256;
/// Bytes that a tty hands out at once, whatever waits behind them.
pub(crate) const TTY: usize = 4_095;

#[cfg(test)]
mod tests {
    use super::*;
    use schema::MILLIS;

    #[test]
    fn what_came_behind_it_took_its_time() {
        let mut arrivals = Arrivals::default();
        arrivals.note(1_000_000, 100);
        arrivals.note(1_500_000, 0);
        arrivals.note(2_000_000, 10);
        let byte = line_time(1, 1_000_000);
        assert_eq!(arrivals.latest(99, Some(1_000_000)), 1_000_000);
        assert_eq!(arrivals.latest(90, Some(1_000_000)), 1_000_000 - 9 * byte);
        assert_eq!(arrivals.latest(109, Some(1_000_000)), 2_000_000);
        assert_eq!(arrivals.latest(90, None), 1_000_000);
        // Two reads of what had been waiting.
        arrivals.note(2_000_001, 30);
        assert_eq!(arrivals.latest(109, Some(1_000_000)), 2_000_000, "not before it was read");
        arrivals.note(3_000_000, 200);
        assert_eq!(arrivals.latest(139, Some(1_000_000)), 2_000_001, "faster than a line");
        assert_eq!(arrivals.latest(300, Some(1_000_000)), 3_000_000 - 39 * byte);
    }

    /// Bytes that come one by one, `byte_ns` apart.
    fn evenly(byte_ns: f64) -> Flow {
        Flow { byte_ns, packet_len: 0, pace: None }
    }

    #[test]
    fn what_had_waited_may_have_been_there_long_before() {
        let (mut arrivals, flow) = (Arrivals::default(), evenly(100_000.0));
        let at = |millis: Nanos| millis * MILLIS;
        arrivals.note(at(1_000), 50);
        arrivals.note(at(1_005), 50);
        assert_eq!(arrivals.earliest(10, flow), None, "nothing was read before");
        assert_eq!(arrivals.earliest(60, flow), Some(at(1_001)));
        arrivals.note(at(2_005), 100);
        assert_eq!(arrivals.earliest(100, flow), Some(at(1_995)), "nothing was sent before");
        arrivals.note(at(3_005), 4_000);
        assert_eq!(
            arrivals.earliest(4_100, flow),
            Some(at(2_005)),
            "behind it others may have found no room"
        );
        arrivals.note(at(3_010), 700);
        assert_eq!(arrivals.earliest(4_300, flow), None, "all of it waited");
        arrivals.note(at(3_015), 50);
        assert_eq!(arrivals.earliest(4_910, flow), Some(at(3_011)));
    }

    #[test]
    fn packets_come_in_one_piece() {
        let (mut arrivals, flow) = (Arrivals::default(), evenly(100_000.0));
        let packets = Flow { packet_len: 84, ..flow };
        let on_a_line = Flow { pace: Some(400_000), ..packets };
        let at = |millis: Nanos| millis * MILLIS;
        arrivals.note(at(1_000), 84);
        // Nothing was sent for a while, then a packet as fast as the line goes.
        arrivals.note(at(1_500), 16);
        arrivals.note(at(1_505), 68);
        assert_eq!(arrivals.earliest(167, flow), None);
        assert_eq!(arrivals.earliest(167, packets), Some(at(1_500)), "at once, and nothing since");
        assert_eq!(arrivals.earliest(167, on_a_line), Some(at(1_500) + line_time(68, 400_000)));
        // What a read leaves had waited, however little it is.
        arrivals.note(at(2_500), 4_095);
        arrivals.note(at(2_501), 60);
        assert_eq!(arrivals.earliest(4_300, packets), None);
        // Also behind the last piece of what waited, which is shorter.
        arrivals.note(at(3_500), 4_095);
        arrivals.note(at(3_501), 4_056);
        arrivals.note(at(3_507), 70);
        let rest = 84 + 84 + 4_095 + 60 + 4_095 + 4_056;
        assert_eq!(arrivals.earliest(rest + 40, packets), None);
        assert_eq!(arrivals.earliest_behind_gap(rest + 40, packets), Some(at(3_501)));
    }

    #[test]
    fn what_comes_to_a_full_tty_finds_room_once_it_is_read() {
        let mut arrivals = Arrivals::default();
        let packets = Flow { packet_len: 84, ..evenly(15_000.0) };
        let at = |millis: Nanos| millis * MILLIS;
        arrivals.note(at(1_000), 420);
        // A tty may take its time to hand out more.
        let reads = [(1_500, 4_095), (1_501, 4_095), (1_502, 900), (1_507, 4_095)];
        reads.iter().for_each(|&(ms, len)| arrivals.note(at(ms), len));
        let end = 420 + 3 * 4_095 + 900;
        assert_eq!(arrivals.earliest_behind_gap(end - 100, packets), Some(at(1_500)));
        let early = arrivals.earliest_behind_gap(end - 4_000, packets);
        assert_eq!(early, None, "it waited, or what is behind it did");
        arrivals.note(at(1_508), 2_000);
        assert_eq!(arrivals.earliest_behind_gap(end + 1_700, packets), Some(at(1_500)));
        assert_eq!(arrivals.earliest_behind_gap(end + 500, packets), None);
        assert_eq!(arrivals.earliest(end + 1_700, packets), None);
        arrivals.note(at(1_513), 336);
        assert_eq!(arrivals.earliest_behind_gap(end + 1_700, packets), Some(at(1_500)), "known later, too");
        assert_eq!(arrivals.earliest_behind_gap(end + 2_100, packets), Some(at(1_508)), "as without a gap");
    }
}
