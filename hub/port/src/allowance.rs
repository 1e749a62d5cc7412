//! How much may be read from a connection that can deliver more than any line: twice what the line carries, and up to one
//! second of that at once, because a network holds data back and catches up. The rest waits in the connection, and is
//! older than it seems when it is read. Refuses to know a clock, and what the bytes are.

use schema::{MILLIS, Nanos, line_time};

/// What may be read, and for how long there has been more.
#[derive(Clone, Debug)]
pub struct Allowance {
    /// Time that a byte takes.
    byte_ns: Nanos,
    /// The time until which all was read that was allowed.
    spent: Nanos,
    /// When it was short the first time and the last time, of those that belong together.
    short: Option<(Nanos, Nanos)>,
    /// The last read brought all that there was room for, so that there may be more.
    is_full: bool,
}

impl Allowance {
    /// All of it, at `now`, for a line of `baud`.
    pub fn new(baud: u32, now: Nanos) -> Allowance {
        let byte_ns = line_time(1, baud) / TIMES;
        Allowance { byte_ns, spent: now.saturating_sub(BURST), short: None, is_full: false }
    }

    /// Bytes that may be read at `now`.
    pub fn bytes(&self, now: Nanos) -> usize {
        (now.saturating_sub(self.begin(now)) / self.byte_ns) as usize
    }

    /// `len` bytes were read at `now` into a buffer of `room` bytes.
    pub fn take(&mut self, len: usize, room: usize, now: Nanos) {
        self.is_full = len > 0 && len == room;
        self.spent = self.begin(now) + len as Nanos * self.byte_ns;
    }

    /// When to read again, if what may be read at `now` is not worth it: then nothing is waited for but the time. By
    /// `until` something else has to be done, for which a byte may be read.
    pub fn rest(&mut self, now: Nanos, until: Nanos) -> Option<Nanos> {
        let (any_at, enough_at) = (self.spent + self.byte_ns, self.spent + PORTION);
        if now >= enough_at {
            return None;
        }
        let since = self.short.filter(|&(_, last)| now < last + CALM).map_or(now, |(since, _)| since);
        self.short = Some((since, now));
        // What is overdue waits for the end of the bytes, and did not come to it.
        Some(if until > now { until.clamp(any_at, enough_at) } else { enough_at })
    }

    /// Whether more than that has been arriving for a while, as of `now`.
    pub fn is_flooded(&self, now: Nanos) -> bool {
        self.short.is_some_and(|(since, last)| now < last + CALM && last >= since + PATIENCE)
    }

    /// Whether the last bytes read may have waited in the connection, as of `now`: there was more than could be read, or
    /// there was a moment ago.
    pub fn is_behind(&self, now: Nanos) -> bool {
        self.is_full || self.short.is_some_and(|(_, last)| now < last + SETTLED)
    }

    /// From when on what was not read is allowed still.
    fn begin(&self, now: Nanos) -> Nanos {
        self.spent.max(now.saturating_sub(BURST))
    }
}

