//! People of the proof: they walk from place to place, stand, sit down, stop on the way, give way to each other, change rooms
//! through the corridor, leave the house and come in. A pure function of the seed.

use scanhub_perception::track::geometry::{Point, distance};
use scanhub_sim::Shape;

use crate::house::{CHAIRS, House, chair_legs, normal, post, wall};

pub(crate) const LEG_M: f64 = 0.06;
/// Half the distance of the legs across the way, and how far a foot gets ahead.
const HIP_M: f64 = 0.11;
const STRIDE_M: f64 = 0.25;
const DOUBLE_STEP_M: f64 = 1.4;
/// Mean and deviation of how fast people walk.
pub(crate) const PACE: (f64, f64) = (1.15, 0.22);
/// Share of those who stop in the corridor, and for how long at most.
pub(crate) const STOPS: (f64, f64) = (0.15, 8.0);
const INSIDE: usize = 3;
pub(crate) const CORRIDOR: [f64; 2] = [6.0, 11.0];

/// Nobody steps nearer to another one.
const NEAREST_M: f64 = 0.55;

/// A free part of the plan: minimum x and y, maximum x and y.
const FREE: [[f64; 4]; 9] = [
    [0.35, 0.35, 5.65, 4.65],
    [11.35, 0.35, 16.65, 4.65],
    [6.3, 1.8, 10.7, 3.2],
    [5.6, 2.2, 6.4, 2.8],
    [10.6, 2.2, 11.4, 2.8],
    // The doors to the street, and the street.
    [-0.4, 2.2, 0.4, 2.8],
    [16.6, 2.2, 17.4, 2.8],
    [-3.4, 0.5, -0.35, 4.5],
    [17.35, 0.5, 20.4, 4.5],
];
/// The doors to the street: x, and the direction of the street.
const OUTER: [(f64, f64); 2] = [(0.0, -1.0), (17.0, 1.0)];
/// Number of the first of them in the site.
const FIRST_OUTER: usize = 2;
/// Share of plans that lead to the street, and time after which somebody else comes in, in seconds.
const LEAVES: f64 = 0.06;
const RETURNS_S: (f64, f64) = (3.0, 12.0);
/// A door opens for a person who is nearer to it and wants to pass, and takes this time.
const OPENS_M: f64 = 1.4;
const OPENS_S: f64 = 0.9;
/// Distance of the shins of a sitter from the center of the chair: the front edge of the seat is at 0.2 m.
const SHINS_M: f64 = 0.36;
/// Distance by which a sitter moves the chair along each axis, at most, and its turn in radians.
const CHAIR_MOVES: (f64, f64) = (0.05, 0.15);
/// Minimum distance of a walker from the center of a chair.
const CHAIR_M: f64 = 0.3;
/// Duration of sitting, in seconds.
const SITS_S: (f64, f64) = (10.0, 40.0);
/// Position of people who have left.
const GONE: Point = [-1000.0, -1000.0];

pub(crate) struct Walker {
    pub(crate) place: Point,
    velocity: Point,
    heading: Point,
    pub(crate) pace: f64,
    /// Turns of a double step.
    phase: f64,
    way: Vec<(Point, f64)>,
    rest_s: f64,
    room: usize,
    /// For how long he has wanted to go and could not.
    stuck_s: f64,
    /// The chair that the person sits on, or walks to.
    chair: Option<usize>,
    /// The door to the street that the person wants to pass.
    outer: Option<usize>,
    /// When he went into the corridor, if he is there.
    pub(crate) entered_s: Option<f64>,
}

/// Somebody came out of the corridor on the other side.
pub(crate) struct Crossing {
    pub(crate) walker: usize,
    pub(crate) entered_s: f64,
    pub(crate) left_s: f64,
}

pub(crate) struct Crowd {
    pub(crate) walkers: Vec<Walker>,
    random: fastrand::Rng,
    pub(crate) crossings: Vec<Crossing>,
    /// Doors that were passed: when, which, and whether from the room that the site names first.
    pub(crate) passages: Vec<(f64, usize, bool)>,
    /// How often one whose rest is over changes rooms; less than 0: whoever is in a room stands there for good.
    restless: f64,
    /// Share of rests on a chair.
    sits: f64,
    house: House,
    /// Center and direction of each chair.
    chairs: Vec<(Point, f64)>,
    /// Opening of the doors to the street, 0 to 1.
    open: [f64; 2],
    /// Times at which new people enter, and the number of the door.
    arrivals: Vec<(f64, usize)>,
    now_s: f64,
}

