//! Check whether something is near the robot: the minimal distance check of the paper, with circles around the robot's
//! center.
//!
//! A [`ZoneChecker`] counts violations over scans. Its table has the ranges of each beam that lie inside each circle.
//! The table is computed once per layout of the scans, in floating point and millimeters. A scan then needs only
//! comparisons of integers in device units.

use std::f64::consts::TAU;

use scanhub_schema::{MAX_ZONES, Pose, Scan, ScanHead, Verdict, Zone, Zones, in_sector_mdeg};

use crate::search::position;

/// Sector of the sensor's view in which parts of the robot itself are visible.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sector {
    /// First sensor angle in 1/1000 degree, as in the scan: 0 ahead, counter-clockwise.
    pub from_mdeg: i32,
    /// Last sensor angle in 1/1000 degree, inclusive.
    pub to_mdeg: i32,
    /// Minimum range. Nearer readings are the robot's own body and are ignored.
    pub range_mm: u16,
}

/// Maximum number of sectors of a sensor. More are ignored.
pub const MAX_SECTORS: usize = 64;

/// Settings of a check.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Radii of the circles, the largest first, at most [`MAX_ZONES`]. More are ignored.
    pub radii_mm: Vec<u16>,
    /// The robot's own body. Where sectors overlap, the largest range counts.
    pub body_mask: Vec<Sector>,
    /// Distance in mm by which a circle is extended along every beam that meets it.
    pub margin_mm: u16,
    /// Number of beams that must end inside a zone for a scan to violate the zone. 0 counts as 1.
    pub min_beams: u16,
    /// Number of consecutive scans that must violate a zone; 0 counts as 1.
    pub min_scans: u16,
    /// Maximum share of invalid beams among the beams through the largest circle. If the share is larger, the verdict
    /// is unknown.
    pub max_invalid: f64,
    /// Whether an object between the sensor and the near side of a circle counts as outside, if the sensor is outside
    /// the circle.
    pub exact: bool,
    /// Whether a beam without a return has met nothing. Otherwise, it is invalid.
    pub no_return_is_far: bool,
}

impl Default for Settings {
    /// Returns 1 m and 0.6 m (paper III.B.1), one beam, one scan. A tenth of the beams may be invalid.
    fn default() -> Self {
        Settings {
            radii_mm: vec![1000, 600],
            body_mask: Vec::new(),
            margin_mm: 0,
            min_beams: 1,
            min_scans: 1,
            max_invalid: 0.10,
            exact: true,
            no_return_is_far: true,
        }
    }
}

/// Result of checking an incomplete scan. It never reports that the robot's surroundings are clear.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Warning {
    /// [`Verdict::Slow`] or [`Verdict::Stop`].
    pub verdict: Verdict,
    /// Beam of the nearest point so far.
    pub beam: u16,
    /// Distance of that point from the robot's center in mm, rounded down.
    pub distance_mm: u32,
}

/// Compares scans of one sensor with its circles.
///
/// Rules for cases that the paper leaves open:
/// - Until `min_scans` scans have been seen since the start, a silence, a scan with too many invalid beams or a change
///   of the sensor's layout, the absence of a violation proves nothing. The verdict is unknown then, because clear
///   would be a guess.
/// - A beam is relevant if it can have a reading inside the largest circle and outside the robot's own body. The
///   reading is in the scan's units and below the scan's codes. All other beams count neither as invalid nor in the
///   total.
/// - If a violation takes more beams than are relevant, no zone can ever be violated, so the verdict is unknown.
///   Examples are an empty scan, a check without circles, a pose that is not finite, and a sensor that looks past the
///   largest circle.
pub struct ZoneChecker {
    min_beams: u16,
    min_scans: u16,
    table: Table,
    /// Number of scans since the start, a silence, a scan with too many invalid beams or a change of the layout.
    scan_count: u16,
    /// For each circle, number of consecutive scans in which enough beams met something inside.
    streaks: [u16; MAX_ZONES],
    /// Whether scans may be older than their stamps.
    is_backlogged: bool,
}

impl ZoneChecker {
    /// Creates a check for a sensor at `pose` with at most `beams` beams. More are ignored.
    pub fn new(pose: Pose, settings: &Settings, beams: usize) -> ZoneChecker {
        ZoneChecker {
            min_beams: settings.min_beams.max(1),
            min_scans: settings.min_scans.max(1),
            table: Table::new(pose, settings, beams),
            scan_count: 0,
            streaks: [0; MAX_ZONES],
            is_backlogged: false,
        }
    }

