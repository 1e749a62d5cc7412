//! Where the beams of a sensor cross the circles around the robot's centre. Computed once per beam layout, in floating
//! point and millimetres; used for every scan, in device units. Refuses to know verdicts.

use std::f64::consts::TAU;

use super::nearest::Nearest;
use super::spans::Spans;
use super::{SECTORS, Sector, Settings};
use schema::{Pose, Scan, ScanHead, ZONES, in_sector_mdeg};

/// What of a scan the table depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Layout {
    count: usize,
    unit_um: u32,
    valid_to: u16,
    no_return: u16,
    beyond: u16,
    first_angle: f64,
    step: f64,
}

impl Layout {
    /// That of `scan`, of which at most `most` beams are looked at.
    pub(super) fn of(scan: &Scan, most: usize) -> Layout {
        let ScanHead { unit_um, valid_to, no_return, beyond, first_angle, step, .. } = **scan;
        let count = scan.beams().min(most);
        Layout { count, unit_um, valid_to, no_return, beyond, first_angle, step }
    }

    /// Whether scans of so many beams and this unit are of it.
    pub(super) fn is_of(&self, count: usize, unit_um: u32) -> bool {
        (self.count, self.unit_um) == (count, unit_um)
    }

    /// Millimetres per device unit; no sensor has a unit of 0.
    fn unit_mm(&self) -> f64 {
        f64::from(self.unit_um.max(1)) / 1000.0
    }
}

/// The circles of a sensor, and what they are for the layout of its last scan.
pub(super) struct Table {
    pose: Pose,
    circles: usize,
    radii_mm: [u16; ZONES],
    /// The robot's own body: so many of these.
    sectors: ([Sector; SECTORS], usize),
    margin_mm: u16,
    exact: bool,
    no_return_is_far: bool,
    max_invalid: f64,

    layout: Layout,
    /// Valid readings inside each circle, beyond the robot's own body.
    inside: [Spans; ZONES],
    nearest: Nearest,
    /// 1 for beams of which a reading may lie inside the largest circle.
    tells: Box<[u16]>,
    /// How many these are.
    telling: u16,
    most_invalid: u16,
}

/// What the beams of a scan met.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Met {
    /// Beams that met something inside each circle.
    pub(super) inside: [u16; ZONES],
    /// The beam whose point is nearest to the robot's centre, the first of several, and its distance in mm, rounded down.
    pub(super) nearest: Option<(u16, u32)>,
}

impl Table {
    /// For a sensor of at most `beams` beams.
    pub(super) fn new(pose: Pose, settings: &Settings<'_>, beams: usize) -> Table {
        let circles = settings.radii_mm.len().min(ZONES);
        let mut radii_mm = [0; ZONES];
        radii_mm[..circles].copy_from_slice(&settings.radii_mm[..circles]);
        let mut sectors = [Sector { from_mdeg: 0, to_mdeg: -1, range_mm: 0 }; SECTORS];
        let count = settings.self_min.len().min(SECTORS);
        sectors[..count].copy_from_slice(&settings.self_min[..count]);
        let mut table = Table {
            pose,
            circles,
            radii_mm,
            sectors: (sectors, count),
            margin_mm: settings.margin_mm,
            exact: settings.exact,
            no_return_is_far: settings.no_return_is_far,
            max_invalid: settings.max_invalid,
            layout: Layout::default(),
            inside: std::array::from_fn(|zone| Spans::none(if zone < circles { beams } else { 0 })),
            nearest: Nearest::none(beams),
            tells: vec![0; beams].into(),
            telling: 0,
            most_invalid: 0,
        };
        table.make(Layout::default());
        table
    }

    /// Circles used, at most [`ZONES`].
    pub(super) fn circles(&self) -> usize {
        self.circles
    }

    /// Radius of circle `zone`; 0 of those that are not used.
    pub(super) fn radius_mm(&self, zone: usize) -> u16 {
        self.radii_mm[zone]
    }

    /// The most beams of a scan.
    pub(super) fn most(&self) -> usize {
        self.tells.len()
    }

    /// What the table was made for.
    pub(super) fn layout(&self) -> Layout {
        self.layout
    }

    /// Computes the table again.
    pub(super) fn make(&mut self, layout: Layout) {
        self.layout = layout;
        self.inside.iter_mut().for_each(Spans::clear);
        self.nearest.seen.clear();
        self.nearest.twice_q.fill(0.0);
        self.tells.fill(0);
        for i in 0..layout.count {
            self.make_beam(i, layout.first_angle + i as f64 * layout.step);
        }
        self.nearest.finish();
        self.telling = self.tells.iter().sum();
        self.most_invalid = floor(self.max_invalid * f64::from(self.telling)) as u16;
    }

