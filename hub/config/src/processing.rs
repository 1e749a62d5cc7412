//! Processing of a link's scans: sections pose, zones, marks, lines, motion, background and early, as values in effect
//! and as keys of the sources.
//!
//! Each value is checked in its own source. Meters, radians and degrees become the units of the processors.

use std::ops::{Range, RangeInclusive};
use std::path::PathBuf;

use preprocess::background::{Candidate, Method, Settings as Learning, Start};
use preprocess::zones::{SECTORS, Sector};
use preprocess::{lines, marks, motion, zones};
use scanhub_drivers::features;
use scanhub_files::regular;
use schema::{BEAMS, Failure, Family, Kind, LINES, Pose, SavedModel, ZONES};
use serde::Deserialize;
use toml::Spanned;

use crate::link::Link;
use crate::sources::Origin;

/// Settings for processing the scans of one link.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Processing {
    /// Pose of the sensor.
    pub pose: Pose,
    /// Zones around the robot.
    pub zones: Zones,
    /// Detection of reflector marks.
    pub marks: marks::Settings,
    /// Detection of straight lines.
    pub lines: lines::Settings,
    /// Limits of the robot's steps that are accepted.
    pub motion: motion::Settings,
    /// Learning of the background.
    pub background: Background,
    /// Early warnings from partial telegrams.
    pub early: Early,
}

/// Values of section `[early]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Early {
    /// Number of reads per LMS telegram while the topic has a subscriber, 2 to 8.
    pub pieces: u8,
}

impl Default for Early {
    fn default() -> Self {
        Early { pieces: 2 }
    }
}

/// Values of section `[zones]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Zones {
    /// Radii around the robot's center in mm, the largest first, 1 to 8.
    pub radii_mm: Vec<u16>,
    /// Sectors that the robot's own body covers.
    pub self_min: Vec<zones::Sector>,
    /// Margin that is added to every radius, in mm.
    pub margin_mm: u16,
    /// Minimum number of beams of a violation.
    pub min_beams: u16,
    /// Minimum number of consecutive scans of a violation.
    pub min_scans: u16,
    /// Maximum share of the beams through the largest zone that may have no reading.
    pub max_invalid: f64,
    /// Whether points in front of the near side of a zone do not count as inside it, if the sensor is outside the zone.
    pub exact: bool,
    /// Whether a beam without an echo means that nothing is near.
    pub no_return_is_far: bool,
}

impl Zones {
    /// Returns the settings of the processor.
    pub fn settings(&self) -> zones::Settings<'_> {
        zones::Settings {
            radii_mm: &self.radii_mm,
            self_min: &self.self_min,
            margin_mm: self.margin_mm,
            min_beams: self.min_beams,
            min_scans: self.min_scans,
            max_invalid: self.max_invalid,
            exact: self.exact,
            no_return_is_far: self.no_return_is_far,
        }
    }
}

impl Default for Zones {
    fn default() -> Self {
        let zones::Settings {
            radii_mm,
            self_min,
            margin_mm,
            min_beams,
            min_scans,
            max_invalid,
            exact,
            no_return_is_far,
        } = zones::Settings::default();
        let (radii_mm, self_min) = (radii_mm.to_vec(), self_min.to_vec());
        Zones { radii_mm, self_min, margin_mm, min_beams, min_scans, max_invalid, exact, no_return_is_far }
    }
}

/// Values of section `[background]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Background {
    /// Whether the hub keeps a background. Otherwise it publishes neither foreground nor background.
    pub is_kept: bool,
    /// Settings of learning.
    pub learning: Learning,
    /// File that the background starts with.
    pub file: Option<PathBuf>,
    /// Whether the start was set explicitly, so that a background of an earlier hub is not used.
    pub start_is_said: bool,
    /// Whether the learned background is saved for the next hub, which starts with it.
    pub is_handed_on: bool,
    /// Background to start with: the contents of the file, or the background of an earlier hub.
    pub model: Option<Box<schema::Background>>,
    /// Whether the model is published with every scan, and not only for a new generation and after a period of
    /// learning.
    pub every_scan: bool,
}

