//! Computes the likelihood that a person who comes into the sensors' view is a person who went out of view earlier. The
//! likelihood depends on position, walking speed and time, and on the gaps of the site.

use super::geometry::{Point, distance_to_segment, length2, middle, minus};
use super::site::Site;

/// Maximum time of a path that is not in the site file, in seconds.
pub(crate) const MAX_GAP_S: f64 = 60.0;
/// Standard deviation of the logarithm of the ratio between a person's speed and the person's pace.
const PACE_SPREAD: f64 = 0.2;
/// Share of people who walk on without a stop. The first constant is for people who walked when they were last seen,
/// and the second for people who stood.
const CONTINUE_SHARE_WALKING: f64 = 0.6;
const CONTINUE_SHARE_STANDING: f64 = 0.3;
/// Share of people who stay at their position, and the mean time for which they stay, in seconds.
const STAY_SHARE: f64 = 0.4;
const STAY_TIME_S: f64 = 4.0;
/// Share of people who turn back.
const TURN_BACK_SHARE: f64 = 0.04;
/// Minimum speed of a person who walks on, in m/s.
const MIN_WALKING_SPEED_M_S: f64 = 0.5;
/// Minimum speed of a person who turns back, in m/s.
const MIN_RETURN_SPEED_M_S: f64 = 0.35;
/// Standard deviations of a person's position along and across the path, in meters. The deviation across the path grows
/// by [`ACROSS_SIGMA_M_S`] every second, up to [`MAX_ACROSS_SIGMA_M`], the width of a path.
const ALONG_SIGMA_M: f64 = 0.25;
const ACROSS_SIGMA_M: f64 = 0.25;
const ACROSS_SIGMA_M_S: f64 = 0.3;
const MAX_ACROSS_SIGMA_M: f64 = 0.7;
/// Likelihood for a person who arrives earlier or much later than the gap allows.
const MIN_LIKELIHOOD: f64 = 1e-6;
/// Length of a path with an unknown end, in meters.
const DEFAULT_PATH_M: f64 = 5.0;

/// A person who is out of sight.
pub(crate) struct DepartedPerson {
    /// Door through which the person entered the room in which they went out of sight; `None` if it is unknown.
    pub(crate) entry: Option<usize>,
    /// Last position in the map, in meters, and speed in m/s.
    pub(crate) at: Point,
    pub(crate) speed: f64,
    /// Walking speed in m/s.
    pub(crate) pace: f64,
}

/// A person who has come into view.
pub(crate) struct ArrivedPerson {
    /// Door that is nearest to the position at which the person was first seen.
    pub(crate) exit: usize,
    /// Position at which the person was first seen.
    pub(crate) at: Point,
    pub(crate) velocity: Point,
    /// Whether the person is beyond the door `exit`, in a room with sensors.
    pub(crate) is_out: bool,
}

impl Site {
    /// Returns the minimum and maximum time that the path between two doors takes, in seconds.
    fn gap(&self, [a, b]: [usize; 2]) -> [f64; 2] {
        let found = self.gaps.iter().find(|gap| gap.doors == [a, b] || gap.doors == [b, a]);
        found.map_or([0.0, MAX_GAP_S], |gap| gap.seconds)
    }

