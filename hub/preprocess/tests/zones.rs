//! Zones against two slow versions that know nothing of tables: the formula as it stands, beam by beam, which has to
//! give the same in everything; and plain geometry, the point of a reading and the circle, which has to give the same
//! but for what lies within a millimetre of a circle.

mod scans;

use fastrand::Rng;
use scanhub_preprocess::zones::{Check, Sector, Settings};
use scanhub_schema::{Pose, Scan, ScanHead, Verdict, Zones};

/// One random configuration.
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
        let self_min = sectors.collect();
        let settings = Settings {
            radii_mm,
            self_min,
            margin_mm: if random.bool() { 0 } else { random.u16(..200) },
            min_beams: random.u16(1..4),
            min_scans: random.u16(1..4),
            max_invalid: [0.0, 0.05, 0.1, 0.5][random.usize(..4)],
            exact: random.u8(..3) > 0,
            no_return_is_far: random.bool(),
        };
        Case { pose: scans::pose(random), settings }
    }

    fn check(&self) -> Check {
        Check::new(self.pose, &self.settings, 401)
    }

    /// Direction of a beam and what the robot's own body takes of it, in mm.
    fn beam(&self, scan: &Scan, i: usize) -> ([f64; 2], f64) {
        let mdeg = (1000.0 * (scan.first_angle + i as f64 * scan.step).to_degrees()).round() as i32;
        let sense = if self.pose.upside_down == 1 { -1.0 } else { 1.0 };
        let angle = self.pose.yaw_rad + sense * (f64::from(mdeg) / 1000.0).to_radians();
        let covers = |sector: &&Sector| sector.from_mdeg <= mdeg && mdeg <= sector.to_mdeg;
        let own =
            self.settings.self_min.iter().filter(covers).map(|sector| sector.range_mm).max().unwrap_or(0);
        ([angle.cos(), angle.sin()], f64::from(own))
    }

    fn sensor_mm(&self) -> [f64; 2] {
        [self.pose.x_m * 1000.0, self.pose.y_m * 1000.0]
    }

    /// Between which ranges a beam is inside, from the formula.
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

    /// A reading by the formula is inside.
    fn violates(&self, u: [f64; 2], own: f64, range: f64, radius: f64) -> bool {
        let (lo, hi) = self.chord(u, radius);
        range >= own && range < hi && (!self.settings.exact || lo == 0.0 || range > lo)
    }

    /// There is a reading of the scan's kind that would be inside the largest circle: the shortest one beyond the
    /// robot's own body and the circle's near side, if any.
    fn tells(&self, scan: &Scan, u: [f64; 2], own: f64) -> bool {
        let (unit, radius) = (scans::unit_mm(scan), f64::from(self.settings.radii_mm[0]));
        let shortest = (own.max(self.chord(u, radius).0) / unit).floor();
        let values = [shortest, shortest + 1.0].into_iter().filter(|value| *value < f64::from(max(scan) - 8));
        values.into_iter().any(|value| self.violates(u, own, value * unit, radius))
    }

    /// How far the part of a beam that counts as met by this reading stays from the centre: the point itself, so much
    /// to and fro as the margin allows, and what comes behind it if that counts.
    fn distance(&self, u: [f64; 2], range: f64) -> f64 {
        let [x, y] = self.sensor_mm();
        let margin = f64::from(self.settings.margin_mm);
        let end = if self.settings.exact { range + margin } else { f64::INFINITY };
        let at = (-(x * u[0] + y * u[1])).clamp((range - margin).max(0.0), end);
        (x + at * u[0]).hypot(y + at * u[1])
    }

    /// Readings, many of them about the circles and the robot's own body.
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

/// The greatest value of a range.
fn max(scan: &Scan) -> u16 {
    scan.no_return
}

/// What a beam tells, from its word: a range in mm, that nothing is near, or nothing.
enum Told {
    Range(f64),
    Far,
    Nothing,
}

