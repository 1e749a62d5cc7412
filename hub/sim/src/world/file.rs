//! A scene from TOML: the keys and their valid values. Every value is checked where it is written, so that a failure names
//! file, line and column. Described in `docs/worlds.md`.

use std::ops::Range;

use schema::Failure;
use serde::Deserialize;
use toml::Spanned;

use crate::layers::Layers;
use crate::people::{Plan, Speed, Way, distance};
use crate::scene::{Move, Scene, Sensor, Sun, Surface, Thing};
use crate::shape::{Point, Pose, Shape};
use crate::solid::Heights;
use crate::world::mount::MountFile;
use crate::world::origin::Origin;

/// The scene that `text` describes; `name` is how failures call it.
///
/// [`Kind::Configuration`] for whatever is no scene, with place, value and remedy.
pub(crate) fn parse(name: &str, text: &str) -> Result<Scene, Failure> {
    let origin = Origin { name, text };
    let file: SceneFile = toml::from_str(text).map_err(|error| origin.explain(&error))?;
    let sensor = |file: &SensorFile| {
        let mount =
            file.mount.as_ref().map(|mount| mount.get_ref().mount(mount.span(), &origin)).transpose()?;
        Ok(Sensor { pose: pose(&origin, &file.pose)?, mount })
    };
    let sensors = file.sensor.iter().map(sensor).collect::<Result<Vec<_>, _>>()?;
    Ok(Scene {
        sensors: if sensors.is_empty() { vec![Sensor { pose: MIDDLE, mount: None }] } else { sensors },
        layers: file.noise.layers(&origin)?,
        things: file
            .thing
            .iter()
            .map(|thing| thing.get_ref().thing(thing.span(), &origin))
            .collect::<Result<_, _>>()?,
        people: file
            .person
            .iter()
            .map(|person| person.get_ref().plan(person.span(), &origin))
            .collect::<Result<_, _>>()?,
        suns: file.sun.iter().map(|sun| sun.sun(&origin)).collect::<Result<_, _>>()?,
    })
}

/// A sensor in the middle of its world that looks along y, so that angles are those of a page.
const MIDDLE: Pose = Pose { x_mm: 0.0, y_mm: 0.0, turn_deg: 90.0 };

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
    /// The key of when 0 was right: refused, because its values are possible in both frames.
    sector_deg: Option<Spanned<(Number, Number)>>,
    from_s: Option<Spanned<f64>>,
    until_s: Option<Spanned<f64>>,
    share: Option<Spanned<f64>>,
}

