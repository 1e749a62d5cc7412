//! Match of a scan with a reference scan. Each beam should end on the surface that is nearest to its end. The position
//! of the scan is therefore the position at which the beams are off least.
//!
//! A [`PreparedScan`] has the data of one scan for the comparison: its points, the surfaces on which they lie, and its
//! lines.

use std::f64::consts::{FRAC_PI_2, TAU};

use scanhub_schema::{Corner, Line, Lines, Pose, Scan};

use super::covariance::{Square, add_outer, eigen, transformed};
use crate::directions::Directions;
use crate::velocity::{Pose2, is_whole};

/// Position of one scan relative to another.
#[derive(Clone, Copy, Debug)]
pub(super) struct Match {
    pub(super) pose: Pose2,
    /// Covariance of the position that the noise of the scan causes, and covariance that the noise of the reference
    /// causes.
    pub(super) own: Square,
    pub(super) of_reference: Square,
    /// Share of the readings that lie on surfaces.
    pub(super) overlap: f64,
    /// Sum of the weights of the readings. A reading near a surface has more weight, so a match with a greater sum fits
    /// better.
    pub(super) weight: f64,
    /// Whether there is a direction in which the position is unknown.
    pub(super) is_degenerate: bool,
    /// Whether the scans have a corner in common.
    pub(super) has_corners: bool,
    /// Whether the scans have a line in common.
    pub(super) has_lines: bool,
}

/// Matcher of scans. It remembers which readings belong to moving objects.
pub(super) struct ScanMatcher {
    /// For each reading, 0 if its object stands, otherwise the number of reference scans for which its moving object is
    /// ignored.
    ignored_scans: Box<[u8]>,
    runs: Box<[Run]>,
}

/// Neighboring readings, at most [`MAX_RUN_LEN`], that may belong to one object.
#[derive(Clone, Copy, Default)]
struct Run {
    first: u16,
    /// Number of readings.
    all: u16,
    /// Number of readings in space that was empty before.
    in_free_space: u16,
    /// Number of readings on objects that moved before, and maximum number of reference scans for which these objects
    /// are ignored.
    on_moving_objects: u16,
    ignored_scans: u8,
    /// Number of readings near a surface.
    beams: u16,
    /// Sum of their squared distances from the surface, in variances of their noise.
    squared_distances: f64,
}

/// Sums over beams near surfaces.
#[derive(Default)]
struct Sums {
    /// Sum of the weights times v v', where v is (nx, ny, n x p / scale): the number of beams that meet walls across
    /// each direction.
    weight: Square,
    slope: [f64; 3],
    /// Part of `weight` that surfaces with an uncertain direction add by chance.
    chance: f64,
    own: Square,
    of_reference: Square,
    /// Sum of the squared distances of the beams. `expected` is the sum of the variances by noise alone.
    squared_distances: f64,
    expected: f64,
    weights: f64,
    beams: usize,
}

/// Directions in which the surroundings define the position.
struct Observability {
    values: [f64; 3],
    vectors: [[f64; 3]; 3],
    /// For each direction, whether enough beams meet walls across it for an estimate that is better than a guess.
    is_significant: [bool; 3],
    /// For each direction, whether enough beams meet walls across it.
    is_known: [bool; 3],
}

impl ScanMatcher {
    /// Allocates a matcher for at most `beams` beams.
    pub(super) fn new(beams: usize) -> ScanMatcher {
        ScanMatcher { ignored_scans: vec![0; beams].into(), runs: vec![Run::default(); beams].into() }
    }

