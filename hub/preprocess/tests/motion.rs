//! Tests of the motion of a robot. The motion is compared with a slow version that tries all pairs of points, and with
//! the true motion of simulated drives. Other tests have surroundings that do not define the position in some
//! directions, and scans without information.

mod drives;

use std::f64::consts::PI;

use drives::{Drive, beams_at, normal, scan};
use fastrand::Rng;
use scanhub_preprocess::motion::{MotionEstimator, Pose2, Settings};
use scanhub_schema::{ArrayFlags, Motion, MotionMethod, Pose, Scan};

/// Returns the motion for each of `scans`. The payloads contain garbage before, which must not remain.
fn estimate_motion(scans: &[Box<Scan>], pose: Pose, settings: Settings) -> Vec<Motion> {
    let beams = scans.iter().map(|scan| scan.beams()).max().unwrap_or(0);
    let mut estimator = MotionEstimator::new(pose, settings, beams);
    let estimate = |(number, scan): (usize, &Scan)| {
        let mut motion: Motion = bytemuck::Zeroable::zeroed();
        bytemuck::bytes_of_mut(&mut motion).fill(0xA5);
        estimator.update(scan, drives::stamp_ns(number), 0, &mut motion);
        motion
    };
    scans.iter().map(|scan| &**scan).enumerate().map(estimate).collect()
}

fn step(motion: &Motion) -> Pose2 {
    Pose2::new(motion.dx_m.into(), motion.dy_m.into(), motion.dyaw_rad.into())
}

/// Returns the distance between two poses, in meters and radians.
fn pose_difference(one: &Pose2, other: &Pose2) -> (f64, f64) {
    let between = one.inverse().then(other);
    (between.x.hypot(between.y), between.yaw.abs())
}

/// Returns the position of `now` relative to `reference`, calculated from all pairs of points. Each point of `now` is
/// pulled to the line through the nearest point of `reference` and the neighbors of this point. Points near their line
/// have more weight than points far from it.
fn reference_match(reference: &Scan, now: &Scan) -> Pose2 {
    let points = |scan: &Scan| -> Vec<(f64, f64)> {
        let of = |i: usize| Some((scan.distance_m(i)?, scan.angle(i)));
        (0..scan.beams()).filter_map(of).map(|(r, a)| (r * a.cos(), r * a.sin())).collect()
    };
    let (kept, now) = (points(reference), points(now));
    // The line goes through the point and three neighbors on each side. The normal of the line is the direction of
    // minimum spread. It is found by trying many directions.
    let normal_at = |at: usize| -> (f64, f64) {
        let near = &kept[at.saturating_sub(3)..(at + 4).min(kept.len())];
        let spread = |angle: f64| -> f64 {
            let along: Vec<f64> = near.iter().map(|p| p.0 * angle.cos() + p.1 * angle.sin()).collect();
            let mean = along.iter().sum::<f64>() / along.len() as f64;
            along.iter().map(|value| (value - mean).powi(2)).sum()
        };
        let angles = (0..720).map(|i| f64::from(i) * PI / 720.0);
        let best = angles.min_by(|a, b| spread(*a).total_cmp(&spread(*b))).unwrap();
        (best.cos(), best.sin())
    };
    let normals: Vec<(f64, f64)> = (0..kept.len()).map(normal_at).collect();
    let cost = |place: &Pose2| -> f64 {
        let off = |point: &(f64, f64)| {
            let (x, y) = place.point(*point);
            let square = |at: usize| (kept[at].0 - x).powi(2) + (kept[at].1 - y).powi(2);
            let nearest = (0..kept.len()).min_by(|a, b| square(*a).total_cmp(&square(*b))).unwrap();
            let (dx, dy) = (x - kept[nearest].0, y - kept[nearest].1);
            let off = normals[nearest].0 * dx + normals[nearest].1 * dy;
            (off * off).min(0.01)
        };
        now.iter().map(off).sum()
    };
    let (mut place, mut width) = (Pose2::default(), 0.05);
    let mut best = cost(&place);
    while width > 2e-5 {
        let mut is_better = false;
        for (x, y, yaw) in [
            (1.0, 0.0, 0.0),
            (-1.0, 0.0, 0.0),
            (0.0, 1.0, 0.0),
            (0.0, -1.0, 0.0),
            (0.0, 0.0, 0.4),
            (0.0, 0.0, -0.4),
        ] {
            let next = Pose2::new(place.x + width * x, place.y + width * y, place.yaw + width * yaw);
            let of_next = cost(&next);
            if of_next < best {
                (place, best, is_better) = (next, of_next, true);
            }
        }
        if !is_better {
            width *= 0.6;
        }
    }
    place
}

