//! Counts the losses of a stream: scans that were due but did not arrive, and bytes that the line damaged.
//!
//! A scanner sends scans one period apart, even if the line loses some of them. The schedule can therefore count lost
//! scans and stamp a scan in a backlog. A silence that is longer than the session's timeout is not a loss on the line,
//! because the session then restarts the stream.

use scanhub_schema::{MILLIS, Nanos};

use crate::lms::framer::FramerCounters;

/// Due times of the current stream, and counters of all streams of a session.
#[derive(Clone, Debug)]
pub(crate) struct ScanSchedule {
    /// Period that follows from the scanner's settings.
    nominal: Nanos,
    /// Measured period. It differs from the nominal period because the scanner's motor and the host's clock are not
    /// exact.
    period: Nanos,
    /// Due time of the last scan. `None` if the next scan begins a stream.
    last_due: Option<Nanos>,
    /// Whether two scans have arrived one period apart, which shows that the scanner sends a scan in every period.
    is_steady: bool,
    window: PeriodWindow,
    /// Number of scans that were due after the first scan of each stream.
    pub(crate) due: u64,
    arrived: u64,
    /// Number of scans that counted as lost because they were missing for a second.
    pub(crate) lost: u64,
    /// Minimum number of missing scans since `min_since`. A scan that is only late is missing for a short time, so it
    /// does not increase this minimum.
    min_missing: u64,
    min_since: Nanos,
}

/// Measurement of the mean period over `length` periods.
#[derive(Clone, Copy, Debug)]
struct PeriodWindow {
    begin: Nanos,
    slots: u64,
    length: u64,
}

impl ScanSchedule {
    pub(crate) fn new() -> Self {
        ScanSchedule {
            nominal: 0,
            period: 0,
            last_due: None,
            is_steady: false,
            window: PeriodWindow { begin: 0, slots: 0, length: FIRST_WINDOW_SCANS },
            due: 0,
            arrived: 0,
            lost: 0,
            min_missing: 0,
            min_since: 0,
        }
    }

    /// Returns the due time `slots` periods after the last scan. Returns `None` until the scanner has sent scans in
    /// consecutive periods.
    pub(crate) fn due_after(&self, slots: u64) -> Option<Nanos> {
        self.last_due.filter(|_| self.is_steady).map(|last| last + slots * self.period)
    }

    /// Ends the sequence of due times, because the scanner stopped, or skips scans to send a reply.
    pub(crate) fn end_stream(&mut self) {
        if self.last_due.take().is_some() {
            self.lost = self.lost.max(self.due.saturating_sub(self.arrived));
            self.min_missing = self.lost;
        }
    }

    /// Records a scan that began at `at`. `nominal` is the period that follows from the scanner's settings.
    pub(crate) fn note_scan(&mut self, at: Nanos, estimated: bool, nominal: Nanos) {
        if nominal != self.nominal {
            self.end_stream();
            (self.nominal, self.period, self.is_steady) = (nominal, nominal, false);
            self.window.length = FIRST_WINDOW_SCANS;
        }
        let Some(last) = self.last_due else {
            (self.last_due, self.min_since) = (Some(at), at);
            (self.window.begin, self.window.slots) = (at, 0);
            return;
        };
        let (since, period) = (at as i64 - last as i64, self.period as i64);
        let slots = (since + period / 2).div_euclid(period).max(0);
        let off = since - slots * period;
        // A busy host may delay a stamp. The due times therefore follow only a part of a deviation.
        let due = last.saturating_add_signed(slots * period + off / if estimated { 8 } else { 2 });
        self.last_due = Some(due);
        let slots = slots as u64;
        self.window.slots += slots;
        if self.window.slots >= self.window.length && !estimated {
            self.update_period(due);
        }
        self.is_steady |= slots == 1;
        if self.is_steady {
            self.due += slots;
            self.arrived += 1;
            self.count_lost(at);
        }
    }

    /// Uses the measured mean as the period, if the mean is plausible.
    fn update_period(&mut self, due: Nanos) {
        let PeriodWindow { begin, slots, length } = self.window;
        let mean = due.saturating_sub(begin) / slots;
        if mean.abs_diff(self.nominal) * TOLERANCE_DIVISOR < self.nominal {
            self.period = mean;
        }
        self.window = PeriodWindow { begin: due, slots: 0, length: (2 * length).min(MAX_WINDOW_SCANS) };
    }

    /// Counts scans as lost that have been missing for a second.
    fn count_lost(&mut self, at: Nanos) {
        let missing = self.due.saturating_sub(self.arrived);
        self.min_missing = self.min_missing.min(missing);
        if at.saturating_sub(self.min_since) > LOSS_TIMEOUT {
            self.lost = self.lost.max(self.min_missing);
            self.min_missing = missing;
            self.min_since = at;
        }
    }
}

/// Number of periods of the first measurement. Later measurements are longer, up to `MAX_WINDOW_SCANS`.
const FIRST_WINDOW_SCANS: u64 = 64;
const MAX_WINDOW_SCANS: u64 = 256;
/// Inverse of the maximum plausible deviation of a mean from the nominal period. If a mean deviates more, scans were
/// counted wrongly.
const TOLERANCE_DIVISOR: u64 = 6;
/// Time after which a missing scan is lost. A network may delay scans for some tenths of a second.
const LOSS_TIMEOUT: Nanos = 1_000 * MILLIS;

