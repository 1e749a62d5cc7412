//! Matches a scan with another one: each of its beams ends on the surface nearest to it, and the position where the
//! beams are least off is that of the scan.
//!
//! A [`View`] is one scan as it is compared: its points, the surfaces on which they lie, and its lines.

use std::f64::consts::{FRAC_PI_2, TAU};

use scanhub_schema::{Corner, Line, Lines, Pose, Scan};

use super::covariance::{Square, add_outer, around, eigen};
use crate::directions::Directions;
use crate::velocity::{Rigid, is_whole};

/// Position of one scan relative to another.
#[derive(Clone, Copy, Debug)]
pub(super) struct Match {
    pub(super) place: Rigid,
    /// Covariance of the position by the noise of the scan, and by that of the kept one.
    pub(super) own: Square,
    pub(super) of_kept: Square,
    /// Share of the readings that lie on surfaces.
    pub(super) overlap: f64,
    /// Sum of the weights of the readings. A reading near a surface has more weight, so a match with a greater sum fits
    /// better.
    pub(super) weight: f64,
    /// Whether a direction of the position is not known.
    pub(super) is_degenerate: bool,
    /// Whether the scans have a corner in common.
    pub(super) has_corners: bool,
    /// Whether the scans have a line in common.
    pub(super) has_lines: bool,
}

/// Matches scans.
pub(super) struct Matcher {
    /// By reading: 0 for an object that stands, otherwise the number of kept scans for which a moving object is
    /// ignored.
    doubts: Box<[u8]>,
    runs: Box<[Run]>,
}

/// Neighboring readings, at most [`PIECE`], that may belong to one object.
#[derive(Clone, Copy, Default)]
struct Run {
    first: u16,
    /// Number of readings.
    all: u16,
    /// Readings in space that was empty before.
    come: u16,
    /// Readings on objects that moved before, and the maximum time for which these are ignored.
    doubted: u16,
    doubt: u8,
    /// Readings near a surface.
    beams: u16,
    /// Sum of their squared distances from the surface, in variances of their noise.
    off: f64,
}

/// Sums over beams near surfaces.
#[derive(Default)]
struct Sums {
    /// Sum of the weights times v v', where v is (nx, ny, n x p / scale): the number of beams that meet walls across
    /// each direction.
    weight: Square,
    slope: [f64; 3],
    /// Part of `weight` that surfaces of uncertain direction add by chance.
    chance: f64,
    own: Square,
    of_kept: Square,
    /// Sums of the squared distances of the beams, and of the variances by noise alone.
    off: f64,
    expected: f64,
    weights: f64,
    beams: usize,
}

/// Directions in which the surroundings define the position.
struct Known {
    values: [f64; 3],
    vectors: [[f64; 3]; 3],
    /// Whether enough beams meet walls across it to be better than a guess.
    is_said: [bool; 3],
    /// Whether enough beams meet walls across it.
    is_known: [bool; 3],
}

impl Matcher {
    /// Allocates a matcher for at most `beams` beams.
    pub(super) fn new(beams: usize) -> Matcher {
        Matcher { doubts: vec![0; beams].into(), runs: vec![Run::default(); beams].into() }
    }

    /// Returns the position of `now` relative to `kept`, near `begin`; `None` if too few beams match. In directions
    /// that the surroundings do not define, the position is that of `begin`, with a standard deviation of `unknown_m`.
    pub(super) fn find(&mut self, kept: &View, now: &View, begin: Rigid, unknown_m: f64) -> Option<Match> {
        self.trust_all();
        let pair = Pair { kept, now, scale: scale(now)?, finest: WIDTH * kept.noise.hypot(now.noise) };
        let mut place = pair.settle(begin, FIRST_M, &self.doubts);
        for _ in 0..LOOKS {
            if !self.mark_moving(&pair, &place) {
                break;
            }
            place = pair.settle(place, 0.0, &self.doubts);
        }
        let sums = pair.sums(&place, pair.finest, 1, &self.doubts);
        if sums.beams < LEAST_BEAMS {
            return None;
        }
        let known = Known::of(&sums, 1);
        let (own, of_kept) = known.covariances(&sums, pair.scale, unknown_m);
        let is_finite =
            own.as_flattened().iter().chain(of_kept.as_flattened()).all(|value| value.is_finite());
        let found = Match {
            place,
            own,
            of_kept,
            overlap: pair.overlap(&place),
            weight: sums.weights,
            is_degenerate: !known.is_known.iter().all(|is_known| *is_known),
            has_corners: same_corners(kept, now, &place),
            has_lines: same_lines(kept, now, &place),
        };
        (is_finite && place.x.is_finite() && place.y.is_finite() && place.yaw.is_finite()).then_some(found)
    }

