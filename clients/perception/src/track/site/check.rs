//! Whether the entries of a site file make a plan: names that are there and only once, rooms that do not overlap, doors
//! that are in the walls of their rooms, and a way to each room. Refuses to know how the file is written.

use std::ops::Range;

use scanhub_schema::{Failure, check_followed};
use toml::Spanned;

use super::file::{DoorEntry, File, GapEntry, IgnoreEntry, RoomEntry, SensorEntry, Source, nearest};
use super::{Door, Gap, IGNORED, Ignored, OUTSIDE, ROOMS, Room, SENSORS, Sensor, Site};
use crate::track::geometry::{
    Point, area, contains, crosses_itself, distance, distance_to_border, middle, overlap,
};

/// By so much may rooms overlap, for they are measured by hand.
const OVERLAP_M: f64 = 0.05;
/// So far may the middle of a door be from the walls of its rooms: walls are thick.
const DOOR_OFF_M: f64 = 0.5;
/// Minimum size of an ignored area, in square meters: a curtain is thin.
const LEAST_IGNORED_M2: f64 = 0.02;
/// The greatest coordinate: beyond it, somebody wrote millimetres.
const FARTHEST_M: f64 = 1_000.0;

pub(super) fn check(source: &Source<'_>, file: &File) -> Result<Site, Failure> {
    if file.sensor.is_empty() {
        return Err(source.refuse(None, "no sensor", "add [[sensor]] with name and pose"));
    }
    if file.room.is_empty() {
        return Err(source.refuse(None, "no room", "add [[room]] with name and polygon"));
    }
    if file.sensor.len() > SENSORS || file.room.len() > ROOMS {
        let what = format!("{} sensors and {} rooms", file.sensor.len(), file.room.len());
        return Err(source.refuse(None, what, format!("at most {SENSORS} sensors and {ROOMS} rooms")));
    }
    if let Some(entry) = file.ignore.get(IGNORED) {
        let what = format!("{} ignored areas", file.ignore.len());
        return Err(source.refuse(Some(entry.name.span()), what, format!("at most {IGNORED}")));
    }
    once(source, "sensor", file.sensor.iter().map(|entry| &entry.name))?;
    once(source, "room", file.room.iter().map(|entry| &entry.name))?;
    once(source, "door", file.door.iter().map(|entry| &entry.name))?;
    once(source, "ignored area", file.ignore.iter().map(|entry| &entry.name))?;
    let mut site = Site {
        sensors: file.sensor.iter().map(|entry| sensor(source, entry)).collect::<Result<_, _>>()?,
        rooms: file.room.iter().map(|entry| room(source, entry)).collect::<Result<_, _>>()?,
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

fn once<'a>(
    source: &Source<'_>,
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
        if what != "sensor" && (name.is_empty() || name.len() > super::NAME || name == OUTSIDE) {
            let remedy = format!("1 to {} bytes, and not {OUTSIDE:?}", super::NAME);
            return Err(source.refuse(span, format!("{what} name {name:?} is not possible"), remedy));
        }
        known.push(name);
    }
    Ok(())
}

fn finite(source: &Source<'_>, span: Range<usize>, points: &[Point]) -> Result<(), Failure> {
    let far = points.iter().flatten().find(|value| value.is_nan() || value.abs() > FARTHEST_M);
    far.map_or(Ok(()), |value| {
        let what = format!("{value} m is too far");
        Err(source.refuse(Some(span), what, format!("metres, at most {FARTHEST_M}")))
    })
}

fn sensor(source: &Source<'_>, entry: &SensorEntry) -> Result<Sensor, Failure> {
    let name = entry.name.as_ref();
    check_followed(name)
        .map_err(|failure| source.refuse(Some(entry.name.span()), failure.message, failure.hint))?;
    let (pose, span) = (entry.pose.as_ref(), entry.pose.span());
    finite(source, span.clone(), &[[pose.x, pose.y]])?;
    if pose.yaw.is_nan() || pose.yaw.abs() > std::f64::consts::TAU {
        let what = format!("yaw {} of sensor {name}", pose.yaw);
        return Err(source.refuse(Some(span), what, "radians, at most one turn: 1.5708 looks along y"));
    }
    Ok(Sensor {
        name: name.clone(),
        place: [pose.x, pose.y],
        yaw_rad: pose.yaw,
        is_upside_down: pose.upside_down,
    })
}

fn room(source: &Source<'_>, entry: &RoomEntry) -> Result<Room, Failure> {
    let (name, polygon) = (entry.name.as_ref(), entry.polygon.as_ref());
    corners(source, &format!("room {name}"), &entry.polygon)?;
    let size = area(polygon).abs();
    if size < 0.25 {
        let what = format!("room {name}: {size:.2} m2");
        return Err(source.refuse(Some(entry.polygon.span()), what, "meters, at least 0.25 m2"));
    }
    Ok(Room { name: name.clone(), polygon: polygon.clone() })
}

/// Checks the polygon of `what`: three corners or more, and sides that do not cross.
fn corners(source: &Source<'_>, what: &str, polygon: &Spanned<Vec<Point>>) -> Result<(), Failure> {
    let (span, polygon) = (polygon.span(), polygon.as_ref());
    finite(source, span.clone(), polygon)?;
    if polygon.len() < 3 {
        return Err(source.refuse(
            Some(span),
            format!("{what}: {} corners", polygon.len()),
            "at least three",
        ));
    }
    if crosses_itself(polygon) {
        let remedy = "give the corners in their order around it";
        return Err(source.refuse(Some(span), format!("{what}: its sides cross"), remedy));
    }
    Ok(())
}

