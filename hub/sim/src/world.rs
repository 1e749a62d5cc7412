//! The available worlds: artificial ones that test the line and the hub, built-in scenes, and scenes in TOML files.
//!
//! The parser keeps the position of each value in a file, so that a failure names file, line and column.
//! `docs/worlds.md` describes the format.

use std::ops::{Range, RangeInclusive};
use std::path::Path;
use std::str::FromStr;
use std::sync::Arc;

use scanhub_files::regular_file;
use scanhub_schema::{Failure, Kind};
use serde::Deserialize;
use toml::Spanned;

use crate::beam::NoiseModel;
use crate::mount::{Fault, FaultKind, Mount};
use crate::scene::{
    Corner, Movement, Object, PersonSpec, SIT_DOWN_S, Scene, Sensor, Speed, Sun, Surface, WalkPath, length,
};
use crate::shape::{Heights, Point, Pose, Shape};

/// The surroundings of the simulated scanners.
#[derive(Clone, Debug, PartialEq)]
pub enum World {
    /// No surface within the maximum range.
    Empty,
    /// A wall around the scanner at which every value is 640. The bytes of each value are `80 02`, so the last byte of
    /// each value and the first byte of the next value look like the start of a header, `02 80`.
    Wall640,
    /// Random values, in which all bits that the mode allows may be set.
    Random,
    /// Walls, objects and people.
    Scene(Arc<Scene>),
}

/// The built-in scenes: name and text.
const SCENES: [(&str, &str); 16] = [
    ("room", include_str!("../../../tests/worlds/room.toml")),
    ("bare", include_str!("../../../tests/worlds/bare.toml")),
    ("fig8", include_str!("../../../tests/worlds/fig8.toml")),
    ("standing", include_str!("../../../tests/worlds/standing.toml")),
    ("approach", include_str!("../../../tests/worlds/approach.toml")),
    ("door", include_str!("../../../tests/worlds/door.toml")),
    ("corridor", include_str!("../../../tests/worlds/corridor.toml")),
    ("glass", include_str!("../../../tests/worlds/glass.toml")),
    ("faint", include_str!("../../../tests/worlds/faint.toml")),
    ("sun", include_str!("../../../tests/worlds/sun.toml")),
    ("chair", include_str!("../../../tests/worlds/chair.toml")),
    ("strips", include_str!("../../../tests/worlds/strips.toml")),
    ("crowd", include_str!("../../../tests/worlds/crowd.toml")),
    ("demo", include_str!("../../../tests/worlds/demo.toml")),
    ("house", include_str!("../../../tests/worlds/house.toml")),
    ("tilt", include_str!("../../../tests/worlds/tilt.toml")),
];

impl World {
    /// Returns the names of all worlds that need no file.
    pub fn names() -> impl Iterator<Item = &'static str> {
        SCENES.iter().map(|(name, _)| *name).chain(["empty", "wall640", "random"])
    }

    /// Parses the world that `text` describes in TOML. Failures use `name` as the name of the file.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`], with position, value and remedy, if `text` does not describe a world.
    pub fn of_toml(name: &str, text: &str) -> Result<World, Failure> {
        parse_scene(name, text).map(|scene| World::Scene(Arc::new(scene)))
    }

    /// Returns the number of sensors in the world.
    pub fn sensors(&self) -> usize {
        match self {
            World::Scene(scene) => scene.sensors.len(),
            _ => 1,
        }
    }

    /// Returns the mount of the sensor with the index `sensor`, or `None` if this sensor has no mount.
    pub fn mount(&self, sensor: usize) -> Option<&Mount> {
        match self {
            World::Scene(scene) => scene.sensors.get(sensor)?.mount.as_ref(),
            _ => None,
        }
    }

    /// Returns the world with `faults` as the faults of all its mounts.
    pub fn with_mount_faults(self, faults: &[Fault]) -> World {
        let World::Scene(scene) = self else { return self };
        let mut scene = Arc::unwrap_or_clone(scene);
        let mounts = scene.sensors.iter_mut().filter_map(|sensor| sensor.mount.as_mut());
        mounts.for_each(|mount| mount.faults = faults.to_vec());
        World::Scene(Arc::new(scene))
    }

    /// Returns the noise, or `None` if the world is not a scene.
    pub fn noise(&self) -> Option<NoiseModel> {
        match self {
            World::Scene(scene) => Some(scene.noise),
            _ => None,
        }
    }

    /// Returns the world with `noise` as its noise. A world that is not a scene is returned unchanged.
    pub fn with_noise(self, noise: NoiseModel) -> World {
        match self {
            World::Scene(scene) => World::Scene(Arc::new(Scene { noise, ..Arc::unwrap_or_clone(scene) })),
            other => other,
        }
    }
}

