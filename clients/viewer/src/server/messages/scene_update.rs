//! Circles, marks, lines and people as `foxglove.SceneUpdate`, encoded as JSON. Each message has all there is: what is not in the next one
//! would stay, so entities live for a second only.

mod obstacles;

use crate::scene::{Ellipse, People, Scene, circles};
use scanhub_ros::BASE_FRAME;
use scanhub_schema::Verdict;
use serde::Serialize;

use super::{bytes, json};
use crate::server::board::Channel;

pub use obstacles::obstacles;

pub(super) fn channel(topic: &str) -> Channel {
    json(topic.to_owned(), "foxglove.SceneUpdate", include_str!("scene_update.json"))
}

/// The circles of the robot's sensors, each with its radius and verdict as metadata, and for each sensor that sees something
/// inside one the nearest beam that does.
pub fn zones(scene: &Scene, wall_ns: u64) -> Vec<u8> {
    let around = circles(scene.robot().map(|(_, sensor)| sensor));
    let mut entities = Vec::new();
    for circle in &around {
        let mut entity = Entity::new(format!("zone {:.3}", circle.radius_m), wall_ns);
        entity.tell("radius_m", format!("{:.3}", circle.radius_m));
        entity.tell("verdict", circle.verdict.name().to_owned());
        entity.cylinders.push(disc((0.0, 0.0), 2.0 * circle.radius_m, colour(circle.verdict, 0.18)));
        let label = format!("{:.2} m", circle.radius_m);
        entity.texts.push(Text::new(at(circle.radius_m, 0.0), 12.0, colour(circle.verdict, 1.0), label));
        entities.push(entity);
    }
    for (_, sensor) in scene.robot() {
        let near =
            |a: &crate::scene::Point, b: &crate::scene::Point| a.distance_m().total_cmp(&b.distance_m());
        let inside = around.iter().filter_map(|circle| Some((circle.inside(sensor).min_by(near)?, circle)));
        let smallest = |a: &crate::scene::Circle, b: &crate::scene::Circle| a.radius_m.total_cmp(&b.radius_m);
        let Some((point, circle)) = inside.min_by(|a, b| smallest(a.1, b.1)) else { continue };
        let mut entity = Entity::new(format!("beam {}", sensor.name), wall_ns);
        entity.tell("sensor", sensor.name.clone());
        entity.tell("beam", point.beam.to_string());
        entity.tell("distance_m", format!("{:.3}", point.distance_m()));
        entity.tell("verdict", circle.verdict.name().to_owned());
        let from = sensor.placement.pose().unwrap_or_default();
        let points = [(from.x_m, from.y_m), (point.x_m, point.y_m)];
        let color = colour(circle.verdict, 1.0);
        entity.lines.push(LinePrimitive::new(LINE_STRIP, points.into_iter(), color));
        entities.push(entity);
    }
    update(&entities)
}

/// The people of one tracker with their numbers, their tails, and around each the ellipse that holds the true place in 95 of 100
/// cases; in the robot's frame, which is the map of the site for who follows a tracker. Who is not seen is pale.
pub fn tracks(people: &People, wall_ns: u64) -> Vec<u8> {
    let entities = people.known().map(|person| {
        let (x, y) = person.position;
        let colour = Colour { a: if person.is_seen() { 1.0 } else { PALE }, ..PERSON };
        let mut entity = Entity::new(format!("person {}", person.id), wall_ns);
        entity.tell("id", person.id.to_string());
        entity.tell("state", person.state.name().to_owned());
        entity.tell("room", person.room.clone().unwrap_or_default());
        entity.cylinders.push(disc((x, y), PERSON_M, colour));
        entity.cylinders.push(oval((x, y), &person.reach, Colour { a: FAINT, ..PERSON }));
        entity.lines.push(LinePrimitive::new(LINE_STRIP, person.tail().chain([(x, y)]), colour));
        entity.texts.push(Text::new(at(x, y), 14.0, colour, format!("#{}", person.id)));
        entity
    });
    update(&entities.collect::<Vec<_>>())
}

