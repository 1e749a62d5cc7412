//! Doors, and who comes out of an unseen way: which door leads from room to room, and how likely it is that somebody who
//! went in then comes out now. Refuses to know sensors.

use crate::geometry::{Point, distance_to_segment};
use crate::site::Site;

/// Spread of the logarithm of how fast somebody crosses, around his own pace.
const SPREAD: f64 = 0.2;
/// Who stops on the way takes any time that the gap allows.
const STOPS: f64 = 0.15;
/// Who turns round, and after how many seconds.
const TURNS: f64 = 0.04;
const TURNS_AFTER_S: f64 = 6.0;
/// Longest time of a way of which no gap tells.
pub(crate) const LONGEST_S: f64 = 60.0;

impl Site {
    /// Returns the door from `from` to `to` that is nearest to `place`.
    pub(crate) fn door_between(&self, from: Option<usize>, to: Option<usize>, place: Point) -> Option<usize> {
        let between = |door: usize| {
            let ends = (self.doors[door].from, self.doors[door].to);
            ends == (from, to) || ends == (to, from)
        };
        let off = |&door: &usize| distance_to_segment(place, self.doors[door].between);
        (0..self.doors.len()).filter(|&door| between(door)).min_by(|a, b| off(a).total_cmp(&off(b)))
    }

    /// Returns the seconds of the gap between two doors, shortest and longest.
    fn gap(&self, doors: [usize; 2]) -> Option<[f64; 2]> {
        let [a, b] = doors;
        let found = self.gaps.iter().find(|gap| gap.doors == [a, b] || gap.doors == [b, a]);
        found.map(|gap| gap.seconds)
    }

    /// Returns how likely it is, per second, that somebody who went out of sight at door `entry` `after_s` seconds ago at
    /// `pace` m/s is seen now, `way_m` metres farther, at door `exit`, given that he has not been before: the density of the
    /// time divided by what is left of it.
    pub(crate) fn arrival(&self, [entry, exit]: [usize; 2], way_m: f64, pace: f64, after_s: f64) -> f64 {
        let t = after_s.max(0.05);
        if entry == exit && t > 1.5 * way_m / pace {
            return TURNS / TURNS_AFTER_S;
        }
        let [shortest, longest] = self.gap([entry, exit]).unwrap_or([0.0, LONGEST_S]);
        if t > 2.0 * longest {
            return 1e-6;
        }
        let z = ((way_m.max(0.3) / t).ln() - pace.max(0.3).ln()) / SPREAD;
        let walks = (-z * z / 2.0).exp() / (SPREAD * t * (2.0 * std::f64::consts::PI).sqrt());
        let width = longest - shortest;
        let stops = if (shortest..=longest).contains(&t) { 1.0 / width } else { 1e-3 / width };
        let left = (longest - t.clamp(shortest, longest)) / width;
        let density = (1.0 - STOPS) * walks + STOPS * stops;
        let remains = (1.0 - STOPS) * normal_below(z) + STOPS * left;
        density / remains.max(1e-3)
    }
}

/// Probability that a standard normal number is less than `z`: the error function by Abramowitz and Stegun 7.1.26,
/// within 2e-7.
fn normal_below(z: f64) -> f64 {
    let x = z.abs() / std::f64::consts::SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * x);
    let series = [1.061_405_429, -1.453_152_027, 1.421_413_741, -0.284_496_736, 0.254_829_592];
    let poly = series.iter().fold(0.0, |sum, c| (sum + c) * t);
    let erf = 1.0 - poly * (-x * x).exp();
    if z < 0.0 { (1.0 - erf) / 2.0 } else { (1.0 + erf) / 2.0 }
}

#[cfg(test)]
mod tests {
    use super::normal_below;

    #[test]
    fn the_normal_distribution_agrees_with_its_integral() {
        let mut sum = 0.0;
        for i in 0..80_000 {
            let z = -4.0 + 1e-4 * f64::from(i);
            if i % 5_000 == 0 {
                assert!((normal_below(z) - sum - 3.17e-5).abs() < 1e-5, "{z}: {} {sum}", normal_below(z));
            }
            let mid = z + 0.5e-4;
            sum += 1e-4 * (-mid * mid / 2.0).exp() / (2.0 * std::f64::consts::PI).sqrt();
        }
    }
}
