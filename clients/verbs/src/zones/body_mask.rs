//! Computes which readings of a sensor are the robot's own body. The result is sectors with a range. The body consists
//! of the objects that stay within a circle around the robot's center during the whole observation.
//!
//! The observation is divided into time slices. If a beam meets an object in all slices at about the same range, the
//! object is body. If a beam meets an object only in some slices, the object is not body.

use scanhub_schema::{Pose, Scan, in_degrees, in_sector_mdeg};

/// Number of time slices.
pub(crate) const SLICE_COUNT: usize = 10;
/// Maximum number of sectors that a hub accepts.
const MAX_SECTORS: usize = 64;
/// Maximum range of a sector that a hub accepts, in mm.
const MAX_RANGE_MM: u32 = 65_000;
/// Margin beyond the farthest reading of the body, in mm. Readings in this margin still count as body. It is five times
/// the standard deviation of 7 mm, plus 15 mm. 7 mm is the maximum in recordings of stationary sensors, and 15 mm is
/// the difference between two devices.
const MARGIN_MM: u32 = 50;
/// Margin in mm for a beam that meets only the body. It can be large, because the beam sees nothing else that the mask
/// could hide. One reading in a hundred is off by 60 mm. With a smaller margin, these readings would cause a stop every
/// few seconds. The margin is four standard deviations of 60 mm.
const HIDDEN_MARGIN_MM: u32 = 250;
/// Minimum share of body readings in the scans of a beam for which the beam counts as meeting only the body.
const FULL_SHARE: f64 = 0.9;

/// Minimum share of a slice's scans in which a beam must meet an object for the object to count. A single wrong reading
/// therefore has no effect.
const MIN_HIT_SHARE: f64 = 0.05;
/// Divisor of the number of slices. This part of the slices may differ from the others, because a person may walk past
/// the body.
const PASSING_DIVISOR: usize = 5;
/// Maximum difference between the nearest readings of the body in different slices, in mm. Noise and vibration of the
/// robot cause this difference. A person moves more.
const MAX_STEADY_DIFFERENCE_MM: u32 = 100;
/// Maximum angle between a beam and an edge of the body at which the beam may measure any range between the body and
/// the object behind it, in degrees. It corresponds to half of a light spot of 12 mm at a range of 0.4 m.
const EDGE_DEG: f64 = 1.0;
/// Maximum difference between the ranges of neighboring beams in a sector, in mm. A sector hides at most this much more
/// than necessary.
const MAX_SECTOR_DIFFERENCE_MM: u32 = 50;
/// Maximum number of beams without motion between two beams with motion in the same sector.
const MAX_GAP_BEAMS: usize = 3;

/// Observation of a sensor. The mask is computed from it.
pub(crate) struct Body {
    pose: Pose,
    within_mm: f64,
    /// Shape of the first scan. All other scans must have the same shape.
    shape: Option<Shape>,
    /// Number of scans in each slice.
    scans: [u32; SLICE_COUNT],
    beams: Vec<Beam>,
}

/// Number of beams, first angle, angle between two beams, and unit of a scan.
type Shape = (u16, f64, f64, u32);

struct Beam {
    /// Unit vector of the beam in the robot's frame.
    direction: (f64, f64),
    angle_mdeg: i32,
    /// Range in mm at which the beam leaves the circle, plus the margin; 0 if the beam is never inside the circle.
    circle_mm: u32,
    /// Number of scans with a reading.
    valid: u32,
    slices: [Slice; SLICE_COUNT],
}

/// Readings of a beam within the circle in one slice.
#[derive(Clone, Copy, Default)]
struct Slice {
    count: u32,
    nearest_mm: u32,
    farthest_mm: u32,
}

/// Result of an observation: the body, and other objects in the circle.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Mask {
    /// Sectors in which readings below `range_mm` are the body, in the order of the beams. There are at most
    /// [`MAX_SECTORS`].
    pub(crate) sectors: Vec<Sector>,
    /// Sectors of objects that moved, appeared or disappeared, with the shortest range of each object.
    pub(crate) moving: Vec<Sector>,
    /// Number of beams in a scan.
    pub(crate) of_beams: usize,
}

