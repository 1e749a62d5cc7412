//! The mount's angle at any time, from what its encoder says now and then; and where that cannot be trusted. Refuses to know
//! beams and sweeps.

use std::collections::VecDeque;

use crate::tilt::settings::Settings;

/// What an encoder, or whatever turns the mount, says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Angle {
    /// CLOCK_MONOTONIC when the mount was there, not when that was said.
    pub stamp_ns: u64,
    /// In radians, as [`Mount`](crate::tilt::Mount) counts them.
    pub angle_rad: f64,
    /// How fast it grows in radians a second; nan: not known.
    pub rate_rad_s: f64,
}

/// Why beams make no points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Withheld {
    /// No angle was said for that time, or it came too late.
    Silent,
    /// The angle jumped, or has jumped not long ago.
    Jumped,
    /// The angles are not those that their rates say.
    Inconsistent,
    /// The mount stands, or its encoder hangs: from the angles both look alike.
    Standing,
}

impl Withheld {
    /// How many reasons there are.
    pub const COUNT: usize = 4;
}

/// What is known of the angle at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum At {
    Known(f64),
    /// No later angle has come yet.
    Open,
    Never(Withheld),
}

/// What an angle means for the way that the mount takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Step {
    /// It was not taken.
    Dropped,
    /// The mount came here.
    On,
    /// From the angle before to this one nothing is known.
    Torn,
}

/// What was wrong with angles, since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Dropped {
    pub(crate) unordered: u64,
    pub(crate) ahead: u64,
    pub(crate) unfit: u64,
}

#[derive(Clone, Copy)]
struct Entry {
    angle: Angle,
    /// Why the way from the angle before to this one is not known.
    torn: Option<Withheld>,
}

/// The last angles.
pub(crate) struct Angles {
    entries: VecDeque<Entry>,
    settled_ns: u64,
    /// Time from each angle to its stamp.
    late_ns: i64,
    pub(crate) dropped: Dropped,
}

/// So many are kept: ten seconds of 100 a second.
const ANGLES: usize = 1024;
/// A stamp so far before all others is of a clock that was set back; one so far ahead of the scans of none.
const JUMP_NS: u64 = 1_000_000_000;

impl Angles {
    pub(crate) fn new() -> Angles {
        Angles {
            entries: VecDeque::with_capacity(ANGLES),
            settled_ns: 0,
            late_ns: 0,
            dropped: Dropped::default(),
        }
    }

    /// Takes the next angle; the latest scan is of `scan_ns`, if there was one.
    pub(crate) fn take(&mut self, angle: Angle, scan_ns: Option<u64>, settings: &Settings) -> Step {
        if !angle.angle_rad.is_finite() {
            self.dropped.unfit += 1;
            return Step::Dropped;
        }
        if scan_ns.is_some_and(|scan_ns| angle.stamp_ns > scan_ns.saturating_add(JUMP_NS)) {
            self.dropped.ahead += 1;
            return Step::Dropped;
        }
        let Some(before) = self.entries.back().map(|entry| entry.angle) else {
            self.entries.push_back(Entry { angle, torn: Some(Withheld::Silent) });
            return Step::Torn;
        };
        if angle.stamp_ns <= before.stamp_ns {
            self.dropped.unordered += 1;
            if before.stamp_ns - angle.stamp_ns > JUMP_NS {
                self.entries.clear();
                self.entries.push_back(Entry { angle, torn: Some(Withheld::Silent) });
                return Step::Torn;
            }
            return Step::Dropped;
        }
        let torn = self.torn(&before, &angle, settings);
        if self.entries.len() == ANGLES {
            self.entries.pop_front();
        }
        self.entries.push_back(Entry { angle, torn });
        if torn.is_some() { Step::Torn } else { Step::On }
    }

    fn torn(&mut self, before: &Angle, angle: &Angle, settings: &Settings) -> Option<Withheld> {
        let lasts_ns = angle.stamp_ns - before.stamp_ns;
        let speed = (angle.angle_rad - before.angle_rad) / (lasts_ns as f64 * 1e-9);
        if lasts_ns > settings.gap_ns {
            return Some(Withheld::Silent);
        }
        if speed.abs() > settings.fastest_rad_s {
            self.settled_ns = angle.stamp_ns.saturating_add(settings.settle_ns);
        }
        if angle.stamp_ns <= self.settled_ns {
            return Some(Withheld::Jumped);
        }
        // Where the mount turns back the rates are apart, and the way is between them.
        let (least, most) =
            (before.rate_rad_s.min(angle.rate_rad_s), before.rate_rad_s.max(angle.rate_rad_s));
        let is_off = speed < least - settings.rate_rad_s || speed > most + settings.rate_rad_s;
        is_off.then_some(Withheld::Inconsistent)
    }

    /// Marks all angles after the one with the stamp `since_ns`: the mount stands.
    pub(crate) fn stand_since(&mut self, since_ns: u64) {
        let stands = |entry: &&mut Entry| entry.angle.stamp_ns > since_ns && entry.torn.is_none();
        self.entries
            .iter_mut()
            .rev()
            .take_while(stands)
            .for_each(|entry| entry.torn = Some(Withheld::Standing));
    }

    /// Returns the delay of all stamps.
    pub(crate) fn late_ns(&self) -> i64 {
        self.late_ns
    }

    /// Adds `more_ns` to the delay of all stamps.
    pub(crate) fn correct(&mut self, more_ns: i64) {
        self.late_ns += more_ns;
    }