impl Background {
    /// Reads the file that the background of `link` starts with, if there is one, and compares it with the
    /// configuration of that link.
    ///
    /// Returns [`Kind::Configuration`] with file and reason if it does not fit.
    pub(crate) fn read(&mut self, link: &Link) -> Result<(), Failure> {
        let sensor = &link.name;
        let Some(file) = self.file.as_ref().filter(|_| self.is_kept) else { return Ok(()) };
        let place = file.display().to_string();
        let refuse = |what: String, hint: &str| {
            let message = format!("link {sensor}: background.start = {place}: {what}");
            Err(Failure::new(Kind::Configuration, message, hint))
        };
        let text = match regular::read(file, regular::LONGEST) {
            Ok(text) => text,
            Err(error) => return refuse(error.to_string(), START),
        };
        let SavedModel { sensor: of, model } = SavedModel::parse(&text, &place).map_err(|failure| {
            let message = format!("link {sensor}: background.start: {}", failure.message);
            Failure::new(Kind::Configuration, message, failure.hint)
        })?;
        if of != *sensor {
            let hint = "name the file of each sensor by background.start of its link";
            return refuse(format!("the model is that of sensor {of}"), hint);
        }
        if let Err(wanted) = link.fits(&model) {
            let (beams, unit_mm) = (model.count, model.unit_um / 1000);
            let what = format!(
                "the model has {beams} beams in units of {unit_mm} mm, the link is configured for {wanted}"
            );
            return refuse(what, "use \"empty\", and save a new model of the sensor");
        }
        self.model = Some(model);
        Ok(())
    }
}

impl Default for Background {
    fn default() -> Self {
        Background {
            is_kept: true,
            learning: Learning::default(),
            file: None,
            start_is_said: false,
            is_handed_on: true,
            model: None,
            every_scan: false,
        }
    }
}

/// Values of `start`.
pub(crate) const START: &str =
    "\"empty\", \"first-scan\", or a file that `scanhub background SENSOR save` has written";

/// Keys of section `pose` of a link.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "where the sensor sits, as { x = 0.3, y = 0.0, yaw = 1.5708 }")]
pub(crate) struct PoseLayer {
    x: Option<Spanned<f64>>,
    y: Option<Spanned<f64>>,
    yaw: Option<Spanned<f64>>,
    upside_down: Option<bool>,
}

/// Keys of section `zones`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of zones, as { radii = [1.0, 0.6] }")]
pub(crate) struct ZonesLayer {
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
    /// The former keys, whose 0 was to the right. Many of their values are possible in both frames, so none is
    /// accepted.
    from: Option<f64>,
    to: Option<f64>,
}

/// Keys of section `marks`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of marks, as { i_min = 1 } or { level = 240 }")]
pub(crate) struct MarksLayer {
    i_min: Option<Spanned<i64>>,
    level: Option<Spanned<i64>>,
    max_range_step: Option<Spanned<f64>>,
    max_gap: Option<Spanned<i64>>,
}

/// Keys of section `lines`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of lines, as { max = 20, polish = true }")]
pub(crate) struct LinesLayer {
    max: Option<Spanned<i64>>,
    min_points: Option<Spanned<i64>>,
    polish: Option<bool>,
}

