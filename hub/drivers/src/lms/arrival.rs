//! When a byte arrived, and when to look at the line again. The port only tells when a read returned and how many
//! bytes it brought; this file turns that into a stamp for any byte, and learns how long a telegram takes, so that
//! the host can sleep through it.

use crate::lms::variant::BYTES_PER_TURN;
use schema::{MICROS, MILLIS, Nanos, line_time};

/// Reads, newest last, by the number of the byte after their last one.
#[derive(Clone, Debug)]
pub(crate) struct Arrivals {
    reads: [Read; Arrivals::CAPACITY],
    next: usize,
    total: u64,
    /// When the line was last seen to bring something: one that holds its bytes back looks empty.
    last_look: Nanos,
    /// What waited while the host did not look.
    backlog: Option<Backlog>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Read {
    end: u64,
    now: Nanos,
    backlog: Option<Backlog>,
}

/// Bytes that came while the host did not run, or that the line held back. Their age is not known; but the line's buffer keeps the oldest ones, so
/// they arrived at the speed of the line, starting at the last read.
#[derive(Clone, Copy, Debug)]
struct Backlog {
    /// Number of its first byte.
    begin: u64,
    /// The last look before it that found something.
    since: Nanos,
    /// The last read that brought more than can have come since the one before it, and the bytes read after it.
    hurried: Nanos,
    read_since: usize,
}

/// A stamp, and whether more than the pace of a UART stands between it and the truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stamp {
    pub(crate) at: Nanos,
    pub(crate) estimated: bool,
    /// Where the byte waited while the host did not run: when it must have been there at the latest. Then `at` is the
    /// earliest time that is possible.
    pub(crate) latest: Option<Nanos>,
}

impl Arrivals {
    /// A telegram in pieces of 16 bytes, twice.
    const CAPACITY: usize = 128;

    /// Nothing that arrives is older than `now`.
    pub(crate) fn new(now: Nanos) -> Self {
        let reads = [Read::default(); Arrivals::CAPACITY];
        Arrivals { reads, next: 0, total: 0, last_look: now, backlog: None }
    }

    /// A read at `now` brought `len` bytes, of a line of `pace` bits per second if it was one.
    pub(crate) fn note(&mut self, now: Nanos, len: usize, pace: Option<u32>) {
        let since = self.last_look;
        if len > 0 {
            self.last_look = now;
        }
        if len > BYTES_PER_TURN && now.saturating_sub(since) > LATE {
            self.backlog = pace.map(|_| Backlog { begin: self.total, since, hurried: now, read_since: 0 });
        } else if let (Some(backlog), Some(baud)) = (&mut self.backlog, pace) {
            backlog.read_since += len;
            let calm = now.saturating_sub(backlog.hurried);
            if line_time(backlog.read_since, baud) > calm + line_time(ESTIMATED, baud) {
                (backlog.hurried, backlog.read_since) = (now, 0);
            } else if calm > CALM {
                self.catch_up();
            }
        }
        if len > 0 {
            self.total += len as u64;
            let read = Read { end: self.total, now, backlog: self.backlog };
            self.reads[self.next % Arrivals::CAPACITY] = read;
            self.next += 1;
        }
    }

    /// At `now` there were `len` bytes that will come with the next read.
    pub(crate) fn sense(&mut self, now: Nanos, len: usize) {
        self.last_look = now;
        let read = Read { end: self.total + len as u64, now, backlog: self.backlog };
        self.reads[self.next % Arrivals::CAPACITY] = read;
        self.next += 1;
    }

    /// What was read since the last hurried read came when it was read.
    fn catch_up(&mut self) {
        if let Some(backlog) = self.backlog.take() {
            for read in self.reads.iter_mut().filter(|read| read.now > backlog.hurried) {
                read.backlog = None;
            }
        }
    }