/// As much as the line brings, so often.
const TIMES: Nanos = 2;
/// What was not read for so long may be read at once.
const BURST: Nanos = 1_000 * MILLIS;
/// Read at a time, where there is more than is allowed.
const PORTION: Nanos = 20 * MILLIS;
/// Bytes that a network held back are read within a second, as a rule: they are no flood.
const PATIENCE: Nanos = 1_500 * MILLIS;
/// So long there has to be no shortage before what is read is new: a network that catches up brings it in pieces.
const SETTLED: Nanos = 200 * MILLIS;
/// After so long without a shortage there is none any more.
const CALM: Nanos = 5_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    const BAUD: u32 = 500_000;
    const SECOND: Nanos = 1_000 * MILLIS;

    /// Bytes read from `begin` to `end` where there are always more, and how often.
    fn flooded(allowance: &mut Allowance, begin: Nanos, end: Nanos) -> (usize, u32) {
        let (mut now, mut read, mut reads) = (begin, 0, 0);
        while now < end {
            match allowance.rest(now, Nanos::MAX) {
                Some(until) => now = until,
                None => {
                    let len = allowance.bytes(now).min(900);
                    allowance.take(len, len, now);
                    (read, reads) = (read + len, reads + 1);
                    now += 1;
                }
            }
        }
        (read, reads)
    }

    #[test]
    fn a_flood_is_twice_the_line_behind_a_second_at_once() {
        for baud in [500_000, 38_400, 9_600] {
            let mut allowance = Allowance::new(baud, 9 * SECOND);
            let second = baud as usize / 10 * 2;
            let (read, _) = flooded(&mut allowance, 9 * SECOND, 10 * SECOND);
            assert!((2 * second - second / 40..=2 * second).contains(&read), "{baud}: {read}");
            let (read, reads) = flooded(&mut allowance, 10 * SECOND, 20 * SECOND);
            assert!(
                (10 * second - second / 40..=10 * second + second / 40).contains(&read),
                "{baud}: {read}"
            );
            assert!(reads <= 2_000, "{baud}: {reads}");
            assert!(allowance.is_flooded(20 * SECOND) && !allowance.is_flooded(30 * SECOND));
            // A pause gives back what it took, and no more than a second of it.
            assert_eq!(allowance.bytes(90 * SECOND), second);
        }
    }

    #[test]
    fn a_line_as_it_should_be_is_read_whenever_it_brings_something() {
        let mut allowance = Allowance::new(BAUD, SECOND);
        for now in (SECOND..60 * SECOND).step_by(MILLIS as usize) {
            assert_eq!(allowance.rest(now, Nanos::MAX), None);
            allowance.take(50, 900, now);
            assert!(!allowance.is_behind(now));
        }
        // Half a second stood in the network.
        assert!(allowance.bytes(60 * SECOND) > 25_000);
        allowance.take(25_000, 25_000, 60 * SECOND);
        assert!(allowance.is_behind(60 * SECOND), "more may be there");
        allowance.take(10, 900, 60 * SECOND);
        assert_eq!(allowance.rest(60 * SECOND, Nanos::MAX), None);
        assert!(!allowance.is_flooded(60 * SECOND) && !allowance.is_behind(60 * SECOND));
    }

    #[test]
    fn whoever_reads_what_waited_is_behind_until_it_has_caught_up() {
        for (standstill, longest_ms) in [(1, 1), (5, 3_500), (20, 19_000)] {
            // The line goes on all the time.
            let arrived = |now: Nanos| (now / 20_000) as usize;
            let mut allowance = Allowance::new(BAUD, 0);
            let (mut now, mut read) = (standstill * SECOND, 0);
            let mut caught_up = None;
            while now < 60 * SECOND {
                if let Some(until) = allowance.rest(now, Nanos::MAX) {
                    now = until;
                    continue;
                }
                let room = allowance.bytes(now).clamp(1, 900);
                let len = room.min(arrived(now) - read);
                allowance.take(len, room, now);
                // Of what was read the first byte waited for so long.
                let age = now - read as Nanos * 20_000;
                read += len;
                assert!(allowance.is_behind(now) || age <= 40 * MILLIS, "{age} ns old at {now}");
                match caught_up {
                    None if !allowance.is_behind(now) => caught_up = Some(now - standstill * SECOND),
                    None => {}
                    Some(_) => assert!(!allowance.is_behind(now), "once it has caught up"),
                }
                now += if len < room { MILLIS } else { 1 };
            }
            let took = caught_up.expect("it catches up");
            assert!(took <= longest_ms * MILLIS, "{standstill} s: {took}");
        }
    }

    #[test]
    fn what_is_due_is_done_and_nobody_spins() {
        let mut allowance = Allowance::new(BAUD, SECOND);
        allowance.take(100_000, 100_000, SECOND);
        assert_eq!(allowance.bytes(SECOND), 0);
        let (byte, portion) = (SECOND + 10_000, SECOND + PORTION);
        assert_eq!(allowance.rest(SECOND, SECOND + 1), Some(byte), "a byte has to be allowed");
        assert_eq!(allowance.rest(SECOND, 0), Some(portion), "it is overdue");
        assert_eq!(allowance.rest(SECOND, byte + 5), Some(byte + 5));
        assert_eq!(allowance.rest(SECOND, Nanos::MAX), Some(portion));
        assert_eq!((allowance.bytes(byte), allowance.bytes(portion)), (1, 2_000));
        assert!(!allowance.is_flooded(portion), "it was short once");
    }
}
