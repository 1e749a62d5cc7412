//! A simulated hall with a scanner at one end and a door at the other: leaves that slide or swing, people who walk and
//! stand, and mixed ranges where a beam meets two surfaces. The simulation uses virtual time and seeds.
#![allow(dead_code)] // Each test file uses only a part of it.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use scanhub_perception::track::geometry::{Point, distance};
use scanhub_perception::track::{Event, PeopleTracker, Site, Snapshot};
use scanhub_preprocess::background::{BackgroundModel, Settings};
use scanhub_preprocess::segments::Segmenter;
use scanhub_schema::{Foreground, Pose, Scan, ScanHead};

/// Site file with a hall of 8 m by 6 m, and a lobby of 8 m by 4 m behind the hall. The opening in the wall between hall
/// and lobby is 1.8 m wide.
pub(crate) const HALL_SITE: &str = r#"
[[sensor]]
name = "front"
pose = { x = 0.0, y = 0.0, yaw = 0.0 }
[[room]]
name = "hall"
polygon = [[0, -4], [6, -4], [6, 4], [0, 4]]
[[room]]
name = "lobby"
polygon = [[6, -4], [10, -4], [10, 4], [6, 4]]
[[door]]
name = "entrance"
from = "lobby"
to = "hall"
between = [[6, -0.9], [6, 0.9]]
"#;
const HALL_WALLS: [[Point; 2]; 7] = [
    [[0.0, -4.0], [6.0, -4.0]],
    [[0.0, 4.0], [6.0, 4.0]],
    [[6.0, -4.0], [6.0, -0.9]],
    [[6.0, 0.9], [6.0, 4.0]],
    [[6.0, -4.0], [10.0, -4.0]],
    [[6.0, 4.0], [10.0, 4.0]],
    [[10.0, -4.0], [10.0, 4.0]],
];
/// Width of a leaf, which is half of the opening, and distance by which a sliding leaf moves.
const LEAF_WIDTH_M: f64 = 0.9;
const SLIDE_DISTANCE_M: f64 = 0.85;
/// Time in which a leaf opens or closes.
const MOVE_TIME_S: f64 = 1.5;
/// Interval at which a door that moves by itself opens.
const MOVE_INTERVAL_S: f64 = 20.0;
/// Angle that a beam covers; standard deviation of a range; and share of beams on an edge that have a mixed range.
const BEAM_RAD: f64 = 0.5 * PI / 180.0;
const NOISE_M: f64 = 0.01;
const MIXED_SHARE: f64 = 0.2;
const LEG_RADIUS_M: f64 = 0.06;
const START_NS: u64 = 1_800_000_000_000_000_000;

/// Movement of the two leaves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum DoorKind {
    /// The leaves slide along the wall, in a plane at this distance behind the wall, in meters.
    Slide(f64),
    /// The leaves swing about the two jambs by a right angle, into the hall or into the lobby.
    SwingIn,
    SwingOut,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Scanner {
    pub(crate) step_deg: f64,
    pub(crate) hz: u64,
}

pub(crate) const DOOR_KINDS: [DoorKind; 4] =
    [DoorKind::Slide(0.05), DoorKind::Slide(-0.05), DoorKind::SwingIn, DoorKind::SwingOut];
pub(crate) const SCANNERS: [Scanner; 4] = [
    Scanner { step_deg: 0.5, hz: 25 },
    Scanner { step_deg: 0.5, hz: 10 },
    Scanner { step_deg: 1.0, hz: 25 },
    Scanner { step_deg: 1.0, hz: 10 },
];

impl DoorKind {
    /// Returns the two leaves of a door. `share` is 0 if the door is closed, and 1 if it is completely open.
    fn at(self, share: f64) -> [[Point; 2]; 2] {
        let (sin, cos) = (share * FRAC_PI_2).sin_cos();
        [1.0, -1.0].map(|side| match self {
            DoorKind::Slide(behind) => [share * SLIDE_DISTANCE_M, share * SLIDE_DISTANCE_M + LEAF_WIDTH_M]
                .map(|y| [6.0 + behind, side * y]),
            DoorKind::SwingIn => {
                [[6.0, side * LEAF_WIDTH_M], [6.0 - LEAF_WIDTH_M * sin, side * LEAF_WIDTH_M * (1.0 - cos)]]
            }
            DoorKind::SwingOut => {
                [[6.0, side * LEAF_WIDTH_M], [6.0 + LEAF_WIDTH_M * sin, side * LEAF_WIDTH_M * (1.0 - cos)]]
            }
        })
    }
}

/// A person who appears at `from_s` and walks from point to point. Each point has the time for which the person stands
/// there, in seconds.
pub(crate) struct Walker {
    pub(crate) from_s: f64,
    pub(crate) path: Vec<(Point, f64)>,
    pub(crate) speed: f64,
    /// Share of a double step that the person has already walked at the start.
    pub(crate) phase: f64,
}

