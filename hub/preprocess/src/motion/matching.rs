//! Match of a scan with a reference scan. If the position of the scan is right, each beam ends on the surface of the
//! reference scan that is nearest to its end. The match searches for the position at which the ends of the beams are
//! nearest to their surfaces.
//!
//! A [`PreparedScan`] has the data of one scan for the comparison: its points, the surfaces on which they lie, and its
//! lines.

use std::f64::consts::{FRAC_PI_2, TAU};

use scanhub_schema::{Corner, Line, Lines, Pose, Scan};

use super::covariance::{Square, add_outer, eigen, transformed};
use crate::directions::Directions;
use crate::velocity::{Pose2, is_whole};

/// Position of the current scan relative to the reference scan.
#[derive(Clone, Copy, Debug)]
pub(super) struct Match {
    pub(super) pose: Pose2,
    /// Covariance of the position that the noise of the current scan causes.
    pub(super) own: Square,
    /// Covariance of the position that the noise of the reference scan causes.
    pub(super) of_reference: Square,
    /// Share of the readings that lie on surfaces of the reference scan.
    pub(super) overlap: f64,
    /// Sum of the weights of the readings. A reading near a surface has more weight, so a match with a greater sum fits
    /// better.
    pub(super) weight: f64,
    /// Whether there is a direction in which the surroundings do not define the position.
    pub(super) is_degenerate: bool,
    /// Whether both scans have a corner at the same position.
    pub(super) has_corners: bool,
    /// Whether both scans have a line at the same position.
    pub(super) has_lines: bool,
}

/// Matcher of scans. It stores which readings of the last scan belong to moving objects.
pub(super) struct ScanMatcher {
    /// For each reading of the last scan: 0 if its object stands, or the number of reference scans for which its moving
    /// object is ignored.
    ignored_scans: Box<[u8]>,
    /// Buffer for the runs of the current scan.
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
    /// Number of readings on objects that moved before.
    on_moving_objects: u16,
    /// Maximum number of reference scans for which these objects are ignored.
    ignored_scans: u8,
    /// Number of readings near a surface.
    beams: u16,
    /// Sum of the squared distances of these readings from their surfaces, in variances of their noise.
    squared_distances: f64,
}

/// Sums over beams near surfaces. In these sums, n is the normal of a beam's surface, and p is the end of the beam. The
/// vector v is (nx, ny, n x p / scale). It is the derivative of the beam's distance from the surface.
#[derive(Default)]
struct Sums {
    /// Sum of the weights times v v'. For a direction, it is about the number of beams that meet walls across this
    /// direction.
    weight: Square,
    /// Sum of the weights times distance times v.
    slope: [f64; 3],
    /// Part of `weight` that surfaces with an uncertain direction add by chance.
    chance: f64,
    /// Sum of v v' times the squared weight and the variance that the noise of the current scan causes.
    own: Square,
    /// Sum of v v' times the squared weight and the variance that the noise of the reference scan causes.
    of_reference: Square,
    /// Sum of the squared distances of the beams from their surfaces, with weights.
    squared_distances: f64,
    /// Value of `squared_distances` that noise alone would cause.
    expected: f64,
    weights: f64,
    beams: usize,
}

/// Observability of the position in three directions: how well the surroundings define it there. The directions are the
/// eigenvectors of [`Sums::weight`].
struct Observability {
    /// Eigenvalues: for each direction, about the number of beams that meet walls across it.
    values: [f64; 3],
    /// Eigenvectors: the directions.
    vectors: [[f64; 3]; 3],
    /// For each direction, whether there are enough such beams for an estimate that is better than a guess.
    is_significant: [bool; 3],
    /// For each direction, whether there are enough such beams to define the position.
    is_known: [bool; 3],
}

impl ScanMatcher {
    /// Allocates a matcher for at most `beams` beams.
    pub(super) fn new(beams: usize) -> ScanMatcher {
        ScanMatcher { ignored_scans: vec![0; beams].into(), runs: vec![Run::default(); beams].into() }
    }

