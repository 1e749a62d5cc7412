//! Checks whether something is near the robot: the paper's minimal distance check, with circles around the robot's
//! centre. Refuses to know where beams cross circles: the table has that in device units, so a scan costs only
//! comparisons of integers.

mod nearest;
mod spans;
mod table;

use schema::{Pose, Scan, Verdict, ZONES, Zone, Zones};
use table::{Layout, Met, Table};

/// A part of the sensor's view in which something of the robot itself stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sector {
    /// First sensor angle in 1/1000 degree, as in the scan: 0 ahead, counter-clockwise.
    pub from_mdeg: i32,
    /// Last sensor angle in 1/1000 degree; it belongs to the sector.
    pub to_mdeg: i32,
    /// Readings nearer than this are the robot's own body and are ignored.
    pub range_mm: u16,
}

/// The most sectors of a sensor; those beyond are left out.
pub const SECTORS: usize = 64;

/// What a check is made from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings<'a> {
    /// Radii of the circles, the largest first, at most [`ZONES`]; those beyond are left out.
    pub radii_mm: &'a [u16],
    /// The robot's own body; where sectors overlap, the farthest range holds.
    pub self_min: &'a [Sector],
    /// Added to a circle along every beam that meets it.
    pub margin_mm: u16,
    /// A zone is violated by so many beams of a scan; 0 is 1.
    pub min_beams: u16,
    /// And by so many scans, one after the other; 0 is 1.
    pub min_scans: u16,
    /// The verdict is unknown if a greater share of the beams through the largest circle is invalid.
    pub max_invalid: f64,
    /// What stands before the circle, between a sensor outside and the circle's near side, is not inside.
    pub exact: bool,
    /// A beam of which nothing came back has met nothing; otherwise it is invalid.
    pub no_return_is_far: bool,
}

impl Default for Settings<'static> {
    /// 1 m and 0.6 m (paper III.B.1), one beam, one scan; a tenth of the beams may be invalid.
    fn default() -> Self {
        Settings {
            radii_mm: &[1000, 600],
            self_min: &[],
            margin_mm: 0,
            min_beams: 1,
            min_scans: 1,
            max_invalid: 0.10,
            exact: true,
            no_return_is_far: true,
        }
    }
}

/// What a part of a scan tells: never that the robot's surroundings are clear.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Warning {
    /// [`Verdict::Slow`] or [`Verdict::Stop`].
    pub verdict: Verdict,
    /// The beam of the nearest point so far.
    pub beam: u16,
    /// Its distance from the robot's centre in mm, rounded down.
    pub distance_mm: u32,
}

/// Compares scans of one sensor with its circles.
///
/// Where the design leaves something open:
/// - until `min_scans` scans were seen since the start, a silence or a change of the sensor's layout, no zone can be
///   violated; the verdict is unknown then, because clear would be a guess;
/// - a beam can tell something if there is a reading of it, in the scan's units and below its codes, that lies inside
///   the largest circle and not in the robot's own body; all others count neither as invalid nor among all;
/// - where fewer beams can tell something than a violation takes, nothing would ever be violated: unknown. So it is with
///   an empty scan, no circle at all, a pose that is not finite, and a sensor that looks past the largest circle.
pub struct Check {
    min_beams: u16,
    min_scans: u16,
    table: Table,
    /// Scans since the start, a silence or another layout.
    seen: u16,
    /// Scans one after the other in which enough beams met something, by circle.
    streaks: [u16; ZONES],
    /// Scans may be older than they seem.
    is_late: bool,
}

impl Check {
    /// A check for the sensor that sits at `pose` and has at most `beams` beams; those beyond are passed over.
    pub fn new(pose: Pose, settings: &Settings<'_>, beams: usize) -> Check {
        Check {
            min_beams: settings.min_beams.max(1),
            min_scans: settings.min_scans.max(1),
            table: Table::new(pose, settings, beams),
            seen: 0,
            streaks: [0; ZONES],
            is_late: false,
        }
    }