impl Walker {
    /// Returns the person's position, heading and walked distance, and whether the person stands. Returns `None` before
    /// the person appears and after they have left.
    pub(crate) fn at(&self, now_s: f64) -> Option<(Point, Point, f64, bool)> {
        let mut left_s = now_s - self.from_s;
        let mut walked_m = 0.0;
        if left_s < 0.0 {
            return None;
        }
        for leg in self.path.windows(2) {
            let [(from, stands_s), (to, _)] = [leg[0], leg[1]];
            let far_m = distance(from, to);
            let ahead = [(to[0] - from[0]) / far_m, (to[1] - from[1]) / far_m];
            if left_s < stands_s {
                return Some((from, ahead, walked_m, true));
            }
            left_s -= stands_s;
            let gone_m = left_s * self.speed;
            if gone_m < far_m {
                let place = [from[0] + gone_m * ahead[0], from[1] + gone_m * ahead[1]];
                return Some((place, ahead, walked_m + gone_m, false));
            }
            walked_m += far_m;
            left_s -= far_m / self.speed;
        }
        None
    }

    /// Returns the centers of the person's two legs.
    fn legs(&self, now_s: f64) -> Option<[Point; 2]> {
        let (place, [hx, hy], walked_m, stands) = self.at(now_s)?;
        let stride = if stands { 0.0 } else { 0.25 * (TAU * (self.phase + walked_m / 1.4)).sin() };
        // A standing person sways a little.
        let sway = if stands { 0.03 * (1.3 * now_s).sin() } else { 0.0 };
        Some([1.0, -1.0].map(|side| {
            let (ahead, aside) = (side * stride + sway, side * 0.11 + 0.5 * sway);
            [place[0] + ahead * hx - aside * hy, place[1] + ahead * hy + aside * hx]
        }))
    }

    /// Returns the times at which the person goes through the door, each with a flag that is true if the person goes
    /// into the hall.
    pub(crate) fn passages(&self) -> Vec<(f64, bool)> {
        let mut passages = Vec::new();
        let mut before: Option<Point> = None;
        for step in 0..20_000 {
            let now_s = self.from_s + f64::from(step) * 0.01;
            let Some((place, ..)) = self.at(now_s) else { break };
            if let Some(before) = before
                && (before[0] < 6.0) != (place[0] < 6.0)
            {
                passages.push((now_s, place[0] < 6.0));
            }
            before = Some(place);
        }
        passages
    }
}

/// A run of the hall.
pub(crate) struct Scene<'a> {
    pub(crate) site: &'a str,
    pub(crate) leaves: DoorKind,
    pub(crate) scanner: Scanner,
    /// Position of the scanner, which faces the wall with the door.
    pub(crate) at: Point,
    pub(crate) seed: u64,
    pub(crate) seconds: u64,
    /// Whether the door opens every 20 s even without a person near it.
    pub(crate) is_door_moving: bool,
    /// Distance from the middle of the door at which a person opens the door, in meters; and time for which the door
    /// then stays open.
    pub(crate) opens_m: f64,
    pub(crate) open_time_s: f64,
    pub(crate) walkers: &'a [Walker],
}

/// Returns the events in the hall with their times in seconds.
pub(crate) fn events(scene: &Scene<'_>) -> Vec<(f64, Event)> {
    let mut events = Vec::new();
    run(scene, |sample| {
        let at_s = |event: &Event| event.wall_ns.saturating_sub(START_NS) as f64 * 1e-9;
        events.extend(sample.events.iter().map(|event| (at_s(event), *event)));
    });
    events
}