    /// Writes the result for `scan` into `out`, every byte of it. A table is computed only for the first scan of a
    /// layout.
    pub fn update(&mut self, scan: &Scan, out: &mut Zones) {
        let layout = Layout::of(scan, self.table.max_beams());
        if self.table.layout != layout {
            self.table.compute(layout);
            self.reset();
        }
        self.scan_count = self.scan_count.saturating_add(1);
        let ranges = &scan.ranges()[..scan.beams().min(self.table.max_beams())];
        let invalid = self.table.invalid_beams(ranges, scan.spacing);
        let ZoneHits { inside, nearest } = self.table.hits(ranges, scan.exact_angles());
        let is_enough = self.scan_count >= self.min_scans && !self.is_blind();
        let is_valid = invalid <= self.table.max_invalid_beams;
        let is_known = is_enough && !self.is_backlogged && is_valid;
        for (streak, &beams) in self.streaks.iter_mut().zip(&inside).take(self.table.circles) {
            *streak = if beams >= self.min_beams { streak.saturating_add(1) } else { 0 };
        }
        out.verdict = self.verdict(is_known) as u8;
        out.count = self.table.circles as u8;
        (out.nearest_beam, out.nearest_mm) = nearest.unwrap_or((Zones::NO_BEAM, Zones::NO_DISTANCE));
        out.invalid_beams = invalid;
        self.write_circles(&inside, out);
        if !is_valid {
            // The scan may have ended the run of violations of a zone although the object is still there.
            self.scan_count = 0;
        }
    }

    /// Checks an incomplete scan of `count` beams with the unit `unit_um`. Both values must be the same as in the last
    /// scan. `ranges` are the first ranges of the scan. For a scan with exact `angles`, `ranges` are all ranges, and a
    /// nearer point may still replace one of them. Returns the zone that the scan violates if no more points arrive, or
    /// `None`. Before the first complete scan, the result is `None`.
    pub fn check_partial(
        &mut self,
        count: usize,
        unit_um: u32,
        ranges: &[u16],
        angles: &[f32],
    ) -> Option<Warning> {
        if !self.table.layout.is_of(count, unit_um) || self.is_blind() {
            return None;
        }
        let ranges = &ranges[..ranges.len().min(count).min(self.table.max_beams())];
        let ZoneHits { inside, nearest } = self.table.hits(ranges, angles);
        let will_be = |zone: &usize| {
            inside[*zone] >= self.min_beams && self.streaks[*zone].saturating_add(1) >= self.min_scans
        };
        let smallest = self.table.circles.checked_sub(1)?;
        let zone = (0..=smallest).rev().find(will_be)?;
        let verdict = if zone == smallest { Verdict::Stop } else { Verdict::Slow };
        let (beam, distance_mm) = nearest?;
        Some(Warning { verdict, beam, distance_mm })
    }

    /// Writes the result of missing scans into `out`: only the circles are known. Afterwards, the count of consecutive
    /// scans restarts.
    pub fn write_stale(&mut self, out: &mut Zones) {
        self.reset();
        *out = Zones { count: self.table.circles as u8, ..Zones::unknown() };
        self.write_circles(&[0; MAX_ZONES], out);
    }

    /// Sets whether scans may be older than their stamps from now on. For a scan that may be older, points inside the
    /// smallest circle count. Without these points, the verdict is unknown.
    pub fn set_backlogged(&mut self, is_backlogged: bool) {
        self.is_backlogged = is_backlogged;
    }

    /// Returns the number of relevant beams of the last scan's layout; 0 before the first scan.
    pub fn effective_beams(&self) -> u16 {
        self.table.effective_beams
    }

    /// Returns whether fewer beams are relevant than a violation takes. The verdict is then always unknown.
    pub fn is_blind(&self) -> bool {
        self.effective_beams() < self.min_beams
    }

    fn reset(&mut self) {
        self.scan_count = 0;
        self.streaks = [0; MAX_ZONES];
    }

    fn is_violated(&self, zone: usize) -> bool {
        self.streaks[zone] >= self.min_scans
    }

