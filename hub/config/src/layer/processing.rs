//! The keys of sections pose, zones, marks, lines, motion, background and early, and their valid values. Metres, radians and degrees become the
//! units of the processors. Each value is checked in its own source; this file refuses to know which source wins.

use std::ops::{Range, RangeInclusive};

use preprocess::background::{Candidate, Method, Start};
use preprocess::zones::{SECTORS, Sector};
use schema::{BEAMS, Failure, Family, LINES, ZONES};
use serde::Deserialize;
use toml::Spanned;

use super::early::EarlyLayer;
use super::motion::MotionLayer;
use crate::origin::Origin;
use crate::processing::{Background, Processing, START, Zones};

/// Section `pose` of a link.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "where the sensor sits, as { x = 0.3, y = 0.0, yaw = 1.5708 }")]
pub(super) struct PoseLayer {
    x: Option<Spanned<f64>>,
    y: Option<Spanned<f64>>,
    yaw: Option<Spanned<f64>>,
    upside_down: Option<bool>,
}

/// Section `zones`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of zones, as { radii = [1.0, 0.6] }")]
pub(super) struct ZonesLayer {
    radii: Option<Spanned<Vec<f64>>>,
    self_min: Option<Spanned<Vec<Spanned<SectorLayer>>>>,
    margin: Option<Spanned<f64>>,
    min_beams: Option<Spanned<i64>>,
    min_scans: Option<Spanned<i64>>,
    max_invalid: Option<Spanned<f64>>,
    exact: Option<bool>,
    no_return_is_far: Option<bool>,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "a sector, as { from_deg = -77.5, to_deg = -60.0, range = 0.42 }")]
struct SectorLayer {
    from_deg: Option<f64>,
    to_deg: Option<f64>,
    range: f64,
    /// The keys of when 0 was right. Many of their values are possible in both frames, so none is taken.
    from: Option<f64>,
    to: Option<f64>,
}

/// Section `marks`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of marks, as { i_min = 1 } or { level = 240 }")]
pub(super) struct MarksLayer {
    i_min: Option<Spanned<i64>>,
    level: Option<Spanned<i64>>,
    max_range_step: Option<Spanned<f64>>,
    max_gap: Option<Spanned<i64>>,
}

/// Section `lines`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of lines, as { max = 20, polish = true }")]
pub(super) struct LinesLayer {
    max: Option<Spanned<i64>>,
    min_points: Option<Spanned<i64>>,
    polish: Option<bool>,
}

/// Section `background`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of background, as { method = \"multi\" }")]
pub(super) struct BackgroundLayer {
    method: Option<MethodLayer>,
    threshold_mm: Option<Spanned<i64>>,
    candidate_mm: Option<Spanned<i64>>,
    scans: Option<Spanned<i64>>,
    candidate: Option<CandidateLayer>,
    start: Option<Spanned<String>>,
    keep: Option<bool>,
    no_return_is_far: Option<bool>,
    publish: Option<PublishLayer>,
}

#[derive(Clone, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum MethodLayer {
    Multi,
    Paper,
    Moving,
    Off,
}

#[derive(Clone, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum CandidateLayer {
    First,
    Latest,
}

#[derive(Clone, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum PublishLayer {
    OnDemand,
    EveryScan,
}

/// The sections of one source, for all links or for one.
#[derive(Clone)]
pub(super) struct Sections {
    pub(super) pose: Option<PoseLayer>,
    pub(super) zones: Option<ZonesLayer>,
    pub(super) marks: Option<MarksLayer>,
    pub(super) lines: Option<LinesLayer>,
    pub(super) motion: Option<MotionLayer>,
    pub(super) background: Option<BackgroundLayer>,
    pub(super) early: Option<EarlyLayer>,
}