    /// When byte number `offset` arrived at the latest: whatever came behind it, in the same read or in one right
    /// after it, took its time on the line. Of a backlog it is the earliest time that is possible: old values must not
    /// look new. Where the beat of the stream is known, [`crate::lms::cadence`] knows better.
    pub(crate) fn stamp(&self, offset: u64, baud: u32) -> Stamp {
        let oldest = self.next.saturating_sub(Arrivals::CAPACITY);
        let (mut at, mut own, mut own_behind) = (Nanos::MAX, Nanos::MAX, ESTIMATED + 1);
        let (mut latest, mut waited) = (Nanos::MAX, false);
        for n in (oldest..self.next).rev() {
            let read = self.reads[n % Arrivals::CAPACITY];
            if read.end <= offset {
                break;
            }
            own_behind = (read.end - offset - 1) as usize;
            own = read.now.saturating_sub(line_time(own_behind, baud));
            at = at.min(own);
            latest = latest.min(own);
            if let Some(backlog) = read.backlog.filter(|backlog| backlog.begin <= offset) {
                at = at.min(backlog.since + line_time((offset - backlog.begin) as usize + 1, baud));
                waited = true;
            }
        }
        // A host that wakes up a little later for one read than for another is no estimate.
        let moved = own - at > line_time(ESTIMATED, baud);
        Stamp { at, estimated: own_behind > ESTIMATED || moved, latest: waited.then_some(latest) }
    }
}

/// How long a telegram of the stream takes, learned from those that came. A busy host only ever sees them take
/// longer, so the least of several is the truth.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rhythm {
    duration: Option<Nanos>,
    /// The shortest of the `counted` telegrams since it was learned.
    least: Nanos,
    counted: u32,
    /// First byte of the telegram that is coming.
    first: Option<Nanos>,
    /// A telegram is read in so many pieces, at least.
    pieces: u8,
}

impl Rhythm {
    pub(crate) fn new() -> Self {
        Rhythm { duration: None, least: Nanos::MAX, counted: 0, first: None, pieces: 1 }
    }

    /// From now on the host looks at a telegram `pieces` times in all, in equal parts of it; 0 is 1.
    pub(crate) fn look_in(&mut self, pieces: u8) {
        self.pieces = pieces.max(1);
    }

    /// The first byte of a telegram arrived.
    pub(crate) fn begin(&mut self, first: Nanos) {
        self.first = Some(first);
    }

    /// How long a telegram takes, if that is known.
    pub(crate) fn duration(&self) -> Option<Nanos> {
        self.duration
    }

    /// Until when nothing can be complete that is waited for: the next piece, or the telegram; answered once for each.
    pub(crate) fn rest(&mut self, now: Nanos) -> Option<Nanos> {
        let (first, duration) = (self.first?, self.duration?);
        let end = first + duration.checked_sub(LEAD)?;
        let soon = now + MIN_REST;
        let pieces = Nanos::from(self.pieces);
        let piece = (1..pieces).map(|n| first + n * duration / pieces);
        let piece = piece.take_while(|&at| at + MIN_REST < end).find(|&at| at > soon);
        self.first = self.first.filter(|_| piece.is_some());
        let until = piece.unwrap_or(end);
        (until > soon).then_some(until)
    }

    /// A telegram is complete that took so long from its first to its last byte.
    pub(crate) fn complete(&mut self, took: Nanos) {
        self.first = None;
        self.least = self.least.min(took);
        self.counted += 1;
        if self.counted >= if self.duration.is_none() { LESSONS } else { WINDOW } {
            self.duration = Some(self.least);
            self.least = Nanos::MAX;
            self.counted = 0;
        }
    }

    /// What was coming is not known any more.
    pub(crate) fn lose(&mut self) {
        self.first = None;
    }

    /// Whether `took` is longer than usual by more than noise.
    pub(crate) fn is_slow(&self, took: Nanos) -> bool {
        self.duration.is_some_and(|duration| took > duration + SLOW)
    }
}