    /// Returns the verdict. Points inside the smallest circle take precedence over invalid beams.
    fn verdict(&self, is_known: bool) -> Verdict {
        match self.table.circles.checked_sub(1) {
            None => Verdict::Unknown,
            Some(smallest) if self.is_violated(smallest) => Verdict::Stop,
            _ if !is_known => Verdict::Unknown,
            Some(smallest) if (0..smallest).any(|zone| self.is_violated(zone)) => Verdict::Slow,
            _ => Verdict::Clear,
        }
    }

    fn write_circles(&self, beams: &[u16; MAX_ZONES], out: &mut Zones) {
        out.flags = if self.scan_count < self.min_scans { Zones::PROVISIONAL } else { 0 };
        out.reserved = 0;
        for (zone, circle) in out.zone_array.iter_mut().enumerate() {
            *circle = Zone {
                radius_mm: self.table.radii_mm[zone],
                beams: beams[zone],
                violated: u8::from(self.is_violated(zone)),
                reserved: [0; 3],
            };
        }
    }
}

/// Properties of a scan on which the table depends.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Layout {
    count: usize,
    unit_um: u32,
    valid_to: u16,
    no_return: u16,
    beyond: u16,
    first_angle: f64,
    step: f64,
}

impl Layout {
    /// Returns the layout of `scan`. At most `max_beams` beams are used.
    fn of(scan: &Scan, max_beams: usize) -> Layout {
        let ScanHead { unit_um, valid_to, no_return, beyond, first_angle, step, .. } = **scan;
        let count = scan.beams().min(max_beams);
        Layout { count, unit_um, valid_to, no_return, beyond, first_angle, step }
    }

    /// Returns whether scans with this number of beams and this unit have the layout.
    fn is_of(&self, count: usize, unit_um: u32) -> bool {
        (self.count, self.unit_um) == (count, unit_um)
    }

    /// Returns the millimeters per device unit. No sensor has a unit of 0.
    fn unit_mm(&self) -> f64 {
        f64::from(self.unit_um.max(1)) / 1000.0
    }
}

/// The circles of a sensor, computed for the layout of its last scan.
struct Table {
    pose: Pose,
    /// Number of circles, at most [`MAX_ZONES`].
    circles: usize,
    /// Radii of the circles; 0 for unused ones.
    radii_mm: [u16; MAX_ZONES],
    /// The robot's own body: the sectors, and their number.
    sectors: ([Sector; MAX_SECTORS], usize),
    margin_mm: u16,
    exact: bool,
    no_return_is_far: bool,
    max_invalid: f64,

    layout: Layout,
    /// Valid readings inside each circle, beyond the robot's own body.
    inside: [Spans; MAX_ZONES],
    nearest: Nearest,
    /// 1 for relevant beams, which can have a reading inside the largest circle; 0 for the others.
    is_effective: Box<[u16]>,
    /// Number of relevant beams.
    effective_beams: u16,
    /// Maximum number of invalid beams with which the verdict does not become unknown.
    max_invalid_beams: u16,
}

/// Points of a scan inside the circles.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct ZoneHits {
    /// Number of beams that met something inside each circle.
    inside: [u16; MAX_ZONES],
    /// Beam whose point is nearest to the robot's center, and its distance in mm, rounded down. The first one of
    /// several.
    nearest: Option<(u16, u32)>,
}