impl Crowd {
    /// All begin in the corridor or before it, from second `from_s` on one after the other.
    pub(crate) fn new(
        house: House,
        count: usize,
        from_s: f64,
        (restless, sits): (f64, f64),
        seed: u64,
    ) -> Crowd {
        let mut random = fastrand::Rng::with_seed(seed);
        let walkers = (0..count).map(|i| {
            let room = i % 2;
            let place = [8.5 + 0.3 * (i as f64 % 4.0 - 1.5), 2.0 + 0.1 * (i as f64 % 10.0)];
            let pace = (PACE.0 + PACE.1 * normal(&mut random)).clamp(0.7, 1.7);
            Walker {
                place,
                velocity: [0.0, 0.0],
                heading: [1.0, 0.0],
                pace,
                phase: random.f64(),
                way: Vec::new(),
                rest_s: from_s + 1.3 * i as f64,
                room,
                stuck_s: 0.0,
                chair: None,
                outer: None,
                entered_s: None,
            }
        });
        let walkers: Vec<Walker> = walkers.collect();
        let mut crowd = Crowd {
            walkers,
            random,
            crossings: Vec::new(),
            passages: Vec::new(),
            restless,
            sits: if house.is_ideal { 0.0 } else { sits },
            house,
            chairs: if house.is_ideal { Vec::new() } else { CHAIRS.to_vec() },
            open: [0.0; 2],
            arrivals: Vec::new(),
            now_s: 0.0,
        };
        for i in 0..count {
            let (door, _) = doors(crowd.walkers[i].room);
            let inner = crowd.free_place(crowd.walkers[i].room);
            crowd.walkers[i].way = vec![(inner, 0.0), (door[2], 0.0), (door[1], 0.0), (door[0], 0.0)];
        }
        crowd
    }

    /// Whether the walker is not yet on his way.
    pub(crate) fn waits(&self, walker: usize) -> bool {
        let [x, _] = self.walkers[walker].place;
        self.walkers[walker].entered_s.is_none()
            && (CORRIDOR[0]..=CORRIDOR[1]).contains(&x)
            && self.now_s < 13.0 + 1.3 * walker as f64
    }

    fn free_place(&mut self, room: usize) -> Point {
        let [a, b, c, d] = FREE[room];
        loop {
            let place = [a + (c - a) * self.random.f64(), b + (d - b) * self.random.f64()];
            let is_clear = self.house.obstacles().all(|one| !within(one, 0.4, place));
            if is_clear && self.chairs.iter().all(|(chair, _)| distance(*chair, place) > 0.5) {
                return place;
            }
        }
    }

