//! Scans of a robot that drives through random rooms, with the true positions of the robot and the beams that met a
//! person.
#![allow(dead_code)] // each test takes what it needs

use std::collections::HashMap;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

use fastrand::Rng;
use scanhub_preprocess::motion::Pose2;
use scanhub_schema::{Code, Scan, ScanHead};

type Point = (f64, f64);

/// Consecutive scans of a robot, with the true positions and targets.
pub(crate) struct Drive {
    pub(crate) scans: Vec<Box<Scan>>,
    /// Position of the robot at the end of each scan.
    pub(crate) poses: Vec<Pose2>,
    /// For each scan, whether each beam met a person.
    pub(crate) people: Vec<Vec<bool>>,
    walls: Vec<(Point, Point)>,
    /// Centers and radii of round legs and pillars, in meters.
    pub(crate) legs: Vec<(Point, f64)>,
    walkers: Vec<Walker>,
    head: ScanHead,
    noise_m: f64,
    random: Rng,
}

/// Squares of 0.1 m that scans saw free, each with the number of scans that saw it free. The squares are calculated
/// from the true positions of the robot.
#[derive(Default)]
pub(crate) struct ObservedSquares {
    squares: HashMap<(i32, i32), (u32, u32)>,
    scans: u32,
}

impl ObservedSquares {
    /// Counts the squares that the scan with index `at` saw free.
    pub(crate) fn observe(&mut self, drive: &Drive, at: usize) {
        self.scans += 1;
        let scan = &drive.scans[at];
        for beam in 0..scan.beams() {
            let Some(range) = scan.distance_m(beam) else { continue };
            for step in 1..(range / 0.05) as u32 {
                let at = square(drive, at, beam, 0.05 * f64::from(step));
                let (free, last) = self.squares.entry(at).or_default();
                if *last != self.scans {
                    (*free, *last) = (*free + 1, self.scans);
                }
            }
        }
    }

    /// Returns whether a beam of the scan with index `at` ends in a square that at least five scans saw free.
    pub(crate) fn is_free(&self, drive: &Drive, at: usize, beam: usize) -> bool {
        let end = drive.scans[at].distance_m(beam).map(|range| square(drive, at, beam, range));
        end.and_then(|at| self.squares.get(&at)).is_some_and(|(free, _)| *free >= 5)
    }
}

/// Returns the square that contains the point at the given `range` on a beam of the scan with index `at`.
fn square(drive: &Drive, at: usize, beam: usize, range: f64) -> (i32, i32) {
    let (scan, before) = (&drive.scans[at], &drive.poses[at.saturating_sub(1)]);
    let (pose, angle) = (relative_pose(before, &drive.poses[at], scan, beam), scan.angle(beam));
    let (x, y) = pose.point((range * angle.cos(), range * angle.sin()));
    ((10.0 * x).floor() as i32, (10.0 * y).floor() as i32)
}

/// Returns the robot's position at the time of a beam of `scan`. During the scan, the robot moves from `before` to
/// `pose`.
fn relative_pose(before: &Pose2, pose: &Pose2, scan: &Scan, beam: usize) -> Pose2 {
    let part = 1.0 + 1e-9 * scan.beam_ns(beam) as f64 / SCAN_PERIOD_S;
    let step = before.inverse().then(pose);
    before.then(&Pose2::new(part * step.x, part * step.y, part * step.yaw))
}

/// Duration of a scan of an LMS at half degrees, in seconds. It is two revolutions of the mirror.
pub(crate) const SCAN_PERIOD_S: f64 = 0.026_64;

/// Returns the stamp of the scan with the index `number`, in ns.
pub(crate) fn stamp_ns(number: usize) -> u64 {
    1_000_000_000 + (number as f64 * 1e9 * SCAN_PERIOD_S) as u64
}

struct Walker {
    at: Point,
    by_scan: Point,
}

