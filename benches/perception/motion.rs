//! Accuracy of a robot's motion that is estimated from its scans, and CPU time of the estimate. The hub's method is
//! compared with simple point-to-point and point-to-line matching of two scans. The simple methods start at the pose of
//! the first scan, and ignore the worst tenth of the pairs of points. The drives are recordings of real robots and
//! simulations.
//!
//! The true positions of three logs come from a map that was built from the same logs, and have errors of about 20 mm.
//! The true positions of the model cars have errors of about 5 mm. The steps of three logs are a meter or more, so the
//! limits in the section `[motion]` are wider for these logs. A step is wrong if its error is 200 mm (100 mm for the
//! cars) or 5 degrees. The row `people in half; hidden` is for comparison: the scans are the same, but beams on people
//! have no reading.

use std::f64::consts::{PI, TAU};
use std::time::Instant;

use fastrand::Rng;
use scanhub_preprocess::lines::{LineFinder, Settings as LineSettings};
use scanhub_preprocess::motion::{MotionEstimator, Pose2, Settings};
use scanhub_schema::{Lines, Motion, Pose, Scan};

use crate::figures::{self, Cell, Figure, Target};
use crate::recordings::{self, Drive, normal, scan};
use crate::worlds;

/// Measures the methods on recorded and simulated drives. If `is_quick` is true, uses fewer steps and seeds.
pub(crate) fn measure(is_quick: bool, is_json: bool) {
    let (mut figures, mut cells) = (Vec::new(), Vec::new());
    let drives = recordings::drives();
    if drives.is_empty() {
        eprintln!("left out: SCANHUB_DATA names no folder with carmen/ and moving/");
    }
    for drive in &drives {
        measure_drive(drive, if is_quick { 100 } else { 400 }, &mut cells);
    }
    measure_simulated(if is_quick { 2 } else { 10 }, &mut figures);
    figures::print("perception, motion", is_json, &figures);
    figures::print_cells("perception, motion", is_json, &cells);
}

/// Returns the motion that the hub's method estimates for each scan, and the CPU times for lines and for motion, in
/// microseconds per scan.
fn run(scans: &[Box<Scan>], settings: Settings) -> (Vec<Motion>, [f64; 2]) {
    let beams = scans.iter().map(|scan| scan.beams()).max().unwrap_or(0);
    let mut finder = LineFinder::new(Pose::default(), LineSettings::default(), beams);
    let mut estimator = MotionEstimator::new(Pose::default(), settings, beams);
    let mut lines = Lines::default();
    let mut taken_us = [0.0; 2];
    let motions = scans.iter().enumerate().map(|(number, scan)| {
        let begin = Instant::now();
        finder.update(scan, &mut lines);
        taken_us[0] += 1e6 * begin.elapsed().as_secs_f64();
        let begin = Instant::now();
        let mut motion = Motion::default();
        estimator.update(scan, worlds::stamp_ns(number), 0, &mut motion);
        taken_us[1] += 1e6 * begin.elapsed().as_secs_f64();
        motion
    });
    let motions = motions.collect();
    (motions, taken_us.map(|us| us / scans.len().max(1) as f64))
}

/// Returns the difference between `truth` and `found`: the distance in millimeters and the angle in degrees.
fn pose_error(truth: &Pose2, found: &Pose2) -> (f64, f64) {
    let between = truth.inverse().then(found);
    (1000.0 * between.x.hypot(between.y), between.yaw.to_degrees().abs())
}

fn step(motion: &Motion) -> Option<Pose2> {
    let [x, y, yaw] = [motion.dx_m, motion.dy_m, motion.dyaw_rad].map(f64::from);
    motion.has_step().then(|| Pose2::new(x, y, yaw))
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    figures::percentile(values, 0.5).unwrap_or(f64::NAN)
}