    fn make_beam(&mut self, i: usize, angle: f64) {
        let beam = self.beam(angle);
        let beyond_ranges = self.layout.valid_to.saturating_add(1);
        self.nearest.seen.set(i, beam.own, beyond_ranges);
        self.nearest.twice_q[i] = 2.0 * beam.q / self.layout.unit_mm();
        for zone in 0..self.circles {
            let (from, below) = self.span(&beam, zone);
            self.inside[zone].set(i, from, below.min(u64::from(beyond_ranges)) as u16);
            if zone == 0 {
                self.tells[i] = u16::from(self.inside[zone].has_any(i));
            }
        }
    }

    /// The beam at a sensor angle.
    fn beam(&self, angle: f64) -> Beam {
        let own = in_units(self.self_min_mm(angle) as f64, self.layout.unit_mm());
        let (sx, sy) = self.sensor_mm();
        if (sx, sy) == (0.0, 0.0) && self.pose.yaw_rad.is_finite() {
            // From the robot's centre all beams are alike, and exact ones are many.
            return Beam { q: 0.0, own };
        }
        let (ux, uy) = self.pose.direction(angle);
        Beam { q: sx * ux + sy * uy, own }
    }

    /// The readings of `beam` inside circle `zone`: from the first, below the second.
    fn span(&self, beam: &Beam, zone: usize) -> (u64, u64) {
        let unit_mm = self.layout.unit_mm();
        let (sx, sy) = self.sensor_mm();
        let (lo_mm, hi_mm) = self.chord_mm(beam.q, sx * sx + sy * sy, f64::from(self.radii_mm[zone]));
        let from = if self.exact && lo_mm > 0 { floor(lo_mm as f64 / unit_mm) as u64 + 1 } else { 0 };
        (from.max(beam.own), in_units(hi_mm as f64, unit_mm))
    }

    /// Beams that can tell something of the largest circle.
    pub(super) fn telling(&self) -> u16 {
        self.telling
    }

    /// Of so many invalid beams or fewer the verdict does not become unknown.
    pub(super) fn most_invalid(&self) -> u16 {
        self.most_invalid
    }

    /// Beams without a reading among those that can tell something of the largest circle. One that was not measured counts
    /// where nothing was over more than two spacings of the sensor's own points, which are `spacing` radians.
    pub(super) fn invalid(&self, ranges: &[u16], spacing: f32) -> u16 {
        let Layout { valid_to, no_return, beyond, .. } = self.layout;
        let is_invalid = |value: u16| {
            let is_no_return = self.no_return_is_far & (value == no_return);
            let is_beyond = (value == beyond) & (beyond != no_return);
            (value > valid_to) & !is_beyond & !is_no_return
        };
        let beams = ranges.iter().zip(&self.tells);
        let invalid: u16 = beams.map(|(&value, &tells)| u16::from(is_invalid(value)) & tells).sum();
        if invalid == 0 { 0 } else { invalid - self.looked_past(ranges, spacing) }
    }

    /// Of the beams that can tell something, those that were not measured and have measured ones near enough on both sides.
    fn looked_past(&self, ranges: &[u16], spacing: f32) -> u16 {
        let is_measured = |value: &u16| *value != Scan::NOT_MEASURED;
        let (Some(first), Some(last)) =
            (ranges.iter().position(is_measured), ranges.iter().rposition(is_measured))
        else {
            return 0;
        };
        let step = self.layout.step.abs();
        let most = (2.0 * f64::from(spacing) / step * (1.0 + ROUNDING)) as usize;
        // Where beams go all around, the first follows the last.
        let is_whole_turn = (ranges.len() as f64 * step - TAU).abs() < step / 2.0;
        let across = if is_whole_turn { first + ranges.len() - 1 - last } else { usize::MAX - 1 };
        let told = |run: &[u16], tells: &[u16]| -> u16 { tells[..run.len()].iter().sum() };
        let mut past = 0;
        if across < most {
            past += told(&ranges[..first], &self.tells) + told(&ranges[last + 1..], &self.tells[last + 1..]);
        }
        let mut begin = first;
        while begin < last {
            let behind = begin + 1 + ranges[begin + 1..].iter().position(is_measured).unwrap_or(0);
            if behind - begin - 1 < most {
                past += told(&ranges[begin + 1..behind], &self.tells[begin + 1..]);
            }
            begin = behind;
        }
        past
    }

    /// What the beams met that have these `ranges`, the first ones of a scan of the table's layout: the exact points count
    /// where there are `angles`.
    pub(super) fn met(&mut self, ranges: &[u16], angles: &[f32]) -> Met {
        if !angles.is_empty() {
            return self.met_exactly(ranges, angles);
        }
        let nearest = self.nearest.find(ranges).map(|(beam, square)| self.at_distance(beam, square));
        Met { inside: std::array::from_fn(|zone| self.inside[zone].count(ranges)), nearest }
    }

