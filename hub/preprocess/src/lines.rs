//! Straight lines of one scan. They are the lines for which the measured ranges are most likely, if each range has
//! normal noise along its beam. A beam belongs to one line or to none. The lines do not depend on earlier scans.
//!
//! The method is maximum likelihood as in Schaefer, Buescher, Luft, Burgard: "A Maximum Likelihood Approach to Extract
//! Polylines from 2-D Laser Range Scans" (IROS 2018), called PLE in comments. Here, the lines need not be connected.
//! Neighboring pairs of beams are joined to lines, the likeliest lines first. Then the cuts between lines are moved
//! (`pieces`).
//!
//! No parameter is set by hand: the noise is estimated from the scan, and a Bayesian information criterion decides
//! whether a line explains more than noise.

mod fit;
mod pieces;

use std::f32::consts::{PI, TAU};

use scanhub_schema::{Corner, Line, Lines, MAX_BEAMS, MAX_LINES, Pose, Scan};

use crate::directions::Directions;

use fit::{Information, Ray};
use pieces::{Bounds, Piece, ScanPartitioner};

/// Settings of a line finder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Maximum number of lines, 1 to 64.
    pub max: u8,
    /// Minimum number of beams of a line, at least 3.
    pub min_points: u16,
    /// Whether to refine the lines, which is slower: cuts between lines are moved to where they help most, and beams at
    /// the ends of lines that fit their line worst are dropped.
    pub refine: bool,
    /// Condition that ends the joining of lines.
    pub stop: StopCriterion,
}

/// Condition that ends the joining of lines.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum StopCriterion {
    /// Joining ends when the next join would increase the error by more than noise explains. Neighboring points more
    /// than one meter apart are never joined. The IROS paper uses this distance for real scans.
    Likelihood,
    /// Joining ends when at most `max` lines are left. Neighboring points farther apart than this number of meters are
    /// never joined. This criterion is for comparisons with other methods at equal numbers of lines.
    Number(f64),
}

impl Default for Settings {
    fn default() -> Self {
        Settings { max: MAX_LINES as u8, min_points: 5, refine: false, stop: StopCriterion::Likelihood }
    }
}

/// Finds the lines of the scans of one sensor.
pub struct LineFinder {
    pose: Pose,
    settings: Settings,
    directions: Directions,
    /// Beams that have a range.
    rays: Box<[Ray]>,
    /// Index in the scan of each beam in `rays`.
    beams: Box<[u16]>,
    /// Index after the last ray of each group. In a group, the points of neighboring rays are near enough to each other
    /// to be on one line.
    ends: Box<[u16]>,
    /// Buffer for estimating the noise.
    steps: Box<[[f64; 2]]>,
    partitioner: ScanPartitioner,
}

impl LineFinder {
    /// Creates a finder for a sensor at `pose` with at most `beams` beams.
    pub fn new(pose: Pose, settings: Settings, beams: usize) -> LineFinder {
        let beams = beams.min(MAX_BEAMS);
        LineFinder {
            pose,
            settings,
            directions: Directions::new(beams),
            rays: vec![Ray::default(); beams].into(),
            beams: vec![0; beams].into(),
            ends: vec![0; beams].into(),
            steps: vec![[0.0; 2]; beams].into(),
            partitioner: ScanPartitioner::new(beams),
        }
    }

    /// Changes the pose of the sensor and the settings for the next scans.
    pub fn change(&mut self, pose: Pose, settings: Settings) {
        (self.pose, self.settings) = (pose, settings);
    }

    /// Writes the lines of `scan` into `out`. Writes every byte of `out`.
    pub fn update(&mut self, scan: &Scan, out: &mut Lines) {
        *out = Lines::default();
        let rays = self.read(scan);
        let groups = self.group(rays);
        let noise = self.noise(groups, scan);
        (out.readings, out.noise_m) = (rays as u16, noise as f32);
        let bounds = self.bounds(rays, noise);
        let rays = &self.rays[..rays];
        let pieces = self.partitioner.partition(rays, &self.ends[..groups], &bounds);
        if pieces.is_full {
            out.flags = Lines::OVERFLOW;
        }
        let mut count = 0;
        for piece in pieces.list {
            if let (Some(slot), Some(line)) =
                (out.line_array.get_mut(count), line(&self.pose, rays, &self.beams, piece, noise))
            {
                *slot = line;
                out.on_lines += line.points;
                count += 1;
            }
        }
        out.count = count as u8;
        corners(out, &self.pose, scan.step.abs() as f32);
    }

    /// Stores the beams of `scan` that have a range, and returns their number.
    fn read(&mut self, scan: &Scan) -> usize {
        self.directions.fit(&self.pose, scan);
        let mut count = 0;
        for (i, (cos, sin), range) in self.directions.readings(&self.pose, scan) {
            self.rays[count] = Ray { cos, sin, range };
            self.beams[count] = i as u16;
            count += 1;
        }
        count
    }

