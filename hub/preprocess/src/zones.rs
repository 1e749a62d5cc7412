//! Check whether something is near the robot: the minimal distance check of the paper. A zone is a circle around the
//! robot's center.
//!
//! A [`ZoneChecker`] compares each scan with a table, and counts violations over several scans. For each beam and each
//! circle, the table has the ranges that lie inside the circle. The table is computed once per layout of the scans, in
//! floating point and millimeters. To check a scan, it is then sufficient to compare integers in device units.

use std::f64::consts::TAU;

use scanhub_schema::{MAX_ZONES, Pose, Scan, ScanHead, Verdict, Zone, Zones, in_sector_mdeg};

use crate::search::position;

/// Sector of the sensor's view in which parts of the robot itself are visible.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sector {
    /// First angle of the sector in 1/1000 degree, as in the scan: 0 ahead, counter-clockwise.
    pub from_mdeg: i32,
    /// Last angle of the sector in 1/1000 degree, inclusive.
    pub to_mdeg: i32,
    /// Range at which the robot's own body ends. Nearer readings are ignored.
    pub range_mm: u16,
}

/// Maximum number of sectors of a sensor. Further sectors are ignored.
pub const MAX_SECTORS: usize = 64;

/// Settings of a check.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Radii of the circles, the largest first. Only the first [`MAX_ZONES`] are used.
    pub radii_mm: Vec<u16>,
    /// The robot's own body. Where sectors overlap, the one with the largest range is used.
    pub body_mask: Vec<Sector>,
    /// Distance in mm by which a circle is extended along every beam that meets it.
    pub margin_mm: u16,
    /// Number of beams that must end inside a zone for a scan to violate the zone. 0 counts as 1.
    pub min_beams: u16,
    /// Number of consecutive scans that must violate a zone before the verdict reports the violation. 0 counts as 1.
    pub min_scans: u16,
    /// Maximum share of invalid beams among the beams through the largest circle. If the share is larger, the verdict
    /// is unknown.
    pub max_invalid: f64,
    /// Whether an object between the sensor and the near side of a circle counts as outside the circle. It matters only
    /// if the sensor is outside the circle. If it is not set, such an object counts as inside.
    pub exact: bool,
    /// Whether a beam without a return counts as a beam that has met nothing. Otherwise, the beam is invalid.
    pub no_return_is_far: bool,
}

impl Default for Settings {
    /// Returns circles of 1 m and 0.6 m (paper III.B.1). One beam in one scan is a violation, and a tenth of the beams
    /// may be invalid.
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

/// Compares the scans of one sensor with circles around the robot's center.
///
/// The paper leaves some cases open. These rules apply to them:
/// - The count of scans restarts after a silence, after a scan with too many invalid beams, and after a change of the
///   sensor's layout. Until it reaches `min_scans`, the absence of a violation proves nothing, so the verdict is
///   unknown. Clear would be a guess.
/// - A beam is relevant if it can have a reading inside the largest circle and outside the robot's own body. The
///   reading must be possible in the scan's units, below the scan's codes. The share of invalid beams is computed only
///   from relevant beams.
/// - If fewer than `min_beams` beams are relevant, no zone can ever be violated, so the verdict is unknown. Examples
///   are an empty scan, a check without circles, a pose that is not finite, and a sensor whose beams all miss the
///   largest circle.
pub struct ZoneChecker {
    min_beams: u16,
    min_scans: u16,
    table: Table,
    /// Number of scans since the start, a silence, a scan with too many invalid beams or a change of the layout,
    /// whichever was last.
    scan_count: u16,
    /// For each circle, the number of consecutive scans in which enough beams ended inside the circle.
    streaks: [u16; MAX_ZONES],
    /// Whether scans may be older than their stamps, because they come from a backlog.
    is_backlogged: bool,
}

impl ZoneChecker {
    /// Creates a check for a sensor at `pose` with at most `beams` beams. Further beams are ignored.
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

