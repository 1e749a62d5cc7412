//! Tests of zones, verdicts and early warnings. Zones are compared with two slow versions that use no table. The first
//! version evaluates the formula beam by beam, and must have the same results. The second version uses plain geometry,
//! and must agree except within a millimeter of a circle. The warning for a partial scan is compared with the result of
//! another check. This check gets the same scans, but the beams that have not arrived meet no objects.

mod scans;

use fastrand::Rng;
use scanhub_preprocess::zones::{Sector, Settings, Warning, ZoneChecker};
use scanhub_schema::{ArrayFlags, Code, Pose, Scan, ScanHead, Verdict, Zones};

/// Random settings, and a random pose of the sensor.
struct Case {
    pose: Pose,
    settings: Settings,
}

impl Case {
    fn new(random: &mut Rng) -> Case {
        let mut radii_mm: Vec<u16> = (0..random.usize(1..=8)).map(|_| random.u16(50..3000)).collect();
        radii_mm.sort_unstable_by(|a, b| b.cmp(a));
        let sectors = (0..random.usize(..4)).map(|_| {
            let from_mdeg = 250 * random.i32(-360..360);
            Sector { from_mdeg, to_mdeg: from_mdeg + 250 * random.i32(0..80), range_mm: random.u16(..2000) }
        });
        let body_mask = sectors.collect();
        let settings = Settings {
            radii_mm,
            body_mask,
            margin_mm: if random.bool() { 0 } else { random.u16(..200) },
            min_beams: random.u16(1..4),
            min_scans: random.u16(1..4),
            max_invalid: [0.0, 0.05, 0.1, 0.5][random.usize(..4)],
            exact: random.u8(..3) > 0,
            no_return_is_far: random.bool(),
        };
        Case { pose: scans::pose(random), settings }
    }

    fn check(&self) -> ZoneChecker {
        ZoneChecker::new(self.pose, &self.settings, 401)
    }

    /// Returns the direction of a beam as a unit vector, and the range in mm at which the beam leaves the robot's own
    /// body.
    fn beam(&self, scan: &Scan, i: usize) -> ([f64; 2], f64) {
        let mdeg = (1000.0 * (scan.first_angle + i as f64 * scan.step).to_degrees()).round() as i32;
        let sense = if self.pose.upside_down == 1 { -1.0 } else { 1.0 };
        let angle = self.pose.yaw_rad + sense * (f64::from(mdeg) / 1000.0).to_radians();
        let covers = |sector: &&Sector| sector.from_mdeg <= mdeg && mdeg <= sector.to_mdeg;
        let own =
            self.settings.body_mask.iter().filter(covers).map(|sector| sector.range_mm).max().unwrap_or(0);
        ([angle.cos(), angle.sin()], f64::from(own))
    }

    fn sensor_mm(&self) -> [f64; 2] {
        [self.pose.x_m * 1000.0, self.pose.y_m * 1000.0]
    }

    /// Returns the two ranges in mm between which a beam is inside a circle. The function uses the formula.
    fn chord(&self, u: [f64; 2], radius: f64) -> (f64, f64) {
        let [x, y] = self.sensor_mm();
        let (q, square) = (x * u[0] + y * u[1], x * x + y * y);
        let disc = q * q - (square - radius * radius);
        let (lo, hi) = if square < radius * radius {
            (0.0, -q + disc.sqrt())
        } else if disc > 0.0 && q < 0.0 {
            (-q - disc.sqrt(), -q + disc.sqrt())
        } else {
            return (0.0, 0.0);
        };
        let margin = f64::from(self.settings.margin_mm);
        ((lo - margin + 1e-6).floor().max(0.0), (hi + margin - 1e-6).ceil())
    }

    /// Returns whether a reading is inside a circle. The function uses the formula.
    fn violates(&self, u: [f64; 2], own_range: f64, range: f64, radius: f64) -> bool {
        let (lo, hi) = self.chord(u, radius);
        range >= own_range && range < hi && (!self.settings.exact || lo == 0.0 || range > lo)
    }

    /// Returns whether a reading of this beam can be inside the largest circle. It is sufficient to check the shortest
    /// readings beyond both the robot's own body and the near side of the circle.
    fn can_violate(&self, scan: &Scan, u: [f64; 2], own: f64) -> bool {
        let (unit, radius) = (scans::unit_mm(scan), f64::from(self.settings.radii_mm[0]));
        let shortest = (own.max(self.chord(u, radius).0) / unit).floor();
        let values = [shortest, shortest + 1.0].into_iter().filter(|value| *value < f64::from(max(scan) - 8));
        values.into_iter().any(|value| self.violates(u, own, value * unit, radius))
    }