#[test]
fn steps_match_the_reference_and_the_truth() {
    for seed in 0..4 {
        let drive = Drive::through_a_room(seed, 181, 2, 0.01);
        let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
        let truth = drive.poses[0].inverse().then(&drive.poses[1]);
        let (slow, found) = (reference_match(&drive.scans[0], &drive.scans[1]), step(&found[1]));
        let (of_slow, of_truth) = (pose_difference(&slow, &found), pose_difference(&truth, &found));
        assert!(of_slow.0 < 0.01 && of_slow.1 < 0.004, "{seed}: {slow:?} {found:?}");
        assert!(of_truth.0 < 0.008 && of_truth.1 < 0.003, "{seed}: {truth:?} {found:?}");
    }
}

#[test]
fn steps_sum_to_the_pose_with_right_covariance() {
    let (mut squares, mut steps) = (0.0, 0);
    for seed in 0..5 {
        let drive = Drive::through_a_room(seed, 361, 150, 0.01);
        let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
        assert_eq!((found[0].method(), found[0].has_pose()), (MotionMethod::First, true));
        let mut sum = Pose2::default();
        for (at, motion) in found.iter().enumerate().skip(1) {
            assert!(
                motion.has_step() && motion.overlap > 0.6 && !motion.is_degenerate(),
                "{seed} {at}: {motion:?}"
            );
            sum = sum.then(&step(motion));
            let pose = Pose2::new(motion.x_m, motion.y_m, motion.yaw_rad);
            let (metres, radians) = pose_difference(&sum, &pose);
            assert!(metres < 1e-4 && radians < 1e-4, "{seed} {at}: {sum:?} {pose:?}");
            let truth = drive.poses[at - 1].inverse().then(&drive.poses[at]);
            let off = step(motion);
            let off = [off.x - truth.x, off.y - truth.y, off.yaw - truth.yaw];
            for (k, off) in off.iter().enumerate() {
                squares += off * off / f64::from(motion.covariance[4 * k]);
                steps += 1;
            }
        }
        let truth = drive.poses[0].inverse().then(&drive.poses[drive.poses.len() - 1]);
        let (metres, radians) = pose_difference(&truth, &sum);
        assert!(metres < 0.08 && radians < 0.03, "{seed}: {truth:?} {sum:?}");
    }
    let mean = squares / f64::from(steps);
    assert!((0.5..2.0).contains(&mean), "in variances: {mean}");
}

/// Returns the squared length of `error` in standard deviations of `covariance`. If the covariance is right, the mean
/// of this square over many errors is 3. The square is NaN if the covariance is not positive definite.
fn normalized(error: [f64; 3], covariance: &[f32; 9]) -> f64 {
    let (mut lower, mut whitened) = ([[0.0; 3]; 3], [0.0; 3]);
    for i in 0..3 {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|k| lower[i][k] * lower[j][k]).sum();
            let rest = f64::from(covariance[3 * i + j]) - sum;
            lower[i][j] = if i == j { rest.sqrt() } else { rest / lower[j][j] };
        }
        let sum: f64 = (0..i).map(|k| lower[i][k] * whitened[k]).sum();
        whitened[i] = (error[i] - sum) / lower[i][i];
    }
    whitened.iter().map(|value| value * value).sum()
}