/// The lines of the robot's sensors, from end to end, and where two meet.
pub fn lines(scene: &Scene, wall_ns: u64) -> Vec<u8> {
    let entities = scene.robot().filter_map(|(_, sensor)| {
        let found = sensor.lines()?;
        let mut entity = Entity::new(format!("lines {}", sensor.name), wall_ns);
        entity.tell("sensor", sensor.name.clone());
        let ends = |line: &scanhub_schema::Line| [(line.x1_m, line.y1_m), (line.x2_m, line.y2_m)];
        let points = found.lines().iter().flat_map(ends).map(|(x, y)| (x.into(), y.into()));
        entity.lines.push(LinePrimitive::new(LINE_LIST, points, LINE));
        let corner =
            |corner: &scanhub_schema::Corner| ball((corner.x_m.into(), corner.y_m.into()), CORNER_M, LINE);
        entity.spheres = found.corners().iter().map(corner).collect();
        Some(entity)
    });
    update(&entities.collect::<Vec<_>>())
}

/// The reflector marks of the robot's sensors.
pub fn marks(scene: &Scene, wall_ns: u64) -> Vec<u8> {
    let entities = scene.robot().map(|(_, sensor)| {
        let mut entity = Entity::new(format!("marks {}", sensor.name), wall_ns);
        entity.tell("sensor", sensor.name.clone());
        entity.spheres = sensor.mark_points().into_iter().map(|mark| ball(mark, MARK_M, MARK)).collect();
        entity
    });
    update(&entities.collect::<Vec<_>>())
}

#[derive(Serialize)]
struct Entity {
    timestamp: Time,
    frame_id: &'static str,
    id: String,
    lifetime: Time,
    frame_locked: bool,
    metadata: Vec<KeyValue>,
    arrows: [(); 0],
    cubes: Vec<Cube>,
    spheres: Vec<Sphere>,
    cylinders: Vec<Cylinder>,
    lines: Vec<LinePrimitive>,
    triangles: [(); 0],
    texts: Vec<Text>,
    models: [(); 0],
}

#[derive(Serialize)]
struct Time {
    sec: u64,
    nsec: u64,
}

#[derive(Serialize)]
struct KeyValue {
    key: &'static str,
    value: String,
}

#[derive(Serialize)]
struct Vector {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Serialize)]
struct Quaternion {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

#[derive(Serialize)]
struct Pose {
    position: Vector,
    orientation: Quaternion,
}

#[derive(Clone, Copy, Serialize)]
struct Colour {
    r: f64,
    g: f64,
    b: f64,
    a: f64,
}

#[derive(Serialize)]
struct Cube {
    pose: Pose,
    size: Vector,
    color: Colour,
}

#[derive(Serialize)]
struct Sphere {
    pose: Pose,
    size: Vector,
    color: Colour,
}

#[derive(Serialize)]
struct Cylinder {
    pose: Pose,
    size: Vector,
    bottom_scale: f64,
    top_scale: f64,
    color: Colour,
}

#[derive(Serialize)]
struct Text {
    pose: Pose,
    billboard: bool,
    font_size: f64,
    scale_invariant: bool,
    color: Colour,
    text: String,
}

#[derive(Serialize)]
struct LinePrimitive {
    #[serde(rename = "type")]
    kind: u8,
    pose: Pose,
    thickness: f64,
    scale_invariant: bool,
    points: Vec<Vector>,
    color: Colour,
    colors: [(); 0],
    indices: [(); 0],
}

impl Time {
    fn of(ns: u64) -> Time {
        Time { sec: ns / 1_000_000_000, nsec: ns % 1_000_000_000 }
    }
}

impl Text {
    /// Of that many pixels, and turned to who looks.
    fn new(pose: Pose, font_size: f64, color: Colour, text: String) -> Text {
        Text { pose, billboard: true, font_size, scale_invariant: true, color, text }
    }
}

impl LinePrimitive {
    /// Two pixels wide, through these points of the robot's frame.
    fn new(kind: u8, points: impl Iterator<Item = (f64, f64)>, color: Colour) -> LinePrimitive {
        LinePrimitive {
            kind,
            pose: at(0.0, 0.0),
            thickness: 2.0,
            scale_invariant: true,
            points: points.map(|(x, y)| Vector { x, y, z: 0.0 }).collect(),
            color,
            colors: [],
            indices: [],
        }
    }
}

impl Entity {
    fn new(id: String, wall_ns: u64) -> Entity {
        Entity {
            timestamp: Time::of(wall_ns),
            frame_id: BASE_FRAME,
            id,
            lifetime: Time { sec: 1, nsec: 0 },
            frame_locked: true,
            metadata: Vec::new(),
            arrows: [],
            cubes: Vec::new(),
            spheres: Vec::new(),
            cylinders: Vec::new(),
            lines: Vec::new(),
            triangles: [],
            texts: Vec::new(),
            models: [],
        }
    }

