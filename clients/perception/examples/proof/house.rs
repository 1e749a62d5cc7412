//! House of the proof: two rooms with furniture, a corridor between them that no sensor covers, and a sensor in each of
//! two corners of each room. The simulator of the scanners computes the scans.

use std::f64::consts::PI;

use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_perception::track::geometry::Point;
use scanhub_schema::{Nanos, Scan, ScanHead};
use scanhub_sim::Shape;
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

/// Sensors, rooms and inner doors of the site file.
const ROOMS: &str = r#"
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

/// Doors that lead outside.
const OUTER_DOORS: &str = r#"
[[door]]
name = "porch"
from = "hall"
to = "outside"
between = [[0, 2], [0, 3]]
[[door]]
name = "yard"
from = "kitchen"
to = "outside"
between = [[17, 2], [17, 3]]
"#;

/// Corners of the cupboards: minimum x and y, maximum x and y.
const CUPBOARDS: [[f64; 4]; 2] = [[2.6, 3.2, 3.6, 3.6], [13.4, 1.4, 13.8, 2.4]];
/// Corners of the tables: minimum x and y, maximum x and y. A table has four legs.
const TABLE_CORNERS: [[f64; 4]; 2] = [[3.4, 0.5, 4.6, 1.2], [14.9, 3.5, 16.1, 4.2]];
const TABLE_LEG_M: f64 = 0.03;
/// Chairs: x, y, and the direction in radians in which a person sits.
pub(crate) const CHAIRS: [(Point, f64); 6] = [
    ([1.2, 4.4], -PI / 2.0),
    ([4.9, 4.3], -0.75 * PI),
    ([4.0, 1.6], PI / 2.0),
    ([12.2, 0.7], PI / 2.0),
    ([15.6, 0.8], 0.75 * PI),
    ([15.5, 3.1], -PI / 2.0),
];
/// Distance of a chair's legs from the chair's center along both axes, and radius of the legs.
const CHAIR_HALF_M: f64 = 0.2;
const CHAIR_LEG_M: f64 = 0.014;
/// Standard deviation of a range of the ideal sensor, and share of the ideal sensor's beams without a range.
const IDEAL_SIGMA_MM: f64 = 10.0;
const IDEAL_ERRORS: f64 = 1e-3;

pub(crate) const BEAMS: usize = 361;

/// Plan of the house, with or without furniture and doors that lead outside.
#[derive(Clone, Copy)]
pub(crate) struct House {
    /// Whether the sensors are ideal, and the house has only cupboards.
    pub(crate) is_ideal: bool,
}

impl House {
    /// Returns the site file.
    pub(crate) fn site(self) -> String {
        if self.is_ideal { ROOMS.to_owned() } else { [ROOMS, OUTER_DOORS].concat() }
    }