    /// Returns when the mount was where an angle with the stamp `stamp_ns` says.
    pub(crate) fn true_ns(&self, stamp_ns: u64) -> u64 {
        stamp_ns.saturating_add_signed(-self.late_ns)
    }

    /// Returns when the mount was at the last angle.
    pub(crate) fn last_ns(&self) -> Option<u64> {
        self.entries.back().map(|entry| self.true_ns(entry.angle.stamp_ns))
    }

    /// Returns why the way to the last angle is not known.
    pub(crate) fn trouble(&self) -> Option<Withheld> {
        self.entries.back().map_or(Some(Withheld::Silent), |entry| entry.torn)
    }

    /// Returns the angle at `time_ns`, evenly between those before and after.
    pub(crate) fn at(&self, time_ns: u64) -> At {
        let time_ns = time_ns.saturating_add_signed(self.late_ns);
        let after = self.entries.partition_point(|entry| entry.angle.stamp_ns < time_ns);
        let Some(Entry { angle, torn }) = self.entries.get(after) else { return At::Open };
        let Some(before) = after.checked_sub(1).map(|i| self.entries[i].angle) else {
            return At::Never(Withheld::Silent);
        };
        match torn {
            Some(why) => At::Never(*why),
            None => {
                let share = (time_ns - before.stamp_ns) as f64 / (angle.stamp_ns - before.stamp_ns) as f64;
                At::Known(before.angle_rad + share * (angle.angle_rad - before.angle_rad))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn angles(said: &[(u64, f64)]) -> (Angles, Vec<Step>) {
        let mut angles = Angles::new();
        let settings = Settings::default();
        let steps = said.iter().map(|&(ms, deg)| {
            let angle = Angle { stamp_ns: ms * MS, angle_rad: f64::to_radians(deg), rate_rad_s: f64::NAN };
            angles.take(angle, Some(1000 * MS), &settings)
        });
        let steps = steps.collect();
        (angles, steps)
    }

    fn deg(angles: &Angles, ms: u64) -> Option<f64> {
        match angles.at(ms * MS) {
            At::Known(rad) => Some((rad.to_degrees() * 1e6).round() / 1e6),
            _ => None,
        }
    }

    #[test]
    fn between_two_angles_it_goes_evenly() {
        let (angles, steps) = angles(&[(10, 1.0), (20, 2.0), (40, 1.0)]);
        assert_eq!(steps, [Step::Torn, Step::On, Step::On]);
        assert_eq!([15, 20, 30, 40].map(|ms| deg(&angles, ms)), [1.5, 2.0, 1.5, 1.0].map(Some));
        assert_eq!((angles.at(9 * MS), angles.at(41 * MS)), (At::Never(Withheld::Silent), At::Open));
    }

    #[test]
    fn a_silence_and_a_jump_are_no_way() {
        let (silent, _) = angles(&[(10, 1.0), (20, 2.0), (200, 3.0), (210, 4.0)]);
        assert_eq!(silent.at(100 * MS), At::Never(Withheld::Silent));
        assert_eq!(deg(&silent, 205), Some(3.5));
        let said: Vec<_> = (0..80).map(|i| (10 * i, if i < 5 { 0.0 } else { 8.0 })).collect();
        let (jumped, steps) = angles(&said);
        assert_eq!(jumped.at(45 * MS), At::Never(Withheld::Jumped));
        assert_eq!(jumped.at(300 * MS), At::Never(Withheld::Jumped), "not settled");
        assert_eq!(deg(&jumped, 600), Some(8.0));
        assert_eq!(steps.iter().filter(|step| **step == Step::On).count(), 4 + 80 - 5 - 51);
    }

    #[test]
    fn stamps_that_cannot_be_are_dropped_and_counted() {
        let (angles, steps) =
            angles(&[(1500, 1.0), (1490, 1.0), (2100, 1.0), (1510, 2.0), (100, 3.0), (110, 4.0)]);
        use Step::{Dropped as D, On, Torn};
        assert_eq!(steps, [Torn, D, D, On, Torn, On]);
        assert_eq!(angles.dropped, Dropped { unordered: 2, ahead: 1, unfit: 0 });
        assert_eq!(deg(&angles, 105), Some(3.5), "the clock was set back");
    }

    #[test]
    fn rates_that_say_something_else_are_told() {
        let settings = Settings::default();
        let mut angles = Angles::new();
        let mut say = |ms: u64, deg: f64, deg_s: f64| {
            let angle =
                Angle { stamp_ns: ms * MS, angle_rad: deg.to_radians(), rate_rad_s: deg_s.to_radians() };
            angles.take(angle, None, &settings)
        };
        assert_eq!(
            [say(0, 0.0, 30.0), say(10, 0.3, 30.0), say(20, 0.1, -30.0)],
            [Step::Torn, Step::On, Step::On]
        );
        assert_eq!([say(30, -0.2, 30.0), say(40, -0.5, 30.0)], [Step::On, Step::Torn]);
        assert_eq!(angles.at(35 * MS), At::Never(Withheld::Inconsistent));
    }

    #[test]
    fn what_stands_is_marked_back_to_where_it_stood_still() {
        let (mut angles, _) = angles(&[(10, 1.0), (20, 2.0), (30, 2.0), (40, 2.0)]);
        angles.stand_since(20 * MS);
        assert_eq!(deg(&angles, 15), Some(1.5));
        assert_eq!(angles.at(25 * MS), At::Never(Withheld::Standing));
    }
}