/// More bytes than so behind a stamped one in the same read make the stamp an estimate: an adapter's chunk of 62.
const ESTIMATED: usize = 64;
/// A host that found nothing for so long, beyond any rest at the highest rate, was stopped or starved, or the line was.
const LATE: Nanos = 50 * MILLIS;
/// A line that brings no more than it can for so long has no backlog any more: less than a telegram takes, more than the
/// kernel needs to move what it kept from one buffer to the next.
const CALM: Nanos = 12 * MILLIS;
/// The host looks again so long before the expected end: a chunk or two of 16 bytes.
const LEAD: Nanos = 600 * MICROS;
/// A shorter rest is not worth a system call.
const MIN_REST: Nanos = 500 * MICROS;
/// Telegrams that are read as they come before the first rest.
const LESSONS: u32 = 3;
/// Telegrams of which the shortest counts, from then on. One that was slept through to its end took the rest at most,
/// so too long a rest shortens itself.
const WINDOW: u32 = 16;
/// A telegram that takes so much longer than usual is suspect (framing: quality, reason 4).
const SLOW: Nanos = 8 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    /// When a byte arrived, and whether that is an estimate.
    fn seen(arrivals: &Arrivals, offset: u64) -> (Nanos, bool) {
        let Stamp { at, estimated, .. } = arrivals.stamp(offset, 500_000);
        (at, estimated)
    }

    #[test]
    fn a_stamp_knows_what_came_behind_it() {
        let mut arrivals = Arrivals::new(0);
        arrivals.note(1_000_000, 16, Some(500_000));
        arrivals.note(11_000_000, 484, Some(500_000));
        assert_eq!(seen(&arrivals, 0), (1_000_000 - 15 * 20_000, false));
        assert_eq!(seen(&arrivals, 499), (11_000_000, false));
        assert_eq!(seen(&arrivals, 16), (11_000_000 - 483 * 20_000, true));
        // Two reads of what had been waiting: the line was not faster because of that.
        arrivals.note(11_010_000, 500, Some(500_000));
        assert_eq!(seen(&arrivals, 499), (11_010_000 - 500 * 20_000, true));
        // Reads with a jitter of some microseconds are what they are.
        arrivals.note(31_000_000, 16, Some(500_000));
        arrivals.note(31_300_000, 16, Some(500_000));
        assert_eq!(seen(&arrivals, 1_015), (30_980_000, false));
        for _ in 0..200 {
            arrivals.note(40_000_000, 1, Some(500_000));
        }
        // Older than what is remembered: the oldest remembered read.
        assert!(arrivals.stamp(0, 500_000).estimated);
    }

    #[test]
    fn what_waited_while_the_host_did_not_run_is_not_new() {
        let mut arrivals = Arrivals::new(0);
        arrivals.note(1_000 * MILLIS, 16, Some(500_000));
        // Two seconds later, as fast as they can be read; then as they come.
        for read in 0..4 {
            arrivals.note(3_000 * MILLIS + read * 100_000, 1_600, Some(500_000));
        }
        // The kernel moves the rest a little later; then comes what is new.
        arrivals.note(3_002 * MILLIS, 50, Some(500_000));
        arrivals.note(3_002 * MILLIS + 50_000, 1_550, Some(500_000));
        arrivals.note(3_010 * MILLIS, 16, Some(500_000));
        assert!(arrivals.stamp(8_031, 500_000).at < 1_200 * MILLIS, "not yet known to be new");
        arrivals.note(3_015 * MILLIS, 16, Some(500_000));
        for byte in [0, 731, 1_599, 1_600, 6_399, 6_400, 7_999] {
            let at = 1_000 * MILLIS + (byte + 1) * 20_000;
            assert_eq!(seen(&arrivals, 16 + byte), (at, true));
        }
        assert_eq!(seen(&arrivals, 8_031), (3_010 * MILLIS, false));
        // A line that was silent is looked at in time; a slow one that was slept through has kept its pace.
        arrivals.note(5_000 * MILLIS, 62, Some(500_000));
        assert_eq!(seen(&arrivals, 8_109), (5_000 * MILLIS, false));
        arrivals.note(5_762 * MILLIS, 730, Some(9600));
        let stamp = arrivals.stamp(8_110 + 729, 9600);
        assert!(stamp.at > 5_760 * MILLIS && !stamp.estimated, "{stamp:?}");
    }

    #[test]
    fn what_a_line_held_back_is_not_new_though_the_host_looked() {
        let mut arrivals = Arrivals::new(0);
        arrivals.note(1_000 * MILLIS, 16, Some(500_000));
        arrivals.note(1_500 * MILLIS, 0, Some(500_000));
        arrivals.note(1_850 * MILLIS, 16_000, Some(500_000));
        assert_eq!(seen(&arrivals, 16), (1_000 * MILLIS + 20_000, true));
    }

    #[test]
    fn what_comes_with_the_first_look_is_no_older_than_the_session() {
        let mut arrivals = Arrivals::new(9_000 * MILLIS);
        arrivals.note(9_010 * MILLIS, 400, Some(500_000));
        let at = 9_010 * MILLIS - 399 * 20_000;
        assert_eq!(seen(&arrivals, 0), (at, true));
    }

    #[test]
    fn what_was_seen_before_it_was_read_is_as_old_as_that() {
        let mut arrivals = Arrivals::new(0);
        arrivals.sense(1_000_000, 16);
        arrivals.note(18_000_000, 700, Some(500_000));
        arrivals.note(18_400_000, 32, Some(500_000));
        assert_eq!(seen(&arrivals, 0), (700_000, false));
        assert_eq!(seen(&arrivals, 731), (18_400_000, false));
        arrivals.note(30_000_000, 1, Some(500_000));
        assert_eq!(seen(&arrivals, 732), (30_000_000, false));
    }

    #[test]
    fn after_three_lessons_the_host_may_rest() {
        let mut rhythm = Rhythm::new();
        for took in [18_300_000, 18_000_000, 90_000_000] {
            rhythm.begin(0);
            assert_eq!(rhythm.rest(0), None);
            rhythm.complete(took);
        }
        rhythm.begin(100_000_000);
        assert_eq!(rhythm.rest(100_000_000), Some(117_400_000));
        assert_eq!(rhythm.rest(117_400_000), None, "once per telegram");
        assert!(rhythm.is_slow(26_000_001) && !rhythm.is_slow(26_000_000));
        // All of them were there before the host looked: it looks earlier from then on.
        for _ in 0..16 {
            rhythm.complete(17_500_000);
        }
        rhythm.begin(200_000_000);
        assert_eq!(rhythm.rest(200_000_000), Some(216_900_000));
    }

    #[test]
    fn in_pieces_the_host_looks_once_for_each() {
        let mut rhythm = Rhythm::new();
        (0..3).for_each(|_| rhythm.complete(18_000_000));
        rhythm.look_in(3);
        rhythm.begin(0);
        assert_eq!(rhythm.rest(100_000), Some(6_000_000));
        assert_eq!(rhythm.rest(6_050_000), Some(12_000_000));
        assert_eq!(rhythm.rest(12_050_000), Some(17_400_000), "the end, a little before it");
        assert_eq!(rhythm.rest(17_450_000), None);
        rhythm.begin(100_000_000);
        assert_eq!(
            rhythm.rest(113_000_000),
            Some(117_400_000),
            "a host that is late passes over what is over"
        );
        // So many pieces that the last one would be where the end is.
        rhythm.look_in(200);
        rhythm.begin(0);
        let looks = core::iter::successors(rhythm.rest(0), |&at| rhythm.rest(at)).count();
        assert!((20..=33).contains(&looks), "{looks}");
    }
}
