//! A scene as data: its sensors, objects and people, the times at which objects and people are present, and their
//! motion. Lengths are in millimeters, in the frame of the world. Times are in seconds. Every position is a function of
//! time and a seed, so that two sensors, a test and a bench see the same person at the same position.

use std::f64::consts::TAU;

use crate::beam::NoiseModel;
use crate::mount::Mount;
use crate::shape::{Heights, Point, Pose, Shape};

/// A scene that was parsed.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The sensors in the scene.
    pub(crate) sensors: Vec<Sensor>,
    pub(crate) noise: NoiseModel,
    pub(crate) objects: Vec<Object>,
    pub(crate) people: Vec<PersonSpec>,
    pub(crate) suns: Vec<Sun>,
}

/// A sensor in a scene.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Sensor {
    /// Pose of the sensor, or of its mount if it has one. With a rotation of 0, the sensor points along x.
    pub(crate) pose: Pose,
    /// Mount that tilts the sensor. A sensor without a mount measures level, and sees objects of every height.
    pub(crate) mount: Option<Mount>,
}

/// Kind of a surface, by its reflection of beams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Surface {
    Plain,
    Dark,
    Reflector,
    /// Glass, which reflects a beam only at a right angle. Other beams pass through.
    Glass,
    /// A glossy or oblique surface that reflects only few beams.
    Faint,
}

/// An object: a wall, a piece of furniture, a box or a door.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Object {
    /// Outline in the object's own frame.
    pub(crate) shapes: Vec<Shape>,
    /// Heights, for tilted sensors.
    pub(crate) heights: Heights,
    /// Whether the shapes are the four sides of a box.
    pub(crate) is_box: bool,
    pub(crate) pose: Pose,
    pub(crate) surface: Surface,
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
    /// Moves while the object is present, in the order of time. They do not overlap.
    pub(crate) moves: Vec<Movement>,
    /// Time from the first move until all moves start again, in seconds; `None` if they happen once. The last move must
    /// end within this time, at the pose at which the first move began.
    pub(crate) repeat_s: Option<f64>,
    /// Maximum distance by which the object is displaced along each axis, drawn from the seed.
    pub(crate) jitter_mm: f64,
}

/// A move of an object, at a constant speed from one time to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Movement {
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
    pub(crate) offset: Pose,
}

/// A sun that dazzles a sector of a sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Sun {
    /// First angle of the sector, in degrees counterclockwise from ahead of the sensor.
    pub(crate) from_deg: f64,
    pub(crate) to_deg: f64,
    pub(crate) from_s: f64,
    pub(crate) until_s: f64,
    /// Share of the beams in the sector that are dazzled, 0 to 1.
    pub(crate) share: f64,
}

/// Pose of an object, and the time at which the object arrived at the pose or left it.
pub(crate) struct Presence {
    pub(crate) pose: Pose,
    pub(crate) since_s: f64,
}

impl Object {
    /// Returns whether the object never changes.
    pub(crate) fn is_still(&self) -> bool {
        self.from_s <= 0.0 && self.until_s.is_infinite() && self.moves.is_empty()
    }

    /// Returns the pose at `time_s`, and the time at which the object arrived at this pose. This time is 0 if the
    /// object has had this pose from the start, and `time_s` while the object moves. Returns `None` while the object is
    /// not present.
    pub(crate) fn at(&self, time_s: f64) -> Option<Presence> {
        let start = Presence { pose: self.pose, since_s: self.from_s.max(0.0) };
        let last = |_, presence: Presence| presence;
        (self.from_s..self.until_s)
            .contains(&time_s)
            .then(|| self.poses(time_s, self.round(time_s)).fold(start, last))
    }

    /// Returns the poses that the object has left by `time_s`, with the times at which it left them. If the moves
    /// repeat, returns only the poses of the current and the previous repetition.
    pub(crate) fn previous_presences(&self, time_s: f64) -> Vec<Presence> {
        let round = self.round(time_s);
        let rounds = if round > 0.0 { vec![round - 1.0, round] } else { vec![round] };
        let mut presences = Vec::new();
        let mut pose = self.pose;
        for next in rounds.into_iter().flat_map(|round| self.poses(time_s, round)) {
            presences.push(Presence { pose, since_s: next.since_s });
            pose = next.pose;
        }
        if self.until_s <= time_s {
            presences.push(Presence { pose, since_s: self.until_s });
        }
        presences
    }