/// A group of neighboring beams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sector {
    /// Angle of the first beam in 1/1000 degree.
    pub(crate) from_mdeg: i32,
    /// Angle of the last beam in 1/1000 degree.
    pub(crate) to_mdeg: i32,
    /// Number of beams.
    pub(crate) beams: usize,
    /// Range of the sector in mm.
    pub(crate) range_mm: u32,
}

impl Body {
    /// Creates the observation of a sensor at `pose`. Only objects within `within_mm` of the robot's center can be
    /// body.
    pub(crate) fn new(pose: Pose, within_mm: f64) -> Body {
        Body { pose, within_mm, shape: None, scans: [0; SLICE_COUNT], beams: Vec::new() }
    }

    /// Adds `scan`, which belongs to `slice`. Returns false if it has another shape than earlier scans.
    pub(crate) fn add(&mut self, slice: usize, scan: &Scan) -> bool {
        let shape = (scan.count, scan.first_angle, scan.step, scan.unit_um);
        if *self.shape.get_or_insert(shape) != shape {
            return false;
        }
        if self.beams.is_empty() {
            self.beams =
                (0..scan.beams()).map(|i| self.beam(scan.first_angle + i as f64 * scan.step)).collect();
        }
        let slice = slice.min(SLICE_COUNT - 1);
        self.scans[slice] += 1;
        let (x_mm, y_mm) = (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m);
        for (i, beam) in self.beams.iter_mut().enumerate() {
            let Some(range_mm) = scan.distance_mm(i) else { continue };
            beam.valid += 1;
            let (x, y) = beam.direction;
            let range = f64::from(range_mm);
            if (x_mm + range * x).hypot(y_mm + range * y) < self.within_mm {
                let readings = &mut beam.slices[slice];
                readings.nearest_mm =
                    if readings.count == 0 { range_mm } else { readings.nearest_mm.min(range_mm) };
                readings.farthest_mm = readings.farthest_mm.max(range_mm);
                readings.count += 1;
            }
        }
        true
    }

    /// Returns the number of scans in all slices.
    pub(crate) fn scans(&self) -> u32 {
        self.scans.iter().sum()
    }

    /// Returns the number of slices that have a scan.
    pub(crate) fn slice_count(&self) -> usize {
        self.scans.iter().filter(|&&scans| scans > 0).count()
    }

    /// Computes the mask from all scans.
    pub(crate) fn mask(&self) -> Mask {
        let hits: Vec<FrequentHits> =
            self.beams.iter().map(|beam| FrequentHits::of(beam, &self.scans)).collect();
        let slices = self.slice_count();
        let is_body: Vec<bool> = hits.iter().map(|hits| hits.is_body(slices)).collect();
        let edge =
            self.shape.map_or(1, |(_, _, step, _)| (EDGE_DEG / in_degrees(step.abs())).max(1.0) as usize);
        let range = |beam: usize| range_mm(&hits, &is_body, beam, edge, slices).min(MAX_RANGE_MM);
        let ranges_mm: Vec<u32> = (0..hits.len()).map(range).collect();
        let moving_mm: Vec<u32> =
            hits.iter().zip(&ranges_mm).map(|(hits, range)| hits.beyond(*range)).collect();
        Mask {
            sectors: self.sectors(join(runs(&ranges_mm, 0, MAX_SECTOR_DIFFERENCE_MM)), |run| run.max_mm),
            moving: self.sectors(runs(&moving_mm, MAX_GAP_BEAMS, u32::MAX), |run| run.min_mm),
            of_beams: self.beams.len(),
        }
    }

    fn beam(&self, angle: f64) -> Beam {
        let direction = self.pose.direction(angle);
        let angle_mdeg = in_sector_mdeg(angle);
        let (x_mm, y_mm) = (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m);
        // The greater root of |sensor + range * direction| = circle. If there is no root, the result is NaN, which
        // becomes 0.
        let along = x_mm * direction.0 + y_mm * direction.1;
        let across = self.within_mm.powi(2) - (x_mm.powi(2) + y_mm.powi(2) - along.powi(2));
        let leaves = (across.sqrt() - along).ceil() as u32;
        let circle_mm = if leaves > 0 { leaves + MARGIN_MM } else { 0 };
        Beam { direction, angle_mdeg, circle_mm, valid: 0, slices: Default::default() }
    }