    /// Returns the minimum distance from the robot's center to the part of a beam that counts as occupied because of a
    /// reading at `range`. This part consists of the point and the margin on both sides. If `exact` is not set, it also
    /// includes the beam behind the point.
    fn distance(&self, u: [f64; 2], range: f64) -> f64 {
        let [x, y] = self.sensor_mm();
        let margin = f64::from(self.settings.margin_mm);
        let end = if self.settings.exact { range + margin } else { f64::INFINITY };
        let at = (-(x * u[0] + y * u[1])).clamp((range - margin).max(0.0), end);
        (x + at * u[0]).hypot(y + at * u[1])
    }

    /// Fills `scan` with readings, many of them near a circle or near the end of the robot's own body.
    fn fill(&self, random: &mut Rng, scan: &mut Scan) {
        let max = max(scan);
        let crowded = random.bool();
        let broken = [0, 0, 20, 100][random.usize(..4)];
        for i in 0..usize::from(scan.count) {
            let (u, own) = self.beam(scan, i);
            let (lo, hi) = self
                .chord(u, f64::from(self.settings.radii_mm[random.usize(..self.settings.radii_mm.len())]));
            let near = [lo, hi, own][random.usize(..3)] / scans::unit_mm(scan) + 2.0;
            let anywhere = random.u16(..max - 8);
            let value = match random.u8(..4) {
                0 if crowded => (near as u16).saturating_sub(random.u16(..5)),
                1 if crowded => (near as u16).saturating_add(random.u16(..50)),
                _ => anywhere.max((4_000_000 / scan.unit_um) as u16),
            };
            let value =
                if random.u8(..200) < broken { scans::code(random, scan) } else { value.min(max - 9) };
            scan.arrays().ranges[i] = value;
        }
    }
}

/// Returns the maximum value that the range bits of the scan can hold.
fn max(scan: &Scan) -> u16 {
    scan.no_return
}

/// Reading of a beam: a range in mm, nothing in range, or no reading.
enum BeamReading {
    Range(f64),
    Far,
    Nothing,
}

fn beam_reading(scan: &Scan, i: usize, no_return_is_far: bool) -> BeamReading {
    match max(scan) - scan.ranges()[i] {
        8 => BeamReading::Far,
        0 if no_return_is_far => BeamReading::Far,
        0..8 => BeamReading::Nothing,
        _ => BeamReading::Range(f64::from(scan.ranges()[i]) * scans::unit_mm(scan)),
    }
}

/// Compares `out` with the formula and with geometry, except the verdict.
fn compare(case: &Case, scan: &Scan, out: &Zones) -> CaseTally {
    let mut tally = CaseTally::default();
    let mut beams = vec![0; case.settings.radii_mm.len()];
    let mut geometric = vec![(0, 0); case.settings.radii_mm.len()];
    let (mut invalid, mut telling) = (0_u16, 0_u16);
    let mut nearest: Option<(f64, usize)> = None;
    for i in 0..usize::from(scan.count) {
        let (u, own) = case.beam(scan, i);
        let can_violate = case.can_violate(scan, u, own);
        telling += u16::from(can_violate);
        let range = match beam_reading(scan, i, case.settings.no_return_is_far) {
            BeamReading::Range(range) => range,
            BeamReading::Far => continue,
            BeamReading::Nothing => {
                invalid += u16::from(can_violate);
                continue;
            }
        };
        for (zone, radius) in case.settings.radii_mm.iter().map(|&radius| f64::from(radius)).enumerate() {
            beams[zone] += u16::from(case.violates(u, own, range, radius));
            let distance = case.distance(u, range);
            let (surely, perhaps) = (distance < radius - 1.0, distance < radius + 1.0);
            geometric[zone].0 += u16::from(surely && range >= own);
            geometric[zone].1 += u16::from(perhaps && range >= own);
        }
        let [x, y] = case.sensor_mm();
        let distance = (x + range * u[0]).hypot(y + range * u[1]);
        if range >= own && nearest.is_none_or(|(smallest, _)| distance < smallest) {
            nearest = Some((distance, i));
        }
    }
    for (zone, (&beams, &(surely, perhaps))) in beams.iter().zip(&geometric).enumerate() {
        let reported = out.zones()[zone].beams;
        assert_eq!(reported, beams, "circle {zone}");
        assert!(
            (surely..=perhaps).contains(&reported),
            "circle {zone}: {reported}, not {surely} to {perhaps}"
        );
        tally.sure += u32::from(surely == perhaps);
        tally.close += u32::from(surely != perhaps);
    }
    assert_eq!(out.invalid_beams, invalid);
    tally.blind = telling < case.settings.min_beams;
    tally.invalid = f64::from(invalid) > case.settings.max_invalid * f64::from(telling) + 1e-9;
    tally.unknown = tally.blind || tally.invalid;
    match (nearest, out.nearest()) {
        (None, None) => {}
        (Some((distance, i)), Some((beam, reported))) => {
            assert_eq!(f64::from(reported), (distance + 1e-6).floor(), "nearest");
            let [x, y] = case.sensor_mm();
            let (u, _) = case.beam(scan, usize::from(beam));
            let range = f64::from(scan.ranges()[usize::from(beam)]) * scans::unit_mm(scan);
            let reported_distance = (x + range * u[0]).hypot(y + range * u[1]);
            assert!(
                (reported_distance - distance).abs() < 1e-6,
                "beam {beam} at {reported_distance}, beam {i} at {distance}"
            );
        }
        wrong => panic!("nearest: {wrong:?}"),
    }
    tally
}

