//! A site: sensors, rooms and doors in one map, as a site file describes them. A file is checked while it is read:
//! names are unique, rooms do not overlap, doors are in the walls of their rooms, and every room can be reached.

use std::fmt::Display;
use std::ops::Range;

use scanhub_schema::{Failure, Kind, check_any_sensor};
use serde::Deserialize;
use toml::Spanned;

use super::geometry::{
    Point, area, contains, crosses_itself, distance, distance_to_border, distance_to_segment, dot, middle,
    minus, overlap,
};
use super::sensor_view::DoorProximity;

/// Maximum number of sensors of a site, which is the maximum number of links of a hub.
pub(crate) const MAX_SENSORS: usize = 32;
/// Maximum number of rooms.
pub(crate) const MAX_ROOMS: usize = 64;
/// Maximum number of ignored areas.
pub(crate) const MAX_IGNORED: usize = 64;

/// A checked description of a site.
#[derive(Clone, Debug, PartialEq)]
pub struct Site {
    /// Sensors in the order of the file.
    pub sensors: Vec<Sensor>,
    /// Rooms, whose polygons do not overlap.
    pub rooms: Vec<Area>,
    /// Doors between rooms, or between a room and outside.
    pub doors: Vec<Door>,
    /// Paths between doors. No sensor covers these paths.
    pub gaps: Vec<Gap>,
    /// Areas in which legs start no track. They may overlap rooms, doors and each other.
    pub ignored: Vec<Area>,
}

/// A sensor with its pose in the map.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensor {
    /// Name as in topics: `front`, or `kitchen.front` for a remote sensor.
    pub name: String,
    /// Position in the map, in meters.
    pub position: Point,
    /// Direction in radians, counterclockwise from x.
    pub yaw_rad: f64,
    /// Whether the sensor is mounted upside down, so that its beams run clockwise.
    pub is_upside_down: bool,
}

/// A room, or an ignored area. An ignored area has a moving object that is not a person: for example a fountain, a
/// revolving door or a curtain.
#[derive(Clone, Debug, PartialEq)]
pub struct Area {
    /// Name in events and in the drawing.
    pub name: String,
    /// Corners in meters, at least three.
    pub polygon: Vec<Point>,
}

/// An opening between two rooms, or between a room and outside.
#[derive(Clone, Debug, PartialEq)]
pub struct Door {
    /// Name in events.
    pub name: String,
    /// Index of the room on one side; `None` for outside.
    pub from: Option<usize>,
    /// Index of the room on the other side; `None` for outside.
    pub to: Option<usize>,
    /// Positions of both sides of the door frame, in meters.
    pub between: [Point; 2],
}

/// A path between two doors, and the time that it takes. No sensor covers the path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gap {
    /// Indexes of the two doors.
    pub doors: [usize; 2],
    /// Minimum and maximum time that the path takes, in seconds.
    pub seconds: [f64; 2],
}

impl Site {
    /// Returns whether `point` is in an ignored area.
    pub fn is_ignored(&self, point: Point) -> bool {
        self.ignored.iter().any(|area| contains(&area.polygon, point))
    }

    /// Returns the distance between `point` and a door, in meters. If an ignored area covers the middle of the door, as
    /// for a revolving door, returns the distance between `point` and this area if that is shorter.
    pub(crate) fn distance_to_door(&self, point: Point, door: usize) -> f64 {
        let between = self.doors[door].between;
        let area =
            self.ignored.iter().find(|area| touches(&area.polygon, middle(between), MAX_WALL_DISTANCE_M));
        let from_area = area.map_or(f64::INFINITY, |area| match contains(&area.polygon, point) {
            true => 0.0,
            false => distance_to_border(&area.polygon, point),
        });
        distance_to_segment(point, between).min(from_area)
    }

