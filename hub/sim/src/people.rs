//! People in a world: where their legs are at a given time. A pure function of time and seed, so that two sensors, a
//! test and a bench see the same person. Refuses to know sensors.

use std::f64::consts::TAU;

use crate::shape::Heights;
use crate::shape::{Point, Shape};

/// What a world says of a person.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Plan {
    /// Where the person goes.
    pub(crate) way: Way,
    /// The person is there from this second on.
    pub(crate) from_s: f64,
    /// And gone from this one on.
    pub(crate) until_s: f64,
    /// The most by which the seed moves each corner of the way.
    pub(crate) jitter_mm: f64,
    /// Radius of a leg with its trousers.
    pub(crate) leg_mm: f64,
}

/// How a person walks.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Way {
    /// To and fro within a reach of a centre, on a closed curve that the seed chooses.
    Roam { centre: Point, reach: Point },
    /// From corner to corner, with so many seconds of rest at each; at the end gone, or if it `repeats`, on to the first corner.
    Path { corners: Vec<(Point, f64)>, speed: Speed, repeats: bool },
}

/// How fast.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Speed {
    /// Millimetres per second, drawn by the seed between two bounds.
    Between(f64, f64),
    /// So that the end of the path is reached when the person has to be gone, which is after all rests.
    InTime,
}

/// One person as a seed makes it.
#[derive(Clone, Debug)]
pub(crate) struct Person {
    from_s: f64,
    until_s: f64,
    leg_mm: f64,
    /// Which leg is ahead at the start, in turns of a double step.
    phase: f64,
    course: Course,
}

#[derive(Clone, Debug)]
enum Course {
    /// `pace`: turns per second along the two axes.
    Roam { centre: Point, reach: Point, pace: Point, phase: Point },
    /// When the person is where, and what it has walked until then; the time never goes back. Of a lap, if it `repeats`.
    Path { knots: Vec<(f64, Point, f64)>, repeats: bool },
}

/// Where a body is, which way it looks (a unit vector), and in which part of a double step.
struct Stand {
    place: Point,
    ahead: Point,
    step: f64,
}

impl Person {
    /// The person of `plan` as `random` makes it.
    pub(crate) fn new(plan: &Plan, random: &mut fastrand::Rng) -> Person {
        let phase = random.f64();
        let Plan { from_s, until_s, jitter_mm, leg_mm, .. } = *plan;
        let course = match plan.way {
            Way::Roam { centre, reach } => {
                // Peak speed is 2 pi * reach * pace: 0.5 to 1.3 m/s, as people indoors walk.
                let mut pace = |reach: f64| (500.0 + 800.0 * random.f64()) / (TAU * reach);
                let pace = (pace(reach.0), pace(reach.1));
                Course::Roam { centre, reach, pace, phase: (random.f64(), random.f64()) }
            }
            Way::Path { ref corners, speed, repeats } => {
                let mut corners = corners.clone();
                for (point, _) in &mut corners {
                    *point = jittered(*point, jitter_mm, random);
                }
                if repeats {
                    corners.push((corners[0].0, 0.0));
                }
                let rest_s: f64 = corners.iter().map(|corner| corner.1).sum();
                let length: f64 = corners.windows(2).map(|pair| distance(pair[0].0, pair[1].0)).sum();
                let speed = match speed {
                    Speed::Between(slowest, fastest) => slowest + (fastest - slowest) * random.f64(),
                    Speed::InTime => length / (until_s - from_s - rest_s),
                };
                Course::Path { knots: course(&corners, from_s, speed), repeats }
            }
        };
        // Who has to be in time is; who has a speed is gone at the end of the way.
        let until_s = match (&plan.way, &course) {
            (Way::Path { speed: Speed::Between(..), .. }, Course::Path { knots, repeats: false }) => {
                knots.last().map_or(until_s, |knot| knot.0)
            }
            _ => until_s,
        };
        Person { from_s, until_s, leg_mm, phase, course }
    }

    /// Both legs at `time_s`, as a sensor at the height of the shins sees them; none while nobody is there.
    pub(crate) fn legs(&self, time_s: f64) -> Option<[Shape; 2]> {
        self.stand(time_s).map(|stand| self.legs_of(&stand))
    }