/// Counts from one scan. The test computes the expected verdict from them, and checks that it covers all cases.
#[derive(Default)]
struct CaseTally {
    sure: u32,
    close: u32,
    unknown: bool,
    /// Whether too many beams are invalid.
    invalid: bool,
    /// Whether the number of relevant beams is too small for a violation.
    blind: bool,
}

#[test]
fn zones_match_the_reference_and_geometry() {
    let mut random = Rng::with_seed(1);
    let mut verdicts = [0; 4];
    let (mut sure, mut close, mut blind) = (0, 0, 0);
    for _ in 0..CASE_COUNT {
        let case = Case::new(&mut random);
        let mut check = case.check();
        let mut out = uninitialized_zones();
        // Scans with another unit have another layout, so the counts of the check restart.
        for unit_mm in [1, 10, 100] {
            let mut scan = scans::layout(&mut random, unit_mm);
            let mut streaks = vec![0; case.settings.radii_mm.len()];
            let mut scans_checked = 0;
            for _ in 0..SCANS_PER_CASE {
                scans_checked += 1;
                case.fill(&mut random, &mut scan);
                check.update(&scan, &mut out);
                let tally = compare(&case, &scan, &out);
                (sure, close) = (sure + tally.sure, close + tally.close);
                blind += u32::from(tally.blind);
                for (streak, zone) in streaks.iter_mut().zip(out.zones()) {
                    *streak = if zone.beams >= case.settings.min_beams { *streak + 1 } else { 0 };
                    assert_eq!(zone.violated == 1, *streak >= case.settings.min_scans);
                }
                let is_new = scans_checked < case.settings.min_scans;
                let violated: Vec<bool> = out.zones().iter().map(|zone| zone.violated == 1).collect();
                let expected = match (violated.last(), violated.contains(&true)) {
                    (Some(true), _) => Verdict::Stop,
                    _ if tally.unknown || is_new => Verdict::Unknown,
                    (_, true) => Verdict::Slow,
                    _ => Verdict::Clear,
                };
                assert_eq!(out.verdict(), expected, "{:?} {violated:?}", case.settings);
                assert_eq!(out.flags & Zones::PROVISIONAL != 0, is_new);
                assert!(violated.is_sorted_by(|outer, inner| outer >= inner), "nested");
                verdicts[expected as usize] += 1;
                if tally.invalid {
                    scans_checked = 0;
                }
            }
        }
    }
    println!(
        "clear, slow, stop, unknown: {verdicts:?}; circles {sure} sure, {close} within 1 mm; blind {blind}"
    );
    assert!(verdicts.iter().all(|&verdicts| verdicts > CASE_COUNT / 10), "{verdicts:?}");
    assert!(close > 1000 && sure > 10_000 && blind > 100, "{close} {sure} {blind}");
}

/// An object stays inside the circle, but one of the scans is invalid. The check must not report clear after it.
#[test]
fn invalid_scan_delays_a_clear_verdict() {
    let settings = Settings { radii_mm: vec![1000, 600], min_scans: 2, ..Settings::default() };
    let mut check = ZoneChecker::new(Pose::default(), &settings, 181);
    let head = ScanHead::lms(181, -90_000, 1000, 1, 13);
    let scan = |range: u16| Scan::of(head, &[range; 181]);
    let scans = [scan(300), scan(4000), scan(head.no_return - 1)];
    let [near, far, invalid]: [&Scan; 3] = scans.each_ref().map(|scan| &**scan);
    let mut verdict = |scan: &Scan| {
        let mut out = uninitialized_zones();
        check.update(scan, &mut out);
        out.verdict()
    };
    let verdicts = [near, near, invalid, near, near, far, invalid, far, far].map(&mut verdict);
    let [unknown, stop, clear] = [Verdict::Unknown, Verdict::Stop, Verdict::Clear];
    assert_eq!(verdicts, [unknown, stop, unknown, unknown, stop, clear, unknown, unknown, clear]);
}