    /// Returns whether the leaf of a door may reach `point`. `has_leaves` has for each door whether it has leaves.
    pub(crate) fn at_door(&self, point: Point, has_leaves: &[bool]) -> DoorProximity {
        let mut found = DoorProximity::Clear;
        for (Door { between: [a, b], .. }, _) in self.doors.iter().zip(has_leaves).filter(|(_, has)| **has) {
            let width = distance(*a, *b);
            // A wide door has two leaves. A sliding leaf moves along the wall by its own width.
            let leaf_m = if width > MAX_LEAF_WIDTH_M { width / 2.0 } else { width }.min(MAX_LEAF_WIDTH_M);
            let along = minus(*b, *a).map(|value| value * leaf_m / width);
            let line = [minus(*a, along), [b[0] + along[0], b[1] + along[1]]];
            if distance_to_segment(point, line) < MAX_LEAF_OFFSET_M {
                let share = dot(minus(point, *a), minus(*b, *a)) / width;
                return if (MAX_JAMB_DISTANCE_M..width - MAX_JAMB_DISTANCE_M).contains(&share) {
                    DoorProximity::Line
                } else {
                    DoorProximity::Jamb
                };
            }
            if distance(point, *a).min(distance(point, *b)) < leaf_m + MAX_LEAF_OFFSET_M {
                found = DoorProximity::Swing;
            }
        }
        found
    }

    /// Returns the index of the room that contains `point`.
    pub fn room_at(&self, point: Point) -> Option<usize> {
        self.rooms.iter().position(|room| contains(&room.polygon, point))
    }

    /// Returns the door that is nearest to `point`. Considers only doors for which `is_candidate` returns true.
    pub(crate) fn nearest_door(&self, point: Point, is_candidate: impl Fn(&usize) -> bool) -> Option<usize> {
        let off = |&door: &usize| distance_to_segment(point, self.doors[door].between);
        (0..self.doors.len()).filter(is_candidate).min_by(|a, b| off(a).total_cmp(&off(b)))
    }

    /// Returns for each room whether it contains a sensor. A sensor on a wall counts for every room that is at most
    /// 0.15 m away.
    pub fn rooms_with_sensor(&self) -> Vec<bool> {
        let watched = |room: &Area| {
            let mut positions = self.sensors.iter().map(|sensor| sensor.position);
            positions.any(|position| touches(&room.polygon, position, MAX_WALL_DISTANCE_M))
        };
        self.rooms.iter().map(watched).collect()
    }

    /// Returns the name of a room, or `outside` for `None`.
    pub fn room_name(&self, room: Option<usize>) -> &str {
        room.and_then(|room| self.rooms.get(room)).map_or(OUTSIDE_NAME, |room| &room.name)
    }
}

impl Door {
    /// Returns the rooms on both sides of the door.
    pub(crate) fn rooms(&self) -> [Option<usize>; 2] {
        [self.from, self.to]
    }
}

impl Sensor {
    /// Returns the name of the hub whose clock stamps the sensor's samples: `kitchen` for `kitchen.front`, and `""` for
    /// a local sensor.
    pub fn hub(&self) -> &str {
        self.name.split_once('.').map_or("", |(hub, _)| hub)
    }

    /// Returns the direction of the sensor's beam at `angle` (in radians), as a unit vector in the map.
    pub fn direction(&self, angle: f64) -> Point {
        let (sin, cos) = (self.yaw_rad + if self.is_upside_down { -angle } else { angle }).sin_cos();
        [cos, sin]
    }
}

/// Maximum length of the name of a room or door, in bytes. The payload of an event has space for names of this length.
pub(crate) const MAX_NAME_LEN: usize = 24;
/// Name for the outside, to which a door may lead.
pub(crate) const OUTSIDE_NAME: &str = "outside";
/// Maximum width of a door's leaf in meters.
const MAX_LEAF_WIDTH_M: f64 = 1.3;
/// Maximum distance between a jamb and the end of an open leaf, in meters.
const MAX_JAMB_DISTANCE_M: f64 = 0.15;
/// Maximum distance of a sliding leaf from the line between the jambs, in meters.
const MAX_LEAF_OFFSET_M: f64 = 0.15;
/// Maximum distance of a sensor from the wall on which it is mounted, in meters.
const MAX_WALL_DISTANCE_M: f64 = 0.15;

fn touches(polygon: &[Point], point: Point, tolerance_m: f64) -> bool {
    contains(polygon, point) || distance_to_border(polygon, point) <= tolerance_m
}