    pub(crate) fn step(&mut self, now_s: f64, dt: f64) {
        self.now_s = now_s;
        self.move_doors(dt);
        self.let_in(now_s);
        let places: Vec<Point> = self.walkers.iter().map(|walker| walker.place).collect();
        let inside = places.iter().filter(|place| (5.9..=11.1).contains(&place[0])).count();
        for i in 0..self.walkers.len() {
            if self.walkers[i].place == GONE {
                continue;
            }
            let waits = self.waits(i);
            if self.walkers[i].rest_s > 0.0 {
                self.walkers[i].rest_s -= dt;
                if self.walkers[i].rest_s <= 0.0 && self.walkers[i].way.is_empty() {
                    self.stand_up(i);
                }
            } else if self.walkers[i].way.is_empty() {
                self.plan(i, inside);
            }
            let gives_way = self.gives_way(i, &places);
            let (house, chairs) = (self.house, self.chairs.clone());
            let is_free = |place: Point| {
                FREE.iter().any(|free| within(free, 1e-9, place))
                    && house.obstacles().all(|one| !within(one, 0.3, place))
                    && chairs.iter().all(|(chair, _)| distance(*chair, place) > CHAIR_M)
            };
            let walker = &mut self.walkers[i];
            let mut wish = [0.0, 0.0];
            let rests = walker.rest_s > 0.0 || gives_way;
            if let (false, Some(&(goal, rest_s))) = (rests, walker.way.last()) {
                let off = distance(goal, walker.place);
                let seat = walker.chair.filter(|_| walker.way.len() == 1);
                if off < if seat.is_some() { 0.04 } else { 0.25 } {
                    walker.way.pop();
                    walker.rest_s = rest_s;
                    if let Some(chair) = seat {
                        self.chairs[chair] = moved(self.chairs[chair], &mut self.random);
                        let (sin, cos) = self.chairs[chair].1.sin_cos();
                        (walker.heading, walker.velocity) = ([cos, sin], [0.0, 0.0]);
                    }
                    if walker.way.is_empty() && walker.outer.is_some_and(|door| is_outside(door, goal)) {
                        walker.place = GONE;
                        let after_s = RETURNS_S.0 + (RETURNS_S.1 - RETURNS_S.0) * self.random.f64();
                        self.arrivals.push((now_s + after_s, self.random.usize(..OUTER.len())));
                        continue;
                    }
                } else {
                    let pace = walker.pace / off;
                    let pace = if seat.is_some() { pace.min(2.5) } else { pace };
                    wish = [pace * (goal[0] - walker.place[0]), pace * (goal[1] - walker.place[1])];
                }
            }
            for (j, other) in places.iter().enumerate() {
                let off = distance(*other, walker.place);
                let sits = rests && walker.chair.is_some();
                if i != j && off < 0.9 && off > 1e-6 && !waits && !sits {
                    let near = |x: f64| (walker.place[0] - x).abs() < 1.0;
                    let near_door = [0.0, 6.0, 11.0, 17.0].into_iter().any(near) && walker.chair.is_none();
                    let push = (0.9 - off) / off
                        * if near_door {
                            1.0
                        } else if rests {
                            1.5
                        } else {
                            4.0
                        };
                    // To the side as well, so that two who meet pass.
                    let away = [walker.place[0] - other[0], walker.place[1] - other[1]];
                    wish = [
                        wish[0] + push * (away[0] - 0.5 * away[1]),
                        wish[1] + push * (away[1] + 0.5 * away[0]),
                    ];
                }
            }
            let speed = (wish[0] * wish[0] + wish[1] * wish[1]).sqrt();
            let most = 1.3 * walker.pace;
            if speed > most {
                wish = [wish[0] * most / speed, wish[1] * most / speed];
            }
            for (speed, wish) in walker.velocity.iter_mut().zip(wish) {
                *speed += (wish - *speed) * (dt / 0.25);
            }
            let from = walker.place;
            let nearest = if walker.stuck_s > 1.0 { 0.35 } else { NEAREST_M };
            let bumps = |to: Point| {
                places.iter().enumerate().any(|(j, other)| {
                    let now = distance(*other, to);
                    i != j && now < nearest && now < distance(*other, from) && !waits
                })
            };
            for axis in 0..2 {
                let mut to = walker.place;
                to[axis] += walker.velocity[axis] * dt;
                if is_free(to) && !bumps(to) {
                    walker.place = to;
                } else {
                    walker.velocity[axis] = 0.0;
                    // Around a corner.
                    let mut aside = walker.place;
                    aside[1 - axis] += dt * 0.5 * if i % 2 == 0 { 1.0 } else { -1.0 };
                    if is_free(aside) && !rests && !bumps(aside) {
                        walker.place = aside;
                    }
                }
            }
            let speed = walker.velocity[0].hypot(walker.velocity[1]);
            if speed > 0.15 {
                walker.heading = [walker.velocity[0] / speed, walker.velocity[1] / speed];
                walker.phase += speed * dt / DOUBLE_STEP_M;
            }
            let went = distance(walker.place, from) / dt;
            walker.stuck_s =
                if went < 0.1 && walker.rest_s <= 0.0 && !waits { walker.stuck_s + dt } else { 0.0 };
            let is_stuck = walker.stuck_s > 1.5 && walker.way.len() == 1;
            self.note(i, from[0], now_s);
            let [x, _] = self.walkers[i].place;
            let is_in_room = (0.3..5.7).contains(&x) || (11.3..16.7).contains(&x);
            if is_stuck || self.walkers[i].stuck_s > 6.0 && is_in_room {
                let walker = &mut self.walkers[i];
                walker.stuck_s = 0.0;
                walker.way.clear();
                (walker.chair, walker.outer) = (None, None);
                walker.room = usize::from(x > 8.5);
            }
        }
    }

