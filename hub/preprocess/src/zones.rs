//! Checks whether something is near the robot: the paper's minimal distance check, with circles around the robot's
//! centre. Refuses to know where beams cross circles: the table has that in device units, so a scan costs only
//! comparisons of integers.

mod nearest;
mod spans;
mod table;

use schema::{Pose, Scan, Verdict, ZONES, Zone, Zones};
use table::{Layout, Table};

/// A part of the sensor's view in which something of the robot itself stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sector {
    /// First sensor angle in 1/1000 degree.
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
    /// A check for the sensor that sits at `pose`.
    pub fn new(pose: Pose, settings: &Settings<'_>) -> Check {
        Check {
            min_beams: settings.min_beams.max(1),
            min_scans: settings.min_scans.max(1),
            table: Table::new(pose, settings),
            seen: 0,
            streaks: [0; ZONES],
            is_late: false,
        }
    }

    /// Writes what `scan` tells into `out`, every byte of it. The first scan of a layout costs a table; no other does.
    pub fn update(&mut self, scan: &Scan, out: &mut Zones) {
        let layout = Layout::of(scan);
        if self.table.layout() != layout {
            self.table.make(layout);
            self.forget();
        }
        self.seen = self.seen.saturating_add(1);
        let ranges = &scan.range_array;
        let invalid = self.table.invalid(ranges);
        let nearest = self.table.nearest(ranges);
        let is_enough = self.seen >= self.min_scans && !self.is_blind();
        let is_known = is_enough && !self.is_late && invalid <= self.table.most_invalid();
        let mut beams = [0; ZONES];
        for (zone, beams) in beams.iter_mut().enumerate().take(self.table.circles()) {
            *beams = self.table.inside(zone, ranges);
            let streak = &mut self.streaks[zone];
            *streak = if *beams >= self.min_beams { streak.saturating_add(1) } else { 0 };
        }
        out.verdict = self.verdict(is_known) as u8;
        out.count = self.table.circles() as u8;
        (out.nearest_beam, out.nearest_mm) = nearest.unwrap_or((Zones::NO_BEAM, Zones::NO_DISTANCE));
        out.invalid_beams = invalid;
        self.write_circles(&beams, out);
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

#[cfg(test)]
mod tests {
    use super::*;

    const INVALID: u16 = 0x1FFF - 5;

    /// A hundred beams of 180 degrees: nothing within 5 m but what is named.
    fn scan(beams: &[(usize, u16)]) -> Scan {
        let mut scan = Scan { count: 100, unit_mm: 1, range_bits: 13, step_mdeg: 1800, ..Scan::default() };
        scan.range_array[..100].fill(5000);
        beams.iter().for_each(|&(i, range_mm)| scan.range_array[i] = range_mm);
        scan
    }

    fn told(check: &mut Check, scan: &Scan) -> Zones {
        let mut out = Zones::unknown();
        check.update(scan, &mut out);
        out
    }

    fn verdict(settings: &Settings<'_>, scan: &Scan) -> Verdict {
        told(&mut Check::new(Pose::default(), settings), scan).verdict()
    }

    #[test]
    fn the_two_circles_of_the_paper() {
        let settings = Settings::default();
        assert_eq!(verdict(&settings, &scan(&[])), Verdict::Clear);
        assert_eq!(verdict(&settings, &scan(&[(7, 1000)])), Verdict::Clear);
        assert_eq!(verdict(&settings, &scan(&[(7, 999)])), Verdict::Slow);
        assert_eq!(verdict(&settings, &scan(&[(7, 600)])), Verdict::Slow);
        assert_eq!(verdict(&settings, &scan(&[(7, 599), (9, 0)])), Verdict::Stop);
        let mut check = Check::new(Pose::default(), &settings);
        let out = told(&mut check, &scan(&[(7, 599), (9, 0), (12, 700), (13, INVALID)]));
        assert_eq!((out.nearest(), out.invalid_beams, out.flags), (Some((9, 0)), 1, 0));
        let circles = out.zones().iter().map(|zone| (zone.radius_mm, zone.beams, zone.violated));
        assert!(circles.eq([(1000, 3, 1), (600, 2, 1)]));
    }

    #[test]
    fn a_violation_takes_enough_beams_in_enough_scans_and_a_start_is_unknown() {
        let settings = Settings { min_beams: 2, min_scans: 3, ..Settings::default() };
        let mut check = Check::new(Pose::default(), &settings);
        let (near, single) = (scan(&[(7, 700), (8, 500), (9, 500)]), scan(&[(7, 500)]));
        let mut next = |scan: &Scan| {
            let out = told(&mut check, scan);
            (out.verdict(), out.flags)
        };
        assert_eq!(next(&near), (Verdict::Unknown, Zones::PROVISIONAL));
        assert_eq!(next(&near), (Verdict::Unknown, Zones::PROVISIONAL));
        assert_eq!(next(&near), (Verdict::Stop, 0));
        assert_eq!(next(&single), (Verdict::Clear, 0));
        assert_eq!([(); 3].map(|()| next(&near).0), [Verdict::Clear, Verdict::Clear, Verdict::Stop]);
        let mut cm = scan(&[]);
        cm.unit_mm = 10;
        assert_eq!(next(&cm), (Verdict::Unknown, Zones::PROVISIONAL), "another layout is another start");
    }

    #[test]
    fn a_silence_is_unknown_and_scans_follow_each_other_anew() {
        let settings = Settings { min_scans: 2, ..Settings::default() };
        let mut check = Check::new(Pose::default(), &settings);
        let near = scan(&[(7, 500)]);
        assert_eq!([(); 2].map(|()| told(&mut check, &near).verdict()), [Verdict::Unknown, Verdict::Stop]);
        let mut out = told(&mut check, &near);
        check.stale(&mut out);
        assert_eq!((out.verdict(), out.nearest(), out.flags), (Verdict::Unknown, None, Zones::PROVISIONAL));
        let circles = out.zones().iter().map(|zone| (zone.radius_mm, zone.beams, zone.violated));
        assert!(circles.eq([(1000, 0, 0), (600, 0, 0)]));
        assert_eq!([(); 2].map(|()| told(&mut check, &near).verdict()), [Verdict::Unknown, Verdict::Stop]);
    }

    #[test]
    fn too_many_invalid_beams_hide_all_but_a_stop() {
        let invalid: Vec<_> = (0..11).map(|i| (i, INVALID)).collect();
        let settings = Settings::default();
        assert_eq!(verdict(&settings, &scan(&invalid[..10])), Verdict::Clear, "a tenth is not too many");
        assert_eq!(verdict(&settings, &scan(&invalid)), Verdict::Unknown);
        let with = |range_mm| scan(&[&invalid[..], &[(20, range_mm)]].concat());
        assert_eq!(verdict(&settings, &with(700)), Verdict::Unknown);
        assert_eq!(verdict(&settings, &with(500)), Verdict::Stop);
        let far: Vec<_> = (0..100).map(|i| (i, 0x1FFF - 8 * (i as u16 % 2))).collect();
        assert_eq!(verdict(&settings, &scan(&far)), Verdict::Clear, "nothing came back");
        let strict = Settings { no_return_is_far: false, ..settings };
        assert_eq!(verdict(&strict, &scan(&far)), Verdict::Unknown);
    }

    #[test]
    fn the_robot_itself_is_neither_near_nor_invalid() {
        // Beams 0 to 10; there the body ends before the circle, or hides all of it.
        let partly = [Sector { from_mdeg: 0, to_mdeg: 18_000, range_mm: 400 }];
        let wholly = [Sector { range_mm: 1000, ..partly[0] }, partly[0]];
        let body: Vec<_> = (0..12).map(|i| (i, 399)).collect();
        let blind: Vec<_> = (0..11).map(|i| (i, INVALID)).collect();
        for (self_min, of_blind) in [(&partly[..], Verdict::Unknown), (&wholly[..], Verdict::Clear)] {
            let settings = Settings { self_min, ..Settings::default() };
            assert_eq!(verdict(&settings, &scan(&body[..11])), Verdict::Clear);
            assert_eq!(verdict(&settings, &scan(&body)), Verdict::Stop, "beam 11 is none of the body's");
            assert_eq!(verdict(&settings, &scan(&blind)), of_blind);
            let mut check = Check::new(Pose::default(), &settings);
            assert_eq!(told(&mut check, &scan(&body[..11])).nearest(), Some((11, 5000)));
        }
        let settings = Settings { self_min: &partly, ..Settings::default() };
        assert_eq!(verdict(&settings, &scan(&[(3, 400)])), Verdict::Stop, "where the body ends");
    }

    #[test]
    fn who_is_told_nothing_knows_nothing() {
        let settings = Settings::default();
        assert_eq!(verdict(&settings, &Scan::default()), Verdict::Unknown);
        assert_eq!(verdict(&Settings { radii_mm: &[], ..settings }, &scan(&[(7, 500)])), Verdict::Unknown);
        for (x_m, yaw_rad) in [(f64::NAN, 0.0), (0.0, f64::INFINITY), (f64::INFINITY, 0.0)] {
            let mut check = Check::new(Pose { x_m, yaw_rad, ..Pose::default() }, &settings);
            assert_eq!(told(&mut check, &scan(&[])).verdict(), Verdict::Unknown);
        }
    }

    #[test]
    fn an_old_scan_is_never_clear() {
        let mut check = Check::new(Pose::default(), &Settings::default());
        let mut of = |is_late, scan: &Scan| {
            check.doubt(is_late);
            told(&mut check, scan).verdict()
        };
        assert_eq!(of(false, &scan(&[])), Verdict::Clear);
        assert_eq!(of(true, &scan(&[])), Verdict::Unknown);
        assert_eq!(of(true, &scan(&[(7, 700)])), Verdict::Unknown);
        assert_eq!(of(true, &scan(&[(7, 500)])), Verdict::Stop);
        assert_eq!(of(false, &scan(&[])), Verdict::Clear);
    }

    #[test]
    fn a_circle_that_cannot_be_violated_is_never_clear() {
        let settings = Settings::default();
        let of = |pose: Pose, settings: &Settings<'_>, scan: &Scan| {
            let mut check = Check::new(pose, settings);
            (told(&mut check, scan).verdict(), check.telling(), check.is_blind())
        };
        let whole = Pose::default();
        let most = Settings { min_beams: 100, ..settings };
        assert_eq!(of(whole, &most, &scan(&[])), (Verdict::Clear, 100, false));
        let more = Settings { min_beams: 101, ..settings };
        assert_eq!(of(whole, &more, &scan(&[(7, 0)])), (Verdict::Unknown, 100, true));
        let body = [Sector { from_mdeg: 0, to_mdeg: 18_000, range_mm: 1000 }];
        let masked = Settings { self_min: &body, ..most };
        assert_eq!(of(whole, &masked, &scan(&[])), (Verdict::Unknown, 89, true));
        let all = [Sector { to_mdeg: 180_000, ..body[0] }];
        assert_eq!(of(whole, &Settings { self_min: &all, ..settings }, &scan(&[])).0, Verdict::Unknown);
        // 2 m ahead of the centre it looks away from the circle; turned about, into it.
        let away = Pose { x_m: 2.0, ..Pose::default() };
        assert_eq!(of(away, &settings, &scan(&[])), (Verdict::Unknown, 0, true));
        let back = Pose { yaw_rad: std::f64::consts::PI, ..away };
        assert_eq!(of(back, &settings, &scan(&[])).0, Verdict::Clear);
        // So far away that 13 bits of mm do not reach it; those of cm do.
        let far = Pose { x_m: 9.2, ..back };
        assert_eq!(of(far, &settings, &scan(&[])), (Verdict::Unknown, 0, true));
        assert_eq!(of(far, &settings, &Scan { unit_mm: 10, ..scan(&[]) }).0, Verdict::Clear);
    }
}
