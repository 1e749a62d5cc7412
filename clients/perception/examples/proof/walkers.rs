//! People of the proof: they walk, stand, sit down, stop on the way, give way to each other, change rooms through the
//! corridor, and leave and enter the house. Their behavior is a pure function of the seed.

use scanhub_perception::track::geometry::{Point, distance};
use scanhub_sim::Shape;

use crate::house::{CHAIRS, House, chair_legs, normal, post, wall};

pub(crate) const LEG_RADIUS_M: f64 = 0.06;
/// Half of the distance between the legs across the walking direction, and maximum distance of a foot ahead of the
/// body.
const HALF_HIP_WIDTH_M: f64 = 0.11;
const STRIDE_LEN_M: f64 = 0.25;
const DOUBLE_STEP_LEN_M: f64 = 1.4;
/// Mean and standard deviation of the walking speed in m/s.
pub(crate) const WALKING_SPEED: (f64, f64) = (1.15, 0.22);
/// Share of people who stop in the corridor, and maximum duration of the stop in seconds.
pub(crate) const STOP_SHARE: (f64, f64) = (0.15, 8.0);
const INSIDE_ROOM: usize = 3;
pub(crate) const CORRIDOR_X: [f64; 2] = [6.0, 11.0];

/// Minimum distance between two people in meters.
const MIN_DISTANCE_M: f64 = 0.55;

/// Free parts of the plan: minimum x and y, maximum x and y.
const FREE_AREAS: [[f64; 4]; 9] = [
    [0.35, 0.35, 5.65, 4.65],
    [11.35, 0.35, 16.65, 4.65],
    [6.3, 1.8, 10.7, 3.2],
    [5.6, 2.2, 6.4, 2.8],
    [10.6, 2.2, 11.4, 2.8],
    // Areas of the doors that lead outside, and of the street.
    [-0.4, 2.2, 0.4, 2.8],
    [16.6, 2.2, 17.4, 2.8],
    [-3.4, 0.5, -0.35, 4.5],
    [17.35, 0.5, 20.4, 4.5],
];
/// Doors that lead outside: x, and the direction of the street.
const OUTER_DOORS: [(f64, f64); 2] = [(0.0, -1.0), (17.0, 1.0)];
/// Index in the site of the first door that leads outside.
const FIRST_OUTER_DOOR: usize = 2;
/// Share of paths that lead outside, and minimum and maximum time after which another person enters, in seconds.
const LEAVE_SHARE: f64 = 0.06;
const RETURN_TIME_S: (f64, f64) = (3.0, 12.0);
/// Distance in meters at which a door opens for a person who wants to pass, and the duration of the opening in seconds.
const DOOR_OPEN_DISTANCE_M: f64 = 1.4;
const DOOR_OPEN_TIME_S: f64 = 0.9;
/// Distance of the shins of a sitting person from the center of the chair in meters. The front edge of the seat is at
/// 0.2 m.
const SHIN_DISTANCE_M: f64 = 0.36;
/// Maximum distance by which a sitting person moves the chair along each axis in meters, and maximum rotation in
/// radians.
const MAX_CHAIR_MOVE: (f64, f64) = (0.05, 0.15);
/// Minimum distance of a walker from the center of a chair in meters.
const MIN_CHAIR_DISTANCE_M: f64 = 0.3;
/// Minimum and maximum duration of sitting in seconds.
const SIT_TIME_S: (f64, f64) = (10.0, 40.0);
/// Position of people who have left.
const OUTSIDE_POSITION: Point = [-1000.0, -1000.0];

pub(crate) struct Walker {
    pub(crate) position: Point,
    velocity: Point,
    heading: Point,
    pub(crate) speed: f64,
    /// Phase of the walk in double steps.
    phase: f64,
    path: Vec<(Point, f64)>,
    pause_s: f64,
    room: usize,
    /// Time for which the person has been unable to move on, in seconds.
    blocked_s: f64,
    /// Chair on which the person sits, or to which they walk.
    chair: Option<usize>,
    /// Outer door that the person wants to pass.
    outer_door: Option<usize>,
    /// Time at which the person entered the corridor; `None` outside the corridor.
    pub(crate) entered_s: Option<f64>,
}

/// A passage of a person through the corridor, from one side to the other.
pub(crate) struct Crossing {
    pub(crate) walker: usize,
    pub(crate) entered_s: f64,
    pub(crate) left_s: f64,
}