/// Returns the head of a scan of `count` beams with ranges in mm.
pub(crate) fn beams_at(count: usize, first_angle: f64, step: f64) -> ScanHead {
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
pub(crate) fn scan(head: ScanHead, mut range: impl FnMut(f64) -> Option<f64>) -> Box<Scan> {
    let unit = |i: u16| {
        let range = range(head.first_angle + f64::from(i) * head.step);
        range
            .filter(|range| *range < 65.0)
            .map_or(head.no_return, |range| (1000.0 * range).max(0.0).round() as u16)
    };
    Scan::of(head, &(0..head.count).map(unit).collect::<Vec<_>>())
}

/// Returns a normally distributed number with standard deviation 1, by the method of Box and Muller.
pub(crate) fn normal(random: &mut Rng) -> f64 {
    (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (TAU * random.f64()).cos()
}

fn box_walls(center: Point, (long, wide): (f64, f64), yaw: f64) -> Vec<(Point, Point)> {
    let pose = Pose2::new(center.0, center.1, yaw);
    let corners = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]
        .map(|(x, y): Point| pose.point((x * long / 2.0, y * wide / 2.0)));
    (0..4).map(|i| (corners[i], corners[(i + 1) % 4])).collect()
}

fn distance_to_wall(from: Point, along: Point, ((x1, y1), (x2, y2)): &(Point, Point)) -> Option<f64> {
    let (dx, dy) = (x2 - x1, y2 - y1);
    let cross = along.0 * dy - along.1 * dx;
    let (ox, oy) = (x1 - from.0, y1 - from.1);
    let (range, share) = ((ox * dy - oy * dx) / cross, (ox * along.1 - oy * along.0) / cross);
    (range > 0.0 && (0.0..=1.0).contains(&share)).then_some(range)
}

fn distance_to_disc(from: Point, along: Point, center: Point, radius: f64) -> Option<f64> {
    let (dx, dy) = (center.0 - from.0, center.1 - from.1);
    let ahead = dx * along.0 + dy * along.1;
    let inside = radius * radius - (dx * dx + dy * dy - ahead * ahead);
    (inside > 0.0 && ahead > radius).then(|| ahead - inside.sqrt())
}

impl Drive {
    /// Returns `count` scans of `beams` beams over 180 degrees. The robot drives through a room with boxes, which is
    /// drawn from `seed`.
    pub(crate) fn through_a_room(seed: u64, beams: usize, count: usize, noise_m: f64) -> Drive {
        let mut drive = Drive::new_room(seed, beams, noise_m);
        drive.drive_on(count, 0.02);
        drive
    }

    /// Returns scans like [`through_a_room`](Self::through_a_room), with `people` people around the robot.
    pub(crate) fn among_people(seed: u64, beams: usize, count: usize, people: usize) -> Drive {
        let mut drive = Drive::new_room(seed, beams, 0.01);
        for _ in 0..people {
            drive.add_walker();
        }
        drive.drive_on(count, 0.02);
        drive
    }

    /// Returns scans of a robot among `people` people who walk. The robot drives by `speed` meters per scan, or does
    /// not move if `speed` is 0.
    pub(crate) fn with_walkers(seed: u64, beams: usize, count: usize, people: usize, speed: f64) -> Drive {
        let mut drive = Drive::new_room(seed, beams, 0.01);
        for _ in 0..people {
            drive.add_walker();
        }
        if speed == 0.0 {
            drive.stand_still(count);
        } else {
            drive.drive_on(count, speed);
        }
        drive
    }

    /// Returns scans of an LMS at half degrees. The robot drives by `speed` meters per scan among `people` people, and
    /// moves while a scan is measured. The room has tables and chairs with thin legs, cupboards, and pillars.
    pub(crate) fn through_furniture(seed: u64, count: usize, people: usize, speed: f64) -> Drive {
        let mut drive = Drive::new_room(seed, 361, 0.01);
        drive.furnish();
        for _ in 0..people {
            drive.add_walker();
        }
        drive.drive_on(count, speed);
        drive
    }

    /// Returns scans of an LMS at half degrees, on a robot that turns on the spot in a furnished room. From the first
    /// scan on, the robot turns by `deg_per_s`. At the end, it does not move for 20 scans.
    pub(crate) fn on_the_spot(seed: u64, count: usize, deg_per_s: f64) -> Drive {
        let mut drive = Drive::turning(seed, count + 1, deg_per_s);
        drive.stand_still(19);
        drive
    }

    /// Returns `count` scans of an LMS at half degrees, on a robot that turns on the spot in a furnished room by
    /// `deg_per_s`.
    pub(crate) fn turning(seed: u64, count: usize, deg_per_s: f64) -> Drive {
        let mut drive = Drive::new_room(seed, 361, 0.01);
        drive.furnish();
        let pose = Pose2::new(0.0, 0.0, TAU * drive.random.f64());
        drive.scan_from(pose);
        drive.turn(count - 1, deg_per_s);
        drive
    }

    fn furnish(&mut self) {
        let Drive { random, walls, legs, .. } = self;
        let free = |random: &mut Rng| loop {
            let at = (10.0 * (random.f64() - 0.5), 7.0 * (random.f64() - 0.5));
            if at.0.hypot(at.1) > 3.0 {
                return at;
            }
        };
        for _ in 0..5 {
            let (at, yaw) = (free(random), PI * random.f64());
            let table = Pose2::new(at.0, at.1, yaw);
            let corners = |long: f64, wide: f64| [(long, wide), (-long, wide), (-long, -wide), (long, -wide)];
            legs.extend(corners(0.7, 0.38).map(|corner| (table.point(corner), 0.025)));
            for side in [-1.0, 1.0] {
                let chair = table.then(&Pose2::new(0.6 * (random.f64() - 0.5), side * 0.7, random.f64()));
                legs.extend(corners(0.2, 0.2).map(|corner| (chair.point(corner), 0.012)));
            }
        }
        for _ in 0..3 {
            legs.push((free(random), 0.08 + 0.2 * random.f64()));
            walls.extend(box_walls(free(random), (0.9, 0.45), FRAC_PI_2 * f64::from(random.u8(..4))));
        }
    }

    fn add_walker(&mut self) {
        let at = (1.2 + 2.0 * self.random.f64(), TAU * self.random.f64());
        let direction = (TAU * self.random.f64()).sin_cos();
        let speed = 0.02 + 0.02 * self.random.f64();
        self.walkers.push(Walker {
            at: (at.0 * at.1.cos(), at.0 * at.1.sin()),
            by_scan: (speed * direction.1, speed * direction.0),
        });
    }

    /// Returns scans of a robot that drives between two endless walls.
    pub(crate) fn along_a_corridor(seed: u64, beams: usize, count: usize) -> Drive {
        let mut drive = Drive::new_room(seed, beams, 0.01);
        drive.walls = vec![((-500.0, 1.2), (500.0, 1.2)), ((-500.0, -1.0), (500.0, -1.0))];
        let mut pose = Pose2::default();
        for _ in 0..count {
            drive.scan_from(pose);
            pose = pose.then(&Pose2::new(0.02, 0.0, 0.0));
        }
        drive
    }

    fn new_room(seed: u64, beams: usize, noise_m: f64) -> Drive {
        let mut random = Rng::with_seed(seed);
        let mut walls = box_walls((0.3, -0.4), (11.0, 8.0), 0.0);
        for _ in 0..9 {
            let at = (10.0 * (random.f64() - 0.5), 7.0 * (random.f64() - 0.5));
            if at.0.hypot(at.1) > 2.6 {
                let size = (0.3 + random.f64(), 0.3 + random.f64());
                walls.extend(box_walls(at, size, PI * random.f64()));
            }
        }
        Drive {
            scans: Vec::new(),
            poses: Vec::new(),
            people: Vec::new(),
            walls,
            legs: Vec::new(),
            walkers: Vec::new(),
            head: match beams {
                // Scans with this number of beams have the times of an LMS.
                361 => ScanHead::lms(361, -90_000, 500, 1, 15),
                _ => beams_at(beams, -PI / 2.0, PI / (beams - 1) as f64),
            },
            noise_m,
            random,
        }
    }

    /// Adds `count` scans while the robot drives around by `speed` meters per scan.
    pub(crate) fn drive_on(&mut self, count: usize, speed: f64) {
        let mut yaw_sum = 0.0;
        let yaw = TAU * self.random.f64();
        let mut pose = self.poses.last().copied().unwrap_or(Pose2::new(0.0, 0.0, yaw));
        for _ in 0..count {
            self.scan_from(pose);
            yaw_sum = f64::clamp(yaw_sum + 0.01 * (self.random.f64() - 0.5), -0.03, 0.03);
            let is_far = pose.x.hypot(pose.y) > 1.3;
            let home = Pose2::new(0.0, 0.0, (-pose.y).atan2(-pose.x) - pose.yaw).yaw.clamp(-1.0, 1.0);
            pose = pose.then(&Pose2::new(speed, 0.0, if is_far { 0.04 * home } else { yaw_sum }));
        }
    }

    /// Adds `count` scans while the robot turns on the spot by `deg_per_s`.
    pub(crate) fn turn(&mut self, count: usize, deg_per_s: f64) {
        let step = Pose2::new(0.0, 0.0, (deg_per_s * SCAN_PERIOD_S).to_radians());
        for _ in 0..count {
            let pose = self.poses.last().copied().unwrap_or_default();
            self.scan_from(pose.then(&step));
        }
    }

    /// Adds a scan. The robot has moved by `by` since the previous scan, and turns by `deg_per_s` during the new scan.
    pub(crate) fn move_by(&mut self, by: Pose2, deg_per_s: f64) {
        let before = self.poses.last().copied().unwrap_or_default().then(&by);
        self.scan_between(
            before,
            before.then(&Pose2::new(0.0, 0.0, (deg_per_s * SCAN_PERIOD_S).to_radians())),
        );
    }

    /// Adds `count` scans while the robot stands.
    pub(crate) fn stand_still(&mut self, count: usize) {
        let pose = self.poses.last().copied().unwrap_or_default();
        (0..count).for_each(|_| self.scan_from(pose));
    }

    /// Adds a scan. During the scan, the robot moves from its last position to `pose`.
    fn scan_from(&mut self, pose: Pose2) {
        self.scan_between(self.poses.last().copied().unwrap_or(pose), pose);
    }

    /// Adds a scan. During the scan, the robot moves from `before` to `pose`.
    fn scan_between(&mut self, before: Pose2, pose: Pose2) {
        let Drive { walls, legs, walkers, head, noise_m, random, .. } = self;
        let times = Scan::of(*head, &[]);
        for walker in walkers.iter_mut() {
            walker.at = (walker.at.0 + walker.by_scan.0, walker.at.1 + walker.by_scan.1);
            // A walker turns back when it comes too near to the robot or too far away from the robot.
            let (dx, dy) = (walker.at.0 - pose.x, walker.at.1 - pose.y);
            let far = dx.hypot(dy);
            let outwards = dx * walker.by_scan.0 + dy * walker.by_scan.1;
            if far < 0.8 && outwards < 0.0 || far > 3.2 && outwards > 0.0 {
                walker.by_scan = (-walker.by_scan.0, -walker.by_scan.1);
            }
        }
        let mut met = Vec::new();
        let mut beam = 0;
        let scan = scan(*head, |angle| {
            let pose = relative_pose(&before, &pose, &times, beam);
            beam += 1;
            let (sin, cos) = (pose.yaw + angle).sin_cos();
            let (from, along) = ((pose.x, pose.y), (cos, sin));
            let wall = walls.iter().filter_map(|wall| distance_to_wall(from, along, wall));
            let legs = legs.iter().filter_map(|(at, radius)| distance_to_disc(from, along, *at, *radius));
            let wall = wall.chain(legs).fold(f64::INFINITY, f64::min);
            let discs = walkers.iter().filter_map(|walker| distance_to_disc(from, along, walker.at, 0.2));
            let disc = discs.fold(f64::INFINITY, f64::min);
            met.push(disc < wall);
            Some(disc.min(wall) + *noise_m * normal(random))
        });
        self.scans.push(scan);
        self.poses.push(pose);
        self.people.push(met);
    }
}
