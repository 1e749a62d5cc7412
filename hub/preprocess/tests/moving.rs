//! Tests of the map of a moving scanner: a comparison with a slow version whose map does not scroll, drives among
//! people whose positions are known, and positions without information. Other tests run lines, motion and map together,
//! with a lifted robot, with few returns, and with a clock that jumps. The processors must not panic, and must not
//! report a wrong result as certain.

mod drives;

use std::collections::{HashMap, HashSet};

use drives::Drive;
use fastrand::Rng;
use scanhub_preprocess::background::{BackgroundModel, Candidate, Class, Method, Settings, Start};
use scanhub_preprocess::lines::LineFinder;
use scanhub_preprocess::motion::{MotionEstimator, Pose2};
use scanhub_preprocess::velocity::Velocity;
use scanhub_preprocess::{lines, motion};
use scanhub_schema::{Background, Foreground, Lines, Motion, MotionMethod, Pose, Scan};

const MAP_SETTINGS: Settings = Settings {
    method: Method::Moving,
    threshold_mm: None,
    candidate_mm: None,
    scans: Some(100),
    candidate: Candidate::First,
    start: Start::Empty,
    no_return_is_far: None,
};

/// Returns the payload with which the motion of a robot at `pose` is reported.
fn motion_at(pose: &Pose2, is_first: bool) -> Motion {
    let method = if is_first { MotionMethod::First } else { MotionMethod::Both };
    Motion { x_m: pose.x, y_m: pose.y, yaw_rad: pose.yaw, method: method as u8, ..Motion::default() }
}

/// Returns the robot's velocity during the scan with index `number`.
fn velocity(drive: &Drive, number: usize) -> Velocity {
    let step = drive.poses[number.saturating_sub(1)].inverse().then(&drive.poses[number]);
    Velocity::of_step((step.x, step.y, step.yaw), drives::SCAN_PERIOD_S)
}

/// Slow version of the method, with a map of unlimited size.
#[derive(Default)]
struct ReferenceModel {
    /// For each square, `hits` and `free` as in a cell of the map.
    squares: HashMap<(i32, i32), (i32, i32)>,
}

impl ReferenceModel {
    fn square(x: f64, y: f64) -> (i32, i32) {
        ((x / 0.05).floor() as i32, (y / 0.05).floor() as i32)
    }

    fn count_near(&self, (x, y): (i32, i32), (dx, dy): (i32, i32)) -> (i32, i32) {
        self.squares.get(&(x + dx, y + dy)).copied().unwrap_or_default()
    }

