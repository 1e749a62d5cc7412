//! Encoders of circles, marks, line features, people and obstacles as `foxglove.SceneUpdate` in JSON. Each message has
//! all entities of its channel. Viewers keep entities that are missing in the next message, so each entity has a
//! lifetime of one second.

use scanhub_ros::BASE_FRAME;
use scanhub_schema::{Header, Obstacle, Obstacles, Verdict};
use serde::Serialize;

use super::{json_bytes, json_channel};
use crate::scene::{Circle, Ellipse, People, Point, Scene, circles};
use crate::server::Channel;

pub(super) fn channel(topic: &str) -> Channel {
    json_channel(topic.to_owned(), "foxglove.SceneUpdate", include_str!("scene_update.json"))
}

/// Encodes the circles of the robot's sensors, each with its radius and verdict as metadata. For each sensor with
/// points inside a circle, adds the beam of the nearest point.
pub(crate) fn zones(scene: &Scene, wall_ns: u64) -> Vec<u8> {
    let zone_circles = circles(scene.robot().map(|(_, sensor)| sensor));
    let mut entities = Vec::new();
    for circle in &zone_circles {
        let mut entity = Entity::new(format!("zone {:.3}", circle.radius_m), wall_ns);
        entity.add("radius_m", format!("{:.3}", circle.radius_m));
        entity.add("verdict", circle.verdict.name().to_owned());
        entity.cylinders.push(disc((0.0, 0.0), 2.0 * circle.radius_m, color(circle.verdict, 0.18)));
        let label = format!("{:.2} m", circle.radius_m);
        entity.texts.push(Text::new(at(circle.radius_m, 0.0), 12.0, color(circle.verdict, 1.0), label));
        entities.push(entity);
    }
    for (_, sensor) in scene.robot() {
        let near = |a: &Point, b: &Point| a.distance_m().total_cmp(&b.distance_m());
        let inside =
            zone_circles.iter().filter_map(|circle| Some((circle.inside(sensor).min_by(near)?, circle)));
        let smallest = |a: &Circle, b: &Circle| a.radius_m.total_cmp(&b.radius_m);
        let Some((point, circle)) = inside.min_by(|a, b| smallest(a.1, b.1)) else { continue };
        let mut entity = Entity::new(format!("beam {}", sensor.name), wall_ns);
        entity.add("sensor", sensor.name.clone());
        entity.add("beam", point.beam.to_string());
        entity.add("distance_m", format!("{:.3}", point.distance_m()));
        entity.add("verdict", circle.verdict.name().to_owned());
        let from = sensor.placement.pose().unwrap_or_default();
        let points = [(from.x_m, from.y_m), (point.x_m, point.y_m)];
        let color = color(circle.verdict, 1.0);
        entity.lines.push(LinePrimitive::new(LINE_STRIP, points.into_iter(), color));
        entities.push(entity);
    }
    update(&entities)
}

/// Encodes the people of one tracker with their IDs and tails. The ellipse around a person contains the true position
/// in 95 of 100 cases. The frame has the name of the robot's frame, but it is the map of the site. People who are not
/// seen are pale.
pub(crate) fn tracks(people: &People, wall_ns: u64) -> Vec<u8> {
    let entities = people.known().map(|person| {
        let (x, y) = person.position;
        let color = Color { a: if person.is_seen() { 1.0 } else { PALE }, ..PERSON };
        let mut entity = Entity::new(format!("person {}", person.id), wall_ns);
        entity.add("id", person.id.to_string());
        entity.add("state", person.state.name().to_owned());
        entity.add("room", person.room.clone().unwrap_or_default());
        entity.cylinders.push(disc((x, y), PERSON_M, color));
        entity.cylinders.push(oval((x, y), &person.ellipse, Color { a: FAINT, ..PERSON }));
        entity.lines.push(LinePrimitive::new(LINE_STRIP, person.tail().chain([(x, y)]), color));
        entity.texts.push(Text::new(at(x, y), 14.0, color, format!("#{}", person.id)));
        entity
    });
    update(&entities.collect::<Vec<_>>())
}

