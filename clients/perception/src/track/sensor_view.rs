//! View of one sensor in its last scan: the range in each direction, the legs, and whether a position is occupied,
//! free or occluded.

use std::f64::consts::{FRAC_PI_4, TAU};

use scanhub_schema::{Foreground, Scan};

use super::geometry::{Point, distance, minus};
use super::site::{Sensor, Site};

/// Maximum number of legs in a scan.
pub(crate) const MAX_LEGS: usize = 64;
/// Radius of a leg with its trousers, in meters.
pub(crate) const LEG_M: f64 = 0.06;
/// Maximum width of a leg in meters. A wider object counts as two adjacent legs.
const MAX_LEG_WIDTH_M: f64 = 0.26;
/// Minimum width of a leg with its trousers, in meters. The legs of chairs and tables are thinner.
const MIN_LEG_WIDTH_M: f64 = 0.09;
/// Diameter of a beam's light spot at the scanner in meters, and growth of this diameter per meter of range. The values
/// are those of an LMS 2xx, which has the widest spot of all supported scanners.
const SPOT_M: f64 = 0.01;
const SPOT_RAD: f64 = 0.0045;
/// Minimum width of a surface, such as the leaf of a door, in meters. A narrower straight object may be legs.
const MIN_FLAT_WIDTH_M: f64 = 0.4;
/// Maximum standard deviation of a surface's points from a straight line, in meters. The ranges have noise.
const FLATNESS_M: f64 = 0.015;
/// Minimum distance by which the beams next to a free leg reach farther than the leg, in meters. Neighboring points of
/// a surface differ by less.
const MIN_FREE_DEPTH_M: f64 = 0.6;
/// Number of points between the jambs of a door at which the door is checked, and maximum distance between a closed
/// leaf and the line from jamb to jamb, in meters.
const CLOSED_POINTS: usize = 9;
const MAX_CLOSED_OFFSET_M: f64 = 0.25;
/// Maximum width of a person in meters.
const MAX_PERSON_WIDTH_M: f64 = 1.3;
/// Minimum distance by which an object must be nearer than the farthest range of its beam, in meters.
const MIN_FOREGROUND_DISTANCE_M: f64 = 0.15;
/// Number of scans in a row in which a beam must exceed its farthest range before this range is increased.
const MIN_FARTHER_SCANS: u8 = 5;
/// Maximum distance between a person's position and a leg of the person, in meters.
const MAX_LEG_DISTANCE_M: f64 = 0.35;

/// A leg that one sensor sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Leg {
    /// Center of the leg. The sensor sees only the near side of the leg, so the measured position is corrected.
    pub(crate) at: Point,
    /// Standard deviation of each coordinate in meters.
    pub(crate) sigma_m: f64,
    /// Whether the leg is in front of the background and has enough beams. A single beam is enough only where
    /// neighboring beams are at least [`LEG_M`] apart. An object that has become background is not fresh.
    pub(crate) is_fresh: bool,
    /// Whether the leg is evidence for a person. False for an object that is as thin as a chair leg, and for a range
    /// between two surfaces, which belongs to no object. Legs that are not solid only support a track that other legs
    /// have started.
    pub(crate) is_solid: bool,
    /// Number of beams that the leg reflects.
    pub(crate) beams: usize,
    /// Whether the leg is in an ignored area. A leg in an ignored area is not fresh.
    pub(crate) is_ignored: bool,
    /// Whether the beams on both sides of the leg reach much farther. This excludes parts of a door's leaf, because the
    /// points of a leaf are adjacent.
    pub(crate) is_free: bool,
    /// Position of the leg relative to the leaves of doors.
    pub(crate) at_door: DoorProximity,
}

/// Whether a leg may be a part of a door's leaf.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd)]
pub(crate) enum DoorProximity {
    /// No leaf reaches the position.
    Clear,
    /// A leaf that swings about a jamb reaches the position.
    Swing,
    /// The position is between the jambs of a door, on the line along which a leaf may slide.
    Line,
    /// The position is on the line along which a leaf may slide, at a jamb or outside the opening, where an open leaf
    /// ends.
    Jamb,
}

/// Visibility of a position at which a person may stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Visibility {
    /// The sensor sees through the position, so no person stands there.
    Free,
    /// An object is at the position.
    Occupied,
    /// A nearer object occludes the position, or no beam points there.
    Occluded,
}

