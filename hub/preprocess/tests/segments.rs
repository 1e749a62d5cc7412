//! Tests of segments. The segments are compared with those of a slow version, which calculates each point with sine and
//! cosine, and each distance from two points.

use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::{ArrayFlags, Foreground, ForegroundHead, MAX_SEGMENTS, Pose, Scan, ScanHead, Segment};

/// Number of beams of all scans in these tests.
const BEAM_COUNT: usize = 401;

/// Returns a foreground with the beams in `ranges`, which has pairs of beam and range in the order of the beams.
fn foreground(ranges: &[(usize, u16)]) -> Box<Foreground> {
    let mut foreground = Foreground::of_bytes(&vec![0xA5; Foreground::len(BEAM_COUNT)]);
    let head =
        ForegroundHead { count: BEAM_COUNT as u16, beams: ranges.len() as u16, ..ForegroundHead::default() };
    let arrays = foreground.begin(head);
    arrays.bits.fill(0);
    arrays.ranges.fill(0);
    for (place, &(beam, range)) in ranges.iter().enumerate() {
        arrays.bits[beam / 8] |= 1 << (beam % 8);
        arrays.ranges[place] = range;
    }
    foreground
}

/// Returns the end of beam `i` of `scan` in the robot's frame, in mm.
fn point(scan: &Scan, pose: &Pose, i: usize, range: u16) -> (f64, f64) {
    let turned = scan.angle(i);
    let turned = if pose.upside_down == 1 { -turned } else { turned };
    let angle = pose.yaw_rad + turned;
    let range_mm = f64::from(range) * f64::from(scan.unit_um) / 1000.0;
    (1000.0 * pose.x_m + range_mm * angle.cos(), 1000.0 * pose.y_m + range_mm * angle.sin())
}

fn distance(a: (f64, f64), b: (f64, f64)) -> f64 {
    (a.0 - b.0).hypot(a.1 - b.1)
}

#[test]
fn segments_match_the_reference() {
    let mut random = fastrand::Rng::with_seed(3);
    let mut maximum = 0;
    // Number of scans in which the exact angles change the result.
    let mut others = 0;
    for round in 0..3_000 {
        let is_exact = round % 2 == 1;
        let step_mdeg = [250, 500, 1000][random.usize(..3)];
        let unit_mm = [1, 10, 100][random.usize(..3)];
        let head = ScanHead::lms(BEAM_COUNT, random.i32(-180_000..0), step_mdeg, unit_mm, 13);
        let contents = head.contents | if is_exact { ArrayFlags::ANGLES } else { 0 };
        let mut scan = Scan::of(ScanHead { contents, ..head }, &[0; BEAM_COUNT]);
        let (first_angle, step) = (scan.first_angle, scan.step);
        for (i, exact) in scan.arrays().angles.iter_mut().enumerate() {
            let turns = f64::from(random.i32(-1..=1)) * std::f64::consts::TAU;
            *exact = (first_angle + (i as f64 + random.f64() - 0.5) * step + turns) as f32;
        }
        let pose = Pose {
            x_m: random.f64() - 0.5,
            y_m: random.f64() - 0.5,
            yaw_rad: 7.0 * random.f64(),
            upside_down: random.u8(..2),
            reserved: [0; 7],
        };
        let (mut range_mm, share) = (2_000.0, 0.3 + 0.7 * random.f64());
        let mut ranges = Vec::new();
        for i in 0..BEAM_COUNT {
            // Most ranges differ from the previous range only by noise. Some ranges differ by a step, which may start
            // another segment.
            let step_mm = if random.u8(..8) == 0 { 600.0 } else { 30.0 };
            range_mm = (range_mm + step_mm * (random.f64() - 0.5)).clamp(50.0, 8_000.0);
            if random.f64() < share {
                ranges.push((i, (range_mm / f64::from(unit_mm)) as u16));
            }
        }
        let even = (f64::from(step_mdeg) / 1000.0).to_radians();
        let limit_mm =
            |range_mm: f64, step: f64| range_mm * step.sin() / (10_f64.to_radians() - step).sin() + 15.0;
        let together = |a: &(usize, u16), b: &(usize, u16)| {
            let step = (scan.angle(b.0) - scan.angle(a.0)).rem_euclid(std::f64::consts::TAU);
            let step = if is_exact { step } else { even };
            let range_mm = f64::from(a.1) * f64::from(unit_mm);
            let apart_mm = distance(point(&scan, &pose, a.0, a.1), point(&scan, &pose, b.0, b.1));
            a.0 + 1 == b.0 && apart_mm <= limit_mm(range_mm, step)
        };
        let expected: Vec<_> = ranges.chunk_by(together).collect();
        maximum = maximum.max(expected.len());
        if is_exact {
            let mut of_grid = foreground(&ranges);
            Segmenter::new(pose, BEAM_COUNT).update(&Scan::of(head, &[0; BEAM_COUNT]), &mut of_grid);
            others += usize::from(usize::from(of_grid.segments) != expected.len().min(MAX_SEGMENTS));
        }

        let mut out = foreground(&ranges);
        Segmenter::new(pose, BEAM_COUNT).update(&scan, &mut out);
        assert_eq!(usize::from(out.segments), expected.len().min(MAX_SEGMENTS), "round {round}");
        assert_eq!(usize::from(out.dropped), expected.len().saturating_sub(MAX_SEGMENTS));
        let (used, head) = (out.segments().len(), **out);
        assert!(out.clone().begin(head).segments[used..].iter().all(|rest| *rest == Segment::default()));
        for (segment, beams) in out.segments().iter().zip(expected) {
            let ((first, a), (last, b)) = (beams[0], beams[beams.len() - 1]);
            assert_eq!((usize::from(segment.first), usize::from(segment.last)), (first, last));
            assert_eq!(Some(segment.nearest), beams.iter().map(|beam| beam.1).min());
            let points = || beams.iter().map(|&(i, range)| point(&scan, &pose, i, range));
            let mean = |part: fn((f64, f64)) -> f64| points().map(part).sum::<f64>() / beams.len() as f64;
            let width =
                distance(point(&scan, &pose, first, a), point(&scan, &pose, last, b)) / f64::from(unit_mm);
            for (reported, exact) in [
                (f64::from(segment.width), width),
                (f64::from(segment.x_mm), mean(|point| point.0)),
                (f64::from(segment.y_mm), mean(|point| point.1)),
            ] {
                assert!((reported - exact).abs() < 0.5 + 1e-6, "round {round}: {reported}, {exact}");
            }
        }
    }
    assert!(maximum > MAX_SEGMENTS, "{maximum} segments at most: none was left out");
    assert!(others > 100, "{others} differ from those of an even grid");
}