    fn sectors(&self, runs: Vec<Run>, range_mm: impl Fn(&Run) -> u32) -> Vec<Sector> {
        // The lower angle comes first in both directions of rotation. A run across 180 degrees becomes two sectors.
        let is_clockwise = self.shape.is_some_and(|(_, _, step, _)| step < 0.0);
        let mut sectors: Vec<Sector> = Vec::new();
        for run in &runs {
            let beams = &self.beams[run.first..=run.last];
            for beams in beams.chunk_by(|a, b| (a.angle_mdeg > b.angle_mdeg) == is_clockwise) {
                let (first, last) = (beams[0].angle_mdeg, beams[beams.len() - 1].angle_mdeg);
                let (from_mdeg, to_mdeg) = (first.min(last), first.max(last));
                sectors.push(Sector { from_mdeg, to_mdeg, beams: beams.len(), range_mm: range_mm(run) });
            }
        }
        sectors
    }
}

/// Ranges of a beam in the slices in which the beam met an object often enough. The list of each slice is in ascending
/// order.
struct FrequentHits {
    /// Whether the beam meets only the body.
    is_full: bool,
    circle_mm: u32,
    nearest_mm: Vec<u32>,
    farthest_mm: Vec<u32>,
}

impl FrequentHits {
    fn of(beam: &Beam, scans: &[u32; SLICE_COUNT]) -> FrequentHits {
        let enough = |scans: u32| ((f64::from(scans) * MIN_HIT_SHARE).ceil() as u32).max(1);
        let readings: Vec<&Slice> = beam
            .slices
            .iter()
            .zip(scans)
            .filter_map(|(slice, scans)| (slice.count >= enough(*scans)).then_some(slice))
            .collect();
        let sorted = |range_mm: fn(&Slice) -> u32| {
            let mut ranges: Vec<u32> = readings.iter().map(|slice| range_mm(slice)).collect();
            ranges.sort_unstable();
            ranges
        };
        FrequentHits {
            is_full: f64::from(readings.iter().map(|slice| slice.count).sum::<u32>())
                >= FULL_SHARE * f64::from(beam.valid),
            circle_mm: beam.circle_mm,
            nearest_mm: sorted(|slice| slice.nearest_mm),
            farthest_mm: sorted(|slice| slice.farthest_mm),
        }
    }

    fn slices(&self) -> usize {
        self.nearest_mm.len()
    }

    /// Returns whether the beam met an object in each of `slices` at about the same range.
    fn is_body(&self, slices: usize) -> bool {
        if self.slices() < slices {
            return false;
        }
        let passing = slices / PASSING_DIVISOR;
        let (near, far) = (self.nearest_mm.get(passing), self.nearest_mm.iter().nth_back(passing));
        near.zip(far).is_some_and(|(near, far)| far.saturating_sub(*near) <= MAX_STEADY_DIFFERENCE_MM)
    }

    /// Returns the range in mm below which readings are the body.
    fn reach_mm(&self, slices: usize) -> u32 {
        let reach = self.farthest_mm.iter().nth_back(slices / PASSING_DIVISOR).copied().unwrap_or_default();
        reach + if self.is_full { HIDDEN_MARGIN_MM } else { MARGIN_MM }
    }

    /// Returns the nearest reading at `range_mm` or beyond; 0 if there is none.
    fn beyond(&self, range_mm: u32) -> u32 {
        self.nearest_mm.iter().copied().find(|&nearest| nearest >= range_mm).unwrap_or_default()
    }
}

/// Returns the range in mm below which readings of `beam` are the body; 0 if no reading is the body.
///
/// Within `edge` beams of an edge of the body, every reading in the circle may be body. Light spots are wider than the
/// angle between beams, and robots vibrate, so a range near an edge may lie anywhere between the body and a farther
/// object. The strip that is hidden near an edge is too narrow for a leg.
fn range_mm(hits: &[FrequentHits], is_body: &[bool], beam: usize, edge: usize, slices: usize) -> u32 {
    let near = |distance: usize| {
        let (first, last) =
            (beam.saturating_sub(distance), beam.saturating_add(distance).min(hits.len() - 1));
        &is_body[first..=last]
    };
    match &hits[beam] {
        at_edge if is_body[beam] && near(edge).contains(&false) => at_edge.circle_mm,
        inside if is_body[beam] => inside.reach_mm(slices),
        outside if near(1).contains(&true) => outside.circle_mm,
        outside if near(edge).contains(&true) && outside.slices() > slices / PASSING_DIVISOR => {
            outside.circle_mm
        }
        _ => 0,
    }
}