impl Table {
    /// Creates a table for a sensor with at most `beams` beams.
    fn new(pose: Pose, settings: &Settings, beams: usize) -> Table {
        let circles = settings.radii_mm.len().min(MAX_ZONES);
        let mut radii_mm = [0; MAX_ZONES];
        radii_mm[..circles].copy_from_slice(&settings.radii_mm[..circles]);
        let mut sectors = [Sector { from_mdeg: 0, to_mdeg: -1, range_mm: 0 }; MAX_SECTORS];
        let count = settings.body_mask.len().min(MAX_SECTORS);
        sectors[..count].copy_from_slice(&settings.body_mask[..count]);
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
            is_effective: vec![0; beams].into(),
            effective_beams: 0,
            max_invalid_beams: 0,
        };
        table.compute(Layout::default());
        table
    }

    /// Returns the maximum number of beams of a scan.
    fn max_beams(&self) -> usize {
        self.is_effective.len()
    }

    /// Computes the table for `layout`.
    fn compute(&mut self, layout: Layout) {
        self.layout = layout;
        self.inside.iter_mut().for_each(Spans::clear);
        self.nearest.measurable.clear();
        self.nearest.twice_q.fill(0.0);
        self.is_effective.fill(0);
        for i in 0..layout.count {
            self.compute_beam(i, layout.first_angle + i as f64 * layout.step);
        }
        self.nearest.finish();
        self.effective_beams = self.is_effective.iter().sum();
        self.max_invalid_beams = floor(self.max_invalid * f64::from(self.effective_beams)) as u16;
    }

    fn compute_beam(&mut self, i: usize, angle: f64) {
        let beam = self.beam(angle);
        let beyond_ranges = self.layout.valid_to.saturating_add(1);
        self.nearest.measurable.set(i, beam.own, beyond_ranges);
        self.nearest.twice_q[i] = 2.0 * beam.q / self.layout.unit_mm();
        for zone in 0..self.circles {
            let (from, below) = self.span(&beam, zone);
            self.inside[zone].set(i, from, below.min(u64::from(beyond_ranges)) as u16);
            if zone == 0 {
                self.is_effective[i] = u16::from(self.inside[zone].has_any(i));
            }
        }
    }

    /// Returns the beam at a sensor angle.
    fn beam(&self, angle: f64) -> Beam {
        let own = in_units(self.body_mask_mm(angle) as f64, self.layout.unit_mm());
        let (sx, sy) = self.sensor_mm();
        if (sx, sy) == (0.0, 0.0) && self.pose.yaw_rad.is_finite() {
            // At the robot's center, all beams are equal, and scans with exact angles need this function often.
            return Beam { q: 0.0, own };
        }
        let (ux, uy) = self.pose.direction(angle);
        Beam { q: sx * ux + sy * uy, own }
    }

    /// Returns the readings of `beam` inside circle `zone`, as a range: the first reading, and the reading after the
    /// last.
    fn span(&self, beam: &Beam, zone: usize) -> (u64, u64) {
        let unit_mm = self.layout.unit_mm();
        let (sx, sy) = self.sensor_mm();
        let (lo_mm, hi_mm) = self.chord_mm(beam.q, sx * sx + sy * sy, f64::from(self.radii_mm[zone]));
        let from = if self.exact && lo_mm > 0 { floor(lo_mm as f64 / unit_mm) as u64 + 1 } else { 0 };
        (from.max(beam.own), in_units(hi_mm as f64, unit_mm))
    }

    /// Returns the number of relevant beams without a reading. A beam that was not measured counts if it lies in a gap
    /// of more than two spacings between points. The sensor's own points have a spacing of `spacing` radians.
    fn invalid_beams(&self, ranges: &[u16], spacing: f32) -> u16 {
        let Layout { valid_to, no_return, beyond, .. } = self.layout;
        let is_invalid = |value: u16| {
            let is_no_return = self.no_return_is_far & (value == no_return);
            let is_beyond = (value == beyond) & (beyond != no_return);
            (value > valid_to) & !is_beyond & !is_no_return
        };
        let beams = ranges.iter().zip(&self.is_effective);
        let invalid: u16 =
            beams.map(|(&value, &is_effective)| u16::from(is_invalid(value)) & is_effective).sum();
        // Every beam of an LMS is measured.
        let is_complete = invalid == 0 || !ranges.contains(&Scan::NOT_MEASURED);
        if is_complete { invalid } else { invalid - self.unmeasured_between(ranges, spacing) }
    }

    /// Returns the number of relevant beams that were not measured, but have measured beams near enough on both sides.
    fn unmeasured_between(&self, ranges: &[u16], spacing: f32) -> u16 {
        let is_measured = |value: &u16| *value != Scan::NOT_MEASURED;
        let (Some(first), Some(last)) =
            (ranges.iter().position(is_measured), ranges.iter().rposition(is_measured))
        else {
            return 0;
        };
        let step = self.layout.step.abs();
        let max_beams_between = (2.0 * f64::from(spacing) / step * (1.0 + ROUNDING_ERROR)) as usize;
        // In a full revolution, the first beam follows the last one.
        let is_whole_turn = (ranges.len() as f64 * step - TAU).abs() < step / 2.0;
        let across = if is_whole_turn { first + ranges.len() - 1 - last } else { usize::MAX - 1 };
        let effective = |run: &[u16], is_effective: &[u16]| -> u16 { is_effective[..run.len()].iter().sum() };
        let mut unmeasured = 0;
        if across < max_beams_between {
            unmeasured += effective(&ranges[..first], &self.is_effective)
                + effective(&ranges[last + 1..], &self.is_effective[last + 1..]);
        }
        let mut begin = first;
        while begin < last {
            let next_measured = begin + 1 + ranges[begin + 1..].iter().position(is_measured).unwrap_or(0);
            if next_measured - begin - 1 < max_beams_between {
                unmeasured += effective(&ranges[begin + 1..next_measured], &self.is_effective[begin + 1..]);
            }
            begin = next_measured;
        }
        unmeasured
    }

    /// Returns the points inside the circles for `ranges`, which are the first ranges of a scan with the table's
    /// layout. If there are exact `angles`, the points are computed from these angles.
    fn hits(&mut self, ranges: &[u16], angles: &[f32]) -> ZoneHits {
        if !angles.is_empty() {
            return self.exact_hits(ranges, angles);
        }
        let nearest = self.nearest.find(ranges).map(|(beam, square)| self.at_distance(beam, square));
        let shortest = &self.nearest.shortest;
        ZoneHits { inside: std::array::from_fn(|zone| self.inside[zone].count(ranges, shortest)), nearest }
    }

    /// Returns the points inside the circles of a scan with exact angles. A point is computed only if it is so near
    /// that it may be inside a circle or be the nearest point.
    fn exact_hits(&self, ranges: &[u16], angles: &[f32]) -> ZoneHits {
        let unit_mm = self.layout.unit_mm();
        let (sx, sy) = self.sensor_mm();
        let sensor_distance_mm = (sx * sx + sy * sy).sqrt();
        let radius_mm = self.radii_mm[..self.circles].iter().max().map_or(0.0, |&radius| f64::from(radius));
        let reach = (sensor_distance_mm + radius_mm + f64::from(self.margin_mm) + 1.0) / unit_mm;
        let (mut zone_hits, mut best) = (ZoneHits::default(), (f64::INFINITY, None));
        // A greater range than `limit` is neither inside a circle nor nearer than the nearest point so far.
        let mut limit = self.layout.valid_to;
        let mut next = 0;
        while let Some(i) = position(ranges, next, |range| range <= limit)
            && let Some(&angle) = angles.get(i)
        {
            next = i + 1;
            let range = ranges[i];
            let beam = self.beam(f64::from(angle));
            if u64::from(range) < beam.own {
                continue;
            }
            let value = f64::from(range);
            let square = value * (value + 2.0 * beam.q / unit_mm);
            let distance_mm =
                (square * unit_mm * unit_mm + sensor_distance_mm * sensor_distance_mm).max(0.0).sqrt();
            if distance_mm < best.0 {
                best = (distance_mm, Some((i, square)));
                let farthest = ((distance_mm + sensor_distance_mm) / unit_mm).max(reach) as u16;
                limit = limit.min(farthest.saturating_add(1));
            }
            for (zone, inside) in zone_hits.inside.iter_mut().enumerate().take(self.circles) {
                let (from, below) = self.span(&beam, zone);
                *inside += u16::from((from..below).contains(&u64::from(range)));
            }
        }
        zone_hits.nearest = best.1.map(|(beam, square)| self.at_distance(beam, square));
        zone_hits
    }

    /// Returns the beam of a point, and the distance of the point in mm. `square` is the square of the point's distance
    /// minus the square of the sensor's distance, in device units.
    fn at_distance(&self, beam: usize, square: f64) -> (u16, u32) {
        let unit_mm = self.layout.unit_mm();
        let (sx, sy) = self.sensor_mm();
        let distance_mm = (square * unit_mm * unit_mm + sx * sx + sy * sy).max(0.0).sqrt();
        (beam as u16, floor(distance_mm) as u32)
    }

    /// Returns the sensor's position in the robot's frame.
    fn sensor_mm(&self) -> (f64, f64) {
        (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m)
    }

    /// Returns the range at which the robot's own body ends along a beam.
    fn body_mask_mm(&self, angle: f64) -> u64 {
        let sectors = &self.sectors.0[..self.sectors.1];
        if sectors.is_empty() {
            return 0;
        }
        let angle_mdeg = in_sector_mdeg(angle);
        let is_in_sector = |sector: &&Sector| (sector.from_mdeg..=sector.to_mdeg).contains(&angle_mdeg);
        sectors.iter().filter(is_in_sector).map(|sector| u64::from(sector.range_mm)).max().unwrap_or(0)
    }

    /// Returns the ranges in mm between which a beam is inside a circle; 0 and 0 if it never is. `q` is s.u and
    /// `square` is |s|^2, with the sensor's position s and the beam's direction u (a line through a circle; paper
    /// III.B.1).
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
        // Negative ranges become 0.
        (floor(lo - margin) as u64, ceil(hi + margin) as u64)
    }
}