fn ignored(source: &Source<'_>, entry: &IgnoreEntry, site: &Site) -> Result<Ignored, Failure> {
    let (name, polygon) = (entry.name.as_ref(), entry.polygon.as_ref());
    corners(source, &format!("ignored area {name}"), &entry.polygon)?;
    let size = area(polygon).abs();
    if size < LEAST_IGNORED_M2 {
        let what = format!("ignored area {name}: {size:.3} m2");
        let remedy = format!("meters, at least {LEAST_IGNORED_M2} m2");
        return Err(source.refuse(Some(entry.polygon.span()), what, remedy));
    }
    if !site.rooms.iter().any(|room| overlap(&room.polygon, polygon, 0.0)) {
        let what = format!("ignored area {name} is in no room");
        let remedy = "correct its corners; `scanhub site check FILE --svg OUT` draws the rooms";
        return Err(source.refuse(Some(entry.polygon.span()), what, remedy));
    }
    if let Some(room) = site.rooms.iter().find(|room| room.polygon.iter().all(|&at| contains(polygon, at))) {
        let what = format!("ignored area {name} covers room {}", room.name);
        return Err(source.refuse(
            Some(entry.polygon.span()),
            what,
            "make it smaller, or leave the room out",
        ));
    }
    Ok(Ignored { name: name.clone(), polygon: polygon.clone() })
}

fn no_overlap(source: &Source<'_>, file: &File, site: &Site) -> Result<(), Failure> {
    for (i, room) in site.rooms.iter().enumerate() {
        if let Some(other) =
            site.rooms[..i].iter().find(|other| overlap(&room.polygon, &other.polygon, OVERLAP_M))
        {
            let what = format!("rooms {} and {} overlap", other.name, room.name);
            let remedy =
                "move a corner: rooms may only touch; `scanhub site check FILE --svg OUT` draws them";
            return Err(source.refuse(Some(file.room[i].polygon.span()), what, remedy));
        }
    }
    Ok(())
}

fn door(source: &Source<'_>, entry: &DoorEntry, site: &Site) -> Result<Door, Failure> {
    let name = entry.name.as_ref();
    let side = |said: &Spanned<String>| {
        let room = said.as_ref().as_str();
        if room == OUTSIDE {
            return Ok(None);
        }
        let found = site.rooms.iter().position(|known| known.name == room);
        found.map(Some).ok_or_else(|| {
            let mut known: Vec<&str> = site.rooms.iter().map(|room| room.name.as_str()).collect();
            known.push(OUTSIDE);
            let remedy = format!("{}Rooms here: {}", nearest(room, &known), known.join(", "));
            source.refuse(Some(said.span()), format!("door {name}: no room {room:?}"), remedy)
        })
    };
    let (from, to) = (side(&entry.from)?, side(&entry.to)?);
    if from == to {
        let what = format!("door {name}: both sides are {:?}", entry.to.as_ref());
        return Err(source.refuse(Some(entry.to.span()), what, "a door leads from one room to another"));
    }
    let (between, span) = (*entry.between.as_ref(), entry.between.span());
    finite(source, span.clone(), &between)?;
    let width = distance(between[0], between[1]);
    if !(0.3..=20.0).contains(&width) {
        let what = format!("door {name}: {width:.2} m wide");
        return Err(source.refuse(Some(span), what, "two jambs, 0.3 to 20 m apart"));
    }
    for room in [from, to].into_iter().flatten().map(|room| &site.rooms[room]) {
        let off = distance_to_border(&room.polygon, middle(between));
        if off > DOOR_OFF_M {
            let what = format!("door {name}: {off:.2} m from the walls of room {}", room.name);
            let remedy = format!("at most {DOOR_OFF_M} m; correct between, or the room");
            return Err(source.refuse(Some(span), what, remedy));
        }
    }
    Ok(Door { name: name.clone(), from, to, between })
}

fn gap(source: &Source<'_>, entry: &GapEntry, site: &Site) -> Result<Gap, Failure> {
    let find = |said: &Spanned<String>| {
        let name = said.as_ref().as_str();
        site.doors.iter().position(|door| door.name == name).ok_or_else(|| {
            let known: Vec<&str> = site.doors.iter().map(|door| door.name.as_str()).collect();
            let remedy = format!("{}Doors here: {}", nearest(name, &known), known.join(", "));
            source.refuse(Some(said.span()), format!("gap: no door {name:?}"), remedy)
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

/// From the rooms with a sensor there is a way to each other room, over doors, outside and gaps.
fn all_reachable(source: &Source<'_>, file: &File, site: &Site) -> Result<(), Failure> {
    let mut reached = site.watched();
    if !reached.contains(&true) {
        let place = site.sensors[0].place;
        let what =
            format!("no sensor is in a room: {} is at [{}, {}]", site.sensors[0].name, place[0], place[1]);
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
        site.doors.iter().for_each(|door| join([door.from, door.to]));
        for Gap { doors: [a, b], .. } in &site.gaps {
            let (a, b) = (&site.doors[*a], &site.doors[*b]);
            [a.from, a.to]
                .into_iter()
                .for_each(|one| [b.from, b.to].into_iter().for_each(|two| join([one, two])));
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