impl FromStr for World {
    type Err = Failure;

    /// Returns the world with the name `text`, or the world in the file at the path `text`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] if there is no such world and the file cannot be read. Returns [`Kind::Configuration`],
    /// with position and remedy, if the file is invalid.
    fn from_str(text: &str) -> Result<World, Failure> {
        match text {
            "empty" => Ok(World::Empty),
            "wall640" => Ok(World::Wall640),
            "random" => Ok(World::Random),
            _ => match SCENES.iter().find(|(name, _)| *name == text) {
                Some((name, contents)) => World::of_toml(name, contents),
                None => World::of_toml(text, &read(text)?),
            },
        }
    }
}

fn read(path: &str) -> Result<String, Failure> {
    regular_file::read_text(Path::new(path), regular_file::MAX_FILE_BYTES).map_err(|error| {
        let names: Vec<_> = World::names().collect();
        let message = format!("world {path:?} is not known, and as a file: {error}");
        Failure::new(Kind::Input, message, format!("a TOML file, or one of: {}", names.join(", ")))
    })
}

/// Parses the scene that `text` describes. Failures use `name` as the name of the file.
///
/// # Errors
///
/// Returns [`Kind::Configuration`], with position, value and remedy, if `text` does not describe a scene.
fn parse_scene(name: &str, text: &str) -> Result<Scene, Failure> {
    let origin = Origin { name, text };
    let file: SceneFile = toml::from_str(text).map_err(|error| origin.explain(&error))?;
    let sensor = |file: &SensorFile| {
        let mount =
            file.mount.as_ref().map(|mount| mount.get_ref().mount(mount.span(), &origin)).transpose()?;
        Ok(Sensor { pose: pose(&origin, &file.pose)?, mount })
    };
    let sensors = file.sensor.iter().map(sensor).collect::<Result<Vec<_>, _>>()?;
    Ok(Scene {
        sensors: if sensors.is_empty() { vec![Sensor { pose: PAGE_POSE, mount: None }] } else { sensors },
        noise: file.noise.model(&origin)?,
        objects: file
            .thing
            .iter()
            .map(|object| object.get_ref().object(object.span(), &origin))
            .collect::<Result<_, _>>()?,
        people: file
            .person
            .iter()
            .map(|person| person.get_ref().person_spec(person.span(), &origin))
            .collect::<Result<_, _>>()?,
        suns: file.sun.iter().map(|sun| sun.sun(&origin)).collect::<Result<_, _>>()?,
    })
}