    /// Returns the position of the current scan relative to the reference, near `begin`; `None` if too few beams match.
    /// In a direction that the surroundings do not define, the position is taken from `begin`, with a standard
    /// deviation of `unknown_m`.
    pub(super) fn find(
        &mut self,
        reference: &PreparedScan,
        current: &PreparedScan,
        begin: Pose2,
        unknown_m: f64,
    ) -> Option<Match> {
        self.reset();
        let pair = Pair {
            reference,
            current,
            scale: scale(current)?,
            finest: MAX_DEVIATIONS * reference.noise.hypot(current.noise),
        };
        let mut pose = pair.converge(begin, FIRST_WIDTH_M, &self.ignored_scans);
        for _ in 0..MAX_SEARCHES {
            if !self.mark_moving(&pair, &pose) {
                break;
            }
            pose = pair.converge(pose, 0.0, &self.ignored_scans);
        }
        let sums = pair.sums(&pose, pair.finest, 1, &self.ignored_scans);
        if sums.beams < MIN_BEAMS {
            return None;
        }
        let observability = Observability::of(&sums, 1);
        let (own, of_kept) = observability.covariances(&sums, pair.scale, unknown_m);
        let is_finite =
            own.as_flattened().iter().chain(of_kept.as_flattened()).all(|value| value.is_finite());
        let found = Match {
            pose,
            own,
            of_reference: of_kept,
            overlap: pair.overlap(&pose),
            weight: sums.weights,
            is_degenerate: !observability.is_known.iter().all(|is_known| *is_known),
            has_corners: same_corners(reference, current, &pose),
            has_lines: same_lines(reference, current, &pose),
        };
        (is_finite && pose.x.is_finite() && pose.y.is_finite() && pose.yaw.is_finite()).then_some(found)
    }

    /// Returns for each reading of the last scan 0 if its object stands, otherwise the number of reference scans for
    /// which its moving object is ignored.
    pub(super) fn ignored_scans(&self) -> &[u8] {
        &self.ignored_scans
    }

    /// Resets the matcher: no object is known to move.
    pub(super) fn reset(&mut self) {
        self.ignored_scans.fill(0);
    }

    /// Marks readings of moving objects. Returns whether the marked readings have changed. A run of neighboring
    /// readings is marked if one of these is true:
    ///
    /// - Together, the readings of the run are farther from surfaces than noise explains.
    /// - Most of them lie in space that was empty before.
    /// - Most of them lie on objects that moved before.
    fn mark_moving(&mut self, pair: &Pair<'_>, pose: &Pose2) -> bool {
        let width = 2.0 * pair.finest;
        let beams = pair.current.points().len();
        let (mut runs, mut off, mut expected) = (0, 0.0, 0.0);
        for i in 0..beams {
            if i == 0 || !pair.current.is_connected(i) || usize::from(self.runs[runs - 1].all) >= MAX_RUN_LEN
            {
                self.runs[runs] = Run { first: i as u16, ..Run::default() };
                runs += 1;
            }
            let run = &mut self.runs[runs - 1];
            run.all += 1;
            let point = pose.point(pair.current.points()[i]);
            run.in_free_space += u16::from(pair.reference.sees_through(point, width));
            let ignored_scans = pair
                .reference
                .nearest(point, width)
                .map_or(0, |at| pair.reference.readings()[at].ignored_scans);
            run.on_moving_objects += u16::from(ignored_scans > 0);
            run.ignored_scans = run.ignored_scans.max(ignored_scans);
            let Some(residual) = pair.residual(i, pose, width) else { continue };
            let square = residual.distance * residual.distance;
            run.squared_distances += (square / residual.variance()).min(MAX_SQUARE);
            run.beams += 1;
            if self.ignored_scans[i] == 0 && residual.distance.abs() < pair.finest {
                (off, expected) = (off + square, expected + residual.variance());
            }
        }
        let level = if expected > 0.0 { (off / expected).max(1.0) } else { 1.0 };
        let mut is_new = false;
        for at in 0..runs {
            let end = if at + 1 < runs { self.runs[at + 1].first.into() } else { beams };
            let run = self.runs[at];
            // The variance of the sum of squares is twice the number of beams.
            let n = f64::from(run.beams);
            let is_off = run.squared_distances > level * (MAX_MEAN_SQUARE * n + 4.0 * (2.0 * n).sqrt());
            let ignored_scans = match is_off || 2 * run.in_free_space > run.all {
                true => IGNORED_SCANS,
                false if 2 * run.on_moving_objects > run.all => run.ignored_scans - 1,
                false => 0,
            };
            for ignored in &mut self.ignored_scans[run.first.into()..end] {
                is_new |= (*ignored > 0) != (ignored_scans > 0);
                *ignored = ignored_scans;
            }
        }
        is_new
    }
}

