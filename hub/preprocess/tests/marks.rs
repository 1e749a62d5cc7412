//! Tests of marks. The marks are compared with those of a slow version that follows the definition of marks, in
//! floating point.

mod scans;

use fastrand::Rng;
use scanhub_preprocess::marks::{MarkDetector, Settings};
use scanhub_schema::{Family, MAX_MARKS, Mark, Marks, Scan, ScanHead};

/// A beam that belongs to a mark: its index, range in mm and intensity.
#[derive(Clone, Copy)]
struct Hit {
    beam: usize,
    range_mm: f64,
    intensity: u8,
}

/// Returns the beams that can belong to marks, one group for each mark. A group ends if the next beam is too far away,
/// or if its range differs too much.
fn groups(scan: &Scan, settings: Settings) -> Vec<Vec<Hit>> {
    let mut groups: Vec<Vec<Hit>> = Vec::new();
    for beam in 0..usize::from(scan.count) {
        let (value, intensity) = (scan.ranges()[beam], scan.upper()[beam]);
        let is_code = value > scan.no_return - 9;
        if is_code || intensity < settings.min_level.max(1) {
            continue;
        }
        let hit = Hit { beam, range_mm: f64::from(value) * scans::unit_mm(scan), intensity };
        let joins = groups.last().and_then(|group| group.last()).is_some_and(|last| {
            let step_mm = (hit.range_mm - last.range_mm).abs();
            beam - last.beam - 1 <= usize::from(settings.max_gap)
                && step_mm <= f64::from(settings.max_range_step_mm)
        });
        if !joins {
            groups.push(Vec::new());
        }
        groups.last_mut().expect("one is open").push(hit);
    }
    groups
}

fn assert_mark(scan: &Scan, group: &[Hit], mark: &Mark) {
    let sum = |of: &dyn Fn(&Hit) -> f64| group.iter().map(|hit| f64::from(hit.intensity) * of(hit)).sum();
    let weight: f64 = sum(&|_| 1.0);
    let angle: f64 = sum(&|hit| 1000.0 * (scan.first_angle + hit.beam as f64 * scan.step).to_degrees());
    let range: f64 = sum(&|hit| hit.range_mm);
    // Values are rounded to a thousandth of a degree and a tenth of a millimeter. Halves are rounded up.
    let nearest = |exact: f64, reported: f64| (-0.5 - 1e-6..0.5 + 1e-6).contains(&(exact - reported));
    assert!(nearest(angle / weight, f64::from(mark.angle_mdeg)), "{} {mark:?}", angle / weight);
    assert!(nearest(10.0 * range / weight, f64::from(mark.range_dmm)), "{} {mark:?}", range / weight);
    assert_eq!(f64::from(mark.weight), weight);
    assert_eq!(Some(mark.peak), group.iter().map(|hit| hit.intensity).max());
    let (first, last) = (group[0].beam, group[group.len() - 1].beam);
    assert_eq!((usize::from(mark.first_beam), usize::from(mark.last_beam)), (first, last));
    assert_eq!(mark.edge == 1, first == 0 || last == usize::from(scan.count) - 1);
}

/// Fills `scan` with the ranges of a wall that has steps, and the intensities of a few reflectors.
fn fill(random: &mut Rng, scan: &mut Scan) {
    let max = scan.no_return;
    let unit_mm = scans::unit_mm(scan) as u16;
    let seldom = [2, 10, 40][random.usize(..3)];
    let mut wall = random.u16(..max - 1000);
    let mut lit = 0;
    for i in 0..usize::from(scan.count) {
        if random.u8(..20) == 0 {
            wall = random.u16(..max - 1000);
        }
        if lit == 0 && random.u8(..seldom) == 0 {
            lit = random.u8(1..8);
        }
        let range = match random.u8(..15) {
            0 => scans::code(random, scan),
            _ => (wall + random.u16(..150 / unit_mm)).min(max - 9),
        };
        scan.arrays().ranges[i] = range;
        let bits = scan.intensity_bits;
        scan.arrays().upper[i] = if lit > 0 { random.u8(..1 << bits) } else { 0 };
        lit = lit.saturating_sub(1);
    }
}

#[test]
fn marks_match_the_reference() {
    let mut random = Rng::with_seed(1);
    let (mut marks, mut edges, mut overflows) = (0, 0, 0);
    for _ in 0..2000 {
        let settings = Settings {
            min_level: random.u8(..4),
            level: [None, Some(200)][random.usize(..2)],
            max_range_step_mm: [0, 50, 100, 1000][random.usize(..4)],
            max_gap: [0, 0, 1, 5][random.usize(..4)],
        };
        let unit_mm = [1, 10, 100][random.usize(..3)];
        let mut scan = scans::layout(&mut random, unit_mm);
        fill(&mut random, &mut scan);
        let mut out: Marks = bytemuck::pod_read_unaligned(&[0xA5; size_of::<Marks>()]);
        MarkDetector::new(settings).update(&scan, &mut out);
        let groups = groups(&scan, settings);
        assert_eq!(usize::from(out.count), groups.len().min(MAX_MARKS), "{settings:?}");
        assert_eq!((out.is_overflow(), out.is_available()), (groups.len() > MAX_MARKS, true));
        for (group, mark) in groups.iter().zip(out.marks()) {
            assert_mark(&scan, group, mark);
        }
        assert!(out.mark_array[usize::from(out.count)..].iter().all(|mark| *mark == Mark::default()));
        marks += groups.len();
        edges += out.marks().iter().filter(|mark| mark.edge == 1).count();
        overflows += usize::from(out.is_overflow());
    }
    println!("{marks} marks, {edges} at an edge, {overflows} scans with too many");
    assert!(marks > 10_000 && edges > 100 && overflows > 10, "{marks} {edges} {overflows}");
}