/// Counter of damaged bytes in all streams of a session.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LineDamage {
    /// Number of damaged bytes up to the last check.
    damaged: u64,
    /// Number of bytes outside telegrams at the last check. `None` without a stream.
    checked: Option<u64>,
    /// Time of the last check that found damaged bytes.
    last_damage: Option<Nanos>,
}

impl LineDamage {
    /// Adds the damage since the last check. Starts a stream if there is none.
    pub(crate) fn note_bytes(&mut self, counters: &FramerCounters, now: Nanos) {
        let unassigned = unassigned_bytes(counters);
        if let Some(checked) = self.checked.replace(unassigned)
            && unassigned > checked
        {
            self.damaged += unassigned - checked;
            self.last_damage = Some(now);
        }
    }

    /// Ends the stream. Until the next stream starts, bytes outside telegrams do not count as damage.
    pub(crate) fn end_stream(&mut self) {
        self.checked = None;
    }

    /// Returns the number of damaged bytes, including the bytes since the last check.
    pub(crate) fn damaged(&self, counters: &FramerCounters) -> u64 {
        self.damaged + self.checked.map_or(0, |checked| unassigned_bytes(counters) - checked)
    }

    /// Returns whether a telegram that arrives at `now` may be damaged although its checksum is right.
    pub(crate) fn is_recent(&self, now: Nanos) -> bool {
        self.last_damage.is_some_and(|last| now.saturating_sub(last) < RECENT_DAMAGE_TIME)
    }
}

fn unassigned_bytes(counters: &FramerCounters) -> u64 {
    counters.discarded - counters.broken_off
}

/// Time after the last damage during which every telegram on the line may be damaged.
const RECENT_DAMAGE_TIME: Nanos = 10_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Nanos = 26_640_000;

    /// Returns the schedule after scans at the times `scans`, in periods.
    fn after_scans(scans: impl IntoIterator<Item = f64>) -> ScanSchedule {
        let mut cadence = ScanSchedule::new();
        for at in scans {
            cadence.note_scan(((100.0 + at) * PERIOD as f64) as Nanos, false, PERIOD);
        }
        cadence.end_stream();
        cadence
    }

    #[test]
    fn counts_missing_scans_when_they_are_too_late() {
        let mut cadence = ScanSchedule::new();
        for n in (0..100).filter(|n| ![20, 40, 41, 42].contains(n)) {
            cadence.note_scan(n * PERIOD, false, PERIOD);
        }
        assert_eq!((cadence.due, cadence.lost), (99, 1), "the last three are too new");
        for n in 100..140 {
            cadence.note_scan(n * PERIOD, false, PERIOD);
        }
        assert_eq!((cadence.due, cadence.lost), (139, 4));
    }

    #[test]
    fn delayed_scans_do_not_count_as_lost() {
        let jittery = (0..4000).map(|n| f64::from(n) + f64::from(n * 7 % 10) * 0.04);
        assert_eq!(after_scans(jittery).lost, 0);
        // A network sometimes delays scans for 200 ms and then delivers all of them at once.
        let held = (0..4000).map(|n| f64::from(if n % 100 < 8 { n - n % 100 + 8 } else { n }));
        let mut cadence = ScanSchedule::new();
        for at in held {
            cadence.note_scan((at * PERIOD as f64) as Nanos, false, PERIOD);
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
        let mut cadence = ScanSchedule::new();
        (0..400).for_each(|n| cadence.note_scan(n * (PERIOD + 30_000), false, PERIOD));
        let due = cadence.due_after(80).expect("steady");
        assert!(due.abs_diff((399 + 80) * (PERIOD + 30_000)) < 100_000, "{due}");
    }

    #[test]
    fn ambiguous_gaps_are_not_counted() {
        // The scanner always skips every second scan.
        let slow = after_scans((0..100).map(|n| f64::from(2 * n)));
        assert_eq!((slow.due, slow.lost), (0, 0));
        // The scanner pauses.
        let mut cadence = ScanSchedule::new();
        (0..50).for_each(|n| cadence.note_scan(n * PERIOD, false, PERIOD));
        cadence.end_stream();
        assert_eq!(cadence.due_after(1), None);
        (900..950).for_each(|n| cadence.note_scan(n * PERIOD, false, PERIOD));
        assert_eq!((cadence.due, cadence.lost), (98, 0));
        // The scanner now has another resolution.
        cadence.note_scan(960 * PERIOD, false, PERIOD / 2);
        (1921..1950).for_each(|n| cadence.note_scan(n * PERIOD / 2, false, PERIOD / 2));
        cadence.end_stream();
        assert_eq!(cadence.lost, 0);
    }

    #[test]
    fn counts_only_bytes_of_streams() {
        let tally =
            |discarded, broken_off| FramerCounters { discarded, broken_off, ..FramerCounters::default() };
        let mut damage = LineDamage::default();
        damage.note_bytes(&tally(500, 0), 1);
        assert_eq!((damage.damaged(&tally(500, 0)), damage.is_recent(1)), (0, false));
        damage.note_bytes(&tally(700, 150), 2);
        assert_eq!((damage.damaged(&tally(700, 150)), damage.damaged(&tally(720, 150))), (50, 70));
        assert!(
            damage.is_recent(2)
                && damage.is_recent(RECENT_DAMAGE_TIME + 1)
                && !damage.is_recent(RECENT_DAMAGE_TIME + 2)
        );
        damage.end_stream();
        assert_eq!(damage.damaged(&tally(900, 150)), 50);
        damage.note_bytes(&tally(900, 150), 3);
        damage.note_bytes(&tally(901, 150), 4);
        assert_eq!(damage.damaged(&tally(901, 150)), 51);
    }
}