    /// The whole person at `time_s`: legs, trunk and head, with their heights.
    pub(crate) fn body(&self, time_s: f64) -> Option<[(Shape, Heights); 4]> {
        let stand = self.stand(time_s)?;
        let [left, right] = self.legs_of(&stand);
        let part = |shape, from_mm, to_mm| (shape, Heights { from_mm, to_mm });
        let upper = |radius| Shape::Post { centre: stand.place, radius };
        Some([
            part(left, 0.0, CROTCH_MM),
            part(right, 0.0, CROTCH_MM),
            part(upper(TRUNK_MM), CROTCH_MM, NECK_MM),
            part(upper(HEAD_MM), NECK_MM, CROWN_MM),
        ])
    }

    fn stand(&self, time_s: f64) -> Option<Stand> {
        (self.from_s..self.until_s).contains(&time_s).then(|| self.course.stand(time_s))
    }

    fn legs_of(&self, stand: &Stand) -> [Shape; 2] {
        let Stand { place, ahead, step } = *stand;
        let stride = STRIDE_MM * (TAU * (step + self.phase)).sin();
        [1.0, -1.0].map(|side| Shape::Post {
            centre: (
                place.0 + side * (stride * ahead.0 - HIP_MM * ahead.1),
                place.1 + side * (stride * ahead.1 + HIP_MM * ahead.0),
            ),
            radius: self.leg_mm,
        })
    }
}

impl Course {
    fn stand(&self, time_s: f64) -> Stand {
        match self {
            Course::Roam { centre, reach, pace, phase } => {
                let turn = |pace: f64, phase: f64| (TAU * (pace * time_s + phase)).sin_cos();
                let (sin_x, cos_x) = turn(pace.0, phase.0);
                let (sin_y, cos_y) = turn(pace.1, phase.1);
                let heading = (pace.0 * reach.0 * cos_x, pace.1 * reach.1 * cos_y);
                let place = (centre.0 + reach.0 * sin_x, centre.1 + reach.1 * sin_y);
                Stand { place, ahead: unit(heading), step: STEPS_HZ * time_s }
            }
            Course::Path { knots, repeats } => {
                let (first, last) = (knots[0], knots[knots.len() - 1]);
                let lap_s = last.0 - first.0;
                let laps = if *repeats { ((time_s - first.0) / lap_s).floor() } else { 0.0 };
                let time_s = time_s - laps * lap_s;
                let next = knots.partition_point(|knot| knot.0 <= time_s).clamp(1, knots.len() - 1);
                let ((t0, a, s0), (t1, b, s1)) = (knots[next - 1], knots[next]);
                let share = if t1 > t0 { ((time_s - t0) / (t1 - t0)).min(1.0) } else { 1.0 };
                // A person who rests looks along the path, and at its end back to where the path came from.
                let mut legs = knots[next - 1..].windows(2).chain(knots.windows(2).rev());
                let ahead = legs.find(|pair| pair[0].1 != pair[1].1);
                let ahead =
                    ahead.map_or((0.0, 1.0), |pair| (pair[1].1.0 - pair[0].1.0, pair[1].1.1 - pair[0].1.1));
                Stand {
                    place: (a.0 + (b.0 - a.0) * share, a.1 + (b.1 - a.1) * share),
                    ahead: unit(ahead),
                    step: (laps * last.2 + s0 + (s1 - s0) * share) / DOUBLE_STEP_MM,
                }
            }
        }
    }
}

/// When somebody who starts at `from_s` is at which corner, before and after the rest there.
fn course(corners: &[(Point, f64)], from_s: f64, speed: f64) -> Vec<(f64, Point, f64)> {
    let (mut time_s, mut walked) = (from_s, 0.0);
    let mut before = corners[0].0;
    let mut knots = Vec::new();
    for &(point, rest_s) in corners {
        let way = distance(before, point);
        walked += way;
        time_s += if way > 0.0 { way / speed } else { 0.0 };
        knots.push((time_s, point, walked));
        time_s += rest_s;
        knots.push((time_s, point, walked));
        before = point;
    }
    knots
}

/// `point` moved by up to `most_mm` along both axes.
pub(crate) fn jittered(point: Point, most_mm: f64, random: &mut fastrand::Rng) -> Point {
    let mut off = || most_mm * (2.0 * random.f64() - 1.0);
    (point.0 + off(), point.1 + off())
}

pub(crate) fn distance(a: Point, b: Point) -> f64 {
    (a.0 - b.0).hypot(a.1 - b.1)
}