#[test]
fn point_on_a_circle_is_outside_from_any_pose() {
    let mut random = Rng::with_seed(2);
    // Each entry has the position of a sensor that points ahead, and the ranges at which its beam ahead enters and
    // leaves the circle of 1 m.
    let places = [
        ([0.0, 0.0], 0, 1000),
        ([0.3, 0.0], 0, 700),
        ([-0.2, 0.6], 0, 1000),
        ([0.0, -0.8], 0, 600),
        ([-2.0, 0.6], 1200, 2800),
        ([-5.0, -0.28], 4040, 5960),
        ([-1.0, 0.0], 0, 2000),
    ];
    for (place, lo_mm, hi_mm) in places {
        for round in 0..200 {
            // Rotate the sensor around the robot's center. This does not change the ranges at which the beam enters and
            // leaves the circle.
            let yaw_rad = if round < 4 { f64::from(round).to_radians() * 90.0 } else { 7.0 * random.f64() };
            let (sin, cos) = yaw_rad.sin_cos();
            let pose = Pose {
                x_m: place[0] * cos - place[1] * sin,
                y_m: place[0] * sin + place[1] * cos,
                yaw_rad,
                upside_down: round as u8 & 1,
                ..Pose::default()
            };
            let mut check =
                ZoneChecker::new(pose, &Settings { radii_mm: vec![1000], ..Settings::default() }, 1);
            let mut is_inside = |unit_mm: u16, range_mm: u16| {
                let scan = Scan::of(ScanHead::lms(1, 0, 500, unit_mm.into(), 13), &[range_mm / unit_mm]);
                let mut out = uninitialized_zones();
                check.update(&scan, &mut out);
                assert_eq!(out.zones()[0].beams == 1, out.verdict() == Verdict::Stop);
                out.zones()[0].beams == 1
            };
            for unit_mm in [1, 10] {
                assert!(
                    !is_inside(unit_mm, hi_mm) && is_inside(unit_mm, hi_mm - unit_mm),
                    "{place:?} {round}"
                );
                assert!(is_inside(unit_mm, lo_mm + unit_mm), "{place:?} {round}");
                assert!(lo_mm == 0 || !is_inside(unit_mm, lo_mm), "{place:?} {round}");
            }
        }
    }
}

/// Returns a payload that contains garbage, like a new loan of shared memory.
fn uninitialized_zones() -> Zones {
    bytemuck::pod_read_unaligned(&[0xA5; size_of::<Zones>()])
}

const CASE_COUNT: u32 = 600;
const SCANS_PER_CASE: u16 = 6;

const INVALID_CODE: u16 = 0x1FFF - 5;

/// Returns a scan of a hundred beams over 180 degrees. All ranges are 5 m, except those in `beams`, which has pairs of
/// beam and range.
fn scan(beams: &[(usize, u16)]) -> Box<Scan> {
    let mut scan = Scan::of(ScanHead::lms(100, -90_000, 1800, 1, 13), &[5000; 100]);
    beams.iter().for_each(|&(i, range_mm)| scan.arrays().ranges[i] = range_mm);
    scan
}

fn zones_after(check: &mut ZoneChecker, scan: &Scan) -> Zones {
    let mut out = Zones::unknown();
    check.update(scan, &mut out);
    out
}

fn verdict(settings: &Settings, scan: &Scan) -> Verdict {
    zones_after(&mut ZoneChecker::new(Pose::default(), settings, 100), scan).verdict()
}

#[test]
fn default_circles_give_slow_and_stop() {
    let settings = Settings::default();
    assert_eq!(verdict(&settings, &scan(&[])), Verdict::Clear);
    assert_eq!(verdict(&settings, &scan(&[(7, 1000)])), Verdict::Clear);
    assert_eq!(verdict(&settings, &scan(&[(7, 999)])), Verdict::Slow);
    assert_eq!(verdict(&settings, &scan(&[(7, 600)])), Verdict::Slow);
    assert_eq!(verdict(&settings, &scan(&[(7, 599), (9, 0)])), Verdict::Stop);
    let mut check = ZoneChecker::new(Pose::default(), &settings, 100);
    let out = zones_after(&mut check, &scan(&[(7, 599), (9, 0), (12, 700), (13, INVALID_CODE)]));
    assert_eq!((out.nearest(), out.invalid_beams, out.flags), (Some((9, 0)), 1, 0));
    let circles = out.zones().iter().map(|zone| (zone.radius_mm, zone.beams, zone.violated));
    assert!(circles.eq([(1000, 3, 1), (600, 2, 1)]));
}