pub(crate) struct Crowd {
    pub(crate) walkers: Vec<Walker>,
    random: fastrand::Rng,
    pub(crate) crossings: Vec<Crossing>,
    /// Passages of doors: time, door, and whether the person came from the room that the site names first.
    pub(crate) passages: Vec<(f64, usize, bool)>,
    /// Share of rests that end with a change of the room. If it is negative, people stay at their first position.
    room_change_share: f64,
    /// Share of rests on a chair.
    sit_share: f64,
    house: House,
    /// Center and direction of each chair.
    chairs: Vec<(Point, f64)>,
    /// Opening of the doors to the street, 0 to 1.
    door_openings: [f64; 2],
    /// Times at which new people enter, with the index of the door.
    arrivals: Vec<(f64, usize)>,
    now_s: f64,
}

impl Crowd {
    /// Creates the people, who start in the corridor or in front of it, one after the other from second `from_s` on.
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
            let position = [8.5 + 0.3 * (i as f64 % 4.0 - 1.5), 2.0 + 0.1 * (i as f64 % 10.0)];
            let speed = (WALKING_SPEED.0 + WALKING_SPEED.1 * normal(&mut random)).clamp(0.7, 1.7);
            Walker {
                position,
                velocity: [0.0, 0.0],
                heading: [1.0, 0.0],
                speed,
                phase: random.f64(),
                path: Vec::new(),
                pause_s: from_s + 1.3 * i as f64,
                room,
                blocked_s: 0.0,
                chair: None,
                outer_door: None,
                entered_s: None,
            }
        });
        let walkers: Vec<Walker> = walkers.collect();
        let mut crowd = Crowd {
            walkers,
            random,
            crossings: Vec::new(),
            passages: Vec::new(),
            room_change_share: restless,
            sit_share: if house.is_ideal { 0.0 } else { sits },
            house,
            chairs: if house.is_ideal { Vec::new() } else { CHAIRS.to_vec() },
            door_openings: [0.0; 2],
            arrivals: Vec::new(),
            now_s: 0.0,
        };
        for i in 0..count {
            let (door, _) = doors(crowd.walkers[i].room);
            let inner = crowd.free_position(crowd.walkers[i].room);
            crowd.walkers[i].path = vec![(inner, 0.0), (door[2], 0.0), (door[1], 0.0), (door[0], 0.0)];
        }
        crowd
    }

    /// Returns whether the walker has not started yet.
    pub(crate) fn is_waiting(&self, walker: usize) -> bool {
        let [x, _] = self.walkers[walker].position;
        self.walkers[walker].entered_s.is_none()
            && (CORRIDOR_X[0]..=CORRIDOR_X[1]).contains(&x)
            && self.now_s < 13.0 + 1.3 * walker as f64
    }

    fn free_position(&mut self, room: usize) -> Point {
        let [a, b, c, d] = FREE_AREAS[room];
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
        self.admit_arrivals(now_s);
        let places: Vec<Point> = self.walkers.iter().map(|walker| walker.position).collect();
        let inside = places.iter().filter(|place| (5.9..=11.1).contains(&place[0])).count();
        for i in 0..self.walkers.len() {
            if self.walkers[i].position == OUTSIDE_POSITION {
                continue;
            }
            let waits = self.is_waiting(i);
            if self.walkers[i].pause_s > 0.0 {
                self.walkers[i].pause_s -= dt;
                if self.walkers[i].pause_s <= 0.0 && self.walkers[i].path.is_empty() {
                    self.stand_up(i);
                }
            } else if self.walkers[i].path.is_empty() {
                self.plan_path(i, inside);
            }
            let gives_way = self.must_wait(i, &places);
            let (house, chairs) = (self.house, self.chairs.clone());
            let is_free = |place: Point| {
                FREE_AREAS.iter().any(|free| within(free, 1e-9, place))
                    && house.obstacles().all(|one| !within(one, 0.3, place))
                    && chairs.iter().all(|(chair, _)| distance(*chair, place) > MIN_CHAIR_DISTANCE_M)
            };
            let walker = &mut self.walkers[i];
            let mut desired_velocity = [0.0, 0.0];
            let is_resting = walker.pause_s > 0.0 || gives_way;
            if let (false, Some(&(goal, rest_s))) = (is_resting, walker.path.last()) {
                let off = distance(goal, walker.position);
                let own_chair = walker.chair.filter(|_| walker.path.len() == 1);
                if off < if own_chair.is_some() { 0.04 } else { 0.25 } {
                    walker.path.pop();
                    walker.pause_s = rest_s;
                    if let Some(chair) = own_chair {
                        self.chairs[chair] = move_chair(self.chairs[chair], &mut self.random);
                        let (sin, cos) = self.chairs[chair].1.sin_cos();
                        (walker.heading, walker.velocity) = ([cos, sin], [0.0, 0.0]);
                    }
                    if walker.path.is_empty() && walker.outer_door.is_some_and(|door| is_outside(door, goal))
                    {
                        walker.position = OUTSIDE_POSITION;
                        let after_s =
                            RETURN_TIME_S.0 + (RETURN_TIME_S.1 - RETURN_TIME_S.0) * self.random.f64();
                        self.arrivals.push((now_s + after_s, self.random.usize(..OUTER_DOORS.len())));
                        continue;
                    }
                } else {
                    let pace = walker.speed / off;
                    let pace = if own_chair.is_some() { pace.min(2.5) } else { pace };
                    desired_velocity =
                        [pace * (goal[0] - walker.position[0]), pace * (goal[1] - walker.position[1])];
                }
            }
            for (j, other) in places.iter().enumerate() {
                let off = distance(*other, walker.position);
                let sits = is_resting && walker.chair.is_some();
                if i != j && off < 0.9 && off > 1e-6 && !waits && !sits {
                    let near = |x: f64| (walker.position[0] - x).abs() < 1.0;
                    let near_door = [0.0, 6.0, 11.0, 17.0].into_iter().any(near) && walker.chair.is_none();
                    let push = (0.9 - off) / off
                        * if near_door {
                            1.0
                        } else if is_resting {
                            1.5
                        } else {
                            4.0
                        };
                    // Push sideways too, so that two people who meet can pass.
                    let away = [walker.position[0] - other[0], walker.position[1] - other[1]];
                    desired_velocity = [
                        desired_velocity[0] + push * (away[0] - 0.5 * away[1]),
                        desired_velocity[1] + push * (away[1] + 0.5 * away[0]),
                    ];
                }
            }
            let speed = (desired_velocity[0] * desired_velocity[0]
                + desired_velocity[1] * desired_velocity[1])
                .sqrt();
            let maximum = 1.3 * walker.speed;
            if speed > maximum {
                desired_velocity =
                    [desired_velocity[0] * maximum / speed, desired_velocity[1] * maximum / speed];
            }
            for (speed, wish) in walker.velocity.iter_mut().zip(desired_velocity) {
                *speed += (wish - *speed) * (dt / 0.25);
            }
            let from = walker.position;
            let nearest = if walker.blocked_s > 1.0 { 0.35 } else { MIN_DISTANCE_M };
            let bumps = |to: Point| {
                places.iter().enumerate().any(|(j, other)| {
                    let now = distance(*other, to);
                    i != j && now < nearest && now < distance(*other, from) && !waits
                })
            };
            for axis in 0..2 {
                let mut to = walker.position;
                to[axis] += walker.velocity[axis] * dt;
                if is_free(to) && !bumps(to) {
                    walker.position = to;
                } else {
                    walker.velocity[axis] = 0.0;
                    // Walk around a corner.
                    let mut aside = walker.position;
                    aside[1 - axis] += dt * 0.5 * if i % 2 == 0 { 1.0 } else { -1.0 };
                    if is_free(aside) && !is_resting && !bumps(aside) {
                        walker.position = aside;
                    }
                }
            }
            let speed = walker.velocity[0].hypot(walker.velocity[1]);
            if speed > 0.15 {
                walker.heading = [walker.velocity[0] / speed, walker.velocity[1] / speed];
                walker.phase += speed * dt / DOUBLE_STEP_LEN_M;
            }
            let went = distance(walker.position, from) / dt;
            walker.blocked_s =
                if went < 0.1 && walker.pause_s <= 0.0 && !waits { walker.blocked_s + dt } else { 0.0 };
            let is_stuck = walker.blocked_s > 1.5 && walker.path.len() == 1;
            self.note_crossing(i, from[0], now_s);
            let [x, _] = self.walkers[i].position;
            let is_in_room = (0.3..5.7).contains(&x) || (11.3..16.7).contains(&x);
            if is_stuck || self.walkers[i].blocked_s > 6.0 && is_in_room {
                let walker = &mut self.walkers[i];
                walker.blocked_s = 0.0;
                walker.path.clear();
                (walker.chair, walker.outer_door) = (None, None);
                walker.room = usize::from(x > 8.5);
            }
        }
    }

    /// Returns whether another person comes through the door to which person `i` walks.
    fn must_wait(&self, i: usize, positions: &[Point]) -> bool {
        let walker = &self.walkers[i];
        let Some((goal, _)) = walker.path.last() else { return false };
        let door = CORRIDOR_X.into_iter().find(|x| (goal[0] - x).abs() < 0.1);
        let before = door.filter(|x| (0.5..0.9).contains(&(walker.position[0] - x).abs()));
        before.is_some_and(|x| {
            let side = (walker.position[0] - x).signum();
            let comes = |j: usize| {
                let other = &self.walkers[j];
                let off = [positions[j][0] - x, positions[j][1] - 2.5];
                j != i && off[0].abs() < 1.0 && off[1].abs() < 0.7 && other.velocity[0] * side > 0.2
            };
            walker.blocked_s < 3.0 && (0..positions.len()).any(comes)
        })
    }

    fn plan_path(&mut self, i: usize, inside: usize) {
        let room = self.walkers[i].room;
        if self.room_change_share < 0.0 {
            let goal = self.free_position(room);
            self.walkers[i].path = vec![(goal, f64::INFINITY)];
            return;
        }
        self.walkers[i].outer_door = None;
        let waiting = if self.random.f64() < 0.4 { 2.0 + 18.0 * self.random.f64() } else { 0.0 };
        if !self.house.is_ideal && self.random.f64() < self.sit_share && self.sit_down(i) {
            return;
        }
        if !self.house.is_ideal && self.room_change_share > 0.0 && self.random.f64() < LEAVE_SHARE {
            self.walkers[i].outer_door = Some(room);
            let (x, out) = OUTER_DOORS[room];
            let path = [2.8, 0.8, 0.0, -0.8].map(|off| ([x + out * off, 2.5], 0.0));
            self.walkers[i].path = path.to_vec();
            return;
        }
        if self.random.f64() < self.room_change_share && inside < INSIDE_ROOM {
            let other = 1 - room;
            let ((out, _), (into, _)) = (doors(room), doors(other));
            let goal = self.free_position(other);
            let stop = if self.random.f64() < STOP_SHARE.0 { STOP_SHARE.1 * self.random.f64() } else { 0.0 };
            let aside = 2.5 + 0.5 * (2.0 * self.random.f64() - 1.0);
            self.walkers[i].path = vec![
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
            let goal = self.free_position(room);
            self.walkers[i].path = vec![(goal, waiting)];
        }
    }

    fn note_crossing(&mut self, i: usize, from_x: f64, now_s: f64) {
        let to_x = self.walkers[i].position[0];
        for (door, x) in CORRIDOR_X.into_iter().enumerate() {
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
        for (door, (x, out)) in OUTER_DOORS.into_iter().enumerate() {
            if (from_x < x) != (to_x < x) {
                self.passages.push((now_s, FIRST_OUTER_DOOR + door, (to_x - x) * out > 0.0));
            }
        }
    }

    /// Sends person `i` to a free chair in the room. Returns false if no chair is free, or if the person has just sat
    /// on one.
    fn sit_down(&mut self, i: usize) -> bool {
        let room = self.walkers[i].room;
        let is_free = |&chair: &usize| {
            let [a, b, c, d] = FREE_AREAS[room];
            within(&[a, b, c, d], 0.0, self.chairs[chair].0)
                && self.walkers.iter().all(|walker| walker.chair != Some(chair))
        };
        let free: Vec<usize> = (0..self.chairs.len()).filter(is_free).collect();
        // A person who has just sat on a chair walks before they sit down again.
        if free.is_empty() || self.walkers[i].chair.is_some() {
            self.walkers[i].chair = None;
            return false;
        }
        let chair = free[self.random.usize(..free.len())];
        let sits_s = SIT_TIME_S.0 + (SIT_TIME_S.1 - SIT_TIME_S.0) * self.random.f64();
        self.walkers[i].chair = Some(chair);
        let ahead = |m: f64| {
            let ([x, y], yaw_rad) = self.chairs[chair];
            [x + m * yaw_rad.cos(), y + m * yaw_rad.sin()]
        };
        self.walkers[i].path = vec![(ahead(SHIN_DISTANCE_M), sits_s), (ahead(0.8), 0.0)];
        true
    }

    /// Ends the rest of person `i` on a chair, and moves the chair a little.
    fn stand_up(&mut self, i: usize) {
        if let Some(chair) = self.walkers[i].chair.take() {
            self.chairs[chair] = move_chair(self.chairs[chair], &mut self.random);
        }
    }

    fn move_doors(&mut self, dt: f64) {
        for (door, (x, _)) in OUTER_DOORS.into_iter().enumerate() {
            let wants = |walker: &Walker| {
                walker.outer_door == Some(door) && distance(walker.position, [x, 2.5]) < DOOR_OPEN_DISTANCE_M
            };
            let step = dt / DOOR_OPEN_TIME_S * if self.walkers.iter().any(wants) { 1.0 } else { -1.0 };
            self.door_openings[door] = (self.door_openings[door] + step).clamp(0.0, 1.0);
        }
    }

    /// Adds the people who have entered from the street by now.
    fn admit_arrivals(&mut self, now_s: f64) {
        while let Some(due) = self.arrivals.iter().position(|(at_s, _)| *at_s <= now_s) {
            let (_, door) = self.arrivals.swap_remove(due);
            let (x, out) = OUTER_DOORS[door];
            let inner = self.free_position(door);
            let speed = (WALKING_SPEED.0 + WALKING_SPEED.1 * normal(&mut self.random)).clamp(0.7, 1.7);
            self.walkers.push(Walker {
                position: [x + out * 2.8, 2.5],
                velocity: [0.0, 0.0],
                heading: [-out, 0.0],
                speed,
                phase: self.random.f64(),
                path: [(inner, 0.0)]
                    .into_iter()
                    .chain([-0.8, 0.0, 0.8].map(|off| ([x + out * off, 2.5], 0.0)))
                    .collect(),
                pause_s: 0.0,
                room: door,
                blocked_s: 0.0,
                chair: None,
                outer_door: Some(door),
                entered_s: None,
            });
        }
    }

    /// Returns all moving objects: legs, chairs and the leaves of doors.
    pub(crate) fn shapes(&self) -> Vec<Shape> {
        let mut legs = Vec::new();
        self.legs(&mut legs);
        let mut shapes: Vec<Shape> = legs.into_iter().map(|leg| post(leg, LEG_RADIUS_M)).collect();
        shapes.extend(self.chairs.iter().flat_map(|&(center, yaw_rad)| chair_legs(center, yaw_rad)));
        if !self.house.is_ideal {
            // One door swings toward the street, and the other slides along the wall.
            let (sin, cos) = (85.0_f64.to_radians() * self.door_openings[0]).sin_cos();
            shapes.push(wall([0.0, 2.0], [-sin, 2.0 + cos]));
            let y = 2.0 + 0.95 * self.door_openings[1];
            shapes.push(wall([17.02, y], [17.02, y + 1.0]));
        }
        shapes
    }

    fn legs(&self, legs: &mut Vec<Point>) {
        for walker in self.walkers.iter().filter(|walker| walker.position != OUTSIDE_POSITION) {
            let speed = walker.velocity[0].hypot(walker.velocity[1]);
            let swing = (speed / 0.6).min(1.0);
            let stride = swing * STRIDE_LEN_M * (std::f64::consts::TAU * walker.phase).sin();
            for side in [1.0, -1.0] {
                let [hx, hy] = walker.heading;
                legs.push([
                    walker.position[0] + side * (stride * hx - HALF_HIP_WIDTH_M * hy),
                    walker.position[1] + side * (stride * hy + HALF_HIP_WIDTH_M * hx),
                ]);
            }
        }
    }
}

/// Returns three points on the path from the corridor into a room: in front of the room's door, in the door, and behind
/// the door. Also returns the door's x.
fn doors(room: usize) -> ([Point; 3], f64) {
    match room {
        0 => ([[6.6, 2.5], [6.0, 2.5], [5.3, 2.5]], 6.0),
        _ => ([[10.4, 2.5], [11.0, 2.5], [11.7, 2.5]], 11.0),
    }
}

fn within([a, b, c, d]: &[f64; 4], margin: f64, [x, y]: Point) -> bool {
    x > a - margin && x < c + margin && y > b - margin && y < d + margin
}

/// Returns whether `position` is at the end of the path that leads outside through `door`.
fn is_outside(door: usize, position: Point) -> bool {
    let (x, out) = OUTER_DOORS[door];
    (position[0] - x) * out > 2.0
}

/// Returns a chair whose position has changed a little.
fn move_chair(([x, y], turn): (Point, f64), random: &mut fastrand::Rng) -> (Point, f64) {
    let mut off = |maximum: f64| maximum * (2.0 * random.f64() - 1.0);
    ([x + off(MAX_CHAIR_MOVE.0), y + off(MAX_CHAIR_MOVE.0)], turn + off(MAX_CHAIR_MOVE.1))
}
