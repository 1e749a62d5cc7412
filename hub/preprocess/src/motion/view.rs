//! One scan as others are compared with it: its points, the surfaces that they lie on, and its lines. Refuses to know how it
//! is compared.

use std::f64::consts::TAU;

use scanhub_schema::{Lines, Pose, Scan};

/// The readings of one scan.
pub(super) struct View {
    pose: Pose,
    /// First angle, step and number of the beams; the directions are for these.
    grid: (f64, f64, usize),
    directions: Box<[(f64, f64)]>,
    /// Where the beams end that have a range, in the robot's frame, in the order of the beams.
    points: Box<[(f64, f64)]>,
    readings: Box<[Reading]>,
    count: usize,
    /// The first reading at or behind each beam.
    slots: Box<[u16]>,
    pub(super) lines: Lines,
    /// Standard deviation of a range, in metres.
    pub(super) noise: f64,
}

/// One of the beams that have a range.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Reading {
    pub(super) beam: u16,
    /// Where the beam points, in the robot's frame.
    pub(super) direction: (f64, f64),
    /// Metres from the sensor.
    pub(super) range: f64,
    pub(super) surface: Option<Surface>,
    /// What it shows was seen to move; so many kept scans later it is trusted again. 0: it stands.
    pub(super) doubt: u8,
}

/// A plane: x nx + y ny = r.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surface {
    pub(super) normal: (f64, f64),
    pub(super) r: f64,
    /// Variance of its direction, in rad2.
    pub(super) variance: f64,
}

impl View {
    /// For so many beams at most.
    pub(super) fn new(beams: usize) -> View {
        View {
            pose: Pose::default(),
            grid: (0.0, 0.0, 0),
            directions: vec![(0.0, 0.0); beams].into(),
            points: vec![(0.0, 0.0); beams].into(),
            readings: vec![Reading::default(); beams].into(),
            count: 0,
            slots: vec![0; beams].into(),
            lines: Lines::default(),
            noise: 0.0,
        }
    }

    /// Takes over `scan` of a sensor at `pose`, and its `lines`.
    pub(super) fn take(&mut self, pose: &Pose, scan: &Scan, lines: &Lines) {
        self.lines = *lines;
        let unit_m = f64::from(scan.unit_um) * 1e-6;
        let noise = f64::from(lines.noise_m);
        self.noise = if noise.is_finite() { noise.max(LEAST_NOISE_M) } else { LEAST_NOISE_M };
        let count = scan.beams().min(self.directions.len());
        let grid = (scan.first_angle, scan.step, count);
        if (self.grid, self.pose) != (grid, *pose) {
            (self.grid, self.pose) = (grid, *pose);
            for (i, direction) in self.directions[..count].iter_mut().enumerate() {
                *direction = pose.direction(scan.first_angle + i as f64 * scan.step);
            }
        }
        let exact = scan.exact_angles();
        self.count = 0;
        for i in 0..count {
            self.slots[i] = self.count as u16;
            let range = scan.range(i).map_or(0.0, |range| f64::from(range) * unit_m);
            if range <= 0.0 {
                continue;
            }
            let exact = exact.get(i).filter(|exact| exact.is_finite());
            let direction = exact.map_or(self.directions[i], |&exact| pose.direction(exact.into()));
            self.points[self.count] = (pose.x_m + range * direction.0, pose.y_m + range * direction.1);
            self.readings[self.count] = Reading { beam: i as u16, direction, range, surface: None, doubt: 0 };
            self.count += 1;
        }
        self.lay_on_lines();
        for i in 0..self.count {
            if self.readings[i].surface.is_none() {
                self.readings[i].surface = self.among_neighbours(i);
            }
        }
    }

    /// The readings on a line lie on that, but for those that are far from it.
    fn lay_on_lines(&mut self) {
        for line in self.lines.lines() {
            let alpha = f64::from(line.alpha_rad);
            let (sin, cos) = alpha.sin_cos();
            let (r, deviation) = (f64::from(line.r_m), f64::from(line.sd_alpha_rad));
            let surface = Surface { normal: (cos, sin), r, variance: deviation * deviation };
            let first = self.slots.get(usize::from(line.first)).map_or(self.count, |&at| at.into());
            let readings = &mut self.readings[first.min(self.count)..self.count];
            let points = &self.points[first.min(self.count)..self.count];
            for (reading, &point) in readings.iter_mut().zip(points) {
                if reading.beam > line.last {
                    break;
                }
                if surface.off(point).abs() <= 4.0 * self.noise {
                    reading.surface = Some(surface);
                }
            }
        }
    }

    /// The surface through reading `i` and its neighbours, if they lie on one.
    fn among_neighbours(&self, i: usize) -> Option<Surface> {
        let (mut first, mut last) = (i, i);
        while first > 0 && i - first < NEIGHBOURS && self.is_connected(first) {
            first -= 1;
        }
        while last + 1 < self.count && last - i < NEIGHBOURS && self.is_connected(last + 1) {
            last += 1;
        }
        let n = (last - first + 1) as f64;
        if n < 4.0 {
            return None;
        }
        let points = &self.points[first..=last];
        let sum = points.iter().fold((0.0, 0.0), |sum, point| (sum.0 + point.0, sum.1 + point.1));
        let middle = (sum.0 / n, sum.1 / n);
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for point in points {
            let (x, y) = (point.0 - middle.0, point.1 - middle.1);
            (xx, xy, yy) = (xx + x * x, xy + x * y, yy + y * y);
        }
        let half = ((xx - yy) / 2.0).hypot(xy);
        let (most, least) = ((xx + yy) / 2.0 + half, (xx + yy) / 2.0 - half);
        let along = 0.5 * (2.0 * xy).atan2(xx - yy);
        let (sin, cos) = along.sin_cos();
        let variance = (least / (n - 2.0)).max(self.noise * self.noise) / most;
        let normal = (-sin, cos);
        let surface = Surface { normal, r: normal.0 * middle.0 + normal.1 * middle.1, variance };
        (variance <= MOST_VARIANCE).then_some(surface)
    }