impl Sections {
    /// Lays what `origin` says over `processing`.
    pub(super) fn lay(self, origin: &Origin, processing: &mut Processing) -> Result<(), Failure> {
        let Sections { pose, zones, marks, lines, motion, background, early } = self;
        if let Some(layer) = pose {
            let pose = &mut processing.pose;
            put(&mut pose.x_m, layer.x, |value| place(origin, "x", value))?;
            put(&mut pose.y_m, layer.y, |value| place(origin, "y", value))?;
            put(&mut pose.yaw_rad, layer.yaw, |value| {
                within(
                    origin,
                    "yaw",
                    value,
                    -TURN..=TURN,
                    "radians, counter-clockwise: 90 degrees are 1.5708",
                )
            })?;
            pose.upside_down = layer.upside_down.map_or(pose.upside_down, u8::from);
        }
        if let Some(layer) = zones {
            layer.lay(origin, &mut processing.zones)?;
        }
        if let Some(layer) = marks {
            let marks = &mut processing.marks;
            put(&mut marks.i_min, layer.i_min, |value| whole(origin, "i_min", value, 1..=7))?;
            put(&mut marks.level, layer.level, |value| {
                whole(origin, "level", value, 1..=i64::from(u16::MAX)).map(Some)
            })?;
            put(&mut marks.max_range_step_mm, layer.max_range_step, |value| {
                millimetres(origin, "max_range_step", value, 0.001..=10.0)
            })?;
            put(&mut marks.max_gap, layer.max_gap, |value| {
                whole(origin, "max_gap", value, 0..=BEAMS as i64)
            })?;
        }
        if let Some(layer) = lines {
            let lines = &mut processing.lines;
            put(&mut lines.max, layer.max, |value| whole(origin, "max", value, 1..=LINES as i64))?;
            put(&mut lines.min_points, layer.min_points, |value| {
                whole(origin, "min_points", value, 3..=BEAMS as i64)
            })?;
            lines.polish = layer.polish.unwrap_or(lines.polish);
        }
        motion.map_or(Ok(()), |layer| layer.lay(origin, &mut processing.motion))?;
        if let Some(layer) = background {
            layer.lay(origin, &mut processing.background)?;
        }
        if let Some(layer) = early {
            layer.lay(origin, &mut processing.early)?;
        }
        Ok(())
    }

    /// [`Kind::Configuration`](schema::Kind::Configuration) if `origin` says here for one link what a scanner of `family` has
    /// not. What is said for all links is for those that have it.
    pub(super) fn check_family(&self, origin: &Origin, family: Family) -> Result<(), Failure> {
        if let Some(early) = &self.early {
            early.check_family(origin, family)?;
        }
        let Some(MarksLayer { i_min, level, .. }) = &self.marks else { return Ok(()) };
        let name = family.name();
        let (foreign, what, remedy) = if family.has_reflector_levels() {
            let what = format!("level, and the intensities of an {name} are levels of reflectors, 0 to 7");
            (level, what, "i_min is the least of them")
        } else {
            let what = format!("i_min, and the intensities of an {name} are counts of any surface");
            (i_min, what, "level is the least of a reflector, as intensities of scans show it")
        };
        foreign.as_ref().map_or(Ok(()), |value| Err(origin.refuse(Some(value.span()), what, remedy)))
    }

    /// Where the sensor's pose is set, if it is.
    pub(super) fn pose(&self) -> Option<Range<usize>> {
        let PoseLayer { x, y, yaw, .. } = self.pose.as_ref()?;
        [x, y, yaw].into_iter().flatten().map(Spanned::span).next()
    }

    /// Where the initial background is set, if it is.
    pub(super) fn start(&self) -> Option<Range<usize>> {
        self.background.as_ref()?.start.as_ref().map(Spanned::span)
    }

    /// Where the robot's own body is set, if it is.
    pub(super) fn self_min(&self) -> Option<Range<usize>> {
        self.zones.as_ref()?.self_min.as_ref().map(Spanned::span)
    }

    /// Where the number of beams that violate a circle is set, if it is.
    pub(super) fn min_beams(&self) -> Option<Range<usize>> {
        self.zones.as_ref()?.min_beams.as_ref().map(Spanned::span)
    }
}