    /// Returns, by reading of the last scan, 0 for an object that stands, otherwise the number of kept scans for which
    /// a moving object is ignored.
    pub(super) fn doubts(&self) -> &[u8] {
        &self.doubts
    }

    /// Resets the matcher: no object is known to move.
    pub(super) fn trust_all(&mut self) {
        self.doubts.fill(0);
    }

    /// Marks readings of moving objects, and returns whether other readings than before are marked. A run of
    /// neighboring readings is marked if one of these is true:
    ///
    /// - Together, they are farther from surfaces than their noise.
    /// - Most of them lie in space that was empty before.
    /// - Most of them lie on objects that moved before.
    fn mark_moving(&mut self, pair: &Pair<'_>, place: &Rigid) -> bool {
        let width = 2.0 * pair.finest;
        let beams = pair.now.points().len();
        let (mut runs, mut off, mut expected) = (0, 0.0, 0.0);
        for i in 0..beams {
            if i == 0 || !pair.now.is_connected(i) || usize::from(self.runs[runs - 1].all) >= PIECE {
                self.runs[runs] = Run { first: i as u16, ..Run::default() };
                runs += 1;
            }
            let run = &mut self.runs[runs - 1];
            run.all += 1;
            let point = place.point(pair.now.points()[i]);
            run.come += u16::from(pair.kept.sees_through(point, width));
            let doubt = pair.kept.nearest(point, width).map_or(0, |at| pair.kept.readings()[at].doubt);
            run.doubted += u16::from(doubt > 0);
            run.doubt = run.doubt.max(doubt);
            let Some(on) = pair.on(i, place, width) else { continue };
            let square = on.off * on.off;
            run.off += (square / on.variance()).min(CAP);
            run.beams += 1;
            if self.doubts[i] == 0 && on.off.abs() < pair.finest {
                (off, expected) = (off + square, expected + on.variance());
            }
        }
        let level = if expected > 0.0 { (off / expected).max(1.0) } else { 1.0 };
        let mut is_new = false;
        for at in 0..runs {
            let end = if at + 1 < runs { self.runs[at + 1].first.into() } else { beams };
            let run = self.runs[at];
            // The variance of the sum of squares is twice the number of beams.
            let n = f64::from(run.beams);
            let is_off = run.off > level * (MORE * n + 4.0 * (2.0 * n).sqrt());
            let doubt = match is_off || 2 * run.come > run.all {
                true => DOUBT,
                false if 2 * run.doubted > run.all => run.doubt - 1,
                false => 0,
            };
            for was in &mut self.doubts[run.first.into()..end] {
                is_new |= (*was > 0) != (doubt > 0);
                *was = doubt;
            }
        }
        is_new
    }
}

/// Two scans that are matched.
struct Pair<'a> {
    kept: &'a View,
    now: &'a View,
    /// See [`scale`].
    scale: f64,
    /// Maximum distance of a beam from its surface in the last rounds, in meters.
    finest: f64,
}

/// A beam that ends near a surface.
struct On {
    point: (f64, f64),
    surface: Surface,
    off: f64,
    /// Whether the surface belongs to a moving object.
    is_doubted: bool,
    /// Variance of `off` by the noise of the scan, and by that of the kept one.
    by_now: f64,
    by_kept: f64,
}

impl On {
    fn variance(&self) -> f64 {
        self.by_now + self.by_kept
    }
}