/// Keys of section `background`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of background, as { method = \"multi\" }")]
pub(crate) struct BackgroundLayer {
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

/// Sections of one source, for all links or for one.
#[derive(Clone)]
pub(crate) struct Sections {
    pub(crate) pose: Option<PoseLayer>,
    pub(crate) zones: Option<ZonesLayer>,
    pub(crate) marks: Option<MarksLayer>,
    pub(crate) lines: Option<LinesLayer>,
    pub(crate) motion: Option<MotionLayer>,
    pub(crate) background: Option<BackgroundLayer>,
    pub(crate) early: Option<EarlyLayer>,
}

impl Sections {
    /// Applies the sections of `origin` to `processing`.
    pub(crate) fn apply(self, origin: &Origin, processing: &mut Processing) -> Result<(), Failure> {
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
                    -FULL_CIRCLE..=FULL_CIRCLE,
                    "radians, counter-clockwise: 90 degrees are 1.5708",
                )
            })?;
            pose.upside_down = layer.upside_down.map_or(pose.upside_down, u8::from);
        }
        if let Some(layer) = zones {
            layer.apply(origin, &mut processing.zones)?;
        }
        if let Some(layer) = marks {
            let marks = &mut processing.marks;
            put(&mut marks.i_min, layer.i_min, |value| whole(origin, "i_min", value, 1..=7))?;
            put(&mut marks.level, layer.level, |value| {
                whole(origin, "level", value, 1..=i64::from(u16::MAX)).map(Some)
            })?;
            put(&mut marks.max_range_step_mm, layer.max_range_step, |value| {
                millimeters(origin, "max_range_step", value, 0.001..=10.0)
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
        motion.map_or(Ok(()), |layer| layer.apply(origin, &mut processing.motion))?;
        if let Some(layer) = background {
            layer.apply(origin, &mut processing.background)?;
        }
        if let Some(layer) = early {
            layer.apply(origin, &mut processing.early)?;
        }
        Ok(())
    }

    /// Returns [`Kind::Configuration`] if these sections, which belong to one link, set a
    /// key that a scanner of `family` does not have. A key for all links applies to the families that have it.
    pub(crate) fn check_family(&self, origin: &Origin, family: Family) -> Result<(), Failure> {
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

    /// Returns the position of the sensor's pose, if it is set.
    pub(crate) fn pose(&self) -> Option<Range<usize>> {
        let PoseLayer { x, y, yaw, .. } = self.pose.as_ref()?;
        [x, y, yaw].into_iter().flatten().map(Spanned::span).next()
    }

    /// Returns the position of the initial background, if it is set.
    pub(crate) fn start(&self) -> Option<Range<usize>> {
        self.background.as_ref()?.start.as_ref().map(Spanned::span)
    }

    /// Returns the position of the robot's own body, if it is set.
    pub(crate) fn self_min(&self) -> Option<Range<usize>> {
        self.zones.as_ref()?.self_min.as_ref().map(Spanned::span)
    }

    /// Returns the position of the minimum number of beams, if it is set.
    pub(crate) fn min_beams(&self) -> Option<Range<usize>> {
        self.zones.as_ref()?.min_beams.as_ref().map(Spanned::span)
    }
}

impl ZonesLayer {
    fn apply(self, origin: &Origin, zones: &mut Zones) -> Result<(), Failure> {
        put(&mut zones.radii_mm, self.radii, |value| radii(origin, value))?;
        put(&mut zones.self_min, self.self_min, |value| sectors(origin, value))?;
        put(&mut zones.margin_mm, self.margin, |value| millimeters(origin, "margin", value, 0.0..=10.0))?;
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
    fn apply(self, origin: &Origin, background: &mut Background) -> Result<(), Failure> {
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

/// Sets `field` to the result of `check`, if there is a value.
pub(crate) fn put<T, V>(
    field: &mut T,
    value: Option<Spanned<V>>,
    check: impl FnOnce(Spanned<V>) -> Result<T, Failure>,
) -> Result<(), Failure> {
    if let Some(value) = value {
        *field = check(value)?;
    }
    Ok(())
}

pub(crate) fn within(
    origin: &Origin,
    key: &str,
    value: Spanned<f64>,
    allowed: RangeInclusive<f64>,
    remedy: &str,
) -> Result<f64, Failure> {
    // NaN is not within any range.
    if allowed.contains(value.get_ref()) {
        return Ok(*value.get_ref());
    }
    Err(origin.refuse(Some(value.span()), format!("{key} = {}", value.get_ref()), remedy))
}

pub(crate) fn whole<T: TryFrom<i64>>(
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
    within(origin, key, value, -MAX_OFFSET_M..=MAX_OFFSET_M, "metres from the robot's centre, at most 100")
}

fn millimeters(
    origin: &Origin,
    key: &str,
    value: Spanned<f64>,
    allowed_m: RangeInclusive<f64>,
) -> Result<u16, Failure> {
    let remedy = format!("metres, from {} to {}", allowed_m.start(), allowed_m.end());
    within(origin, key, value, allowed_m, &remedy).map(in_mm)
}

/// Returns the nearest whole number of millimeters, saturated to a u16.
fn in_mm(metres: f64) -> u16 {
    (metres * 1000.0).round() as u16
}

fn radii(origin: &Origin, value: Spanned<Vec<f64>>) -> Result<Vec<u16>, Failure> {
    let radii = value.get_ref();
    let refuse = |remedy: &str| Err(origin.refuse(Some(value.span()), format!("radii = {radii:?}"), remedy));
    if !(1..=ZONES).contains(&radii.len()) {
        return refuse("1 to 8 radii, the largest first, for example [1.0, 0.6]");
    }
    if !radii.iter().all(|radius| (0.001..=MAX_RADIUS_M).contains(radius)) {
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
    if !(0.001..=MAX_RADIUS_M).contains(&range) {
        return refuse("range in metres: readings that are nearer are the robot's own body");
    }
    let mdeg = |deg: f64| (deg * 1000.0).round() as i32;
    Ok(Sector { from_mdeg: mdeg(from), to_mdeg: mdeg(to), range_mm: in_mm(range) })
}

/// No robot is larger. A greater value is in millimeters, or a mistake.
const MAX_OFFSET_M: f64 = 100.0;
/// A radius in mm must fit into 16 bits.
const MAX_RADIUS_M: f64 = 65.0;
/// A larger yaw, in either direction, was written in degrees by mistake.
const FULL_CIRCLE: f64 = 2.0 * std::f64::consts::PI;

/// Keys of section `motion`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of motion, as { max_step = 0.5, max_turn = 30.0 }")]
pub(crate) struct MotionLayer {
    max_step: Option<Spanned<f64>>,
    max_turn: Option<Spanned<f64>>,
    min_overlap: Option<Spanned<f64>>,
}

impl MotionLayer {
    pub(crate) fn apply(
        self,
        origin: &Origin,
        motion: &mut preprocess::motion::Settings,
    ) -> Result<(), Failure> {
        put(&mut motion.max_step_m, self.max_step, |value| {
            within(origin, "max_step", value, 0.01..=10.0, "metres from scan to scan, from 0.01 to 10")
        })?;
        put(&mut motion.max_turn_deg, self.max_turn, |value| {
            within(origin, "max_turn", value, 1.0..=85.0, "degrees from scan to scan, from 1 to 85")
        })?;
        put(&mut motion.min_overlap, self.min_overlap, |value| {
            within(origin, "min_overlap", value, 0.1..=1.0, "a share from 0.1 to 1")
        })
    }
}

/// Keys of section `early`.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "keys of early, as { pieces = 2 }")]
pub(crate) struct EarlyLayer {
    pieces: Option<Spanned<i64>>,
}

impl EarlyLayer {
    pub(crate) fn apply(self, origin: &Origin, early: &mut Early) -> Result<(), Failure> {
        put(&mut early.pieces, self.pieces, |value| whole(origin, "pieces", value, 2..=8))
    }

    /// Returns [`Kind::Configuration`] if it is set for a `family` that sends packets, which are short already.
    pub(crate) fn check_family(&self, origin: &Origin, family: Family) -> Result<(), Failure> {
        let foreign = self.pieces.as_ref().filter(|_| !features(family).has_whole_telegrams);
        foreign.map_or(Ok(()), |pieces| {
            let what = format!("pieces, and an {} sends packets, which are short", family.name());
            Err(origin.refuse(Some(pieces.span()), what, "it warns by each packet anyway"))
        })
    }
}