    /// Returns how often the moves have been repeated at `time_s`.
    fn round(&self, time_s: f64) -> f64 {
        match (self.moves.first(), self.repeat_s) {
            (Some(first), Some(repeat_s)) => ((time_s - first.from_s) / repeat_s).floor().max(0.0),
            _ => 0.0,
        }
    }

    /// Returns the pose after each move of repetition `round` that has begun by `time_s`, with the time at which the
    /// object arrived at the pose. If the move has not ended, the pose and the time are those of `time_s`.
    fn poses(&self, time_s: f64, round: f64) -> impl Iterator<Item = Presence> {
        let offset_s = round * self.repeat_s.unwrap_or(0.0);
        let started = self.moves.iter().take_while(move |movement| movement.from_s + offset_s <= time_s);
        started.scan(self.pose, move |pose, movement| {
            *pose = moved(*pose, movement, time_s - offset_s);
            Some(Presence { pose: *pose, since_s: (movement.until_s + offset_s).min(time_s) })
        })
    }
}

/// Returns the pose at `time_s` of an object that was at `pose` before `movement`.
fn moved(pose: Pose, movement: &Movement, time_s: f64) -> Pose {
    let lasts_s = movement.until_s - movement.from_s;
    let share = if lasts_s > 0.0 { ((time_s - movement.from_s) / lasts_s).clamp(0.0, 1.0) } else { 1.0 };
    Pose {
        x_mm: pose.x_mm + share * movement.offset.x_mm,
        y_mm: pose.y_mm + share * movement.offset.y_mm,
        turn_deg: pose.turn_deg + share * movement.offset.turn_deg,
    }
}

impl Sun {
    /// Returns the share of the beams at `angle_mdeg` that are dazzled at `time_s`.
    pub(crate) fn share(&self, angle_mdeg: i32, time_s: f64) -> f64 {
        let angle_deg = f64::from(angle_mdeg) / 1000.0;
        let shines = (self.from_s..self.until_s).contains(&time_s);
        let meets = (self.from_deg..=self.to_deg).contains(&angle_deg);
        if shines && meets { self.share } else { 0.0 }
    }
}

/// Description of a person in a scene.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PersonSpec {
    /// Path of the person.
    pub(crate) path: WalkPath,
    /// Time at which the person appears.
    pub(crate) from_s: f64,
    /// Time at which the person disappears.
    pub(crate) until_s: f64,
    /// Maximum distance by which each corner of the path is displaced along each axis, drawn from the seed.
    pub(crate) jitter_mm: f64,
    /// Radius of a leg with its trousers.
    pub(crate) leg_mm: f64,
}

/// Path of a person.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum WalkPath {
    /// A closed curve within `reach` of `centre`, whose course is drawn from the seed.
    Roam { centre: Point, reach: Point },
    /// A polyline of corners, with a pause at each corner. After the last corner, the person disappears. If the path
    /// `repeats`, the person walks to the first corner instead.
    Path { corners: Vec<Corner>, speed: Speed, repeats: bool },
}

/// A corner of a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Corner {
    pub(crate) point: Point,
    /// Time that the person spends at this corner, in seconds.
    pub(crate) pause_s: f64,
    /// Direction that the person faces while they sit at this corner, in degrees counterclockwise from x. `None` if
    /// they stand at this corner.
    pub(crate) seat_deg: Option<f64>,
}

/// Speed of a person on a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Speed {
    /// A speed between these bounds, in millimeters per second, drawn from the seed.
    Between(f64, f64),
    /// The speed with which the person reaches the end of the path, after all pauses, when they disappear.
    ToEnd,
}

/// A person whose path a seed has drawn.
#[derive(Clone, Debug)]
pub(crate) struct Person {
    from_s: f64,
    until_s: f64,
    leg_mm: f64,
    /// Phase of the gait at the start, in double steps.
    phase: f64,
    course: Course,
}