/// Encodes the line features of the robot's sensors, and their corners.
pub(crate) fn lines(scene: &Scene, wall_ns: u64) -> Vec<u8> {
    let entities = scene.robot().filter_map(|(_, sensor)| {
        let found = sensor.lines()?;
        let mut entity = Entity::new(format!("lines {}", sensor.name), wall_ns);
        entity.add("sensor", sensor.name.clone());
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

/// Encodes the reflector marks of the robot's sensors.
pub(crate) fn marks(scene: &Scene, wall_ns: u64) -> Vec<u8> {
    let entities = scene.robot().map(|(_, sensor)| {
        let mut entity = Entity::new(format!("marks {}", sensor.name), wall_ns);
        entity.add("sensor", sensor.name.clone());
        entity.spheres = sensor.mark_points().into_iter().map(|mark| ball(mark, MARK_M, MARK)).collect();
        entity
    });
    update(&entities.collect::<Vec<_>>())
}

/// Encodes the obstacles of a sweep as boxes with the metadata `distance_m`, `points`, `foreground` and `near`. The
/// first entity has no shape. It has the metadata of the sweep: `sweep`, `generation`, `complete`, `unreliable`,
/// `dropped`, and `words`, a summary as text. A sweep may last longer than a second, because it ends only when the
/// mount reverses. Therefore each message deletes all earlier entities, and the lifetime of its entities depends on the
/// duration of the sweep.
pub(crate) fn obstacles(header: &Header, found: &Obstacles) -> Vec<u8> {
    let lifetime = || Time::of(lifetime_ns(header));
    let mut sweep = Entity { lifetime: lifetime(), ..Entity::new("sweep".to_owned(), header.wall_ns) };
    sweep.add("sweep", found.sweep.to_string());
    sweep.add("generation", found.generation.to_string());
    sweep.add("complete", found.has(Obstacles::COMPLETE).to_string());
    sweep.add("unreliable", found.has(Obstacles::UNRELIABLE).to_string());
    sweep.add("dropped", found.dropped.to_string());
    sweep.add("words", sweep_text(found));
    let boxes = found.obstacles().iter().enumerate().map(|(number, one)| {
        let id = format!("obstacle {number}");
        let mut entity = Entity { lifetime: lifetime(), ..Entity::new(id, header.wall_ns) };
        entity.add("distance_m", format!("{:.3}", one.distance_m));
        entity.add("points", one.points.to_string());
        entity.add("foreground", one.has(Obstacle::FOREGROUND).to_string());
        entity.add("near", one.has(Obstacle::NEAR).to_string());
        let color = if one.has(Obstacle::NEAR) { NEAR } else { FOREGROUND };
        let axis = |axis: usize| (f64::from(one.low[axis]), f64::from(one.high[axis]));
        let [x, y, z] = [0, 1, 2].map(axis);
        let middle = |(low, high): (f64, f64)| (low + high) / 2.0;
        let size = Vector { x: x.1 - x.0, y: y.1 - y.0, z: z.1 - z.0 };
        entity.cubes.push(Shape { pose: at_height(middle(x), middle(y), middle(z)), size, color });
        let label = format!("{:.2} m", one.distance_m);
        entity.texts.push(Text::new(
            at_height(middle(x), middle(y), z.1),
            14.0,
            Color { a: 1.0, ..color },
            label,
        ));
        entity
    });
    let entities: Vec<Entity> = std::iter::once(sweep).chain(boxes).collect();
    let all_before = Deletion { timestamp: Time::of(header.wall_ns), kind: DELETE_ALL, id: "" };
    json_bytes(&Update { deletions: &[all_before], entities: &entities })
}

/// Returns the lifetime of a sweep's obstacles in ns: the duration of two more sweeps, and some time to process them.
fn lifetime_ns(header: &Header) -> u64 {
    2 * header.stamp_last_ns.saturating_sub(header.stamp_first_ns).min(MAX_SWEEP_NS) + PROCESSING_NS
}

fn sweep_text(found: &Obstacles) -> String {
    if found.has(Obstacles::UNRELIABLE) {
        return "sweep unreliable: its angles contradict the background".to_owned();
    }
    let count = u64::from(found.dropped) + found.obstacles().len() as u64;
    let plural = if count == 1 { "" } else { "s" };
    let obstacles = found.obstacles().first().map_or("no obstacle".to_owned(), |nearest| {
        // Use one decimal, because screen readers read the text whenever it changes.
        format!("{count} obstacle{plural}, nearest {:.1} m", nearest.distance_m)
    });
    let incomplete = if found.has(Obstacles::COMPLETE) { "" } else { ", sweep incomplete" };
    format!("{obstacles}{incomplete}")
}

#[derive(Default, Serialize)]
struct Entity {
    timestamp: Time,
    frame_id: &'static str,
    id: String,
    lifetime: Time,
    frame_locked: bool,
    metadata: Vec<KeyValue>,
    arrows: [(); 0],
    cubes: Vec<Shape>,
    spheres: Vec<Shape>,
    cylinders: Vec<Cylinder>,
    lines: Vec<LinePrimitive>,
    triangles: [(); 0],
    texts: Vec<Text>,
    models: [(); 0],
}

#[derive(Default, Serialize)]
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
struct Color {
    r: f64,
    g: f64,
    b: f64,
    a: f64,
}

/// A cube or a sphere.
#[derive(Serialize)]
struct Shape {
    pose: Pose,
    size: Vector,
    color: Color,
}

#[derive(Serialize)]
struct Cylinder {
    pose: Pose,
    size: Vector,
    bottom_scale: f64,
    top_scale: f64,
    color: Color,
}

#[derive(Serialize)]
struct Text {
    pose: Pose,
    billboard: bool,
    font_size: f64,
    scale_invariant: bool,
    color: Color,
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
    color: Color,
    colors: [(); 0],
    indices: [(); 0],
}

impl Time {
    fn of(ns: u64) -> Time {
        Time { sec: ns / 1_000_000_000, nsec: ns % 1_000_000_000 }
    }
}

impl Text {
    /// Creates a text of this size in pixels that faces the viewer.
    fn new(pose: Pose, font_size: f64, color: Color, text: String) -> Text {
        Text { pose, billboard: true, font_size, scale_invariant: true, color, text }
    }
}

impl LinePrimitive {
    /// Creates a line of two pixels through these points of the robot's frame.
    fn new(kind: u8, points: impl Iterator<Item = (f64, f64)>, color: Color) -> LinePrimitive {
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
        let (timestamp, lifetime) = (Time::of(wall_ns), Time { sec: 1, nsec: 0 });
        Entity { timestamp, frame_id: BASE_FRAME, id, lifetime, frame_locked: true, ..Entity::default() }
    }

    fn add(&mut self, key: &'static str, value: String) {
        self.metadata.push(KeyValue { key, value });
    }
}

fn update(entities: &[Entity]) -> Vec<u8> {
    json_bytes(&Update { deletions: &[], entities })
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
    at_height(x, y, 0.0)
}

fn at_height(x: f64, y: f64, z: f64) -> Pose {
    let (position, orientation) = (Vector { x, y, z }, Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 });
    Pose { position, orientation }
}

fn ball((x, y): (f64, f64), across: f64, color: Color) -> Shape {
    Shape { pose: at(x, y), size: Vector { x: across, y: across, z: across }, color }
}

fn disc((x, y): (f64, f64), across: f64, color: Color) -> Cylinder {
    let size = Vector { x: across, y: across, z: FLAT_M };
    Cylinder { pose: at(x, y), size, bottom_scale: 1.0, top_scale: 1.0, color }
}

fn oval((x, y): (f64, f64), of: &Ellipse, color: Color) -> Cylinder {
    let (z, w) = (of.yaw_rad / 2.0).sin_cos();
    let pose = Pose { orientation: Quaternion { x: 0.0, y: 0.0, z, w }, ..at(x, y) };
    let size = Vector { x: 2.0 * of.long_m, y: 2.0 * of.short_m, z: FLAT_M };
    Cylinder { pose, size, bottom_scale: 1.0, top_scale: 1.0, color }
}

/// Returns the color of a verdict: green, amber or red, as on the page.
fn color(verdict: Verdict, a: f64) -> Color {
    let (r, g, b) = match verdict {
        Verdict::Clear => (0.18, 0.62, 0.36),
        Verdict::Slow => (0.85, 0.58, 0.08),
        Verdict::Stop | Verdict::Unknown => (0.84, 0.18, 0.2),
    };
    Color { r, g, b, a }
}

const LINE_STRIP: u8 = 0;
const LINE_LIST: u8 = 2;
const FLAT_M: f64 = 0.002;
const MARK_M: f64 = 0.08;
const CORNER_M: f64 = 0.06;

const LINE: Color = Color { r: 0.45, g: 0.33, b: 0.8, a: 1.0 };
const PERSON: Color = Color { r: 0.2, g: 0.65, b: 0.3, a: 1.0 };
const PERSON_M: f64 = 0.5;
/// Opacity of a person who is not seen, and opacity of an ellipse.
const PALE: f64 = 0.5;
const FAINT: f64 = 0.15;
const MARK: Color = Color { r: 0.05, g: 0.55, b: 0.75, a: 1.0 };
/// `SceneEntityDeletion.ALL`.
const DELETE_ALL: u8 = 1;
/// Maximum duration of a sweep that the lifetime allows for, in ns.
const MAX_SWEEP_NS: u64 = 60_000_000_000;
/// Time to process a sweep, in ns.
const PROCESSING_NS: u64 = 1_000_000_000;

const FOREGROUND: Color = Color { r: 0.77, g: 0.07, b: 0.42, a: 0.35 };
const NEAR: Color = Color { r: 0.84, g: 0.18, b: 0.2, a: 0.35 };

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn new_obstacles_delete_earlier_and_have_a_lifetime() {
        let header = Header {
            stamp_first_ns: 1_000_000_000,
            stamp_last_ns: 2_500_000_000,
            wall_ns: 7_000_000_009,
            ..Header::default()
        };
        let mut found = Obstacles { sweep: 3, flags: Obstacles::COMPLETE, ..Obstacles::default() };
        let message = |found: &Obstacles| {
            serde_json::from_slice::<serde_json::Value>(&obstacles(&header, found)).unwrap()
        };
        let empty = message(&found);
        assert_eq!(empty["deletions"][0]["type"], 1);
        assert_eq!(empty["deletions"][0]["timestamp"], serde_json::json!({ "sec": 7, "nsec": 9 }));
        let sweep = &empty["entities"][0];
        assert_eq!((&sweep["metadata"][0]["value"], &sweep["lifetime"]["sec"]), (&"3".into(), &4.into()));
        assert_eq!(empty["entities"].as_array().map(Vec::len), Some(1));
        found.push(Obstacle {
            low: [1.0, -0.5, 0.0],
            high: [2.0, 0.5, 1.5],
            distance_m: 1.0,
            flags: Obstacle::NEAR,
            ..Obstacle::default()
        });
        let one = &message(&found)["entities"][1];
        assert_eq!(one["cubes"][0]["pose"]["position"], serde_json::json!({ "x": 1.5, "y": 0.0, "z": 0.75 }));
        assert_eq!(one["cubes"][0]["size"], serde_json::json!({ "x": 1.0, "y": 1.0, "z": 1.5 }));
        assert_eq!(sweep_text(&found), "1 obstacle, nearest 1.0 m");
        let mut other = Obstacles { flags: 0, ..found };
        (0..2 * scanhub_schema::MAX_OBSTACLES).for_each(|_| other.push(Obstacle::default()));
        assert_eq!(sweep_text(&other), "129 obstacles, nearest 1.0 m, sweep incomplete");
        other = Obstacles { flags: Obstacles::UNRELIABLE, ..Obstacles::default() };
        assert_eq!(sweep_text(&other), "sweep unreliable: its angles contradict the background");
        assert_eq!((&one["texts"][0]["text"], &one["frame_id"]), (&"1.00 m".into(), &"base_link".into()));
        assert_eq!(lifetime_ns(&Header { stamp_last_ns: u64::MAX, ..header }), 121_000_000_000);
    }
}
