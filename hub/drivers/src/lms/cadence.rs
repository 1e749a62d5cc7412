//! When the scans of a stream are due. A sensor sends them one period apart, whatever becomes of them on the way: so
//! those that never came can be counted, and one that waited while the host did not run can be dated. Knows no bytes.
//! If a sensor is silent for longer than the session waits, that is not counted as loss on the line: the stream starts
//! again.

use schema::{MILLIS, Nanos};

/// The beat of one stream, and the account of all streams of a session.
#[derive(Clone, Debug)]
pub(crate) struct Cadence {
    /// The period that the beat began with, by the sensor's settings.
    nominal: Nanos,
    /// The period as it was measured since: a sensor's motor and a host's clock are never quite equal.
    period: Nanos,
    /// When the last scan was due; `None`: the next one begins a beat.
    last: Option<Nanos>,
    /// Two scans came one period apart: the sensor does send that often.
    is_steady: bool,
    lesson: Lesson,
    /// Scans that were due after the first one of each beat, and those of them that came.
    due: u64,
    came: u64,
    /// Those that did not come, for sure.
    lost: u64,
    /// The fewest that were missing since then: what is only late is missing for a moment.
    least: u64,
    settled_at: Nanos,
}

/// From which scan on the period is measured, and over how many.
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

    /// Scans that the sensor must have sent since the first one of each stream; 0 also where that is not known.
    pub(crate) fn due(&self) -> u64 {
        self.due
    }

    /// Those of them that did not arrive. One that is missing counts after a second: it might only be late.
    pub(crate) fn lost(&self) -> u64 {
        self.lost
    }

    /// When the scan is due that comes so many periods after the last one; nothing before there was one.
    pub(crate) fn after(&self, slots: u64) -> Option<Nanos> {
        self.last.filter(|_| self.is_steady).map(|last| last + slots * self.period)
    }

    /// The stream ended, or a request was sent, for which the sensor skips scans: the next scan starts a new cadence.
    pub(crate) fn rest(&mut self) {
        if self.last.take().is_some() {
            self.lost = self.lost.max(self.due.saturating_sub(self.came));
            self.least = self.lost;
        }
    }

    /// A scan began at `at`, which may be an estimate, of a sensor that sends one each `nominal`.
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
        // What a busy host adds to one stamp shall not move the beat by as much.
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

    /// Takes the mean of the lesson for the period, if it can be one.
    fn learn(&mut self, due: Nanos) {
        let Lesson { begin, slots, length } = self.lesson;
        let mean = due.saturating_sub(begin) / slots;
        if mean.abs_diff(self.nominal) * TOLERANCE < self.nominal {
            self.period = mean;
        }
        self.lesson = Lesson { begin: due, slots: 0, length: (2 * length).min(LONGEST_LESSON) };
    }

    /// What was missing for a whole second is lost.
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

/// Scans by which the period is measured at first, and at most.
const FIRST_LESSON: u64 = 64;
const LONGEST_LESSON: u64 = 256;
/// A mean that is off by this part of the nominal period is none: something was miscounted.
const TOLERANCE: u64 = 6;
/// What comes later than so much is lost: a network may hold back for some tenths of a second.
const LATEST: Nanos = 1_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Nanos = 26_640_000;

    /// The account after scans at these times, in periods.
    fn heard(scans: impl IntoIterator<Item = f64>) -> Cadence {
        let mut cadence = Cadence::new();
        for at in scans {
            cadence.note(((100.0 + at) * PERIOD as f64) as Nanos, false, PERIOD);
        }
        cadence.rest();
        cadence
    }

    #[test]
    fn what_is_missing_is_counted_once_it_cannot_come_any_more() {
        let mut cadence = Cadence::new();
        for n in (0..100).filter(|n| ![20, 40, 41, 42].contains(n)) {
            cadence.note(n * PERIOD, false, PERIOD);
        }
        assert_eq!((cadence.due(), cadence.lost()), (99, 1), "the last three are too new");
        for n in 100..140 {
            cadence.note(n * PERIOD, false, PERIOD);
        }
        assert_eq!((cadence.due(), cadence.lost()), (139, 4));
    }

    #[test]
    fn a_host_or_network_that_is_late_loses_nothing() {
        let jittery = (0..4000).map(|n| f64::from(n) + f64::from(n * 7 % 10) * 0.04);
        assert_eq!(heard(jittery).lost(), 0);
        // A network that holds back for 200 ms, now and then, and then brings all at once.
        let held = (0..4000).map(|n| f64::from(if n % 100 < 8 { n - n % 100 + 8 } else { n }));
        let mut cadence = Cadence::new();
        for at in held {
            cadence.note((at * PERIOD as f64) as Nanos, false, PERIOD);
            assert_eq!(cadence.lost(), 0);
        }
    }

    #[test]
    fn a_period_that_is_not_quite_the_nominal_one_is_learned() {
        for drift in [0.97, 0.999, 1.001, 1.03, 1.12] {
            let kept = |n: &u32| !n.is_multiple_of(3) || n.is_multiple_of(5);
            let scans = (0..3000).filter(kept).map(|n| f64::from(n) * drift);
            let lost = (0..3000).filter(|n| !kept(n)).count() as u64;
            let counted = heard(scans).lost();
            assert!(counted.abs_diff(lost) <= 2, "{drift}: {counted} of {lost}");
        }
        let mut cadence = Cadence::new();
        (0..400).for_each(|n| cadence.note(n * (PERIOD + 30_000), false, PERIOD));
        let due = cadence.after(80).expect("a beat");
        assert!(due.abs_diff((399 + 80) * (PERIOD + 30_000)) < 100_000, "{due}");
    }

    #[test]
    fn what_may_be_anything_is_not_counted() {
        // A sensor that sends every other scan all the while.
        let slow = heard((0..100).map(|n| f64::from(2 * n)));
        assert_eq!((slow.due(), slow.lost()), (0, 0));
        // A pause.
        let mut cadence = Cadence::new();
        (0..50).for_each(|n| cadence.note(n * PERIOD, false, PERIOD));
        cadence.rest();
        assert_eq!(cadence.after(1), None);
        (900..950).for_each(|n| cadence.note(n * PERIOD, false, PERIOD));
        assert_eq!((cadence.due(), cadence.lost()), (98, 0));
        // Another resolution.
        cadence.note(960 * PERIOD, false, PERIOD / 2);
        (1921..1950).for_each(|n| cadence.note(n * PERIOD / 2, false, PERIOD / 2));
        cadence.rest();
        assert_eq!(cadence.lost(), 0);
    }
}
