//! Estimates the delay of a mount's stamps relative to its angles. If the stamps are late, a surface appears too low in
//! sweeps in one direction, and too high in sweeps in the other direction. Play in the gears has the same effect.

use super::sweep::Ray;

/// Number of beam directions that are compared.
const COLUMN_COUNT: usize = 24;
/// Minimum number of points on slopes that a measurement of the delay needs.
const MIN_VOTES: usize = 60;
/// Minimum angle by which a surface must appear displaced between two sweeps to count as a delay, in radians: 0.1
/// degrees.
const MIN_SHIFT_RAD: f64 = 0.0017;
/// Maximum delay that is corrected, in seconds.
pub(crate) const MAX_DELAY_S: f64 = 0.15;
/// Minimum distance by which the end of a beam moves per radian of the mount's angle, in meters. If it moves less,
/// noise hides the delay.
const MIN_SLOPE_M: f64 = 3.0;
/// Maximum relative difference between neighboring slopes on one surface.
const MAX_SLOPE_DIFFERENCE: f64 = 0.3;
/// Maximum angle between neighboring samples on one plane, in radians.
const MAX_GAP_RAD: f64 = 0.06;

/// A beam of a sweep.
#[derive(Clone, Copy)]
struct Sample {
    time_s: f64,
    angle_rad: f64,
    /// One divided by the range in meters. On a plane, this value changes evenly with the angle.
    inverse: f64,
}

/// The sampled beams of a sweep, by direction.
#[derive(Default)]
struct Profile {
    columns: Vec<Vec<Sample>>,
    until_ns: u64,
}

/// Comparison of each complete sweep with the one before it.
#[derive(Default)]
pub(crate) struct Delay {
    before: Profile,
    now: Profile,
    /// Delay computed from each point, in seconds.
    votes: Vec<f64>,
    /// Delay computed from the last pair of sweeps, in seconds.
    last: Option<f64>,
}

impl Delay {
    /// Removes all sweeps.
    pub(crate) fn reset(&mut self) {
        (self.before.until_ns, self.now.until_ns, self.last) = (0, 0, None);
    }

    /// Adds a sweep, whose scans have `beams` beams. Once two successive pairs of sweeps agree on the delay that
    /// remains after earlier corrections, returns this delay in seconds.
    pub(crate) fn take(
        &mut self,
        rays: &[Ray],
        beams: usize,
        (from_ns, until_ns): (u64, u64),
        is_complete: bool,
    ) -> Option<f64> {
        std::mem::swap(&mut self.before, &mut self.now);
        self.now.fill(rays, beams, from_ns);
        self.now.until_ns = if is_complete { until_ns } else { 0 };
        let is_pair = is_complete && self.before.until_ns == from_ns;
        let measured = if is_pair { self.measure() } else { None };
        let before = std::mem::replace(&mut self.last, measured.map(|(late_s, _)| late_s));
        let ((late_s, rate), before_s) = (measured?, before?);
        let agrees = (late_s - before_s).abs() * rate < MIN_SHIFT_RAD.max(0.2 * late_s.abs() * rate);
        let is_significant =
            late_s.abs().min(before_s.abs()) * rate > MIN_SHIFT_RAD && late_s.abs() < MAX_DELAY_S;
        (agrees && is_significant).then_some(late_s)
    }

    /// Returns the delay in seconds, and the angle by which a delay moves the two sweeps apart, in rad per second of
    /// delay.
    fn measure(&mut self) -> Option<(f64, f64)> {
        let mut late_s = 0.0;
        for _ in 0..4 {
            let mut rate = 0.0;
            self.votes.clear();
            for (now, before) in self.now.columns.iter().zip(&self.before.columns) {
                for window in now.windows(3) {
                    if let Some((vote, apart)) = vote(window, before, late_s) {
                        self.votes.push(vote);
                        rate += apart;
                    }
                }
            }
            if self.votes.len() < MIN_VOTES {
                return None;
            }
            rate /= self.votes.len() as f64;
            let middle = self.votes.len() / 2;
            let more_s = *self.votes.select_nth_unstable_by(middle, f64::total_cmp).1;
            late_s += more_s;
            if more_s.abs() * rate < MIN_SHIFT_RAD {
                return Some((late_s, rate));
            }
        }
        None
    }
}

/// Computes the delay from the second of the three samples in `window`. Returns the part of the delay that exceeds
/// `late_s`, in seconds, and the angle by which a delay moves the two sweeps apart, in rad per second of delay.
fn vote(window: &[Sample], before: &[Sample], late_s: f64) -> Option<(f64, f64)> {
    let [first, here, last] = window else { return None };
    let rate = (last.angle_rad - first.angle_rad) / (last.time_s - first.time_s);
    let apart = rate - slopes(before, here.angle_rad)?.rate;
    let angle_rad = here.angle_rad + apart * late_s;
    let there = slopes(before, angle_rad)?;
    let expected = there.at.inverse + there.slope * (angle_rad - there.at.angle_rad);
    let is_steep = there.slope.abs() > MIN_SLOPE_M * here.inverse * here.inverse;
    // Near a reversal, the two sweeps are too close to each other to measure a delay.
    let goes_back = rate * there.rate < 0.0 && apart.abs() > rate.abs();
    (is_steep && goes_back).then(|| ((here.inverse - expected) / (there.slope * apart), apart.abs()))
}