#[test]
fn violation_needs_enough_beams_in_enough_scans() {
    let settings = Settings { min_beams: 2, min_scans: 3, ..Settings::default() };
    let mut check = ZoneChecker::new(Pose::default(), &settings, 100);
    let (near, single) = (scan(&[(7, 700), (8, 500), (9, 500)]), scan(&[(7, 500)]));
    let mut next = |scan: &Scan| {
        let out = zones_after(&mut check, scan);
        (out.verdict(), out.flags)
    };
    assert_eq!(next(&near), (Verdict::Unknown, Zones::PROVISIONAL));
    assert_eq!(next(&near), (Verdict::Unknown, Zones::PROVISIONAL));
    assert_eq!(next(&near), (Verdict::Stop, 0));
    assert_eq!(next(&single), (Verdict::Clear, 0));
    assert_eq!([(); 3].map(|()| next(&near).0), [Verdict::Clear, Verdict::Clear, Verdict::Stop]);
    let mut cm = scan(&[]);
    cm.unit_um = 10_000;
    assert_eq!(next(&cm), (Verdict::Unknown, Zones::PROVISIONAL), "another layout is another start");
}

#[test]
fn stale_verdict_is_unknown_and_restarts_counting() {
    let settings = Settings { min_scans: 2, ..Settings::default() };
    let mut check = ZoneChecker::new(Pose::default(), &settings, 100);
    let near = scan(&[(7, 500)]);
    assert_eq!([(); 2].map(|()| zones_after(&mut check, &near).verdict()), [Verdict::Unknown, Verdict::Stop]);
    let mut out = zones_after(&mut check, &near);
    check.write_stale(&mut out);
    assert_eq!((out.verdict(), out.nearest(), out.flags), (Verdict::Unknown, None, Zones::PROVISIONAL));
    let circles = out.zones().iter().map(|zone| (zone.radius_mm, zone.beams, zone.violated));
    assert!(circles.eq([(1000, 0, 0), (600, 0, 0)]));
    assert_eq!([(); 2].map(|()| zones_after(&mut check, &near).verdict()), [Verdict::Unknown, Verdict::Stop]);
}