impl Pair<'_> {
    /// Returns the position of `now`, starting at `place` with beams that are at most `width` away from surfaces.
    fn settle(&self, mut place: Rigid, width: f64, doubts: &[u8]) -> Rigid {
        let mut width = width.max(self.finest);
        let coarse = self.now.points().len().div_ceil(COARSE);
        for _ in 0..ROUNDS {
            let is_last = width <= self.finest;
            let stride = if is_last { 1 } else { coarse };
            let sums = self.sums(&place, width, stride, doubts);
            let step = Known::of(&sums, stride).solve(&sums.slope);
            let turn = step[2] / self.scale;
            place = Rigid::new(step[0], step[1], turn).then(&place);
            if is_last && step[0].hypot(step[1]) < STILL_M && turn.abs() < STILL_RAD {
                break;
            }
            width = (0.5 * width).max(self.finest);
        }
        place
    }

    /// Returns the share of the readings that are near a surface.
    fn overlap(&self, place: &Rigid) -> f64 {
        let beams = self.now.points().len();
        (0..beams).filter(|&i| self.on(i, place, self.finest).is_some()).count() as f64 / beams as f64
    }

    /// Returns reading `i` if it is less than `width` away from a surface.
    fn on(&self, i: usize, place: &Rigid, width: f64) -> Option<On> {
        let (reading, point) = (&self.now.readings()[i], place.point(self.now.points()[i]));
        // The beam nearest to the point may end as far from it as neighboring beams are apart.
        let on = &self.kept.readings()[self.kept.nearest(point, width + SPACING_M)?];
        let surface = on.surface?;
        let off = surface.off(point);
        let along = |(x, y): (f64, f64)| surface.normal.0 * x + surface.normal.1 * y;
        let deviations =
            (along(place.turned(reading.direction)) * self.now.noise, along(on.direction) * self.kept.noise);
        let (by_now, by_kept) = (deviations.0 * deviations.0, deviations.1 * deviations.1);
        // A surface that is seen edge-on also varies across the beams.
        let least = LEAST_SHARE * (self.now.noise * self.now.noise);
        (off.abs() < width).then_some(On {
            point,
            surface,
            off,
            is_doubted: on.doubt > 0,
            by_now: by_now.max(least),
            by_kept: by_kept.max(least),
        })
    }

    /// Returns the sums over every `stride`th beam at `place` that is less than `width` away from a surface and not on
    /// a moving object.
    fn sums(&self, place: &Rigid, width: f64, stride: usize, doubts: &[u8]) -> Sums {
        let mut sums = Sums::default();
        for i in (0..self.now.points().len()).step_by(stride.max(1)).filter(|&i| doubts[i] == 0) {
            let Some(on) = self.on(i, place, width).filter(|on| !on.is_doubted) else { continue };
            let (share, off) = (on.off / width, on.off);
            // Tukey's biweight.
            let weight = (1.0 - share * share) * (1.0 - share * share);
            let ((nx, ny), (x, y)) = (on.surface.normal, on.point);
            let row = [nx, ny, (ny * x - nx * y) / self.scale];
            add_outer(&mut sums.weight, &row, weight);
            for (slope, value) in sums.slope.iter_mut().zip(row) {
                *slope += weight * off * value;
            }
            add_outer(&mut sums.own, &row, weight * weight * on.by_now);
            add_outer(&mut sums.of_kept, &row, weight * weight * on.by_kept);
            sums.chance += CHANCE * weight * on.surface.variance;
            sums.off += weight * off * off;
            sums.expected += weight * on.variance();
            sums.weights += weight;
            sums.beams += 1;
        }
        sums
    }
}

/// Returns the root mean square distance of the points of `now`, so that a turn by its inverse moves them by about one
/// meter. `None` if there are no points.
fn scale(now: &View) -> Option<f64> {
    let square: f64 = now.points().iter().map(|point| point.0 * point.0 + point.1 * point.1).sum();
    let scale = (square / now.points().len().max(1) as f64).sqrt();
    (scale.is_finite() && scale > 0.0).then_some(scale)
}

impl Known {
    /// A direction is known if enough beams meet walls across it, not counting the part that chance adds.
    fn of(sums: &Sums, stride: usize) -> Known {
        let (values, vectors) = eigen(sums.weight);
        let least = (LEAST_BEAMS as f64 / stride as f64).max(LEAST_PART * sums.weights);
        let said = values.map(|value| value - sums.chance);
        let is_said = said.map(|beams| beams * stride as f64 >= SAID_BEAMS);
        Known { values, vectors, is_said, is_known: said.map(|beams| beams >= least) }
    }

    /// Returns the step against `slope`, along directions with enough beams.
    fn solve(&self, slope: &[f64; 3]) -> [f64; 3] {
        let mut step = [0.0; 3];
        for ((value, vector), is_said) in self.values.iter().zip(&self.vectors).zip(self.is_said) {
            if is_said {
                let along: f64 = vector.iter().zip(slope).map(|(a, b)| a * b).sum();
                step.iter_mut().zip(vector).for_each(|(step, v)| *step -= along / value * v);
            }
        }
        step
    }