/// Compares the sum of all steps at the end of each drive with the true position. Returns the mean of the squared
/// errors in variances, and the share of the errors that are within two standard deviations.
fn errors_of_sums(drives: impl Iterator<Item = Drive>) -> (f64, f64) {
    let (mut squares, mut within, mut count) = (0.0, 0.0, 0.0);
    for drive in drives {
        let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
        let last = found.last().unwrap();
        let covariance = last.sum_covariance().expect("a valid sum");
        let truth = drive.poses[0].inverse().then(&drive.poses[drive.poses.len() - 1]);
        let yaw = Pose2::new(0.0, 0.0, last.yaw_rad - truth.yaw).yaw;
        let off = [last.x_m - truth.x, last.y_m - truth.y, yaw];
        squares += normalized(off, covariance) / 3.0;
        let is_within =
            |(k, off): (usize, &f64)| off.abs() < 2.0 * f64::from(covariance[4 * k]).max(0.0).sqrt();
        within += off.iter().enumerate().filter(|axis| is_within(*axis)).count() as f64 / 3.0;
        count += 1.0;
    }
    (squares / count, within / count)
}

/// If a robot does not move, all its scans are matched with the same reference scan, so the covariance of its position
/// does not grow with the number of steps.
#[test]
fn pose_covariance_is_right_while_standing() {
    let standing = (1000..1100).map(|seed| {
        let mut drive = Drive::through_a_room(seed, 361, 1, 0.01);
        drive.stand_still(30);
        drive
    });
    let (square, within) = errors_of_sums(standing);
    println!("stands: {square:.3} variances, {within:.3} within 2 deviations");
    assert!(
        (0.5..1.3).contains(&square) && within > 0.93,
        "{square} variances, {within} within 2 deviations"
    );
}

#[test]
fn pose_covariance_is_not_too_small_while_driving() {
    for (name, drive) in [
        ("room", (|seed| Drive::through_a_room(seed, 361, 50, 0.01)) as fn(u64) -> Drive),
        ("furniture", |seed| Drive::through_furniture(seed, 50, 3, 0.02)),
        ("turn", |seed| Drive::on_the_spot(seed, 30, 45.0)),
    ] {
        let (square, within) = errors_of_sums((1000..1100).map(drive));
        println!("{name}: {square:.3} variances, {within:.3} within 2 deviations");
        assert!(square < 1.0 && within > 0.95, "{name}: {square} variances, {within} within 2 deviations");
    }
}

#[test]
fn measures_turns_during_scans() {
    for (seed, deg_per_s) in [(101, 45.0), (102, 90.0), (103, 180.0)] {
        let count = (270.0 / deg_per_s / drives::SCAN_PERIOD_S) as usize;
        let drive = Drive::on_the_spot(seed, count, deg_per_s);
        let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
        let (mut sum, mut truth) = (0.0, 0.0);
        let mut errors = Vec::new();
        for (at, motion) in found.iter().enumerate().skip(1) {
            assert!(motion.has_step(), "{deg_per_s} {at}: {motion:?}");
            let yaw_deg = drive.poses[at - 1].inverse().then(&drive.poses[at]).yaw.to_degrees();
            let of_scan = f64::from(motion.dyaw_rad).to_degrees();
            (sum, truth) = (sum + of_scan, truth + yaw_deg);
            errors.push((of_scan - yaw_deg).abs());
        }
        errors.sort_by(f64::total_cmp);
        let median = errors[errors.len() / 2];
        assert!((sum - truth).abs() < 0.6, "{deg_per_s}: {sum} of {truth} degrees");
        assert!(median < 0.03, "{deg_per_s}: {median} degrees");
    }
}