#[test]
fn too_many_invalid_beams_yield_unknown_or_stop() {
    let invalid: Vec<_> = (0..11).map(|i| (i, INVALID_CODE)).collect();
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
fn body_mask_hides_the_robot_itself() {
    // The sectors cover beams 0 to 10. In the first case, the robot's body ends inside the circle. In the second case,
    // it hides the whole circle.
    let partly = [Sector { from_mdeg: -90_000, to_mdeg: -72_000, range_mm: 400 }];
    let wholly = [Sector { range_mm: 1000, ..partly[0] }, partly[0]];
    let body: Vec<_> = (0..12).map(|i| (i, 399)).collect();
    let blind: Vec<_> = (0..11).map(|i| (i, INVALID_CODE)).collect();
    for (body_mask, of_blind) in [(&partly[..], Verdict::Unknown), (&wholly[..], Verdict::Clear)] {
        let settings = Settings { body_mask: body_mask.to_vec(), ..Settings::default() };
        assert_eq!(verdict(&settings, &scan(&body[..11])), Verdict::Clear);
        assert_eq!(verdict(&settings, &scan(&body)), Verdict::Stop, "beam 11 is none of the body's");
        assert_eq!(verdict(&settings, &scan(&blind)), of_blind);
        let mut check = ZoneChecker::new(Pose::default(), &settings, 100);
        assert_eq!(zones_after(&mut check, &scan(&body[..11])).nearest(), Some((11, 5000)));
    }
    let settings = Settings { body_mask: partly.to_vec(), ..Settings::default() };
    assert_eq!(verdict(&settings, &scan(&[(3, 400)])), Verdict::Stop, "where the body ends");
}

#[test]
fn verdict_is_unknown_without_usable_input() {
    let settings = Settings::default();
    assert_eq!(verdict(&settings, &Box::<Scan>::default()), Verdict::Unknown);
    let no_circles = Settings { radii_mm: Vec::new(), ..Settings::default() };
    assert_eq!(verdict(&no_circles, &scan(&[(7, 500)])), Verdict::Unknown);
    for (x_m, yaw_rad) in [(f64::NAN, 0.0), (0.0, f64::INFINITY), (f64::INFINITY, 0.0)] {
        let mut check = ZoneChecker::new(Pose { x_m, yaw_rad, ..Pose::default() }, &settings, 100);
        assert_eq!(zones_after(&mut check, &scan(&[])).verdict(), Verdict::Unknown);
    }
}

#[test]
fn backlogged_scan_is_never_clear() {
    let mut check = ZoneChecker::new(Pose::default(), &Settings::default(), 100);
    let mut of = |is_late, scan: &Scan| {
        check.set_backlogged(is_late);
        zones_after(&mut check, scan).verdict()
    };
    assert_eq!(of(false, &scan(&[])), Verdict::Clear);
    assert_eq!(of(true, &scan(&[])), Verdict::Unknown);
    assert_eq!(of(true, &scan(&[(7, 700)])), Verdict::Unknown);
    assert_eq!(of(true, &scan(&[(7, 500)])), Verdict::Stop);
    assert_eq!(of(false, &scan(&[])), Verdict::Clear);
}

#[test]
fn unviolable_circle_is_never_clear() {
    let settings = Settings::default();
    let of = |pose: Pose, settings: &Settings, scan: &Scan| {
        let mut check = ZoneChecker::new(pose, settings, 100);
        (zones_after(&mut check, scan).verdict(), check.effective_beams(), check.is_blind())
    };
    let whole = Pose::default();
    let strict = Settings { min_beams: 100, ..settings.clone() };
    assert_eq!(of(whole, &strict, &scan(&[])), (Verdict::Clear, 100, false));
    let more = Settings { min_beams: 101, ..settings.clone() };
    assert_eq!(of(whole, &more, &scan(&[(7, 0)])), (Verdict::Unknown, 100, true));
    let body = [Sector { from_mdeg: -90_000, to_mdeg: -72_000, range_mm: 1000 }];
    let masked = Settings { body_mask: body.to_vec(), ..strict.clone() };
    assert_eq!(of(whole, &masked, &scan(&[])), (Verdict::Unknown, 89, true));
    let all = [Sector { to_mdeg: 90_000, ..body[0] }];
    assert_eq!(
        of(whole, &Settings { body_mask: all.to_vec(), ..settings.clone() }, &scan(&[])).0,
        Verdict::Unknown
    );
    // A sensor 2 m ahead of the center points away from the circle, so no beam meets the circle. If the sensor is
    // rotated by 180 degrees, its beams meet the circle.
    let facing_away = Pose { x_m: 2.0, ..Pose::default() };
    assert_eq!(of(facing_away, &settings, &scan(&[])), (Verdict::Unknown, 0, true));
    let back = Pose { yaw_rad: std::f64::consts::PI, ..facing_away };
    assert_eq!(of(back, &settings, &scan(&[])).0, Verdict::Clear);
    // The circle is too far away for ranges of 13 bits in mm, but not for ranges in cm.
    let far = Pose { x_m: 9.2, ..back };
    assert_eq!(of(far, &settings, &scan(&[])), (Verdict::Unknown, 0, true));
    let mut cm = scan(&[]);
    cm.unit_um = 10_000;
    assert_eq!(of(far, &settings, &cm).0, Verdict::Clear);
}

/// Returns a clockwise revolution of 200 beams, 1.8 degrees apart. The scanner's own points are also 1.8 degrees apart.
/// All ranges are 5 m, except those in `beams`. Each entry of `beams` has a beam, its range, and its exact angle in
/// degrees.
fn revolution(beams: &[(usize, u16, f32)]) -> Box<Scan> {
    let head = ScanHead {
        step: -1.8_f64.to_radians(),
        spacing: 1.8_f32.to_radians(),
        unit_um: 1000,
        valid_to: 0xFFEF,
        no_return: Code::NoReturn.value(),
        beyond: Code::NoReturn.value(),
        contents: ArrayFlags::ANGLES,
        ..ScanHead::default()
    };
    let mut scan = Scan::of(head, &[5000; 200]);
    let arrays = scan.arrays();
    for (i, angle) in arrays.angles.iter_mut().enumerate() {
        *angle = (-1.8 * i as f32).to_radians();
    }
    for &(i, range, angle_deg) in beams {
        (arrays.ranges[i], arrays.angles[i]) = (range, angle_deg.to_radians());
    }
    scan
}

fn zones_of_revolution(pose: Pose, settings: &Settings, scan: &Scan) -> Zones {
    zones_after(&mut ZoneChecker::new(pose, settings, 200), scan)
}

#[test]
fn zones_use_exact_points_if_available() {
    let settings = Settings::default();
    assert_eq!(zones_of_revolution(Pose::default(), &settings, &revolution(&[])).verdict(), Verdict::Clear);
    let near =
        zones_of_revolution(Pose::default(), &settings, &revolution(&[(7, 700, -12.0), (190, 999, 17.5)]));
    assert_eq!((near.verdict(), near.nearest()), (Verdict::Slow, Some((7, 700))));
    assert_eq!((near.zones()[0].beams, near.zones()[1].beams), (2, 0));
    // The sensor is 2 m ahead of the center. An object straight behind the sensor at 1001 mm is just inside the circle.
    // An object at the same range, but half a beam to the side, is outside.
    let ahead = Pose { x_m: 2.0, ..Pose::default() };
    assert_eq!(
        zones_of_revolution(ahead, &settings, &revolution(&[(100, 1001, -180.0)])).zones()[0].beams,
        1
    );
    assert_eq!(
        zones_of_revolution(ahead, &settings, &revolution(&[(100, 1000, -180.0)])).zones()[0].beams,
        0
    );
    assert_eq!(
        zones_of_revolution(ahead, &settings, &revolution(&[(100, 1001, -182.6)])).zones()[0].beams,
        0
    );
    // The middle of beam 99 is next to the robot's body. But the exact angle of a point may be in the sector of the
    // body.
    let body = [Sector { from_mdeg: -180_000, to_mdeg: -179_000, range_mm: 2000 }];
    let masked = Settings { body_mask: body.to_vec(), ..settings };
    assert_eq!(zones_of_revolution(ahead, &masked, &revolution(&[(99, 1500, -178.3)])).zones()[0].beams, 1);
    assert_eq!(zones_of_revolution(ahead, &masked, &revolution(&[(99, 1500, -179.3)])).zones()[0].beams, 0);
}

#[test]
fn skips_unmeasured_beams_between_measured_ones() {
    let settings = Settings { max_invalid: 0.0, ..Settings::default() };
    let without = |beams: &[usize], spacing_deg: f32| {
        let mut scan = revolution(&[]);
        beams.iter().for_each(|&i| scan.arrays().ranges[i] = Scan::NOT_MEASURED);
        scan.spacing = spacing_deg.to_radians();
        let out = zones_of_revolution(Pose::default(), &settings, &scan);
        (out.invalid_beams, out.verdict())
    };
    assert_eq!(without(&[5, 90, 198], 1.8), (0, Verdict::Clear));
    assert_eq!(without(&[5, 6, 90], 1.8), (2, Verdict::Unknown), "three spacings without a point");
    assert_eq!(without(&[5, 6, 90], 3.6), (0, Verdict::Clear), "its points are farther apart");
    assert_eq!(without(&[199], 1.8), (0, Verdict::Clear), "the first beam follows the last");
    assert_eq!(without(&[0, 199], 1.8), (2, Verdict::Unknown));
    let none: Vec<usize> = (0..200).collect();
    assert_eq!(without(&none, 1.8), (200, Verdict::Unknown));
}

#[test]
fn changing_speed_does_not_interrupt_scan_counting() {
    let settings = Settings { min_scans: 3, max_invalid: 0.0, ..Settings::default() };
    let mut check = ZoneChecker::new(Pose::default(), &settings, 200);
    let mut next = |range: u16, spacing_deg: f32| {
        let mut scan = revolution(&[(7, range, -12.6)]);
        [90, 91].iter().for_each(|&i| scan.arrays().ranges[i] = Scan::NOT_MEASURED);
        scan.spacing = spacing_deg.to_radians();
        let out = zones_after(&mut check, &scan);
        (out.verdict(), out.invalid_beams)
    };
    let near = [3.6, 3.61, 3.59].map(|spacing_deg| next(500, spacing_deg));
    assert_eq!(near, [(Verdict::Unknown, 0), (Verdict::Unknown, 0), (Verdict::Stop, 0)]);
    assert_eq!(next(5000, 3.6), (Verdict::Clear, 0));
    assert_eq!(next(5000, 1.8), (Verdict::Unknown, 2), "its points are as near to each other as its beams");
}

const BEAM_COUNT: usize = 100;
const FAR_MM: u16 = 5000;

/// Returns a scan of 180 degrees. At most `near` random beams have short ranges.
fn random_scan(random: &mut Rng, near: usize) -> Box<Scan> {
    let mut scan = Scan::of(ScanHead::lms(BEAM_COUNT, -90_000, 1800, 1, 13), &[FAR_MM; BEAM_COUNT]);
    (0..near).for_each(|_| scan.arrays().ranges[random.usize(..BEAM_COUNT)] = random.u16(..1200));
    scan
}

/// Passes all `scans` to a new check, and returns the zones for the last scan.
fn zones_of(pose: Pose, settings: &Settings, scans: &[Box<Scan>]) -> Zones {
    let (mut check, mut out) = (ZoneChecker::new(pose, settings, BEAM_COUNT), Zones::unknown());
    scans.iter().for_each(|scan| check.update(scan, &mut out));
    out
}

fn worst(zones: &Zones) -> Option<Verdict> {
    match zones.zones() {
        [.., smallest] if smallest.violated != 0 => Some(Verdict::Stop),
        circles if circles.iter().any(|zone| zone.violated != 0) => Some(Verdict::Slow),
        _ => None,
    }
}

#[test]
fn partial_scan_warns_and_complete_scan_confirms() {
    let mut random = Rng::with_seed(28);
    let (mut warned, mut silent) = (0, 0);
    for _ in 0..200 {
        let (min_beams, min_scans) = (random.u16(1..4), random.u16(1..4));
        let settings = Settings { min_beams, min_scans, exact: random.bool(), ..Settings::default() };
        let pose = Pose { x_m: 0.4 * random.f64(), yaw_rad: random.f64(), ..Pose::default() };
        let mut check = ZoneChecker::new(pose, &settings, BEAM_COUNT);
        let mut scans: Vec<Box<Scan>> = Vec::new();
        for _ in 0..6 {
            let near = random.usize(..9);
            let whole = random_scan(&mut random, near);
            let mut before = None;
            for received in [0, 1, random.usize(..BEAM_COUNT), random.usize(..BEAM_COUNT), BEAM_COUNT] {
                let early = check.check_partial(BEAM_COUNT, 1000, &whole.ranges()[..received], &[]);
                let mut part = whole.clone();
                part.arrays().ranges[received..].fill(FAR_MM);
                scans.push(part);
                let zones = zones_of(pose, &settings, &scans);
                scans.pop();
                // The check computes its table for the first complete scan of a layout, so it cannot warn before.
                let expected = worst(&zones).filter(|_| !scans.is_empty());
                assert_eq!(early.map(|warning| warning.verdict), expected, "{received} of {near}");
                if let Some(Warning { beam, distance_mm, .. }) = early {
                    assert_eq!(Some((beam, distance_mm)), zones.nearest());
                }
                (warned, silent) =
                    (warned + usize::from(early.is_some()), silent + usize::from(early.is_none()));
                before =
                    before.max(early.map(|warning| warning.verdict as u8).filter(|_| received == BEAM_COUNT));
            }
            let mut out = Zones::unknown();
            check.update(&whole, &mut out);
            assert!(before.is_none_or(|before| out.verdict().worse(Verdict::Clear) as u8 >= before));
            scans.push(whole);
        }
    }
    assert!(warned > 500 && silent > 500, "{warned} and {silent}");
}

#[test]
fn scan_with_another_layout_causes_no_warning() {
    let mut check = ZoneChecker::new(Pose::default(), &Settings::default(), BEAM_COUNT);
    let near = [300; BEAM_COUNT];
    assert_eq!(check.check_partial(BEAM_COUNT, 1000, &near, &[]), None, "nothing is known of the sensor");
    check.update(&random_scan(&mut Rng::with_seed(1), 0), &mut Zones::unknown());
    assert_eq!(
        check.check_partial(BEAM_COUNT, 1000, &near, &[]).map(|warning| warning.verdict),
        Some(Verdict::Stop)
    );
    assert_eq!(check.check_partial(BEAM_COUNT + 1, 1000, &near, &[]), None, "more beams");
    assert_eq!(check.check_partial(BEAM_COUNT, 10_000, &near, &[]), None, "another unit");
    check.write_stale(&mut Zones::unknown());
    assert_eq!(check.check_partial(BEAM_COUNT, 1000, &[], &[]), None);
}

/// If the spacing between the points of a rotating scanner varies by an arc second, the layout does not change, so the
/// check counts consecutive scans.
#[test]
fn slightly_uneven_revolutions_are_consecutive() {
    let settings = Settings { min_scans: 2, ..Settings::default() };
    let mut check = ZoneChecker::new(Pose::default(), &settings, BEAM_COUNT);
    let mut turn = Scan::zeroed(Scan::len(BEAM_COUNT, scanhub_schema::ArrayFlags::REVOLUTION));
    let mut verdicts = Vec::new();
    for number in 0..3 {
        let head = ScanHead::of_revolution(scanhub_schema::Family::Ld, BEAM_COUNT);
        let arrays = turn.begin(ScanHead { spacing: head.spacing + number as f32 * 5e-6, ..head });
        arrays.ranges.fill(500);
        arrays.upper.fill(0);
        let step = head.step;
        arrays.angles.iter_mut().enumerate().for_each(|(i, angle)| *angle = (i as f64 * step) as f32);
        let early = check.check_partial(BEAM_COUNT, 1000, turn.ranges(), turn.exact_angles());
        let mut out = Zones::unknown();
        check.update(&turn, &mut out);
        verdicts.push((early.map(|warning| warning.verdict), out.verdict()));
    }
    let known = (Some(Verdict::Stop), Verdict::Stop);
    assert_eq!(verdicts, [(None, Verdict::Unknown), known, known]);
}