/// A group of neighboring beams, with the minimum and the maximum of their values.
#[derive(Clone, Copy)]
struct Run {
    first: usize,
    last: usize,
    min_mm: u32,
    max_mm: u32,
}

impl Run {
    fn beams(&self) -> usize {
        self.last - self.first + 1
    }

    /// Returns the run from the first beam of both runs to the last one.
    fn union(self, other: Run) -> Run {
        Run {
            first: self.first.min(other.first),
            last: self.last.max(other.last),
            min_mm: self.min_mm.min(other.min_mm),
            max_mm: self.max_mm.max(other.max_mm),
        }
    }

    /// Returns the area that the run hides, in beams times mm.
    fn area(&self) -> u64 {
        self.beams() as u64 * u64::from(self.max_mm)
    }
}

/// Groups beams whose value is not 0 into runs. Between two beams of a run, at most `gap` beams have no value. The
/// values of a run differ by at most `alike_mm`.
fn runs(values_mm: &[u32], gap: usize, alike_mm: u32) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    for (beam, &value) in values_mm.iter().enumerate().filter(|(_, value)| **value > 0) {
        let one = Run { first: beam, last: beam, min_mm: value, max_mm: value };
        match runs.last_mut() {
            Some(run)
                if beam - run.last <= gap + 1
                    && run.union(one).max_mm - run.union(one).min_mm <= alike_mm =>
            {
                *run = run.union(one);
            }
            _ => runs.push(one),
        }
    }
    runs
}

