//! The mount's angle at any time, interpolated between the angles that its encoder reports. The module also detects
//! unreliable angles and the reversals of the mount.

use std::collections::VecDeque;

use serde::Serialize;

use super::{Counts, Settings};

/// An angle reported by the mount's encoder or drive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Angle {
    /// Time of the measurement (not of the report) on CLOCK_MONOTONIC.
    pub stamp_ns: u64,
    /// Angle in radians, in the direction that [`Mount`](super::Mount) defines.
    pub angle_rad: f64,
    /// Rate of change in rad/s; NaN if it is unknown.
    pub rate_rad_s: f64,
}

/// Reason why a beam produces no point.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[repr(usize)]
pub enum DropReason {
    /// No angle was reported for the time of the beam, or the angle arrived too late.
    Silent,
    /// The angle jumps, or jumped recently.
    Jumped,
    /// The angles contradict their rates.
    Inconsistent,
    /// The mount stands, or its encoder is stuck. The angles do not distinguish these two cases.
    Standing,
}

impl DropReason {
    /// Number of variants.
    pub const COUNT: usize = 4;
}

/// Result of a query for the angle at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum AngleLookup {
    Known(f64),
    /// No later angle has arrived yet.
    Open,
    Never(DropReason),
}

/// Effect of a new angle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum AngleUpdate {
    /// The angle was dropped.
    Dropped,
    /// The mount moved to this angle.
    Moved,
    /// The angles between the previous angle and the new one are unknown.
    Interrupted,
}

#[derive(Clone, Copy)]
struct Entry {
    angle: Angle,
    /// Reason why the angles between the previous angle and this one are unknown.
    drop_reason: Option<DropReason>,
}

/// The most recent angles.
pub(crate) struct Angles {
    entries: VecDeque<Entry>,
    settled_ns: u64,
    /// Estimated delay of all stamps in ns.
    late_ns: i64,
}

/// Maximum number of stored angles, enough for ten seconds at 100 Hz.
const MAX_ANGLES: usize = 1024;
/// Two limits in ns. If the stamp of an angle is earlier than the previous angle's stamp by more than this time, the
/// clock was set back. If it is later than the latest scan's stamp by more than this time, the angle is dropped.
const CLOCK_JUMP_NS: u64 = 1_000_000_000;

impl Angles {
    pub(crate) fn new() -> Angles {
        Angles { entries: VecDeque::with_capacity(MAX_ANGLES), settled_ns: 0, late_ns: 0 }
    }

    /// Handles the next angle. `scan_ns` is the stamp of the latest scan.
    pub(crate) fn take(
        &mut self,
        angle: Angle,
        scan_ns: Option<u64>,
        settings: &Settings,
        counts: &mut Counts,
    ) -> AngleUpdate {
        if !angle.angle_rad.is_finite() {
            counts.angles_invalid += 1;
            return AngleUpdate::Dropped;
        }
        if scan_ns.is_some_and(|scan_ns| angle.stamp_ns > scan_ns.saturating_add(CLOCK_JUMP_NS)) {
            counts.angles_in_future += 1;
            return AngleUpdate::Dropped;
        }
        let Some(before) = self.entries.back().map(|entry| entry.angle) else {
            self.entries.push_back(Entry { angle, drop_reason: Some(DropReason::Silent) });
            return AngleUpdate::Interrupted;
        };
        if angle.stamp_ns <= before.stamp_ns {
            counts.angles_out_of_order += 1;
            if before.stamp_ns - angle.stamp_ns > CLOCK_JUMP_NS {
                self.entries.clear();
                self.entries.push_back(Entry { angle, drop_reason: Some(DropReason::Silent) });
                return AngleUpdate::Interrupted;
            }
            return AngleUpdate::Dropped;
        }
        let drop_reason = self.drop_reason(&before, &angle, settings);
        if self.entries.len() == MAX_ANGLES {
            self.entries.pop_front();
        }
        self.entries.push_back(Entry { angle, drop_reason });
        if drop_reason.is_some() { AngleUpdate::Interrupted } else { AngleUpdate::Moved }
    }