/// The estimator starts while the robot drives at 3 m/s.
#[test]
fn corrects_scans_of_an_already_moving_robot() {
    let mut drive = Drive::through_furniture(7, 0, 0, 0.0);
    drive.drive_on(40, 0.08);
    drive.scans.remove(0);
    drive.poses.remove(0);
    let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
    let off = |at: usize| {
        let truth = drive.poses[at - 1].inverse().then(&drive.poses[at]);
        let (metres, _) = pose_difference(&truth, &step(&found[at]));
        metres
    };
    let mut errors: Vec<f64> = (4..found.len()).map(off).collect();
    errors.sort_by(f64::total_cmp);
    assert!(found[1..].iter().all(Motion::has_step));
    assert!(errors[errors.len() / 2] < 0.006, "{errors:?}");
}

/// A robot turns at 120 degrees/s, and moves by 0.2 m between two scans. In one case, a person has carried the robot,
/// and it does not move now. In the other case, the robot was pushed and still turns. In both cases, the scan must be
/// corrected with the right velocity, because later steps are computed from this scan.
#[test]
fn carried_or_pushed_robot_uses_the_right_velocity() {
    for deg_per_s in [0.0, 120.0] {
        for seed in 0..20 {
            let mut drive = Drive::turning(seed, 30, 120.0);
            drive.move_by(Pose2::new(0.14, 0.14, 0.0), deg_per_s);
            drive.turn(10, deg_per_s);
            let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
            for (at, motion) in found.iter().enumerate().skip(30) {
                let truth = drive.poses[at - 1].inverse().then(&drive.poses[at]);
                let (meters, radians) = pose_difference(&truth, &step(motion));
                let degrees = radians.to_degrees();
                assert!(
                    motion.has_step() && meters < 0.02 && degrees < 0.3,
                    "{deg_per_s} degrees/s, seed {seed}, scan {at}: {meters} m, {degrees} degrees"
                );
            }
        }
    }
}

#[test]
fn motion_does_not_depend_on_the_mounting_pose() {
    let drive = Drive::through_a_room(7, 361, 30, 0.002);
    let own = estimate_motion(&drive.scans, Pose::default(), Settings::default());
    let mut random = Rng::with_seed(1);
    for _ in 0..6 {
        let pose = Pose {
            x_m: random.f64() - 0.5,
            y_m: random.f64() - 0.5,
            yaw_rad: 6.0 * random.f64(),
            upside_down: random.u8(..2),
            ..Pose::default()
        };
        // Pose of the sensor on the robot.
        let seat = Pose2::new(pose.x_m, pose.y_m, pose.yaw_rad);
        let found = estimate_motion(&drive.scans, pose, Settings::default());
        for (one, other) in own.iter().zip(&found).skip(1) {
            let mut of_sensor = step(one);
            if pose.upside_down != 0 {
                of_sensor = Pose2::new(of_sensor.x, -of_sensor.y, -of_sensor.yaw);
            }
            let expected = seat.then(&of_sensor).then(&seat.inverse());
            let (metres, radians) = pose_difference(&expected, &step(other));
            assert!(metres < 0.004 && radians < 0.003, "{pose:?}: {expected:?} {other:?}");
        }
    }
}

#[test]
fn standing_robot_does_not_drift() {
    let mut drive = Drive::through_a_room(3, 361, 1, 0.01);
    drive.stand_still(600);
    let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
    let last = found.last().unwrap();
    assert!(last.x_m.hypot(last.y_m) < 0.006 && last.yaw_rad.abs() < 0.003, "{last:?}");
}

#[test]
fn corridor_makes_its_direction_uncertain() {
    let drive = Drive::along_a_corridor(5, 361, 60);
    let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
    for motion in &found[1..] {
        assert!(motion.has_step() && motion.is_degenerate(), "{motion:?}");
        let [along, across] = [0, 4].map(|at| motion.covariance[at].sqrt());
        assert!(along > 0.2 && across < 0.02, "{motion:?}");
    }
}

