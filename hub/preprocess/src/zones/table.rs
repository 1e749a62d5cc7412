//! Which values of each beam lie where: inside a circle, before the robot's own body, in no range at all. Made once
//! for a layout of beams, in floating point; read with every scan, in device units. Refuses to know verdicts.

use super::{Ranges, SECTORS, Sector, Settings};
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
}

/// The values `from..from + len` of each beam, in device units. Nothing for beams that there are not.
#[derive(Clone, Copy)]
struct Spans {
    from: [u16; BEAMS],
    len: [u16; BEAMS],
}

impl Spans {
    const NONE: Spans = Spans { from: [0; BEAMS], len: [0; BEAMS] };

    fn set(&mut self, i: usize, from: u64, below: u64) {
        self.from[i] = from as u16;
        self.len[i] = below.saturating_sub(from) as u16;
    }

    fn has(&self, i: usize, value: u16) -> bool {
        value.wrapping_sub(self.from[i]) < self.len[i]
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
    /// Valid readings beyond the robot's own body.
    beyond_self: Spans,
    /// 1 for beams that can tell something of the largest circle.
    telling: [u16; BEAMS],
    most_invalid: u16,
    /// The first value that is a code.
    codes_from: u16,
    /// The largest value, code 0.
    max: u16,
    /// Twice the way along each beam to the point that is nearest to the centre, backwards, in device units.
    twice_q: [f64; BEAMS],
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
            beyond_self: Spans::NONE,
            telling: [0; BEAMS],
            most_invalid: 0,
            codes_from: 0,
            max: 0,
            twice_q: [0.0; BEAMS],
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
    pub(super) fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Makes the table anew.
    pub(super) fn make(&mut self, layout: Layout) {
        let scan = layout.scan();
        // A unit of 0 is none that a sensor has.
        let unit_mm = u64::from(layout.unit_mm.max(1));
        self.layout = layout;
        self.max = scan.max();
        self.codes_from = self.max.saturating_sub(Code::BEYOND.0);
        (self.inside, self.beyond_self) = ([Spans::NONE; ZONES], Spans::NONE);
        (self.telling, self.twice_q) = ([0; BEAMS], [0.0; BEAMS]);
        let (sx, sy) = (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m);
        for i in 0..scan.beams() {
            let angle_mdeg = scan.angle_mdeg(i);
            let (ux, uy) = self.pose.direction(angle_mdeg);
            let q = sx * ux + sy * uy;
            let self_min_mm = self.self_min_mm(angle_mdeg);
            let own = self_min_mm.div_ceil(unit_mm);
            let below = u64::from(self.codes_from);
            self.beyond_self.set(i, own, below);
            self.twice_q[i] = 2.0 * q / unit_mm as f64;
            for zone in 0..self.circles {
                let (lo_mm, hi_mm) = self.chord_mm(q, sx * sx + sy * sy, f64::from(self.radii_mm[zone]));
                let from = if self.exact && lo_mm > 0 { lo_mm / unit_mm + 1 } else { 0 };
                self.inside[zone].set(i, from.max(own), hi_mm.div_ceil(unit_mm).min(below));
                if zone == 0 {
                    self.telling[i] = u16::from(hi_mm > self_min_mm);
                }
            }
        }
        let telling: u16 = self.telling.iter().sum();
        self.most_invalid = floor(self.max_invalid * f64::from(telling)) as u16;
    }

    /// A scan of this layout tells anything at all.
    pub(super) fn tells(&self) -> bool {
        let Pose { x_m, y_m, yaw_rad, .. } = self.pose;
        self.layout.count > 0 && (x_m + y_m + yaw_rad).is_finite()
    }

    /// Beams through the largest circle that may be invalid.
    pub(super) fn most_invalid(&self) -> u16 {
        self.most_invalid
    }

    /// Beams that met something inside circle `zone`.
    pub(super) fn inside(&self, zone: usize, ranges: &Ranges) -> u16 {
        let spans = &self.inside[zone];
        (0..BEAMS).map(|i| u16::from(spans.has(i, ranges[i]))).sum()
    }

    /// Beams without a reading among those that could tell something of the largest circle.
    pub(super) fn invalid(&self, ranges: &Ranges) -> u16 {
        let has_beyond = self.max >= Code::BEYOND.0;
        let is_invalid = |value: u16| {
            let is_beyond = has_beyond & (value == self.codes_from);
            let is_no_return = self.no_return_is_far & (value == self.max);
            (value >= self.codes_from) & !is_beyond & !is_no_return
        };
        (0..BEAMS).map(|i| u16::from(is_invalid(ranges[i])) & self.telling[i]).sum()
    }

    /// The beam whose point is nearest to the robot's centre, the first of several, and the distance in mm, rounded
    /// down.
    pub(super) fn nearest(&self, ranges: &Ranges) -> Option<(u16, u32)> {
        // The distance squared is r^2 + 2qr and what is the same for all beams.
        let key = |i: usize| {
            let value = f64::from(ranges[i]);
            let key = value * (value + self.twice_q[i]);
            if self.beyond_self.has(i, ranges[i]) { key } else { f64::INFINITY }
        };
        let mut nearest = (f64::INFINITY, 0);
        for start in (0..BEAMS).step_by(BLOCK) {
            let block = start..(start + BLOCK).min(BEAMS);
            let least = block.clone().map(key).fold(f64::INFINITY, |a, b| if b < a { b } else { a });
            if least < nearest.0 {
                nearest = (least, block.clone().find(|&i| key(i) == least).unwrap_or(start));
            }
        }
        let (key, beam) = nearest;
        let unit_mm = f64::from(self.layout.unit_mm.max(1));
        let (sx, sy) = (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m);
        let square = key * unit_mm * unit_mm + (sx * sx + sy * sy);
        key.is_finite().then_some((beam as u16, floor(square.max(0.0).sqrt()) as u32))
    }

    /// Where the robot's own body ends along a beam.
    fn self_min_mm(&self, angle_mdeg: i32) -> u64 {
        let here = |sector: &&Sector| (sector.from_mdeg..=sector.to_mdeg).contains(&angle_mdeg);
        self.sectors.iter().filter(here).map(|sector| u64::from(sector.range_mm)).max().unwrap_or(0)
    }

    /// The ranges in mm between which a beam is inside a circle: with the sensor at s and the beam's direction u, `q`
    /// is s.u, `square` is |s|^2 (the line through a circle; paper III.B.1). 0 and 0 if it never is.
    fn chord_mm(&self, q: f64, square: f64, radius: f64) -> (u64, u64) {
        let outside = square - radius * radius;
        let disc = q * q - outside;
        let (lo, hi) = if outside < 0.0 {
            (0.0, -q + disc.sqrt())
        } else if disc > 0.0 && q < 0.0 {
            (-q - disc.sqrt(), -q + disc.sqrt())
        } else {
            return (0, 0);
        };
        let margin = f64::from(self.margin_mm);
        // Below 0 is 0.
        (floor(lo - margin) as u64, ceil(hi + margin) as u64)
    }
}

/// Values within so many mm of a whole number are that number: rounding is never towards clear, but what stands
/// exactly on a circle is outside, whatever sine and cosine lose.
const WHOLE_MM: f64 = 1e-6;

/// Beams that are compared before it is asked which of them is nearest.
const BLOCK: usize = 16;

fn floor(value: f64) -> f64 {
    if (value - value.round()).abs() <= WHOLE_MM { value.round() } else { value.floor() }
}

fn ceil(value: f64) -> f64 {
    if (value - value.round()).abs() <= WHOLE_MM { value.round() } else { value.ceil() }
}