impl NoiseFile {
    fn layers(&self, origin: &Origin) -> Result<Layers, Failure> {
        let all = Layers::default();
        let length = |value: &Option<Spanned<f64>>, usual| origin.number(value, usual, 0.0..=1_000.0);
        let share = |value: &Option<Spanned<f64>>, usual| origin.number(value, usual, 0.0..=1.0);
        Ok(Layers {
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
    fn thing(&self, span: Range<usize>, origin: &Origin) -> Result<Thing, Failure> {
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        let mut moves: Vec<Move> = Vec::new();
        for file in &self.moves {
            let (start_s, end_s) = (*file.from_s.get_ref(), *file.until_s.get_ref());
            let earliest_s = moves.last().map_or(from_s, |way| way.until_s);
            if !(earliest_s <= start_s && start_s <= end_s) {
                let what = format!("a move from {start_s} s until {end_s} s, after {earliest_s} s");
                let remedy = "moves one after the other once it is put down, each with from_s <= until_s";
                return Err(origin.refuse(file.from_s.span(), what, remedy));
            }
            if end_s > until_s {
                let what = format!("a move until {end_s} s of what is taken away at {until_s} s");
                return Err(origin.refuse(file.until_s.span(), what, "moves while it is there"));
            }
            moves.push(Move { from_s: start_s, until_s: end_s, by: pose(origin, &file.by)? });
        }
        Ok(Thing {
            shapes: self.shapes(span, origin)?,
            heights: self.heights(origin)?,
            is_box: self.sides.is_some(),
            pose: self.pose.as_ref().map_or(Ok(Pose { turn_deg: 0.0, ..MIDDLE }), |at| pose(origin, at))?,
            surface: self.surface.as_ref().map_or(Ok(Surface::Plain), |name| surface(origin, name))?,
            from_s,
            until_s,
            moves,
            jitter_mm: origin.number(&self.jitter_mm, 0.0, 0.0..=1_000.0)?,
        })
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
    fn plan(&self, span: Range<usize>, origin: &Origin) -> Result<Plan, Failure> {
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        Ok(Plan {
            way: self.way(span, origin, from_s, until_s)?,
            from_s,
            until_s,
            jitter_mm: origin.number(&self.jitter_mm, 0.0, 0.0..=10_000.0)?,
            leg_mm: origin.number(&self.leg_mm, 60.0, 1.0..=200.0)?,
        })
    }

    fn way(&self, span: Range<usize>, origin: &Origin, from_s: f64, until_s: f64) -> Result<Way, Failure> {
        let (path, speed) = match (&self.path, self.centre, self.reach, &self.speed_mm_s) {
            (None, Some(centre), Some(reach), None) if self.repeat.is_none() => {
                return Ok(Way::Roam { centre: point(centre), reach: (reach.0.0, reach.1.0) });
            }
            (Some(path), None, None, speed) => (path, speed),
            _ => {
                let remedy = "path = [[x, y], ..], or centre = [x, y] with reach = [x, y] and no speed";
                return Err(origin.refuse(span, "a person with no path, or with two", remedy));
            }
        };
        let corner = |values: &Vec<Number>| match values[..] {
            [x, y] => Some(((x.0, y.0), 0.0)),
            [x, y, rest_s] if rest_s.0 >= 0.0 => Some(((x.0, y.0), rest_s.0)),
            _ => None,
        };
        let corners = path.get_ref().iter().map(corner).collect::<Option<Vec<_>>>();
        let Some(corners) = corners.filter(|corners| !corners.is_empty()) else {
            let remedy = "path = [[x, y], [x, y, seconds of rest], ..] in millimetres";
            return Err(origin.refuse(path.span(), "a path without points", remedy));
        };
        let rest_s: f64 = corners.iter().map(|corner| corner.1).sum();
        if corners.len() > 1 && rest_s >= until_s - from_s {
            let what = format!("{rest_s} s of rest from {from_s} s until {until_s} s");
            return Err(origin.refuse(path.span(), what, "rests that leave time to walk"));
        }
        let speed = match (speed, corners.len()) {
            (None, 1) => Speed::InTime,
            (None, _) if until_s.is_finite() => Speed::InTime,
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
        let length: f64 = corners.windows(2).map(|pair| distance(pair[0].0, pair[1].0)).sum();
        if let Some(repeat) = repeats.filter(|_| speed == Speed::InTime || length == 0.0) {
            let remedy = "repeat = true only beside a path with several corners and speed_mm_s";
            return Err(origin.refuse(repeat.span(), "a path that cannot be walked again and again", remedy));
        }
        Ok(Way::Path { corners, speed, repeats: repeats.is_some() })
    }
}

impl SunFile {
    fn sun(&self, origin: &Origin) -> Result<Sun, Failure> {
        if let Some(sector) = &self.sector_deg {
            let (from, to) = point(*sector.get_ref());
            let what = format!("sector_deg = [{from}, {to}] counts angles from the right");
            let [from, to] = [from, to].map(|deg| (deg * 1000.0 - 90_000.0).round() / 1000.0);
            let remedy = format!("angles are counted from ahead now: from_deg = {from:?}, to_deg = {to:?}");
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

/// A coordinate in millimetres, an angle in degrees, a time in seconds.
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

/// A length in millimetres that is one.
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
            let what = format!("{} numbers are no pose", other.len());
            Err(origin.refuse(values.span(), what, "[x, y] in millimetres, or [x, y, degrees]"))
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
