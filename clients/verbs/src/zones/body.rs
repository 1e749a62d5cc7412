//! Decides which readings of a sensor are the robot's own body: what stays within a circle around the robot's centre
//! during the whole observation. Scans in, sectors out; refuses to know where scans come from and how sectors are
//! written.
//!
//! The observation is divided into slices of time. What is seen in all slices at about the same range is body; what is
//! seen in only some of them came and went, and is left out.

use scanhub_schema::{Pose, Scan, in_degrees, in_sector_mdeg};

/// Slices of the time.
pub(crate) const SLICES: usize = 10;
/// The most sectors that a hub takes.
const SECTORS: usize = 64;
/// The greatest range of a sector that a hub takes.
const FARTHEST_MM: u32 = 65_000;
/// So much farther than it was met a reading still counts as the body: five standard deviations of 7 mm, which is the most
/// that recordings of standing sensors show, and the 15 mm by which two devices differ.
const MARGIN_MM: u32 = 50;
/// The same where the body hides all that is behind it, so that nothing is missed by looking less far: four standard
/// deviations of the 60 mm by which a reading in a hundred is off, which would be a stop every few seconds.
const BEHIND_MM: u32 = 250;
/// A beam of whose readings so large a share are of the body sees nothing behind it.
const FULL: f64 = 0.9;

/// A share of a slice's scans that a beam has to meet something in, so that one wrong reading is nothing.
const SHARE: f64 = 0.05;
/// A fifth of the slices may differ from the others: somebody may pass before or behind the body.
const PASSING: usize = 5;
/// How much the nearest readings of a body differ from slice to slice: noise and a robot that trembles. What is alive
/// moves more.
const STEADY_MM: u32 = 100;
/// So near to an edge, in degrees, a beam may tell something between the body and what is behind: half a spot of
/// 12 mm at 0.4 m.
const EDGE_DEG: f64 = 1.0;
/// Neighbouring beams whose ranges differ by less make one sector: what it hides more than needed is no wider than that.
const ALIKE_MM: u32 = 50;
/// Beams between two that moved, and belong together all the same.
const GAP_BEAMS: usize = 3;

/// What was seen so far.
pub(crate) struct Body {
    pose: Pose,
    within_mm: f64,
    /// Of the first scan; all others are to be alike.
    shape: Option<Shape>,
    scans: [u32; SLICES],
    beams: Vec<Beam>,
}

/// Count, first angle, step and unit of a scan.
type Shape = (u16, f64, f64, u32);

struct Beam {
    /// In the robot's frame.
    direction: (f64, f64),
    angle_mdeg: i32,
    /// Where it leaves the circle, and the margin; 0 if it never is inside.
    circle_mm: u32,
    /// Scans in which it met anything at all.
    valid: u32,
    slices: [Slice; SLICES],
}

/// What a beam met within the circle.
#[derive(Clone, Copy, Default)]
struct Slice {
    met: u32,
    nearest_mm: u32,
    farthest_mm: u32,
}

/// The body, and what was no body.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Mask {
    /// Readings nearer than `range_mm` are the body; in order, at most [`SECTORS`].
    pub(crate) sectors: Vec<Sector>,
    /// What moved, or came, or went: at `range_mm` where it was nearest.
    pub(crate) moving: Vec<Sector>,
    /// Beams of the scan.
    pub(crate) of_beams: usize,
}

/// Neighbouring beams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sector {
    /// Angle of the first beam in 1/1000 degree.
    pub(crate) from_mdeg: i32,
    /// Angle of the last one.
    pub(crate) to_mdeg: i32,
    /// How many there are.
    pub(crate) beams: usize,
    /// In mm.
    pub(crate) range_mm: u32,
}

impl Body {
    /// Nothing seen yet by a sensor at `pose`; what is nearer than `within_mm` to the robot's centre may be body.
    pub(crate) fn new(pose: Pose, within_mm: f64) -> Body {
        Body { pose, within_mm, shape: None, scans: [0; SLICES], beams: Vec::new() }
    }