fn told(scan: &Scan, i: usize, no_return_is_far: bool) -> Told {
    match max(scan) - scan.ranges()[i] {
        8 => Told::Far,
        0 if no_return_is_far => Told::Far,
        0..8 => Told::Nothing,
        _ => Told::Range(f64::from(scan.ranges()[i]) * scans::unit_mm(scan)),
    }
}

/// The formula and geometry over one scan: asserts what `out` says of it, but for the verdict.
fn compare(case: &Case, scan: &Scan, out: &Zones) -> Tally {
    let mut tally = Tally::default();
    let mut beams = vec![0; case.settings.radii_mm.len()];
    let mut geometric = vec![(0, 0); case.settings.radii_mm.len()];
    let (mut invalid, mut telling) = (0_u16, 0_u16);
    let mut nearest: Option<(f64, usize)> = None;
    for i in 0..usize::from(scan.count) {
        let (u, own) = case.beam(scan, i);
        let tells = case.tells(scan, u, own);
        telling += u16::from(tells);
        let range = match told(scan, i, case.settings.no_return_is_far) {
            Told::Range(range) => range,
            Told::Far => continue,
            Told::Nothing => {
                invalid += u16::from(tells);
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
        if range >= own && nearest.is_none_or(|(least, _)| distance < least) {
            nearest = Some((distance, i));
        }
    }
    for (zone, (&beams, &(surely, perhaps))) in beams.iter().zip(&geometric).enumerate() {
        let said = out.zones()[zone].beams;
        assert_eq!(said, beams, "circle {zone}");
        assert!((surely..=perhaps).contains(&said), "circle {zone}: {said}, not {surely} to {perhaps}");
        tally.sure += u32::from(surely == perhaps);
        tally.close += u32::from(surely != perhaps);
    }
    assert_eq!(out.invalid_beams, invalid);
    tally.blind = telling < case.settings.min_beams;
    tally.invalid = f64::from(invalid) > case.settings.max_invalid * f64::from(telling) + 1e-9;
    tally.unknown = tally.blind || tally.invalid;
    match (nearest, out.nearest()) {
        (None, None) => {}
        (Some((distance, i)), Some((beam, said))) => {
            assert_eq!(f64::from(said), (distance + 1e-6).floor(), "nearest");
            let [x, y] = case.sensor_mm();
            let (u, _) = case.beam(scan, usize::from(beam));
            let range = f64::from(scan.ranges()[usize::from(beam)]) * scans::unit_mm(scan);
            let there = (x + range * u[0]).hypot(y + range * u[1]);
            assert!((there - distance).abs() < 1e-6, "beam {beam} at {there}, beam {i} at {distance}");
        }
        wrong => panic!("nearest: {wrong:?}"),
    }
    tally
}

/// What one scan was good for.
#[derive(Default)]
struct Tally {
    sure: u32,
    close: u32,
    unknown: bool,
    /// Too many beams are invalid.
    invalid: bool,
    /// A violation takes more beams than can tell something.
    blind: bool,
}

#[test]
fn zones_are_those_of_the_formula_and_of_geometry() {
    let mut random = Rng::with_seed(1);
    let mut verdicts = [0; 4];
    let (mut sure, mut close, mut blind) = (0, 0, 0);
    for _ in 0..CASES {
        let case = Case::new(&mut random);
        let mut check = case.check();
        let mut out = dirty();
        // Another unit is another layout, and all begins anew.
        for unit_mm in [1, 10, 100] {
            let mut scan = scans::layout(&mut random, unit_mm);
            let mut streaks = vec![0; case.settings.radii_mm.len()];
            let mut seen = 0;
            for _ in 0..SCANS {
                seen += 1;
                case.fill(&mut random, &mut scan);
                check.update(&scan, &mut out);
                let tally = compare(&case, &scan, &out);
                (sure, close) = (sure + tally.sure, close + tally.close);
                blind += u32::from(tally.blind);
                for (streak, zone) in streaks.iter_mut().zip(out.zones()) {
                    *streak = if zone.beams >= case.settings.min_beams { *streak + 1 } else { 0 };
                    assert_eq!(zone.violated == 1, *streak >= case.settings.min_scans);
                }
                let is_new = seen < case.settings.min_scans;
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
                    seen = 0;
                }
            }
        }
    }
    println!(
        "clear, slow, stop, unknown: {verdicts:?}; circles {sure} sure, {close} within 1 mm; blind {blind}"
    );
    assert!(verdicts.iter().all(|&verdicts| verdicts > CASES / 10), "{verdicts:?}");
    assert!(close > 1000 && sure > 10_000 && blind > 100, "{close} {sure} {blind}");
}

/// An object stays inside the circle, and one scan in between cannot show it.
#[test]
fn after_an_invalid_scan_the_verdict_is_not_clear_before_it_is_proven() {
    let settings = Settings { radii_mm: vec![1000, 600], min_scans: 2, ..Settings::default() };
    let mut check = Check::new(Pose::default(), &settings, 181);
    let head = ScanHead::lms(181, -90_000, 1000, 1, 13);
    let scan = |range: u16| Scan::of(head, &[range; 181]);
    let scans = [scan(300), scan(4000), scan(head.no_return - 1)];
    let [near, far, invalid]: [&Scan; 3] = scans.each_ref().map(|scan| &**scan);
    let mut verdict = |scan: &Scan| {
        let mut out = dirty();
        check.update(scan, &mut out);
        out.verdict()
    };
    let verdicts = [near, near, invalid, near, near, far, invalid, far, far].map(&mut verdict);
    let [unknown, stop, clear] = [Verdict::Unknown, Verdict::Stop, Verdict::Clear];
    assert_eq!(verdicts, [unknown, stop, unknown, unknown, stop, clear, unknown, unknown, clear]);
}

#[test]
fn on_a_circle_is_outside_wherever_it_is_seen_from() {
    let mut random = Rng::with_seed(2);
    // The sensor's place when it looks ahead, the beam ahead's way in and out of the circle of 1 m.
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
        for turn in 0..200 {
            // The robot turned about its centre: nothing changes for the beam.
            let yaw_rad = if turn < 4 { f64::from(turn).to_radians() * 90.0 } else { 7.0 * random.f64() };
            let (sin, cos) = yaw_rad.sin_cos();
            let pose = Pose {
                x_m: place[0] * cos - place[1] * sin,
                y_m: place[0] * sin + place[1] * cos,
                yaw_rad,
                upside_down: turn as u8 & 1,
                ..Pose::default()
            };
            let mut check = Check::new(pose, &Settings { radii_mm: vec![1000], ..Settings::default() }, 1);
            let mut is_inside = |unit_mm: u16, range_mm: u16| {
                let scan = Scan::of(ScanHead::lms(1, 0, 500, unit_mm.into(), 13), &[range_mm / unit_mm]);
                let mut out = dirty();
                check.update(&scan, &mut out);
                assert_eq!(out.zones()[0].beams == 1, out.verdict() == Verdict::Stop);
                out.zones()[0].beams == 1
            };
            for unit_mm in [1, 10] {
                assert!(
                    !is_inside(unit_mm, hi_mm) && is_inside(unit_mm, hi_mm - unit_mm),
                    "{place:?} {turn}"
                );
                assert!(is_inside(unit_mm, lo_mm + unit_mm), "{place:?} {turn}");
                assert!(lo_mm == 0 || !is_inside(unit_mm, lo_mm), "{place:?} {turn}");
            }
        }
    }
}

/// As a loan comes.
fn dirty() -> Zones {
    bytemuck::pod_read_unaligned(&[0xA5; size_of::<Zones>()])
}

const CASES: u32 = 600;
const SCANS: u16 = 6;
