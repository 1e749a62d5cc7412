//! Arrival times of bytes and of telegrams.
//!
//! A port reports only the time at which a read returned, and the number of bytes in the read. From these reads,
//! [`ArrivalEstimator`] computes a stamp for any byte. [`TelegramTiming`] measures the duration of a telegram, so that
//! the host can sleep until the next telegram is nearly complete.

use crate::lms::variant::BYTES_PER_REVOLUTION;
use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};

/// Estimator of arrival times, with the last reads in a ring buffer. The stamp of a byte follows from the read that
/// returned the byte, and from the reads after that read.
#[derive(Clone, Debug)]
pub(crate) struct ArrivalEstimator {
    reads: [ReadRecord; ArrivalEstimator::CAPACITY],
    next: usize,
    total: u64,
    /// Time of the last read with bytes, or of the last call of `note_unread`.
    last_checked: Nanos,
    /// `Some` while the session reads bytes that were buffered because the host did not read.
    backlog: Option<Backlog>,
}

#[derive(Clone, Copy, Debug, Default)]
struct ReadRecord {
    end_offset: u64,
    now: Nanos,
    backlog: Option<Backlog>,
}

/// Bytes that were buffered while the host or the line was stopped. Their exact age is unknown. A full buffer keeps its
/// oldest bytes. The bytes of the backlog therefore arrived at the speed of the line, starting at the last read before
/// the stop.
#[derive(Clone, Copy, Debug)]
struct Backlog {
    /// Offset of the first byte of the backlog.
    begin_offset: u64,
    /// Time of the last read with bytes before the backlog.
    since: Nanos,
    /// Time of the last read that returned more bytes than can have arrived since the previous read.
    last_surplus: Nanos,
    read_since: usize,
}

/// A stamp. It is an estimate if its error may exceed the duration of 64 bytes on the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Timestamp {
    pub(crate) at: Nanos,
    pub(crate) estimated: bool,
    /// Latest possible arrival time of a byte in a backlog; `at` is then the earliest possible arrival time. `None` for
    /// other bytes.
    pub(crate) latest: Option<Nanos>,
}

impl ArrivalEstimator {
    /// Number of stored reads. This number is sufficient for two telegrams in chunks of 16 bytes.
    const CAPACITY: usize = 128;

    /// Creates an estimator at `now`. No byte gets a stamp before `now`.
    pub(crate) fn new(now: Nanos) -> Self {
        let reads = [ReadRecord::default(); ArrivalEstimator::CAPACITY];
        ArrivalEstimator { reads, next: 0, total: 0, last_checked: now, backlog: None }
    }

    /// Records a read of `len` bytes at `now`. `line_rate` is the rate of the line in bits per second. It is `None` if
    /// bytes arrive without a fixed rate, for example from a recording or a network.
    pub(crate) fn note_read(&mut self, now: Nanos, len: usize, line_rate: Option<u32>) {
        let since = self.last_checked;
        if len > 0 {
            self.last_checked = now;
        }
        if len > BYTES_PER_REVOLUTION && now.saturating_sub(since) > STALL_THRESHOLD {
            self.backlog = line_rate.map(|_| Backlog {
                begin_offset: self.total,
                since,
                last_surplus: now,
                read_since: 0,
            });
        } else if let (Some(backlog), Some(baud)) = (&mut self.backlog, line_rate) {
            backlog.read_since += len;
            let quiet_time = now.saturating_sub(backlog.last_surplus);
            if line_time(backlog.read_since, baud) > quiet_time + line_time(MAX_EXACT_BYTES, baud) {
                (backlog.last_surplus, backlog.read_since) = (now, 0);
            } else if quiet_time > BACKLOG_END_TIME {
                self.end_backlog();
            }
        }
        if len > 0 {
            self.total += len as u64;
            let read = ReadRecord { end_offset: self.total, now, backlog: self.backlog };
            self.reads[self.next % ArrivalEstimator::CAPACITY] = read;
            self.next += 1;
        }
    }

    /// Records that `len` unread bytes were in the line's buffer at `now`. The next read will return them.
    pub(crate) fn note_unread(&mut self, now: Nanos, len: usize) {
        self.last_checked = now;
        let read = ReadRecord { end_offset: self.total + len as u64, now, backlog: self.backlog };
        self.reads[self.next % ArrivalEstimator::CAPACITY] = read;
        self.next += 1;
    }