    /// Cuts the rays into groups where neighboring points are too far apart for one line. Returns the number of groups.
    fn group(&mut self, rays: usize) -> usize {
        let max_gap_m = match self.settings.stop {
            StopCriterion::Likelihood => MAX_GAP_M,
            StopCriterion::Number(max_gap_m) => max_gap_m,
        };
        let mut groups = 0;
        for i in 1..=rays {
            if i == rays || self.rays[i - 1].distance(&self.rays[i]) > max_gap_m {
                self.ends[groups] = i as u16;
                groups += 1;
            }
        }
        groups
    }

    /// Returns the standard deviation of a range in meters. It is at least the standard deviation that rounding to the
    /// unit of `scan` causes. It is computed from the median of many distances: of each point from the line through its
    /// two neighbors, and from the line through the two points after those neighbors. Edges and corners hardly change
    /// the median.
    fn noise(&mut self, groups: usize, scan: &Scan) -> f64 {
        let (mut count, mut first) = (0, 0);
        let steps = self.steps.as_flattened_mut();
        for &end in &self.ends[..groups] {
            let rays = &self.rays[first..end.into()];
            for offset in [1, 2] {
                for (i, ray) in rays.iter().enumerate().skip(offset) {
                    let Some(after) = rays.get(i + offset) else { break };
                    let inverse = fit::LineEquation::through(&rays[i - offset], after).inverse(ray);
                    let off = (ray.range - 1.0 / inverse).abs();
                    if off.is_finite() && inverse > 0.0 {
                        steps[count] = off;
                        count += 1;
                    }
                }
            }
            first = end.into();
        }
        let minimum = f64::from(scan.unit_um) * 1e-6 / 12_f64.sqrt();
        let Some(steps) = steps.get_mut(..count).filter(|steps| !steps.is_empty()) else { return minimum };
        let (_, median, _) = steps.select_nth_unstable_by(count / 2, f64::total_cmp);
        // The median of the absolute value is .6745 standard deviations. The difference between one range and the mean
        // of two other ranges has 1 + 1/2 times the variance of a range.
        (*median / (0.6745 * 1.5_f64.sqrt())).max(minimum)
    }

    fn bounds(&self, rays: usize, noise: f64) -> Bounds {
        let Settings { max, min_points, refine, stop } = self.settings;
        let penalty = PARAMETERS_PER_LINE * (rays.max(2) as f64).ln() * noise * noise;
        // If the maximum distance is infinite, every point must be on a line, so no beam can be dropped.
        let (penalty, variance, loss) = match stop {
            StopCriterion::Likelihood => (penalty, noise * noise, BEAM_LOSS_M * BEAM_LOSS_M),
            StopCriterion::Number(gap_m) if gap_m.is_finite() => {
                (0.0, f64::INFINITY, BEAM_LOSS_M * BEAM_LOSS_M)
            }
            StopCriterion::Number(_) => (0.0, f64::INFINITY, f64::INFINITY),
        };
        Bounds {
            max: usize::from(max).min(MAX_LINES),
            penalty,
            variance,
            loss,
            min_points: usize::from(min_points),
            rounds: if refine { 3 } else { 1 },
            exchange: refine,
            // If this number of beams is dropped, 19 of 20 beams are still on a line. In simulated rooms like those of
            // PLE, 97.8 % of the beams are on a line.
            trimmed: if refine { rays / 20 } else { 0 },
        }
    }
}

/// Number of parameters of a line: its two numbers, and the cut to the next line. The cut counts twice, as in the
/// criterion of Zhang and Siegmund (2007) for change points.
const PARAMETERS_PER_LINE: f64 = 4.0;
/// Maximum distance between neighboring points of one line, in meters. PLE uses the same distance for real scans.
const MAX_GAP_M: f64 = 1.0;
/// Cost of dropping a beam if there are more lines than allowed, as an error in meters. With this cost, on logs of four
/// sensors (aces, Freiburg, Intel, Orebro: `cargo bench --bench perception`), ten vertices cover more beams than ten
/// vertices of RANSAC, and fit better.
const BEAM_LOSS_M: f64 = 0.2;
/// Maximum angle between the facing ends of two neighboring lines that may have a corner, in steps between beams.
const MAX_NEIGHBOR_GAP: f32 = 4.5;
/// Maximum number of steps of Newton's method toward the likeliest line.
const NEWTON_STEPS: usize = 3;