    /// Returns the position of the current scan relative to the reference scan, near `begin`. Returns `None` if too few
    /// beams match. In a direction that the surroundings do not define, the position is that of `begin`, with a
    /// standard deviation of `unknown_m`.
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

    /// Returns for each reading of the last scan: 0 if its object stands, or the number of reference scans for which
    /// its moving object is ignored.
    pub(super) fn ignored_scans(&self) -> &[u8] {
        &self.ignored_scans
    }

    /// Resets the matcher, so that all objects count as standing.
    pub(super) fn reset(&mut self) {
        self.ignored_scans.fill(0);
    }

    /// Marks readings of moving objects. Returns whether other readings are marked than before. A run of neighboring
    /// readings is marked if one of these conditions is true:
    ///
    /// - Together, the readings of the run are farther from surfaces than noise explains.
    /// - Most readings of the run lie in space that was empty before.
    /// - Most readings of the run lie on objects that moved before.
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
            // If there is only noise, the variance of the sum of squares is twice the number of beams. Allow four
            // standard deviations.
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
    /// Scale of turns in meters, see [`scale`].
    scale: f64,
    /// Maximum distance of a beam from its surface in the last rounds, in meters.
    finest: f64,
}

/// Residual of a beam of the current scan that ends near a surface of the reference scan.
struct SurfaceResidual {
    /// End of the beam in the frame of the reference scan.
    point: (f64, f64),
    surface: Surface,
    /// The residual: the signed distance of `point` from `surface`.
    distance: f64,
    /// Whether the surface belongs to a moving object.
    is_moving: bool,
    /// Variance of the residual that the noise of the current scan causes.
    current_variance: f64,
    /// Variance of the residual that the noise of the reference scan causes.
    reference_variance: f64,
}

impl SurfaceResidual {
    fn variance(&self) -> f64 {
        self.current_variance + self.reference_variance
    }
}