#[test]
fn refuses_a_jump_and_continues_afterwards() {
    for seed in 0..5 {
        let mut drive = Drive::through_a_room(seed, 361, 40, 0.01);
        let mut other = Drive::through_a_room(seed + 100, 361, 40, 0.01);
        drive.scans.append(&mut other.scans);
        let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
        let methods: Vec<MotionMethod> = found.iter().map(Motion::method).collect();
        let refused: Vec<usize> =
            (0..found.len()).filter(|&at| methods[at] == MotionMethod::Refused).collect();
        assert_eq!(refused, [40], "{seed}: {methods:?}");
        assert_eq!(
            found[40],
            Motion { method: MotionMethod::Refused as u8, refused_steps: 1, ..Motion::default() }
        );
        let (before, after) = (&found[39], &found[41]);
        assert_eq!((before.refused_steps, after.refused_steps), (0, 1));
        assert!(
            (before.x_m - after.x_m).hypot(before.y_m - after.y_m) < 0.05,
            "the sum goes on where it was"
        );
    }
}

#[test]
fn people_do_not_bias_the_motion() {
    let mut off = [Vec::new(), Vec::new()];
    for seed in 0..4 {
        for (of, people) in off.iter_mut().zip([0, 7]) {
            let drive = Drive::among_people(seed, 361, 80, people);
            let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
            for (at, motion) in found.iter().enumerate().skip(1) {
                assert!(motion.has_step(), "{seed} {people} {at}: {motion:?}");
                let truth = drive.poses[at - 1].inverse().then(&drive.poses[at]);
                of.push(pose_difference(&truth, &step(motion)).0);
            }
        }
    }
    let [without, among] = off.map(|mut of| {
        of.sort_by(f64::total_cmp);
        of[of.len() / 2]
    });
    assert!(among < 1.5 * without && among < 0.006, "{without} {among}");
}

#[test]
fn uninformative_scans_are_refused_or_uncertain() {
    let drive = Drive::through_a_room(2, 361, 60, 0.01);
    let mut random = Rng::with_seed(9);
    // In scans 10 to 19, nine of ten beams have no return. In scans 20 to 29, no beam has a return. In scans 30 to 39,
    // the robot is lifted, and the ranges are random.
    let mut scans = drive.scans.clone();
    for (at, scan) in scans.iter_mut().enumerate() {
        let no_return = scan.no_return;
        let share = match at {
            10..20 => 90,
            20..30 => 100,
            _ => 0,
        };
        let lifted = (30..40).contains(&at);
        for range in scan.arrays().ranges {
            if lifted {
                *range = random.u16(50..3000);
            }
            if random.u8(..100) < share {
                *range = no_return;
            }
        }
    }
    let found = estimate_motion(&scans, Pose::default(), Settings::default());
    for (at, motion) in found.iter().enumerate().take(41).skip(20) {
        assert_eq!(motion.method(), MotionMethod::Refused, "{at}: {motion:?}");
    }
    for at in (1..20).chain(42..60) {
        if found[at].has_step() {
            let truth = drive.poses[at - 1].inverse().then(&drive.poses[at]);
            let off = step(&found[at]);
            for (k, off) in [off.x - truth.x, off.y - truth.y, off.yaw - truth.yaw].into_iter().enumerate() {
                let variance = f64::from(found[at].covariance[4 * k]);
                assert!(off * off < 30.0 * variance, "{at}: {off} {:?}", found[at]);
            }
        }
    }
    assert!((42..60).all(|at| found[at].has_step()), "it goes on");
}