    /// Looks at `scan`, which was made in slice `slice`; false if it is shaped otherwise than those before.
    pub(crate) fn look(&mut self, slice: usize, scan: &Scan) -> bool {
        let shape = (scan.count, scan.first_angle, scan.step, scan.unit_um);
        if *self.shape.get_or_insert(shape) != shape {
            return false;
        }
        if self.beams.is_empty() {
            self.beams =
                (0..scan.beams()).map(|i| self.beam(scan.first_angle + i as f64 * scan.step)).collect();
        }
        let slice = slice.min(SLICES - 1);
        self.scans[slice] += 1;
        let (x_mm, y_mm) = (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m);
        for (i, beam) in self.beams.iter_mut().enumerate() {
            let Some(range_mm) = scan.distance_mm(i) else { continue };
            beam.valid += 1;
            let (x, y) = beam.direction;
            let range = f64::from(range_mm);
            if (x_mm + range * x).hypot(y_mm + range * y) < self.within_mm {
                let met = &mut beam.slices[slice];
                met.nearest_mm = if met.met == 0 { range_mm } else { met.nearest_mm.min(range_mm) };
                met.farthest_mm = met.farthest_mm.max(range_mm);
                met.met += 1;
            }
        }
        true
    }

    /// Scans looked at.
    pub(crate) fn scans(&self) -> u32 {
        self.scans.iter().sum()
    }

    /// Slices of which there was a scan.
    pub(crate) fn seen_slices(&self) -> usize {
        self.scans.iter().filter(|&&scans| scans > 0).count()
    }

    /// What is to be concluded from all that was seen.
    pub(crate) fn mask(&self) -> Mask {
        let met: Vec<Met> = self.beams.iter().map(|beam| Met::of(beam, &self.scans)).collect();
        let slices = self.seen_slices();
        let is_body: Vec<bool> = met.iter().map(|met| met.is_body(slices)).collect();
        let edge =
            self.shape.map_or(1, |(_, _, step, _)| (EDGE_DEG / in_degrees(step.abs())).max(1.0) as usize);
        let range = |beam: usize| range_mm(&met, &is_body, beam, edge, slices).min(FARTHEST_MM);
        let ranges_mm: Vec<u32> = (0..met.len()).map(range).collect();
        let moving_mm: Vec<u32> = met.iter().zip(&ranges_mm).map(|(met, range)| met.beyond(*range)).collect();
        Mask {
            sectors: self.sectors(join(runs(&ranges_mm, 0, ALIKE_MM)), |run| run.most_mm),
            moving: self.sectors(runs(&moving_mm, GAP_BEAMS, u32::MAX), |run| run.least_mm),
            of_beams: self.beams.len(),
        }
    }

    fn beam(&self, angle: f64) -> Beam {
        let direction = self.pose.direction(angle);
        let angle_mdeg = in_sector_mdeg(angle);
        let (x_mm, y_mm) = (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m);
        // The greater root of |sensor + range * direction| = circle; none is not a number, and so becomes 0.
        let along = x_mm * direction.0 + y_mm * direction.1;
        let across = self.within_mm.powi(2) - (x_mm.powi(2) + y_mm.powi(2) - along.powi(2));
        let leaves = (across.sqrt() - along).ceil() as u32;
        let circle_mm = if leaves > 0 { leaves + MARGIN_MM } else { 0 };
        Beam { direction, angle_mdeg, circle_mm, valid: 0, slices: Default::default() }
    }