fn unit(way: Point) -> Point {
    let length = way.0.hypot(way.1).max(1e-9);
    (way.0 / length, way.1 / length)
}

/// Half the distance between the legs across the way.
const HIP_MM: f64 = 110.0;
/// Heights of an adult of 1.75 m, and the radii of trunk and head.
const CROTCH_MM: f64 = 820.0;
const NECK_MM: f64 = 1_480.0;
const CROWN_MM: f64 = 1_750.0;
const TRUNK_MM: f64 = 170.0;
const HEAD_MM: f64 = 95.0;
/// How far a foot gets ahead of the body.
const STRIDE_MM: f64 = 250.0;
/// Double steps per second of somebody who roams.
const STEPS_HZ: f64 = 0.9;
/// Way of a double step of somebody on a path: with the stride above a foot nearly stands while the other swings.
const DOUBLE_STEP_MM: f64 = 1_400.0;

#[cfg(test)]
mod tests {
    use super::*;

    fn person(way: Way, from_s: f64, until_s: f64) -> Person {
        let plan = Plan { way, from_s, until_s, jitter_mm: 0.0, leg_mm: 60.0 };
        Person::new(&plan, &mut fastrand::Rng::with_seed(1))
    }

    fn body(person: &Person, time_s: f64) -> Point {
        let [a, b] =
            person.legs(time_s).expect("somebody is there").map(|leg| leg.placed(|p| p).front_of_post());
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
    fn who_roams_moves_like_a_person_and_stays_within_reach() {
        let way = Way::Roam { centre: (0.0, 3000.0), reach: (1500.0, 800.0) };
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
    fn a_path_is_walked_from_corner_to_corner_with_its_rests() {
        let corners = vec![((0.0, 0.0), 0.0), ((0.0, 2000.0), 3.0), ((1000.0, 2000.0), 0.0)];
        let walker = person(
            Way::Path { corners, speed: Speed::Between(500.0, 500.0), repeats: false },
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
    fn a_path_that_repeats_is_walked_for_ever() {
        let corners = vec![((0.0, 0.0), 1.0), ((0.0, 2000.0), 3.0)];
        let walker = person(
            Way::Path { corners, speed: Speed::Between(500.0, 500.0), repeats: true },
            10.0,
            f64::INFINITY,
        );
        assert!(walker.legs(9.99).is_none());
        // A lap takes 12 s: 4 s each way and both rests.
        for lap_s in [0.0, 12.0, 12_000.0] {
            for (at_s, y) in [(10.5, 0.0), (13.0, 1000.0), (17.0, 2000.0), (20.0, 1000.0)] {
                let body = body(&walker, lap_s + at_s);
                assert!(distance(body, (0.0, y)) < 1.0, "{lap_s} + {at_s} s: {body:?}");
            }
        }
        // Neither legs nor body jump from a lap to the next one.
        let (before, after) =
            (walker.stand(21.999).expect("is there"), walker.stand(22.001).expect("is there"));
        assert!((before.step - after.step).abs() < 0.001, "{} and {}", before.step, after.step);
    }

    #[test]
    fn who_stands_stands_and_who_has_to_be_in_time_is() {
        let stands = person(
            Way::Path { corners: vec![((5.0, 7.0), 0.0)], speed: Speed::InTime, repeats: false },
            0.0,
            20.0,
        );
        assert_eq!(stands.legs(0.0), stands.legs(19.9));
        assert!(stands.legs(20.0).is_none());
        let corners = vec![((0.0, 0.0), 1.0), ((0.0, 2000.0), 0.0)];
        let walks = person(Way::Path { corners, speed: Speed::InTime, repeats: false }, 2.0, 7.0);
        assert!(distance(body(&walks, 5.0), (0.0, 1000.0)) < 1.0);
        assert!(walks.legs(6.99).is_some() && walks.legs(7.0).is_none());
        // No way at all is in time as well.
        let corners = vec![((5.0, 7.0), 1.0), ((5.0, 7.0), 0.0)];
        let waits = person(Way::Path { corners, speed: Speed::InTime, repeats: false }, 2.0, 7.0);
        assert_eq!((waits.legs(2.0), waits.legs(7.0)), (waits.legs(6.99), None));
        assert_eq!(body(&waits, 6.99), (5.0, 7.0));
    }
}