/// Adds the scores of at most `max_steps` steps of `drive`, which are evenly distributed over the drive.
fn measure_drive(drive: &Drive, max_steps: usize, cells: &mut Vec<Cell>) {
    let (motions, times_us) = run(&drive.scans, drive.settings);
    let steps: Vec<(usize, Pose2)> = drive.steps().collect();
    let every = steps.len().div_ceil(max_steps).max(1);
    let steps: Vec<_> = steps.into_iter().step_by(every).collect();
    let mut put = |row: &str,
                   found: &dyn Fn(usize) -> Option<Pose2>,
                   says: &dyn Fn(usize) -> bool,
                   time_us: Option<f64>| {
        let pairs: Vec<(f64, f64)> =
            steps.iter().filter_map(|(at, truth)| Some(pose_error(truth, &found(*at)?))).collect();
        let mut offs: [Vec<f64>; 2] = pairs.iter().copied().collect::<(Vec<_>, Vec<_>)>().into();
        let [mm, degrees] = offs.each_mut().map(|values| median(values));
        let is_wrong = |(mm, degrees): &&(f64, f64)| *mm > drive.min_wrong_mm || *degrees > 5.0;
        let is_silent = |(at, truth): &&(usize, Pose2)| {
            found(*at).is_some_and(|found| is_wrong(&&pose_error(truth, &found))) && !says(*at)
        };
        let silent = steps.iter().filter(is_silent).count();
        let share = |count: usize| count as f64 / steps.len().max(1) as f64;
        for (column, unit, value) in [
            ("median step error", "mm", Some(mm)),
            ("median turn error", "deg", Some(degrees)),
            ("steps that are wrong", "1", Some(share(pairs.iter().filter(is_wrong).count()))),
            ("wrong, and not reported", "1", Some(share(silent))),
            ("steps rejected", "1", Some(share(steps.len() - pairs.len()))),
            ("time", "us", time_us),
        ] {
            cells.push(Cell {
                table: format!("{}: {} steps of {}", drive.name, steps.len(), drive.scans.len()),
                row: row.to_owned(),
                column: column.to_owned(),
                unit,
                values: value.into_iter().collect(),
            });
        }
    };
    put("hub", &|at| step(&motions[at]), &|at| motions[at].is_degenerate(), Some(times_us[1]));
    type Baseline = fn(&Scan, &Scan) -> Pose2;
    let baselines: [(&str, Baseline); 2] =
        [("point to point", point_to_point), ("point to line", point_to_line)];
    for (row, baseline) in baselines {
        let begin = Instant::now();
        let found: Vec<Pose2> =
            steps.iter().map(|(at, _)| baseline(&drive.scans[at - 1], &drive.scans[*at])).collect();
        let time_us = 1e6 * begin.elapsed().as_secs_f64() / steps.len().max(1) as f64;
        let of = |at: usize| found.get(steps.iter().position(|(step, _)| *step == at)?).copied();
        put(row, &of, &|_| false, Some(time_us));
    }
}