    /// Ends the backlog. Reads after the last surplus do not belong to the backlog.
    fn end_backlog(&mut self) {
        if let Some(backlog) = self.backlog.take() {
            for read in self.reads.iter_mut().filter(|read| read.now > backlog.last_surplus) {
                read.backlog = None;
            }
        }
    }

    /// Returns the stamp of the byte at `offset`, on a line of `baud` bits per second. The stamp is the latest time at
    /// which the byte can have arrived, because all bytes after it needed time on the line. For a byte in a backlog,
    /// the stamp is the earliest possible time, so that old values do not appear new. If the period of the stream is
    /// known, [`crate::lms::scan_schedule`] computes a more exact stamp.
    pub(crate) fn stamp(&self, offset: u64, baud: u32) -> Timestamp {
        let oldest = self.next.saturating_sub(ArrivalEstimator::CAPACITY);
        let (mut at, mut arrival, mut later_bytes) = (Nanos::MAX, Nanos::MAX, MAX_EXACT_BYTES + 1);
        let (mut latest, mut is_backlogged) = (Nanos::MAX, false);
        for n in (oldest..self.next).rev() {
            let read = self.reads[n % ArrivalEstimator::CAPACITY];
            if read.end_offset <= offset {
                break;
            }
            later_bytes = (read.end_offset - offset - 1) as usize;
            arrival = read.now.saturating_sub(line_time(later_bytes, baud));
            at = at.min(arrival);
            latest = latest.min(arrival);
            if let Some(backlog) = read.backlog.filter(|backlog| backlog.begin_offset <= offset) {
                at = at.min(backlog.since + line_time((offset - backlog.begin_offset) as usize + 1, baud));
                is_backlogged = true;
            }
        }
        // A small jitter between reads does not make the stamp an estimate.
        let is_estimated = arrival - at > line_time(MAX_EXACT_BYTES, baud);
        Timestamp {
            at,
            estimated: later_bytes > MAX_EXACT_BYTES || is_estimated,
            latest: is_backlogged.then_some(latest),
        }
    }
}

/// Measured duration of a telegram of the stream. A busy host may measure a duration that is too long, but never one
/// that is too short. The result is therefore the minimum over several telegrams.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TelegramTiming {
    pub(crate) duration: Option<Nanos>,
    /// Minimum duration of the last `measured_telegrams` telegrams.
    min_duration: Nanos,
    measured_telegrams: u32,
    /// Arrival of the first byte of the current telegram. `None` after the last sleep within this telegram.
    first: Option<Nanos>,
    /// Minimum number of reads per telegram.
    partial_reads: u8,
    lead: WakeLead,
    /// Number of reads with bytes since the sleep until shortly before the end of the telegram. `None` before that
    /// sleep.
    reads_near_end: Option<u32>,
}

impl TelegramTiming {
    pub(crate) fn new() -> Self {
        TelegramTiming {
            duration: None,
            min_duration: Nanos::MAX,
            measured_telegrams: 0,
            first: None,
            partial_reads: 1,
            lead: WakeLead::default(),
            reads_near_end: None,
        }
    }

    /// Sets the number of reads per telegram, evenly spaced. 0 counts as 1.
    pub(crate) fn set_partial_reads(&mut self, partial_reads: u8) {
        self.partial_reads = partial_reads.max(1);
    }

    /// Records the arrival of the first byte of a telegram.
    pub(crate) fn begin_telegram(&mut self, first: Nanos) {
        self.first = Some(first);
    }

    /// Counts a read that returned bytes.
    pub(crate) fn count_read(&mut self) {
        if let Some(reads) = &mut self.reads_near_end {
            *reads += 1;
        }
    }

    /// Returns the time until which the host can sleep: the next partial read, or a time shortly before the end of the
    /// telegram. Returns `None` if the duration of a telegram is unknown, if the sleep would be too short, or if the
    /// method has already returned the last sleep within this telegram.
    pub(crate) fn sleep_until(&mut self, now: Nanos) -> Option<Nanos> {
        let (first, duration) = (self.first?, self.duration?);
        let end = first + duration.checked_sub(self.lead.nanos())?;
        let earliest = now + MIN_SLEEP;
        let parts = Nanos::from(self.partial_reads);
        let next_read = (1..parts).map(|n| first + n * duration / parts);
        let piece = next_read.take_while(|&at| at + MIN_SLEEP < end).find(|&at| at > earliest);
        self.first = self.first.filter(|_| piece.is_some());
        let until = piece.unwrap_or(end);
        let pays_off = until > earliest;
        if piece.is_none() && pays_off {
            self.reads_near_end = Some(0);
        }
        pays_off.then_some(until)
    }