/// Reference scan and current scan that are matched.
struct Pair<'a> {
    reference: &'a PreparedScan,
    current: &'a PreparedScan,
    /// See [`scale`].
    scale: f64,
    /// Maximum distance of a beam from its surface in the last rounds, in meters.
    finest: f64,
}

/// A beam that ends near a surface.
struct SurfaceResidual {
    point: (f64, f64),
    surface: Surface,
    distance: f64,
    /// Whether the surface belongs to a moving object.
    is_moving: bool,
    /// Variance of the residual that the noise of the current scan causes. `reference_variance` is the variance that
    /// the noise of the reference causes.
    current_variance: f64,
    reference_variance: f64,
}

impl SurfaceResidual {
    fn variance(&self) -> f64 {
        self.current_variance + self.reference_variance
    }
}

impl Pair<'_> {
    /// Improves the position of the current scan, starting at `pose` with beams that are at most `width` away from
    /// surfaces.
    fn converge(&self, mut pose: Pose2, width: f64, ignored_scans: &[u8]) -> Pose2 {
        let mut width = width.max(self.finest);
        let coarse = self.current.points().len().div_ceil(COARSE_BEAMS);
        for _ in 0..MAX_ROUNDS {
            let is_last = width <= self.finest;
            let stride = if is_last { 1 } else { coarse };
            let sums = self.sums(&pose, width, stride, ignored_scans);
            let step = Observability::of(&sums, stride).solve(&sums.slope);
            let turn = step[2] / self.scale;
            pose = Pose2::new(step[0], step[1], turn).then(&pose);
            if is_last && step[0].hypot(step[1]) < MIN_STEP_M && turn.abs() < MIN_STEP_RAD {
                break;
            }
            width = (0.5 * width).max(self.finest);
        }
        pose
    }

    /// Returns the share of the readings that are near a surface.
    fn overlap(&self, pose: &Pose2) -> f64 {
        let beams = self.current.points().len();
        (0..beams).filter(|&i| self.residual(i, pose, self.finest).is_some()).count() as f64 / beams as f64
    }

    /// Returns the residual of reading `i`, if it is less than `width` away from a surface.
    fn residual(&self, i: usize, pose: &Pose2, width: f64) -> Option<SurfaceResidual> {
        let (reading, point) = (&self.current.readings()[i], pose.point(self.current.points()[i]));
        // The end of the nearest beam may be as far from the point as two neighboring beams are from each other.
        let nearest = &self.reference.readings()[self.reference.nearest(point, width + MAX_SPACING_M)?];
        let surface = nearest.surface?;
        let distance = surface.distance(point);
        let along = |(x, y): (f64, f64)| surface.normal.0 * x + surface.normal.1 * y;
        let deviations = (
            along(pose.turned(reading.direction)) * self.current.noise,
            along(nearest.direction) * self.reference.noise,
        );
        let (current_variance, reference_variance) =
            (deviations.0 * deviations.0, deviations.1 * deviations.1);
        // A surface that is seen edge-on also varies across the beams.
        let min_variance = MIN_VARIANCE_SHARE * (self.current.noise * self.current.noise);
        (distance.abs() < width).then_some(SurfaceResidual {
            point,
            surface,
            distance,
            is_moving: nearest.ignored_scans > 0,
            current_variance: current_variance.max(min_variance),
            reference_variance: reference_variance.max(min_variance),
        })
    }

    /// Returns the sums over every `stride`th beam at `pose` that is less than `width` away from a surface and not on a
    /// moving object.
    fn sums(&self, pose: &Pose2, width: f64, stride: usize, ignored_scans: &[u8]) -> Sums {
        let mut sums = Sums::default();
        for i in (0..self.current.points().len()).step_by(stride.max(1)).filter(|&i| ignored_scans[i] == 0) {
            let Some(residual) = self.residual(i, pose, width).filter(|on| !on.is_moving) else { continue };
            let (share, off) = (residual.distance / width, residual.distance);
            // Tukey's biweight.
            let weight = (1.0 - share * share) * (1.0 - share * share);
            let ((nx, ny), (x, y)) = (residual.surface.normal, residual.point);
            let row = [nx, ny, (ny * x - nx * y) / self.scale];
            add_outer(&mut sums.weight, &row, weight);
            for (slope, value) in sums.slope.iter_mut().zip(row) {
                *slope += weight * off * value;
            }
            add_outer(&mut sums.own, &row, weight * weight * residual.current_variance);
            add_outer(&mut sums.of_reference, &row, weight * weight * residual.reference_variance);
            sums.chance += CHANCE_FACTOR * weight * residual.surface.variance;
            sums.squared_distances += weight * off * off;
            sums.expected += weight * residual.variance();
            sums.weights += weight;
            sums.beams += 1;
        }
        sums
    }
}

