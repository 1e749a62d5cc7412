//! What one sweep of a tilted scanner has found, as boxes. Sweeps come when the mount turns: each message takes away what was
//! there before, and says how long it holds.

use scanhub_schema::{Header, Obstacle, Obstacles};

use super::{Colour, Cube, Deletion, Entity, Pose, Quaternion, Text, Time, Update, Vector, bytes};

/// A box for each obstacle, with metadata `distance_m`, `points`, `foreground` and `near`, behind an entity without a sign
/// whose metadata are those of the sweep: `sweep`, `generation`, `complete`, `doubted`, `left_out`, and in `words` what it has found. All of them live for as
/// long as they say something.
pub fn obstacles(header: &Header, found: &Obstacles) -> Vec<u8> {
    let lifetime = || Time::of(lasts_ns(header));
    let mut sweep = Entity { lifetime: lifetime(), ..Entity::new("sweep".to_owned(), header.wall_ns) };
    sweep.tell("sweep", found.sweep.to_string());
    sweep.tell("generation", found.generation.to_string());
    sweep.tell("complete", found.has(Obstacles::COMPLETE).to_string());
    sweep.tell("doubted", found.has(Obstacles::DOUBTED).to_string());
    sweep.tell("left_out", found.left_out.to_string());
    sweep.tell("words", words(found));
    let boxes = found.obstacles().iter().enumerate().map(|(number, one)| {
        let id = format!("obstacle {number}");
        let mut entity = Entity { lifetime: lifetime(), ..Entity::new(id, header.wall_ns) };
        entity.tell("distance_m", format!("{:.3}", one.distance_m));
        entity.tell("points", one.points.to_string());
        entity.tell("foreground", one.has(Obstacle::FOREGROUND).to_string());
        entity.tell("near", one.has(Obstacle::NEAR).to_string());
        let color = if one.has(Obstacle::NEAR) { NEAR } else { FOREGROUND };
        let axis = |axis: usize| (f64::from(one.low[axis]), f64::from(one.high[axis]));
        let [x, y, z] = [0, 1, 2].map(axis);
        let middle = |(low, high): (f64, f64)| (low + high) / 2.0;
        let size = Vector { x: x.1 - x.0, y: y.1 - y.0, z: z.1 - z.0 };
        entity.cubes.push(Cube { pose: at(middle(x), middle(y), middle(z)), size, color });
        let label = format!("{:.2} m", one.distance_m);
        entity.texts.push(Text::new(at(middle(x), middle(y), z.1), 14.0, Colour { a: 1.0, ..color }, label));
        entity
    });
    let entities: Vec<Entity> = std::iter::once(sweep).chain(boxes).collect();
    let all_before = Deletion { timestamp: Time::of(header.wall_ns), kind: ALL, id: "" };
    bytes(&Update { deletions: &[all_before], entities: &entities })
}

/// How long a sweep says what stands there, in ns: until two more could have come, and some time to find that out.
fn lasts_ns(header: &Header) -> u64 {
    2 * header.stamp_last_ns.saturating_sub(header.stamp_first_ns).min(LONGEST_NS) + PATIENCE_NS
}

fn words(found: &Obstacles) -> String {
    if found.has(Obstacles::DOUBTED) {
        return "sweep doubted, its angles contradict what is known".to_owned();
    }
    let count = u64::from(found.left_out) + found.obstacles().len() as u64;
    let plural = if count == 1 { "" } else { "s" };
    let obstacles = found.obstacles().first().map_or("no obstacle".to_owned(), |nearest| {
        // Not more digits than stay the same from sweep to sweep: it is read out when it changes.
        format!("{count} obstacle{plural}, nearest {:.1} m", nearest.distance_m)
    });
    let incomplete = if found.has(Obstacles::COMPLETE) { "" } else { ", sweep incomplete" };
    format!("{obstacles}{incomplete}")
}

fn at(x: f64, y: f64, z: f64) -> Pose {
    let (position, orientation) = (Vector { x, y, z }, Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 });
    Pose { position, orientation }
}

/// `SceneEntityDeletion.ALL`.
const ALL: u8 = 1;
/// No mount takes longer from turn to turn, as far as anybody is to wait for it.
const LONGEST_NS: u64 = 60_000_000_000;
const PATIENCE_NS: u64 = 1_000_000_000;

const FOREGROUND: Colour = Colour { r: 0.77, g: 0.07, b: 0.42, a: 0.35 };
const NEAR: Colour = Colour { r: 0.84, g: 0.18, b: 0.2, a: 0.35 };

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_take_the_place_of_those_before_and_hold_for_two_sweeps() {
        let header = Header {
            stamp_first_ns: 1_000_000_000,
            stamp_last_ns: 2_500_000_000,
            wall_ns: 7_000_000_009,
            ..Header::default()
        };
        let mut found = Obstacles { sweep: 3, flags: Obstacles::COMPLETE, ..Obstacles::default() };
        let told = |found: &Obstacles| {
            serde_json::from_slice::<serde_json::Value>(&obstacles(&header, found)).unwrap()
        };
        let nothing = told(&found);
        assert_eq!(nothing["deletions"][0]["type"], 1);
        assert_eq!(nothing["deletions"][0]["timestamp"], serde_json::json!({ "sec": 7, "nsec": 9 }));
        let sweep = &nothing["entities"][0];
        assert_eq!((&sweep["metadata"][0]["value"], &sweep["lifetime"]["sec"]), (&"3".into(), &4.into()));
        assert_eq!(nothing["entities"].as_array().map(Vec::len), Some(1));
        found.push(Obstacle {
            low: [1.0, -0.5, 0.0],
            high: [2.0, 0.5, 1.5],
            distance_m: 1.0,
            flags: Obstacle::NEAR,
            ..Obstacle::default()
        });
        let one = &told(&found)["entities"][1];
        assert_eq!(one["cubes"][0]["pose"]["position"], serde_json::json!({ "x": 1.5, "y": 0.0, "z": 0.75 }));
        assert_eq!(one["cubes"][0]["size"], serde_json::json!({ "x": 1.0, "y": 1.0, "z": 1.5 }));
        assert_eq!(words(&found), "1 obstacle, nearest 1.0 m");
        let mut other = Obstacles { flags: 0, ..found };
        (0..2 * scanhub_schema::OBSTACLES).for_each(|_| other.push(Obstacle::default()));
        assert_eq!(words(&other), "129 obstacles, nearest 1.0 m, sweep incomplete");
        other = Obstacles { flags: Obstacles::DOUBTED, ..Obstacles::default() };
        assert_eq!(words(&other), "sweep doubted, its angles contradict what is known");
        assert_eq!((&one["texts"][0]["text"], &one["frame_id"]), (&"1.00 m".into(), &"base_link".into()));
        assert_eq!(lasts_ns(&Header { stamp_last_ns: u64::MAX, ..header }), 121_000_000_000);
    }
}