#[derive(Clone, Debug)]
enum Course {
    /// A closed curve. `frequency` is the number of cycles per second along the two axes.
    Roam { centre: Point, reach: Point, frequency: Point, phase: Point },
    /// A polyline. `knots` has two entries for each corner, before and after the pause: time, position, and the
    /// distance that the person has walked. If the path `repeats`, the entries describe one lap.
    Path { knots: Vec<(f64, Point, f64)>, seats: Vec<Seat>, repeats: bool },
}

/// A pause during which a person sits.
#[derive(Clone, Copy, Debug)]
struct Seat {
    from_s: f64,
    until_s: f64,
    faces_deg: f64,
}

impl Seat {
    /// Returns 0 if the person stands at `time_s`, 1 if they sit, and a value between while they sit down or stand up.
    fn share(&self, time_s: f64) -> f64 {
        ((time_s - self.from_s).min(self.until_s - time_s) / SIT_DOWN_S).clamp(0.0, 1.0)
    }
}

/// Pose of a body.
struct BodyPose {
    position: Point,
    /// Direction that the person faces, as a unit vector.
    heading: Point,
    /// Number of double steps so far.
    step: f64,
    /// 0 if the person stands or walks, 1 if they sit, and a value between while they sit down or stand up.
    seated: f64,
}

impl Person {
    /// Creates a person as `plan` describes, with random parts from `random`.
    pub(crate) fn new(plan: &PersonSpec, random: &mut fastrand::Rng) -> Person {
        let phase = random.f64();
        let PersonSpec { from_s, until_s, jitter_mm, leg_mm, .. } = *plan;
        let course = match plan.path {
            WalkPath::Roam { centre, reach } => {
                // The peak speed is 2 pi * reach * frequency. It is 0.5 to 1.3 m/s, like the speed of people indoors.
                let mut frequency = |reach: f64| (500.0 + 800.0 * random.f64()) / (TAU * reach);
                let frequency = (frequency(reach.0), frequency(reach.1));
                Course::Roam { centre, reach, frequency, phase: (random.f64(), random.f64()) }
            }
            WalkPath::Path { ref corners, speed, repeats } => {
                let mut corners = corners.clone();
                for corner in &mut corners {
                    corner.point = jittered(corner.point, jitter_mm, random);
                }
                if repeats {
                    corners.push(Corner { pause_s: 0.0, seat_deg: None, ..corners[0] });
                }
                let rest_s: f64 = corners.iter().map(|corner| corner.pause_s).sum();
                let length = length(&corners);
                let speed = match speed {
                    Speed::Between(slowest, fastest) => slowest + (fastest - slowest) * random.f64(),
                    Speed::ToEnd => length / (until_s - from_s - rest_s),
                };
                let knots = course(&corners, from_s, speed);
                Course::Path { seats: seats(&corners, &knots), knots, repeats }
            }
        };
        // A person with a speed disappears at the end of the path.
        let until_s = match (&plan.path, &course) {
            (
                WalkPath::Path { speed: Speed::Between(..), .. },
                Course::Path { knots, repeats: false, .. },
            ) => knots.last().map_or(until_s, |knot| knot.0),
            _ => until_s,
        };
        Person { from_s, until_s, leg_mm, phase, course }
    }

    /// Returns both legs at `time_s`, as a sensor at the height of the shins sees them. Returns `None` while the person
    /// is not present.
    pub(crate) fn legs(&self, time_s: f64) -> Option<[Shape; 2]> {
        self.body_pose(time_s).map(|pose| self.legs_of(&pose))
    }

    /// Returns legs, trunk and head at `time_s`, with their heights.
    pub(crate) fn body(&self, time_s: f64) -> Option<[(Shape, Heights); 4]> {
        let pose = self.body_pose(time_s)?;
        let [left, right] = self.legs_of(&pose);
        let part = |shape, from_mm, to_mm| (shape, Heights { from_mm, to_mm });
        let upper = |radius| Shape::Post { centre: pose.position, radius };
        let [crotch, neck, crown] =
            [CROTCH_MM, NECK_MM, CROWN_MM].map(|height| height - pose.seated * (CROTCH_MM - SEAT_MM));
        Some([
            part(left, 0.0, crotch),
            part(right, 0.0, crotch),
            part(upper(TRUNK_MM), crotch, neck),
            part(upper(HEAD_MM), neck, crown),
        ])
    }