    /// Returns the class of each beam without the filter of short runs, and adds the scan to the map.
    fn update(&mut self, pose: &Pose2, velocity: &Velocity, scan: &Scan) -> Vec<Class> {
        let neighbors =
            |reach: i32| (-reach..=reach).flat_map(move |dx| (-reach..=reach).map(move |dy| (dx, dy)));
        let place_of = |beam: usize| {
            let (x, y, yaw) = velocity.position(1e-9 * scan.beam_ns(beam) as f64);
            pose.then(&Pose2::new(x, y, yaw))
        };
        let ends: Vec<Option<(f64, f64)>> = (0..scan.beams())
            .map(|i| {
                let (range, angle) = (scan.distance_m(i)?, scan.angle(i));
                Some(place_of(i).point((range * angle.cos(), range * angle.sin())))
            })
            .collect();
        let class = |end: &Option<(f64, f64)>| {
            let Some((x, y)) = *end else { return Class::Invalid };
            let end = ReferenceModel::square(x, y);
            let stands = |(hits, free): (i32, i32)| hits >= 3 && free < 5 || hits >= 100;
            if neighbors(2).any(|near| stands(self.count_near(end, near))) {
                return Class::Background;
            }
            let is_free = self.count_near(end, (0, 0)).1 >= 5
                && neighbors(1).all(|near| self.count_near(end, near).1 >= 2);
            if is_free { Class::Foreground } else { Class::Unknown }
        };
        let classes = ends.iter().map(class).collect();
        let hit: HashSet<(i32, i32)> =
            ends.iter().flatten().map(|(x, y)| ReferenceModel::square(*x, *y)).collect();
        let near: HashSet<(i32, i32)> =
            hit.iter().flat_map(|(x, y)| neighbors(1).map(move |(dx, dy)| (x + dx, y + dy))).collect();
        for at in &hit {
            let (hits, free) = self.squares.entry(*at).or_default();
            *hits = (*hits + 1).min(100);
            *free -= i32::from(*hits % 8 == 0 && *free > 0);
        }
        let mut through = HashSet::new();
        for (beam, end) in ends.iter().enumerate() {
            let (Some((x, y)), place) = (end, place_of(beam)) else { continue };
            let (dx, dy) = (x - place.x, y - place.y);
            let length = dx.hypot(dy);
            for step in 1..=((length / 0.05 - 2.5).max(0.0) as u32) {
                let far = 0.05 * f64::from(step) / length;
                through.insert(ReferenceModel::square(place.x + far * dx, place.y + far * dy));
            }
        }
        for at in through.difference(&near) {
            let (hits, free) = self.squares.entry(*at).or_default();
            *free = (*free + 1).min(100);
            *hits = (*hits - 1 - *hits / 16).max(0);
        }
        classes
    }
}

#[test]
fn classes_match_the_reference() {
    for (seed, speed) in [(0, 0.02), (1, 0.02), (2, 0.02), (3, 0.2), (4, 0.2)] {
        let drive = Drive::with_walkers(seed, 361, 160, 3, speed);
        let (mut model, mut slow) = (BackgroundModel::new(MAP_SETTINGS, 361), ReferenceModel::default());
        let mut out = Foreground::of(361);
        let (mut same, mut all, mut foreground) = (0, 0, 0);
        for (number, (scan, place)) in drive.scans.iter().zip(&drive.poses).enumerate() {
            let expected = slow.update(place, &velocity(&drive, number), scan);
            let velocity = velocity(&drive, number);
            model.set_motion(&Pose::default(), &motion_at(place, number == 0), &velocity);
            model.update(scan, &mut out);
            for (one, other) in model.classes().iter().zip(&expected) {
                // The model changes foreground in short runs to unknown. The slow version does not have this filter.
                let is_same = one == other || (*one, *other) == (Class::Unknown, Class::Foreground);
                same += usize::from(is_same);
                foreground += usize::from(*one == Class::Foreground && is_same);
                all += 1;
            }
        }
        // The two versions round the borders of squares differently.
        assert!(same as f64 > 0.9998 * all as f64, "{seed}: {same} of {all}");
        assert!(foreground > 100, "{seed}: {foreground}");
    }
}

/// Returns three counts of beams from scan `from` on: beams that met people and are foreground, beams that met people
/// but are not foreground, and beams that are foreground but met no person.
fn count_moving(drive: &Drive, from: usize) -> (usize, usize, usize) {
    let mut estimator = MotionEstimator::new(Pose::default(), motion::Settings::default(), 361);
    let mut model = BackgroundModel::new(Settings { scans: None, ..MAP_SETTINGS }, 361);
    let (mut motion, mut out) = (Motion::default(), Foreground::of(361));
    let (mut found, mut missed, mut wrong) = (0, 0, 0);
    for (number, scan) in drive.scans.iter().enumerate() {
        estimator.update(scan, drives::stamp_ns(number), 0, &mut motion);
        model.set_motion(&Pose::default(), &motion, &estimator.velocity());
        model.update(scan, &mut out);
        for (class, person) in model.classes().iter().zip(&drive.people[number]).filter(|_| number >= from) {
            match (person, *class == Class::Foreground) {
                (true, true) => found += 1,
                (true, false) => missed += 1,
                (false, true) => wrong += 1,
                (false, false) => {}
            }
        }
    }
    (found, missed, wrong)
}