/// Adds the figures of simulated drives. Each kind of drive is simulated with `seeds` seeds.
fn measure_simulated(seeds: u64, figures: &mut Vec<Figure>) {
    let mut put =
        |name, unit, hub, baseline, target| figures.push(Figure { name, unit, hub, baseline, target });
    let of_each = |of: &dyn Fn(u64) -> f64| (1..=seeds).map(of).collect::<Vec<f64>>();
    let error = |kind: DriveKind, beams: usize, seed: u64, by_hub: bool| {
        let (scans, truth) = drive(kind, beams, 200, seed);
        let motions = run(&scans, Settings::default()).0;
        let mut offs: Vec<f64> = (1..scans.len())
            .filter_map(|at| {
                let truth = truth[at - 1].inverse().then(&truth[at]);
                let found = match by_hub {
                    true => step(&motions[at])?,
                    false => point_to_line(&scans[at - 1], &scans[at]),
                };
                Some(pose_error(&truth, &found).0)
            })
            .collect();
        median(&mut offs)
    };
    use DriveKind::{Corridor, Hidden, Jump, People, Room};
    let time = |beams: usize, part: usize| {
        move |seed| run(&drive(Room, beams, 300, seed).0, Settings::default()).1[part]
    };
    for (beams, [name, lines]) in [
        (361, ["time a scan, 361 beams", "lines of it, 361 beams"]),
        (1081, ["time a scan, 1081 beams", "lines of it, 1081 beams"]),
    ] {
        put(name, "us", of_each(&time(beams, 1)), Vec::new(), Target::Max(1000.0));
        put(lines, "us", of_each(&time(beams, 0)), Vec::new(), Target::None);
    }
    let by = |kind, by_hub| of_each(&|seed| error(kind, 361, seed, by_hub));
    put("room: step error; plain", "mm", by(Room, true), by(Room, false), Target::Ratio(1.0));
    put("people in half the view; plain", "mm", by(People, true), by(People, false), Target::Ratio(1.0));
    put("people in half; hidden", "mm", by(People, true), by(Hidden, true), Target::Ratio(1.5));
    put("people in half; without", "mm", by(People, true), by(Room, true), Target::Ratio(1.5));
    let corridor = of_each(&|seed| {
        let motions = run(&drive(Corridor, 361, 200, seed).0, Settings::default()).0;
        let says = |motion: &&Motion| motion.is_degenerate() && motion.covariance[0] > 0.01;
        let steps = motions.iter().filter(|motion| motion.has_step());
        steps.clone().filter(says).count() as f64 / steps.count().max(1) as f64
    });
    put("corridor: reported as degenerate", "1", corridor, Vec::new(), Target::Min(0.99));
    let room = of_each(&|seed| {
        let motions = run(&drive(Room, 361, 200, seed).0, Settings::default()).0;
        motions.iter().filter(|motion| motion.is_degenerate()).count() as f64 / motions.len() as f64
    });
    put("room: reported as degenerate", "1", room, Vec::new(), Target::Max(0.01));
    let jumps = of_each(&|seed| {
        let (scans, truth) = drive(Jump, 361, 200, seed);
        let motions = run(&scans, Settings::default()).0;
        let jumps: Vec<usize> =
            (1..scans.len()).filter(|&at| pose_error(&truth[at - 1], &truth[at]).0 > 1000.0).collect();
        jumps.iter().filter(|&&at| !motions[at].has_step()).count() as f64 / jumps.len().max(1) as f64
    });
    put("jumps that are rejected", "1", jumps, Vec::new(), Target::Min(0.99));
    let unsure = of_each(&|seed| {
        let (scans, truth) = drive(Room, 361, 400, seed);
        let motions = run(&scans, Settings::default()).0;
        let squares: Vec<f64> = (1..scans.len())
            .filter_map(|at| {
                let found = step(&motions[at])?;
                let truth = truth[at - 1].inverse().then(&truth[at]);
                let off = [found.x - truth.x, found.y - truth.y, found.yaw - truth.yaw];
                normalized(&off, &motions[at].covariance)
            })
            .collect();
        squares.iter().sum::<f64>() / (3 * squares.len().max(1)) as f64
    });
    put("squared error by covariance", "1", unsure, Vec::new(), Target::Max(2.0));
    let drift = of_each(&|seed| {
        let (scans, _) = drive(DriveKind::Standing, 361, 1000, seed);
        let motions = run(&scans, Settings::default()).0;
        motions.last().map_or(f64::NAN, |last| 1000.0 * last.x_m.hypot(last.y_m))
    });
    put("standing for 1000 scans: drift", "mm", drift, Vec::new(), Target::None);
}

type Point = (f64, f64);

const MAX_ITERATIONS: usize = 40;
/// Maximum distance between two points of a pair, in meters.
const MAX_PAIR_DISTANCE_M: f64 = 1.0;
/// Share of the pairs that a simple method uses. The other pairs are the worst ones.
const TRIM_SHARE: f64 = 0.9;

fn points(scan: &Scan) -> Vec<Point> {
    let point = |i| {
        let (range, angle) = (scan.distance_m(i).filter(|range| *range > 0.0)?, scan.angle(i));
        Some((range * angle.cos(), range * angle.sin()))
    };
    (0..scan.beams()).filter_map(point).collect()
}

fn squared_distance((x, y): Point, (a, b): Point) -> f64 {
    (x - a) * (x - a) + (y - b) * (y - b)
}

/// Finds the nearest point of `fixed` for each point of `moved`. Returns the indexes of both points and the square of
/// their distance.
fn pairs(fixed: &[Point], moved: &[Point]) -> Vec<(usize, usize, f64)> {
    let nearest = |(i, &point): (usize, &Point)| {
        let by_distance = fixed.iter().enumerate().map(|(j, &other)| (j, squared_distance(point, other)));
        let (j, square) = by_distance.min_by(|a, b| a.1.total_cmp(&b.1))?;
        (square < MAX_PAIR_DISTANCE_M * MAX_PAIR_DISTANCE_M).then_some((i, j, square))
    };
    moved.iter().enumerate().filter_map(nearest).collect()
}