/// Text of a file, with its name for errors.
struct SourceText<'a> {
    name: &'a str,
    text: &'a str,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    sensor: Vec<SensorEntry>,
    #[serde(default)]
    room: Vec<AreaEntry>,
    #[serde(default)]
    door: Vec<DoorEntry>,
    #[serde(default)]
    gap: Vec<GapEntry>,
    #[serde(default)]
    ignore: Vec<AreaEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SensorEntry {
    name: Spanned<String>,
    pose: Spanned<PoseEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseEntry {
    x: f64,
    y: f64,
    yaw: f64,
    #[serde(default)]
    upside_down: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AreaEntry {
    name: Spanned<String>,
    polygon: Spanned<Vec<Point>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct DoorEntry {
    name: Spanned<String>,
    from: Spanned<String>,
    to: Spanned<String>,
    between: Spanned<[Point; 2]>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct GapEntry {
    between: Spanned<[Spanned<String>; 2]>,
    seconds: Spanned<[f64; 2]>,
}

impl Site {
    /// Parses the site that `text` describes. `name` is the name of the file in errors.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] with line, column, value and remedy.
    ///
    /// # Examples
    ///
    /// ```
    /// let text = r#"
    ///     [[sensor]]
    ///     name = "front"
    ///     pose = { x = 0.0, y = 2.0, yaw = 0.0 }
    ///     [[room]]
    ///     name = "hall"
    ///     polygon = [[0, 0], [5, 0], [5, 4], [0, 4]]
    /// "#;
    /// let site = scanhub_perception::track::Site::parse("hall.toml", text)?;
    /// assert_eq!(site.room_at([1.0, 1.0]), Some(0));
    /// # Ok::<(), scanhub_schema::Failure>(())
    /// ```
    pub fn parse(name: &str, text: &str) -> Result<Site, Failure> {
        let source = SourceText { name, text };
        let file: File = toml::from_str(text).map_err(|error| source.explain(&error))?;
        plan(&source, &file)
    }
}

impl SourceText<'_> {
    /// Returns the failure for an invalid value at `span`.
    fn refuse(&self, span: Option<Range<usize>>, what: impl Display, remedy: impl Into<String>) -> Failure {
        let location = match span {
            Some(span) => {
                let before = &self.text[..span.start.min(self.text.len())];
                let line = before.matches('\n').count() + 1;
                let column = before.rsplit('\n').next().unwrap_or_default().chars().count() + 1;
                format!("{}:{line}:{column}", self.name)
            }
            None => self.name.to_owned(),
        };
        Failure::new(Kind::Configuration, format!("{location}: {what}"), remedy)
    }

    fn explain(&self, error: &toml::de::Error) -> Failure {
        let message = error.message();
        let names: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
        if let (true, [unknown, known @ ..]) = (message.starts_with("unknown field"), &names[..]) {
            let remedy = format!("{}Known here: {}", nearest(unknown, known), known.join(", "));
            return self.refuse(error.span(), format!("unknown key `{unknown}`"), remedy);
        }
        self.refuse(error.span(), message, "see docs/tracks.md")
    }
}

/// Returns a question to the user that suggests the name in `known` that is most similar to `word`. Returns an empty
/// text if `known` has no names.
fn nearest(word: &str, known: &[&str]) -> String {
    let near = |a: &str| strsim::jaro_winkler(a, word);
    let best = known.iter().max_by(|a, b| near(a).total_cmp(&near(b)));
    best.map_or(String::new(), |best| format!("did you mean `{best}`? "))
}

/// Maximum overlap of two rooms in meters. A small overlap is allowed because rooms are measured by hand.
const MAX_OVERLAP_M: f64 = 0.05;
/// Maximum distance between the middle of a door and the walls of its rooms, in meters. This distance allows for the
/// thickness of walls.
const MAX_DOOR_OFFSET_M: f64 = 0.5;
/// Minimum area of a room, and minimum area of an ignored area, in square meters. The second value of each constant is
/// the number of decimals that an error message shows. An ignored area may be small, because a curtain is thin.
const MIN_ROOM_M2: (f64, usize) = (0.25, 2);
const MIN_IGNORED_M2: (f64, usize) = (0.02, 3);
/// Maximum coordinate in meters. A larger number is probably in millimeters.
const MAX_COORDINATE_M: f64 = 1_000.0;

fn plan(source: &SourceText<'_>, file: &File) -> Result<Site, Failure> {
    if file.sensor.is_empty() {
        return Err(source.refuse(None, "no sensor", "add [[sensor]] with name and pose"));
    }
    if file.room.is_empty() {
        return Err(source.refuse(None, "no room", "add [[room]] with name and polygon"));
    }
    if file.sensor.len() > MAX_SENSORS || file.room.len() > MAX_ROOMS {
        let what = format!("{} sensors and {} rooms", file.sensor.len(), file.room.len());
        return Err(source.refuse(
            None,
            what,
            format!("at most {MAX_SENSORS} sensors and {MAX_ROOMS} rooms"),
        ));
    }
    if let Some(entry) = file.ignore.get(MAX_IGNORED) {
        let what = format!("{} ignored areas", file.ignore.len());
        return Err(source.refuse(Some(entry.name.span()), what, format!("at most {MAX_IGNORED}")));
    }
    check_unique(source, "sensor", file.sensor.iter().map(|entry| &entry.name))?;
    check_unique(source, "room", file.room.iter().map(|entry| &entry.name))?;
    check_unique(source, "door", file.door.iter().map(|entry| &entry.name))?;
    check_unique(source, "ignored area", file.ignore.iter().map(|entry| &entry.name))?;
    let mut site = Site {
        sensors: file.sensor.iter().map(|entry| sensor(source, entry)).collect::<Result<_, _>>()?,
        rooms: file
            .room
            .iter()
            .map(|entry| checked_area(source, "room", entry, MIN_ROOM_M2))
            .collect::<Result<_, _>>()?,
        doors: Vec::new(),
        gaps: Vec::new(),
        ignored: Vec::new(),
    };
    no_overlap(source, file, &site)?;
    site.doors = file.door.iter().map(|entry| door(source, entry, &site)).collect::<Result<_, _>>()?;
    site.gaps = file.gap.iter().map(|entry| gap(source, entry, &site)).collect::<Result<_, _>>()?;
    site.ignored = file.ignore.iter().map(|entry| ignored(source, entry, &site)).collect::<Result<_, _>>()?;
    all_reachable(source, file, &site)?;
    Ok(site)
}

fn check_unique<'a>(
    source: &SourceText<'_>,
    what: &str,
    names: impl Iterator<Item = &'a Spanned<String>>,
) -> Result<(), Failure> {
    let mut known: Vec<&str> = Vec::new();
    for name in names {
        let span = Some(name.span());
        let name = name.as_ref().as_str();
        if known.contains(&name) {
            return Err(source.refuse(span, format!("{what} {name:?} twice"), "give each another name"));
        }
        if what != "sensor" && (name.is_empty() || name.len() > MAX_NAME_LEN || name == OUTSIDE_NAME) {
            let remedy = format!("1 to {} bytes, and not {OUTSIDE_NAME:?}", MAX_NAME_LEN);
            return Err(source.refuse(span, format!("{what} name {name:?} is not possible"), remedy));
        }
        known.push(name);
    }
    Ok(())
}

fn check_finite(source: &SourceText<'_>, span: Range<usize>, points: &[Point]) -> Result<(), Failure> {
    let far = points.iter().flatten().find(|value| value.is_nan() || value.abs() > MAX_COORDINATE_M);
    far.map_or(Ok(()), |value| {
        let what = format!("{value} m is too far");
        Err(source.refuse(Some(span), what, format!("use meters, at most {MAX_COORDINATE_M}")))
    })
}

fn sensor(source: &SourceText<'_>, entry: &SensorEntry) -> Result<Sensor, Failure> {
    let name = entry.name.as_ref();
    check_any_sensor(name)
        .map_err(|failure| source.refuse(Some(entry.name.span()), failure.message, failure.hint))?;
    let (pose, span) = (entry.pose.as_ref(), entry.pose.span());
    check_finite(source, span.clone(), &[[pose.x, pose.y]])?;
    if pose.yaw.is_nan() || pose.yaw.abs() > std::f64::consts::TAU {
        let what = format!("yaw {} of sensor {name}", pose.yaw);
        return Err(source.refuse(Some(span), what, "radians, at most one turn: 1.5708 looks along y"));
    }
    Ok(Sensor {
        name: name.clone(),
        position: [pose.x, pose.y],
        yaw_rad: pose.yaw,
        is_upside_down: pose.upside_down,
    })
}

/// Checks that the area `what` has at least three corners, that its sides do not cross, and that it has a minimum size.
fn checked_area(
    source: &SourceText<'_>,
    what: &str,
    entry: &AreaEntry,
    (least_m2, digits): (f64, usize),
) -> Result<Area, Failure> {
    let (name, span, polygon) = (entry.name.as_ref(), entry.polygon.span(), entry.polygon.as_ref());
    check_finite(source, span.clone(), polygon)?;
    let size = area(polygon).abs();
    let (problem, remedy) = if polygon.len() < 3 {
        (format!(": {} corners", polygon.len()), "at least three".to_owned())
    } else if crosses_itself(polygon) {
        (": its sides cross".to_owned(), "give the corners in their order around it".to_owned())
    } else if size < least_m2 {
        (format!(": {size:.digits$} m2"), format!("meters, at least {least_m2} m2"))
    } else {
        return Ok(Area { name: name.clone(), polygon: polygon.clone() });
    };
    Err(source.refuse(Some(span), format!("{what} {name}{problem}"), remedy))
}

fn ignored(source: &SourceText<'_>, entry: &AreaEntry, site: &Site) -> Result<Area, Failure> {
    let ignored = checked_area(source, "ignored area", entry, MIN_IGNORED_M2)?;
    let (name, polygon) = (&ignored.name, &ignored.polygon);
    if !site.rooms.iter().any(|room| overlap(&room.polygon, polygon, 0.0)) {
        let what = format!("ignored area {name} is in no room");
        let remedy = "correct its corners; `scanhub site check FILE --svg OUT` draws the rooms";
        return Err(source.refuse(Some(entry.polygon.span()), what, remedy));
    }
    if let Some(room) = site.rooms.iter().find(|room| room.polygon.iter().all(|&at| contains(polygon, at))) {
        let what = format!("ignored area {name} covers room {}", room.name);
        let remedy = "make it smaller, or leave the room out";
        return Err(source.refuse(Some(entry.polygon.span()), what, remedy));
    }
    Ok(ignored)
}

fn no_overlap(source: &SourceText<'_>, file: &File, site: &Site) -> Result<(), Failure> {
    for (i, room) in site.rooms.iter().enumerate() {
        if let Some(other) =
            site.rooms[..i].iter().find(|other| overlap(&room.polygon, &other.polygon, MAX_OVERLAP_M))
        {
            let what = format!("rooms {} and {} overlap", other.name, room.name);
            let remedy =
                "move a corner: rooms may only touch; `scanhub site check FILE --svg OUT` draws them";
            return Err(source.refuse(Some(file.room[i].polygon.span()), what, remedy));
        }
    }
    Ok(())
}

fn door(source: &SourceText<'_>, entry: &DoorEntry, site: &Site) -> Result<Door, Failure> {
    let name = entry.name.as_ref();
    let side = |spanned: &Spanned<String>| {
        let room = spanned.as_ref().as_str();
        if room == OUTSIDE_NAME {
            return Ok(None);
        }
        let found = site.rooms.iter().position(|known| known.name == room);
        found.map(Some).ok_or_else(|| {
            let mut known: Vec<&str> = site.rooms.iter().map(|room| room.name.as_str()).collect();
            known.push(OUTSIDE_NAME);
            let remedy = format!("{}Rooms here: {}", nearest(room, &known), known.join(", "));
            source.refuse(Some(spanned.span()), format!("door {name}: no room {room:?}"), remedy)
        })
    };
    let (from, to) = (side(&entry.from)?, side(&entry.to)?);
    if from == to {
        let what = format!("door {name}: both sides are {:?}", entry.to.as_ref());
        return Err(source.refuse(Some(entry.to.span()), what, "a door leads from one room to another"));
    }
    let (between, span) = (*entry.between.as_ref(), entry.between.span());
    check_finite(source, span.clone(), &between)?;
    let width = distance(between[0], between[1]);
    if !(0.3..=20.0).contains(&width) {
        let what = format!("door {name}: {width:.2} m wide");
        return Err(source.refuse(Some(span), what, "two jambs, 0.3 to 20 m apart"));
    }
    for room in [from, to].into_iter().flatten().map(|room| &site.rooms[room]) {
        let off = distance_to_border(&room.polygon, middle(between));
        if off > MAX_DOOR_OFFSET_M {
            let what = format!("door {name}: {off:.2} m from the walls of room {}", room.name);
            let remedy = format!("at most {MAX_DOOR_OFFSET_M} m; correct between, or the room");
            return Err(source.refuse(Some(span), what, remedy));
        }
    }
    Ok(Door { name: name.clone(), from, to, between })
}

fn gap(source: &SourceText<'_>, entry: &GapEntry, site: &Site) -> Result<Gap, Failure> {
    let find = |spanned: &Spanned<String>| {
        let name = spanned.as_ref().as_str();
        site.doors.iter().position(|door| door.name == name).ok_or_else(|| {
            let known: Vec<&str> = site.doors.iter().map(|door| door.name.as_str()).collect();
            let remedy = format!("{}Doors here: {}", nearest(name, &known), known.join(", "));
            source.refuse(Some(spanned.span()), format!("gap: no door {name:?}"), remedy)
        })
    };
    let [first, second] = entry.between.as_ref();
    let doors = [find(first)?, find(second)?];
    let [shortest, longest] = *entry.seconds.as_ref();
    let is_right = shortest >= 0.0 && shortest < longest && longest <= 3600.0;
    if !is_right {
        let what = format!(
            "gap between {} and {}: seconds {shortest} to {longest}",
            first.as_ref(),
            second.as_ref()
        );
        return Err(source.refuse(Some(entry.seconds.span()), what, "shortest and longest, such as [2, 15]"));
    }
    if doors[0] == doors[1] {
        let what = format!("gap from door {} to itself", first.as_ref());
        return Err(source.refuse(Some(entry.between.span()), what, "name two doors"));
    }
    Ok(Gap { doors, seconds: [shortest, longest] })
}

/// Checks that every room can be reached from a room with a sensor, through doors, outside or gaps.
fn all_reachable(source: &SourceText<'_>, file: &File, site: &Site) -> Result<(), Failure> {
    let mut reached = site.rooms_with_sensor();
    if !reached.contains(&true) {
        let position = site.sensors[0].position;
        let what = format!(
            "no sensor is in a room: {} is at [{}, {}]",
            site.sensors[0].name, position[0], position[1]
        );
        return Err(source.refuse(Some(file.sensor[0].pose.span()), what, "correct the poses, or the rooms"));
    }
    let mut outside = false;
    loop {
        let before = (reached.clone(), outside);
        let mut join = |one: [Option<usize>; 2]| {
            if one.iter().any(|room| room.map_or(outside, |room| reached[room])) {
                for room in one {
                    match room {
                        Some(room) => reached[room] = true,
                        None => outside = true,
                    }
                }
            }
        };
        site.doors.iter().for_each(|door| join(door.rooms()));
        for Gap { doors: [a, b], .. } in &site.gaps {
            let (a, b) = (&site.doors[*a], &site.doors[*b]);
            a.rooms().into_iter().for_each(|one| b.rooms().into_iter().for_each(|two| join([one, two])));
        }
        if before == (reached.clone(), outside) {
            break;
        }
    }
    match reached.iter().position(|reached| !reached) {
        None => Ok(()),
        Some(room) => {
            let what =
                format!("room {} cannot be reached: it has neither sensor nor door", site.rooms[room].name);
            Err(source.refuse(Some(file.room[room].name.span()), what, "add [[door]], or leave the room out"))
        }
    }
}