    /// Somebody comes through the door that this one wants to go through.
    fn gives_way(&self, i: usize, places: &[Point]) -> bool {
        let walker = &self.walkers[i];
        let Some((goal, _)) = walker.way.last() else { return false };
        let door = CORRIDOR.into_iter().find(|x| (goal[0] - x).abs() < 0.1);
        let before = door.filter(|x| (0.5..0.9).contains(&(walker.place[0] - x).abs()));
        before.is_some_and(|x| {
            let side = (walker.place[0] - x).signum();
            let comes = |j: usize| {
                let other = &self.walkers[j];
                let off = [places[j][0] - x, places[j][1] - 2.5];
                j != i && off[0].abs() < 1.0 && off[1].abs() < 0.7 && other.velocity[0] * side > 0.2
            };
            walker.stuck_s < 3.0 && (0..places.len()).any(comes)
        })
    }

    fn plan(&mut self, i: usize, inside: usize) {
        let room = self.walkers[i].room;
        if self.restless < 0.0 {
            let goal = self.free_place(room);
            self.walkers[i].way = vec![(goal, f64::INFINITY)];
            return;
        }
        self.walkers[i].outer = None;
        let waiting = if self.random.f64() < 0.4 { 2.0 + 18.0 * self.random.f64() } else { 0.0 };
        if !self.house.is_ideal && self.random.f64() < self.sits && self.sit_down(i) {
            return;
        }
        if !self.house.is_ideal && self.restless > 0.0 && self.random.f64() < LEAVES {
            self.walkers[i].outer = Some(room);
            let (x, out) = OUTER[room];
            let ways = [2.8, 0.8, 0.0, -0.8].map(|off| ([x + out * off, 2.5], 0.0));
            self.walkers[i].way = ways.to_vec();
            return;
        }
        if self.random.f64() < self.restless && inside < INSIDE {
            let other = 1 - room;
            let ((out, _), (into, _)) = (doors(room), doors(other));
            let goal = self.free_place(other);
            let stop = if self.random.f64() < STOPS.0 { STOPS.1 * self.random.f64() } else { 0.0 };
            let aside = 2.5 + 0.5 * (2.0 * self.random.f64() - 1.0);
            self.walkers[i].way = vec![
                (goal, waiting),
                (into[2], 0.0),
                (into[1], 0.0),
                (into[0], 0.0),
                ([8.5, aside], stop),
                (out[0], 0.0),
                (out[1], 0.0),
                (out[2], 0.0),
            ];
            self.walkers[i].room = other;
        } else {
            let goal = self.free_place(room);
            self.walkers[i].way = vec![(goal, waiting)];
        }
    }

    fn note(&mut self, i: usize, from_x: f64, now_s: f64) {
        let to_x = self.walkers[i].place[0];
        for (door, x) in CORRIDOR.into_iter().enumerate() {
            if (from_x < x) == (to_x < x) {
                continue;
            }
            let goes_in = (to_x > x) == (door == 0);
            self.passages.push((now_s, door, to_x > x));
            if goes_in {
                self.walkers[i].entered_s = Some(now_s);
            } else if let Some(entered_s) = self.walkers[i].entered_s.take() {
                self.crossings.push(Crossing { walker: i, entered_s, left_s: now_s });
            }
        }
        for (door, (x, out)) in OUTER.into_iter().enumerate() {
            if (from_x < x) != (to_x < x) {
                self.passages.push((now_s, FIRST_OUTER + door, (to_x - x) * out > 0.0));
            }
        }
    }

    /// Sends the person to a free chair of the room, if there is one.
    fn sit_down(&mut self, i: usize) -> bool {
        let room = self.walkers[i].room;
        let is_free = |&chair: &usize| {
            let [a, b, c, d] = FREE[room];
            within(&[a, b, c, d], 0.0, self.chairs[chair].0)
                && self.walkers.iter().all(|walker| walker.chair != Some(chair))
        };
        let free: Vec<usize> = (0..self.chairs.len()).filter(is_free).collect();
        // One who has just sat walks first.
        if free.is_empty() || self.walkers[i].chair.is_some() {
            self.walkers[i].chair = None;
            return false;
        }
        let chair = free[self.random.usize(..free.len())];
        let sits_s = SITS_S.0 + (SITS_S.1 - SITS_S.0) * self.random.f64();
        self.walkers[i].chair = Some(chair);
        let ahead = |m: f64| {
            let ([x, y], turn) = self.chairs[chair];
            [x + m * turn.cos(), y + m * turn.sin()]
        };
        self.walkers[i].way = vec![(ahead(SHINS_M), sits_s), (ahead(0.8), 0.0)];
        true
    }