fn trim<T>(mut pairs: Vec<T>, by: impl Fn(&T) -> f64) -> Vec<T> {
    pairs.sort_by(|a, b| by(a).total_cmp(&by(b)));
    pairs.truncate((TRIM_SHARE * pairs.len() as f64).ceil() as usize);
    pairs
}

/// Point-to-point matching by least squares, with the method of Umeyama in the plane.
fn point_to_point(before: &Scan, now: &Scan) -> Pose2 {
    let (fixed, own) = (points(before), points(now));
    let mut pose = Pose2::default();
    for _ in 0..MAX_ITERATIONS {
        let moved: Vec<Point> = own.iter().map(|&point| pose.point(point)).collect();
        let pairs = trim(pairs(&fixed, &moved), |pair| pair.2);
        if pairs.len() < 3 {
            break;
        }
        let n = pairs.len() as f64;
        let mean = |of: &dyn Fn(&(usize, usize, f64)) -> Point| {
            let sum = pairs.iter().map(of).fold((0.0, 0.0), |sum, at| (sum.0 + at.0, sum.1 + at.1));
            (sum.0 / n, sum.1 / n)
        };
        let (a, b) = (mean(&|pair| moved[pair.0]), mean(&|pair| fixed[pair.1]));
        let (mut along, mut across) = (0.0, 0.0);
        for &(i, j, _) in &pairs {
            let (p, q) = ((moved[i].0 - a.0, moved[i].1 - a.1), (fixed[j].0 - b.0, fixed[j].1 - b.1));
            along += p.0 * q.0 + p.1 * q.1;
            across += p.0 * q.1 - p.1 * q.0;
        }
        let turn = Pose2::new(0.0, 0.0, across.atan2(along));
        let turned = turn.point(a);
        let step = Pose2::new(b.0 - turned.0, b.1 - turned.1, turn.yaw);
        pose = step.then(&pose);
        if step.x.hypot(step.y) < 1e-5 && step.yaw.abs() < 1e-5 {
            break;
        }
    }
    pose
}

/// Point-to-line matching as in Censi (ICRA 2008).
fn point_to_line(before: &Scan, now: &Scan) -> Pose2 {
    let (fixed, own) = (points(before), points(now));
    let mut pose = Pose2::default();
    for _ in 0..MAX_ITERATIONS {
        let moved: Vec<Point> = own.iter().map(|&point| pose.point(point)).collect();
        // The line goes through the nearest point and through one of its two neighbors, the nearer one.
        let of_pair = |(i, j, _): (usize, usize, f64)| {
            let point = moved[i];
            let neighbors = [j.checked_sub(1), Some(j + 1)].into_iter().flatten();
            let neighbors = neighbors.filter_map(|other| fixed.get(other).copied());
            let other = neighbors
                .min_by(|a, b| squared_distance(point, *a).total_cmp(&squared_distance(point, *b)))?;
            let (dx, dy) = (other.0 - fixed[j].0, other.1 - fixed[j].1);
            let length = dx.hypot(dy);
            let normal = (-dy / length, dx / length);
            let off = normal.0 * (point.0 - fixed[j].0) + normal.1 * (point.1 - fixed[j].1);
            (length > 0.0).then_some((point, normal, off))
        };
        let lines = pairs(&fixed, &moved).into_iter().filter_map(of_pair).collect();
        let lines = trim(lines, |(_, _, off): &(Point, Point, f64)| off.abs());
        let (mut m, mut v) = ([[0.0; 3]; 3], [0.0; 3]);
        for ((x, y), (nx, ny), off) in &lines {
            let row = [*nx, *ny, ny * x - nx * y];
            for i in 0..3 {
                v[i] -= row[i] * off;
                for j in 0..3 {
                    m[i][j] += row[i] * row[j];
                }
            }
        }
        let Some([x, y, yaw]) = solve(m, v) else { break };
        pose = Pose2::new(x, y, yaw).then(&pose);
        if x.hypot(y) < 1e-5 && yaw.abs() < 1e-5 {
            break;
        }
    }
    pose
}

