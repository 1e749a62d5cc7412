//! Segments of neighboring foreground beams, with their positions and whether they are supported. At a distant edge,
//! single beams flicker between background and foreground. An object is in several beams, or in several scans, which
//! supports its segment.

use std::f64::consts::{PI, TAU};
use std::mem::{replace, take};

use scanhub_schema::{Foreground, ForegroundArrays, Pose, Scan, Segment};

use crate::directions::{Directions, exact_angle};

/// Cuts the foreground of one sensor into segments.
///
/// Points are computed in 64-bit floating point and rounded to mm. The results are the same on every machine, because
/// only the four basic operations and the square root are used, which are exactly defined for this format.
pub struct Segmenter {
    pose: Pose,
    directions: Directions,
    /// Limits for two neighboring beams of a scan without exact angles.
    step_limit: StepLimit,
    /// Foreground points of the previous scan.
    previous: Points,
    /// Buffer for the foreground points of the current scan.
    scratch: Points,
}

/// Points relative to the sensor, along the axes of the robot's frame, in mm.
#[derive(Default)]
struct Points {
    points: Box<[(f64, f64)]>,
    count: usize,
}

/// Values that are computed once from the angle between two beams (the step), to decide whether two points belong to
/// one segment.
#[derive(Clone, Copy, Default)]
struct StepLimit {
    /// The term 2 (1 - cos step) of the law of cosines.
    spread: f64,
    /// Maximum distance between two points of one surface, in mm per mm of range.
    slope: f64,
}

/// Minimum angle between a beam and a surface at which the surface becomes one segment.
const MIN_INCIDENCE_DEG: f64 = 10.0;
/// Distance in mm by which two points of one segment may be farther apart because of the noise of their ranges.
const NOISE_MARGIN_MM: f64 = 15.0;
/// Maximum distance between the point of a single beam and a point of the previous scan that supports it, in mm. A
/// person at 3 m/s runs this distance in one revolution of a scanner at 10 Hz.
const MAX_SUPPORT_DISTANCE_MM: f64 = 300.0;

impl Segmenter {
    /// Creates a segmenter for a sensor at `pose` with at most `beams` beams.
    pub fn new(pose: Pose, beams: usize) -> Segmenter {
        let points = || vec![(0.0, 0.0); beams].into();
        let [before, room] = [points(), points()].map(|places| Points { points: places, count: 0 });
        Segmenter {
            pose,
            directions: Directions::new(beams),
            step_limit: StepLimit::default(),
            previous: before,
            scratch: room,
        }
    }

    /// Fills in the segments of `foreground`, which was computed from `scan`. Writes every byte of the segments.
    ///
    /// Two neighboring foreground beams belong to one segment if their points are no farther apart than two points of a
    /// surface at an angle of 10 degrees to the beam. The limit is r sin(step) / sin(10 degrees - step) + 15 mm, where
    /// r is the range of the first beam and step is the angle between the beams. If the scan has exact angles, step is
    /// computed from them.
    ///
    /// A segment is supported if it has several beams, or if its point is at most 0.3 m from a foreground point of the
    /// previous scan that was passed to this function or to [`pass`](Self::pass).
    pub fn update(&mut self, scan: &Scan, foreground: &mut Foreground) {
        self.fit(scan);
        let unit_mm = f64::from(scan.unit_um) / 1000.0;
        let head = **foreground;
        let ForegroundArrays { segments: places, bits, ranges } = foreground.begin(head);
        let (mut segments, mut dropped, mut supported) = (0, 0_u16, 0_u64);
        let (previous, mut now) = (&self.previous, take(&mut self.scratch));
        now.count = 0;
        let mut put = |open: &OpenSegment, pose: &Pose| match places.get_mut(segments) {
            Some(segment) => {
                *segment = open.close(pose, unit_mm);
                let has_support = open.first < open.last || previous.has_near(open.first_point);
                supported |= u64::from(has_support) << segments;
                segments += 1;
            }
            None => dropped = dropped.saturating_add(1),
        };
        let mut open: Option<OpenSegment> = None;
        self.each_point(scan, bits, ranges, |beam, range, measured, point| {
            now.add(point);
            match &mut open {
                Some(open) if open.last + 1 == beam && self.joins(open, measured) => {
                    open.add(beam, range, measured, point);
                }
                _ => {
                    if let Some(done) = open.replace(OpenSegment::new(beam, range, measured, point)) {
                        put(&done, &self.pose);
                    }
                }
            }
        });
        if let Some(done) = open {
            put(&done, &self.pose);
        }
        places[segments..].fill(Segment::default());
        foreground.segments = segments as u16;
        foreground.dropped = dropped;
        foreground.supported = supported;
        self.scratch = replace(&mut self.previous, now);
    }

    /// Stores the points of `foreground`, which support segments of the next scan, but does not find segments. Call
    /// this function instead of [`update`](Self::update) if the segments of `scan` are not needed.
    pub fn pass(&mut self, scan: &Scan, foreground: &mut Foreground) {
        self.fit(scan);
        let mut now = take(&mut self.scratch);
        now.count = 0;
        let head = **foreground;
        let ForegroundArrays { bits, ranges, .. } = foreground.begin(head);
        self.each_point(scan, bits, ranges, |_, _, _, point| now.add(point));
        self.scratch = replace(&mut self.previous, now);
    }

