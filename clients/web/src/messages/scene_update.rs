//! Circles and marks as `foxglove.SceneUpdate`, encoded as JSON. Each message has all there is: what is not in the next one
//! would stay, so entities live for a second only.

use ros::BASE_FRAME;
use scene::{People, Scene, circles};
use schema::Verdict;
use serde::Serialize;
use serde_json::json;

use super::{bytes, json};
use crate::board::Channel;

pub(super) fn channel(topic: &str) -> Channel {
    json(topic.to_owned(), "foxglove.SceneUpdate", include_str!("scene_update.json"))
}

/// The circles of the robot's sensors, each with its radius and verdict as metadata, and for each sensor that sees something
/// inside one the nearest beam that does.
pub fn zones(scene: &Scene, wall_ns: u64) -> Vec<u8> {
    let around = circles(scene.robot().map(|(_, sensor)| sensor));
    let mut entities = Vec::new();
    for circle in &around {
        let across = 2.0 * circle.radius_m;
        let mut entity = Entity::new(format!("zone {:.3}", circle.radius_m), wall_ns);
        entity.tell("radius_m", format!("{:.3}", circle.radius_m));
        entity.tell("verdict", circle.verdict.name().to_owned());
        entity.cylinders.push(json!({
            "pose": at(0.0, 0.0), "size": { "x": across, "y": across, "z": FLAT_M },
            "bottom_scale": 1.0, "top_scale": 1.0, "color": colour(circle.verdict, 0.18),
        }));
        entity.texts.push(json!({
            "pose": at(circle.radius_m, 0.0), "billboard": true, "font_size": 12.0, "scale_invariant": true,
            "color": colour(circle.verdict, 1.0), "text": format!("{:.2} m", circle.radius_m),
        }));
        entities.push(entity);
    }
    for (_, sensor) in scene.robot() {
        let near = |a: &scene::Point, b: &scene::Point| a.distance_m().total_cmp(&b.distance_m());
        let inside = around.iter().filter_map(|circle| Some((circle.inside(sensor).min_by(near)?, circle)));
        let smallest = |a: &scene::Circle, b: &scene::Circle| a.radius_m.total_cmp(&b.radius_m);
        let Some((point, circle)) = inside.min_by(|a, b| smallest(a.1, b.1)) else { continue };
        let mut entity = Entity::new(format!("beam {}", sensor.name), wall_ns);
        entity.tell("sensor", sensor.name.clone());
        entity.tell("beam", point.beam.to_string());
        entity.tell("distance_m", format!("{:.3}", point.distance_m()));
        entity.tell("verdict", circle.verdict.name().to_owned());
        entity.lines.push(json!({
            "type": LINE_STRIP, "pose": at(0.0, 0.0), "thickness": 2.0, "scale_invariant": true,
            "points": [{ "x": sensor.pose.x_m, "y": sensor.pose.y_m, "z": 0.0 },
                { "x": point.x_m, "y": point.y_m, "z": 0.0 }],
            "color": colour(circle.verdict, 1.0), "colors": [], "indices": [],
        }));
        entities.push(entity);
    }
    update(&entities)
}

/// The people of one tracker with their numbers, and their tails; in the robot's frame, which is the map of the site for who
/// follows a tracker.
pub fn tracks(people: &People, wall_ns: u64) -> Vec<u8> {
    let known = people.persons().iter().filter(|person| person.is_known());
    let entities = known.map(|person| {
        let (x, y) = person.place;
        let mut entity = Entity::new(format!("person {}", person.id), wall_ns);
        entity.tell("id", person.id.to_string());
        entity.tell("state", person.state.name().to_owned());
        entity.cylinders.push(json!({
            "pose": at(x, y), "size": { "x": PERSON_M, "y": PERSON_M, "z": FLAT_M },
            "bottom_scale": 1.0, "top_scale": 1.0, "color": PERSON,
        }));
        entity.lines.push(json!({
            "type": LINE_STRIP, "pose": at(0.0, 0.0), "thickness": 2.0, "scale_invariant": true,
            "points": person.tail().chain([(x, y)]).map(|(x, y)| json!({ "x": x, "y": y, "z": 0.0 })).collect::<Vec<_>>(),
            "color": PERSON, "colors": [], "indices": [],
        }));
        entity.texts.push(json!({
            "pose": at(x, y), "billboard": true, "font_size": 14.0, "scale_invariant": true,
            "color": PERSON, "text": person.id.to_string(),
        }));
        entity
    });
    update(&entities.collect::<Vec<_>>())
}