    fn body_pose(&self, time_s: f64) -> Option<BodyPose> {
        (self.from_s..self.until_s).contains(&time_s).then(|| self.course.body_pose(time_s))
    }

    fn legs_of(&self, pose: &BodyPose) -> [Shape; 2] {
        let BodyPose { position, heading, step, seated } = *pose;
        let stride = (1.0 - seated) * STRIDE_MM * (TAU * (step + self.phase)).sin();
        [1.0, -1.0].map(|side| {
            let (along, across) = (seated * FEET_AHEAD_MM + side * stride, side * HIP_MM);
            Shape::Post {
                centre: (
                    position.0 + along * heading.0 - across * heading.1,
                    position.1 + along * heading.1 + across * heading.0,
                ),
                radius: self.leg_mm,
            }
        })
    }
}

impl Course {
    fn body_pose(&self, time_s: f64) -> BodyPose {
        match self {
            Course::Roam { centre, reach, frequency, phase } => {
                let cycle = |frequency: f64, phase: f64| (TAU * (frequency * time_s + phase)).sin_cos();
                let (sin_x, cos_x) = cycle(frequency.0, phase.0);
                let (sin_y, cos_y) = cycle(frequency.1, phase.1);
                let heading = (frequency.0 * reach.0 * cos_x, frequency.1 * reach.1 * cos_y);
                let position = (centre.0 + reach.0 * sin_x, centre.1 + reach.1 * sin_y);
                BodyPose { position, heading: unit(heading), step: STEPS_HZ * time_s, seated: 0.0 }
            }
            Course::Path { knots, seats, repeats } => {
                let (first, last) = (knots[0], knots[knots.len() - 1]);
                let lap_s = last.0 - first.0;
                let laps = if *repeats { ((time_s - first.0) / lap_s).floor() } else { 0.0 };
                let time_s = time_s - laps * lap_s;
                let next = knots.partition_point(|knot| knot.0 <= time_s).clamp(1, knots.len() - 1);
                let ((t0, a, s0), (t1, b, s1)) = (knots[next - 1], knots[next]);
                let share = if t1 > t0 { ((time_s - t0) / (t1 - t0)).min(1.0) } else { 1.0 };
                let seat = seats.iter().find(|seat| (seat.from_s..seat.until_s).contains(&time_s));
                // A person who pauses faces in the direction of the next part of the path. At the end of the path, they
                // face in the direction of the last part. A person who sits down turns from the direction of the
                // previous part to the direction of the seat, and when they stand up, to that of the next part.
                let is_arriving = seat.is_some_and(|seat| time_s < (seat.from_s + seat.until_s) / 2.0);
                let before = || knots[..next].windows(2).rev();
                let after = || knots[next - 1..].windows(2);
                let is_moving = |pair: &&[(f64, Point, f64)]| pair[0].1 != pair[1].1;
                let leg = if is_arriving { before().find(is_moving) } else { None };
                let leg = leg.or_else(|| after().chain(knots.windows(2).rev()).find(is_moving));
                let heading =
                    leg.map_or((0.0, 1.0), |pair| (pair[1].1.0 - pair[0].1.0, pair[1].1.1 - pair[0].1.1));
                let seated = seat.map_or(0.0, |seat| seat.share(time_s));
                BodyPose {
                    position: (a.0 + (b.0 - a.0) * share, a.1 + (b.1 - a.1) * share),
                    heading: seat.map_or(unit(heading), |seat| turned(heading, seat.faces_deg, seated)),
                    step: (laps * last.2 + s0 + (s1 - s0) * share) / DOUBLE_STEP_MM,
                    seated,
                }
            }
        }
    }
}

/// Returns the knots of [`Course::Path`] for a person who starts at `from_s` and walks at `speed`.
fn course(corners: &[Corner], from_s: f64, speed: f64) -> Vec<(f64, Point, f64)> {
    let (mut time_s, mut walked) = (from_s, 0.0);
    let mut before = corners[0].point;
    let mut knots = Vec::new();
    for &Corner { point, pause_s: rest_s, .. } in corners {
        let walk_mm = distance(before, point);
        walked += walk_mm;
        time_s += if walk_mm > 0.0 { walk_mm / speed } else { 0.0 };
        knots.push((time_s, point, walked));
        time_s += rest_s;
        knots.push((time_s, point, walked));
        before = point;
    }
    knots
}