/// Beam with precomputed values: `q` is s.u in mm, with the sensor's position s and the beam's direction u, and `own`
/// is the range at which the robot's own body ends, in device units.
struct Beam {
    q: f64,
    own: u64,
}

/// Returns the minimum number of device units that is not less than `mm`.
fn in_units(mm: f64, unit_mm: f64) -> u64 {
    ceil(mm / unit_mm) as u64
}

/// Maximum rounding error of a quotient.
const ROUNDING_ERROR: f64 = 1e-6;

/// Tolerance in mm within which a value counts as a whole number. Rounding never makes a verdict clear. But an object
/// exactly on a circle is outside, regardless of the errors of sine and cosine.
const ROUNDING_MM: f64 = 1e-6;

fn floor(value: f64) -> f64 {
    if (value - value.round()).abs() <= ROUNDING_MM { value.round() } else { value.floor() }
}

fn ceil(value: f64) -> f64 {
    if (value - value.round()).abs() <= ROUNDING_MM { value.round() } else { value.ceil() }
}

/// Search for the reading that is nearest to the robot's center, exact to the millimeter (rounded down). Only a few
/// beams are computed one by one.
struct Nearest {
    /// Readings that count: valid ones beyond the robot's own body.
    measurable: Spans,
    /// Twice s.u for each beam, in device units, with the sensor's position s and the beam's direction u.
    twice_q: Box<[f64]>,
    /// Values for each block of beams: the minimum of `twice_q`, the shortest reading that counts in the current scan,
    /// and the lower bound of the readings' squared distances.
    min_twice_q: Box<[f64]>,
    shortest: Box<[u16]>,
    bounds: Box<[f64]>,
}

