//! Tests of line features: a comparison with a slow version that tries all cuts, scans with known lines, and scans
//! without information.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use fastrand::Rng;
use scanhub_preprocess::lines::{LineFinder, Settings, StopCriterion};
use scanhub_schema::{ArrayFlags, Code, Line, Lines, Pose, Scan, ScanHead};

fn head(count: usize, first_angle: f64, step: f64) -> ScanHead {
    let no_return = Code::NoReturn.value();
    ScanHead {
        first_angle,
        step,
        unit_um: 1000,
        count: count as u16,
        valid_to: 0xFFEF,
        no_return,
        beyond: no_return,
        turns: 1,
        ..ScanHead::default()
    }
}

/// Returns a scan. `range` returns the range in meters for each angle. `None` becomes the code of no return.
fn scan(head: ScanHead, range: impl Fn(f64) -> Option<f64>) -> Box<Scan> {
    let angle = |i: usize| head.first_angle + i as f64 * head.step;
    let unit = |i| range(angle(i)).map_or(head.no_return, |range: f64| (1000.0 * range).round() as u16);
    Scan::of(head, &(0..head.count.into()).map(unit).collect::<Vec<_>>())
}

/// Returns a normally distributed number with standard deviation 1, by the method of Box and Muller.
fn normal(random: &mut Rng) -> f64 {
    (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (TAU * random.f64()).cos()
}

fn find(scan: &Scan, pose: Pose, settings: Settings) -> Box<Lines> {
    // Fill the payload with garbage before, because no garbage must remain in the result.
    let mut lines = Box::new(Lines::default());
    bytemuck::bytes_of_mut(&mut *lines).fill(0xA5);
    LineFinder::new(pose, settings, scan.beams()).update(scan, &mut lines);
    lines
}

/// Returns the range in meters to the walls of a room: x from -2 to 4, y from -3 to 2.5.
fn room(angle: f64) -> f64 {
    let (sin, cos) = angle.sin_cos();
    let x = if cos > 0.0 { 4.0 / cos } else { -2.0 / cos };
    let y = if sin > 0.0 { 2.5 / sin } else { -3.0 / sin };
    x.min(y)
}

/// Returns a scan of a room that is drawn from `seed`. The walls are a polygon around the sensor with 6 to 20 corners
/// at random distances. The noise is 20 mm.
fn star(seed: u64, beams: usize) -> Box<Scan> {
    let mut random = Rng::with_seed(seed);
    let corners = random.usize(6..=20);
    let distances: Vec<f64> = (0..corners).map(|_| 2.0 + 4.0 * random.f64()).collect();
    let each = TAU / corners as f64;
    let head = head(beams, -PI, TAU / beams as f64);
    let ranges: Vec<f64> = (0..beams)
        .map(|i| {
            let turned = i as f64 * head.step;
            let corner = ((turned / each) as usize).min(corners - 1);
            let (one, two) = (distances[corner], distances[(corner + 1) % corners]);
            let inside = turned - corner as f64 * each;
            one * two * each.sin() / (one * inside.sin() + two * (each - inside).sin())
                + 0.02 * normal(&mut random)
        })
        .collect();
    scan(head, |angle| ranges.get(((angle + PI) / head.step).round() as usize).copied())
}

/// Returns the minimum, over all lines, of the sum of squared distances along the beams between points and line. The
/// slow search varies the distance and the direction of the line step by step.
fn slow_line(beams: &[(f64, f64)]) -> f64 {
    let error = |r: f64, alpha: f64| -> f64 {
        let off = |&(angle, range): &(f64, f64)| {
            let cos = (angle - alpha).cos();
            if cos <= 1e-3 { 1e3 } else { range - r / cos }
        };
        beams.iter().map(|beam| off(beam).powi(2)).sum()
    };
    let ((t1, r1), (t2, r2)) = (beams[0], beams[beams.len() - 1]);
    let (dx, dy) = (r2 * t2.cos() - r1 * t1.cos(), r2 * t2.sin() - r1 * t1.sin());
    let mut alpha = (-dx).atan2(dy);
    let mut r = r1 * (t1 - alpha).cos();
    if r < 0.0 {
        (alpha, r) = (alpha + PI, -r);
    }
    let mut best = error(r, alpha);
    let (mut by_r, mut by_alpha) = (0.1, 0.05);
    while by_r > 1e-6 {
        let mut is_better = false;
        for (dr, da) in [
            (by_r, 0.0),
            (-by_r, 0.0),
            (0.0, by_alpha),
            (0.0, -by_alpha),
            (by_r, by_alpha),
            (by_r, -by_alpha),
            (-by_r, by_alpha),
            (-by_r, -by_alpha),
        ] {
            let next = error(r + dr, alpha + da);
            if next < best {
                (r, alpha, best, is_better) = (r + dr, alpha + da, next, true);
            }
        }
        if !is_better {
            (by_r, by_alpha) = (0.7 * by_r, 0.7 * by_alpha);
        }
    }
    best
}

/// Returns the minimum sum of squared distances for `count` lines. The function tries all cuts.
fn slow_error(scan: &Scan, count: usize) -> f64 {
    let beams: Vec<(f64, f64)> =
        (0..scan.beams()).filter_map(|i| Some((scan.angle(i), scan.distance_m(i)?))).collect();
    let n = beams.len();
    let mut price = vec![vec![f64::INFINITY; n + 1]; n];
    for first in 0..n {
        for end in first + 2..=n {
            price[first][end] = slow_line(&beams[first..end]);
        }
    }
    let mut best: Vec<f64> = (0..=n).map(|end| if end == 0 { 0.0 } else { f64::INFINITY }).collect();
    for _ in 0..count {
        let with_one_more =
            |end: usize| (0..end).map(|first| best[first] + price[first][end]).fold(f64::INFINITY, f64::min);
        best = (0..=n).map(with_one_more).collect();
    }
    best[n]
}

/// Returns the sum of squared distances along the beams from the lines that were found, and the number of beams on
/// these lines.
fn fit_error(scan: &Scan, lines: &Lines) -> (f64, usize) {
    let (mut sum, mut beams) = (0.0, 0);
    for line in lines.lines() {
        for beam in usize::from(line.first)..=line.last.into() {
            let Some(range) = scan.distance_m(beam) else { continue };
            let on_line = f64::from(line.r_m) / (scan.angle(beam) - f64::from(line.alpha_rad)).cos();
            sum += (range - on_line).powi(2);
            beams += 1;
        }
    }
    (sum, beams)
}

#[test]
fn fit_is_close_to_the_best_partition() {
    let (mut plain, mut refined, mut best) = (0.0, 0.0, 0.0);
    for seed in 0..12 {
        let scan = star(seed, 60);
        let stop = StopCriterion::Number(f64::INFINITY);
        let settings = Settings { max: 8, min_points: 2, refine: false, stop };
        let (of_plain, beams) = fit_error(&scan, &find(&scan, Pose::default(), settings));
        assert_eq!(beams, 60, "all end on a line");
        let refine = Settings { refine: true, ..settings };
        let (of_refined, beams) = fit_error(&scan, &find(&scan, Pose::default(), refine));
        assert!(
            beams >= 57 && of_refined <= 1.000_1 * of_plain,
            "one in twenty may be left out, {beams} are not: {of_refined} of {of_plain}"
        );
        let of_best = slow_error(&scan, 8);
        assert!(of_plain >= 0.999 * of_best, "nothing is better than the best: {of_plain}, {of_best}");
        plain += of_plain.sqrt();
        refined += of_refined.sqrt();
        best += of_best.sqrt();
    }
    assert!(plain < 1.25 * best && refined < 1.1 * best, "{plain}, {refined}, best {best}");
}

fn is_near(one: f32, two: f64, tolerance: f64) -> bool {
    (f64::from(one) - two).abs() < tolerance
}

/// The lines are the walls of the room, with the right ends and corners, for any pose of the sensor on the robot.
#[test]
fn room_has_four_lines_and_its_corners() {
    let mut random = Rng::with_seed(3);
    for (pose, count, step) in [
        (Pose::default(), 720, 0.5_f64.to_radians()),
        (Pose { x_m: 0.5, y_m: -0.25, yaw_rad: FRAC_PI_2, ..Pose::default() }, 720, 0.5_f64.to_radians()),
        (Pose { x_m: -5.0, upside_down: 1, ..Pose::default() }, 1440, -0.25_f64.to_radians()),
    ] {
        let noises: Vec<f64> = (0..count).map(|_| 0.01 * normal(&mut random)).collect();
        let head = head(count, 0.3, step);
        let scan = scan(head, |angle| {
            let i = ((angle - 0.3) / step).round() as usize;
            Some(room(angle) + noises[i])
        });
        for refine in [false, true] {
            let lines = find(&scan, pose, Settings { refine, ..Settings::default() });
            // The wall that beam 0 meets is two lines, one at the start of the scan and one at the end.
            assert_eq!((lines.lines().len(), lines.corners().len()), (5, 4), "{lines:?}");
            assert!(is_near(lines.noise_m, 0.01, 0.002), "{}", lines.noise_m);
            assert!(usize::from(lines.on_lines) >= 98 * count / 100 && usize::from(lines.readings) == count);
            for corner in lines.corners() {
                // Transform the corner back into the sensor's frame.
                let (x, y) = (f64::from(corner.x_m) - pose.x_m, f64::from(corner.y_m) - pose.y_m);
                let (sin, cos) = pose.yaw_rad.sin_cos();
                let (x, y) = (cos * x + sin * y, cos * y - sin * x);
                let y = if pose.upside_down == 0 { y } else { -y };
                let is_corner = (x - 4.0).abs().min((x + 2.0).abs()) < 0.02
                    && (y - 2.5).abs().min((y + 3.0).abs()) < 0.02;
                assert!(is_corner, "({x}, {y})");
            }
            for line in lines.lines() {
                let on_it = |x: f32, y: f32| x * line.alpha_rad.cos() + y * line.alpha_rad.sin() - line.r_m;
                assert!(on_it(line.x1_m, line.y1_m).abs() < 1e-4 && on_it(line.x2_m, line.y2_m).abs() < 1e-4);
                assert!(line.r_m >= 0.0 && line.alpha_rad.abs() <= std::f32::consts::PI);
            }
        }
    }
}

/// The standard deviations that a line reports agree with the measured deviations of the lines of many scans.
#[test]
fn reported_deviations_match_measured_deviations() {
    let mut random = Rng::with_seed(4);
    let pose = Pose { x_m: 0.4, y_m: 0.3, ..Pose::default() };
    let mut found: Vec<Line> = Vec::new();
    for _ in 0..400 {
        let mut noise = || 0.02 * normal(&mut random);
        let noises: Vec<f64> = (0..81).map(|_| noise()).collect();
        let head = head(81, -0.4, 0.01);
        let scan = scan(head, |angle| {
            Some(3.0 / (angle - 0.7).cos() + noises[((angle + 0.4) / 0.01).round() as usize])
        });
        let lines = find(&scan, pose, Settings::default());
        if let [line] = lines.lines() {
            found.push(*line);
        }
    }
    // With this criterion, noise splits a line in about one of N scans, where N is the number of beams.
    assert!(found.len() >= 390, "noise alone makes no lines: one line in {} of 400", found.len());
    let count = found.len() as f64;
    let spread = |of: fn(&Line) -> f32| {
        let mean = found.iter().map(|line| f64::from(of(line))).sum::<f64>() / count;
        (found.iter().map(|line| (f64::from(of(line)) - mean).powi(2)).sum::<f64>() / (count - 1.0)).sqrt()
    };
    let reported = |of: fn(&Line) -> f32| found.iter().map(|line| f64::from(of(line))).sum::<f64>() / count;
    let (r, alpha) = (spread(|line| line.r_m), spread(|line| line.alpha_rad));
    let (reported_r, reported_alpha) = (reported(|line| line.sd_r_m), reported(|line| line.sd_alpha_rad));
    assert!((0.8..1.25).contains(&(reported_r / r)), "{reported_r} m, and it is {r}");
    assert!((0.8..1.25).contains(&(reported_alpha / alpha)), "{reported_alpha}, and it is {alpha}");
}

/// If a scan has exact angles, its points are not in the directions of the beams at equal steps. The lines must be
/// computed from the exact angles.
#[test]
fn lines_use_exact_angles() {
    let mut random = Rng::with_seed(5);
    let head = ScanHead { contents: ArrayFlags::ANGLES, ..head(450, 0.0, -TAU / 450.0) };
    let exact: Vec<f32> =
        (0..450).map(|i| (head.step * (f64::from(i) + 0.8 * (random.f64() - 0.5))) as f32).collect();
    let ranges: Vec<u16> = exact.iter().map(|&angle| (1000.0 * room(angle.into())).round() as u16).collect();
    let mut with = Scan::of(head, &ranges);
    with.arrays().angles.copy_from_slice(&exact);
    let lines = find(&with, Pose::default(), Settings::default());
    assert_eq!((lines.lines().len(), lines.corners().len()), (5, 4), "{lines:?}");
    assert!(lines.noise_m < 0.001, "{}", lines.noise_m);
    let without = Scan::of(ScanHead { contents: 0, ..head }, &ranges);
    assert!(find(&without, Pose::default(), Settings::default()).noise_m > 0.002);
}

#[test]
fn settings_limit_lines_and_points() {
    let scan = star(1, 720);
    let all = find(&scan, Pose::default(), Settings::default());
    assert!(all.lines().len() >= 6 && !all.is_overflow(), "{all:?}");
    let few = find(&scan, Pose::default(), Settings { max: 4, ..Settings::default() });
    assert_eq!((few.lines().len(), few.is_overflow()), (4, true));
    let mut points: Vec<u16> = all.lines().iter().map(|line| line.points).collect();
    points.sort_unstable();
    let min_points = points[points.len() / 2];
    let long = find(&scan, Pose::default(), Settings { min_points, ..Settings::default() });
    assert!(long.lines().iter().all(|line| line.points >= min_points));
    assert!(!long.lines().is_empty() && long.lines().len() < all.lines().len(), "{long:?}");
}

fn assert_sound(lines: &Lines, scan: &Scan, settings: &Settings) {
    let payload = &mut [0; 4096];
    let len = scanhub_schema::datagram::DatagramPayload::pack(lines, payload).unwrap();
    assert!(
        <Lines as scanhub_schema::datagram::DatagramPayload>::room(&payload[..len]).is_some(),
        "{lines:?}"
    );
    assert!(lines.count <= settings.max && usize::from(lines.readings) <= scan.beams());
    assert_eq!(lines.lines().iter().map(|line| line.points).sum::<u16>(), lines.on_lines);
    assert!(lines.lines().windows(2).all(|pair| pair[0].last < pair[1].first));
    for line in lines.lines() {
        assert!(line.points >= settings.min_points && line.last - line.first + 1 >= line.points);
        assert!(line.sd_r_m >= 0.0 && line.sd_alpha_rad > 0.0, "nothing is known without a doubt: {line:?}");
    }
    let unused = [&lines.line_array[lines.lines().len()..]].concat();
    assert!(unused.iter().all(|line| *line == Line::default()));
}

/// A scan without information has no line, or only lines with large standard deviations.
#[test]
fn uninformative_input_yields_no_certain_line() {
    let mut random = Rng::with_seed(6);
    let settings = Settings::default();
    let wide = head(361, -FRAC_PI_2, 0.5_f64.to_radians());
    let none = find(&scan(wide, |_| None), Pose::default(), settings);
    assert_eq!((none.count, none.corners, none.readings), (0, 0, 0));
    let one = find(&scan(head(1, 0.0, 0.01), |_| Some(3.0)), Pose::default(), settings);
    assert_eq!((one.count, one.readings), (0, 1));
    // Nine of ten beams have no return, and the others have random ranges.
    for seed in 0..50 {
        let mut random = Rng::with_seed(seed);
        let ranges: Vec<Option<f64>> =
            (0..361).map(|_| (random.u8(..10) == 0).then(|| 0.5 + 20.0 * random.f64())).collect();
        let scan = scan(wide, |angle| ranges[((angle + FRAC_PI_2) / wide.step).round() as usize]);
        let lines = find(&scan, Pose::default(), settings);
        assert_sound(&lines, &scan, &settings);
        assert_eq!(lines.count, 0, "{lines:?}");
    }
    // If the ranges are only noise, the lines have large standard deviations.
    for refine in [false, true] {
        let settings = Settings { refine, ..settings };
        let ranges: Vec<f64> = (0..361).map(|_| 3.0 + random.f64()).collect();
        let scan = scan(wide, |angle| Some(ranges[((angle + FRAC_PI_2) / wide.step).round() as usize]));
        let lines = find(&scan, Pose::default(), settings);
        assert_sound(&lines, &scan, &settings);
        assert!(lines.noise_m > 0.1, "{}", lines.noise_m);
        assert!(lines.lines().iter().all(|line| line.sd_r_m > 0.02), "{lines:?}");
    }
    // If all ranges are equal, short lines approximate the circle.
    let circle = scan(wide, |_| Some(5.0));
    let lines = find(&circle, Pose::default(), settings);
    assert_sound(&lines, &circle, &settings);
    assert!(lines.lines().iter().all(|line| (f64::from(line.r_m) - 5.0).abs() < 0.02), "{lines:?}");
}

/// No scan, whatever its content, causes a panic, and all results are plausible.
#[test]
fn no_scan_causes_a_panic() {
    for seed in 0..3000 {
        let mut random = Rng::with_seed(seed);
        let count = match random.u8(..4) {
            0 => random.usize(..8),
            1 => 361,
            _ => random.usize(1..600),
        };
        let mut any = head(count, 20.0 * random.f64() - 10.0, 0.2 * random.f64() - 0.1);
        any.unit_um = [0, 1, 250, 1000, 10_000, u32::MAX][random.usize(..6)];
        any.valid_to = [0xFFEF, 100, 0][random.usize(..3)];
        if random.bool() {
            any.contents = ArrayFlags::ANGLES;
        }
        if random.u8(..10) == 0 {
            any.step = 0.0;
        }
        let kind = random.u8(..4);
        let mut last = 1000.0;
        let ranges: Vec<u16> = (0..count)
            .map(|i| match kind {
                0 => random.u16(..),
                1 => 700,
                2 => (2000.0 / (0.005 * i as f64).cos().max(0.1)) as u16,
                _ => {
                    last += 100.0 * (random.f64() - 0.5);
                    last as u16
                }
            })
            .collect();
        let mut scan = Scan::of(any, &ranges);
        for (i, angle) in scan.arrays().angles.iter_mut().enumerate() {
            *angle = match random.u8(..20) {
                0 => f32::NAN,
                1 => f32::INFINITY,
                2 => f32::MAX,
                3 => 0.5,
                _ => (any.first_angle + i as f64 * any.step) as f32,
            };
        }
        let settings = Settings {
            max: random.u8(1..=64),
            min_points: random.u16(3..12),
            refine: random.bool(),
            ..Settings::default()
        };
        let pose = Pose { x_m: random.f64() - 0.5, yaw_rad: random.f64(), ..Pose::default() };
        let lines = find(&scan, pose, settings);
        assert_sound(&lines, &scan, &settings);
    }
}