impl ZonesLayer {
    fn lay(self, origin: &Origin, zones: &mut Zones) -> Result<(), Failure> {
        put(&mut zones.radii_mm, self.radii, |value| radii(origin, value))?;
        put(&mut zones.self_min, self.self_min, |value| sectors(origin, value))?;
        put(&mut zones.margin_mm, self.margin, |value| millimetres(origin, "margin", value, 0.0..=10.0))?;
        put(&mut zones.min_beams, self.min_beams, |value| {
            whole(origin, "min_beams", value, 1..=BEAMS as i64)
        })?;
        put(&mut zones.min_scans, self.min_scans, |value| whole(origin, "min_scans", value, 1..=1000))?;
        put(&mut zones.max_invalid, self.max_invalid, |value| {
            within(origin, "max_invalid", value, 0.0..=1.0, "a share from 0 to 1")
        })?;
        zones.exact = self.exact.unwrap_or(zones.exact);
        zones.no_return_is_far = self.no_return_is_far.unwrap_or(zones.no_return_is_far);
        Ok(())
    }
}

impl BackgroundLayer {
    fn lay(self, origin: &Origin, background: &mut Background) -> Result<(), Failure> {
        let learning = &mut background.learning;
        if let Some(method) = self.method {
            background.is_kept = !matches!(method, MethodLayer::Off);
            learning.method = match method {
                MethodLayer::Multi => Method::Multi,
                MethodLayer::Paper => Method::Paper,
                MethodLayer::Moving => Method::Moving,
                MethodLayer::Off => learning.method,
            };
        }
        put(&mut learning.threshold_mm, self.threshold_mm, |value| {
            whole(origin, "threshold_mm", value, 1..=10_000).map(Some)
        })?;
        put(&mut learning.candidate_mm, self.candidate_mm, |value| {
            whole(origin, "candidate_mm", value, 1..=10_000).map(Some)
        })?;
        put(&mut learning.scans, self.scans, |value| whole(origin, "scans", value, 1..=8_191).map(Some))?;
        if let Some(candidate) = self.candidate {
            learning.candidate = match candidate {
                CandidateLayer::First => Candidate::First,
                CandidateLayer::Latest => Candidate::Latest,
            };
        }
        background.is_handed_on = self.keep.unwrap_or(background.is_handed_on);
        if let Some(start) = self.start {
            background.start_is_said = true;
            (learning.start, background.file) = match start.get_ref().as_str() {
                "empty" => (Start::Empty, None),
                "first-scan" => (Start::FirstScan, None),
                "" => return Err(origin.refuse(Some(start.span()), "start = \"\"", START)),
                file => (Start::Empty, Some(file.into())),
            };
        }
        learning.no_return_is_far = self.no_return_is_far.or(learning.no_return_is_far);
        if let Some(publish) = self.publish {
            background.every_scan = matches!(publish, PublishLayer::EveryScan);
        }
        Ok(())
    }
}

/// Puts what `check` makes of `value` into `field`, if there is a value.
pub(super) fn put<T, V>(
    field: &mut T,
    value: Option<Spanned<V>>,
    check: impl FnOnce(Spanned<V>) -> Result<T, Failure>,
) -> Result<(), Failure> {
    if let Some(value) = value {
        *field = check(value)?;
    }
    Ok(())
}

pub(super) fn within(
    origin: &Origin,
    key: &str,
    value: Spanned<f64>,
    allowed: RangeInclusive<f64>,
    remedy: &str,
) -> Result<f64, Failure> {
    // Not a number is within nothing.
    if allowed.contains(value.get_ref()) {
        return Ok(*value.get_ref());
    }
    Err(origin.refuse(Some(value.span()), format!("{key} = {}", value.get_ref()), remedy))
}

pub(super) fn whole<T: TryFrom<i64>>(
    origin: &Origin,
    key: &str,
    value: Spanned<i64>,
    allowed: RangeInclusive<i64>,
) -> Result<T, Failure> {
    let number = Some(*value.get_ref()).filter(|number| allowed.contains(number));
    number.and_then(|number| T::try_from(number).ok()).ok_or_else(|| {
        let remedy = format!("a whole number from {} to {}", allowed.start(), allowed.end());
        origin.refuse(Some(value.span()), format!("{key} = {}", value.get_ref()), remedy)
    })
}

fn place(origin: &Origin, key: &str, value: Spanned<f64>) -> Result<f64, Failure> {
    within(origin, key, value, -FARTHEST_M..=FARTHEST_M, "metres from the robot's centre, at most 100")
}