/// Returns the root mean square distance of the points of `now` in meters. A turn by its inverse in radians moves the
/// points by about one meter. `None` if there are no points.
fn scale(now: &PreparedScan) -> Option<f64> {
    let square: f64 = now.points().iter().map(|point| point.0 * point.0 + point.1 * point.1).sum();
    let scale = (square / now.points().len().max(1) as f64).sqrt();
    (scale.is_finite() && scale > 0.0).then_some(scale)
}

impl Observability {
    /// Computes the observability from `sums`. A direction is known if enough beams meet walls across it. The part of
    /// their weight that chance adds does not count.
    fn of(sums: &Sums, stride: usize) -> Observability {
        let (values, vectors) = eigen(sums.weight);
        let min_beams = (MIN_BEAMS as f64 / stride as f64).max(MIN_BEAM_SHARE * sums.weights);
        let significant = values.map(|value| value - sums.chance);
        let is_significant = significant.map(|beams| beams * stride as f64 >= MIN_SIGNIFICANT_BEAMS);
        Observability {
            values,
            vectors,
            is_significant,
            is_known: significant.map(|beams| beams >= min_beams),
        }
    }

    /// Returns the step against `slope` in the directions that have enough beams.
    fn solve(&self, slope: &[f64; 3]) -> [f64; 3] {
        let mut step = [0.0; 3];
        for ((value, vector), is_significant) in
            self.values.iter().zip(&self.vectors).zip(self.is_significant)
        {
            if is_significant {
                let along: f64 = vector.iter().zip(slope).map(|(a, b)| a * b).sum();
                step.iter_mut().zip(vector).for_each(|(step, v)| *step -= along / value * v);
            }
        }
        step
    }

    /// Returns the covariance of the position that the noise of the current scan causes, and the covariance that the
    /// noise of the reference causes, in meters and radians.
    fn covariances(&self, sums: &Sums, scale: f64, unknown_m: f64) -> (Square, Square) {
        // If beams are off by more than their noise, the position is less certain.
        let factor = (sums.squared_distances / sums.expected).max(1.0);
        let inverse = self.inverse();
        let of_radians = [1.0, 1.0, 1.0 / scale];
        let of = |sum: &Square, unknown_m: f64| {
            let mut covariance = transformed(&inverse, sum);
            covariance.as_flattened_mut().iter_mut().for_each(|value| *value *= factor);
            for (vector, is_known) in self.vectors.iter().zip(self.is_known) {
                if !is_known {
                    add_outer(&mut covariance, vector, unknown_m * unknown_m);
                }
            }
            std::array::from_fn(|i| std::array::from_fn(|j| covariance[i][j] * of_radians[i] * of_radians[j]))
        };
        (of(&sums.own, unknown_m), of(&sums.of_reference, 0.0))
    }

    fn inverse(&self) -> Square {
        let mut inverse = [[0.0; 3]; 3];
        for ((value, vector), is_known) in self.values.iter().zip(&self.vectors).zip(self.is_known) {
            if is_known {
                add_outer(&mut inverse, vector, 1.0 / value);
            }
        }
        inverse
    }
}

/// Returns whether a corner of the current scan at `pose` is also a corner of the reference.
fn same_corners(reference: &PreparedScan, current: &PreparedScan, pose: &Pose2) -> bool {
    let near = MATCH_DEVIATIONS * reference.noise.hypot(current.noise) + MATCH_MARGIN_M;
    let is_same = |corner: &Corner| {
        let (x, y) = pose.point((corner.x_m.into(), corner.y_m.into()));
        let off = |other: &Corner| (x - f64::from(other.x_m)).hypot(y - f64::from(other.y_m));
        reference.lines.corners().iter().any(|other| off(other) <= near)
    };
    current.lines.corners().iter().any(is_same)
}