/// Returns the solution x of m x = v, which it computes by Cramer's rule. Returns `None` if m is singular.
fn solve(m: [[f64; 3]; 3], v: [f64; 3]) -> Option<[f64; 3]> {
    let of = |m: &[[f64; 3]; 3]| {
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    };
    let whole = of(&m);
    let with = |column: usize| {
        let mut other = m;
        (0..3).for_each(|row| other[row][column] = v[row]);
        of(&other) / whole
    };
    let x = [with(0), with(1), with(2)];
    x.iter().all(|value| value.is_finite()).then_some(x)
}

/// Kind of a simulated drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum DriveKind {
    /// The robot drives in a room.
    Room,
    /// People walk around the robot in a room, and hide about half of the view.
    People,
    /// Like `People`, but beams that meet a person have no reading.
    Hidden,
    /// The robot drives between two walls, and nothing else is visible.
    Corridor,
    /// The robot drives in a room, but every fiftieth scan is from another position.
    Jump,
    /// The robot does not move.
    Standing,
}

/// Standard deviation of a range, in meters.
const NOISE_M: f64 = 0.01;
const PEOPLE_COUNT: usize = 9;
const SCAN_PERIOD_S: f64 = 1.0 / 37.5;

/// Returns the walls of a rectangular room with pillars and boxes in it.
fn room(random: &mut Rng) -> Vec<(Point, Point)> {
    let mut walls = box_walls((0.0, 0.0), (12.0, 9.0), 0.0);
    for _ in 0..8 {
        let at = (11.0 * (random.f64() - 0.5), 8.0 * (random.f64() - 0.5));
        if at.0.hypot(at.1) > 2.5 {
            let size = (0.3 + random.f64(), 0.3 + random.f64());
            walls.extend(box_walls(at, size, PI * random.f64()));
        }
    }
    walls
}

fn box_walls(center: Point, (long, wide): (f64, f64), yaw: f64) -> Vec<(Point, Point)> {
    let pose = Pose2::new(center.0, center.1, yaw);
    let corners = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]
        .map(|(x, y): Point| pose.point((x * long / 2.0, y * wide / 2.0)));
    (0..4).map(|i| (corners[i], corners[(i + 1) % 4])).collect()
}

/// Returns the distance from `from` to a wall, along the unit vector `along`.
fn distance_to_wall(from: Point, along: Point, ((x1, y1), (x2, y2)): &(Point, Point)) -> Option<f64> {
    let (dx, dy) = (x2 - x1, y2 - y1);
    let cross = along.0 * dy - along.1 * dx;
    let (ox, oy) = (x1 - from.0, y1 - from.1);
    let (range, share) = ((ox * dy - oy * dx) / cross, (ox * along.1 - oy * along.0) / cross);
    (range > 0.0 && (0.0..=1.0).contains(&share)).then_some(range)
}

/// Returns the distance from `from` to a disc with this center and `radius`, along the unit vector `along`.
fn distance_to_disc(from: Point, along: Point, center: Point, radius: f64) -> Option<f64> {
    let (dx, dy) = (center.0 - from.0, center.1 - from.1);
    let ahead = dx * along.0 + dy * along.1;
    let inside = radius * radius - (dx * dx + dy * dy - ahead * ahead);
    (inside > 0.0 && ahead > radius).then(|| ahead - inside.sqrt())
}

/// A person who walks. Position and speed are in the frame of the room.
struct Walker {
    at: Point,
    by_second: Point,
}

/// Moves the people by the time of one scan. Replaces people who have left the view of the robot at `visible_from`, so
/// that people always hide about half of the view.
fn move_people(people: &mut Vec<Walker>, visible_from: &Pose2, random: &mut Rng) {
    for Walker { at, by_second } in people.iter_mut() {
        *at = (at.0 + by_second.0 * SCAN_PERIOD_S, at.1 + by_second.1 * SCAN_PERIOD_S);
    }
    let from_robot = |walker: &Walker| {
        let (x, y) = visible_from.inverse().point(walker.at);
        (x.hypot(y), y.atan2(x))
    };
    people.retain(|walker| {
        let (far, bearing) = from_robot(walker);
        (0.6..3.2).contains(&far) && bearing.abs() < 1.7
    });
    while people.len() < PEOPLE_COUNT {
        let (far, bearing) = (0.8 + 2.2 * random.f64(), 3.2 * (random.f64() - 0.5));
        let (direction, speed) = (TAU * random.f64(), 0.5 + random.f64());
        let at = visible_from.point((far * bearing.cos(), far * bearing.sin()));
        people.push(Walker { at, by_second: (speed * direction.cos(), speed * direction.sin()) });
    }
}