/// Last scan of one sensor, with the farthest range that each beam has measured.
pub(crate) struct SensorView {
    sensor: Sensor,
    first_angle: f64,
    step: f64,
    /// Direction of each beam in the map.
    directions: Vec<Point>,
    /// Ranges in meters; NaN without a reading, and infinite without a return.
    ranges: Vec<f64>,
    /// Farthest range that each beam has reached in several scans. These ranges show the room without people.
    farthest: Vec<f64>,
    /// For each beam, the number of scans in a row that exceeded the farthest range, and the minimum range of these
    /// scans.
    farther: Vec<(u8, f64)>,
    is_foreground: Vec<bool>,
    legs: Vec<Leg>,
    /// Beams that end at an object. Their points are in the foreground, or nearer than the farthest range of the beam.
    standing: Vec<usize>,
    /// Beams of the current cluster with their end points.
    points: Vec<(usize, Point)>,
}

impl SensorView {
    pub(crate) fn new(sensor: Sensor) -> SensorView {
        SensorView {
            sensor,
            first_angle: 0.0,
            step: 0.0,
            directions: Vec::new(),
            ranges: Vec::new(),
            farthest: Vec::new(),
            farther: Vec::new(),
            is_foreground: Vec::new(),
            legs: Vec::with_capacity(MAX_LEGS),
            standing: Vec::new(),
            points: Vec::new(),
        }
    }

    /// Handles the next scan, and finds the legs in it.
    pub(crate) fn take(&mut self, scan: &Scan, foreground: &Foreground) {
        self.fit(scan);
        let unit_m = f64::from(scan.unit_um) * 1e-6;
        let beams = self.ranges.iter_mut().zip(&mut self.farthest).zip(&mut self.farther);
        for (&value, ((range, farthest), farther)) in scan.ranges().iter().zip(beams) {
            *range = if value <= scan.valid_to {
                f64::from(value) * unit_m
            } else if value == scan.no_return || value == scan.beyond {
                f64::INFINITY
            } else {
                f64::NAN
            };
            // Most beams end at their usual range, so skip the update for them.
            if *range > *farthest || farther.0 > 0 {
                update_farthest(*range, farthest, farther);
            }
        }
        for (direction, &angle) in self.directions.iter_mut().zip(scan.exact_angles()) {
            if angle.is_finite() {
                *direction = self.sensor.direction(f64::from(angle));
            }
        }
        self.is_foreground.fill(false);
        for (beam, _) in foreground.readings() {
            if let Some(bit) = self.is_foreground.get_mut(beam) {
                *bit = true;
            }
        }
        self.find_legs();
    }

    /// Corrects the sensor's position by `off`, by which everything that the sensor sees is displaced in the map.
    pub(crate) fn shift(&mut self, off: Point) {
        self.sensor.position = minus(self.sensor.position, off);
    }

    /// Marks the legs in the ignored areas of `site`, and the legs that may be parts of door leaves.
    pub(crate) fn mark(&mut self, site: &Site, has_leaves: &[bool]) {
        for leg in &mut self.legs {
            leg.at_door = site.at_door(leg.at, has_leaves);
            if site.is_ignored(leg.at) {
                (leg.is_fresh, leg.is_ignored) = (false, true);
            }
        }
    }