impl Nearest {
    /// Creates an empty search for at most `beams` beams.
    fn none(beams: usize) -> Nearest {
        Nearest {
            measurable: Spans::none(beams),
            twice_q: vec![0.0; beams].into(),
            min_twice_q: vec![0.0; beams.div_ceil(BLOCK_LEN)].into(),
            shortest: vec![u16::MAX; beams.div_ceil(BLOCK_LEN)].into(),
            bounds: vec![0.0; beams.div_ceil(BLOCK_LEN)].into(),
        }
    }

    /// Completes the blocks. Call it when all beams are set.
    fn finish(&mut self) {
        for (block, min_value) in self.twice_q.chunks(BLOCK_LEN).zip(&mut self.min_twice_q) {
            *min_value = block.iter().copied().fold(f64::INFINITY, f64::min);
        }
    }

    /// Returns the beam whose point is nearest to the center, the first beam if there are several, and the square of
    /// the point's distance minus the square of the sensor's distance: r^2 + 2qr, in device units.
    fn find(&mut self, ranges: &[u16]) -> Option<(usize, f64)> {
        self.bound(ranges);
        let bounds = &self.bounds[..ranges.len().div_ceil(BLOCK_LEN)];
        let best =
            (1..bounds.len()).fold(0, |best, block| if bounds[block] < bounds[best] { block } else { best });
        let mut nearest = self.nearer(best, ranges, (f64::INFINITY, usize::MAX));
        for (block, &bound) in bounds.iter().enumerate() {
            if block != best && bound <= nearest.0 {
                nearest = self.nearer(block, ranges, nearest);
            }
        }
        let (square, beam) = nearest;
        (beam != usize::MAX).then_some((beam, square))
    }