/// Returns whether a line of the current scan at `pose` is also a line of the reference: both ends of the one line lie
/// on the other line, and the two lines overlap.
fn same_lines(reference: &PreparedScan, current: &PreparedScan, pose: &Pose2) -> bool {
    let near = MATCH_DEVIATIONS * reference.noise.hypot(current.noise) + MATCH_MARGIN_M;
    let is_same = |line: &Line| {
        let ends =
            [(line.x1_m, line.y1_m), (line.x2_m, line.y2_m)].map(|(x, y)| pose.point((x.into(), y.into())));
        let is_on = |other: &Line| {
            let (sin, cos) = f64::from(other.alpha_rad).sin_cos();
            let along = |(x, y): (f64, f64)| cos * y - sin * x;
            let of_other = [(other.x1_m, other.y1_m), (other.x2_m, other.y2_m)];
            let of_other = of_other.map(|(x, y)| along((x.into(), y.into())));
            let (begin, end) = (of_other[0].min(of_other[1]), of_other[0].max(of_other[1]));
            let alongs = ends.map(along);
            let overlaps = alongs[0].max(alongs[1]) >= begin && alongs[0].min(alongs[1]) <= end;
            overlaps
                && ends.iter().all(|end| (cos * end.0 + sin * end.1 - f64::from(other.r_m)).abs() <= near)
        };
        reference.lines.lines().iter().any(is_on)
    };
    current.lines.lines().iter().any(is_same)
}

/// Readings of one scan, with their surfaces and lines.
pub(super) struct PreparedScan {
    pose: Pose,
    /// First angle, step and number of the beams.
    grid: (f64, f64, usize),
    directions: Directions,
    /// Points of the readings in the robot's frame, in the order of the beams.
    points: Box<[(f64, f64)]>,
    readings: Box<[Reading]>,
    count: usize,
    /// Index of the first reading at or after each beam.
    slots: Box<[u16]>,
    pub(super) lines: Lines,
    /// Standard deviation of a range in meters.
    pub(super) noise: f64,
}

/// A beam that has a range.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Reading {
    pub(super) beam: u16,
    /// Direction of the beam in the robot's frame, as a unit vector.
    pub(super) direction: (f64, f64),
    /// Range in meters.
    pub(super) range: f64,
    pub(super) surface: Option<Surface>,
    /// Number of reference scans for which its object is ignored, because it was seen to move; 0 if it stands.
    pub(super) ignored_scans: u8,
}

/// A plane across the floor: x nx + y ny = r.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surface {
    pub(super) normal: (f64, f64),
    pub(super) r: f64,
    /// Variance of its direction in rad2.
    pub(super) variance: f64,
}

impl PreparedScan {
    /// Allocates a prepared scan of at most `beams` beams.
    pub(super) fn new(beams: usize) -> PreparedScan {
        PreparedScan {
            pose: Pose::default(),
            grid: (0.0, 0.0, 0),
            directions: Directions::new(beams),
            points: vec![(0.0, 0.0); beams].into(),
            readings: vec![Reading::default(); beams].into(),
            count: 0,
            slots: vec![0; beams].into(),
            lines: Lines::default(),
            noise: 0.0,
        }
    }

    /// Replaces the content by `scan` of a sensor at `pose`, and its `lines`.
    pub(super) fn take(&mut self, pose: &Pose, scan: &Scan, lines: &Lines) {
        self.lines = *lines;
        let noise = f64::from(lines.noise_m);
        self.noise = if noise.is_finite() { noise.max(MIN_NOISE_M) } else { MIN_NOISE_M };
        self.pose = *pose;
        self.grid = (scan.first_angle, scan.step, scan.beams().min(self.slots.len()));
        self.directions.fit(pose, scan);
        let mut next = 0;
        self.count = 0;
        for (beam, direction, range) in self.directions.readings(pose, scan) {
            self.slots[next..=beam].fill(self.count as u16);
            next = beam + 1;
            self.points[self.count] = (pose.x_m + range * direction.0, pose.y_m + range * direction.1);
            self.readings[self.count] =
                Reading { beam: beam as u16, direction, range, surface: None, ignored_scans: 0 };
            self.count += 1;
        }
        self.slots[next..self.grid.2].fill(self.count as u16);
        self.set_surfaces_of_lines();
        for i in 0..self.count {
            if self.readings[i].surface.is_none() {
                self.readings[i].surface = self.surface_of_neighbors(i);
            }
        }
    }