    fn drop_reason(&mut self, before: &Angle, angle: &Angle, settings: &Settings) -> Option<DropReason> {
        let lasts_ns = angle.stamp_ns - before.stamp_ns;
        let speed = (angle.angle_rad - before.angle_rad) / (lasts_ns as f64 * 1e-9);
        if lasts_ns > settings.gap_ns {
            return Some(DropReason::Silent);
        }
        if speed.abs() > settings.max_speed_rad_s {
            self.settled_ns = angle.stamp_ns.saturating_add(settings.settle_ns);
        }
        if angle.stamp_ns <= self.settled_ns {
            return Some(DropReason::Jumped);
        }
        // At a reversal, the rates of the two angles differ, and the speed is between the two rates.
        let (lowest, highest) =
            (before.rate_rad_s.min(angle.rate_rad_s), before.rate_rad_s.max(angle.rate_rad_s));
        let is_off = speed < lowest - settings.rate_rad_s || speed > highest + settings.rate_rad_s;
        is_off.then_some(DropReason::Inconsistent)
    }

    /// Marks all angles after the one with the stamp `since_ns` as standing.
    pub(crate) fn mark_standing(&mut self, since_ns: u64) {
        let stands = |entry: &&mut Entry| entry.angle.stamp_ns > since_ns && entry.drop_reason.is_none();
        self.entries
            .iter_mut()
            .rev()
            .take_while(stands)
            .for_each(|entry| entry.drop_reason = Some(DropReason::Standing));
    }

    /// Returns the delay of all stamps in ns.
    pub(crate) fn late_ns(&self) -> i64 {
        self.late_ns
    }

    /// Adds `more_ns` to the delay of all stamps.
    pub(crate) fn correct(&mut self, more_ns: i64) {
        self.late_ns += more_ns;
    }

    /// Returns the time at which the mount had the angle with the stamp `stamp_ns`.
    pub(crate) fn true_ns(&self, stamp_ns: u64) -> u64 {
        stamp_ns.saturating_add_signed(-self.late_ns)
    }

    /// Returns the time at which the mount had the last angle.
    pub(crate) fn last_ns(&self) -> Option<u64> {
        self.entries.back().map(|entry| self.true_ns(entry.angle.stamp_ns))
    }

    /// Returns the reason why the angle is unknown between the last two reported angles; `None` if it is known.
    pub(crate) fn problem(&self) -> Option<DropReason> {
        self.entries.back().map_or(Some(DropReason::Silent), |entry| entry.drop_reason)
    }

    /// Returns the angle at `time_ns`, interpolated between the angles before and after it.
    pub(crate) fn at(&self, time_ns: u64) -> AngleLookup {
        let time_ns = time_ns.saturating_add_signed(self.late_ns);
        let after = self.entries.partition_point(|entry| entry.angle.stamp_ns < time_ns);
        let Some(Entry { angle, drop_reason }) = self.entries.get(after) else { return AngleLookup::Open };
        let Some(before) = after.checked_sub(1).map(|i| self.entries[i].angle) else {
            return AngleLookup::Never(DropReason::Silent);
        };
        match drop_reason {
            Some(reason) => AngleLookup::Never(*reason),
            None => {
                let share = (time_ns - before.stamp_ns) as f64 / (angle.stamp_ns - before.stamp_ns) as f64;
                AngleLookup::Known(before.angle_rad + share * (angle.angle_rad - before.angle_rad))
            }
        }
    }
}

/// Event that is detected when a new angle arrives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SwingEvent {
    Nothing,
    /// The mount reversed at this time.
    Reversed(u64),
    /// The mount has been standing since this time.
    Standing(u64),
}

/// An angle with its stamp.
#[derive(Clone, Copy, Debug, PartialEq)]
struct StampedAngle {
    stamp_ns: u64,
    rad: f64,
}

/// Direction in which the mount moves.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Direction {
    /// Unknown direction, with the minimum and maximum angle since the direction became unknown.
    Open { lowest: StampedAngle, highest: StampedAngle },
    /// Toward larger angles, with the maximum so far.
    Up(StampedAngle),
    /// Toward smaller angles, with the minimum so far.
    Down(StampedAngle),
}