    /// Computes the lower bound of each block, from its shortest reading that counts and its most favorable beam.
    fn bound(&mut self, ranges: &[u16]) {
        let (blocks, rest) = ranges.as_chunks::<BLOCK_LEN>();
        let (from_blocks, from_rest) = self.measurable.from[..ranges.len()].as_chunks::<BLOCK_LEN>();
        // Codes are greater than any range, so they do not change the minimum.
        let shortest = |ranges: &[u16], from: &[u16]| {
            ranges.iter().zip(from).map(|(&range, &from)| range.max(from)).fold(u16::MAX, u16::min)
        };
        for ((value, ranges), from) in self.shortest.iter_mut().zip(blocks).zip(from_blocks) {
            *value = shortest(ranges, from);
        }
        if let Some(value) = self.shortest.get_mut(blocks.len()) {
            *value = shortest(rest, from_rest);
        }
        for ((bound, &shortest), &twice_q) in
            self.bounds.iter_mut().zip(&self.shortest).zip(&self.min_twice_q)
        {
            let (shortest, turn) = (f64::from(shortest), -0.5 * twice_q);
            let value = if shortest > turn { shortest } else { turn };
            *bound = value * (value + twice_q);
        }
    }

    /// Returns `nearest`, or a reading of the block that is nearer.
    fn nearer(&self, block: usize, ranges: &[u16], nearest: (f64, usize)) -> (f64, usize) {
        let mut nearest = nearest;
        for (i, &range) in ranges.iter().enumerate().skip(block * BLOCK_LEN).take(BLOCK_LEN) {
            let value = f64::from(range);
            let square = value * (value + self.twice_q[i]);
            let is_nearer = square < nearest.0 || (square == nearest.0 && i < nearest.1);
            if is_nearer && self.measurable.has(i, range) {
                nearest = (square, i);
            }
        }
        nearest
    }
}

/// Number of beams of a block: so few that their directions differ little, and so many that there are few blocks.
const BLOCK_LEN: usize = 32;

/// Ranges `from..from + len` of each beam in device units. One comparison of integers tests a value.
#[derive(Clone)]
struct Spans {
    /// Minimum value; the maximum of the type for beams that do not exist.
    from: Box<[u16]>,
    len: Box<[u16]>,
    /// For each block of beams, the lowest value from which no value counts.
    ends: Box<[u16]>,
}

impl Spans {
    /// Creates empty spans of `beams` beams.
    fn none(beams: usize) -> Spans {
        let ends = vec![0; beams.div_ceil(BLOCK_LEN)].into();
        Spans { from: vec![u16::MAX; beams].into(), len: vec![0; beams].into(), ends }
    }

    /// Makes all spans empty.
    fn clear(&mut self) {
        self.from.fill(u16::MAX);
        self.len.fill(0);
        self.ends.fill(0);
    }

    /// Sets the values of beam `i` that count: from `from`, below `below`.
    fn set(&mut self, i: usize, from: u64, below: u16) {
        self.from[i] = from.min(u64::from(u16::MAX)) as u16;
        self.len[i] = below.saturating_sub(self.from[i]);
        self.ends[i / BLOCK_LEN] = self.ends[i / BLOCK_LEN].max(below);
    }

    /// Returns whether the value counts.
    #[inline]
    fn has(&self, i: usize, value: u16) -> bool {
        value.wrapping_sub(self.from[i]) < self.len[i]
    }

    /// Returns whether a value of beam `i` can count.
    fn has_any(&self, i: usize) -> bool {
        self.len[i] > 0
    }

    /// Returns the number of beams whose value counts. `shortest` has the shortest value of each block that may count.
    /// In most rooms, most blocks can be skipped, because their shortest value is too long.
    fn count(&self, ranges: &[u16], shortest: &[u16]) -> u16 {
        let may_count = |&block: &usize| shortest[block] < self.ends[block];
        let blocks = (0..ranges.len().div_ceil(BLOCK_LEN).min(self.ends.len())).filter(may_count);
        blocks.map(|block| self.count_in(block, ranges)).sum()
    }

    /// Returns the number of beams of a block whose value counts.
    #[inline(never)]
    fn count_in(&self, block: usize, ranges: &[u16]) -> u16 {
        let beams = block * BLOCK_LEN..ranges.len().min((block + 1) * BLOCK_LEN);
        let spans = self.from[beams.clone()].iter().zip(&self.len[beams.clone()]);
        let values = spans.zip(&ranges[beams]);
        values.map(|((&from, &len), &value)| u16::from(value.wrapping_sub(from) < len)).sum()
    }
}