    /// Returns the areas that people do not walk through: minimum x and y, maximum x and y.
    pub(crate) fn obstacles(self) -> impl Iterator<Item = &'static [f64; 4]> {
        CUPBOARDS.iter().chain(TABLE_CORNERS.iter().filter(move |_| !self.is_ideal))
    }

    /// Returns the world of the simulator, without people, chairs and leaves of doors.
    fn world(self) -> World {
        let mut text = String::new();
        let mm = |[x, y]: Point| format!("[{:.0}, {:.0}]", 1000.0 * x, 1000.0 * y);
        for sensor in
            scanhub_perception::track::Site::parse("house.toml", ROOMS).expect("the house is right").sensors
        {
            let [x, y] = sensor.position.map(|m| 1000.0 * m);
            text += &format!("[[sensor]]\npose = [{x:.0}, {y:.0}, {:.3}]\n", sensor.yaw_rad.to_degrees());
        }
        let mut line = |points: &[Point]| {
            let points: Vec<String> = points.iter().map(|&point| mm(point)).collect();
            text += &format!("[[thing]]\nline = [{}]\n", points.join(", "));
        };
        line(&[[6.0, 2.0], [6.0, 0.0], [0.0, 0.0], [0.0, 2.0]]);
        line(&[[0.0, 3.0], [0.0, 5.0], [6.0, 5.0], [6.0, 3.0]]);
        line(&[[11.0, 2.0], [11.0, 0.0], [17.0, 0.0], [17.0, 2.0]]);
        line(&[[17.0, 3.0], [17.0, 5.0], [11.0, 5.0], [11.0, 3.0]]);
        line(&[[6.0, 2.0], [6.0, 1.5], [11.0, 1.5], [11.0, 2.0]]);
        line(&[[6.0, 3.0], [6.0, 3.5], [11.0, 3.5], [11.0, 3.0]]);
        if self.is_ideal {
            line(&[[0.0, 2.0], [0.0, 3.0]]);
            line(&[[17.0, 2.0], [17.0, 3.0]]);
        } else {
            // A house on the other side of the street, and a fence.
            line(&[[-4.0, -2.0], [-4.0, 8.0]]);
            line(&[[22.0, -2.0], [22.0, 8.0]]);
        }
        for &[a, b, c, d] in &CUPBOARDS {
            line(&[[a, b], [c, b], [c, d], [a, d], [a, b]]);
        }
        for [a, b, c, d] in TABLE_CORNERS.into_iter().filter(|_| !self.is_ideal) {
            for [x, y] in [[a, b], [a, d], [c, b], [c, d]] {
                let radius = 1000.0 * TABLE_LEG_M;
                text += &format!("[[thing]]\nradius_mm = {radius}\npose = {}\n", mm([x, y]));
            }
        }
        let layers = match self.is_ideal {
            true => NoiseModel { sigma_mm: IDEAL_SIGMA_MM, errors: IDEAL_ERRORS, ..NoiseModel::NONE },
            false => NoiseModel::default(),
        };
        World::of_toml("house.toml", &text).expect("the house is right").with_noise(layers)
    }
}

/// A sensor of the house.
pub(crate) struct HouseSensor(Room);

impl HouseSensor {
    pub(crate) fn new(house: House, sensor: usize, seed: u64) -> HouseSensor {
        HouseSensor(Room::of_port(&house.world(), seed, sensor as u64))
    }

    /// Returns the scan that ends at `end_ns`. `shapes` returns all moving objects at a given time.
    pub(crate) fn scan(&self, shapes: &dyn Fn(Nanos) -> Vec<Shape>, end_ns: Nanos) -> Box<Scan> {
        let words = self.0.scan_with(shapes, Variant::HALF, Unit::Mm, Mode(0), end_ns);
        Scan::of(head(), &words)
    }
}

/// Returns a post at `center`, both in meters.
pub(crate) fn post([x, y]: Point, radius_m: f64) -> Shape {
    Shape::Post { centre: (1000.0 * x, 1000.0 * y), radius: 1000.0 * radius_m }
}

/// Returns a wall between two points in meters.
pub(crate) fn wall(a: Point, b: Point) -> Shape {
    let mm = |[x, y]: Point| (1000.0 * x, 1000.0 * y);
    Shape::Wall { from: mm(a), to: mm(b) }
}

/// Returns the legs of a chair.
pub(crate) fn chair_legs([x, y]: Point, turn_rad: f64) -> [Shape; 4] {
    let (sin, cos) = turn_rad.sin_cos();
    let half = CHAIR_HALF_M;
    [[half, half], [half, -half], [-half, half], [-half, -half]]
        .map(|[u, v]| post([x + u * cos - v * sin, y + u * sin + v * cos], CHAIR_LEG_M))
}

pub(crate) fn head() -> ScanHead {
    ScanHead::lms(BEAMS, -90_000, 500, 1, 13)
}

/// Returns a standard normal random number.
pub(crate) fn normal(random: &mut fastrand::Rng) -> f64 {
    (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (2.0 * PI * random.f64()).cos()
}