    /// Whether reading `i` and the one before it may be of one thing.
    pub(super) fn is_connected(&self, i: usize) -> bool {
        let (one, two) = (&self.readings[i - 1], &self.readings[i]);
        let (p, q) = (self.points[i - 1], self.points[i]);
        let apart = f64::from(two.beam - one.beam) * self.grid.1.abs() * one.range.max(two.range);
        (p.0 - q.0).hypot(p.1 - q.1) <= GAP_M + 3.0 * apart
    }

    /// Beams that have a range.
    pub(super) fn readings(&self) -> &[Reading] {
        &self.readings[..self.count]
    }

    /// Where they end, in the robot's frame.
    pub(super) fn points(&self) -> &[(f64, f64)] {
        &self.points[..self.count]
    }

    /// Keeps for each reading how long what it shows is not trusted.
    pub(super) fn doubt(&mut self, doubts: &[u8]) {
        for (reading, doubt) in self.readings[..self.count].iter_mut().zip(doubts) {
            reading.doubt = *doubt;
        }
    }

    /// Whether the beams to both sides of `point` end more than `margin` behind it: nothing was there.
    pub(super) fn sees_through(&self, point: (f64, f64), margin: f64) -> bool {
        let Some((distance, at)) = self.towards(point) else { return false };
        let last = self.grid.2 as f64 - 1.0;
        if at < 1.0 || at > last - 1.0 {
            return false;
        }
        let first = at as usize - 1;
        // One more on each side: next to an edge, exact angles may be a step off.
        (first..(first + 4).min(self.grid.2)).all(|beam| {
            let reading = self.readings().get(usize::from(self.slots[beam]));
            reading.is_some_and(|one| usize::from(one.beam) == beam && one.range > distance + margin)
        })
    }

    /// How far `point` is from the sensor, and how many steps behind the first beam it lies, which may be less than none or
    /// more than there are.
    fn towards(&self, point: (f64, f64)) -> Option<(f64, f64)> {
        let (first, step, beams) = self.grid;
        let (x, y) = (point.0 - self.pose.x_m, point.1 - self.pose.y_m);
        let turned = y.atan2(x) - self.pose.yaw_rad;
        let angle = if self.pose.upside_down == 0 { turned } else { -turned };
        let turn = TAU / step.abs();
        let behind = ((angle - first) * step.signum()).rem_euclid(TAU) / step.abs();
        let is_before = !self.is_whole() && behind > (beams as f64 - 1.0 + turn) / 2.0;
        let at = if is_before { behind - turn } else { behind };
        at.is_finite().then_some((x.hypot(y), at))
    }

    fn is_whole(&self) -> bool {
        is_whole(self.grid.2, self.grid.1)
    }

    /// The reading whose point is nearest to `point`, if it is nearer than `most`. Behind a beam that looks past `point` by an
    /// angle there is nothing nearer than the sine of that angle says, so that few are looked at.
    pub(super) fn nearest(&self, point: (f64, f64), most: f64) -> Option<usize> {
        let (_, step, beams) = self.grid;
        if self.count == 0 {
            return None;
        }
        let (distance, at) = self.towards(point)?;
        let (turn, last) = (TAU / step.abs(), beams as f64 - 1.0);
        let begin = usize::from(self.slots[at.clamp(0.0, last) as usize]);
        let mut best = (most * most, None);
        // The least distance from a beam so many steps aside, by sin a >= 2 a / pi; exact angles are up to a step off.
        let bound = |aside: f64| distance * ((aside - 1.5) * step.abs() / QUARTER).clamp(0.0, 1.0);
        let mut look = |i: usize, at: f64| {
            let aside = (f64::from(self.readings[i].beam) - at).abs();
            let least = bound(aside);
            if least * least > best.0 {
                return false;
            }
            let (dx, dy) = (self.points[i].0 - point.0, self.points[i].1 - point.1);
            let square = dx * dx + dy * dy;
            if square < best.0 {
                best = (square, Some(i));
            }
            true
        };
        let up = (begin..self.count).all(|i| look(i, at));
        let down = (0..begin).rev().all(|i| look(i, at));
        if self.is_whole() {
            if up {
                let _ = (0..begin).all(|i| look(i, at - turn));
            }
            if down {
                let _ = (begin..self.count).rev().all(|i| look(i, at + turn));
            }
        }
        best.1
    }
}

impl Surface {
    /// How far `point` is before or behind it.
    #[inline]
    pub(super) fn off(&self, point: (f64, f64)) -> f64 {
        self.normal.0 * point.0 + self.normal.1 * point.1 - self.r
    }
}

/// Returns whether the last of `beams` beams, `step` radians apart, is a neighbor of the first one.
pub(super) fn is_whole(beams: usize, step: f64) -> bool {
    beams as f64 + 1.5 >= TAU / step.abs()
}

/// Ranges are never surer than this, in metres: what a scanner has beside its noise.
const LEAST_NOISE_M: f64 = 0.005;
/// Neighbours on each side that a surface is laid through.
const NEIGHBOURS: usize = 4;
/// Points of one surface are nearer to each other than this, and what a flat view adds.
const GAP_M: f64 = 0.1;
/// A surface whose direction is less sure than to 10 degrees is none.
const MOST_VARIANCE: f64 = 0.03;
const QUARTER: f64 = std::f64::consts::FRAC_PI_2;