/// Slope of the surface around a sample.
struct Slopes {
    at: Sample,
    slope: f64,
    rate: f64,
}

/// Returns the slope at an angle, if the two samples below this angle and the two samples above it are on one plane.
fn slopes(column: &[Sample], angle_rad: f64) -> Option<Slopes> {
    let after = column.partition_point(|sample| sample.angle_rad < angle_rad);
    let [a, b, c, d] = column.get(after.checked_sub(2)?..after + 2)? else { return None };
    let slope = |a: &Sample, b: &Sample| (b.inverse - a.inverse) / (b.angle_rad - a.angle_rad);
    let [left, middle, right] = [slope(a, b), slope(b, c), slope(c, d)];
    let is_plane = (left - middle).abs().max((right - middle).abs()) < MAX_SLOPE_DIFFERENCE * middle.abs();
    let is_near = d.angle_rad - a.angle_rad < 3.0 * MAX_GAP_RAD;
    let rate = (d.angle_rad - a.angle_rad) / (d.time_s - a.time_s);
    (is_plane && is_near).then_some(Slopes { at: *b, slope: middle, rate })
}

impl Profile {
    /// Fills the profile with the beams that are compared, in the order of increasing angle.
    fn fill(&mut self, rays: &[Ray], beams: usize, from_ns: u64) {
        let every = (beams / COLUMN_COUNT).max(1);
        self.columns.resize_with(beams.div_ceil(every), Vec::new);
        self.columns.iter_mut().for_each(Vec::clear);
        for ray in rays {
            let beam = usize::from(ray.beam);
            if beam.is_multiple_of(every)
                && ray.range_m.is_finite()
                && ray.range_m > 0.0
                && let Some(column) = self.columns.get_mut(beam / every)
            {
                column.push(Sample {
                    time_s: (ray.time_ns as f64 - from_ns as f64) * 1e-9,
                    angle_rad: ray.angle_rad,
                    inverse: 1.0 / f64::from(ray.range_m),
                });
            }
        }
        let falls = |column: &Vec<Sample>| match (column.first(), column.last()) {
            (Some(first), Some(last)) => last.angle_rad < first.angle_rad,
            _ => false,
        };
        self.columns.iter_mut().filter(|column| falls(column)).for_each(|column| column.reverse());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the delay that is computed for each sweep. The mount is 0.9 m above the floor and swings like a pendulum
    /// from 5 to 45 degrees in 2 s. The angles of its encoder have a standard deviation of about 0.05 degrees. Its
    /// stamps are `late_s` seconds late.
    fn delays(late_s: f64, seed: u64) -> Vec<Option<f64>> {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut noise = |sigma: f64| (0..12).map(|_| random.f64()).sum::<f64>() * sigma - 6.0 * sigma;
        let swing = |s: f64| (25.0 - 20.0 * (std::f64::consts::PI * s / 2.0).cos()).to_radians();
        let mut delay = Delay::default();
        let mut sweep = |number: u64| {
            let mut rays = Vec::new();
            for scan in 0..75 {
                let time_ns = number * 2_000_000_000 + scan * 26_640_000;
                let down = swing(time_ns as f64 * 1e-9);
                let angle_rad = swing(time_ns as f64 * 1e-9 - late_s) + noise(0.001);
                for beam in 0..181 {
                    let beam_rad = f64::from(beam - 90).to_radians();
                    let range_m =
                        (0.9 / (down.sin() * beam_rad.cos())).min(4.0 / beam_rad.cos()) + noise(0.01);
                    let (beam, range_m) = (beam as u16, range_m as f32);
                    rays.push(Ray { time_ns, angle_rad, beam_rad, range_m, beam });
                }
            }
            delay.take(&rays, 181, (number * 2_000_000_000, (number + 1) * 2_000_000_000), true)
        };
        (0..4).map(&mut sweep).collect()
    }

    #[test]
    fn estimates_stamp_delay_from_two_pairs_of_sweeps() {
        for (seed, late_s) in [0.02, -0.02, 0.06, 0.12].into_iter().enumerate() {
            let found = delays(late_s, seed as u64);
            assert_eq!(found[..2], [None; 2], "{late_s}");
            let found = found[2].unwrap_or_else(|| panic!("{late_s}: {found:?}"));
            assert!((found - late_s).abs() < 0.002, "{late_s}: {found}");
        }
        assert_eq!(delays(0.0, 9), [None; 4]);
        assert_eq!(delays(0.0005, 9), [None; 4], "not worth it");
    }
}
