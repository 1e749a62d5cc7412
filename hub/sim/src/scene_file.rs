//! A scene from TOML: the keys there are, and what each value can be. Every value is checked where it stands, so that a
//! failure names file, line and column. The page is `docs/worlds.md`.

use std::ops::Range;

use schema::{Failure, Kind};
use serde::Deserialize;
use toml::Spanned;

use crate::layers::Layers;
use crate::people::{Plan, Speed, Way};
use crate::scene::{Move, Scene, Sun, Surface, Thing};
use crate::shape::{Point, Pose, Shape};

/// The scene that `text` describes; `name` is how failures call it.
///
/// [`Kind::Configuration`] for whatever is no scene, with place, value and remedy.
pub(crate) fn parse(name: &str, text: &str) -> Result<Scene, Failure> {
    let origin = Origin { name, text };
    let file: SceneFile = toml::from_str(text).map_err(|error| origin.explain(&error))?;
    let sensors =
        file.sensor.iter().map(|sensor| pose(&origin, &sensor.pose)).collect::<Result<Vec<_>, _>>()?;
    Ok(Scene {
        sensors: if sensors.is_empty() { vec![MIDDLE] } else { sensors },
        layers: file.noise.layers(&origin)?,
        things: file.thing.iter().map(|thing| thing.thing(&origin)).collect::<Result<_, _>>()?,
        people: file.person.iter().map(|person| person.plan(&origin)).collect::<Result<_, _>>()?,
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
    thing: Vec<ThingFile>,
    #[serde(default)]
    person: Vec<PersonFile>,
    #[serde(default)]
    sun: Vec<SunFile>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SensorFile {
    pose: Spanned<Vec<f64>>,
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
    line: Option<Spanned<Vec<Point>>>,
    #[serde(rename = "box")]
    sides: Option<Spanned<Point>>,
    legs: Option<Spanned<Point>>,
    radius_mm: Option<Spanned<f64>>,
    pose: Option<Spanned<Vec<f64>>>,
    surface: Option<Spanned<String>>,
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
    by: Spanned<Vec<f64>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PersonFile {
    path: Option<Spanned<Vec<Vec<f64>>>>,
    speed_mm_s: Option<Spanned<SpeedFile>>,
    centre: Option<Point>,
    reach: Option<Spanned<Point>>,
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
    sector_deg: Spanned<Point>,
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
    fn thing(&self, origin: &Origin) -> Result<Thing, Failure> {
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        let mut moves: Vec<Move> = Vec::new();
        for file in &self.moves {
            let (start_s, end_s) = (*file.from_s.get_ref(), *file.until_s.get_ref());
            let earliest_s = moves.last().map_or(0.0, |way| way.until_s);
            if !(earliest_s <= start_s && start_s <= end_s) {
                let what = format!("a move from {start_s} s until {end_s} s, after {earliest_s} s");
                let remedy = "moves one after the other, each with from_s <= until_s";
                return Err(origin.refuse(file.from_s.span(), what, remedy));
            }
            moves.push(Move { from_s: start_s, until_s: end_s, by: pose(origin, &file.by)? });
        }
        Ok(Thing {
            shapes: self.shapes(origin)?,
            pose: self.pose.as_ref().map_or(Ok(Pose { turn_deg: 0.0, ..MIDDLE }), |at| pose(origin, at))?,
            surface: self.surface.as_ref().map_or(Ok(Surface::Plain), |name| surface(origin, name))?,
            from_s,
            until_s,
            moves,
            jitter_mm: origin.number(&self.jitter_mm, 0.0, 0.0..=1_000.0)?,
        })
    }

    fn shapes(&self, origin: &Origin) -> Result<Vec<Shape>, Failure> {
        const REMEDY: &str = "one of: line = [[x, y], ..], box = [width, depth], radius_mm = R for a post, \
                              legs = [width, depth] with the radius_mm of each";
        let corners = |(width, depth): Point| {
            let (x, y) = (width / 2.0, depth / 2.0);
            [(-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)]
        };
        let walls = |points: &[Point]| {
            points.windows(2).map(|pair| Shape::Wall { from: pair[0], to: pair[1] }).collect::<Vec<_>>()
        };
        let radius = origin.number(&self.radius_mm, 0.0, 1.0..=10_000.0)?;
        match (&self.line, &self.sides, &self.legs, &self.radius_mm) {
            (Some(line), None, None, None) if line.get_ref().len() >= 2 => Ok(walls(line.get_ref())),
            (None, Some(sides), None, None) => Ok(walls(&corners(*sides.get_ref()))),
            (None, None, Some(legs), Some(_)) => {
                let feet = corners(*legs.get_ref());
                Ok(feet[..4].iter().map(|&centre| Shape::Post { centre, radius }).collect())
            }
            (None, None, None, Some(_)) => Ok(vec![Shape::Post { centre: (0.0, 0.0), radius }]),
            (line, sides, legs, radius) => {
                let span = line.as_ref().map(Spanned::span).or(sides.as_ref().map(Spanned::span));
                let span = span.or(legs.as_ref().map(Spanned::span)).or(radius.as_ref().map(Spanned::span));
                Err(origin.refuse(
                    span.unwrap_or_default(),
                    "a thing without a shape, or with too many",
                    REMEDY,
                ))
            }
        }
    }
}

impl PersonFile {
    fn plan(&self, origin: &Origin) -> Result<Plan, Failure> {
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        Ok(Plan {
            way: self.way(origin, until_s)?,
            from_s,
            until_s,
            jitter_mm: origin.number(&self.jitter_mm, 0.0, 0.0..=10_000.0)?,
            leg_mm: origin.number(&self.leg_mm, 60.0, 1.0..=200.0)?,
        })
    }

    fn way(&self, origin: &Origin, until_s: f64) -> Result<Way, Failure> {
        let (path, speed) = match (&self.path, self.centre, &self.reach, &self.speed_mm_s) {
            (None, Some(centre), Some(reach), None) => {
                if reach.get_ref().0 <= 0.0 || reach.get_ref().1 <= 0.0 {
                    let what = format!("reach = {:?}", reach.get_ref());
                    return Err(origin.refuse(reach.span(), what, "two lengths in millimetres, above 0"));
                }
                return Ok(Way::Roam { centre, reach: *reach.get_ref() });
            }
            (Some(path), None, None, speed) => (path, speed),
            (path, _, reach, _) => {
                let span = path.as_ref().map(Spanned::span).or(reach.as_ref().map(Spanned::span));
                let remedy = "path = [[x, y], ..], or centre = [x, y] with reach = [x, y] and no speed";
                return Err(origin.refuse(
                    span.unwrap_or_default(),
                    "a person without a way, or with two",
                    remedy,
                ));
            }
        };
        let corner = |values: &Vec<f64>| match values[..] {
            [x, y] => Some(((x, y), 0.0)),
            [x, y, rest_s] if rest_s >= 0.0 => Some(((x, y), rest_s)),
            _ => None,
        };
        let corners = path.get_ref().iter().map(corner).collect::<Option<Vec<_>>>();
        let Some(corners) = corners.filter(|corners| !corners.is_empty()) else {
            let remedy = "path = [[x, y], [x, y, seconds of rest], ..] in millimetres";
            return Err(origin.refuse(path.span(), "a path that is none", remedy));
        };
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
                let what = "nothing says when the person is where, or two keys do";
                let remedy = "give a path speed_mm_s or until_s; who only stands has no speed";
                return Err(origin.refuse(path.span(), what, remedy));
            }
        };
        Ok(Way::Path { corners, speed })
    }
}

impl SunFile {
    fn sun(&self, origin: &Origin) -> Result<Sun, Failure> {
        let (from_deg, to_deg) = *self.sector_deg.get_ref();
        if from_deg > to_deg {
            let what = format!("sector_deg = [{from_deg}, {to_deg}]");
            return Err(origin.refuse(
                self.sector_deg.span(),
                what,
                "angles of the sensor, the smaller one first",
            ));
        }
        let (from_s, until_s) = origin.interval(&self.from_s, &self.until_s)?;
        let share = origin.number(&self.share, 1.0, 0.0..=1.0)?;
        Ok(Sun { from_deg, to_deg, from_s, until_s, share })
    }
}

fn pose(origin: &Origin, values: &Spanned<Vec<f64>>) -> Result<Pose, Failure> {
    match values.get_ref()[..] {
        [x_mm, y_mm] => Ok(Pose { x_mm, y_mm, turn_deg: 0.0 }),
        [x_mm, y_mm, turn_deg] => Ok(Pose { x_mm, y_mm, turn_deg }),
        _ => {
            let what = format!("{:?} is no pose", values.get_ref());
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
        other => {
            let what = format!("surface = \"{other}\"");
            Err(origin.refuse(name.span(), what, "plain, dark, reflector or glass"))
        }
    }
}

/// The file, so that a failure can say the place.
struct Origin<'a> {
    name: &'a str,
    text: &'a str,
}

impl Origin<'_> {
    /// A value within `allowed`, or `usual` where none is said.
    fn number(
        &self,
        value: &Option<Spanned<f64>>,
        usual: f64,
        allowed: std::ops::RangeInclusive<f64>,
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

    fn refuse(&self, span: Range<usize>, what: impl std::fmt::Display, remedy: impl Into<String>) -> Failure {
        let before = &self.text[..span.start.min(self.text.len())];
        let line = before.matches('\n').count() + 1;
        let column = before.chars().rev().take_while(|&c| c != '\n').count() + 1;
        Failure::new(Kind::Configuration, format!("{}:{line}:{column}: {what}", self.name), remedy)
    }

    /// What the TOML parser found wrong; of an unknown key the nearest known one.
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
