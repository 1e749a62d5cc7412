//! Losses of a stream: scans that were due and did not arrive, and bytes that were damaged on the line.
//!
//! A scanner sends scans one period apart, even if they do not arrive. So lost ones can be counted, and one that was in
//! a backlog can be stamped. If a scanner is silent for longer than the session waits, that is not a loss on the line:
//! the stream starts again.

use scanhub_schema::{MILLIS, Nanos};

use crate::lms::framer::Tally;

/// Due times of one stream, and counters of all streams of a session.
#[derive(Clone, Debug)]
pub(crate) struct Cadence {
    /// Period by the scanner's settings.
    nominal: Nanos,
    /// Measured period. It differs, because the scanner's motor and the host's clock are never exact.
    period: Nanos,
    /// Due time of the last scan. `None`: the next one begins a cadence.
    last: Option<Nanos>,
    /// Whether two scans have arrived one period apart, so that the scanner does send that often.
    is_steady: bool,
    lesson: Lesson,
    /// Number of scans that were due after the first one of each cadence, and of those that arrived.
    pub(crate) due: u64,
    came: u64,
    /// Number of scans that certainly did not arrive.
    pub(crate) lost: u64,
    /// Minimum number of missing scans since `settled_at`. A late one is missing only for a moment.
    least: u64,
    settled_at: Nanos,
}

/// Measurement of the period.
#[derive(Clone, Copy, Debug)]
struct Lesson {
    begin: Nanos,
    slots: u64,
    length: u64,
}

impl Cadence {
    pub(crate) fn new() -> Self {
        Cadence {
            nominal: 0,
            period: 0,
            last: None,
            is_steady: false,
            lesson: Lesson { begin: 0, slots: 0, length: FIRST_LESSON },
            due: 0,
            came: 0,
            lost: 0,
            least: 0,
            settled_at: 0,
        }
    }

    /// Returns the due time `slots` periods after the last scan. `None` before the scanner is known to be steady.
    pub(crate) fn after(&self, slots: u64) -> Option<Nanos> {
        self.last.filter(|_| self.is_steady).map(|last| last + slots * self.period)
    }

    /// Ends the cadence, because the stream ended, or a request was sent, for which the scanner skips scans.
    pub(crate) fn rest(&mut self) {
        if self.last.take().is_some() {
            self.lost = self.lost.max(self.due.saturating_sub(self.came));
            self.least = self.lost;
        }
    }

    /// Handles a scan that began at `at`, of a scanner with the period `nominal`.
    pub(crate) fn note(&mut self, at: Nanos, estimated: bool, nominal: Nanos) {
        if nominal != self.nominal {
            self.rest();
            (self.nominal, self.period, self.is_steady) = (nominal, nominal, false);
            self.lesson.length = FIRST_LESSON;
        }
        let Some(last) = self.last else {
            (self.last, self.settled_at) = (Some(at), at);
            (self.lesson.begin, self.lesson.slots) = (at, 0);
            return;
        };
        let (since, period) = (at as i64 - last as i64, self.period as i64);
        let slots = (since + period / 2).div_euclid(period).max(0);
        let off = since - slots * period;
        // The delay that a busy host adds to one stamp must not move the due times by as much.
        let due = last.saturating_add_signed(slots * period + off / if estimated { 8 } else { 2 });
        self.last = Some(due);
        let slots = slots as u64;
        self.lesson.slots += slots;
        if self.lesson.slots >= self.lesson.length && !estimated {
            self.learn(due);
        }
        self.is_steady |= slots == 1;
        if self.is_steady {
            self.due += slots;
            self.came += 1;
            self.settle(at);
        }
    }

    /// Uses the mean of the measurement as the period, if it is plausible.
    fn learn(&mut self, due: Nanos) {
        let Lesson { begin, slots, length } = self.lesson;
        let mean = due.saturating_sub(begin) / slots;
        if mean.abs_diff(self.nominal) * TOLERANCE < self.nominal {
            self.period = mean;
        }
        self.lesson = Lesson { begin: due, slots: 0, length: (2 * length).min(LONGEST_LESSON) };
    }

    /// Counts scans as lost that were missing for a whole second.
    fn settle(&mut self, at: Nanos) {
        let missing = self.due.saturating_sub(self.came);
        self.least = self.least.min(missing);
        if at.saturating_sub(self.settled_at) > LATEST {
            self.lost = self.lost.max(self.least);
            self.least = missing;
            self.settled_at = at;
        }
    }
}

/// Number of scans of the first measurement, and of the longest one.
const FIRST_LESSON: u64 = 64;
const LONGEST_LESSON: u64 = 256;
/// A mean that differs by this part of the nominal period is not plausible: scans were miscounted.
const TOLERANCE: u64 = 6;
/// A scan that is later than this is lost. A network may delay scans for some tenths of a second.
const LATEST: Nanos = 1_000 * MILLIS;

/// Damage of all streams of a session.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Damage {
    /// Number of damaged bytes, up to `seen`.
    damaged: u64,
    /// Number of bytes in no telegram when the stream was last checked. `None` without a stream.
    seen: Option<u64>,
    /// Time at which bytes were last found damaged.
    last: Option<Nanos>,
}