    fn tell(&mut self, key: &'static str, value: String) {
        self.metadata.push(KeyValue { key, value });
    }
}

fn update(entities: &[Entity]) -> Vec<u8> {
    bytes(&Update { deletions: &[], entities })
}

#[derive(Serialize)]
struct Update<'a> {
    deletions: &'a [Deletion],
    entities: &'a [Entity],
}

#[derive(Serialize)]
struct Deletion {
    timestamp: Time,
    #[serde(rename = "type")]
    kind: u8,
    id: &'static str,
}

fn at(x: f64, y: f64) -> Pose {
    let (position, orientation) = (Vector { x, y, z: 0.0 }, Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 });
    Pose { position, orientation }
}

fn ball((x, y): (f64, f64), across: f64, color: Colour) -> Sphere {
    Sphere { pose: at(x, y), size: Vector { x: across, y: across, z: across }, color }
}

fn disc((x, y): (f64, f64), across: f64, color: Colour) -> Cylinder {
    let size = Vector { x: across, y: across, z: FLAT_M };
    Cylinder { pose: at(x, y), size, bottom_scale: 1.0, top_scale: 1.0, color }
}

fn oval((x, y): (f64, f64), of: &Ellipse, color: Colour) -> Cylinder {
    let (z, w) = (of.yaw_rad / 2.0).sin_cos();
    let pose = Pose { orientation: Quaternion { x: 0.0, y: 0.0, z, w }, ..at(x, y) };
    let size = Vector { x: 2.0 * of.long_m, y: 2.0 * of.short_m, z: FLAT_M };
    Cylinder { pose, size, bottom_scale: 1.0, top_scale: 1.0, color }
}

/// Green, amber and red, as the page has them.
fn colour(verdict: Verdict, a: f64) -> Colour {
    let (r, g, b) = match verdict {
        Verdict::Clear => (0.18, 0.62, 0.36),
        Verdict::Slow => (0.85, 0.58, 0.08),
        Verdict::Stop | Verdict::Unknown => (0.84, 0.18, 0.2),
    };
    Colour { r, g, b, a }
}

const LINE_STRIP: u8 = 0;
const LINE_LIST: u8 = 2;
const FLAT_M: f64 = 0.002;
const MARK_M: f64 = 0.08;
const CORNER_M: f64 = 0.06;

const LINE: Colour = Colour { r: 0.45, g: 0.33, b: 0.8, a: 1.0 };
const PERSON: Colour = Colour { r: 0.2, g: 0.65, b: 0.3, a: 1.0 };
const PERSON_M: f64 = 0.5;
/// Who is not seen, and where else somebody may be.
const PALE: f64 = 0.5;
const FAINT: f64 = 0.15;
const MARK: Colour = Colour { r: 0.05, g: 0.55, b: 0.75, a: 1.0 };