/// Returns `count` scans of `beams` beams over 180 degrees (270 for 1081 beams), and the robot's pose at each scan.
fn drive(kind: DriveKind, beams: usize, count: usize, seed: u64) -> (Vec<Box<Scan>>, Vec<Pose2>) {
    let mut random = Rng::with_seed(seed);
    let walls = match kind {
        DriveKind::Corridor => vec![((-500.0, 1.2), (500.0, 1.2)), ((-500.0, -1.0), (500.0, -1.0))],
        _ => room(&mut random),
    };
    let half = if beams == 1081 { 0.75 * PI } else { 0.5 * PI };
    let (first, step) = (-half, 2.0 * half / (beams - 1) as f64);
    let mut people: Vec<Walker> = Vec::new();
    let (mut scans, mut poses) = (Vec::new(), Vec::new());
    let mut pose = Pose2::new(0.0, 0.0, TAU * random.f64());
    let (mut speed, mut turn) = (0.6, 0.0);
    if kind == DriveKind::Corridor {
        pose = Pose2::default();
    }
    for at in 0..count {
        if at > 0 {
            turn = (turn + 0.3 * (random.f64() - 0.5)).clamp(-0.8, 0.8);
            speed = (speed + 0.1 * (random.f64() - 0.5)).clamp(0.2, 1.2);
            // If the robot is far from the center, it turns back.
            let is_far = pose.x.hypot(pose.y) > 1.5;
            let home = (-pose.y).atan2(-pose.x) - pose.yaw;
            let turn = if is_far { 1.5 * home.sin() } else { turn };
            let (speed, turn) = match kind {
                DriveKind::Standing => (0.0, 0.0),
                DriveKind::Corridor => (speed, 0.2 * (-pose.y - pose.yaw)),
                _ => (speed, turn),
            };
            pose = pose.then(&Pose2::new(speed * SCAN_PERIOD_S, 0.0, turn * SCAN_PERIOD_S));
        }
        let visible_from = if kind == DriveKind::Jump && at % 50 == 49 {
            Pose2::new(7.0 * (random.f64() - 0.5), 5.0 * (random.f64() - 0.5), pose.yaw + PI * random.f64())
        } else {
            pose
        };
        if matches!(kind, DriveKind::People | DriveKind::Hidden) {
            move_people(&mut people, &visible_from, &mut random);
        }
        let ranges: Vec<f64> = (0..beams)
            .map(|beam| {
                let angle = first + beam as f64 * step;
                let (sin, cos) = (visible_from.yaw + angle).sin_cos();
                let (from, along) = ((visible_from.x, visible_from.y), (cos, sin));
                let mut range = walls
                    .iter()
                    .filter_map(|wall| distance_to_wall(from, along, wall))
                    .fold(f64::INFINITY, f64::min);
                for walker in &people {
                    let disc = distance_to_disc(from, along, walker.at, 0.2).filter(|disc| *disc < range);
                    range = disc
                        .map_or(range, |disc| if kind == DriveKind::Hidden { f64::INFINITY } else { disc });
                }
                range + NOISE_M * normal(&mut random)
            })
            .map(|range| if range < 25.0 { range } else { f64::INFINITY })
            .collect();
        scans.push(scan(first, step, &ranges));
        poses.push(visible_from);
    }
    (scans, poses)
}

/// Returns the square of the length of `deviation`, measured in standard deviations of `covariance` (the Mahalanobis
/// distance).
fn normalized(deviation: &[f64; 3], covariance: &[f32; 9]) -> Option<f64> {
    let matrix = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(covariance[3 * i + j])));
    let x = solve(matrix, *deviation)?;
    Some(x.iter().zip(deviation).map(|(x, off)| x * off).sum())
}