/// The lines of the robot's sensors, from end to end, and where two meet.
pub fn lines(scene: &Scene, wall_ns: u64) -> Vec<u8> {
    let entities = scene.robot().filter_map(|(_, sensor)| {
        let found = sensor.lines.as_ref()?;
        let mut entity = Entity::new(format!("lines {}", sensor.name), wall_ns);
        entity.tell("sensor", sensor.name.clone());
        let ends = |line: &schema::Line| [(line.x1_m, line.y1_m), (line.x2_m, line.y2_m)];
        let point = |(x, y): (f32, f32)| json!({ "x": x, "y": y, "z": 0.0 });
        entity.lines.push(json!({
            "type": LINE_LIST, "pose": at(0.0, 0.0), "thickness": 2.0, "scale_invariant": true,
            "points": found.lines().iter().flat_map(ends).map(point).collect::<Vec<_>>(),
            "color": LINE, "colors": [], "indices": [],
        }));
        let corner = |corner: &schema::Corner| {
            let size = json!({ "x": CORNER_M, "y": CORNER_M, "z": CORNER_M });
            json!({ "pose": at(corner.x_m.into(), corner.y_m.into()), "size": size, "color": LINE })
        };
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
        entity.spheres = sensor
            .mark_points()
            .into_iter()
            .map(|(x, y)| json!({ "pose": at(x, y), "size": { "x": MARK_M, "y": MARK_M, "z": MARK_M }, "color": MARK }))
            .collect();
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
    metadata: Vec<serde_json::Value>,
    arrows: [(); 0],
    cubes: [(); 0],
    spheres: Vec<serde_json::Value>,
    cylinders: Vec<serde_json::Value>,
    lines: Vec<serde_json::Value>,
    triangles: [(); 0],
    texts: Vec<serde_json::Value>,
    models: [(); 0],
}

#[derive(Serialize)]
struct Time {
    sec: u64,
    nsec: u64,
}

impl Entity {
    fn new(id: String, wall_ns: u64) -> Entity {
        Entity {
            timestamp: Time { sec: wall_ns / 1_000_000_000, nsec: wall_ns % 1_000_000_000 },
            frame_id: BASE_FRAME,
            id,
            lifetime: Time { sec: 1, nsec: 0 },
            frame_locked: true,
            metadata: Vec::new(),
            arrows: [],
            cubes: [],
            spheres: Vec::new(),
            cylinders: Vec::new(),
            lines: Vec::new(),
            triangles: [],
            texts: Vec::new(),
            models: [],
        }
    }

    fn tell(&mut self, key: &str, value: String) {
        self.metadata.push(json!({ "key": key, "value": value }));
    }
}

fn update(entities: &[Entity]) -> Vec<u8> {
    #[derive(Serialize)]
    struct Update<'a> {
        deletions: [(); 0],
        entities: &'a [Entity],
    }
    bytes(&Update { deletions: [], entities })
}

fn at(x: f64, y: f64) -> serde_json::Value {
    json!({ "position": { "x": x, "y": y, "z": 0.0 }, "orientation": { "x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0 } })
}

/// Green, amber and red, as the page has them.
fn colour(verdict: Verdict, a: f64) -> serde_json::Value {
    let (r, g, b) = match verdict {
        Verdict::Clear => (0.18, 0.62, 0.36),
        Verdict::Slow => (0.85, 0.58, 0.08),
        Verdict::Stop | Verdict::Unknown => (0.84, 0.18, 0.2),
    };
    json!({ "r": r, "g": g, "b": b, "a": a })
}

const LINE_STRIP: u8 = 0;
const LINE_LIST: u8 = 2;
const FLAT_M: f64 = 0.002;
const MARK_M: f64 = 0.08;
const CORNER_M: f64 = 0.06;

/// Of a person, a mark or a line.
#[derive(Clone, Copy, Serialize)]
struct Colour {
    r: f64,
    g: f64,
    b: f64,
    a: f64,
}

const LINE: Colour = Colour { r: 0.45, g: 0.33, b: 0.8, a: 1.0 };
const PERSON: Colour = Colour { r: 0.2, g: 0.65, b: 0.3, a: 1.0 };
const PERSON_M: f64 = 0.5;
const MARK: Colour = Colour { r: 0.05, g: 0.55, b: 0.75, a: 1.0 };