/// Joins neighboring runs until the hub accepts their number. First joins the runs whose union adds the smallest hidden
/// area.
fn join(mut runs: Vec<Run>) -> Vec<Run> {
    while runs.len() > MAX_SECTORS {
        let more = |at: &usize| {
            let (one, next) = (runs[*at], runs[at + 1]);
            one.union(next).area() - one.area() - next.area()
        };
        let Some(at) = (0..runs.len() - 1).min_by_key(more) else { break };
        let next = runs.remove(at + 1);
        runs[at] = runs[at].union(next);
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::ScanHead;

    const COUNT: usize = 361;
    const WALL_MM: u16 = 5000;
    const SCANS: usize = 40;

    /// Returns the mask of a sensor at the robot's center. `range_mm` takes the beam, the slice, and the scan within
    /// the slice, and returns the range.
    fn mask(range_mm: impl Fn(usize, usize, usize) -> Option<u16>) -> Mask {
        learn(Pose::default(), 1000.0, range_mm)
    }

    fn learn(pose: Pose, within_mm: f64, range_mm: impl Fn(usize, usize, usize) -> Option<u16>) -> Mask {
        let mut body = Body::new(pose, within_mm);
        let mut scan = Scan::of(ScanHead::lms(COUNT, angle_mdeg(0), 500, 1, 13), &[0; COUNT]);
        let code = scan.no_return;
        for slice in 0..SLICE_COUNT {
            for index in 0..SCANS {
                for beam in 0..COUNT {
                    scan.arrays().ranges[beam] = range_mm(beam, slice, index).unwrap_or(code);
                }
                assert!(body.add(slice, &scan));
            }
        }
        assert_eq!((body.scans(), body.slice_count()), ((SLICE_COUNT * SCANS) as u32, SLICE_COUNT));
        body.mask()
    }

    fn sector(first: usize, last: usize, range_mm: u32) -> Sector {
        Sector { from_mdeg: angle_mdeg(first), to_mdeg: angle_mdeg(last), beams: last - first + 1, range_mm }
    }

    /// Returns the angle of a beam. Beams are half a degree apart, and beam 180 points ahead.
    fn angle_mdeg(beam: usize) -> i32 {
        beam as i32 * 500 - 90_000
    }

    /// Returns the sectors of a body from beam `first` to `last`, up to `range_mm`, in a circle of one meter. On each
    /// side, the edge consists of two beams of the body and the next beam.
    fn body_sectors(first: usize, last: usize, range_mm: u32) -> Vec<Sector> {
        let edge = |from: usize| sector(from, from + 2, 1050);
        vec![edge(first - 1), sector(first + 2, last - 2, range_mm), edge(last - 1)]
    }

    /// Returns reproducible noise of a few mm.
    fn noise(beam: usize, slice: usize, scan: usize) -> u16 {
        ((beam * 31 + slice * 17 + scan * 7) % 11) as u16
    }

    #[test]
    fn post_is_body_with_one_more_beam_on_each_side() {
        let post = |beam, slice, scan| match beam {
            60..=67 => Some(400 + noise(beam, slice, scan)),
            _ => Some(WALL_MM),
        };
        // For beams on the post, the mask has the large margin. For beams next to the post, the mask extends to the
        // circle.
        assert_eq!(mask(post), Mask { sectors: body_sectors(60, 67, 660), moving: vec![], of_beams: COUNT });
    }

    #[test]
    fn mask_without_body_is_empty() {
        let nothing = Mask { of_beams: COUNT, ..Mask::default() };
        assert_eq!(mask(|_, _, _| Some(WALL_MM)), nothing);
        assert_eq!(mask(|_, _, _| None), nothing);
        assert_eq!(Body::new(Pose::default(), 1000.0).mask(), Mask::default(), "no scan");
    }

    #[test]
    fn moving_object_is_reported_and_is_not_body() {
        // A person walks past a post in six slices. In each slice, the person is ten beams farther.
        let found = mask(|beam, slice, scan| match beam {
            60..=67 => Some(400 + noise(beam, slice, scan)),
            _ if (2..8).contains(&slice) && (100 + 10 * slice..115 + 10 * slice).contains(&beam) => Some(700),
            _ => Some(WALL_MM),
        });
        assert_eq!((found.sectors, found.moving), (body_sectors(60, 67, 660), vec![sector(120, 184, 700)]));
    }

    #[test]
    fn walking_person_is_not_body() {
        let found = mask(|beam, slice, _| match beam {
            100..=130 => Some(400 + 50 * slice as u16),
            _ => Some(WALL_MM),
        });
        assert_eq!((found.sectors, found.moving), (vec![], vec![sector(100, 130, 400)]));
    }

    #[test]
    fn person_in_front_of_body_does_not_change_the_mask() {
        let found = mask(|beam, slice, _| match beam {
            90..=150 if slice == 4 => Some(250),
            100..=110 => Some(500),
            _ => Some(WALL_MM),
        });
        assert_eq!(found.sectors, body_sectors(100, 110, 750));
        assert_eq!(found.moving, [sector(90, 98, 250), sector(112, 150, 250)]);
    }

    #[test]
    fn edge_hides_ranges_between_body_and_wall() {
        // Beams 68 and 70 measure ranges between the body and the wall. Beam 70 is too far from the body to be its
        // edge.
        let found = mask(|beam, slice, scan| match beam {
            60..=67 => Some(400),
            68 | 70 if scan % 8 == 0 && slice < 6 => Some(450 + 50 * (scan as u16 / 4)),
            _ => Some(WALL_MM),
        });
        assert_eq!(found.sectors, body_sectors(60, 67, 650));
        assert_eq!(found.moving, [sector(70, 70, 450)]);
    }

    #[test]
    fn cable_with_rare_scattered_readings_is_body() {
        // Six of forty scans meet the cable, each at a different range.
        let found = mask(|beam, slice, scan| match beam {
            200..=202 if scan % 7 == slice % 7 => Some(300 + ((slice * 97 + scan * 41) % 400) as u16),
            _ => Some(WALL_MM),
        });
        assert_eq!((found.sectors.len(), found.moving.len()), (1, 0), "{found:?}");
        assert_eq!((found.sectors[0].from_mdeg, found.sectors[0].to_mdeg), (9_500, 11_500));
    }

    #[test]
    fn single_wrong_reading_has_no_effect() {
        let wrong = |one: usize| {
            mask(move |beam, slice, scan| match beam {
                7 if slice == 2 && (scan == 3 || scan == one) => Some(100),
                _ => Some(WALL_MM),
            })
        };
        assert_eq!(wrong(3), Mask { of_beams: COUNT, ..Mask::default() });
        // Two readings in a slice count as an object, but not as a body.
        assert_eq!(wrong(30), Mask { moving: vec![sector(7, 7, 100)], of_beams: COUNT, ..Mask::default() });
    }

    #[test]
    fn circle_is_centered_on_the_robot_not_the_sensor() {
        // The sensor is 0.8 m ahead of the center and points back, so a range of 1.7 m is 0.9 m behind the center.
        let pose = Pose { x_m: 0.8, yaw_rad: std::f64::consts::PI, ..Pose::default() };
        let wall = |range_mm: u16| move |beam, _, _| if beam == 180 { Some(range_mm) } else { None };
        assert_eq!(learn(pose, 1000.0, wall(1700)).sectors, [sector(179, 181, 1850)]);
        assert_eq!(learn(pose, 1000.0, wall(1801)).sectors, []);
        assert_eq!(learn(pose, 1000.0, wall(1800)).sectors, [], "a reading on the circle is outside");
        // With the largest circle, no range exceeds the limit of a hub.
        assert_eq!(learn(Pose::default(), 65_000.0, wall(1800)).sectors, [sector(179, 181, MAX_RANGE_MM)]);
    }

    #[test]
    fn slope_becomes_steps_and_fence_fills_all_sectors() {
        let slope = mask(|beam, _, _| if beam < 100 { Some(200 + 5 * beam as u16) } else { Some(WALL_MM) });
        assert_eq!(slope.sectors.len(), 10, "nine steps, and the edge");
        for pair in slope.sectors[..9].windows(2) {
            assert!(
                pair[0].to_mdeg < pair[1].from_mdeg
                    && pair[1].range_mm - pair[0].range_mm <= 2 * MAX_SECTOR_DIFFERENCE_MM
            );
        }
        let fence = mask(|beam, _, _| if beam % 4 == 0 { Some(300 + beam as u16) } else { Some(WALL_MM) });
        assert_eq!(fence.sectors.len(), MAX_SECTORS);
        let hidden = |beam: usize| {
            let of = |sector: &&Sector| (sector.from_mdeg..=sector.to_mdeg).contains(&angle_mdeg(beam));
            fence.sectors.iter().find(of).map_or(0, |sector| sector.range_mm)
        };
        assert!(
            (0..COUNT).step_by(4).all(|beam| hidden(beam) > 300 + beam as u32),
            "every post is still hidden"
        );
    }

    #[test]
    fn detects_scan_with_a_different_layout() {
        let mut body = Body::new(Pose::default(), 1000.0);
        let scan =
            |count, unit_mm| Scan::of(ScanHead::lms(count, -90_000, 1000, unit_mm, 13), &vec![0; count]);
        assert!(body.add(0, &scan(181, 1)) && !body.add(0, &scan(181, 10)));
        assert!(!body.add(0, &scan(180, 1)) && body.add(SLICE_COUNT, &scan(181, 1)));
    }

    #[test]
    fn accepts_scan_with_impossible_angles() {
        for (first_angle, step) in [(1e300, 0.5), (0.0, 0.0), (-1e300, -1e-300)] {
            let mut body = Body::new(Pose::default(), 1000.0);
            let head = ScanHead { first_angle, step, ..ScanHead::lms(3, 0, 1000, 1, 13) };
            for slice in 0..SLICE_COUNT {
                assert!(body.add(slice, &Scan::of(head, &[400, 8191, 5000])));
            }
            assert_eq!(body.mask().of_beams, 3);
        }
    }

    #[test]
    fn sectors_of_clockwise_scanner_begin_at_lower_angle() {
        let mut body = Body::new(Pose::default(), 1000.0);
        let mut scan = Scan::of(ScanHead::of_revolution(scanhub_schema::Family::Ld, 360), &[WALL_MM; 360]);
        // One post is on the right, and one behind the sensor, across 180 degrees.
        scan.arrays().ranges[85..=95].fill(400);
        scan.arrays().ranges[175..=185].fill(400);
        for slice in 0..SLICE_COUNT {
            (0..SCANS).for_each(|_| assert!(body.add(slice, &scan)));
        }
        let sectors = body.mask().sectors;
        let ranges_deg: Vec<_> =
            sectors.iter().map(|sector| (sector.from_mdeg / 1000, sector.to_mdeg / 1000)).collect();
        assert!(ranges_deg.iter().all(|(from, to)| from <= to && to - from <= 12), "{ranges_deg:?}");
        for angle in [-95, -90, -85, -175, -180, 179, 175] {
            assert!(
                ranges_deg.iter().any(|(from, to)| (*from..=*to).contains(&angle)),
                "{angle}: {ranges_deg:?}"
            );
        }
        assert!(!ranges_deg.iter().any(|(from, to)| (*from..=*to).contains(&0)), "{ranges_deg:?}");
    }
}