    /// Records a complete telegram that took `elapsed` ns from its first to its last byte.
    pub(crate) fn end_telegram(&mut self, elapsed: Nanos) {
        self.first = None;
        if let Some(reads) = self.reads_near_end.take() {
            self.lead.adapt(reads);
        }
        self.min_duration = self.min_duration.min(elapsed);
        self.measured_telegrams += 1;
        if self.measured_telegrams
            >= if self.duration.is_none() { LEARNING_TELEGRAMS } else { WINDOW_TELEGRAMS }
        {
            self.duration = Some(self.min_duration);
            self.min_duration = Nanos::MAX;
            self.measured_telegrams = 0;
        }
    }

    /// Discards the current telegram.
    pub(crate) fn reset(&mut self) {
        self.first = None;
        self.reads_near_end = None;
    }

    /// Returns whether a telegram that took `elapsed` ns was unusually slow.
    pub(crate) fn is_slow(&self, elapsed: Nanos) -> bool {
        self.duration.is_some_and(|duration| elapsed > duration + SLOW_TOLERANCE)
    }
}

/// Time between the end of the host's sleep and the expected end of a telegram. The sleep should end between the last
/// two chunks of a telegram, so that the host waits only once more, for the last chunk. The lead therefore adapts to
/// the chunks of the line, and to the delay with which the host's sleeps end.
#[derive(Clone, Copy, Debug)]
pub struct WakeLead(Nanos);

impl WakeLead {
    /// Maximum lead, and initial lead. One or two chunks of 16 bytes arrive in this time at 500,000 baud.
    const MAX: Nanos = 600 * MICROS;
    /// Minimum lead. On an idle host, sleeps end 50 to 100 us late.
    const MIN: Nanos = 100 * MICROS;
    /// Increase of the lead after a sleep that ended too late.
    const INCREASE: Nanos = 80 * MICROS;
    /// Decrease of the lead after a telegram for which the host waited at least twice after the sleep. The decrease is
    /// a fraction of [`INCREASE`](Self::INCREASE), so that few sleeps end too late.
    const DECREASE: Nanos = 5 * MICROS;

    /// Returns the lead in ns.
    pub fn nanos(self) -> Nanos {
        self.0
    }

    /// Adapts the lead after a complete telegram. `reads` is the number of reads with bytes after the sleep. If `reads`
    /// is 1, the telegram was already complete when the sleep ended.
    pub fn adapt(&mut self, reads: u32) {
        match reads {
            1 => self.0 = (self.0 + WakeLead::INCREASE).min(WakeLead::MAX),
            3.. => self.0 = (self.0 - WakeLead::DECREASE).max(WakeLead::MIN),
            _ => {}
        }
    }
}

impl Default for WakeLead {
    fn default() -> Self {
        WakeLead(WakeLead::MAX)
    }
}

