//! Drives through rooms of straight walls and people, with the place of the robot at each scan. Refuses to know who follows
//! them.

use std::f64::consts::{PI, TAU};

use fastrand::Rng;
use preprocess::motion::Rigid;
use schema::Scan;

use crate::rivals::solved;
use crate::rooms::scan;

type Point = (f64, f64);

/// What is driven through.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Room,
    /// People walk around the robot and hide about half of the view.
    People,
    /// The same, but what is seen of people is no reading.
    Hidden,
    /// Two walls and nothing else.
    Corridor,
    /// Every fiftieth scan is one of somewhere else.
    Jump,
    /// The robot does not move.
    Standing,
}

/// Of a range in metres.
const NOISE_M: f64 = 0.01;
const CROWD: usize = 9;
const PERIOD_S: f64 = 1.0 / 37.5;

/// A room of `seed`: the walls of a box with pillars and boxes in it.
fn room(random: &mut Rng) -> Vec<(Point, Point)> {
    let mut walls = boxed((0.0, 0.0), (12.0, 9.0), 0.0);
    for _ in 0..8 {
        let at = (11.0 * (random.f64() - 0.5), 8.0 * (random.f64() - 0.5));
        if at.0.hypot(at.1) > 2.5 {
            let size = (0.3 + random.f64(), 0.3 + random.f64());
            walls.extend(boxed(at, size, PI * random.f64()));
        }
    }
    walls
}

fn boxed(middle: Point, (long, wide): (f64, f64), yaw: f64) -> Vec<(Point, Point)> {
    let place = Rigid::new(middle.0, middle.1, yaw);
    let corners = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]
        .map(|(x, y): Point| place.point((x * long / 2.0, y * wide / 2.0)));
    (0..4).map(|i| (corners[i], corners[(i + 1) % 4])).collect()
}

/// How far along the unit vector `along` from `from` the wall is.
fn to_wall(from: Point, along: Point, ((x1, y1), (x2, y2)): &(Point, Point)) -> Option<f64> {
    let (dx, dy) = (x2 - x1, y2 - y1);
    let cross = along.0 * dy - along.1 * dx;
    let (ox, oy) = (x1 - from.0, y1 - from.1);
    let (range, share) = ((ox * dy - oy * dx) / cross, (ox * along.1 - oy * along.0) / cross);
    (range > 0.0 && (0.0..=1.0).contains(&share)).then_some(range)
}

/// How far a disc of `radius` is.
fn to_disc(from: Point, along: Point, middle: Point, radius: f64) -> Option<f64> {
    let (dx, dy) = (middle.0 - from.0, middle.1 - from.1);
    let ahead = dx * along.0 + dy * along.1;
    let inside = radius * radius - (dx * dx + dy * dy - ahead * ahead);
    (inside > 0.0 && ahead > radius).then(|| ahead - inside.sqrt())
}

/// Somebody on the way, in the frame of the room.
struct Walker {
    at: Point,
    by_second: Point,
}

/// Lets people walk, so many that they hide about half of the view from `seen`: who leaves it is replaced.
fn crowd(people: &mut Vec<Walker>, seen: &Rigid, random: &mut Rng) {
    for Walker { at, by_second } in people.iter_mut() {
        *at = (at.0 + by_second.0 * PERIOD_S, at.1 + by_second.1 * PERIOD_S);
    }
    let from_robot = |walker: &Walker| {
        let (x, y) = seen.inverse().point(walker.at);
        (x.hypot(y), y.atan2(x))
    };
    people.retain(|walker| {
        let (far, bearing) = from_robot(walker);
        (0.6..3.2).contains(&far) && bearing.abs() < 1.7
    });
    while people.len() < CROWD {
        let (far, bearing) = (0.8 + 2.2 * random.f64(), 3.2 * (random.f64() - 0.5));
        let (way, speed) = (TAU * random.f64(), 0.5 + random.f64());
        let at = seen.point((far * bearing.cos(), far * bearing.sin()));
        people.push(Walker { at, by_second: (speed * way.cos(), speed * way.sin()) });
    }
}

/// So many scans of so many beams over half a turn, 1081 of them over 270 degrees, and the places of the robot.
pub(crate) fn drive(kind: Kind, beams: usize, count: usize, seed: u64) -> (Vec<Box<Scan>>, Vec<Rigid>) {
    let mut random = Rng::with_seed(seed);
    let walls = match kind {
        Kind::Corridor => vec![((-500.0, 1.2), (500.0, 1.2)), ((-500.0, -1.0), (500.0, -1.0))],
        _ => room(&mut random),
    };
    let half = if beams == 1081 { 0.75 * PI } else { 0.5 * PI };
    let (first, step) = (-half, 2.0 * half / (beams - 1) as f64);
    let mut people: Vec<Walker> = Vec::new();
    let (mut scans, mut places) = (Vec::new(), Vec::new());
    let mut place = Rigid::new(0.0, 0.0, TAU * random.f64());
    let (mut speed, mut turn) = (0.6, 0.0);
    if kind == Kind::Corridor {
        place = Rigid::default();
    }
    for at in 0..count {
        if at > 0 {
            turn = (turn + 0.3 * (random.f64() - 0.5)).clamp(-0.8, 0.8);
            speed = (speed + 0.1 * (random.f64() - 0.5)).clamp(0.2, 1.2);
            // Near the walls the robot turns back, as far as it turns.
            let is_far = place.x.hypot(place.y) > 1.5;
            let home = (-place.y).atan2(-place.x) - place.yaw;
            let turn = if is_far { 1.5 * home.sin() } else { turn };
            let (speed, turn) = match kind {
                Kind::Standing => (0.0, 0.0),
                Kind::Corridor => (speed, 0.2 * (-place.y - place.yaw)),
                _ => (speed, turn),
            };
            place = place.then(&Rigid::new(speed * PERIOD_S, 0.0, turn * PERIOD_S));
        }
        let seen = if kind == Kind::Jump && at % 50 == 49 {
            Rigid::new(7.0 * (random.f64() - 0.5), 5.0 * (random.f64() - 0.5), place.yaw + PI * random.f64())
        } else {
            place
        };
        if matches!(kind, Kind::People | Kind::Hidden) {
            crowd(&mut people, &seen, &mut random);
        }
        let ranges: Vec<f64> = (0..beams)
            .map(|beam| {
                let angle = first + beam as f64 * step;
                let (sin, cos) = (seen.yaw + angle).sin_cos();
                let (from, along) = ((seen.x, seen.y), (cos, sin));
                let mut range =
                    walls.iter().filter_map(|wall| to_wall(from, along, wall)).fold(f64::INFINITY, f64::min);
                for walker in &people {
                    let disc = to_disc(from, along, walker.at, 0.2).filter(|disc| *disc < range);
                    range =
                        disc.map_or(range, |disc| if kind == Kind::Hidden { f64::INFINITY } else { disc });
                }
                range + NOISE_M * normal(&mut random)
            })
            .map(|range| if range < 25.0 { range } else { f64::INFINITY })
            .collect();
        scans.push(scan(first, step, &ranges));
        places.push(seen);
    }
    (scans, places)
}

/// The square of `off` in deviations of `covariance`.
pub(crate) fn normalized(off: &[f64; 3], covariance: &[f32; 9]) -> Option<f64> {
    let matrix = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(covariance[3 * i + j])));
    let x = solved(matrix, *off)?;
    Some(x.iter().zip(off).map(|(x, off)| x * off).sum())
}

/// By Box and Muller.
fn normal(random: &mut Rng) -> f64 {
    (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (TAU * random.f64()).cos()
}