    /// Returns the covariance of the position by the noise of the scan, and by that of the kept one, in meters and
    /// radians.
    fn covariances(&self, sums: &Sums, scale: f64, unknown_m: f64) -> (Square, Square) {
        // If beams are off by more than their noise, the position is less certain.
        let factor = (sums.off / sums.expected).max(1.0);
        let inverse = self.inverse();
        let of_radians = [1.0, 1.0, 1.0 / scale];
        let of = |sum: &Square, unknown_m: f64| {
            let mut covariance = around(&inverse, sum);
            covariance.as_flattened_mut().iter_mut().for_each(|value| *value *= factor);
            for (vector, is_known) in self.vectors.iter().zip(self.is_known) {
                if !is_known {
                    add_outer(&mut covariance, vector, unknown_m * unknown_m);
                }
            }
            std::array::from_fn(|i| std::array::from_fn(|j| covariance[i][j] * of_radians[i] * of_radians[j]))
        };
        (of(&sums.own, unknown_m), of(&sums.of_kept, 0.0))
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

/// Returns whether a corner of `now` at `place` is one of `kept`.
fn same_corners(kept: &View, now: &View, place: &Rigid) -> bool {
    let near = NEAR * kept.noise.hypot(now.noise) + NEAR_M;
    let is_same = |corner: &Corner| {
        let (x, y) = place.point((corner.x_m.into(), corner.y_m.into()));
        let off = |other: &Corner| (x - f64::from(other.x_m)).hypot(y - f64::from(other.y_m));
        kept.lines.corners().iter().any(|other| off(other) <= near)
    };
    now.lines.corners().iter().any(is_same)
}

/// Returns whether a line of `now` at `place` is one of `kept`: both of its ends lie on that line, and the two overlap.
fn same_lines(kept: &View, now: &View, place: &Rigid) -> bool {
    let near = NEAR * kept.noise.hypot(now.noise) + NEAR_M;
    let is_same = |line: &Line| {
        let ends =
            [(line.x1_m, line.y1_m), (line.x2_m, line.y2_m)].map(|(x, y)| place.point((x.into(), y.into())));
        let is_on = |other: &Line| {
            let (sin, cos) = f64::from(other.alpha_rad).sin_cos();
            let along = |(x, y): (f64, f64)| cos * y - sin * x;
            let of_other = [(other.x1_m, other.y1_m), (other.x2_m, other.y2_m)];
            let of_other = of_other.map(|(x, y)| along((x.into(), y.into())));
            let (least, most) = (of_other[0].min(of_other[1]), of_other[0].max(of_other[1]));
            let alongs = ends.map(along);
            let is_beside = alongs[0].max(alongs[1]) < least || alongs[0].min(alongs[1]) > most;
            !is_beside
                && ends.iter().all(|end| (cos * end.0 + sin * end.1 - f64::from(other.r_m)).abs() <= near)
        };
        kept.lines.lines().iter().any(is_on)
    };
    now.lines.lines().iter().any(is_same)
}

/// Readings of one scan, with their surfaces and lines.
pub(super) struct View {
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
    /// Number of kept scans for which its object is ignored, because it was seen to move; 0 if it stands.
    pub(super) doubt: u8,
}

/// A plane across the floor: x nx + y ny = r.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surface {
    pub(super) normal: (f64, f64),
    pub(super) r: f64,
    /// Variance of its direction in rad2.
    pub(super) variance: f64,
}

impl View {
    /// Allocates a view of at most `beams` beams.
    pub(super) fn new(beams: usize) -> View {
        View {
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
        self.noise = if noise.is_finite() { noise.max(LEAST_NOISE_M) } else { LEAST_NOISE_M };
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
                Reading { beam: beam as u16, direction, range, surface: None, doubt: 0 };
            self.count += 1;
        }
        self.slots[next..self.grid.2].fill(self.count as u16);
        self.set_surfaces_of_lines();
        for i in 0..self.count {
            if self.readings[i].surface.is_none() {
                self.readings[i].surface = self.among_neighbors(i);
            }
        }
    }