/// Detects the reversals of a mount, and whether the mount stands. Play in the gears is not detected as a reversal,
/// because the detector has a hysteresis.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ReversalDetector {
    direction: Option<Direction>,
    /// Last angle at which the mount moved.
    moved: Option<StampedAngle>,
}

impl ReversalDetector {
    /// Resets the detector.
    pub(crate) fn reset(&mut self) {
        *self = ReversalDetector::default();
    }

    /// Handles the next angle, and returns the event that it causes.
    pub(crate) fn take(&mut self, stamp_ns: u64, rad: f64, settings: &Settings) -> SwingEvent {
        use Direction::{Down, Open, Up};
        use SwingEvent::{Nothing, Reversed};
        let here = StampedAngle { stamp_ns, rad };
        let moved = *self.moved.get_or_insert(here);
        if (rad - moved.rad).abs() > settings.reversal_rad / 10.0 {
            self.moved = Some(here);
        } else if stamp_ns - moved.stamp_ns > settings.standing_ns {
            self.direction = None;
            return SwingEvent::Standing(moved.stamp_ns);
        }
        let back = settings.reversal_rad;
        let (direction, event) = match self.direction.unwrap_or(Open { lowest: here, highest: here }) {
            Open { lowest, .. } if rad > lowest.rad + back => (Up(here), Nothing),
            Open { highest, .. } if rad < highest.rad - back => (Down(here), Nothing),
            Open { lowest, highest } => {
                let lowest = if rad <= lowest.rad { here } else { lowest };
                let highest = if rad >= highest.rad { here } else { highest };
                (Open { lowest, highest }, Nothing)
            }
            Up(highest) if rad < highest.rad - back => (Down(here), Reversed(highest.stamp_ns)),
            Up(highest) => (Up(if rad >= highest.rad { here } else { highest }), Nothing),
            Down(lowest) if rad > lowest.rad + back => (Up(here), Reversed(lowest.stamp_ns)),
            Down(lowest) => (Down(if rad <= lowest.rad { here } else { lowest }), Nothing),
        };
        self.direction = Some(direction);
        event
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn angles(reported: &[(u64, f64)]) -> (Angles, Vec<AngleUpdate>, Counts) {
        let (mut angles, mut counts) = (Angles::new(), Counts::default());
        let settings = Settings::default();
        let steps = reported.iter().map(|&(ms, deg)| {
            let angle = Angle { stamp_ns: ms * MS, angle_rad: f64::to_radians(deg), rate_rad_s: f64::NAN };
            angles.take(angle, Some(1000 * MS), &settings, &mut counts)
        });
        let steps = steps.collect();
        (angles, steps, counts)
    }

    fn deg(angles: &Angles, ms: u64) -> Option<f64> {
        match angles.at(ms * MS) {
            AngleLookup::Known(rad) => Some((rad.to_degrees() * 1e6).round() / 1e6),
            _ => None,
        }
    }

    #[test]
    fn interpolates_between_two_angles() {
        let (angles, steps, _) = angles(&[(10, 1.0), (20, 2.0), (40, 1.0)]);
        assert_eq!(steps, [AngleUpdate::Interrupted, AngleUpdate::Moved, AngleUpdate::Moved]);
        assert_eq!([15, 20, 30, 40].map(|ms| deg(&angles, ms)), [1.5, 2.0, 1.5, 1.0].map(Some));
        assert_eq!(
            (angles.at(9 * MS), angles.at(41 * MS)),
            (AngleLookup::Never(DropReason::Silent), AngleLookup::Open)
        );
    }

    #[test]
    fn does_not_interpolate_over_silence_or_jump() {
        let (silent, ..) = angles(&[(10, 1.0), (20, 2.0), (200, 3.0), (210, 4.0)]);
        assert_eq!(silent.at(100 * MS), AngleLookup::Never(DropReason::Silent));
        assert_eq!(deg(&silent, 205), Some(3.5));
        let reported: Vec<_> = (0..80).map(|i| (10 * i, if i < 5 { 0.0 } else { 8.0 })).collect();
        let (jumped, steps, _) = angles(&reported);
        assert_eq!(jumped.at(45 * MS), AngleLookup::Never(DropReason::Jumped));
        assert_eq!(jumped.at(300 * MS), AngleLookup::Never(DropReason::Jumped), "not settled");
        assert_eq!(deg(&jumped, 600), Some(8.0));
        assert_eq!(steps.iter().filter(|step| **step == AngleUpdate::Moved).count(), 4 + 80 - 5 - 51);
    }

    #[test]
    fn impossible_stamps_are_dropped_and_counted() {
        let (angles, steps, counts) =
            angles(&[(1500, 1.0), (1490, 1.0), (2100, 1.0), (1510, 2.0), (100, 3.0), (110, 4.0)]);
        use AngleUpdate::{Dropped as D, Interrupted, Moved};
        assert_eq!(steps, [Interrupted, D, D, Moved, Interrupted, Moved]);
        assert_eq!((counts.angles_out_of_order, counts.angles_in_future, counts.angles_invalid), (2, 1, 0));
        assert_eq!(deg(&angles, 105), Some(3.5), "the clock was set back");
    }

    #[test]
    fn contradicting_rates_are_detected() {
        let settings = Settings::default();
        let mut angles = Angles::new();
        let mut say = |ms: u64, deg: f64, deg_s: f64| {
            let angle =
                Angle { stamp_ns: ms * MS, angle_rad: deg.to_radians(), rate_rad_s: deg_s.to_radians() };
            angles.take(angle, None, &settings, &mut Counts::default())
        };
        assert_eq!(
            [say(0, 0.0, 30.0), say(10, 0.3, 30.0), say(20, 0.1, -30.0)],
            [AngleUpdate::Interrupted, AngleUpdate::Moved, AngleUpdate::Moved]
        );
        assert_eq!(
            [say(30, -0.2, 30.0), say(40, -0.5, 30.0)],
            [AngleUpdate::Moved, AngleUpdate::Interrupted]
        );
        assert_eq!(angles.at(35 * MS), AngleLookup::Never(DropReason::Inconsistent));
    }

    #[test]
    fn marks_angles_as_standing_since_the_given_time() {
        let (mut angles, ..) = angles(&[(10, 1.0), (20, 2.0), (30, 2.0), (40, 2.0)]);
        angles.mark_standing(20 * MS);
        assert_eq!(deg(&angles, 15), Some(1.5));
        assert_eq!(angles.at(25 * MS), AngleLookup::Never(DropReason::Standing));
    }

    fn events(degrees: impl Iterator<Item = f64>) -> Vec<SwingEvent> {
        let mut swing = ReversalDetector::default();
        let settings = Settings::default();
        let events =
            degrees.enumerate().map(|(i, deg)| swing.take(10 * i as u64 * MS, deg.to_radians(), &settings));
        events.filter(|event| *event != SwingEvent::Nothing).collect()
    }

    /// Returns the angle in degrees at report `i`. The mount swings by 20 degrees up and down in two seconds, with half
    /// a degree of play.
    fn triangle(i: u32) -> f64 {
        let phase = f64::from(i % 200) / 100.0;
        20.0 * if phase < 1.0 { phase } else { 2.0 - phase } + if i.is_multiple_of(2) { 0.25 } else { -0.25 }
    }

    #[test]
    fn reversal_is_at_the_extreme_angle() {
        let turns = events((0..500).map(triangle));
        let times: Vec<u64> = turns
            .iter()
            .map(|event| match event {
                SwingEvent::Reversed(ns) => ns / MS,
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(times.len(), 4, "where it began may be anywhere: {times:?}");
        for (time, expected) in times.iter().zip([1000, 2000, 3000, 4000]) {
            assert!(time.abs_diff(expected) <= 20, "{times:?}");
        }
    }

    #[test]
    fn constant_angle_is_reported_as_standing() {
        let stands = events((0..200).map(|i| f64::from(i.min(100)) * 0.3));
        let SwingEvent::Standing(since) = stands[0] else { panic!("{stands:?}") };
        assert_eq!(since / MS, 1000);
        assert!(stands[1..].iter().all(|event| *event == SwingEvent::Standing(since)), "as long as it does");
    }
}