    /// Returns the likelihood per square meter that `departed`, who went out of sight `after_s` seconds ago, is at the
    /// position of `arrived`. The model is that people walk on at their pace, walk on after a stop, stay, or turn back.
    pub(crate) fn likelihood(&self, departed: &DepartedPerson, arrived: &ArrivedPerson, after_s: f64) -> f64 {
        let t = after_s.max(0.0);
        let off = minus(arrived.at, departed.at);
        let far_m = length2(off).sqrt();
        // Distance that the departed person would have walked forward since they were last seen, length of the rest of
        // their path, and the arrived person's speed in this direction.
        let (ahead_m, rest_m, speed) = match departed.entry {
            Some(entry) => {
                let door = self.doors[entry].between;
                let returns = arrived.is_out && arrived.exit == entry;
                let from_door = distance_to_segment(arrived.at, door);
                let now_m = if returns { -from_door } else { from_door };
                let end =
                    if arrived.exit == entry { arrived.at } else { middle(self.doors[arrived.exit].between) };
                let path = minus(end, middle(door));
                let along = (path[0] * arrived.velocity[0] + path[1] * arrived.velocity[1])
                    / length2(path).sqrt().max(0.1);
                let rest_m = if arrived.exit == entry {
                    DEFAULT_PATH_M
                } else {
                    distance_to_segment(departed.at, self.doors[arrived.exit].between)
                };
                let ahead_m = now_m - distance_to_segment(departed.at, door);
                let [shortest_s, longest_s] = self.gap([entry, arrived.exit]);
                let is_too_soon = ahead_m * shortest_s > (t + 0.5) * length2(path).sqrt();
                if is_too_soon || t > 2.0 * longest_s {
                    return MIN_LIKELIHOOD;
                }
                (ahead_m, rest_m, if returns { -along } else { along })
            }
            None => (far_m, DEFAULT_PATH_M, 0.0),
        };
        let across_m = (far_m * far_m - ahead_m * ahead_m).max(0.0).sqrt();
        let walked_m = departed.pace.max(0.3) * t;
        let (range_m, sigma_m) = (walked_m.max(0.3), ALONG_SIGMA_M + PACE_SPREAD * walked_m);
        let walks = if departed.speed > MIN_WALKING_SPEED_M_S {
            CONTINUE_SHARE_WALKING
        } else {
            CONTINUE_SHARE_STANDING
        };
        let staying = STAY_SHARE * (-t / STAY_TIME_S).exp();
        let stops = 1.0 - walks - staying;
        let within = |from: f64, to: f64| if (from..=to).contains(&ahead_m) { 1.0 / range_m } else { 0.0 };
        let density = walks * normal(ahead_m - walked_m, sigma_m)
            + stops * within(-0.1, range_m)
            + staying * normal(ahead_m, ALONG_SIGMA_M)
            + TURN_BACK_SHARE * within(-range_m, 0.0).max(0.01);
        let remains = walks * normal_below((rest_m - walked_m) / sigma_m)
            + stops * (rest_m / range_m).min(1.0)
            + staying
            + TURN_BACK_SHARE;
        let across = normal(across_m, (ACROSS_SIGMA_M + ACROSS_SIGMA_M_S * t).min(MAX_ACROSS_SIGMA_M));
        let turns = if speed < -MIN_RETURN_SPEED_M_S { TURN_BACK_SHARE } else { 1.0 };
        turns * across * density / remains
    }
}

/// Returns the density of a normal distribution at `x`.
fn normal(x: f64, sigma: f64) -> f64 {
    (-x * x / (2.0 * sigma * sigma)).exp() / (sigma * (2.0 * std::f64::consts::PI).sqrt())
}

/// Returns the probability that a number with standard normal distribution is less than `z`. Uses the error function of
/// Abramowitz and Stegun 7.1.26, whose error is at most 2e-7.
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
    use super::{ArrivedPerson, DepartedPerson, Site, normal_below};

    const HOUSE: &str = r#"
[[sensor]]
name = "front"
pose = { x = 0.1, y = 2.5, yaw = 0.0 }
[[sensor]]
name = "rear"
pose = { x = 16.9, y = 2.5, yaw = 3.1416 }
[[room]]
name = "hall"
polygon = [[0, 0], [6, 0], [6, 5], [0, 5]]
[[room]]
name = "corridor"
polygon = [[6, 1.5], [11, 1.5], [11, 3.5], [6, 3.5]]
[[room]]
name = "kitchen"
polygon = [[11, 0], [17, 0], [17, 5], [11, 5]]
[[door]]
name = "left"
from = "hall"
to = "corridor"
between = [[6, 2], [6, 3]]
[[door]]
name = "right"
from = "corridor"
to = "kitchen"
between = [[11, 2], [11, 3]]
[[gap]]
between = ["left", "right"]
seconds = [2, 15]
"#;

    #[test]
    fn gap_likelihood_depends_on_direction_and_time() {
        let site = Site::parse("house.toml", HOUSE).expect("a house");
        let departed =
            |entry: usize, x: f64| DepartedPerson { entry: Some(entry), at: [x, 2.5], speed: 1.0, pace: 1.1 };
        let (from_left, from_right) = (departed(0, 6.5), departed(1, 10.5));
        let new =
            |x: f64, vx: f64| ArrivedPerson { exit: 0, at: [x, 2.5], velocity: [vx, 0.0], is_out: x < 6.0 };
        for arrived in [new(6.7, -1.0), new(5.7, -1.0)] {
            let (turns, walks) =
                (site.likelihood(&from_left, &arrived, 4.0), site.likelihood(&from_right, &arrived, 4.0));
            assert!(walks > 10.0 * turns, "{walks} and {turns}");
        }
        let stands = new(6.6, 0.0);
        let (stays, flies) =
            (site.likelihood(&from_left, &stands, 0.4), site.likelihood(&from_right, &stands, 0.4));
        assert!(stays > 10.0 * flies, "{stays} and {flies}");
        // The gap allows at least 2 s, and at most 15 s.
        assert!(site.likelihood(&from_right, &new(6.0, -1.0), 1.0) < 1e-4);
        assert!(site.likelihood(&from_right, &new(6.0, -1.0), 31.0) < 1e-4);
    }

    #[test]
    fn normal_distribution_agrees_with_the_integral() {
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