    /// Writes the result for `scan` into `out`. Writes every byte of `out`. If the layout of the scans has changed, the
    /// table is computed first.
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
            // The invalid beams may have ended a run of violations although the object is still inside the zone.
            self.scan_count = 0;
        }
    }

    /// Checks an incomplete scan of `count` beams with the unit `unit_um`. `ranges` are the first ranges of the scan.
    /// For a scan with exact `angles`, `ranges` are all ranges, and a nearer point may still replace one of them.
    ///
    /// Returns a warning if the points that have arrived violate a zone. Otherwise returns `None`. Also returns `None`
    /// before the first complete scan, and if `count` or `unit_um` differs from the last complete scan.
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

    /// Writes the result for a silence into `out`: only the circles are known. The count of scans and the counts of
    /// violations restart.
    pub fn write_stale(&mut self, out: &mut Zones) {
        self.reset();
        *out = Zones { count: self.table.circles as u8, ..Zones::unknown() };
        self.write_circles(&[0; MAX_ZONES], out);
    }

    /// Sets whether scans may be older than their stamps from now on. The verdict on such a scan is stop if the
    /// smallest circle is violated, and unknown otherwise.
    pub fn set_backlogged(&mut self, is_backlogged: bool) {
        self.is_backlogged = is_backlogged;
    }

    /// Returns the number of relevant beams of the last scan's layout; 0 before the first scan.
    pub fn effective_beams(&self) -> u16 {
        self.table.effective_beams
    }

    /// Returns whether fewer beams are relevant than a violation needs. The verdict is then always unknown.
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
    /// Radii of the circles; 0 for unused circles.
    radii_mm: [u16; MAX_ZONES],
    /// The robot's own body: the sectors, and their number.
    sectors: ([Sector; MAX_SECTORS], usize),
    margin_mm: u16,
    exact: bool,
    no_return_is_far: bool,
    max_invalid: f64,

    layout: Layout,
    /// For each circle and each beam, the valid readings inside the circle and beyond the robot's own body.
    inside: [Spans; MAX_ZONES],
    nearest: Nearest,
    /// 1 for each relevant beam, which can have a reading inside the largest circle; 0 for each other beam.
    is_effective: Box<[u16]>,
    /// Number of relevant beams.
    effective_beams: u16,
    /// Maximum number of invalid beams. With more, the verdict is unknown.
    max_invalid_beams: u16,
}

/// Points of a scan inside the circles.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct ZoneHits {
    /// Number of beams that end inside each circle.
    inside: [u16; MAX_ZONES],
    /// Beam whose point is nearest to the robot's center, and the distance of this point in mm, rounded down. If
    /// several points are equally near, the first beam.
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
            // If the sensor is at the robot's center, `q` is 0 for all beams. Skip the sine and cosine, because scans
            // with exact angles need this function often.
            return Beam { q: 0.0, own };
        }
        let (ux, uy) = self.pose.direction(angle);
        Beam { q: sx * ux + sy * uy, own }
    }

    /// Returns the readings of `beam` inside the circle with the index `zone`: the first reading, and the reading after
    /// the last one, in device units.
    fn span(&self, beam: &Beam, zone: usize) -> (u64, u64) {
        let unit_mm = self.layout.unit_mm();
        let (sx, sy) = self.sensor_mm();
        let (lo_mm, hi_mm) = self.chord_mm(beam.q, sx * sx + sy * sy, f64::from(self.radii_mm[zone]));
        let from = if self.exact && lo_mm > 0 { floor(lo_mm as f64 / unit_mm) as u64 + 1 } else { 0 };
        (from.max(beam.own), in_units(hi_mm as f64, unit_mm))
    }

    /// Returns the number of relevant beams without a reading. The scanner's own points are `spacing` radians apart. A
    /// beam that was not measured counts only if the measured beams on both sides are more than two spacings apart.
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

    /// Returns the number of relevant beams that were not measured, but lie between two measured beams that are at most
    /// two spacings apart.
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

    /// Returns the points inside the circles. `ranges` are the first ranges of a scan with the table's layout. If there
    /// are exact `angles`, the points are computed from these angles.
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
        // A point at a greater range than `limit` is outside all circles, and farther away than the nearest point so
        // far.
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

    /// Returns the beam of a point, and the distance of the point from the robot's center in mm. `square` is the square
    /// of this distance minus the square of the sensor's distance from the center, in device units.
    fn at_distance(&self, beam: usize, square: f64) -> (u16, u32) {
        let unit_mm = self.layout.unit_mm();
        let (sx, sy) = self.sensor_mm();
        let distance_mm = (square * unit_mm * unit_mm + sx * sx + sy * sy).max(0.0).sqrt();
        (beam as u16, floor(distance_mm) as u32)
    }

    /// Returns the sensor's position in the robot's frame, in mm.
    fn sensor_mm(&self) -> (f64, f64) {
        (1000.0 * self.pose.x_m, 1000.0 * self.pose.y_m)
    }

    /// Returns the range in mm at which the robot's own body ends along the beam at `angle`; 0 if there is no body.
    fn body_mask_mm(&self, angle: f64) -> u64 {
        let sectors = &self.sectors.0[..self.sectors.1];
        if sectors.is_empty() {
            return 0;
        }
        let angle_mdeg = in_sector_mdeg(angle);
        let is_in_sector = |sector: &&Sector| (sector.from_mdeg..=sector.to_mdeg).contains(&angle_mdeg);
        sectors.iter().filter(is_in_sector).map(|sector| u64::from(sector.range_mm)).max().unwrap_or(0)
    }

    /// Returns the two ranges in mm between which a beam is inside a circle; 0 and 0 if the beam misses the circle. `q`
    /// is s.u and `square` is |s|^2, where s is the sensor's position and u is the beam's direction (a line through a
    /// circle; paper III.B.1).
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