    /// Calls `visit` for each beam whose bit is set. The arguments are the index of the beam, its range in device
    /// units, its range in mm together with its exact angle (if there is one), and its point.
    fn each_point(
        &self,
        scan: &Scan,
        bits: &[u8],
        ranges: &[u16],
        mut visit: impl FnMut(usize, u16, (f64, Option<f64>), (f64, f64)),
    ) {
        let unit_mm = f64::from(scan.unit_um) / 1000.0;
        let (mut ranges, exact_angles) = (ranges.iter(), scan.exact_angles());
        for (byte, &bits) in bits.iter().enumerate() {
            let mut rest = bits;
            while rest != 0 {
                let beam = 8 * byte + rest.trailing_zeros() as usize;
                rest &= rest - 1;
                let (Some(&range), Some(on_grid)) = (ranges.next(), self.directions.on_grid(beam)) else {
                    return;
                };
                let range_mm = f64::from(range) * unit_mm;
                let exact = exact_angle(exact_angles, beam);
                let (x, y) = exact.map_or(on_grid, |exact| self.pose.direction(exact));
                visit(beam, range, (range_mm, exact), (range_mm * x, range_mm * y));
            }
        }
    }

    /// Returns whether a point belongs to the same segment as the last point of `open`. The point is on the next beam,
    /// at the range `next_mm`, and at the angle `exact` if the scan has exact angles.
    fn joins(&self, open: &OpenSegment, (next_mm, exact): (f64, Option<f64>)) -> bool {
        let range_mm = open.last_mm;
        let step =
            open.last_exact.zip(exact).map_or(self.step_limit, |(last, next)| StepLimit::of(next - last));
        let limit_mm = range_mm * step.slope + NOISE_MARGIN_MM;
        (range_mm - next_mm) * (range_mm - next_mm) + range_mm * next_mm * step.spread <= limit_mm * limit_mm
    }

    /// Adapts the directions and the step to scans with the angles of `scan`.
    fn fit(&mut self, scan: &Scan) {
        if self.directions.fit(&self.pose, scan) {
            self.step_limit = StepLimit::of(scan.step);
        }
    }
}

impl Points {
    /// Adds a point. Each beam must add at most one point, because there is no memory for more.
    fn add(&mut self, point: (f64, f64)) {
        if let Some(slot) = self.points.get_mut(self.count) {
            *slot = point;
            self.count += 1;
        }
    }

    /// Returns whether one of these points is near enough to `point` to support it.
    fn has_near(&self, point: (f64, f64)) -> bool {
        let square_distance = |other: &(f64, f64)| {
            let (dx, dy) = (other.0 - point.0, other.1 - point.1);
            dx * dx + dy * dy
        };
        self.points[..self.count]
            .iter()
            .any(|other| square_distance(other) <= MAX_SUPPORT_DISTANCE_MM * MAX_SUPPORT_DISTANCE_MM)
    }
}

impl StepLimit {
    /// Returns the limits for two beams with a step of `radians`. The step may be negative, and may include whole
    /// revolutions.
    fn of(radians: f64) -> StepLimit {
        let step = ((radians + PI).rem_euclid(TAU) - PI).abs();
        let spread = 2.0 * (1.0 - step.cos());
        // The formula is not defined for a step of 10 degrees or more, which no scanner has. With such a step, only the
        // margin for noise can join two points.
        let flattest = MIN_INCIDENCE_DEG.to_radians();
        let slope = if step < flattest { step.sin() / (flattest - step).sin() } else { 0.0 };
        StepLimit { spread, slope }
    }
}

/// A segment to which more beams may be added.
struct OpenSegment {
    first: usize,
    last: usize,
    nearest: u16,
    last_mm: f64,
    last_exact: Option<f64>,
    /// Point of the first beam, relative to the sensor, along the axes of the robot's frame, in mm.
    first_point: (f64, f64),
    last_point: (f64, f64),
    sum: (f64, f64),
}

impl OpenSegment {
    fn new(beam: usize, range: u16, (range_mm, exact): (f64, Option<f64>), point: (f64, f64)) -> OpenSegment {
        OpenSegment {
            first: beam,
            last: beam,
            nearest: range,
            last_mm: range_mm,
            last_exact: exact,
            first_point: point,
            last_point: point,
            sum: point,
        }
    }

    fn add(&mut self, beam: usize, range: u16, (range_mm, exact): (f64, Option<f64>), point: (f64, f64)) {
        self.last = beam;
        self.nearest = self.nearest.min(range);
        (self.last_mm, self.last_exact) = (range_mm, exact);
        self.last_point = point;
        self.sum = (self.sum.0 + point.0, self.sum.1 + point.1);
    }

    fn close(&self, pose: &Pose, unit_mm: f64) -> Segment {
        let (dx, dy) = (self.last_point.0 - self.first_point.0, self.last_point.1 - self.first_point.1);
        let beams = (self.last - self.first + 1) as f64;
        Segment {
            first: self.first as u16,
            last: self.last as u16,
            nearest: self.nearest,
            width: ((dx * dx + dy * dy).sqrt() / unit_mm).round() as u16,
            x_mm: (1000.0 * pose.x_m + self.sum.0 / beams).round() as i32,
            y_mm: (1000.0 * pose.y_m + self.sum.1 / beams).round() as i32,
        }
    }
}