/// Returns the seats at `corners`, which a person passes at the times of `knots`. A person with one corner always sits.
fn seats(corners: &[Corner], knots: &[(f64, Point, f64)]) -> Vec<Seat> {
    let pairs = corners.iter().zip(knots.chunks(2));
    let seat = |(corner, knots): (&Corner, &[(f64, Point, f64)])| {
        let (from_s, until_s) = match corners.len() {
            1 => (f64::NEG_INFINITY, f64::INFINITY),
            _ => (knots[0].0, knots[1].0),
        };
        corner.seat_deg.map(|faces_deg| Seat { from_s, until_s, faces_deg })
    };
    pairs.filter_map(seat).collect()
}

/// Returns the length of the path through `corners`.
pub(crate) fn length(corners: &[Corner]) -> f64 {
    corners.windows(2).map(|pair| distance(pair[0].point, pair[1].point)).sum()
}

/// Returns `direction`, turned by `share` of the angle to `to_deg`, in the direction of the smaller angle.
fn turned(direction: Point, to_deg: f64, share: f64) -> Point {
    let from = direction.1.atan2(direction.0);
    let angle = (to_deg.to_radians() - from + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0;
    let (sin, cos) = (from + share * angle).sin_cos();
    (cos, sin)
}

/// Returns `point`, moved by up to `max_mm` along both axes.
pub(crate) fn jittered(point: Point, max_mm: f64, random: &mut fastrand::Rng) -> Point {
    let mut off = || max_mm * (2.0 * random.f64() - 1.0);
    (point.0 + off(), point.1 + off())
}

pub(crate) fn distance(a: Point, b: Point) -> f64 {
    (a.0 - b.0).hypot(a.1 - b.1)
}

fn unit(vector: Point) -> Point {
    let length = vector.0.hypot(vector.1).max(1e-9);
    (vector.0 / length, vector.1 / length)
}

/// Half of the distance between the legs, across the path.
const HIP_MM: f64 = 110.0;
/// Heights in the body of a standing adult of 1.75 m.
const CROTCH_MM: f64 = 820.0;
const NECK_MM: f64 = 1_480.0;
const CROWN_MM: f64 = 1_750.0;
/// Radii of trunk and head.
const TRUNK_MM: f64 = 170.0;
const HEAD_MM: f64 = 95.0;
/// Distance from the body to the feet of a person who sits, in the direction that the person faces.
const FEET_AHEAD_MM: f64 = 300.0;
/// Height of a seat.
const SEAT_MM: f64 = 450.0;
/// Time in which a person sits down, or stands up.
pub(crate) const SIT_DOWN_S: f64 = 1.2;
/// Maximum distance by which a foot of a walking person is ahead of the body.
const STRIDE_MM: f64 = 250.0;
/// Double steps per second of a person who roams.
const STEPS_HZ: f64 = 0.9;
/// Length of a double step of a person on a path. Together with [`STRIDE_MM`], it makes one foot nearly stand still
/// while the other foot swings.
const DOUBLE_STEP_MM: f64 = 1_400.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::World;

    const HERE: Pose = Pose { x_mm: 100.0, y_mm: 200.0, turn_deg: 0.0 };

    fn object(from_s: f64, until_s: f64, moves: &[Movement]) -> Object {
        let shapes = vec![Shape::Post { centre: (0.0, 0.0), radius: 10.0 }];
        let moves = moves.to_vec();
        let (heights, is_box) = (Heights::ALL, false);
        Object {
            shapes,
            heights,
            is_box,
            pose: HERE,
            surface: Surface::Plain,
            from_s,
            until_s,
            moves,
            repeat_s: None,
            jitter_mm: 0.0,
        }
    }

    #[test]
    fn box_appears_and_disappears() {
        let object = object(15.0, 20.0, &[]);
        assert!(
            object.at(14.9).is_none() && object.previous_presences(14.9).is_empty() && !object.is_still()
        );
        assert_eq!(object.at(16.0).map(|presence| presence.since_s), Some(15.0));
        assert!(object.at(20.0).is_none());
        assert_eq!(
            object.previous_presences(30.0).iter().map(|presence| presence.since_s).collect::<Vec<_>>(),
            [20.0]
        );
    }

    #[test]
    fn door_rotates_and_leaves_its_pose() {
        let by = Pose { x_mm: 0.0, y_mm: 0.0, turn_deg: 90.0 };
        let object = object(0.0, f64::INFINITY, &[Movement { from_s: 10.0, until_s: 12.0, offset: by }]);
        let state = |time_s| object.at(time_s).map(|presence| (presence.pose.turn_deg, presence.since_s));
        assert_eq!(state(9.0), Some((0.0, 0.0)));
        assert_eq!(state(11.0), Some((45.0, 11.0)));
        assert_eq!(state(20.0), Some((90.0, 12.0)));
        assert!(object.previous_presences(9.0).is_empty());
        assert_eq!(
            object.previous_presences(20.0).iter().map(|s| (s.pose, s.since_s)).collect::<Vec<_>>(),
            [(HERE, 12.0)]
        );
    }

    #[test]
    fn door_opens_and_closes_again_and_again() {
        let by = |turn_deg| Pose { x_mm: 0.0, y_mm: 0.0, turn_deg };
        let opens = Movement { from_s: 10.0, until_s: 12.0, offset: by(90.0) };
        let closes = Movement { from_s: 15.0, until_s: 16.0, offset: by(-90.0) };
        let door = Object { repeat_s: Some(20.0), ..object(0.0, f64::INFINITY, &[opens, closes]) };
        let state = |time_s| door.at(time_s).map(|presence| (presence.pose.turn_deg, presence.since_s));
        assert_eq!((state(9.0), state(29.0)), (Some((0.0, 0.0)), Some((0.0, 16.0))));
        for round_s in [0.0, 20.0, 2_000.0] {
            let moving_s = 11.0 + round_s;
            assert_eq!(state(moving_s), Some((45.0, moving_s)));
            assert_eq!(state(14.0 + round_s), Some((90.0, 12.0 + round_s)));
            assert_eq!(state(17.0 + round_s), Some((0.0, 16.0 + round_s)));
        }
        let left = |time_s| -> Vec<_> {
            door.previous_presences(time_s)
                .iter()
                .map(|presence| (presence.pose.turn_deg, presence.since_s))
                .collect()
        };
        assert_eq!(left(17.0), [(0.0, 12.0), (90.0, 16.0)]);
        assert_eq!(left(34.0), [(0.0, 12.0), (90.0, 16.0), (0.0, 32.0)]);
        assert_eq!(left(54.0), [(0.0, 32.0), (90.0, 36.0), (0.0, 52.0)]);
    }

    fn corner(x: f64, y: f64, rest_s: f64) -> Corner {
        Corner { point: (x, y), pause_s: rest_s, seat_deg: None }
    }

    fn person(way: WalkPath, from_s: f64, until_s: f64) -> Person {
        let plan = PersonSpec { path: way, from_s, until_s, jitter_mm: 0.0, leg_mm: 60.0 };
        Person::new(&plan, &mut fastrand::Rng::with_seed(1))
    }

    fn body(person: &Person, time_s: f64) -> Point {
        let [a, b] =
            person.legs(time_s).expect("a person is there").map(|leg| leg.transformed(|p| p).front_of_post());
        ((a.0 + b.0) / 2.0, (a.1 + b.1) / 2.0)
    }

    impl Shape {
        fn front_of_post(&self) -> Point {
            match *self {
                Shape::Post { centre, .. } => centre,
                Shape::Wall { from, .. } => from,
            }
        }
    }

    #[test]
    fn roaming_person_walks_within_reach() {
        let way = WalkPath::Roam { centre: (0.0, 3000.0), reach: (1500.0, 800.0) };
        let walker = person(way, 0.0, f64::INFINITY);
        let mut fastest = 0.0f64;
        for step in 0..6000 {
            let time_s = f64::from(step) * 0.01;
            let (now, then) = (body(&walker, time_s), body(&walker, time_s + 0.01));
            fastest = fastest.max(distance(now, then) / 0.01);
            assert!(now.0.abs() <= 1501.0 && (now.1 - 3000.0).abs() <= 801.0);
        }
        assert!((500.0..2000.0).contains(&fastest), "{fastest} mm/s");
    }

    #[test]
    fn person_walks_path_with_rests() {
        let corners = vec![corner(0.0, 0.0, 0.0), corner(0.0, 2000.0, 3.0), corner(1000.0, 2000.0, 0.0)];
        let walker = person(
            WalkPath::Path { corners, speed: Speed::Between(500.0, 500.0), repeats: false },
            10.0,
            f64::INFINITY,
        );
        assert!(walker.legs(9.99).is_none() && walker.legs(19.01).is_none());
        let near = |at_s: f64, place: Point| {
            let body = body(&walker, at_s);
            assert!(distance(body, place) < 1.0, "{at_s} s: {body:?}");
        };
        near(12.0, (0.0, 1000.0));
        near(14.5, (0.0, 2000.0));
        near(16.9, (0.0, 2000.0));
        near(18.0, (500.0, 2000.0));
    }

    #[test]
    fn person_walks_repeating_path_forever() {
        let corners = vec![corner(0.0, 0.0, 1.0), corner(0.0, 2000.0, 3.0)];
        let walker = person(
            WalkPath::Path { corners, speed: Speed::Between(500.0, 500.0), repeats: true },
            10.0,
            f64::INFINITY,
        );
        assert!(walker.legs(9.99).is_none());
        // A lap takes 12 s: 4 s in each direction and both pauses.
        for lap_s in [0.0, 12.0, 12_000.0] {
            for (at_s, y) in [(10.5, 0.0), (13.0, 1000.0), (17.0, 2000.0), (20.0, 1000.0)] {
                let body = body(&walker, lap_s + at_s);
                assert!(distance(body, (0.0, y)) < 1.0, "{lap_s} + {at_s} s: {body:?}");
            }
        }
        // Neither legs nor body jump from a lap to the next one.
        let (before, after) =
            (walker.body_pose(21.999).expect("is there"), walker.body_pose(22.001).expect("is there"));
        assert!((before.step - after.step).abs() < 0.001, "{} and {}", before.step, after.step);
    }

    #[test]
    fn person_sits_down_and_stands_up() {
        // The person walks from (0, 0) to a chair 2 m ahead in 4 s, stays there for 10 s, and continues. The person
        // faces left while sitting.
        let seat = Corner { seat_deg: Some(180.0), ..corner(0.0, 2000.0, 10.0) };
        let corners = vec![corner(0.0, 0.0, 0.0), seat, corner(1000.0, 2000.0, 0.0)];
        let speed = Speed::Between(500.0, 500.0);
        let sits = person(WalkPath::Path { corners, speed, repeats: false }, 0.0, f64::INFINITY);
        let feet = |time_s: f64| sits.legs(time_s).expect("is there").map(|leg| leg.front_of_post());
        for time_s in [4.0 + SIT_DOWN_S, 9.0, 14.0 - SIT_DOWN_S] {
            let [left, right] = feet(time_s);
            assert!(distance(left, (-300.0, 1890.0)) < 1e-6, "{time_s} s: {left:?}");
            assert!(distance(right, (-300.0, 2110.0)) < 1e-6, "{time_s} s: {right:?}");
        }
        // The feet do not jump when the person sits down, and not when the person stands up and turns to walk on.
        for tenth in 35..139 {
            let (before, after) = (feet(f64::from(tenth) / 10.0), feet(f64::from(tenth + 1) / 10.0));
            let jumps = before.iter().zip(after).map(|(a, b)| distance(*a, b)).fold(0.0, f64::max);
            assert!(jumps < 150.0, "{jumps} mm at {tenth}");
        }
        let crown = |time_s| sits.body(time_s).map(|body| body[3].1.to_mm);
        assert_eq!((crown(3.0), crown(9.0)), (Some(CROWN_MM), Some(CROWN_MM - 370.0)));
        // A person with one corner sits all the time.
        let corners = vec![Corner { pause_s: 0.0, ..seat }];
        let stays = person(WalkPath::Path { corners, speed: Speed::ToEnd, repeats: false }, 0.0, 20.0);
        assert_eq!((stays.legs(0.0), stays.legs(19.9)), (sits.legs(9.0), sits.legs(9.0)));
    }

    #[test]
    fn person_sits_down_in_each_lap() {
        let seat = Corner { seat_deg: Some(-90.0), ..corner(0.0, 2000.0, 5.0) };
        let way = WalkPath::Path {
            corners: vec![corner(0.0, 0.0, 0.0), seat],
            speed: Speed::Between(500.0, 500.0),
            repeats: true,
        };
        let walker = person(way, 10.0, f64::INFINITY);
        // A lap takes 13 s: 4 s in each direction and the pause.
        for lap_s in [0.0, 13.0, 13_000.0] {
            let share = |time_s| walker.body_pose(lap_s + time_s).map(|stand| stand.seated);
            assert_eq!((share(12.0), share(16.5), share(20.0)), (Some(0.0), Some(1.0), Some(0.0)));
        }
    }

    #[test]
    fn people_and_leaves_of_doors_do_not_touch() {
        let distance_from = |(from, to): (Point, Point), point: Point| {
            let (along, aside) = ((to.0 - from.0, to.1 - from.1), (point.0 - from.0, point.1 - from.1));
            let share = (aside.0 * along.0 + aside.1 * along.1) / (along.0 * along.0 + along.1 * along.1);
            let share = share.clamp(0.0, 1.0);
            distance(point, (from.0 + share * along.0, from.1 + share * along.1))
        };
        for name in ["crowd", "demo", "house"] {
            let Ok(World::Scene(scene)) = name.parse() else { panic!("{name}") };
            let mut random = fastrand::Rng::with_seed(1);
            let people: Vec<Person> =
                scene.people.iter().map(|plan| Person::new(plan, &mut random)).collect();
            let leaves: Vec<&Object> =
                scene.objects.iter().filter(|object| object.repeat_s.is_some()).collect();
            assert_eq!(leaves.len(), 1, "{name}");
            let mut nearest = f64::INFINITY;
            for time_s in (0..10_000).map(|tick| f64::from(tick) / 20.0) {
                let presence = leaves[0].at(time_s).expect("a leaf stays");
                let Shape::Wall { from, to } =
                    leaves[0].shapes[0].transformed(|point| presence.pose.outward(point))
                else {
                    panic!("a leaf is a wall");
                };
                for leg in people.iter().filter_map(|person| person.legs(time_s)).flatten() {
                    let gap = distance_from((from, to), leg.front_of_post()) - 60.0;
                    assert!(gap > 0.0, "{name}: {gap} mm at {time_s} s");
                    nearest = nearest.min(gap);
                }
            }
            // The test is only meaningful if a person passes near the door.
            assert!(nearest < 500.0, "{name}: {nearest} mm");
        }
    }

    #[test]
    fn person_stands_or_arrives_in_time() {
        let stands = person(
            WalkPath::Path { corners: vec![corner(5.0, 7.0, 0.0)], speed: Speed::ToEnd, repeats: false },
            0.0,
            20.0,
        );
        assert_eq!(stands.legs(0.0), stands.legs(19.9));
        assert!(stands.legs(20.0).is_none());
        let corners = vec![corner(0.0, 0.0, 1.0), corner(0.0, 2000.0, 0.0)];
        let walks = person(WalkPath::Path { corners, speed: Speed::ToEnd, repeats: false }, 2.0, 7.0);
        assert!(distance(body(&walks, 5.0), (0.0, 1000.0)) < 1.0);
        assert!(walks.legs(6.99).is_some() && walks.legs(7.0).is_none());
        // A path without length is completed in time as well.
        let corners = vec![corner(5.0, 7.0, 1.0), corner(5.0, 7.0, 0.0)];
        let waits = person(WalkPath::Path { corners, speed: Speed::ToEnd, repeats: false }, 2.0, 7.0);
        assert_eq!((waits.legs(2.0), waits.legs(7.0)), (waits.legs(6.99), None));
        assert_eq!(body(&waits, 6.99), (5.0, 7.0));
    }
}