    /// Only what is near enough to be inside a circle, or the nearest, is computed.
    fn met_exactly(&self, ranges: &[u16], angles: &[f32]) -> Met {
        let unit_mm = self.layout.unit_mm();
        let (sx, sy) = self.sensor_mm();
        let away = (sx * sx + sy * sy).sqrt();
        let radius_mm = self.radii_mm[..self.circles].iter().max().map_or(0.0, |&radius| f64::from(radius));
        let reach = (away + radius_mm + f64::from(self.margin_mm) + 1.0) / unit_mm;
        let (mut met, mut best) = (Met::default(), (f64::INFINITY, None));
        for (i, (&range, &angle)) in ranges.iter().zip(angles).enumerate() {
            let value = f64::from(range);
            let may_be_nearest = value * unit_mm - away <= best.0;
            if range > self.layout.valid_to || !(may_be_nearest || value <= reach) {
                continue;
            }
            let beam = self.beam(f64::from(angle));
            if u64::from(range) < beam.own {
                continue;
            }
            let square = value * (value + 2.0 * beam.q / unit_mm);
            let distance_mm = (square * unit_mm * unit_mm + away * away).max(0.0).sqrt();
            if distance_mm < best.0 {
                best = (distance_mm, Some((i, square)));
            }
            for (zone, inside) in met.inside.iter_mut().enumerate().take(self.circles) {
                let (from, below) = self.span(&beam, zone);
                *inside += u16::from((from..below).contains(&u64::from(range)));
            }
        }
        met.nearest = best.1.map(|(beam, square)| self.at_distance(beam, square));
        met
    }

    /// Beam and distance in mm of a point, by the square of its distance without that of the sensor, in device units.
    fn at_distance(&self, beam: usize, square: f64) -> (u16, u32) {
        let unit_mm = self.layout.unit_mm();
        let (sx, sy) = self.sensor_mm();
        let distance_mm = (square * unit_mm * unit_mm + sx * sx + sy * sy).max(0.0).sqrt();
        (beam as u16, floor(distance_mm) as u32)
    }

    /// The sensor's place in the robot's frame.
    fn sensor_mm(&self) -> (f64, f64) {
        (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m)
    }

    /// Where the robot's own body ends along a beam.
    fn self_min_mm(&self, angle: f64) -> u64 {
        let sectors = &self.sectors.0[..self.sectors.1];
        if sectors.is_empty() {
            return 0;
        }
        let angle_mdeg = in_sector_mdeg(angle);
        let here = |sector: &&Sector| (sector.from_mdeg..=sector.to_mdeg).contains(&angle_mdeg);
        sectors.iter().filter(here).map(|sector| u64::from(sector.range_mm)).max().unwrap_or(0)
    }

    /// The ranges in mm between which a beam is inside a circle, 0 and 0 if it never is: `q` is s.u and `square` |s|^2,
    /// with s the sensor's place and u the beam's direction (a line through a circle; paper III.B.1).
    fn chord_mm(&self, q: f64, square: f64, radius_mm: f64) -> (u64, u64) {
        let outside = square - radius_mm * radius_mm;
        let disc = q * q - outside;
        let (lo, hi) = if outside < 0.0 {
            (0.0, -q + disc.sqrt())
        } else if disc > 0.0 && q < 0.0 {
            (-q - disc.sqrt(), -q + disc.sqrt())
        } else {
            return (0, 0);
        };
        let margin = f64::from(self.margin_mm);
        // What is below 0 becomes 0.
        (floor(lo - margin) as u64, ceil(hi + margin) as u64)
    }
}

/// A beam: s.u, with s the sensor's place and u its direction, in mm, and where the robot's own body ends, in device units.
struct Beam {
    q: f64,
    own: u64,
}

/// The least number of device units that are no less than `mm`.
fn in_units(mm: f64, unit_mm: f64) -> u64 {
    ceil(mm / unit_mm) as u64
}

/// What a quotient may lose.
const ROUNDING: f64 = 1e-6;

/// Values within so many mm of a whole number are that number: rounding is never towards clear, but what stands
/// exactly on a circle is outside, whatever sine and cosine lose.
const WHOLE_MM: f64 = 1e-6;

fn floor(value: f64) -> f64 {
    if (value - value.round()).abs() <= WHOLE_MM { value.round() } else { value.floor() }
}

fn ceil(value: f64) -> f64 {
    if (value - value.round()).abs() <= WHOLE_MM { value.round() } else { value.ceil() }
}