/// Values of a beam from which its readings inside a circle are computed.
struct Beam {
    /// The scalar product s.u in mm, where s is the sensor's position and u is the beam's direction.
    q: f64,
    /// Range at which the robot's own body ends, in device units.
    own: u64,
}

/// Returns the minimum number of device units that is not less than `mm`.
fn in_units(mm: f64, unit_mm: f64) -> u64 {
    ceil(mm / unit_mm) as u64
}

/// Maximum relative rounding error of a quotient.
const ROUNDING_ERROR: f64 = 1e-6;

/// Difference from a whole number within which a value counts as this whole number. Apart from that, values are rounded
/// so that rounding never makes a verdict clear. With the tolerance, an object exactly on a circle is always outside,
/// whatever the errors of sine and cosine are.
const ROUNDING_MM: f64 = 1e-6;

fn floor(value: f64) -> f64 {
    if (value - value.round()).abs() <= ROUNDING_MM { value.round() } else { value.floor() }
}

fn ceil(value: f64) -> f64 {
    if (value - value.round()).abs() <= ROUNDING_MM { value.round() } else { value.ceil() }
}

/// Search for the reading that is nearest to the robot's center, exact to the millimeter (rounded down). The distances
/// of single beams are computed only for the few blocks of beams that can contain the nearest reading.
struct Nearest {
    /// Readings that count: valid readings beyond the robot's own body.
    measurable: Spans,
    /// For each beam, twice the scalar product s.u in device units, where s is the sensor's position and u is the
    /// beam's direction.
    twice_q: Box<[f64]>,
    /// For each block of beams, the minimum of `twice_q`.
    min_twice_q: Box<[f64]>,
    /// For each block of beams, a lower bound of the readings that count in the current scan.
    shortest: Box<[u16]>,
    /// For each block of beams, a lower bound of the values that [`Nearest::find`] compares.
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

    /// Computes `min_twice_q`. Call this function when `twice_q` is set for all beams.
    fn finish(&mut self) {
        for (block, min_value) in self.twice_q.chunks(BLOCK_LEN).zip(&mut self.min_twice_q) {
            *min_value = block.iter().copied().fold(f64::INFINITY, f64::min);
        }
    }

    /// Returns the beam whose point is nearest to the center, or the first of several such beams. Also returns the
    /// square of the point's distance from the center minus the square of the sensor's distance. This value is
    /// r^2 + 2qr in device units, where r is the range and q is s.u.
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

    /// Computes `shortest` and `bounds` of each block. A bound follows from `shortest` and `min_twice_q` of its block.
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

    /// Returns the nearest reading of the block, or `nearest` if no reading of the block is nearer. Both are pairs of
    /// r^2 + 2qr and the index of the beam.
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

/// Number of beams of a block. It is so low that the directions of a block's beams differ little, and so high that
/// there are few blocks.
const BLOCK_LEN: usize = 32;

/// For each beam, the readings that count: those in `from..from + len`, in device units. A single comparison of
/// integers tests a reading.
#[derive(Clone)]
struct Spans {
    /// Minimum reading that counts; the maximum of the type for beams that do not exist.
    from: Box<[u16]>,
    /// Number of readings that count.
    len: Box<[u16]>,
    /// For each block of beams, the reading from which on no reading counts.
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

    /// Sets which readings of beam `i` count: those from `from` on that are less than `below`.
    fn set(&mut self, i: usize, from: u64, below: u16) {
        self.from[i] = from.min(u64::from(u16::MAX)) as u16;
        self.len[i] = below.saturating_sub(self.from[i]);
        self.ends[i / BLOCK_LEN] = self.ends[i / BLOCK_LEN].max(below);
    }

    /// Returns whether the reading `value` of beam `i` counts.
    #[inline]
    fn has(&self, i: usize, value: u16) -> bool {
        value.wrapping_sub(self.from[i]) < self.len[i]
    }

    /// Returns whether any reading of beam `i` can count.
    fn has_any(&self, i: usize) -> bool {
        self.len[i] > 0
    }

    /// Returns the number of beams whose reading counts. For each block, `shortest` has a lower bound of the readings
    /// that may count. In most rooms, most blocks can be skipped, because even this bound is too long.
    fn count(&self, ranges: &[u16], shortest: &[u16]) -> u16 {
        let may_count = |&block: &usize| shortest[block] < self.ends[block];
        let blocks = (0..ranges.len().div_ceil(BLOCK_LEN).min(self.ends.len())).filter(may_count);
        blocks.map(|block| self.count_in(block, ranges)).sum()
    }

    /// Returns the number of beams of a block whose reading counts.
    #[inline(never)]
    fn count_in(&self, block: usize, ranges: &[u16]) -> u16 {
        let beams = block * BLOCK_LEN..ranges.len().min((block + 1) * BLOCK_LEN);
        let spans = self.from[beams.clone()].iter().zip(&self.len[beams.clone()]);
        let values = spans.zip(&ranges[beams]);
        values.map(|((&from, &len), &value)| u16::from(value.wrapping_sub(from) < len)).sum()
    }
}