    /// Sets the surface of the readings of each line, except of those that are far from it.
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
                if surface.off(point).abs() <= 4.0 * self.noise {
                    reading.surface = Some(surface);
                }
            }
        }
    }

    /// Returns the surface through reading `i` and its neighbors, if they lie on one.
    fn among_neighbors(&self, i: usize) -> Option<Surface> {
        let (mut first, mut last) = (i, i);
        while first > 0 && i - first < NEIGHBORS && self.is_connected(first) {
            first -= 1;
        }
        while last + 1 < self.count && last - i < NEIGHBORS && self.is_connected(last + 1) {
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

    /// Returns whether reading `i` and the one before it may belong to one object.
    pub(super) fn is_connected(&self, i: usize) -> bool {
        let (one, two) = (&self.readings[i - 1], &self.readings[i]);
        let (p, q) = (self.points[i - 1], self.points[i]);
        let apart = f64::from(two.beam - one.beam) * self.grid.1.abs() * one.range.max(two.range);
        (p.0 - q.0).hypot(p.1 - q.1) <= CONNECTED_M + 3.0 * apart
    }

    /// Returns the beams that have a range.
    pub(super) fn readings(&self) -> &[Reading] {
        &self.readings[..self.count]
    }

    /// Returns the points of the readings in the robot's frame.
    pub(super) fn points(&self) -> &[(f64, f64)] {
        &self.points[..self.count]
    }

    /// Stores for each reading for how long its object is ignored.
    pub(super) fn doubt(&mut self, doubts: &[u8]) {
        for (reading, doubt) in self.readings[..self.count].iter_mut().zip(doubts) {
            reading.doubt = *doubt;
        }
    }

    /// Returns whether `point` is in empty space: the beams to both sides of it end more than `margin` after it.
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

    /// Returns the reading whose point is nearest to `point`, if it is nearer than `most`. The sine of the angle
    /// between a beam and `point` is a lower bound of the distance for all beams farther aside, so only a few are
    /// compared.
    pub(super) fn nearest(&self, point: (f64, f64), most: f64) -> Option<usize> {
        let (_, step, beams) = self.grid;
        if self.count == 0 {
            return None;
        }
        let (distance, at) = self.towards(point)?;
        let (turn, last) = (TAU / step.abs(), beams as f64 - 1.0);
        let begin = usize::from(self.slots[at.clamp(0.0, last) as usize]);
        let mut best = (most * most, None);
        // Minimum distance of a beam that is `aside` steps away, by sin a >= 2 a / pi. Exact angles are up to a step
        // off.
        let bound = |aside: f64| distance * ((aside - 1.5) * step.abs() / FRAC_PI_2).clamp(0.0, 1.0);
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
    /// Returns the signed distance of `point` from the surface.
    #[inline]
    pub(super) fn off(&self, point: (f64, f64)) -> f64 {
        self.normal.0 * point.0 + self.normal.1 * point.1 - self.r
    }
}

/// Maximum distance of a beam from its surface in the first round. It is halved in each round.
const FIRST_M: f64 = 0.3;
/// Maximum distance in the last rounds, in standard deviations. With this constant of Tukey, almost nothing is lost if
/// there is only noise.
const WIDTH: f64 = 3.0;
const ROUNDS: usize = 20;
/// Number of beams that are enough for all rounds except the last ones.
const COARSE: usize = 120;
const STILL_M: f64 = 2e-5;
const STILL_RAD: f64 = 1e-5;
/// Minimum number of beams that define a direction. Fewer may be a leg.
const LEAST_BEAMS: usize = 6;
/// Number of beams from which on a direction is better than a guess.
const SAID_BEAMS: f64 = 1.5;
/// `LEAST_BEAMS` as a share of all beams. In a long corridor, door frames are mistaken for one another.
const LEAST_PART: f64 = 0.03;
/// Maximum number of readings that are judged together. A whole wall would count as moving because of one end of it.
const PIECE: usize = 24;
/// Maximum square that a reading adds, in variances of its noise. A few readings at an edge do not decide about the
/// others.
const CAP: f64 = 9.0;
/// Number of times that moving objects are searched for.
const LOOKS: usize = 2;
/// Maximum mean square of the readings of an object that stands, in variances of their noise.
const MORE: f64 = 3.0;
/// Number of kept scans for which a moving object is ignored.
const DOUBT: u8 = 3;
/// Minimum variance across a surface, as a share of the variance of a range.
const LEAST_SHARE: f64 = 0.05;
/// Factor of the part of the weight that is expected by chance.
const CHANCE: f64 = 2.0;
/// Maximum distance of neighboring points whose surface counts for a point between them.
pub(super) const SPACING_M: f64 = 0.2;
/// Maximum distance of equal corners and lines in standard deviations, and in addition to that in meters.
const NEAR: f64 = 3.0;
const NEAR_M: f64 = 0.02;
/// Minimum standard deviation of a range in meters, for errors of a scanner other than noise.
const LEAST_NOISE_M: f64 = 0.005;
/// Number of neighbors on each side that define a surface.
const NEIGHBORS: usize = 4;
/// Maximum distance of two points of one object, in addition to that of a surface that is seen at a flat angle.
const CONNECTED_M: f64 = 0.1;
/// Maximum variance of the direction of a surface: 10 degrees.
const MOST_VARIANCE: f64 = 0.03;