    fn sectors(&self, runs: Vec<Run>, range_mm: impl Fn(&Run) -> u32) -> Vec<Sector> {
        // The lesser angle first, whichever way the beams turn; what goes across 180 degrees is two sectors.
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

/// What one beam met in the slices in which it met something often enough; both from the least on.
struct Met {
    /// It sees nothing behind what it met.
    is_full: bool,
    circle_mm: u32,
    nearest_mm: Vec<u32>,
    farthest_mm: Vec<u32>,
}

impl Met {
    fn of(beam: &Beam, scans: &[u32; SLICES]) -> Met {
        let enough = |scans: u32| ((f64::from(scans) * SHARE).ceil() as u32).max(1);
        let met: Vec<&Slice> = beam
            .slices
            .iter()
            .zip(scans)
            .filter_map(|(slice, scans)| (slice.met >= enough(*scans)).then_some(slice))
            .collect();
        let sorted = |range_mm: fn(&Slice) -> u32| {
            let mut ranges: Vec<u32> = met.iter().map(|slice| range_mm(slice)).collect();
            ranges.sort_unstable();
            ranges
        };
        Met {
            is_full: f64::from(met.iter().map(|slice| slice.met).sum::<u32>())
                >= FULL * f64::from(beam.valid),
            circle_mm: beam.circle_mm,
            nearest_mm: sorted(|slice| slice.nearest_mm),
            farthest_mm: sorted(|slice| slice.farthest_mm),
        }
    }

    fn slices(&self) -> usize {
        self.nearest_mm.len()
    }

    /// Something is met in all of `slices`, and stays where it is.
    fn is_body(&self, slices: usize) -> bool {
        if self.slices() < slices {
            return false;
        }
        let passing = slices / PASSING;
        let (near, far) = (self.nearest_mm.get(passing), self.nearest_mm.iter().nth_back(passing));
        near.zip(far).is_some_and(|(near, far)| far.saturating_sub(*near) <= STEADY_MM)
    }

    /// Readings nearer than this are the body that is met, but for what passes behind its edge.
    fn reach_mm(&self, slices: usize) -> u32 {
        let reach = self.farthest_mm.iter().nth_back(slices / PASSING).copied().unwrap_or_default();
        reach + if self.is_full { BEHIND_MM } else { MARGIN_MM }
    }

    /// The nearest that was met at `range_mm` or farther; 0 if nothing was.
    fn beyond(&self, range_mm: u32) -> u32 {
        self.nearest_mm.iter().copied().find(|&nearest| nearest >= range_mm).unwrap_or_default()
    }
}

/// Readings of `beam` nearer than this are the body; 0 if none are. At an edge of the body, `edge` beams to either side, all
/// that is within the circle may be: spots are wider than beams, robots tremble, and what is told lies anywhere between
/// the body and what is behind. What is lost by that is a strip that no leg fits into.
fn range_mm(met: &[Met], is_body: &[bool], beam: usize, edge: usize, slices: usize) -> u32 {
    let near = |distance: usize| {
        let (first, last) = (beam.saturating_sub(distance), beam.saturating_add(distance).min(met.len() - 1));
        &is_body[first..=last]
    };
    match &met[beam] {
        edge_of_it if is_body[beam] && near(edge).contains(&false) => edge_of_it.circle_mm,
        within if is_body[beam] => within.reach_mm(slices),
        beside if near(1).contains(&true) => beside.circle_mm,
        beside if near(edge).contains(&true) && beside.slices() > slices / PASSING => beside.circle_mm,
        _ => 0,
    }
}

/// Neighbouring beams, and between which values theirs are.
#[derive(Clone, Copy)]
struct Run {
    first: usize,
    last: usize,
    least_mm: u32,
    most_mm: u32,
}

impl Run {
    fn beams(&self) -> usize {
        self.last - self.first + 1
    }

    fn and(self, other: Run) -> Run {
        Run {
            first: self.first.min(other.first),
            last: self.last.max(other.last),
            least_mm: self.least_mm.min(other.least_mm),
            most_mm: self.most_mm.max(other.most_mm),
        }
    }

    /// What it hides.
    fn area(&self) -> u64 {
        self.beams() as u64 * u64::from(self.most_mm)
    }
}

/// Beams whose value is not 0 as runs, in which at most `gap` beams without one lie between two, and no two values
/// differ by more than `alike_mm`.
fn runs(values_mm: &[u32], gap: usize, alike_mm: u32) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    for (beam, &value) in values_mm.iter().enumerate().filter(|(_, value)| **value > 0) {
        let one = Run { first: beam, last: beam, least_mm: value, most_mm: value };
        match runs.last_mut() {
            Some(run)
                if beam - run.last <= gap + 1 && run.and(one).most_mm - run.and(one).least_mm <= alike_mm =>
            {
                *run = run.and(one);
            }
            _ => runs.push(one),
        }
    }
    runs
}

/// Joins neighbours until a hub takes them, first those that hide the least more by it.
fn join(mut runs: Vec<Run>) -> Vec<Run> {
    while runs.len() > SECTORS {
        let more = |at: &usize| {
            let (one, next) = (runs[*at], runs[at + 1]);
            one.and(next).area() - one.area() - next.area()
        };
        let Some(at) = (0..runs.len() - 1).min_by_key(more) else { break };
        let next = runs.remove(at + 1);
        runs[at] = runs[at].and(next);
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

    /// What a sensor at the robot's centre makes of scans whose beams are `range_mm(beam, slice, scan of the slice)`.
    fn mask(range_mm: impl Fn(usize, usize, usize) -> Option<u16>) -> Mask {
        learn(Pose::default(), 1000.0, range_mm)
    }

    fn learn(pose: Pose, within_mm: f64, range_mm: impl Fn(usize, usize, usize) -> Option<u16>) -> Mask {
        let mut body = Body::new(pose, within_mm);
        let mut scan = Scan::of(ScanHead::lms(COUNT, angle_mdeg(0), 500, 1, 13), &[0; COUNT]);
        let code = scan.no_return;
        for slice in 0..SLICES {
            for number in 0..SCANS {
                for beam in 0..COUNT {
                    scan.arrays().ranges[beam] = range_mm(beam, slice, number).unwrap_or(code);
                }
                assert!(body.look(slice, &scan));
            }
        }
        assert_eq!((body.scans(), body.seen_slices()), ((SLICES * SCANS) as u32, SLICES));
        body.mask()
    }

    fn sector(first: usize, last: usize, range_mm: u32) -> Sector {
        Sector { from_mdeg: angle_mdeg(first), to_mdeg: angle_mdeg(last), beams: last - first + 1, range_mm }
    }

    /// Half degrees, of which beam 180 looks ahead.
    fn angle_mdeg(beam: usize) -> i32 {
        beam as i32 * 500 - 90_000
    }

    /// A body from beam `first` to `last`, as far as `range_mm`, in a circle of a metre: two beams of it and one beside it are
    /// its edge.
    fn hidden(first: usize, last: usize, range_mm: u32) -> Vec<Sector> {
        let edge = |from: usize| sector(from, from + 2, 1050);
        vec![edge(first - 1), sector(first + 2, last - 2, range_mm), edge(last - 1)]
    }

    /// Noise of a few mm, the same in every run.
    fn noise(beam: usize, slice: usize, scan: usize) -> u16 {
        ((beam * 31 + slice * 17 + scan * 7) % 11) as u16
    }

    #[test]
    fn a_post_is_body_with_a_beam_beside_it_on_either_side() {
        let post = |beam, slice, scan| match beam {
            60..=67 => Some(400 + noise(beam, slice, scan)),
            _ => Some(WALL_MM),
        };
        // As far as it was met, and a good deal of what it hides; the beams beside it as far as it matters.
        assert_eq!(mask(post), Mask { sectors: hidden(60, 67, 660), moving: vec![], of_beams: COUNT });
    }

    #[test]
    fn nothing_there_is_an_empty_list() {
        let nothing = Mask { of_beams: COUNT, ..Mask::default() };
        assert_eq!(mask(|_, _, _| Some(WALL_MM)), nothing);
        assert_eq!(mask(|_, _, _| None), nothing);
        assert_eq!(Body::new(Pose::default(), 1000.0).mask(), Mask::default(), "not a scan");
    }

    #[test]
    fn what_comes_and_goes_is_left_out_and_named() {
        // Somebody walks past in six slices, ten beams further in each, while a post stands there.
        let found = mask(|beam, slice, scan| match beam {
            60..=67 => Some(400 + noise(beam, slice, scan)),
            _ if (2..8).contains(&slice) && (100 + 10 * slice..115 + 10 * slice).contains(&beam) => Some(700),
            _ => Some(WALL_MM),
        });
        assert_eq!((found.sectors, found.moving), (hidden(60, 67, 660), vec![sector(120, 184, 700)]));
    }

    #[test]
    fn who_walks_up_and_down_all_the_time_is_no_body() {
        let found = mask(|beam, slice, _| match beam {
            100..=130 => Some(400 + 50 * slice as u16),
            _ => Some(WALL_MM),
        });
        assert_eq!((found.sectors, found.moving), (vec![], vec![sector(100, 130, 400)]));
    }

    #[test]
    fn who_passes_before_a_body_neither_widens_nor_hides_it() {
        let found = mask(|beam, slice, _| match beam {
            90..=150 if slice == 4 => Some(250),
            100..=110 => Some(500),
            _ => Some(WALL_MM),
        });
        assert_eq!(found.sectors, hidden(100, 110, 750));
        assert_eq!(found.moving, [sector(90, 98, 250), sector(112, 150, 250)]);
    }

    #[test]
    fn an_edge_that_is_met_by_turns_hides_what_lies_between() {
        // Beams 68 and 70 meet body, wall and what lies between by turns; the second one is too far from the body for that.
        let found = mask(|beam, slice, scan| match beam {
            60..=67 => Some(400),
            68 | 70 if scan % 8 == 0 && slice < 6 => Some(450 + 50 * (scan as u16 / 4)),
            _ => Some(WALL_MM),
        });
        assert_eq!(found.sectors, hidden(60, 67, 650));
        assert_eq!(found.moving, [sector(70, 70, 450)]);
    }

    #[test]
    fn a_cable_is_body_although_it_is_met_seldom_and_never_at_one_range() {
        // It is met in six of forty scans, and each time somewhere else.
        let found = mask(|beam, slice, scan| match beam {
            200..=202 if scan % 7 == slice % 7 => Some(300 + ((slice * 97 + scan * 41) % 400) as u16),
            _ => Some(WALL_MM),
        });
        assert_eq!((found.sectors.len(), found.moving.len()), (1, 0), "{found:?}");
        assert_eq!((found.sectors[0].from_mdeg, found.sectors[0].to_mdeg), (9_500, 11_500));
    }

    #[test]
    fn single_wrong_readings_are_nothing() {
        let wrong = |one: usize| {
            mask(move |beam, slice, scan| match beam {
                7 if slice == 2 && (scan == 3 || scan == one) => Some(100),
                _ => Some(WALL_MM),
            })
        };
        assert_eq!(wrong(3), Mask { of_beams: COUNT, ..Mask::default() });
        // Twice in a slice is something; not a body.
        assert_eq!(wrong(30), Mask { moving: vec![sector(7, 7, 100)], of_beams: COUNT, ..Mask::default() });
    }

    #[test]
    fn the_circle_is_around_the_robot_wherever_the_sensor_sits() {
        // 0.8 m ahead of the centre and looking back: what is 1.7 m off is 0.9 m behind the centre.
        let pose = Pose { x_m: 0.8, yaw_rad: std::f64::consts::PI, ..Pose::default() };
        let wall = |range_mm: u16| move |beam, _, _| if beam == 180 { Some(range_mm) } else { None };
        assert_eq!(learn(pose, 1000.0, wall(1700)).sectors, [sector(179, 181, 1850)]);
        assert_eq!(learn(pose, 1000.0, wall(1801)).sectors, []);
        assert_eq!(learn(pose, 1000.0, wall(1800)).sectors, [], "on the circle is outside");
        // As large a circle as there is: no range is beyond what a hub takes.
        assert_eq!(learn(Pose::default(), 65_000.0, wall(1800)).sectors, [sector(179, 181, FARTHEST_MM)]);
    }

    #[test]
    fn a_slope_becomes_steps_and_a_fence_no_more_than_a_hub_takes() {
        let slope = mask(|beam, _, _| if beam < 100 { Some(200 + 5 * beam as u16) } else { Some(WALL_MM) });
        assert_eq!(slope.sectors.len(), 10, "nine steps, and the edge");
        for pair in slope.sectors[..9].windows(2) {
            assert!(
                pair[0].to_mdeg < pair[1].from_mdeg && pair[1].range_mm - pair[0].range_mm <= 2 * ALIKE_MM
            );
        }
        let fence = mask(|beam, _, _| if beam % 4 == 0 { Some(300 + beam as u16) } else { Some(WALL_MM) });
        assert_eq!(fence.sectors.len(), SECTORS);
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
    fn a_sensor_that_is_set_otherwise_meanwhile_is_noticed() {
        let mut body = Body::new(Pose::default(), 1000.0);
        let scan =
            |count, unit_mm| Scan::of(ScanHead::lms(count, -90_000, 1000, unit_mm, 13), &vec![0; count]);
        assert!(body.look(0, &scan(181, 1)) && !body.look(0, &scan(181, 10)));
        assert!(!body.look(0, &scan(180, 1)) && body.look(SLICES, &scan(181, 1)));
    }

    #[test]
    fn a_scan_of_impossible_angles_does_no_harm() {
        for (first_angle, step) in [(1e300, 0.5), (0.0, 0.0), (-1e300, -1e-300)] {
            let mut body = Body::new(Pose::default(), 1000.0);
            let head = ScanHead { first_angle, step, ..ScanHead::lms(3, 0, 1000, 1, 13) };
            for slice in 0..SLICES {
                assert!(body.look(slice, &Scan::of(head, &[400, 8191, 5000])));
            }
            assert_eq!(body.mask().of_beams, 3);
        }
    }

    #[test]
    fn a_head_that_turns_clockwise_has_sectors_from_the_lesser_angle_on() {
        let mut body = Body::new(Pose::default(), 1000.0);
        let mut scan = Scan::of(ScanHead::turning(scanhub_schema::Family::Ld, 360), &[WALL_MM; 360]);
        // A post on the right, and one behind, across 180 degrees.
        scan.arrays().ranges[85..=95].fill(400);
        scan.arrays().ranges[175..=185].fill(400);
        for slice in 0..SLICES {
            (0..SCANS).for_each(|_| assert!(body.look(slice, &scan)));
        }
        let sectors = body.mask().sectors;
        let seen: Vec<_> =
            sectors.iter().map(|sector| (sector.from_mdeg / 1000, sector.to_mdeg / 1000)).collect();
        assert!(seen.iter().all(|(from, to)| from <= to && to - from <= 12), "{seen:?}");
        for angle in [-95, -90, -85, -175, -180, 179, 175] {
            assert!(seen.iter().any(|(from, to)| (*from..=*to).contains(&angle)), "{angle}: {seen:?}");
        }
        assert!(!seen.iter().any(|(from, to)| (*from..=*to).contains(&0)), "{seen:?}");
    }
}