#[test]
fn distinguishes_walkers_from_a_driving_robot() {
    for seed in 20..22 {
        let drive = Drive::with_walkers(seed, 361, 600, 3, 0.02);
        let (found, missed, wrong) = count_moving(&drive, 300);
        assert!(found as f64 > 0.8 * (found + missed) as f64, "{seed}: {found} {missed}, edges and all");
        assert!(found as f64 > 0.95 * (found + wrong) as f64, "{seed}: {found} {wrong}");
    }
}

/// Legs of chairs become background, although beams meet such a thin leg in only some of the scans.
#[test]
fn chair_legs_are_static_while_people_walk() {
    for seed in 200..203 {
        let drive = Drive::through_furniture(seed, 900, 3, 0.02);
        let (found, missed, wrong) = count_moving(&drive, 450);
        assert!(found as f64 > 0.8 * (found + missed) as f64, "{seed}: {found} {missed}, edges and all");
        assert!(found as f64 > 0.97 * (found + wrong) as f64, "{seed}: {found} {wrong}");
    }
}

#[test]
fn reports_almost_nothing_in_a_static_scene() {
    let drive = Drive::with_walkers(31, 361, 500, 0, 0.02);
    let (found, missed, wrong) = count_moving(&drive, 0);
    assert_eq!((found, missed), (0, 0));
    assert!(wrong < 25, "{wrong} in 500 scans");
}

#[test]
fn unusable_or_new_pose_resets_the_background() {
    let mut drive = Drive::with_walkers(3, 361, 40, 2, 0.0);
    drive.stand_still(40);
    let mut model = BackgroundModel::new(MAP_SETTINGS, 361);
    let mut out = Foreground::of(361);
    let place = drive.poses[0];
    for (number, scan) in drive.scans.iter().enumerate() {
        let generation = model.generation();
        let motion = match number {
            20 => Motion { method: MotionMethod::Refused as u8, ..Motion::default() },
            50 => Motion { x_m: f64::NAN, ..motion_at(&place, false) },
            70 => motion_at(&place, true),
            _ => motion_at(&place, number == 0),
        };
        model.set_motion(&Pose::default(), &motion, &Velocity::default());
        model.update(scan, &mut out);
        let is_anew = [20, 50, 70].contains(&number);
        assert_eq!(model.generation() != generation, is_anew, "{number}");
        if is_anew || [21, 51, 71].contains(&number) {
            assert_eq!((out.beams, model.classes().contains(&Class::Background)), (0, false), "{number}");
        }
    }
}

#[test]
fn shows_the_static_scene_as_background() {
    let mut drive = Drive::through_a_room(4, 361, 1, 0.003);
    drive.stand_still(30);
    let mut model = BackgroundModel::new(MAP_SETTINGS, 361);
    let mut out = Foreground::of(361);
    for (number, scan) in drive.scans.iter().enumerate() {
        model.set_motion(&Pose::default(), &motion_at(&drive.poses[0], number == 0), &Velocity::default());
        model.update(scan, &mut out);
    }
    let mut shown = Background::zeroed(Background::len(361));
    model.write(&mut shown);
    let scan = &drive.scans[0];
    let near = |i: &usize| {
        let (shown, range) = (shown.ranges()[*i], scan.ranges()[*i]);
        shown != Background::UNKNOWN && shown.abs_diff(range) < 200
    };
    let count = (0..361).filter(near).count();
    assert!(count > 300, "{count} of 361, those along walls aside");
    // Loading a background has no effect, because a background that was measured from a single position is not a map.
    let generation = model.generation();
    model.load(&shown).unwrap();
    model.update(scan, &mut out);
    assert_eq!((out.beams, model.generation()), (0, generation + 1));
}

