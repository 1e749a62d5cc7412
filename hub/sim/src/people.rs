//! People who walk about in a room: where their legs are at a given time. A pure function of time and seed, so that
//! two sensors, a test and a bench see the same person. Knows nothing of sensors.

use std::f64::consts::TAU;

use crate::shape::Shape;

/// One person on a closed path.
#[derive(Clone, Debug)]
pub(crate) struct Walker {
    centre: (f64, f64),
    reach: (f64, f64),
    /// Turns per second along the two axes.
    pace: (f64, f64),
    phase: (f64, f64),
}

impl Walker {
    /// A person who stays within `reach` of `centre` (millimetres).
    pub(crate) fn new(centre: (f64, f64), reach: (f64, f64), random: &mut fastrand::Rng) -> Self {
        // Peak speed is 2 pi * reach * pace: 0.5 to 1.3 m/s, as people indoors walk.
        let mut pace = |reach: f64| (500.0 + 800.0 * random.f64()) / (TAU * reach);
        let pace = (pace(reach.0), pace(reach.1));
        Walker { centre, reach, pace, phase: (random.f64(), random.f64()) }
    }

    /// Both legs at `time_s`, as a sensor at the height of the shins sees them.
    pub(crate) fn legs(&self, time_s: f64) -> [Shape; 2] {
        let turn = |pace: f64, phase: f64| (TAU * (pace * time_s + phase)).sin_cos();
        let (sin_x, cos_x) = turn(self.pace.0, self.phase.0);
        let (sin_y, cos_y) = turn(self.pace.1, self.phase.1);
        let place = (self.centre.0 + self.reach.0 * sin_x, self.centre.1 + self.reach.1 * sin_y);
        let heading = (self.pace.0 * self.reach.0 * cos_x, self.pace.1 * self.reach.1 * cos_y);
        let speed = heading.0.hypot(heading.1).max(1e-9);
        let ahead = (heading.0 / speed, heading.1 / speed);
        let stride = STRIDE_MM * (TAU * STEPS_HZ * time_s + self.phase.0).sin();
        [1.0, -1.0].map(|side| Shape::Post {
            centre: (
                place.0 + side * (stride * ahead.0 - HIP_MM * ahead.1),
                place.1 + side * (stride * ahead.1 + HIP_MM * ahead.0),
            ),
            radius: LEG_MM,
        })
    }
}

/// Half the distance between the legs across the way.
const HIP_MM: f64 = 110.0;
/// How far a foot gets ahead of the body.
const STRIDE_MM: f64 = 250.0;
/// Double steps per second.
const STEPS_HZ: f64 = 0.9;
/// Radius of a leg with its trousers.
const LEG_MM: f64 = 65.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_walker_moves_like_a_person_and_stays_within_reach() {
        let walker = Walker::new((0.0, 3000.0), (1500.0, 800.0), &mut fastrand::Rng::with_seed(1));
        let body = |time_s: f64| {
            let [a, b] = walker.legs(time_s).map(|leg| match leg {
                Shape::Post { centre, .. } => centre,
                Shape::Wall { from, .. } => from,
            });
            ((a.0 + b.0) / 2.0, (a.1 + b.1) / 2.0)
        };
        let mut fastest = 0.0f64;
        for step in 0..6000 {
            let time_s = f64::from(step) * 0.01;
            let (now, then) = (body(time_s), body(time_s + 0.01));
            fastest = fastest.max((now.0 - then.0).hypot(now.1 - then.1) / 0.01);
            assert!(now.0.abs() <= 1501.0 && (now.1 - 3000.0).abs() <= 801.0);
        }
        assert!((500.0..2000.0).contains(&fastest), "{fastest} mm/s");
    }
}