    /// Sets the surface of the readings on each line. Readings that are far from their line are left out.
    fn set_surfaces_of_lines(&mut self) {
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
                if surface.distance(point).abs() <= 4.0 * self.noise {
                    reading.surface = Some(surface);
                }
            }
        }
    }

    /// Returns the surface through reading `i` and its neighbors, if they lie on one.
    fn surface_of_neighbors(&self, i: usize) -> Option<Surface> {
        let (mut first, mut last) = (i, i);
        while first > 0 && i - first < SURFACE_NEIGHBORS && self.is_connected(first) {
            first -= 1;
        }
        while last + 1 < self.count && last - i < SURFACE_NEIGHBORS && self.is_connected(last + 1) {
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
        let (major, minor) = ((xx + yy) / 2.0 + half, (xx + yy) / 2.0 - half);
        let along = 0.5 * (2.0 * xy).atan2(xx - yy);
        let (sin, cos) = along.sin_cos();
        let variance = (minor / (n - 2.0)).max(self.noise * self.noise) / major;
        let normal = (-sin, cos);
        let surface = Surface { normal, r: normal.0 * middle.0 + normal.1 * middle.1, variance };
        (variance <= MAX_DIRECTION_VARIANCE).then_some(surface)
    }

    /// Returns whether reading `i` and the reading before it may belong to one object.
    pub(super) fn is_connected(&self, i: usize) -> bool {
        let (one, two) = (&self.readings[i - 1], &self.readings[i]);
        let (p, q) = (self.points[i - 1], self.points[i]);
        let spacing = f64::from(two.beam - one.beam) * self.grid.1.abs() * one.range.max(two.range);
        (p.0 - q.0).hypot(p.1 - q.1) <= MAX_CONNECTED_M + 3.0 * spacing
    }

    /// Returns the beams that have a range.
    pub(super) fn readings(&self) -> &[Reading] {
        &self.readings[..self.count]
    }

    /// Returns the points of the readings in the robot's frame.
    pub(super) fn points(&self) -> &[(f64, f64)] {
        &self.points[..self.count]
    }

    /// Stores for each reading the number of reference scans for which its object is ignored.
    pub(super) fn set_ignored_scans(&mut self, ignored_scans: &[u8]) {
        for (reading, scans) in self.readings[..self.count].iter_mut().zip(ignored_scans) {
            reading.ignored_scans = *scans;
        }
    }

    /// Returns whether `point` is in empty space: the beams on both sides end more than `margin` meters beyond it.
    pub(super) fn sees_through(&self, point: (f64, f64), margin: f64) -> bool {
        let Some((distance, at)) = self.towards(point) else { return false };
        let last = self.grid.2 as f64 - 1.0;
        if at < 1.0 || at > last - 1.0 {
            return false;
        }
        let first = at as usize - 1;
        // Check one more beam on each side, because exact angles may be a step off.
        (first..(first + 4).min(self.grid.2)).all(|beam| {
            let reading = self.readings().get(usize::from(self.slots[beam]));
            reading.is_some_and(|one| usize::from(one.beam) == beam && one.range > distance + margin)
        })
    }

    /// Returns the distance of `point` from the sensor, and its direction as a number of steps after the first beam.
    /// That number may be negative, or greater than the number of beams.
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

    /// Returns the index of the reading whose point is nearest to `point`, if it is nearer than `max_distance`. The
    /// sine of the angle between a beam and the direction of `point` gives a lower bound for the distance of this beam
    /// and all beams farther aside. Therefore only a few beams are compared.
    pub(super) fn nearest(&self, point: (f64, f64), max_distance: f64) -> Option<usize> {
        let (_, step, beams) = self.grid;
        if self.count == 0 {
            return None;
        }
        let (distance, at) = self.towards(point)?;
        let (turn, last) = (TAU / step.abs(), beams as f64 - 1.0);
        let begin = usize::from(self.slots[at.clamp(0.0, last) as usize]);
        let mut best = (max_distance * max_distance, None);
        // Minimum distance of a beam that is `aside` steps away, by sin a >= 2 a / pi. Exact angles are up to a step
        // off.
        let bound = |steps: f64| distance * ((steps - 1.5) * step.abs() / FRAC_PI_2).clamp(0.0, 1.0);
        let mut compare = |i: usize, at: f64| {
            let steps = (f64::from(self.readings[i].beam) - at).abs();
            let min_distance = bound(steps);
            if min_distance * min_distance > best.0 {
                return false;
            }
            let (dx, dy) = (self.points[i].0 - point.0, self.points[i].1 - point.1);
            let square = dx * dx + dy * dy;
            if square < best.0 {
                best = (square, Some(i));
            }
            true
        };
        let up = (begin..self.count).all(|i| compare(i, at));
        let down = (0..begin).rev().all(|i| compare(i, at));
        if self.is_whole() {
            if up {
                let _ = (0..begin).all(|i| compare(i, at - turn));
            }
            if down {
                let _ = (begin..self.count).rev().all(|i| compare(i, at + turn));
            }
        }
        best.1
    }
}