/// Runs a scene, and passes each snapshot to `on_sample`.
pub(crate) fn run(scene: &Scene<'_>, mut on_sample: impl FnMut(&Snapshot)) {
    let Scene { leaves, scanner, walkers, at, .. } = *scene;
    let from_scanner = |[x, y]: Point| [x - at[0], y - at[1]];
    let walls = HALL_WALLS.map(|wall| wall.map(from_scanner));
    let mut random = fastrand::Rng::with_seed(scene.seed);
    let beams = (180.0 / scanner.step_deg) as usize + 1;
    let step = scanner.step_deg.to_radians();
    let head = ScanHead {
        first_angle: -FRAC_PI_2,
        step,
        spacing: step as f32,
        beam_time_ns: 37_037,
        unit_um: 1000,
        valid_to: 20_000,
        no_return: 30_000,
        beyond: 30_000,
        ..ScanHead::default()
    };
    let edges = |i: usize| {
        let middle = -FRAC_PI_2 + i as f64 * step;
        [-BEAM_RAD / 2.0, 0.0, BEAM_RAD / 2.0].map(|off| [(middle + off).cos(), (middle + off).sin()])
    };
    let directions: Vec<[Point; 3]> = (0..beams).map(edges).collect();
    let empty = directions.iter().map(|rays| rays.map(|ray| nearest(ray, walls.iter().enumerate())));
    let empty: Vec<[(f64, usize); 3]> = empty.collect();
    let mut model = BackgroundModel::new(Settings::default(), beams);
    let mut segmenter = Segmenter::new(Pose::default(), beams);
    let mut foreground = Foreground::of(beams);
    let pose = format!("x = {:.2}, y = {:.2}", at[0], at[1]);
    let site = scene.site.replace("x = 0.0, y = 0.0", &pose);
    let mut people = PeopleTracker::new(Site::parse("hall.toml", &site).expect("a hall"), 0);
    let mut words = vec![0; beams];
    let (mut open, mut until_s, mut next_s) = (0.0_f64, 0.0, MOVE_INTERVAL_S);
    for scan in 0..scene.seconds * scanner.hz {
        let now_s = scan as f64 / scanner.hz as f64;
        let near = |walker: &Walker| {
            walker.at(now_s).is_some_and(|(place, ..)| distance(place, [6.0, 0.0]) < scene.opens_m)
        };
        if walkers.iter().any(near) {
            until_s = now_s + scene.open_time_s;
        } else if scene.is_door_moving && now_s >= next_s {
            (until_s, next_s) = (now_s + MOVE_TIME_S + scene.open_time_s, next_s + MOVE_INTERVAL_S);
        }
        let step_share = 1.0 / (MOVE_TIME_S * scanner.hz as f64);
        open = (open + if now_s < until_s { step_share } else { -step_share }).clamp(0.0, 1.0);
        let both = leaves.at(open).map(|leaf| leaf.map(from_scanner));
        let legs: Vec<Point> =
            walkers.iter().filter_map(|walker| walker.legs(now_s)).flatten().map(from_scanner).collect();
        for ((word, rays), walls) in words.iter_mut().zip(&directions).zip(&empty) {
            let mut hits = *walls;
            for (hit, &ray) in hits.iter_mut().zip(rays) {
                let moved = nearest(ray, both.iter().enumerate());
                if moved.0 < hit.0 {
                    *hit = (moved.0, 10 + moved.1);
                }
                for (number, leg) in legs.iter().enumerate() {
                    let along = leg[0] * ray[0] + leg[1] * ray[1];
                    let depth =
                        LEG_RADIUS_M * LEG_RADIUS_M - (leg[0] * leg[0] + leg[1] * leg[1] - along * along);
                    if depth > 0.0 && along - depth.sqrt() < hit.0 {
                        *hit = (along - depth.sqrt(), 20 + number);
                    }
                }
            }
            let (near, far) = hits.iter().fold((hits[0], hits[0]), |(near, far), &hit| {
                (if hit.0 < near.0 { hit } else { near }, if hit.0 > far.0 { hit } else { far })
            });
            let is_mixed = near.1 != far.1 && far.0 - near.0 > 0.1 && random.f64() < MIXED_SHARE;
            let range = if is_mixed { near.0 + (far.0 - near.0) * random.f64() } else { hits[1].0 };
            let noisy = range + NOISE_M * normal(&mut random);
            *word = if noisy.is_finite() { (1000.0 * noisy).round() as u16 } else { 30_000 };
        }
        let scan = Scan::of(head, &words);
        model.update(&scan, &mut foreground);
        segmenter.update(&scan, &mut foreground);
        people.take(0, START_NS + (now_s * 1e9) as u64, &scan, &foreground, &mut on_sample);
    }
}

/// Returns the range of the nearest wall in the direction `ray` from the scanner, and the index of this wall.
fn nearest<'a>(ray: Point, walls: impl Iterator<Item = (usize, &'a [Point; 2])>) -> (f64, usize) {
    let meets = |(number, &[a, b]): (usize, &[Point; 2])| {
        let along = [b[0] - a[0], b[1] - a[1]];
        let across = ray[0] * along[1] - ray[1] * along[0];
        let range = (a[0] * along[1] - a[1] * along[0]) / across;
        let share = (a[0] * ray[1] - a[1] * ray[0]) / across;
        (range > 1e-6 && (0.0..=1.0).contains(&share)).then_some((range, number))
    };
    walls.filter_map(meets).fold((f64::INFINITY, usize::MAX), |a, b| if b.0 < a.0 { b } else { a })
}

/// Returns a standard normal random number.
fn normal(random: &mut fastrand::Rng) -> f64 {
    (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (TAU * random.f64()).cos()
}