#[test]
fn segment_points_follow_a_change_of_angles() {
    let mut cutter = Segmenter::new(Pose::default(), BEAM_COUNT);
    let mut x_mm = |first_angle_mdeg, step_mdeg| {
        let scan = Scan::of(ScanHead::lms(BEAM_COUNT, first_angle_mdeg, step_mdeg, 1, 13), &[0; BEAM_COUNT]);
        let mut out = foreground(&[(180, 1_000)]);
        cutter.update(&scan, &mut out);
        (out.segments()[0].x_mm, out.segments()[0].y_mm)
    };
    assert_eq!(x_mm(-90_000, 500), (1_000, 0));
    assert_eq!(x_mm(-90_000, 1000), (0, 1_000));
    assert_eq!(x_mm(-180_000, 1000), (1_000, 0));
}

/// The foreground of consecutive scans has runs of several beams, and single beams that appear again, move, or
/// disappear.
#[test]
fn neighbors_or_previous_scan_support_a_segment() {
    let mut random = fastrand::Rng::with_seed(27);
    let (mut supported, mut unsupported) = (0, 0);
    for unit_mm in [1, 10] {
        let pose = Pose { x_m: 0.3, y_m: -0.2, yaw_rad: 2.5, ..Pose::default() };
        let scan = Scan::of(ScanHead::lms(BEAM_COUNT, -100_000, 500, unit_mm, 13), &[0; BEAM_COUNT]);
        let mut cutter = Segmenter::new(pose, BEAM_COUNT);
        let mut before: Vec<(f64, f64)> = Vec::new();
        for round in 0..2_000 {
            let mut ranges = Vec::new();
            for i in (0..BEAM_COUNT).filter(|i| i % 3 != 2) {
                // Skip every third beam, so that a beam has a neighbor on one side only. Half of the ranges are equal,
                // so that two neighbors can form a segment.
                let range_mm = if random.bool() { 2_000 } else { random.u32(500..8_000) };
                if random.u8(..10) == 0 {
                    ranges.push((i, (range_mm / unit_mm) as u16));
                }
            }
            if round % 50 == 49 {
                ranges.clear();
            }
            let mut out = foreground(&ranges);
            cutter.update(&scan, &mut out);
            let points: Vec<_> = ranges.iter().map(|&(i, range)| point(&scan, &pose, i, range)).collect();
            for (i, segment) in out.segments().iter().enumerate() {
                let beam = ranges.iter().position(|&(beam, _)| beam == usize::from(segment.first)).unwrap();
                let nearest_mm = before.iter().map(|&other| distance(points[beam], other)).reduce(f64::min);
                let is_near = nearest_mm.is_some_and(|nearest_mm| nearest_mm < 300.0);
                // The two versions compute sine and cosine differently, so skip distances at the limit.
                if nearest_mm.is_some_and(|nearest_mm| (nearest_mm - 300.0).abs() < 1e-6) {
                    continue;
                }
                let expected = segment.first < segment.last || is_near;
                assert_eq!(out.has_support(i), expected, "{unit_mm} mm, round {round}: {segment:?}");
                supported += usize::from(expected && segment.first == segment.last);
                unsupported += usize::from(!expected);
            }
            assert_eq!(out.supported.checked_shr(out.segments.into()).unwrap_or(0), 0);
            before = points;
        }
    }
    assert!(
        supported > 1_000 && unsupported > 1_000,
        "{supported} single beams with support, {unsupported} without"
    );
}