impl Pair<'_> {
    /// Improves the position of the current scan in rounds, starting at `pose`. The first round uses beams that end at
    /// most `width` away from their surfaces. Each later round halves this distance.
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

    /// Returns the share of the current readings that are near a surface of the reference scan, if the current scan is
    /// at `pose`.
    fn overlap(&self, pose: &Pose2) -> f64 {
        let beams = self.current.points().len();
        (0..beams).filter(|&i| self.residual(i, pose, self.finest).is_some()).count() as f64 / beams as f64
    }

    /// Returns the residual of reading `i` of the current scan, or `None` if it is at least `width` away from every
    /// surface.
    fn residual(&self, i: usize, pose: &Pose2, width: f64) -> Option<SurfaceResidual> {
        let (reading, point) = (&self.current.readings()[i], pose.point(self.current.points()[i]));
        // The point may be on a surface between the ends of two beams. Search as far as these ends can be apart.
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
        // For a surface along its beams, the noise of the ranges has no effect on the distance. The minimum variance is
        // for other errors.
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

    /// Returns the sums over beams of the current scan at `pose`. Only one beam in `stride` is used, and only if it
    /// ends less than `width` away from a surface and not on a moving object.
    fn sums(&self, pose: &Pose2, width: f64, stride: usize, ignored_scans: &[u8]) -> Sums {
        let mut sums = Sums::default();
        for i in (0..self.current.points().len()).step_by(stride.max(1)).filter(|&i| ignored_scans[i] == 0) {
            let Some(residual) = self.residual(i, pose, width).filter(|on| !on.is_moving) else { continue };
            let (share, off) = (residual.distance / width, residual.distance);
            // Use Tukey's biweight, so that beams far from their surfaces have little weight.
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

/// Returns the root mean square distance of the points of `now` from the robot's center, in meters. A turn in radians
/// times this distance is about the distance by which the turn moves the points. Returns `None` if there are no points.
fn scale(now: &PreparedScan) -> Option<f64> {
    let square: f64 = now.points().iter().map(|point| point.0 * point.0 + point.1 * point.1).sum();
    let scale = (square / now.points().len().max(1) as f64).sqrt();
    (scale.is_finite() && scale > 0.0).then_some(scale)
}

impl Observability {
    /// Computes the observability from `sums` over one of every `stride` beams. A direction is known if enough beams
    /// meet walls across it. The part of the weight that chance adds is subtracted first.
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

    /// Returns the step that reduces the distances, in the directions that have enough beams. In the other directions,
    /// it is 0.
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

    /// Returns two covariances of the position in meters and radians. The first one is due to the noise of the current
    /// scan, and the second one is due to the noise of the reference scan.
    fn covariances(&self, sums: &Sums, scale: f64, unknown_m: f64) -> (Square, Square) {
        // If the distances of beams are greater than noise explains, the position is less certain.
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

/// Returns whether a corner of the current scan at `pose` is also a corner of the reference scan.
fn same_corners(reference: &PreparedScan, current: &PreparedScan, pose: &Pose2) -> bool {
    let near = MATCH_DEVIATIONS * reference.noise.hypot(current.noise) + MATCH_MARGIN_M;
    let is_same = |corner: &Corner| {
        let (x, y) = pose.point((corner.x_m.into(), corner.y_m.into()));
        let off = |other: &Corner| (x - f64::from(other.x_m)).hypot(y - f64::from(other.y_m));
        reference.lines.corners().iter().any(|other| off(other) <= near)
    };
    current.lines.corners().iter().any(is_same)
}

/// Returns whether a line of the current scan at `pose` is also a line of the reference scan. The two lines are equal
/// if both ends of the current line lie on the reference line or its extension, and if the lines overlap.
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

/// Readings of one scan, with the surfaces on which they lie, and the lines of the scan.
pub(super) struct PreparedScan {
    /// Pose of the sensor on the robot.
    pose: Pose,
    /// First angle, step and number of the beams.
    grid: (f64, f64, usize),
    directions: Directions,
    /// Points of the readings in the robot's frame, in the order of the beams.
    points: Box<[(f64, f64)]>,
    readings: Box<[Reading]>,
    count: usize,
    /// For each beam, the index of the first reading at or after the beam.
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
    /// Surface on which the reading lies, if it is known.
    pub(super) surface: Option<Surface>,
    /// Number of reference scans for which the object of the reading is ignored, because it has moved; 0 if it stands.
    pub(super) ignored_scans: u8,
}

/// A vertical surface: the points (x, y) with x nx + y ny = r, where (nx, ny) is `normal`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surface {
    pub(super) normal: (f64, f64),
    pub(super) r: f64,
    /// Variance of the direction in rad2.
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

    /// Replaces the content by `scan`, which comes from a sensor at `pose`, and the `lines` of this scan.
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

    /// Sets the surface of the readings on each line. Readings that are far from their line get no surface.
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

    /// Returns the surface through reading `i` and its neighbors, or `None` if they do not lie on one surface.
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

    /// Sets [`Reading::ignored_scans`] of all readings.
    pub(super) fn set_ignored_scans(&mut self, ignored_scans: &[u8]) {
        for (reading, scans) in self.readings[..self.count].iter_mut().zip(ignored_scans) {
            reading.ignored_scans = *scans;
        }
    }

    /// Returns whether `point` is in empty space: the beams on both sides of `point` end more than `margin` meters
    /// farther away.
    pub(super) fn sees_through(&self, point: (f64, f64), margin: f64) -> bool {
        let Some((distance, at)) = self.towards(point) else { return false };
        let last = self.grid.2 as f64 - 1.0;
        if at < 1.0 || at > last - 1.0 {
            return false;
        }
        let first = at as usize - 1;
        // Check one more beam on each side, because an exact angle may differ by up to a step from the angle at equal
        // steps.
        (first..(first + 4).min(self.grid.2)).all(|beam| {
            let reading = self.readings().get(usize::from(self.slots[beam]));
            reading.is_some_and(|one| usize::from(one.beam) == beam && one.range > distance + margin)
        })
    }

    /// Returns the distance of `point` from the sensor, and its direction as a number of steps after the first beam.
    /// The number of steps may be negative, or greater than the number of beams.
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

    /// Returns the index of the reading whose point is nearest to `point`, or `None` if no reading is nearer than
    /// `max_distance`. The sine of the angle between a beam and the direction of `point` gives a lower bound for the
    /// distance of this beam and of all beams farther to the side. Only a few beams are compared, because the search in
    /// each direction ends when this bound exceeds the minimum so far.
    pub(super) fn nearest(&self, point: (f64, f64), max_distance: f64) -> Option<usize> {
        let (_, step, beams) = self.grid;
        if self.count == 0 {
            return None;
        }
        let (distance, at) = self.towards(point)?;
        let (turn, last) = (TAU / step.abs(), beams as f64 - 1.0);
        let begin = usize::from(self.slots[at.clamp(0.0, last) as usize]);
        let mut best = (max_distance * max_distance, None);
        // Lower bound for the distance of a beam that is this number of steps to the side, by sin a >= 2 a / pi. An
        // exact angle may differ by up to a step from the angle at equal steps.
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

/// Maximum distance between the end of a beam and its surface in the first round, in meters. Each round halves it.
const FIRST_WIDTH_M: f64 = 0.3;
/// Maximum distance between the end of a beam and its surface in the last rounds, in standard deviations. It is the
/// constant of Tukey's biweight. With this value, the position is hardly less accurate if there is only noise.
const MAX_DEVIATIONS: f64 = 3.0;
/// Maximum number of rounds in which a position is improved.
const MAX_ROUNDS: usize = 20;
/// Maximum number of beams that are used in all rounds except the last ones.
const COARSE_BEAMS: usize = 120;
/// Step in meters below which a position is not improved any more.
const MIN_STEP_M: f64 = 2e-5;
/// Turn in radians below which a position is not improved any more.
const MIN_STEP_RAD: f64 = 1e-5;
/// Minimum number of beams on walls across a direction that define the position in this direction. Fewer beams may come
/// from a leg.
const MIN_BEAMS: usize = 6;
/// Minimum number of beams on walls across a direction with which the position in this direction is better than a
/// guess.
const MIN_SIGNIFICANT_BEAMS: f64 = 1.5;
/// Minimum share of all beams that must be on walls across a direction to define the position in this direction. With
/// fewer beams, one door frame in a long corridor could be mistaken for another one.
const MIN_BEAM_SHARE: f64 = 0.03;
/// Maximum number of readings in a run. In a longer run, one end of a wall could mark the whole wall as moving.
const MAX_RUN_LEN: usize = 24;
/// Maximum squared distance that a reading adds to the sum of its run, in variances of its noise. It is limited so that
/// a few readings at an edge do not decide for the whole run.
const MAX_SQUARE: f64 = 9.0;
/// Maximum number of searches for moving objects in one match.
const MAX_SEARCHES: usize = 2;
/// Maximum mean of the squared distances of an object that stands, in variances of the noise.
const MAX_MEAN_SQUARE: f64 = 3.0;
/// Number of reference scans for which a moving object is ignored.
const IGNORED_SCANS: u8 = 3;
/// Minimum variance of a beam's distance from its surface, as a share of the variance of a range.
const MIN_VARIANCE_SHARE: f64 = 0.05;
/// Factor by which the weight that is expected by chance is multiplied before it is subtracted.
const CHANCE_FACTOR: f64 = 2.0;
/// Maximum distance between two neighboring points whose surface is used for a point between them, in meters.
pub(super) const MAX_SPACING_M: f64 = 0.2;
/// Maximum distance between equal corners or equal lines, in standard deviations. [`MATCH_MARGIN_M`] is added to it.
const MATCH_DEVIATIONS: f64 = 3.0;
/// Additional distance between equal corners or equal lines, in meters.
const MATCH_MARGIN_M: f64 = 0.02;
/// Minimum standard deviation of a range in meters. It accounts for errors of a scanner other than noise.
const MIN_NOISE_M: f64 = 0.005;
/// Maximum number of neighbors on each side of a reading that define its surface.
const SURFACE_NEIGHBORS: usize = 4;
/// Maximum distance between two neighboring points of one object, in meters, in addition to the distance that a surface
/// at a flat angle explains.
const MAX_CONNECTED_M: f64 = 0.1;
/// Maximum variance of the direction of a surface, which is the square of 10 degrees.
const MAX_DIRECTION_VARIANCE: f64 = 0.03;