    /// Writes what `scan` tells into `out`, every byte of it. The first scan of a layout costs a table; no other does.
    pub fn update(&mut self, scan: &Scan, out: &mut Zones) {
        let layout = Layout::of(scan, self.table.most());
        if self.table.layout() != layout {
            self.table.make(layout);
            self.forget();
        }
        self.seen = self.seen.saturating_add(1);
        let ranges = &scan.ranges()[..scan.beams().min(self.table.most())];
        let invalid = self.table.invalid(ranges, scan.spacing);
        let Met { inside, nearest } = self.table.met(ranges, scan.exact_angles());
        let is_enough = self.seen >= self.min_scans && !self.is_blind();
        let is_known = is_enough && !self.is_late && invalid <= self.table.most_invalid();
        for (streak, &beams) in self.streaks.iter_mut().zip(&inside).take(self.table.circles()) {
            *streak = if beams >= self.min_beams { streak.saturating_add(1) } else { 0 };
        }
        out.verdict = self.verdict(is_known) as u8;
        out.count = self.table.circles() as u8;
        (out.nearest_beam, out.nearest_mm) = nearest.unwrap_or((Zones::NO_BEAM, Zones::NO_DISTANCE));
        out.invalid_beams = invalid;
        self.write_circles(&inside, out);
    }

    /// What the `ranges` of a scan tell that is not complete, of so many beams `count` and `unit_um` as the last one: the zone
    /// that it violates if nothing else comes, if any. These are the first ones; or all, with their exact `angles`, of a scan
    /// that has such: then a nearer point may still take the place of one. A scan whose first one has yet to be seen tells
    /// nothing.
    pub fn early(&mut self, count: usize, unit_um: u32, ranges: &[u16], angles: &[f32]) -> Option<Warning> {
        if !self.table.layout().is_of(count, unit_um) || self.is_blind() {
            return None;
        }
        let ranges = &ranges[..ranges.len().min(count).min(self.table.most())];
        let Met { inside, nearest } = self.table.met(ranges, angles);
        let will_be = |zone: &usize| {
            inside[*zone] >= self.min_beams && self.streaks[*zone].saturating_add(1) >= self.min_scans
        };
        let smallest = self.table.circles().checked_sub(1)?;
        let zone = (0..=smallest).rev().find(will_be)?;
        let verdict = if zone == smallest { Verdict::Stop } else { Verdict::Slow };
        let (beam, distance_mm) = nearest?;
        Some(Warning { verdict, beam, distance_mm })
    }

    /// Writes into `out` what to say when scans stay out: nothing is known but the circles. Scans have to follow each
    /// other anew.
    pub fn stale(&mut self, out: &mut Zones) {
        self.forget();
        *out = Zones { count: self.table.circles() as u8, ..Zones::unknown() };
        self.write_circles(&[0; ZONES], out);
    }

    /// The scans from now on may be older than they seem, or are not any more. What such a scan sees in the smallest circle
    /// counts; else the verdict is unknown.
    pub fn doubt(&mut self, is_late: bool) {
        self.is_late = is_late;
    }

    /// Beams of the last scan's layout that can tell something of the largest circle; none before the first scan.
    pub fn telling(&self) -> u16 {
        self.table.telling()
    }

    /// Fewer beams can tell something than a violation takes: the verdict is always unknown.
    pub fn is_blind(&self) -> bool {
        self.telling() < self.min_beams
    }

    fn forget(&mut self) {
        self.seen = 0;
        self.streaks = [0; ZONES];
    }

    fn is_violated(&self, zone: usize) -> bool {
        self.streaks[zone] >= self.min_scans
    }

    /// What is seen inside the smallest circle outweighs what is not known.
    fn verdict(&self, is_known: bool) -> Verdict {
        match self.table.circles().checked_sub(1) {
            None => Verdict::Unknown,
            Some(smallest) if self.is_violated(smallest) => Verdict::Stop,
            _ if !is_known => Verdict::Unknown,
            Some(smallest) if (0..smallest).any(|zone| self.is_violated(zone)) => Verdict::Slow,
            _ => Verdict::Clear,
        }
    }

    fn write_circles(&self, beams: &[u16; ZONES], out: &mut Zones) {
        out.flags = if self.seen < self.min_scans { Zones::PROVISIONAL } else { 0 };
        out.reserved = 0;
        for (zone, circle) in out.zone_array.iter_mut().enumerate() {
            *circle = Zone {
                radius_mm: self.table.radius_mm(zone),
                beams: beams[zone],
                violated: u8::from(self.is_violated(zone)),
                reserved: [0; 3],
            };
        }
    }
}