#[test]
fn no_pose_or_scan_causes_a_panic() {
    let mut random = Rng::with_seed(5);
    let mut model = BackgroundModel::new(MAP_SETTINGS, 300);
    let mut out = Foreground::of(300);
    for _ in 0..400 {
        let count = random.usize(..=300);
        let step = [0.0, 0.01, -0.02, 1e300][random.usize(..4)];
        let head = drives::beams_at(count, random.f64(), step);
        let mut scan = Scan::of(head, &(0..count).map(|_| random.u16(..)).collect::<Vec<_>>());
        scan.unit_um = [0, 1, 1000, u32::MAX][random.usize(..4)];
        let mut number =
            || [0.0, random.f64(), 30.0 * random.f64(), 1e5, -1e9, 1e300, f64::NAN][random.usize(..7)];
        let (x_m, y_m, yaw_rad) = (number(), number(), number());
        let velocity = Velocity { x: number(), y: number(), yaw: number() };
        let motion = Motion { x_m, y_m, yaw_rad, method: random.u8(..7), ..Motion::default() };
        model.set_motion(&Pose { x_m: random.f64(), ..Pose::default() }, &motion, &velocity);
        model.update(&scan, &mut out);
        let mut shown = Background::zeroed(Background::len(300));
        model.write(&mut shown);
        assert!(usize::from(out.beams) <= count);
    }
}

/// Settings with the number of scans of an LMS in ten seconds. The default would depend on the times in the scans.
const TEN_SECONDS: Settings = Settings { scans: Some(375), ..MAP_SETTINGS };

/// All results of a scan.
#[derive(PartialEq)]
struct ScanResult {
    lines: Lines,
    motion: Motion,
    classes: Vec<Class>,
    foreground: usize,
}

/// Returns the results of all scans. The processors run in the same order as in the hub.
fn process_all(scans: &[Box<Scan>]) -> Vec<ScanResult> {
    let beams = scans.iter().map(|scan| scan.beams()).max().unwrap_or(0);
    let mut finder = LineFinder::new(Pose::default(), lines::Settings::default(), beams);
    let mut estimator = MotionEstimator::new(Pose::default(), motion::Settings::default(), beams);
    let mut model = BackgroundModel::new(TEN_SECONDS, beams);
    let mut out = Foreground::of(beams);
    let process = |(number, scan): (usize, &Scan)| {
        let (mut lines, mut motion) = (Lines::default(), Motion::default());
        finder.update(scan, &mut lines);
        estimator.update(scan, drives::stamp_ns(number), 0, &mut motion);
        model.set_motion(&Pose::default(), &motion, &estimator.velocity());
        model.update(scan, &mut out);
        let classes = model.classes().to_vec();
        ScanResult { lines, motion, classes, foreground: usize::from(out.beams) }
    };
    scans.iter().map(|scan| &**scan).enumerate().map(process).collect()
}

/// Returns the largest error of the three numbers of the step, in the standard deviations that `motion` reports.
fn deviations(truth: &Pose2, motion: &Motion) -> f64 {
    let off = [
        f64::from(motion.dx_m) - truth.x,
        f64::from(motion.dy_m) - truth.y,
        f64::from(motion.dyaw_rad) - truth.yaw,
    ];
    let of = |(k, off): (usize, f64)| off.abs() / f64::from(motion.covariance[4 * k]).sqrt();
    off.into_iter().enumerate().map(of).fold(0.0, f64::max)
}

/// Replaces each valid range by the result of `change`, which receives the index of the beam and the range.
fn change_ranges(scan: &mut Scan, mut change: impl FnMut(usize, f64) -> f64) {
    let valid_to = scan.valid_to;
    for (i, range) in scan.arrays().ranges.iter_mut().enumerate().filter(|(_, range)| **range <= valid_to) {
        *range = change(i, f64::from(*range)).clamp(1.0, valid_to.into()) as u16;
    }
}