    /// Returns whether a door is closed: all beams into the opening end near the line between the jambs. A door with
    /// fewer than five beams never counts as closed.
    pub(crate) fn is_closed(&self, [a, b]: [Point; 2]) -> bool {
        let ends_there = |i: usize| {
            let share = (i + 1) as f64 / (CLOSED_POINTS + 1) as f64;
            let (beam, far) = self.beam([a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])])?;
            let beam = beam.round() as usize;
            self.ranges
                .get(beam)
                .is_some_and(|range| (range - far).abs() <= MAX_CLOSED_OFFSET_M)
                .then_some(beam)
        };
        // Begin at the middle, because an open door fails the check there.
        let order = (0..CLOSED_POINTS).map(|i| (i + CLOSED_POINTS / 2) % CLOSED_POINTS);
        let (mut first, mut last) = (usize::MAX, 0);
        for i in order {
            let Some(beam) = ends_there(i) else { return false };
            (first, last) = (first.min(beam), last.max(beam));
        }
        last - first >= 4
    }

    pub(crate) fn legs(&self) -> &[Leg] {
        &self.legs
    }

    /// Returns the visibility of `position` in the last scan.
    pub(crate) fn visibility(&self, position: Point) -> Visibility {
        let Some((middle, far)) = self.beam(position) else { return Visibility::Occluded };
        // Half of the width of a person's legs, in beams.
        let half = ((0.2 / far).min(0.5) / self.step.abs()).ceil();
        let first = (middle - half).max(0.0) as usize;
        let last = ((middle + half) as usize).min(self.ranges.len() - 1);
        let spacing = far * self.step.abs();
        let (mut through, mut hidden, mut occupied_run, mut occluded_run) = (0, 0, 0, 0);
        for (&range, &farthest) in self.ranges[first..=last].iter().zip(&self.farthest[first..=last]) {
            if range.is_nan() {
                continue;
            }
            let is_here = range > far - MAX_LEG_DISTANCE_M
                && range <= far + MAX_LEG_DISTANCE_M
                && range < farthest - MIN_FOREGROUND_DISTANCE_M;
            // An object that is too thin to be a person does not block the view.
            let is_through = is_here
                || range > far + MAX_LEG_DISTANCE_M
                || (range > farthest - MIN_FOREGROUND_DISTANCE_M && range > far - 0.05);
            occupied_run = if is_here { occupied_run + 1 } else { 0 };
            if is_here && !is_thin(occupied_run, spacing) {
                return Visibility::Occupied;
            }
            if is_through {
                through += 1;
                // A thin object cannot occlude a person either.
                hidden += if is_thin(occluded_run, spacing) { 0 } else { occluded_run };
                occluded_run = 0;
            } else {
                occluded_run += 1;
            }
        }
        hidden += occluded_run;
        let all = through + hidden;
        if all >= 2 && 5 * through >= 4 * all { Visibility::Free } else { Visibility::Occluded }
    }

    /// Returns the fractional index of the beam to `position`, and the distance in meters. Returns `None` if no beam
    /// points to `position`.
    fn beam(&self, position: Point) -> Option<(f64, f64)> {
        let offset = minus(position, self.sensor.position);
        let far = (offset[0] * offset[0] + offset[1] * offset[1]).sqrt();
        if self.step == 0.0 || far < 0.2 {
            return None;
        }
        let bearing = offset[1].atan2(offset[0]) - self.sensor.yaw_rad;
        let angle = if self.sensor.is_upside_down { -bearing } else { bearing };
        let turned = ((angle - self.first_angle) * self.step.signum() + 1e-9).rem_euclid(TAU);
        let middle = turned / self.step.abs();
        (middle < self.ranges.len() as f64).then_some((middle, far))
    }

    /// Returns the number of elements for which memory is allocated.
    #[cfg(test)]
    pub(crate) fn capacity(&self) -> usize {
        let of_beams = self.directions.capacity() + self.ranges.capacity() + self.farthest.capacity();
        let flags = self.farther.capacity() + self.is_foreground.capacity();
        of_beams + flags + self.legs.capacity() + self.standing.capacity() + self.points.capacity()
    }

    /// Prepares the tables for the shape of `scan`, if the shape has changed.
    fn fit(&mut self, scan: &Scan) {
        let (shape, count) = ((scan.first_angle, scan.step), scan.beams());
        if (self.first_angle, self.step) == shape && self.ranges.len() == count {
            return;
        }
        (self.first_angle, self.step) = shape;
        self.directions.clear();
        self.directions.extend((0..count).map(|i| self.sensor.direction(shape.0 + i as f64 * shape.1)));
        for array in [&mut self.ranges, &mut self.farthest] {
            array.clear();
            array.resize(count, 0.0);
        }
        self.farther.clear();
        self.farther.resize(count, (0, f64::INFINITY));
        self.is_foreground.clear();
        self.is_foreground.resize(count, false);
        self.standing.reserve(count);
        self.points.reserve(count);
    }

    fn find_legs(&mut self) {
        self.legs.clear();
        let mut points = std::mem::take(&mut self.points);
        points.clear();
        let step = self.step.abs();
        let beams = self.ranges.iter().zip(&self.farthest).zip(&self.is_foreground).enumerate();
        let stands = beams.filter(|(_, ((range, farthest), is_foreground))| {
            range.is_finite() && (**range < **farthest - MIN_FOREGROUND_DISTANCE_M || **is_foreground)
        });
        let mut standing = std::mem::take(&mut self.standing);
        standing.clear();
        standing.extend(stands.map(|(i, _)| i));
        for &i in &standing {
            let range = self.ranges[i];
            let (position, direction) = (self.sensor.position, self.directions[i]);
            let point = [position[0] + range * direction[0], position[1] + range * direction[1]];
            if let Some(&(before, last)) = points.last()
                && (before + 1 != i || distance(last, point) > 0.08 + 1.5 * range * step)
            {
                self.close_cluster(&points);
                points.clear();
            }
            points.push((i, point));
        }
        self.close_cluster(&points);
        (self.points, self.standing) = (points, standing);
    }

    /// Finds the legs in a cluster of neighboring points.
    fn close_cluster(&mut self, points: &[(usize, Point)]) {
        let (Some(&(first, begin)), Some(&(last, end))) = (points.first(), points.last()) else { return };
        let width = distance(begin, end);
        if width > MAX_PERSON_WIDTH_M || self.legs.len() == MAX_LEGS {
            return;
        }
        if width > MAX_LEG_WIDTH_M && points.len() >= 4 {
            if width > MIN_FLAT_WIDTH_M && is_flat(points) {
                return;
            }
            // Between two legs, neighboring points are farther apart than on one leg.
            let n = points.len();
            let within = n / 4 + 1..=3 * n / 4;
            let cut = within.max_by(|&a, &b| {
                let gap = |i: usize| distance(points[i - 1].1, points[i].1);
                gap(a).total_cmp(&gap(b))
            });
            if let Some(cut) = cut {
                self.close_cluster(&points[..cut]);
                self.close_cluster(&points[cut..]);
            }
            return;
        }
        let n = points.len() as f64;
        let sum = points.iter().fold([0.0, 0.0], |sum, (_, p)| [sum[0] + p[0], sum[1] + p[1]]);
        let mean = [sum[0] / n, sum[1] / n];
        let offset = minus(mean, self.sensor.position);
        let range = (offset[0] * offset[0] + offset[1] * offset[1]).sqrt().max(0.05);
        // Distance from the mean of the points to the center of the leg, as a share of the range. The points are on the
        // near half of a circle, and their beams are at equal angles.
        let deeper = LEG_M * FRAC_PI_4 / range;
        let spacing = range * self.step.abs();
        let cut_off = |beam: Option<usize>| {
            beam.and_then(|beam| self.ranges.get(beam)).is_some_and(|&neighbor| neighbor < range - 0.1)
        };
        let is_partial = cut_off(first.checked_sub(1)) || cut_off(Some(last + 1));
        let is_short = points.len() == 1 && spacing < LEG_M;
        // A beam that meets two surfaces may report any range between them.
        let is_between = is_partial && points.len() as f64 <= 1.0 + (SPOT_M + SPOT_RAD * range) / spacing;
        let is_free = |beam: Option<usize>| {
            beam.and_then(|beam| self.ranges.get(beam))
                .is_some_and(|&neighbor| neighbor > range + MIN_FREE_DEPTH_M)
        };
        let sigma_m = if is_partial || is_short { 0.07 } else { 0.03 + 0.3 * spacing };
        let fresh = points.iter().filter(|(beam, _)| self.is_foreground[*beam]).count();
        self.legs.push(Leg {
            at: [mean[0] + deeper * offset[0], mean[1] + deeper * offset[1]],
            sigma_m,
            is_fresh: 2 * fresh > points.len() && !is_short,
            beams: points.len(),
            is_solid: !is_between && !is_short && (is_partial || !is_thin(points.len(), spacing)),
            is_ignored: false,
            is_free: is_free(first.checked_sub(1)) && is_free(Some(last + 1)),
            at_door: DoorProximity::Clear,
        });
    }
}