/// Maximum number of later bytes in the same read with which a stamp is still exact. A chunk of a USB adapter has 62
/// bytes.
const MAX_EXACT_BYTES: usize = 64;
/// Minimum time without bytes before a read whose bytes may be a backlog. At the highest baud rate, every sleep of the
/// hub is shorter, so the host or the line must have been stopped.
const STALL_THRESHOLD: Nanos = 50 * MILLIS;
/// Time after the last read with a surplus of bytes after which a backlog has ended. This time is shorter than the
/// duration of a telegram, and longer than the kernel needs to move bytes from one buffer to the next.
const BACKLOG_END_TIME: Nanos = 12 * MILLIS;
/// Minimum sleep. The system call costs too much for a shorter sleep.
const MIN_SLEEP: Nanos = 500 * MICROS;
/// Number of telegrams that are measured before the first sleep.
const LEARNING_TELEGRAMS: u32 = 3;
/// Number of telegrams over which each minimum is computed after the first sleep. If the host sleeps too long, the
/// telegram is complete before the sleep ends, so its measured duration is at most the duration of the sleep. The next
/// sleeps therefore become shorter again.
const WINDOW_TELEGRAMS: u32 = 16;
/// A telegram is suspect, for reason [`SLOW`](crate::line::suspect::SLOW), if its duration exceeds the usual duration
/// by more than this time.
const SLOW_TOLERANCE: Nanos = 8 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the stamp of a byte, and whether the stamp is an estimate.
    fn seen(arrivals: &ArrivalEstimator, offset: u64) -> (Nanos, bool) {
        let Timestamp { at, estimated, .. } = arrivals.stamp(offset, 500_000);
        (at, estimated)
    }

    #[test]
    fn later_bytes_make_a_stamp_earlier() {
        let mut arrivals = ArrivalEstimator::new(0);
        arrivals.note_read(1_000_000, 16, Some(500_000));
        arrivals.note_read(11_000_000, 484, Some(500_000));
        assert_eq!(seen(&arrivals, 0), (1_000_000 - 15 * 20_000, false));
        assert_eq!(seen(&arrivals, 499), (11_000_000, false));
        assert_eq!(seen(&arrivals, 16), (11_000_000 - 483 * 20_000, true));
        // Two reads of buffered bytes arrive faster than the line can carry them.
        arrivals.note_read(11_010_000, 500, Some(500_000));
        assert_eq!(seen(&arrivals, 499), (11_010_000 - 500 * 20_000, true));
        // A jitter of some microseconds does not make a stamp an estimate.
        arrivals.note_read(31_000_000, 16, Some(500_000));
        arrivals.note_read(31_300_000, 16, Some(500_000));
        assert_eq!(seen(&arrivals, 1_015), (30_980_000, false));
        for _ in 0..200 {
            arrivals.note_read(40_000_000, 1, Some(500_000));
        }
        // The byte is older than all stored reads.
        assert!(arrivals.stamp(0, 500_000).estimated);
    }

    #[test]
    fn backlogged_bytes_are_not_stamped_as_new() {
        let mut arrivals = ArrivalEstimator::new(0);
        arrivals.note_read(1_000 * MILLIS, 16, Some(500_000));
        // After two seconds, the host reads the backlog as fast as possible. New bytes follow.
        for read in 0..4 {
            arrivals.note_read(3_000 * MILLIS + read * 100_000, 1_600, Some(500_000));
        }
        // The kernel moves the rest of the backlog a little later. Then new bytes arrive.
        arrivals.note_read(3_002 * MILLIS, 50, Some(500_000));
        arrivals.note_read(3_002 * MILLIS + 50_000, 1_550, Some(500_000));
        arrivals.note_read(3_010 * MILLIS, 16, Some(500_000));
        assert!(arrivals.stamp(8_031, 500_000).at < 1_200 * MILLIS, "not yet known to be new");
        arrivals.note_read(3_015 * MILLIS, 16, Some(500_000));
        for byte in [0, 731, 1_599, 1_600, 6_399, 6_400, 7_999] {
            let at = 1_000 * MILLIS + (byte + 1) * 20_000;
            assert_eq!(seen(&arrivals, 16 + byte), (at, true));
        }
        assert_eq!(seen(&arrivals, 8_031), (3_010 * MILLIS, false));
        // Bytes after a silence are not a backlog if their number is small. Bytes of a slow line are not a backlog
        // either, because the line carried them at its own rate while the host slept.
        arrivals.note_read(5_000 * MILLIS, 62, Some(500_000));
        assert_eq!(seen(&arrivals, 8_109), (5_000 * MILLIS, false));
        arrivals.note_read(5_762 * MILLIS, 730, Some(9600));
        let stamp = arrivals.stamp(8_110 + 729, 9600);
        assert!(stamp.at > 5_760 * MILLIS && !stamp.estimated, "{stamp:?}");
    }

    #[test]
    fn stamp_of_delayed_bytes_is_their_earliest_arrival() {
        let mut arrivals = ArrivalEstimator::new(0);
        arrivals.note_read(1_000 * MILLIS, 16, Some(500_000));
        arrivals.note_read(1_500 * MILLIS, 0, Some(500_000));
        arrivals.note_read(1_850 * MILLIS, 16_000, Some(500_000));
        assert_eq!(seen(&arrivals, 16), (1_000 * MILLIS + 20_000, true));
    }

    #[test]
    fn stamp_is_not_before_the_session_start() {
        let mut arrivals = ArrivalEstimator::new(9_000 * MILLIS);
        arrivals.note_read(9_010 * MILLIS, 400, Some(500_000));
        let at = 9_010 * MILLIS - 399 * 20_000;
        assert_eq!(seen(&arrivals, 0), (at, true));
    }

    #[test]
    fn unread_bytes_are_stamped_when_they_were_counted() {
        let mut arrivals = ArrivalEstimator::new(0);
        arrivals.note_unread(1_000_000, 16);
        arrivals.note_read(18_000_000, 700, Some(500_000));
        arrivals.note_read(18_400_000, 32, Some(500_000));
        assert_eq!(seen(&arrivals, 0), (700_000, false));
        assert_eq!(seen(&arrivals, 731), (18_400_000, false));
        arrivals.note_read(30_000_000, 1, Some(500_000));
        assert_eq!(seen(&arrivals, 732), (30_000_000, false));
    }

    #[test]
    fn host_sleeps_once_three_telegrams_are_timed() {
        let mut rhythm = TelegramTiming::new();
        for took in [18_300_000, 18_000_000, 90_000_000] {
            rhythm.begin_telegram(0);
            assert_eq!(rhythm.sleep_until(0), None);
            rhythm.end_telegram(took);
        }
        rhythm.begin_telegram(100_000_000);
        assert_eq!(rhythm.sleep_until(100_000_000), Some(117_400_000));
        assert_eq!(rhythm.sleep_until(117_400_000), None, "once per telegram");
        assert!(rhythm.is_slow(26_000_001) && !rhythm.is_slow(26_000_000));
        // All of these telegrams were complete before the host read, so the lead grows.
        for _ in 0..16 {
            rhythm.end_telegram(17_500_000);
        }
        rhythm.begin_telegram(200_000_000);
        assert_eq!(rhythm.sleep_until(200_000_000), Some(216_900_000));
    }

    /// Simulates 400 telegrams of 18 ms. They arrive in chunks of `chunk` ns, on a host whose sleeps end up to
    /// `lateness` ns late. For the last 200 telegrams, returns the average number of reads after the sleep, and the
    /// number of telegrams that were complete before the sleep ended.
    fn play(chunk: Nanos, lateness: Nanos) -> (f64, u32) {
        const DURATION: Nanos = 18 * MILLIS;
        let mut rhythm = TelegramTiming::new();
        (0..3).for_each(|_| rhythm.end_telegram(DURATION));
        let (mut reads, mut late) = (0, 0);
        for n in 0..400 {
            rhythm.begin_telegram(0);
            let mut now = rhythm.sleep_until(0).unwrap() + lateness * (n % 7) / 6;
            let mut count = 1;
            rhythm.count_read();
            let is_late = now >= DURATION;
            while now < DURATION {
                // The last chunk ends with the telegram.
                now = DURATION - (DURATION - now - 1) / chunk * chunk;
                rhythm.count_read();
                count += 1;
            }
            rhythm.end_telegram(DURATION);
            if n >= 200 {
                (reads, late) = (reads + count, late + u32::from(is_late));
            }
        }
        (f64::from(reads) / 200.0, late)
    }

    #[test]
    fn wake_lead_leaves_about_one_chunk() {
        for (chunk, lateness) in [(320, 60), (320, 150), (1_240, 60), (1_240, 400), (80, 30)] {
            let (reads, late) = play(chunk * MICROS, lateness * MICROS);
            assert!(
                reads < 2.2 || chunk < WakeLead::MIN / MICROS,
                "{chunk} us, {lateness} us: {reads} reads"
            );
            assert!(late <= 20, "{chunk} us, {lateness} us: {late} of 200 late");
        }
        // With sleeps that end more than a chunk late, the host either has to wait for two chunks or wakes up too late.
        let (reads, late) = play(320 * MICROS, 500 * MICROS);
        assert!(reads < 2.5 && late <= 40, "{reads} reads, {late} late");
    }

    #[test]
    fn host_wakes_once_per_partial_read() {
        let mut rhythm = TelegramTiming::new();
        (0..3).for_each(|_| rhythm.end_telegram(18_000_000));
        rhythm.set_partial_reads(3);
        rhythm.begin_telegram(0);
        assert_eq!(rhythm.sleep_until(100_000), Some(6_000_000));
        assert_eq!(rhythm.sleep_until(6_050_000), Some(12_000_000));
        assert_eq!(rhythm.sleep_until(12_050_000), Some(17_400_000), "the end, a little before it");
        assert_eq!(rhythm.sleep_until(17_450_000), None);
        rhythm.begin_telegram(100_000_000);
        assert_eq!(
            rhythm.sleep_until(113_000_000),
            Some(117_400_000),
            "a late host skips pieces that have arrived"
        );
        // With 200 reads per telegram, the last partial read would be at the end of the telegram.
        rhythm.set_partial_reads(200);
        rhythm.begin_telegram(0);
        let looks = core::iter::successors(rhythm.sleep_until(0), |&at| rhythm.sleep_until(at)).count();
        assert!((20..=33).contains(&looks), "{looks}");
    }
}