fn millimetres(
    origin: &Origin,
    key: &str,
    value: Spanned<f64>,
    allowed_m: RangeInclusive<f64>,
) -> Result<u16, Failure> {
    let remedy = format!("metres, from {} to {}", allowed_m.start(), allowed_m.end());
    within(origin, key, value, allowed_m, &remedy).map(in_mm)
}

/// The nearest whole number of millimetres; what a u16 does not hold ends at its bounds.
fn in_mm(metres: f64) -> u16 {
    (metres * 1000.0).round() as u16
}

fn radii(origin: &Origin, value: Spanned<Vec<f64>>) -> Result<Vec<u16>, Failure> {
    let radii = value.get_ref();
    let refuse = |remedy: &str| Err(origin.refuse(Some(value.span()), format!("radii = {radii:?}"), remedy));
    if !(1..=ZONES).contains(&radii.len()) {
        return refuse("1 to 8 radii, the largest first, for example [1.0, 0.6]");
    }
    if !radii.iter().all(|radius| (0.001..=LARGEST_M).contains(radius)) {
        return refuse("metres around the robot's centre, more than 0 and at most 65");
    }
    let radii: Vec<u16> = radii.iter().copied().map(in_mm).collect();
    if radii.is_sorted_by(|one, next| one > next) {
        Ok(radii)
    } else {
        refuse("the largest first, each once")
    }
}

fn sectors(origin: &Origin, value: Spanned<Vec<Spanned<SectorLayer>>>) -> Result<Vec<Sector>, Failure> {
    if value.get_ref().len() > SECTORS {
        let what = format!("self_min has {} sectors", value.get_ref().len());
        return Err(origin.refuse(Some(value.span()), what, format!("at most {SECTORS}: merge neighbours")));
    }
    value.into_inner().into_iter().map(|sector| in_sector(origin, sector)).collect()
}

fn in_sector(origin: &Origin, sector: Spanned<SectorLayer>) -> Result<Sector, Failure> {
    let span = Some(sector.span());
    let (from, to, range) = match sector.into_inner() {
        SectorLayer { from_deg: Some(from), to_deg: Some(to), range, from: None, to: None } => {
            (from, to, range)
        }
        SectorLayer { from_deg: None, to_deg: None, range, from: Some(from), to: Some(to) } => {
            let [now_from, now_to] = [from, to].map(|deg| (deg * 1000.0 - 90_000.0).round() / 1000.0);
            let what = format!(
                "self_min = {{ from = {from}, to = {to}, range = {range} }} counts angles from the right"
            );
            let remedy = format!(
                "angles are counted from ahead now: {{ from_deg = {now_from:?}, to_deg = {now_to:?}, range = {range:?} }}"
            );
            return Err(origin.refuse(span, what, remedy));
        }
        _ => {
            let remedy = "give it both angles, as { from_deg = -77.5, to_deg = -60.0, range = 0.42 }";
            return Err(origin.refuse(span, "self_min has a sector without its two angles", remedy));
        }
    };
    let refuse = |remedy: &str| {
        let what = format!("self_min = {{ from_deg = {from}, to_deg = {to}, range = {range} }}");
        Err(origin.refuse(span.clone(), what, remedy))
    };
    if !(-180.0..=180.0).contains(&from) || !(from..=180.0).contains(&to) {
        return refuse(
            "from_deg and to_deg are the sensor's angles in degrees: 0 ahead, 90 left, -90 right, from before to",
        );
    }
    if !(0.001..=LARGEST_M).contains(&range) {
        return refuse("range in metres: readings that are nearer are the robot's own body");
    }
    let mdeg = |deg: f64| (deg * 1000.0).round() as i32;
    Ok(Sector { from_mdeg: mdeg(from), to_mdeg: mdeg(to), range_mm: in_mm(range) })
}

/// No robot is larger; a greater value is millimetres, or a slip.
const FARTHEST_M: f64 = 100.0;
/// A radius in mm fits 16 bits.
const LARGEST_M: f64 = 65.0;
/// A full turn either way: a larger value was written in degrees by mistake, and is refused.
const TURN: f64 = 2.0 * std::f64::consts::PI;