impl Damage {
    /// Handles the counters of a stream that begins or continues.
    pub(crate) fn note(&mut self, tally: &Tally, now: Nanos) {
        let in_nothing = in_nothing(tally);
        if let Some(seen) = self.seen.replace(in_nothing)
            && in_nothing > seen
        {
            self.damaged += in_nothing - seen;
            self.last = Some(now);
        }
    }

    /// Ends the stream.
    pub(crate) fn end(&mut self) {
        self.seen = None;
    }

    /// Returns the number of damaged bytes, including those since the last check.
    pub(crate) fn damaged(&self, tally: &Tally) -> u64 {
        self.damaged + self.seen.map_or(0, |seen| in_nothing(tally) - seen)
    }

    /// Returns whether a telegram that arrives at `now` may be damaged although its checksum is right.
    pub(crate) fn is_recent(&self, now: Nanos) -> bool {
        self.last.is_some_and(|last| now.saturating_sub(last) < RECENT)
    }
}

fn in_nothing(tally: &Tally) -> u64 {
    tally.discarded - tally.broken_off
}

/// Time for which a line counts as damaging after the last damage.
const RECENT: Nanos = 10_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Nanos = 26_640_000;

    /// Returns the cadence after scans at these times, in periods.
    fn after_scans(scans: impl IntoIterator<Item = f64>) -> Cadence {
        let mut cadence = Cadence::new();
        for at in scans {
            cadence.note(((100.0 + at) * PERIOD as f64) as Nanos, false, PERIOD);
        }
        cadence.rest();
        cadence
    }

    #[test]
    fn counts_missing_scans_when_they_are_too_late() {
        let mut cadence = Cadence::new();
        for n in (0..100).filter(|n| ![20, 40, 41, 42].contains(n)) {
            cadence.note(n * PERIOD, false, PERIOD);
        }
        assert_eq!((cadence.due, cadence.lost), (99, 1), "the last three are too new");
        for n in 100..140 {
            cadence.note(n * PERIOD, false, PERIOD);
        }
        assert_eq!((cadence.due, cadence.lost), (139, 4));
    }

    #[test]
    fn delays_are_not_losses() {
        let jittery = (0..4000).map(|n| f64::from(n) + f64::from(n * 7 % 10) * 0.04);
        assert_eq!(after_scans(jittery).lost, 0);
        // A network that sometimes delays scans for 200 ms, and then delivers all at once.
        let held = (0..4000).map(|n| f64::from(if n % 100 < 8 { n - n % 100 + 8 } else { n }));
        let mut cadence = Cadence::new();
        for at in held {
            cadence.note((at * PERIOD as f64) as Nanos, false, PERIOD);
            assert_eq!(cadence.lost, 0);
        }
    }

    #[test]
    fn measures_a_period_near_the_nominal_one() {
        for drift in [0.97, 0.999, 1.001, 1.03, 1.12] {
            let kept = |n: &u32| !n.is_multiple_of(3) || n.is_multiple_of(5);
            let scans = (0..3000).filter(kept).map(|n| f64::from(n) * drift);
            let lost = (0..3000).filter(|n| !kept(n)).count() as u64;
            let counted = after_scans(scans).lost;
            assert!(counted.abs_diff(lost) <= 2, "{drift}: {counted} of {lost}");
        }
        let mut cadence = Cadence::new();
        (0..400).for_each(|n| cadence.note(n * (PERIOD + 30_000), false, PERIOD));
        let due = cadence.after(80).expect("steady");
        assert!(due.abs_diff((399 + 80) * (PERIOD + 30_000)) < 100_000, "{due}");
    }

    #[test]
    fn ambiguous_gaps_are_not_counted() {
        // A scanner that always sends every other scan.
        let slow = after_scans((0..100).map(|n| f64::from(2 * n)));
        assert_eq!((slow.due, slow.lost), (0, 0));
        // A pause.
        let mut cadence = Cadence::new();
        (0..50).for_each(|n| cadence.note(n * PERIOD, false, PERIOD));
        cadence.rest();
        assert_eq!(cadence.after(1), None);
        (900..950).for_each(|n| cadence.note(n * PERIOD, false, PERIOD));
        assert_eq!((cadence.due, cadence.lost), (98, 0));
        // Another resolution.
        cadence.note(960 * PERIOD, false, PERIOD / 2);
        (1921..1950).for_each(|n| cadence.note(n * PERIOD / 2, false, PERIOD / 2));
        cadence.rest();
        assert_eq!(cadence.lost, 0);
    }

    #[test]
    fn counts_only_bytes_of_streams() {
        let tally = |discarded, broken_off| Tally { discarded, broken_off, ..Tally::default() };
        let mut damage = Damage::default();
        damage.note(&tally(500, 0), 1);
        assert_eq!((damage.damaged(&tally(500, 0)), damage.is_recent(1)), (0, false));
        damage.note(&tally(700, 150), 2);
        assert_eq!((damage.damaged(&tally(700, 150)), damage.damaged(&tally(720, 150))), (50, 70));
        assert!(damage.is_recent(2) && damage.is_recent(RECENT + 1) && !damage.is_recent(RECENT + 2));
        damage.end();
        assert_eq!(damage.damaged(&tally(900, 150)), 50);
        damage.note(&tally(900, 150), 3);
        damage.note(&tally(901, 150), 4);
        assert_eq!(damage.damaged(&tally(901, 150)), 51);
    }
}
