//! Where the beams of a sensor cross the circles around the robot's centre. Computed once per beam layout, in floating
//! point and millimetres; used for every scan, in device units. Refuses to know verdicts.

use super::nearest::Nearest;
use super::spans::{Ranges, Spans};
use super::{SECTORS, Sector, Settings};
use schema::{BEAMS, Code, Pose, Scan, ZONES};

/// What of a scan the table depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Layout {
    count: u16,
    unit_mm: u8,
    range_bits: u8,
    first_angle_mdeg: i32,
    step_mdeg: u16,
}

impl Layout {
    pub(super) fn of(scan: &Scan) -> Layout {
        let &Scan { count, unit_mm, range_bits, first_angle_mdeg, step_mdeg, .. } = scan;
        Layout { count, unit_mm, range_bits, first_angle_mdeg, step_mdeg }
    }

    /// A scan of this layout without readings.
    fn scan(self) -> Scan {
        let Layout { count, unit_mm, range_bits, first_angle_mdeg, step_mdeg } = self;
        Scan { count, unit_mm, range_bits, first_angle_mdeg, step_mdeg, ..Scan::default() }
    }

    /// Millimetres per device unit; no sensor has a unit of 0.
    fn unit_mm(self) -> u64 {
        u64::from(self.unit_mm.max(1))
    }
}

/// The circles of a sensor, and what they are for the layout of its last scan.
pub(super) struct Table {
    pose: Pose,
    circles: usize,
    radii_mm: [u16; ZONES],
    sectors: [Sector; SECTORS],
    margin_mm: u16,
    exact: bool,
    no_return_is_far: bool,
    max_invalid: f64,

    layout: Layout,
    /// Valid readings inside each circle, beyond the robot's own body.
    inside: [Spans; ZONES],
    nearest: Nearest,
    /// 1 for beams of which a reading may lie inside the largest circle.
    tells: [u16; BEAMS],
    /// How many these are.
    telling: u16,
    most_invalid: u16,
    /// The first value that is a code.
    codes_from: u16,
    /// The largest value, code 0.
    max: u16,
}

impl Table {
    pub(super) fn new(pose: Pose, settings: &Settings<'_>) -> Table {
        let circles = settings.radii_mm.len().min(ZONES);
        let mut radii_mm = [0; ZONES];
        radii_mm[..circles].copy_from_slice(&settings.radii_mm[..circles]);
        let mut sectors = [Sector { from_mdeg: 0, to_mdeg: -1, range_mm: 0 }; SECTORS];
        for (sector, given) in sectors.iter_mut().zip(settings.self_min) {
            *sector = *given;
        }
        let mut table = Table {
            pose,
            circles,
            radii_mm,
            sectors,
            margin_mm: settings.margin_mm,
            exact: settings.exact,
            no_return_is_far: settings.no_return_is_far,
            max_invalid: settings.max_invalid,
            layout: Layout::default(),
            inside: [Spans::NONE; ZONES],
            nearest: Nearest::NONE,
            tells: [0; BEAMS],
            telling: 0,
            most_invalid: 0,
            codes_from: 0,
            max: 0,
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

    /// What the table was made for.
    pub(super) fn layout(&self) -> Layout {
        self.layout
    }

    /// Computes the table again.
    pub(super) fn make(&mut self, layout: Layout) {
        let scan = layout.scan();
        self.layout = layout;
        self.max = scan.max();
        self.codes_from = self.max.saturating_sub(Code::BEYOND.0);
        self.inside = [Spans::NONE; ZONES];
        self.nearest = Nearest::NONE;
        self.tells = [0; BEAMS];
        for i in 0..scan.beams() {
            self.make_beam(i, scan.angle_mdeg(i));
        }
        self.nearest.finish();
        self.telling = self.tells.iter().sum();
        self.most_invalid = floor(self.max_invalid * f64::from(self.telling)) as u16;
    }

    fn make_beam(&mut self, i: usize, angle_mdeg: i32) {
        let unit_mm = self.layout.unit_mm();
        let ((sx, sy), (ux, uy)) = (self.sensor_mm(), self.pose.direction(angle_mdeg));
        let (q, square) = (sx * ux + sy * uy, sx * sx + sy * sy);
        let own = self.self_min_mm(angle_mdeg).div_ceil(unit_mm);
        self.nearest.seen.set(i, own, self.codes_from);
        self.nearest.twice_q[i] = 2.0 * q / unit_mm as f64;
        for zone in 0..self.circles {
            let (lo_mm, hi_mm) = self.chord_mm(q, square, f64::from(self.radii_mm[zone]));
            let from = if self.exact && lo_mm > 0 { lo_mm / unit_mm + 1 } else { 0 };
            let below = hi_mm.div_ceil(unit_mm).min(u64::from(self.codes_from));
            self.inside[zone].set(i, from.max(own), below as u16);
            if zone == 0 {
                self.tells[i] = u16::from(self.inside[zone].has_any(i));
            }
        }
    }

    /// Beams that can tell something of the largest circle.
    pub(super) fn telling(&self) -> u16 {
        self.telling
    }

    /// Beams that met something inside circle `zone`.
    pub(super) fn inside(&self, zone: usize, ranges: &Ranges) -> u16 {
        self.inside[zone].count(ranges)
    }

    /// Of so many invalid beams or fewer the verdict does not become unknown.
    pub(super) fn most_invalid(&self) -> u16 {
        self.most_invalid
    }

    /// Beams without a reading among those that can tell something of the largest circle.
    pub(super) fn invalid(&self, ranges: &Ranges) -> u16 {
        let has_beyond = self.max >= Code::BEYOND.0;
        let is_invalid = |value: u16| {
            let is_beyond = has_beyond & (value == self.codes_from);
            let is_no_return = self.no_return_is_far & (value == self.max);
            (value >= self.codes_from) & !is_beyond & !is_no_return
        };
        (0..BEAMS).map(|i| u16::from(is_invalid(ranges[i])) & self.tells[i]).sum()
    }

    /// The beam whose point is nearest to the robot's centre, the first of several, and its distance in mm, rounded
    /// down.
    pub(super) fn nearest(&self, ranges: &Ranges) -> Option<(u16, u32)> {
        let (beam, square) = self.nearest.find(ranges)?;
        let unit_mm = self.layout.unit_mm() as f64;
        let (sx, sy) = self.sensor_mm();
        let distance_mm = (square * unit_mm * unit_mm + sx * sx + sy * sy).max(0.0).sqrt();
        Some((beam as u16, floor(distance_mm) as u32))
    }

    /// The sensor's place in the robot's frame.
    fn sensor_mm(&self) -> (f64, f64) {
        (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m)
    }

    /// Where the robot's own body ends along a beam.
    fn self_min_mm(&self, angle_mdeg: i32) -> u64 {
        let here = |sector: &&Sector| (sector.from_mdeg..=sector.to_mdeg).contains(&angle_mdeg);
        self.sectors.iter().filter(here).map(|sector| u64::from(sector.range_mm)).max().unwrap_or(0)
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

/// Values within so many mm of a whole number are that number: rounding is never towards clear, but what stands
/// exactly on a circle is outside, whatever sine and cosine lose.
const WHOLE_MM: f64 = 1e-6;

fn floor(value: f64) -> f64 {
    if (value - value.round()).abs() <= WHOLE_MM { value.round() } else { value.floor() }
}

fn ceil(value: f64) -> f64 {
    if (value - value.round()).abs() <= WHOLE_MM { value.round() } else { value.ceil() }
}