impl Surface {
    /// Returns the signed distance of `point` from the surface.
    #[inline]
    pub(super) fn distance(&self, point: (f64, f64)) -> f64 {
        self.normal.0 * point.0 + self.normal.1 * point.1 - self.r
    }
}

/// Maximum distance of a beam from its surface in the first round, in meters. It is halved in each round.
const FIRST_WIDTH_M: f64 = 0.3;
/// Maximum distance in the last rounds, in standard deviations. With this constant of Tukey, almost nothing is lost if
/// there is only noise.
const MAX_DEVIATIONS: f64 = 3.0;
const MAX_ROUNDS: usize = 20;
/// Number of beams that are enough for all rounds except the last ones.
const COARSE_BEAMS: usize = 120;
const MIN_STEP_M: f64 = 2e-5;
const MIN_STEP_RAD: f64 = 1e-5;
/// Minimum number of beams that define a direction. Fewer beams may come from a leg.
const MIN_BEAMS: usize = 6;
/// Minimum number of beams with which a direction is better than a guess.
const MIN_SIGNIFICANT_BEAMS: f64 = 1.5;
/// Minimum share of all beams that define a direction. In a long corridor, door frames can be mistaken for one another.
const MIN_BEAM_SHARE: f64 = 0.03;
/// Maximum number of readings in a run. In a longer run, one end of a wall could mark the whole wall as moving.
const MAX_RUN_LEN: usize = 24;
/// Maximum squared distance that a reading adds, in variances of its noise, so that a few readings at an edge do not
/// decide about the others.
const MAX_SQUARE: f64 = 9.0;
/// Number of times that moving objects are searched for.
const MAX_SEARCHES: usize = 2;
/// Maximum mean square of the readings of an object that stands, in variances of their noise.
const MAX_MEAN_SQUARE: f64 = 3.0;
/// Number of reference scans for which a moving object is ignored.
const IGNORED_SCANS: u8 = 3;
/// Minimum variance across a surface, as a share of the variance of a range.
const MIN_VARIANCE_SHARE: f64 = 0.05;
/// Factor of the part of the weight that is expected by chance.
const CHANCE_FACTOR: f64 = 2.0;
/// Maximum distance between two neighboring points whose surface is used for a point between them, in meters.
pub(super) const MAX_SPACING_M: f64 = 0.2;
/// Maximum distance between equal corners or equal lines: a number of standard deviations plus a distance in meters.
const MATCH_DEVIATIONS: f64 = 3.0;
const MATCH_MARGIN_M: f64 = 0.02;
/// Minimum standard deviation of a range in meters, for errors of a scanner other than noise.
const MIN_NOISE_M: f64 = 0.005;
/// Number of neighbors on each side that define a surface.
const SURFACE_NEIGHBORS: usize = 4;
/// Maximum distance between two points of one object, in meters. It is added to the distance that a surface at a flat
/// angle explains.
const MAX_CONNECTED_M: f64 = 0.1;
/// Maximum variance of the direction of a surface, which is the square of 10 degrees.
const MAX_DIRECTION_VARIANCE: f64 = 0.03;