/// A lifted sensor sees other objects at other ranges. A tilted sensor has shorter ranges on one side and longer ranges
/// on the other.
#[test]
fn lifting_the_scanner_is_refused_or_uncertain() {
    for seed in 0..6 {
        for factor in [0.5, 0.8, 0.95, 1.05, 1.2, 1.6] {
            for tilt in [0.0, 0.4] {
                let mut drive = Drive::through_a_room(seed, 361, 1, 0.01);
                drive.stand_still(59);
                for scan in &mut drive.scans[20..30] {
                    change_ranges(scan, |i, range| range * (factor + tilt * (i as f64 / 360.0 - 0.5)));
                }
                let results = process_all(&drive.scans);
                let place = format!("seed {seed}, {factor} as far, tilt {tilt}");
                for (at, result) in
                    results.iter().enumerate().skip(1).filter(|(_, result)| result.motion.has_step())
                {
                    let off = deviations(&Pose2::default(), &result.motion);
                    assert!(off < 5.0, "{place}, scan {at}: off by {off} deviations, {:?}", result.motion);
                }
                assert!(results[..20].iter().all(|result| result.foreground == 0), "{place}");
                // If the ranges are very different, the step must be refused. An uncertain step is not sufficient.
                if (factor - 1.0_f64).abs() > 0.3 {
                    for at in [20, 30] {
                        assert_eq!(results[at].motion.method(), MotionMethod::Refused, "{place}, scan {at}");
                    }
                    assert!(results.iter().all(|result| result.foreground == 0), "{place}");
                }
                let last = results.last().unwrap();
                assert!(last.motion.has_step() && last.motion.overlap > 0.9, "it goes on: {place}");
            }
        }
    }
}

/// Only one beam in ten has a return. These are too few beams to detect moving objects.
#[test]
fn scans_with_few_returns_have_no_foreground() {
    let mut random = Rng::with_seed(9);
    for seed in 0..4 {
        let mut drive = Drive::through_a_room(seed, 361, 120, 0.01);
        for scan in &mut drive.scans[40..60] {
            let no_return = scan.no_return;
            scan.arrays()
                .ranges
                .iter_mut()
                .filter(|_| random.u8(..10) != 0)
                .for_each(|range| *range = no_return);
        }
        let results = process_all(&drive.scans);
        for (at, result) in results.iter().enumerate().skip(1) {
            if result.motion.has_step() {
                let truth = drive.poses[at - 1].inverse().then(&drive.poses[at]);
                let off = deviations(&truth, &result.motion);
                assert!(off < 6.0, "{seed} {at}: off by {off} deviations, {:?}", result.motion);
            }
            assert!(
                usize::from(result.lines.readings) <= 361 && result.foreground <= 4,
                "{seed} {at}: {}",
                result.foreground
            );
        }
        assert!(results[100..].iter().all(|result| result.motion.has_step()), "{seed}: it goes on");
    }
}

/// If the times of a scan's beams are impossible, the scan is not corrected with these times.
#[test]
fn impossible_times_of_beams_are_ignored() {
    let mut random = Rng::with_seed(4);
    let drive = Drive::with_walkers(3, 361, 150, 2, 0.02);
    let mut jumping = Drive::with_walkers(3, 361, 150, 2, 0.02);
    for scan in &mut jumping.scans {
        (scan.beam_time_ns, scan.turn_ns) = (random.u32(..), random.u32(..));
        scan.first_beam_ns = random.i32(..);
    }
    let results = process_all(&jumping.scans);
    for (at, result) in results.iter().enumerate().skip(1) {
        let truth = drive.poses[at - 1].inverse().then(&drive.poses[at]);
        let off =
            truth.inverse().then(&Pose2::new(result.motion.dx_m.into(), result.motion.dy_m.into(), 0.0));
        assert!(result.motion.has_step() && off.x.hypot(off.y) < 0.03, "{at}: {truth:?} {:?}", result.motion);
    }
    assert!(results.iter().any(|result| result.foreground > 0));
}