/// In scan 30, only one wall is visible, so the position along this wall is unknown. The covariance of the next step
/// includes this uncertainty, and the covariance of the sum includes it from then on.
#[test]
fn step_from_an_uncertain_position_is_uncertain() {
    let mut open = 0;
    for seed in 0..6 {
        let mut drive = Drive::through_a_room(seed, 361, 60, 0.01);
        let no_return = drive.scans[30].no_return;
        let ranges = drive.scans[30].arrays().ranges;
        ranges[..120].fill(no_return);
        ranges[150..].fill(no_return);
        let found = estimate_motion(&drive.scans, Pose::default(), Settings::default());
        if !found[30].is_degenerate() || !found[31].has_step() {
            continue;
        }
        open += 1;
        let is_kept = found[31].covariance[0].max(found[31].covariance[4]) < 1e-3;
        assert_eq!(found[31].is_degenerate(), !is_kept, "{seed}: {:?}", found[31]);
        assert!(found[..30].iter().all(|motion| motion.has_valid_pose()), "{seed}");
        assert!(!found[30..].iter().any(|motion| motion.has_valid_pose()), "{seed}");
        assert!(found[1..30].iter().all(|motion| motion.sum_covariance().is_some()), "{seed}");
        assert!(found[30..].iter().all(|motion| motion.pose_covariance == [0.0; 9]), "{seed}");
    }
    assert!(open > 2, "{open}");
}

#[test]
fn motion_of_any_scan_is_finite() {
    let mut random = Rng::with_seed(17);
    for _ in 0..150 {
        let pose = Pose {
            x_m: random.f64(),
            yaw_rad: 7.0 * random.f64(),
            upside_down: random.u8(..2),
            ..Pose::default()
        };
        let scans: Vec<Box<Scan>> = (0..6)
            .map(|_| {
                let count = random.usize(..300);
                let contents = if random.bool() { ArrayFlags::ANGLES } else { 0 };
                let step = [0.0, 0.01, -0.02, 0.3, f64::MIN_POSITIVE][random.usize(..5)];
                let head =
                    scanhub_schema::ScanHead { contents, ..beams_at(count, 3.0 * random.f64() - 1.5, step) };
                let wild: Vec<u16> = (0..count).map(|_| random.u16(..)).collect();
                let mut scan = Scan::of(head, &wild);
                scan.unit_um = [0, 1, 1000, u32::MAX][random.usize(..4)];
                for angle in scan.arrays().angles {
                    *angle = [f32::NAN, 0.0, random.f32(), f32::INFINITY, 1e30][random.usize(..5)];
                }
                scan
            })
            .collect();
        for motion in estimate_motion(&scans, pose, Settings::default()) {
            let numbers = [motion.x_m, motion.y_m, motion.yaw_rad];
            assert!(numbers.iter().all(|number| number.is_finite()), "{motion:?}");
            let numbers = [motion.dx_m, motion.dy_m, motion.dyaw_rad, motion.overlap];
            let mut numbers = numbers.iter().chain(&motion.covariance).chain(&motion.pose_covariance);
            assert!(numbers.all(|number| number.is_finite()), "{motion:?}");
            assert!((0.0..=1.0).contains(&motion.overlap), "{motion:?}");
        }
    }
}

#[test]
fn full_circle_scanner_detects_turn_by_one_beam() {
    let mut random = Rng::with_seed(4);
    let at = |yaw: f64, random: &mut Rng| {
        scan(beams_at(360, -PI, PI / 180.0), |angle| {
            let (sin, cos) = (angle + yaw).sin_cos();
            let wall =
                |along: f64, near: f64, far: f64| if along > 0.0 { far / along } else { -near / along };
            Some(wall(cos, 2.0, 4.0).min(wall(sin, 3.0, 2.5)) + 0.005 * normal(random))
        })
    };
    let scans: Vec<Box<Scan>> = (0..20).map(|i| at(f64::from(i) * PI / 180.0, &mut random)).collect();
    for motion in &estimate_motion(&scans, Pose::default(), Settings::default())[1..] {
        let (metres, radians) = pose_difference(&Pose2::new(0.0, 0.0, PI / 180.0), &step(motion));
        assert!(metres < 0.006 && radians < 0.003, "{motion:?}");
    }
}