/// Returns the likeliest line for the rays of `piece`, or `None` if they do not define a line.
fn line(pose: &Pose, rays: &[Ray], beams: &[u16], piece: &Piece, noise: f64) -> Option<Line> {
    let inside = &rays[piece.first..piece.end];
    let (fit, error) = piece.line().refined(inside, NEWTON_STEPS);
    let information = Information::of(&fit, inside)?;
    let free = inside.len().saturating_sub(2).max(1) as f64;
    let (aa, ab, bb) = information.inverse((error / free).max(noise * noise))?;
    let square = fit.a * fit.a + fit.b * fit.b;
    let of_sensor = 1.0 / square.sqrt();
    let (cos, sin) = (fit.a * of_sensor, fit.b * of_sensor);
    let along =
        |by_a: f64, by_b: f64| (by_a * by_a * aa + 2.0 * by_a * by_b * ab + by_b * by_b * bb).max(0.0).sqrt();
    let alpha_by = (-fit.b / square, fit.a / square);
    // Transform from the sensor, which need not be at the robot's center, to the robot's frame.
    let lever = pose.y_m * cos - pose.x_m * sin;
    let r_by = |of: f64, by_alpha: f64| lever * by_alpha - of * of_sensor / square;
    let r = of_sensor + pose.x_m * cos + pose.y_m * sin;
    let (cos, sin) = if r < 0.0 { (-cos, -sin) } else { (cos, sin) };
    let end = |ray: &Ray| {
        let range = 1.0 / fit.inverse(ray);
        ((pose.x_m + range * ray.cos) as f32, (pose.y_m + range * ray.sin) as f32)
    };
    let ((x1_m, y1_m), (x2_m, y2_m)) = (end(inside.first()?), end(inside.last()?));
    let line = Line {
        x1_m,
        y1_m,
        x2_m,
        y2_m,
        r_m: r.abs() as f32,
        alpha_rad: sin.atan2(cos) as f32,
        sd_r_m: along(r_by(fit.a, alpha_by.0), r_by(fit.b, alpha_by.1)) as f32,
        sd_alpha_rad: along(alpha_by.0, alpha_by.1) as f32,
        first: beams[piece.first],
        last: beams[piece.end - 1],
        points: inside.len() as u16,
        reserved: 0,
    };
    let numbers = [x1_m, y1_m, x2_m, y2_m, line.r_m, line.alpha_rad, line.sd_r_m, line.sd_alpha_rad];
    // With a standard deviation of 1 rad or more, the direction of the line is unknown.
    let is_known = numbers.iter().all(|number| number.is_finite()) && line.sd_alpha_rad < 1.0;
    is_known.then_some(line)
}

/// Writes the corners of neighboring lines to `out`. Two lines have a corner if they are certainly not parallel, and if
/// they meet between the last beam of the first line and the first beam of the second line. At such a corner, both
/// lines have about the same range, so neither hides the end of the other.
fn corners(out: &mut Lines, pose: &Pose, step: f32) {
    let count = usize::from(out.count);
    // In a full revolution, the last line is a neighbor of the first one.
    let pairs = if count > 2 { count } else { count.saturating_sub(1) };
    let direction = |x: f32, y: f32| (y - pose.y_m as f32).atan2(x - pose.x_m as f32);
    let turned = |from: f32, to: f32| (to - from + PI).rem_euclid(TAU) - PI;
    let mut corners = 0;
    for first in 0..pairs {
        let second = (first + 1) % count;
        let (one, two) = (&out.line_array[first], &out.line_array[second]);
        let Some((x_m, y_m)) = intersection(one, two) else { continue };
        let last = direction(one.x2_m, one.y2_m);
        let gap = turned(last, direction(two.x1_m, two.y1_m));
        let middle = last + gap / 2.0;
        let range = (x_m - pose.x_m as f32).hypot(y_m - pose.y_m as f32);
        let unsure = 1.5 * step + 3.0 * out.noise_m / range;
        if gap.abs() <= MAX_NEIGHBOR_GAP * step
            && turned(middle, direction(x_m, y_m)).abs() <= gap.abs() / 2.0 + unsure
        {
            out.corner_array[corners] =
                Corner { x_m, y_m, first_line: first as u16, second_line: second as u16 };
            corners += 1;
        }
    }
    out.corners = corners as u8;
}

/// Returns the point at which two lines meet, or `None` if they may be parallel.
fn intersection(one: &Line, two: &Line) -> Option<(f32, f32)> {
    let sine = (two.alpha_rad - one.alpha_rad).sin();
    if sine.abs() <= 3.0 * one.sd_alpha_rad.hypot(two.sd_alpha_rad) {
        return None;
    }
    let ((sin1, cos1), (sin2, cos2)) = (one.alpha_rad.sin_cos(), two.alpha_rad.sin_cos());
    let (x_m, y_m) = ((one.r_m * sin2 - two.r_m * sin1) / sine, (two.r_m * cos1 - one.r_m * cos2) / sine);
    (x_m.is_finite() && y_m.is_finite()).then_some((x_m, y_m))
}