/// Pose of a sensor without a configured pose: at the origin of the world, facing along y. Its frame has x to the right
/// and y ahead, like the world in a drawing.
const PAGE_POSE: Pose = Pose { x_mm: 0.0, y_mm: 0.0, turn_deg: 90.0 };

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneFile {
    #[serde(default)]
    sensor: Vec<SensorFile>,
    #[serde(default)]
    noise: NoiseFile,
    #[serde(default)]
    thing: Vec<Spanned<ThingFile>>,
    #[serde(default)]
    person: Vec<Spanned<PersonFile>>,
    #[serde(default)]
    sun: Vec<SunFile>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SensorFile {
    pose: Spanned<Vec<Number>>,
    mount: Option<Spanned<MountFile>>,
}

#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct NoiseFile {
    bias_mm: Option<Spanned<f64>>,
    sigma_mm: Option<Spanned<f64>>,
    tail: Option<Spanned<f64>>,
    spot: Option<bool>,
    errors: Option<Spanned<f64>>,
    weak: Option<bool>,
    dazzle: Option<bool>,
    comb: Option<bool>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ThingFile {
    line: Option<Vec<(Number, Number)>>,
    #[serde(rename = "box")]
    sides: Option<(Length, Length)>,
    legs: Option<(Length, Length)>,
    radius_mm: Option<Spanned<f64>>,
    pose: Option<Spanned<Vec<Number>>>,
    surface: Option<Spanned<String>>,
    height_mm: Option<Spanned<f64>>,
    above_mm: Option<Spanned<f64>>,
    from_s: Option<Spanned<f64>>,
    until_s: Option<Spanned<f64>>,
    #[serde(default)]
    moves: Vec<MoveFile>,
    repeat_s: Option<Spanned<f64>>,
    jitter_mm: Option<Spanned<f64>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MoveFile {
    from_s: Spanned<f64>,
    until_s: Spanned<f64>,
    by: Spanned<Vec<Number>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PersonFile {
    path: Option<Spanned<Vec<Vec<Number>>>>,
    speed_mm_s: Option<Spanned<SpeedFile>>,
    centre: Option<(Number, Number)>,
    reach: Option<(Length, Length)>,
    repeat: Option<Spanned<bool>>,
    from_s: Option<Spanned<f64>>,
    until_s: Option<Spanned<f64>>,
    jitter_mm: Option<Spanned<f64>>,
    leg_mm: Option<Spanned<f64>>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(untagged)]
enum SpeedFile {
    Always(f64),
    Between(f64, f64),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SunFile {
    from_deg: Option<Spanned<f64>>,
    to_deg: Option<Spanned<f64>>,
    /// Key of an earlier version, whose angle 0 was to the right. The parser refuses it, because most of its values
    /// would also be valid angles from ahead.
    sector_deg: Option<Spanned<(Number, Number)>>,
    from_s: Option<Spanned<f64>>,
    until_s: Option<Spanned<f64>>,
    share: Option<Spanned<f64>>,
}

impl NoiseFile {
    fn model(&self, origin: &Origin) -> Result<NoiseModel, Failure> {
        let all = NoiseModel::default();
        let length = |value: &Option<Spanned<f64>>, usual| origin.number(value, usual, 0.0..=1_000.0);
        let share = |value: &Option<Spanned<f64>>, usual| origin.number(value, usual, 0.0..=1.0);
        Ok(NoiseModel {
            bias_mm: length(&self.bias_mm, all.bias_mm)?,
            sigma_mm: length(&self.sigma_mm, all.sigma_mm)?,
            tail: share(&self.tail, all.tail)?,
            spot: self.spot.unwrap_or(all.spot),
            errors: share(&self.errors, all.errors)?,
            weak: self.weak.unwrap_or(all.weak),
            dazzle: self.dazzle.unwrap_or(all.dazzle),
            comb: self.comb.unwrap_or(all.comb),
        })
    }
}

impl ThingFile {
    fn object(&self, span: Range<usize>, origin: &Origin) -> Result<Object, Failure> {
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        let mut moves: Vec<Movement> = Vec::new();
        for file in &self.moves {
            let (start_s, end_s) = (*file.from_s.get_ref(), *file.until_s.get_ref());
            let earliest_s = moves.last().map_or(from_s, |movement| movement.until_s);
            if !(earliest_s <= start_s && start_s <= end_s) {
                let what = format!("a move from {start_s} s until {end_s} s, after {earliest_s} s");
                let remedy = "moves one after the other once it is put down, each with from_s <= until_s";
                return Err(origin.refuse(file.from_s.span(), what, remedy));
            }
            if end_s > until_s {
                let what = format!("a move until {end_s} s of a thing that is removed at {until_s} s");
                return Err(origin.refuse(
                    file.until_s.span(),
                    what,
                    "end all moves before the thing is removed",
                ));
            }
            moves.push(Movement { from_s: start_s, until_s: end_s, offset: pose(origin, &file.by)? });
        }
        Ok(Object {
            shapes: self.shapes(span, origin)?,
            heights: self.heights(origin)?,
            is_box: self.sides.is_some(),
            pose: self
                .pose
                .as_ref()
                .map_or(Ok(Pose { turn_deg: 0.0, ..PAGE_POSE }), |at| pose(origin, at))?,
            surface: self.surface.as_ref().map_or(Ok(Surface::Plain), |name| surface(origin, name))?,
            from_s,
            until_s,
            repeat_s: self.repeat_s(&moves, origin)?,
            moves,
            jitter_mm: origin.number(&self.jitter_mm, 0.0, 0.0..=1_000.0)?,
        })
    }

    /// Returns the time after which `moves` start again, or `None` if they happen once.
    fn repeat_s(&self, moves: &[Movement], origin: &Origin) -> Result<Option<f64>, Failure> {
        let Some(repeat) = &self.repeat_s else { return Ok(None) };
        let repeat_s = origin.number(&self.repeat_s, 0.0, 0.1..=1e6)?;
        let sum =
            |part: fn(&Pose) -> f64| moves.iter().map(|movement| part(&movement.offset)).sum::<f64>().abs();
        let returns =
            [sum(|by| by.x_mm), sum(|by| by.y_mm), sum(|by| by.turn_deg)].iter().all(|sum| *sum < 1e-6);
        let lasts_s = moves.first().zip(moves.last()).map(|(first, last)| last.until_s - first.from_s);
        match lasts_s {
            Some(lasts_s) if returns && lasts_s <= repeat_s => Ok(Some(repeat_s)),
            _ => {
                let what = format!("moves that cannot be repeated every {repeat_s} s");
                Err(origin.refuse(
                    repeat.span(),
                    what,
                    "moves that end where they began, and within repeat_s",
                ))
            }
        }
    }

    fn heights(&self, origin: &Origin) -> Result<Heights, Failure> {
        let from_mm = origin.number(&self.above_mm, Heights::ALL.from_mm, 0.0..=10_000.0)?;
        let to_mm = origin.number(&self.height_mm, Heights::ALL.to_mm, 1.0..=10_000.0)?;
        match &self.above_mm {
            Some(above) if from_mm >= to_mm => {
                let what = format!("above_mm = {from_mm}, height_mm = {to_mm}");
                Err(origin.refuse(above.span(), what, "both from the floor, the top above the bottom"))
            }
            _ => Ok(Heights { from_mm, to_mm }),
        }
    }

    fn shapes(&self, span: Range<usize>, origin: &Origin) -> Result<Vec<Shape>, Failure> {
        const REMEDY: &str = "one of: line = [[x, y], ..], box = [width, depth], radius_mm = R for a post, \
                              legs = [width, depth] with the radius_mm of each";
        let corners = |(width, depth): (Length, Length)| {
            let (x, y) = (width.0 / 2.0, depth.0 / 2.0);
            [(-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)].map(|(x, y)| (Number(x), Number(y)))
        };
        let walls = |points: &[(Number, Number)]| {
            let wall = |pair: &[(Number, Number)]| Shape::Wall { from: point(pair[0]), to: point(pair[1]) };
            points.windows(2).map(wall).collect()
        };
        let radius = origin.number(&self.radius_mm, 0.0, 1.0..=10_000.0)?;
        match (&self.line, &self.sides, &self.legs, &self.radius_mm) {
            (Some(line), None, None, None) if line.len() >= 2 => Ok(walls(line)),
            (None, Some(sides), None, None) => Ok(walls(&corners(*sides))),
            (None, None, Some(legs), Some(_)) => {
                let feet = corners(*legs);
                Ok(feet[..4].iter().map(|&foot| Shape::Post { centre: point(foot), radius }).collect())
            }
            (None, None, None, Some(_)) => Ok(vec![Shape::Post { centre: (0.0, 0.0), radius }]),
            _ => Err(origin.refuse(span, "a thing with no shape, or with more than one", REMEDY)),
        }
    }
}

impl PersonFile {
    fn person_spec(&self, span: Range<usize>, origin: &Origin) -> Result<PersonSpec, Failure> {
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        Ok(PersonSpec {
            path: self.path(span, origin, from_s, until_s)?,
            from_s,
            until_s,
            jitter_mm: origin.number(&self.jitter_mm, 0.0, 0.0..=10_000.0)?,
            leg_mm: origin.number(&self.leg_mm, 60.0, 1.0..=200.0)?,
        })
    }

    fn path(
        &self,
        span: Range<usize>,
        origin: &Origin,
        from_s: f64,
        until_s: f64,
    ) -> Result<WalkPath, Failure> {
        let (path, speed) = match (&self.path, self.centre, self.reach, &self.speed_mm_s) {
            (None, Some(centre), Some(reach), None) if self.repeat.is_none() => {
                return Ok(WalkPath::Roam { centre: point(centre), reach: (reach.0.0, reach.1.0) });
            }
            (Some(path), None, None, speed) => (path, speed),
            _ => {
                let remedy = "path = [[x, y], ..], or centre = [x, y] with reach = [x, y] and no speed";
                return Err(origin.refuse(span, "a person with no path, or with two", remedy));
            }
        };
        let corner = |values: &Vec<Number>| {
            let (&[x, y], rest) = values.split_first_chunk()?;
            let (rest_s, seat_deg) = match rest {
                [] => (0.0, None),
                [rest_s] => (rest_s.0, None),
                [rest_s, seat_deg] => (rest_s.0, Some(seat_deg.0)),
                _ => return None,
            };
            (rest_s >= 0.0).then_some(Corner { point: (x.0, y.0), pause_s: rest_s, seat_deg })
        };
        let corners = path.get_ref().iter().map(corner).collect::<Option<Vec<_>>>();
        let Some(corners) = corners.filter(|corners| !corners.is_empty()) else {
            let remedy = "path = [[x, y], [x, y, seconds of rest], [x, y, seconds, degrees that a sitter faces], ..] \
                          in millimeters";
            return Err(origin.refuse(path.span(), "a path without points", remedy));
        };
        let is_short = |corner: &&Corner| corner.seat_deg.is_some() && corner.pause_s < 2.0 * SIT_DOWN_S;
        if let Some(corner) = corners.iter().find(is_short).filter(|_| corners.len() > 1) {
            let what = format!("a person who sits for {} s", corner.pause_s);
            let least_s = 2.0 * SIT_DOWN_S;
            let remedy = format!("{least_s} s or more: to sit down and to stand up take {SIT_DOWN_S} s each");
            return Err(origin.refuse(path.span(), what, remedy));
        }
        let rest_s: f64 = corners.iter().map(|corner| corner.pause_s).sum();
        if corners.len() > 1 && rest_s >= until_s - from_s {
            let what = format!("{rest_s} s of rest from {from_s} s until {until_s} s");
            return Err(origin.refuse(path.span(), what, "rests that leave time to walk"));
        }
        let speed = match (speed, corners.len()) {
            (None, 1) => Speed::ToEnd,
            (None, _) if until_s.is_finite() => Speed::ToEnd,
            (Some(speed), 2..) if until_s.is_infinite() => {
                let (slowest, fastest) = match *speed.get_ref() {
                    SpeedFile::Always(speed) => (speed, speed),
                    SpeedFile::Between(slowest, fastest) => (slowest, fastest),
                };
                if !(1.0 <= slowest && slowest <= fastest && fastest <= 10_000.0) {
                    let what = format!("speed_mm_s from {slowest} to {fastest}");
                    return Err(origin.refuse(speed.span(), what, "1 to 10000 mm/s, the slower one first"));
                }
                Speed::Between(slowest, fastest)
            }
            _ => {
                let what = "the person's speed is not set, or set by two keys";
                let remedy = "give a path speed_mm_s or until_s; a person at one point has no speed";
                return Err(origin.refuse(path.span(), what, remedy));
            }
        };
        let repeats = self.repeat.as_ref().filter(|repeat| *repeat.get_ref());
        if let Some(repeat) = repeats.filter(|_| speed == Speed::ToEnd || length(&corners) == 0.0) {
            let remedy = "set repeat = true only with a path with several corners and speed_mm_s";
            return Err(origin.refuse(repeat.span(), "a path that cannot be repeated", remedy));
        }
        Ok(WalkPath::Path { corners, speed, repeats: repeats.is_some() })
    }
}

impl SunFile {
    fn sun(&self, origin: &Origin) -> Result<Sun, Failure> {
        if let Some(sector) = &self.sector_deg {
            let (from, to) = point(*sector.get_ref());
            let what = format!("sector_deg = [{from}, {to}] counts angles from the right");
            let [from, to] = [from, to].map(|deg| (deg * 1000.0 - 90_000.0).round() / 1000.0);
            let remedy = format!("angles count from ahead: from_deg = {from:?}, to_deg = {to:?}");
            return Err(origin.refuse(sector.span(), what, remedy));
        }
        let from_deg = origin.number(&self.from_deg, -180.0, -180.0..=180.0)?;
        let to_deg = origin.number(&self.to_deg, 180.0, -180.0..=180.0)?;
        if let Some(to) = self.to_deg.as_ref().filter(|_| from_deg > to_deg) {
            let what = format!("from_deg = {from_deg}, to_deg = {to_deg}");
            return Err(origin.refuse(to.span(), what, "angles of the sensor, the smaller one first"));
        }
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        let share = origin.number(&self.share, 1.0, 0.0..=1.0)?;
        Ok(Sun { from_deg, to_deg, from_s, until_s, share })
    }
}

/// A coordinate in millimeters, an angle in degrees, or a time in seconds.
#[derive(Clone, Copy, Deserialize)]
#[serde(try_from = "f64")]
struct Number(f64);

impl TryFrom<f64> for Number {
    type Error = String;

    fn try_from(value: f64) -> Result<Number, String> {
        let known = value.abs() <= 1e6;
        known.then_some(Number(value)).ok_or_else(|| format!("{value} is not between -1000000 and 1000000"))
    }
}

/// A length in millimeters, at least 1.
#[derive(Clone, Copy, Deserialize)]
#[serde(try_from = "f64")]
struct Length(f64);

impl TryFrom<f64> for Length {
    type Error = String;

    fn try_from(value: f64) -> Result<Length, String> {
        let known = (1.0..=1e6).contains(&value);
        known.then_some(Length(value)).ok_or_else(|| format!("{value} is not between 1 and 1000000"))
    }
}

fn point((x, y): (Number, Number)) -> Point {
    (x.0, y.0)
}

fn pose(origin: &Origin, values: &Spanned<Vec<Number>>) -> Result<Pose, Failure> {
    match values.get_ref()[..] {
        [x, y] => Ok(Pose { x_mm: x.0, y_mm: y.0, turn_deg: 0.0 }),
        [x, y, turn] => Ok(Pose { x_mm: x.0, y_mm: y.0, turn_deg: turn.0 }),
        ref other => {
            let what = format!("a pose of {} numbers", other.len());
            Err(origin.refuse(values.span(), what, "[x, y] in millimeters, or [x, y, degrees]"))
        }
    }
}

fn surface(origin: &Origin, name: &Spanned<String>) -> Result<Surface, Failure> {
    match name.get_ref().as_str() {
        "plain" => Ok(Surface::Plain),
        "dark" => Ok(Surface::Dark),
        "reflector" => Ok(Surface::Reflector),
        "glass" => Ok(Surface::Glass),
        "faint" => Ok(Surface::Faint),
        other => {
            let what = format!("surface = \"{other}\"");
            Err(origin.refuse(name.span(), what, "plain, dark, reflector, glass or faint"))
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MountFile {
    height_mm: Spanned<f64>,
    arm_mm: Option<(f64, f64)>,
    from_deg: Spanned<f64>,
    to_deg: Spanned<f64>,
    deg_s: Option<Spanned<f64>>,
    reports_hz: Option<Spanned<f64>>,
    #[serde(default)]
    faults: Vec<Spanned<FaultFile>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FaultFile {
    kind: String,
    from_s: Option<Spanned<f64>>,
    until_s: Option<Spanned<f64>>,
    by_deg: Option<Spanned<f64>>,
    by_s: Option<Spanned<f64>>,
}

impl MountFile {
    fn mount(&self, span: Range<usize>, origin: &Origin) -> Result<Mount, Failure> {
        let within = |value: &Spanned<f64>, allowed| origin.number(&Some(value.clone()), 0.0, allowed);
        let (from_deg, to_deg) = (within(&self.from_deg, -80.0..=80.0)?, within(&self.to_deg, -80.0..=80.0)?);
        if to_deg - from_deg < 1.0 {
            let what = format!("a mount that swings from {from_deg} to {to_deg} degrees");
            return Err(origin.refuse(
                span,
                what,
                "from_deg below to_deg, by a degree at least; down is positive",
            ));
        }
        let faults = self.faults.iter().map(|fault| fault.get_ref().fault(fault.span(), origin));
        Ok(Mount {
            height_mm: within(&self.height_mm, 1.0..=10_000.0)?,
            arm_mm: self.arm_mm.unwrap_or_default(),
            from_deg,
            to_deg,
            deg_s: origin.number(&self.deg_s, 30.0, 1.0..=360.0)?,
            reports_hz: origin.number(&self.reports_hz, 100.0, 1.0..=10_000.0)?,
            faults: faults.collect::<Result<_, _>>()?,
        })
    }
}

impl FaultFile {
    fn fault(&self, span: Range<usize>, origin: &Origin) -> Result<Fault, Failure> {
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        let by_deg = || origin.number(&self.by_deg, 8.0, -80.0..=80.0);
        let kind = match self.kind.as_str() {
            "halts" => FaultKind::Halt,
            "silent" => FaultKind::Silence,
            "stuck" => FaultKind::Stuck,
            "jumps" => FaultKind::Jump(by_deg()?),
            "lies" => FaultKind::Drift(by_deg()?),
            "late" => FaultKind::Delay(origin.number(&self.by_s, 0.3, 0.0..=10.0)?),
            "stamps_late" => FaultKind::StampDelay(origin.number(&self.by_s, 0.03, -1.0..=1.0)?),
            other => {
                let remedy = "halts, silent, stuck, jumps or lies with by_deg, late or stamps_late with by_s";
                return Err(origin.refuse(span, format!("kind = \"{other}\""), remedy));
            }
        };
        Ok(Fault { kind, from_s, until_s })
    }
}

/// The text of a file, and its name in failures.
struct Origin<'a> {
    name: &'a str,
    text: &'a str,
}

impl Origin<'_> {
    /// Returns `value`, which must be within `allowed`. Returns `usual` if there is no value.
    fn number(
        &self,
        value: &Option<Spanned<f64>>,
        usual: f64,
        allowed: RangeInclusive<f64>,
    ) -> Result<f64, Failure> {
        match value {
            None => Ok(usual),
            Some(value) if allowed.contains(value.get_ref()) => Ok(*value.get_ref()),
            Some(value) => {
                let remedy = format!("a number from {} to {}", allowed.start(), allowed.end());
                Err(self.refuse(value.span(), format!("{} is out of range", value.get_ref()), remedy))
            }
        }
    }

    /// Returns start and end of an interval. By default, the interval starts at 0 and has no end.
    fn interval(
        &self,
        from: &Option<Spanned<f64>>,
        until: &Option<Spanned<f64>>,
    ) -> Result<(f64, f64), Failure> {
        let from_s = self.number(from, 0.0, 0.0..=1e6)?;
        let until_s = self.number(until, f64::INFINITY, 0.0..=1e6)?;
        match until {
            Some(until) if until_s <= from_s => {
                let what = format!("until_s = {until_s}, and from_s = {from_s}");
                Err(self.refuse(until.span(), what, "an end after the start"))
            }
            _ => Ok((from_s, until_s)),
        }
    }

    /// Returns the failure for an invalid value at `span`, with the problem `what` and its `remedy`.
    fn refuse(&self, span: Range<usize>, what: impl std::fmt::Display, remedy: impl Into<String>) -> Failure {
        let before = &self.text[..span.start.min(self.text.len())];
        let line = before.matches('\n').count() + 1;
        let column = before.chars().rev().take_while(|&c| c != '\n').count() + 1;
        Failure::new(Kind::Configuration, format!("{}:{line}:{column}: {what}", self.name), remedy)
    }

    /// Returns the failure for an error of the TOML parser. For an unknown key, the remedy names the most similar known
    /// key.
    fn explain(&self, error: &toml::de::Error) -> Failure {
        let (span, message) = (error.span().unwrap_or_default(), error.message());
        let names: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
        match names[..] {
            [unknown, ref known @ ..] if message.starts_with("unknown field") => {
                let likeness = |name: &str| strsim::jaro_winkler(name, unknown);
                let nearest = known.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)));
                let nearest = nearest.map_or(String::new(), |name| format!("did you mean `{name}`? "));
                let remedy = format!("{nearest}Known here: {}", known.join(", "));
                self.refuse(span, format!("unknown key `{unknown}`"), remedy)
            }
            _ => self.refuse(span, message, "docs/worlds.md has the keys and their forms"),
        }
    }
}
