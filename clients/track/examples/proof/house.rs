//! The house of the proof: two rooms and a corridor between them, a cupboard in each room, a sensor in two corners of each.
//! What a sensor in it measures, with noise, gaps and flicker.

use std::f64::consts::PI;

use schema::{Scan, ScanHead};
use track::Site;
use track::geometry::Point;

use crate::walkers::LEG_M;

pub(crate) const SITE: &str = r#"
[[sensor]]
name = "hall"
pose = { x = 0.05, y = 0.05, yaw = 0.7854 }
[[sensor]]
name = "b.hall"
pose = { x = 5.95, y = 4.95, yaw = -2.3562 }
[[sensor]]
name = "kitchen"
pose = { x = 16.95, y = 0.05, yaw = 2.3562 }
[[sensor]]
name = "b.kitchen"
pose = { x = 11.05, y = 4.95, yaw = -0.7854 }
[[room]]
name = "hall"
polygon = [[0, 0], [6, 0], [6, 5], [0, 5]]
[[room]]
name = "corridor"
polygon = [[6, 1.5], [11, 1.5], [11, 3.5], [6, 3.5]]
[[room]]
name = "kitchen"
polygon = [[11, 0], [17, 0], [17, 5], [11, 5]]
[[door]]
name = "left"
from = "hall"
to = "corridor"
between = [[6, 2], [6, 3]]
[[door]]
name = "right"
from = "corridor"
to = "kitchen"
between = [[11, 2], [11, 3]]
[[gap]]
between = ["left", "right"]
seconds = [2, 15]
"#;

/// Corners of the cupboards: least x and y, greatest x and y.
pub(crate) const CUPBOARDS: [[f64; 4]; 2] = [[2.6, 3.2, 3.6, 3.6], [13.4, 1.4, 13.8, 2.4]];
pub(crate) const BEAMS: usize = 361;
/// Standard deviation of a range.
const NOISE_M: f64 = 0.01;
/// Share of beams without a reading, and of those that meet nothing.
const DROPPED: f64 = 1e-3;
const FLICKER: f64 = 2e-4;
const FARTHEST_M: f64 = 8.182;

/// The walls of the house, doors left out, and the sides of the cupboards.
pub(crate) fn walls() -> Vec<[Point; 2]> {
    let mut walls = Vec::new();
    let mut way = |points: &[Point]| walls.extend(points.windows(2).map(|two| [two[0], two[1]]));
    way(&[[6.0, 2.0], [6.0, 0.0], [0.0, 0.0], [0.0, 5.0], [6.0, 5.0], [6.0, 3.0]]);
    way(&[[11.0, 2.0], [11.0, 0.0], [17.0, 0.0], [17.0, 5.0], [11.0, 5.0], [11.0, 3.0]]);
    way(&[[6.0, 2.0], [6.0, 1.5], [11.0, 1.5], [11.0, 2.0]]);
    way(&[[6.0, 3.0], [6.0, 3.5], [11.0, 3.5], [11.0, 3.0]]);
    for [a, b, c, d] in CUPBOARDS {
        way(&[[a, b], [c, b], [c, d], [a, d], [a, b]]);
    }
    walls
}

/// A sensor of the house.
pub(crate) struct Eye {
    place: Point,
    directions: Vec<Point>,
    /// How far each beam goes in the empty house.
    empty: Vec<f64>,
}

impl Eye {
    pub(crate) fn new(site: &Site, sensor: usize, walls: &[[Point; 2]]) -> Eye {
        let sensor = &site.sensors[sensor];
        let place = sensor.place;
        let angle = |i: usize| -PI / 2.0 + i as f64 * PI / 360.0;
        let directions: Vec<Point> = (0..BEAMS).map(|i| sensor.direction(angle(i))).collect();
        let empty = directions.iter().map(|&direction| {
            walls.iter().filter_map(|&wall| meets_wall(place, direction, wall)).fold(f64::INFINITY, f64::min)
        });
        Eye { place, empty: empty.collect(), directions }
    }

    pub(crate) fn scan(&self, legs: &[Point], random: &mut fastrand::Rng) -> Box<Scan> {
        let mut ranges: Vec<f64> = self.empty.clone();
        for leg in legs {
            let (x, y) = (leg[0] - self.place[0], leg[1] - self.place[1]);
            let far2 = x * x + y * y;
            if !(LEG_M * LEG_M..=90.0).contains(&far2) {
                continue;
            }
            for (range, direction) in ranges.iter_mut().zip(&self.directions) {
                let along = x * direction[0] + y * direction[1];
                let depth = LEG_M * LEG_M - (far2 - along * along);
                if along > 0.0 && depth > 0.0 {
                    *range = range.min(along - depth.sqrt());
                }
            }
        }
        let words: Vec<u16> = ranges
            .iter()
            .map(|&range| {
                let dice = random.f64();
                let range =
                    if dice < FLICKER { range * random.f64() } else { range + NOISE_M * normal(random) };
                match range {
                    range if range > FARTHEST_M || dice > 1.0 - DROPPED => 8191,
                    range => (1000.0 * range).round().max(1.0) as u16,
                }
            })
            .collect();
        Scan::of(head(), &words)
    }
}

pub(crate) fn head() -> ScanHead {
    ScanHead {
        first_angle: -PI / 2.0,
        step: PI / 360.0,
        spacing: (PI / 360.0) as f32,
        beam_time_ns: 37_037,
        unit_um: 1000,
        valid_to: 8182,
        no_return: 8191,
        beyond: 8191,
        ..ScanHead::default()
    }
}

fn meets_wall(from: Point, direction: Point, [a, b]: [Point; 2]) -> Option<f64> {
    let along = [b[0] - a[0], b[1] - a[1]];
    let across = direction[0] * along[1] - direction[1] * along[0];
    let off = [a[0] - from[0], a[1] - from[1]];
    let range = (off[0] * along[1] - off[1] * along[0]) / across;
    let share = (off[0] * direction[1] - off[1] * direction[0]) / across;
    (range > 1e-6 && (0.0..=1.0).contains(&share)).then_some(range)
}

/// A standard normal number.
pub(crate) fn normal(random: &mut fastrand::Rng) -> f64 {
    (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (2.0 * PI * random.f64()).cos()
}