/// Returns whether an object is thinner than a leg. The object reflects `beams` beams, which are `spacing_m` apart.
fn is_thin(beams: usize, spacing_m: f64) -> bool {
    (beams + 1) as f64 * spacing_m < MIN_LEG_WIDTH_M
}

/// Returns whether the points lie on a line, within the noise of the ranges.
fn is_flat(points: &[(usize, Point)]) -> bool {
    let n = points.len() as f64;
    let mean = points.iter().fold([0.0, 0.0], |sum, (_, p)| [sum[0] + p[0] / n, sum[1] + p[1] / n]);
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for (_, point) in points {
        let [x, y] = minus(*point, mean);
        (xx, xy, yy) = (xx + x * x / n, xy + x * y / n, yy + y * y / n);
    }
    // Variance along the minor axis.
    let across = (xx + yy) / 2.0 - ((xx - yy) * (xx - yy) / 4.0 + xy * xy).sqrt();
    across < FLATNESS_M * FLATNESS_M
}

/// Updates the farthest range of a beam. A longer range counts as noise until [`MIN_FARTHER_SCANS`] scans in a row have
/// measured one.
fn update_farthest(range: f64, farthest: &mut f64, (scans, least): &mut (u8, f64)) {
    if range > *farthest {
        (*scans, *least) = (*scans + 1, least.min(range));
        if *scans == MIN_FARTHER_SCANS {
            *farthest = *least;
            (*scans, *least) = (0, f64::INFINITY);
        }
    } else if !range.is_nan() {
        (*scans, *least) = (0, f64::INFINITY);
    }
}