/// Returns a scan of eleven beams at 1 m, one degree apart. `intensities` has pairs of beam and intensity.
fn scan_with_intensities(intensities: &[(usize, u8)]) -> Box<Scan> {
    let head = ScanHead { intensity_bits: 3, ..ScanHead::lms(11, -1000, 1000, 1, 13) };
    let mut scan = Scan::of(head, &[1000; 11]);
    for &(i, intensity) in intensities {
        scan.arrays().upper[i] = intensity;
    }
    scan
}

fn find(scan: &Scan, settings: Settings) -> Marks {
    let mut out = Marks::default();
    MarkDetector::new(settings).update(scan, &mut out);
    out
}

#[test]
fn half_units_are_rounded_up() {
    let mut scan = scan_with_intensities(&[(4, 1), (5, 1)]);
    scan.arrays().ranges[4] = 1001;
    scan.step = 0.001_f64.to_radians();
    let mark = find(&scan, Settings::default()).mark_array[0];
    assert_eq!((mark.angle_mdeg, mark.range_dmm), (-1000 + 5, 10_005));
    // The centers of the two marks are 8/3 and 7/3 degrees after the first beam, which is at -1 degree.
    let angle = |beams| find(&scan_with_intensities(beams), Settings::default()).mark_array[0].angle_mdeg;
    assert_eq!((angle(&[(2, 1), (3, 2)]), angle(&[(2, 2), (3, 1)])), (1667, 1333));
}

#[test]
fn each_joining_beam_restarts_the_gap_count() {
    let scan = scan_with_intensities(&[(2, 3), (4, 1), (6, 3), (9, 1)]);
    let count = |max_gap| find(&scan, Settings { max_gap, ..Settings::default() }).count;
    assert_eq!((count(0), count(1), count(2)), (4, 2, 1));
    let mark = find(&scan, Settings { max_gap: 1, ..Settings::default() }).mark_array[0];
    assert_eq!((mark.first_beam, mark.last_beam, mark.edge, mark.weight), (2, 6, 0, 7));
}

#[test]
fn marks_are_unavailable_without_reflector_bits() {
    let mut scan = scan_with_intensities(&[(4, 1)]);
    scan.intensity_bits = 0;
    let out = find(&scan, Settings::default());
    assert_eq!((out.count, out.is_available()), (0, false));
    scan.intensity_bits = 3;
    scan.contents = 0;
    assert!(!find(&scan, Settings::default()).is_available());
    let nothing = find(&scan_with_intensities(&[]), Settings::default());
    assert_eq!((nothing.count, nothing.is_available()), (0, true), "nothing there is something known");
}

/// Returns a revolution of eight beams at 1 m with these intensities. Each exact angle is an eighth of a beam beyond
/// the middle of its beam.
fn revolution(intensities: [u8; 8]) -> Box<Scan> {
    let mut scan = Scan::of(ScanHead::of_revolution(Family::Ld, 8), &[1000; 8]);
    let step = scan.step;
    let arrays = scan.arrays();
    arrays.upper.copy_from_slice(&intensities);
    for (i, exact) in arrays.angles.iter_mut().enumerate() {
        // The exact angle of the first beam is counted from the next revolution.
        *exact = ((i as f64 + 0.125) * step - if i == 0 { std::f64::consts::TAU } else { 0.0 }) as f32;
    }
    scan
}

#[test]
fn intensities_above_a_level_are_marks() {
    let scan = revolution([3, 90, 240, 255, 241, 239, 0, 7]);
    let none = find(&scan, Settings::default());
    assert_eq!((none.count, none.is_available(), none.lacks_level()), (0, false, true));
    let settings = Settings { level: Some(240), min_level: 7, ..Settings::PAPER };
    let found = find(&scan, settings);
    assert_eq!((found.count, found.is_available(), found.lacks_level()), (1, true, false));
    let mark = found.mark_array[0];
    assert_eq!((mark.first_beam, mark.last_beam, mark.peak, mark.weight), (2, 4, 255, 240 + 255 + 241));
    // `level` has no effect on scanners with reflector levels, and `min_level` has no effect on other scanners.
    let lms = find(&scan_with_intensities(&[(4, 3)]), Settings { level: Some(5), ..Settings::PAPER });
    assert_eq!((lms.count, lms.is_available(), lms.lacks_level()), (1, true, false));
    assert_eq!(find(&scan_with_intensities(&[(4, 3)]), settings).count, 0);
}

#[test]
fn mark_position_uses_exact_angles() {
    let angle = |intensities| {
        let settings = Settings { level: Some(100), ..Settings::PAPER };
        f64::from(find(&revolution(intensities), settings).mark_array[0].angle_mdeg) / 1000.0
    };
    let near = |angle: f64, expected: f64| assert!((angle - expected).abs() < 1e-3, "{angle} {expected}");
    near(angle([0, 0, 100, 100, 0, 0, 0, 0]), -45.0 * (2.5 + 0.125));
    near(angle([200, 0, 0, 0, 0, 0, 0, 0]), -45.0 * 0.125);
    // Behind the scanner, at 180 degrees, the angle of a mark changes its sign, as for sectors.
    near(angle([0, 0, 0, 0, 200, 0, 0, 0]), 360.0 - 45.0 * 4.125);
    near(angle([0, 0, 0, 0, 0, 0, 0, 200]), 360.0 - 45.0 * 7.125);
}