    /// The person leaves the chair, which moves a little.
    fn stand_up(&mut self, i: usize) {
        if let Some(chair) = self.walkers[i].chair.take() {
            self.chairs[chair] = moved(self.chairs[chair], &mut self.random);
        }
    }

    fn move_doors(&mut self, dt: f64) {
        for (door, (x, _)) in OUTER.into_iter().enumerate() {
            let wants =
                |walker: &Walker| walker.outer == Some(door) && distance(walker.place, [x, 2.5]) < OPENS_M;
            let step = dt / OPENS_S * if self.walkers.iter().any(wants) { 1.0 } else { -1.0 };
            self.open[door] = (self.open[door] + step).clamp(0.0, 1.0);
        }
    }

    /// Adds the people who enter from the street by now.
    fn let_in(&mut self, now_s: f64) {
        while let Some(due) = self.arrivals.iter().position(|(at_s, _)| *at_s <= now_s) {
            let (_, door) = self.arrivals.swap_remove(due);
            let (x, out) = OUTER[door];
            let inner = self.free_place(door);
            let pace = (PACE.0 + PACE.1 * normal(&mut self.random)).clamp(0.7, 1.7);
            self.walkers.push(Walker {
                place: [x + out * 2.8, 2.5],
                velocity: [0.0, 0.0],
                heading: [-out, 0.0],
                pace,
                phase: self.random.f64(),
                way: [(inner, 0.0)]
                    .into_iter()
                    .chain([-0.8, 0.0, 0.8].map(|off| ([x + out * off, 2.5], 0.0)))
                    .collect(),
                rest_s: 0.0,
                room: door,
                stuck_s: 0.0,
                chair: None,
                outer: Some(door),
                entered_s: None,
            });
        }
    }

    /// Returns everything that moves: legs, chairs and the leaves of doors.
    pub(crate) fn shapes(&self) -> Vec<Shape> {
        let mut legs = Vec::new();
        self.legs(&mut legs);
        let mut shapes: Vec<Shape> = legs.into_iter().map(|leg| post(leg, LEG_M)).collect();
        shapes.extend(self.chairs.iter().flat_map(|&(center, turn)| chair_legs(center, turn)));
        if !self.house.is_ideal {
            // The one swings into the street, the other slides along the wall.
            let (sin, cos) = (85.0_f64.to_radians() * self.open[0]).sin_cos();
            shapes.push(wall([0.0, 2.0], [-sin, 2.0 + cos]));
            let y = 2.0 + 0.95 * self.open[1];
            shapes.push(wall([17.02, y], [17.02, y + 1.0]));
        }
        shapes
    }

    fn legs(&self, legs: &mut Vec<Point>) {
        for walker in self.walkers.iter().filter(|walker| walker.place != GONE) {
            let speed = walker.velocity[0].hypot(walker.velocity[1]);
            let swing = (speed / 0.6).min(1.0);
            let stride = swing * STRIDE_M * (std::f64::consts::TAU * walker.phase).sin();
            for side in [1.0, -1.0] {
                let [hx, hy] = walker.heading;
                legs.push([
                    walker.place[0] + side * (stride * hx - HIP_M * hy),
                    walker.place[1] + side * (stride * hy + HIP_M * hx),
                ]);
            }
        }
    }
}

/// The ways out of a room: before, in and behind its door, seen from the corridor; and the door's x.
fn doors(room: usize) -> ([Point; 3], f64) {
    match room {
        0 => ([[6.6, 2.5], [6.0, 2.5], [5.3, 2.5]], 6.0),
        _ => ([[10.4, 2.5], [11.0, 2.5], [11.7, 2.5]], 11.0),
    }
}

fn within([a, b, c, d]: &[f64; 4], margin: f64, [x, y]: Point) -> bool {
    x > a - margin && x < c + margin && y > b - margin && y < d + margin
}

/// Returns whether `place` is at the end of the way out by that door.
fn is_outside(door: usize, place: Point) -> bool {
    let (x, out) = OUTER[door];
    (place[0] - x) * out > 2.0
}

/// Returns a chair that was moved a little.
fn moved(([x, y], turn): (Point, f64), random: &mut fastrand::Rng) -> (Point, f64) {
    let mut off = |most: f64| most * (2.0 * random.f64() - 1.0);
    ([x + off(CHAIR_MOVES.0), y + off(CHAIR_MOVES.0)], turn + off(CHAIR_MOVES.1))
}
