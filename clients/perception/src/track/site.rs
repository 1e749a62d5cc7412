//! A site: where sensors, rooms and doors are, in one map. Refuses to know who walks there.

mod check;
mod drawing;
mod file;

use crate::track::geometry::{
    Point, contains, distance, distance_to_border, distance_to_segment, dot, middle, minus,
};
use crate::track::sight::AtDoor;

/// The most sensors of a site: as many as a hub has links.
pub const SENSORS: usize = 32;
/// The most rooms.
pub const ROOMS: usize = 64;
/// Maximum number of ignored areas.
pub const IGNORED: usize = 64;

/// A plan that was checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Site {
    /// In the order of the file.
    pub sensors: Vec<Sensor>,
    /// Their polygons do not overlap.
    pub rooms: Vec<Room>,
    /// From room to room, or to outside.
    pub doors: Vec<Door>,
    /// Ways between doors that no sensor sees.
    pub gaps: Vec<Gap>,
    /// Areas in which legs start no track. They may overlap rooms, doors and each other.
    pub ignored: Vec<Ignored>,
}

/// A sensor, and where it is in the map.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensor {
    /// As consumers know it: `front`, or `kitchen.front` of another machine.
    pub name: String,
    /// Metres in the map.
    pub place: Point,
    /// Where it looks, in radians counter-clockwise from x.
    pub yaw_rad: f64,
    /// Its beams run the other way.
    pub is_upside_down: bool,
}

/// A room.
#[derive(Clone, Debug, PartialEq)]
pub struct Room {
    /// As in events.
    pub name: String,
    /// Its corners in metres, at least three.
    pub polygon: Vec<Point>,
}

/// An opening between two rooms, or a room and outside.
#[derive(Clone, Debug, PartialEq)]
pub struct Door {
    /// As in events.
    pub name: String,
    /// The room on the one side; none: outside.
    pub from: Option<usize>,
    /// The room on the other side; none: outside.
    pub to: Option<usize>,
    /// Its two jambs.
    pub between: [Point; 2],
}

/// Doors that a way connects which no sensor sees, and how long it takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gap {
    /// Numbers of the two doors.
    pub doors: [usize; 2],
    /// Shortest and longest time, in seconds.
    pub seconds: [f64; 2],
}

/// An area with something that moves and is not a person, such as a fountain, a revolving door or a curtain.
#[derive(Clone, Debug, PartialEq)]
pub struct Ignored {
    /// Name in the drawing.
    pub name: String,
    /// Corners in meters, at least three.
    pub polygon: Vec<Point>,
}

impl Site {
    /// Returns whether `point` is in an ignored area.
    pub fn is_ignored(&self, point: Point) -> bool {
        self.ignored.iter().any(|area| contains(&area.polygon, point))
    }

    /// Returns the distance of `point` from a door, in meters. If an ignored area covers the middle of the door, as that of a
    /// revolving door does, it is the distance from this area.
    pub(crate) fn distance_to_door(&self, point: Point, door: usize) -> f64 {
        let between = self.doors[door].between;
        let area = self.ignored.iter().find(|area| touches(&area.polygon, middle(between), ON_THE_WALL_M));
        let from_area = area.map_or(f64::INFINITY, |area| match contains(&area.polygon, point) {
            true => 0.0,
            false => distance_to_border(&area.polygon, point),
        });
        distance_to_segment(point, between).min(from_area)
    }

    /// Returns whether a leaf may reach `point`, for the doors that have leaves.
    pub(crate) fn at_door(&self, point: Point, has_leaves: &[bool]) -> AtDoor {
        let mut found = AtDoor::Clear;
        for (Door { between: [a, b], .. }, _) in self.doors.iter().zip(has_leaves).filter(|(_, has)| **has) {
            let width = distance(*a, *b);
            // A wide door has two leaves. One that slides does so along the wall, as far as it is wide.
            let leaf_m = if width > WIDEST_LEAF_M { width / 2.0 } else { width }.min(WIDEST_LEAF_M);
            let along = minus(*b, *a).map(|value| value * leaf_m / width);
            let line = [minus(*a, along), [b[0] + along[0], b[1] + along[1]]];
            if distance_to_segment(point, line) < LINE_M {
                let share = dot(minus(point, *a), minus(*b, *a)) / width;
                return if (JAMB_M..width - JAMB_M).contains(&share) { AtDoor::Line } else { AtDoor::Jamb };
            }
            if distance(point, *a).min(distance(point, *b)) < leaf_m + LINE_M {
                found = AtDoor::Swing;
            }
        }
        found
    }

    /// Returns the room that `point` is in.
    pub fn room_at(&self, point: Point) -> Option<usize> {
        self.rooms.iter().position(|room| contains(&room.polygon, point))
    }

    /// Returns the rooms in which there is a sensor, in the order of the rooms. A sensor on a wall is in every room that it
    /// touches, at most 0.15 m away.
    pub fn watched(&self) -> Vec<bool> {
        let watched = |room: &Room| {
            let mut places = self.sensors.iter().map(|sensor| sensor.place);
            places.any(|place| touches(&room.polygon, place, ON_THE_WALL_M))
        };
        self.rooms.iter().map(watched).collect()
    }

    /// Returns the name of a room, `outside` for none.
    pub fn room_name(&self, room: Option<usize>) -> &str {
        room.and_then(|room| self.rooms.get(room)).map_or(OUTSIDE, |room| &room.name)
    }
}

impl Sensor {
    /// Returns the machine that its samples are stamped by: of `kitchen.front` it is `kitchen`, of a local one `""`.
    pub fn hub(&self) -> &str {
        self.name.split_once('.').map_or("", |(hub, _)| hub)
    }

    /// Returns the direction in the map of the beam at `angle` of the sensor: a unit vector.
    pub fn direction(&self, angle: f64) -> Point {
        let (sin, cos) = (self.yaw_rad + if self.is_upside_down { -angle } else { angle }).sin_cos();
        [cos, sin]
    }
}

/// The most bytes of a name of a room or door: so many have place in an event.
pub const NAME: usize = 24;
/// What a door leads to where there is no room.
pub const OUTSIDE: &str = "outside";
/// Maximum width of a leaf of a door, in meters.
const WIDEST_LEAF_M: f64 = 1.3;
/// Distance from a jamb within which an open leaf may end.
const JAMB_M: f64 = 0.15;
/// Maximum distance of a leaf that slides from the line between the jambs.
const LINE_M: f64 = 0.15;
/// A sensor so near a wall sits on it.
const ON_THE_WALL_M: f64 = 0.15;

fn touches(polygon: &[Point], point: Point, tolerance_m: f64) -> bool {
    contains(polygon, point) || distance_to_border(polygon, point) <= tolerance_m
}
