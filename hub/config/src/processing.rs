//! Sections for processing the scans of a link: pose, zones, marks, lines, motion, background and early. Each section
//! exists in two forms: the keys of the sources, and the values in effect. Keys in meters, radians and degrees are
//! converted to the units of the processors.

use std::path::PathBuf;

use scanhub_drivers::features;
use scanhub_files::regular_file;
use scanhub_preprocess::background::{Candidate, Method, Settings as Learning, Start};
use scanhub_preprocess::zones::{MAX_SECTORS, Sector, ZoneChecker};
use scanhub_preprocess::{lines, marks, motion, zones};
use scanhub_schema::{
    BackgroundFile, Failure, Family, Kind, MAX_BEAMS, MAX_LINES, MAX_ZONES, Pose, Scan, ScanHead,
};
use serde::{Deserialize, Serialize};
use toml::Spanned;
use toml::de::DeTable;

use crate::link::{Link, LinkKeys};
use crate::section::{CheckResult, each, find, invalid_value, meters, optional, section, whole, within};
use crate::sources::SourceMap;

/// Settings for processing the scans of one link.
#[derive(Clone, Debug, PartialEq)]
pub struct Processing {
    /// Pose of the sensor in the frame of the robot.
    pub pose: Pose,
    /// Zones around the robot.
    pub zones: zones::Settings,
    /// Detection of reflector marks.
    pub marks: marks::Settings,
    /// Detection of straight lines.
    pub lines: lines::Settings,
    /// Limits for the steps of the robot. The motion estimate rejects larger steps.
    pub motion: motion::Settings,
    /// Learning of the background.
    pub background: Background,
    /// Early warnings from partial telegrams.
    pub early: Early,
}

/// Values of section `[early]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Early {
    /// Number of reads per LMS telegram while the topic `early` has a subscriber, 2 to 8.
    pub reads_per_telegram: u8,
}

/// Values of section `[background]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Background {
    /// Whether the hub learns a background. If not, the hub publishes neither foreground nor background.
    pub is_enabled: bool,
    /// Settings for learning.
    pub learning: Learning,
    /// File with the background to start with.
    pub file: Option<PathBuf>,
    /// Whether the key `start` is set. If so, the hub does not use the background of an earlier hub.
    pub is_start_set: bool,
    /// Whether the hub saves the learned background, so that the next hub starts with it.
    pub is_saved: bool,
    /// Background to start with, from the file or from an earlier hub.
    pub model: Option<Box<scanhub_schema::Background>>,
    /// Whether the background is published with every scan. If not, the background is published only for a new
    /// generation and after each period of learning.
    pub every_scan: bool,
}

impl Background {
    /// Reads the file with the background to start with, if there is one, and compares it with the configuration of
    /// `link`.
    ///
    /// Returns [`Kind::Configuration`] with file and reason if the background does not fit.
    pub(crate) fn read(&mut self, link: &Link) -> Result<(), Failure> {
        let sensor = &link.name;
        let Some(file) = self.file.as_ref().filter(|_| self.is_enabled) else { return Ok(()) };
        let path = file.display().to_string();
        let refuse = |what: String, hint: &str| {
            let message = format!("link {sensor}: background.start = {path}: {what}");
            Err(Failure::new(Kind::Configuration, message, hint))
        };
        let text = match regular_file::read(file, regular_file::MAX_FILE_BYTES) {
            Ok(text) => text,
            Err(error) => return refuse(error.to_string(), START_VALUES),
        };
        let BackgroundFile { sensor: of, model } =
            BackgroundFile::parse(&text, &path).map_err(|failure| {
                let message = format!("link {sensor}: background.start: {}", failure.message);
                Failure::new(Kind::Configuration, message, failure.hint)
            })?;
        if of != *sensor {
            let hint = "name the file of each sensor by background.start of its link";
            return refuse(format!("the model is that of sensor {of}"), hint);
        }
        if let Err(expected) = link.check_background(&model) {
            let (beams, unit_mm) = (model.count, model.unit_um / 1000);
            let what = format!(
                "the model has {beams} beams in units of {unit_mm} mm, the link is configured for {expected}"
            );
            return refuse(what, "use \"empty\", and save a new model of the sensor");
        }
        self.model = Some(model);
        Ok(())
    }
}

/// Valid values of the key `start`.
pub(crate) const START_VALUES: &str =
    "\"empty\", \"first-scan\", or a file that `scanhub background SENSOR save` has written";

section! {
    /// Keys of section `pose` of a link.
    pub(crate) struct PoseKeys: "where the sensor sits, as { x = 0.3, y = 0.0, yaw = 1.5708 }" {
        /// meters ahead of the robot's center, at most 100
        x: f64 = 0.0, check within(-100.0..=100.0, OFFSET_REMEDY);
        /// meters to the left of the robot's center, at most 100
        y: f64 = 0.0, check within(-100.0..=100.0, OFFSET_REMEDY);
        /// radians, counterclockwise from ahead
        ///
        /// Direction of the sensor in radians counterclockwise from ahead, at most 2 pi in either direction.
        yaw: f64 = 0.0, check within(-FULL_CIRCLE..=FULL_CIRCLE, "radians, counterclockwise: 90 degrees are 1.5708");
        /// whether the sensor hangs upside down
        ///
        /// Whether the sensor hangs upside down, so that its first beam is the leftmost.
        upside_down: bool = false;
    }
}

section! {
    /// Keys of section `zones`.
    pub(crate) struct ZonesKeys: "keys of zones, as { radii = [1.0, 0.6] }" {
        /// meters around the robot's center: slow first, stop last
        ///
        /// Radii of 1 to 8 zones, the largest first, at most 65 m. A point in the smallest zone means `stop`, and a
        /// point in another zone `slow`.
        radii: Vec<f64> = vec![1.0, 0.6], check radii;
        /// the robot's own body, such as { from_deg = -77.5, to_deg = -60.0, range = 0.42 }
        ///
        /// The robot's own body: at most 64 sectors, from `from_deg` to `to_deg` (-180 to 180; 0 is ahead of the
        /// sensor, 90 left). In a sector, the hub ignores readings nearer than `range` meters. `scanhub zones SENSOR
        /// mask` learns the sectors.
        body_mask: Vec<SectorKeys> = Vec::new(), check sectors;
        /// meters added to each radius
        ///
        /// Meters added to every radius, at most 10.
        margin: f64 = 0.0, check meters(0.0..=10.0);
        /// beams inside a circle that violate it
        ///
        /// Minimum number of beams that violate a zone by ending in it.
        min_beams: i64 = 1, check whole(1..=MAX_BEAMS as i64);
        /// consecutive scans in which a circle must be violated
        ///
        /// Consecutive scans in which a zone must be violated, at most 1000. After a start, a silence or a scan with
        /// too many invalid beams, the verdict is unknown until this number of scans has arrived.
        min_scans: i64 = 1, check whole(1..=1000);
        /// the verdict is unknown if a larger share of the beams has no reading
        ///
        /// The verdict is unknown if a larger share of the beams into the largest zone has no reading.
        max_invalid: f64 = 0.1, check within(0.0..=1.0, "a share from 0 to 1");
        /// ignore points between the sensor and the near side of a circle
        ///
        /// Whether a sensor outside a zone ignores points between itself and the zone.
        exact: bool = true;
        /// whether no echo means that nothing is near
        ///
        /// Whether a beam without an echo means that nothing is near. If false, it has no reading.
        no_return_is_far: bool = true;
    }
}

/// Sector of the sensor's view that the robot's own body covers.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, expecting = "a sector, as { from_deg = -77.5, to_deg = -60.0, range = 0.42 }")]
pub(crate) struct SectorKeys {
    from_deg: Option<f64>,
    to_deg: Option<f64>,
    range: f64,
    /// Keys of earlier versions are `from` and `to`, whose angle 0 was to the right. Many angles would also be valid
    /// with the current meaning, so neither key is accepted.
    #[serde(skip_serializing)]
    from: Option<f64>,
    #[serde(skip_serializing)]
    to: Option<f64>,
}

section! {
    /// Keys of section `marks`.
    pub(crate) struct MarksKeys: "keys of marks, as { min_level = 1 } or { level = 240 }" {
        /// reflectors of an LMS: lowest level, 1 to 7
        ///
        /// For an LMS: lowest level of a beam of a mark, 1 to 7.
        min_level: i64 = 1, check whole(1..=7);
        /// reflectors of all other scanners: lowest intensity, 1 to 65535; no default
        ///
        /// For all other scanners: lowest intensity of a beam of a mark, 1 to 65535.
        level: Option<i64> = None, check optional(whole(1..=i64::from(u16::MAX))), example "240";
        /// meters between neighboring beams of a mark
        ///
        /// Maximum difference in meters between the ranges of neighboring beams of a mark, up to 10.
        max_range_step: f64 = 0.1, check meters(0.001..=10.0);
        /// beams that may be missing in a mark
        ///
        /// Maximum number of beams that may be missing between two beams of a mark.
        max_gap: i64 = 0, check whole(0..=MAX_BEAMS as i64);
    }
}

section! {
    /// Keys of section `lines`.
    pub(crate) struct LinesKeys: "keys of lines, as { max = 20, refine = true }" {
        /// lines of a scan, 1 to 64
        ///
        /// Maximum number of lines of a scan, 1 to 64. If a scan has more, the hub joins the lines that differ least,
        /// and drops beams that do not fit well.
        max: i64 = 64, check whole(1..=MAX_LINES as i64);
        /// beams of a line, at least 3
        ///
        /// Minimum number of beams of a line, 3 to 8192.
        min_points: i64 = 5, check whole(3..=MAX_BEAMS as i64);
        /// slower fit with a better result
        ///
        /// Whether the hub optimizes the borders between lines, which is slower. The hub then drops the worst beams at
        /// the ends of lines, at most one in twenty.
        refine: bool = false;
    }
}

section! {
    /// Keys of section `motion`.
    pub(crate) struct MotionKeys: "keys of motion, as { max_step = 0.5, max_turn = 30.0 }" {
        /// meters from one scan to the next
        ///
        /// Maximum distance in meters from one scan to the next, 0.01 to 10. A longer step is rejected.
        max_step: f64 = 0.5, check within(0.01..=10.0, "meters from scan to scan, from 0.01 to 10");
        /// degrees from one scan to the next
        ///
        /// Maximum turn in degrees from one scan to the next, 1 to 85.
        max_turn: f64 = 30.0, check within(1.0..=85.0, "degrees from scan to scan, from 1 to 85");
        /// share of readings on surfaces of the previous scan
        ///
        /// Minimum share of readings on surfaces of the previous scan, 0.1 to 1. A step with a smaller share is
        /// rejected.
        min_overlap: f64 = 0.4, check within(0.1..=1.0, "a share from 0.1 to 1");
    }
}

section! {
    /// Keys of section `background`.
    pub(crate) struct BackgroundKeys: "keys of background, as { method = \"multi\" }" {
        /// multi, paper, moving (for a robot that drives) or off
        ///
        /// `multi`; `paper`, a simpler published method; [`moving`](#moving), for a robot that drives; or `off`. With
        /// `off`, neither foreground nor background is published.
        method: MethodKey = MethodKey::Multi;
        /// distance from the background that still belongs to it; default: 30, 60 or 100, by the unit
        ///
        /// Distance from the background, in mm, within which a reading is background, from one unit of the sensor to
        /// 10,000. Default: 30 for units of mm, 60 for cm, 100 for dm.
        threshold_mm: Option<i64> = None, check optional(whole(1..=10_000)), example "30";
        /// for paper: the same distance from a candidate, with the same default
        ///
        /// For `paper`: like `threshold_mm`, for a candidate that may become background.
        candidate_mm: Option<i64> = None, check optional(whole(1..=10_000)), example "30";
        /// scans until a surface is background; default: those of 10 s
        ///
        /// Number of scans until a surface is background, at most 8191. `paper` must see the surface in all of them,
        /// `multi` in 5/8. Default: the scans of 10 s at the full rate.
        scans: Option<i64> = None, check optional(whole(1..=8_191)), example "375";
        /// for paper: first or latest
        ///
        /// For `paper`: compare readings with the `first` or the `latest` reading of a candidate.
        candidate: CandidateKey = CandidateKey::First;
        /// empty, first-scan or a saved file; default: the saved background if it fits, or empty
        ///
        /// Background to start with: `empty`, `first-scan`, or a file from `scanhub background SENSOR save`, relative
        /// to the working directory of the hub. Default: the background that an earlier hub saved, if it fits,
        /// otherwise `empty`.
        start: Option<String> = None, check optional(start), example "\"empty\"";
        /// whether the next hub starts with this background
        ///
        /// Whether the hub saves the learned background for the next hub ([keep](#keep)).
        keep: bool = true;
        /// whether no echo counts as a background far away; default: true, for paper false
        ///
        /// Whether a beam without an echo counts as a background far away. If false, it has no reading. Default: true,
        /// for `paper` false.
        no_return_is_far: Option<bool> = None, example "true";
        /// on-demand or every-scan
        ///
        /// When to publish the background: `every-scan`, or `on-demand`, which is when a generation begins, and after
        /// every `scans` scans that it has learned.
        publish: PublishKey = PublishKey::OnDemand;
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum MethodKey {
    Multi,
    Paper,
    Moving,
    Off,
}

#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum CandidateKey {
    First,
    Latest,
}

#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum PublishKey {
    OnDemand,
    EveryScan,
}

section! {
    /// Keys of section `early`.
    pub(crate) struct EarlyKeys: "keys of early, as { pieces = 2 }" {
        /// reads per telegram of an LMS while `early` has a subscriber, 2 to 8
        ///
        /// Number of reads per telegram of an LMS while the topic `early` has a subscriber, 2 to 8.
        pieces: i64 = 2, check whole(2..=8);
    }
}

impl Processing {
    /// Converts the sections of a link to values in effect.
    pub(crate) fn of(keys: &LinkKeys) -> Processing {
        let LinkKeys { pose, zones, marks, lines, motion, background, early, .. } = keys;
        Processing {
            pose: Pose {
                x_m: pose.x,
                y_m: pose.y,
                yaw_rad: pose.yaw,
                upside_down: pose.upside_down.into(),
                ..Pose::default()
            },
            zones: zones::Settings {
                radii_mm: zones.radii.iter().copied().map(in_mm).collect(),
                body_mask: zones.body_mask.iter().filter_map(SectorKeys::sector).collect(),
                margin_mm: in_mm(zones.margin),
                min_beams: zones.min_beams as u16,
                min_scans: zones.min_scans as u16,
                max_invalid: zones.max_invalid,
                exact: zones.exact,
                no_return_is_far: zones.no_return_is_far,
            },
            marks: marks::Settings {
                min_level: marks.min_level as u8,
                level: marks.level.map(|level| level as u16),
                max_range_step_mm: in_mm(marks.max_range_step),
                max_gap: marks.max_gap as u16,
            },
            lines: lines::Settings {
                max: lines.max as u8,
                min_points: lines.min_points as u16,
                refine: lines.refine,
                ..lines::Settings::default()
            },
            motion: motion::Settings {
                max_step_m: motion.max_step,
                max_turn_deg: motion.max_turn,
                min_overlap: motion.min_overlap,
            },
            background: background.values(),
            early: Early { reads_per_telegram: early.pieces as u8 },
        }
    }

    /// Returns the names of the sections that differ in `other`.
    pub fn differences(&self, other: &Processing) -> Vec<&'static str> {
        let differences = [
            ("pose", self.pose != other.pose),
            ("zones", self.zones != other.zones),
            ("marks", self.marks != other.marks),
            ("lines", self.lines != other.lines),
            ("motion", self.motion != other.motion),
            ("background", self.background != other.background),
            ("early", self.early != other.early),
        ];
        differences.into_iter().filter(|(_, differs)| *differs).map(|(section, _)| section).collect()
    }
}

impl Default for Processing {
    fn default() -> Self {
        Processing::of(&LinkKeys::default())
    }
}

impl BackgroundKeys {
    fn values(&self) -> Background {
        let (start, file) = match self.start.as_deref() {
            None | Some("empty") => (Start::Empty, None),
            Some("first-scan") => (Start::FirstScan, None),
            Some(file) => (Start::Empty, Some(file.into())),
        };
        Background {
            is_enabled: self.method != MethodKey::Off,
            learning: Learning {
                method: match self.method {
                    MethodKey::Multi | MethodKey::Off => Method::Multi,
                    MethodKey::Paper => Method::Paper,
                    MethodKey::Moving => Method::Moving,
                },
                threshold_mm: self.threshold_mm.map(|mm| mm as u16),
                candidate_mm: self.candidate_mm.map(|mm| mm as u16),
                scans: self.scans.map(|scans| scans as u32),
                candidate: match self.candidate {
                    CandidateKey::First => Candidate::First,
                    CandidateKey::Latest => Candidate::Latest,
                },
                start,
                no_return_is_far: self.no_return_is_far,
            },
            file,
            is_start_set: self.start.is_some(),
            is_saved: self.keep,
            model: None,
            every_scan: self.publish == PublishKey::EveryScan,
        }
    }
}

/// Checks the keys that a link sets itself. `own` has the values of the link, without the values for all links.
///
/// Returns [`Kind::Configuration`] if the link sets a key that a scanner of `family` does not have. A key that is set
/// for all links is ignored for families that do not have the key.
pub(crate) fn check_family(own: &DeTable<'_>, sources: &SourceMap, family: Family) -> Result<(), Failure> {
    let name = family.name();
    for key in FAMILY_KEYS.into_iter().filter(|key| !has_key(Some(family), key)) {
        let Some(value) = find(own, key) else { continue };
        let (what, remedy) = match key {
            "marks.level" => (
                format!("level, but the intensities of an {name} are reflector levels, 0 to 7"),
                "use min_level, the lowest level of a reflector",
            ),
            "marks.min_level" => (
                format!("min_level, but the intensities of an {name} are not reflector levels"),
                "use level, the lowest intensity of a reflector in scans",
            ),
            _ => (
                format!("pieces, but an {name} sends short packets"),
                "leave it out: early warnings use every packet",
            ),
        };
        return Err(sources.refuse(value.span(), what, remedy));
    }
    Ok(())
}

/// Returns whether a scanner of `family` has the `key` of a section. If the family is unknown, it may have every key.
pub(crate) fn has_key(family: Option<Family>, key: &str) -> bool {
    family.is_none_or(|family| match key {
        "marks.min_level" => family.has_reflector_levels(),
        "marks.level" => !family.has_reflector_levels(),
        "early.pieces" => features(family).has_whole_telegrams,
        _ => true,
    })
}

/// Keys that only some families have.
const FAMILY_KEYS: [&str; 3] = ["early.pieces", "marks.level", "marks.min_level"];

/// Converts meters to the nearest whole number of millimeters, limited to the range of a u16.
fn in_mm(meters: f64) -> u16 {
    (meters * 1000.0).round() as u16
}

fn radii(key: &str, radii: &[f64]) -> CheckResult {
    let refuse = |remedy: &str| Err(invalid_value(format!("{key} = {radii:?}"), remedy));
    if !(1..=MAX_ZONES).contains(&radii.len()) {
        return refuse("1 to 8 radii, the largest first, for example [1.0, 0.6]");
    }
    if !radii.iter().all(|radius| (0.001..=MAX_RADIUS_M).contains(radius)) {
        return refuse("meters around the robot's center, more than 0 and at most 65");
    }
    match radii.iter().copied().map(in_mm).is_sorted_by(|one, next| one > next) {
        true => Ok(()),
        false => refuse("the largest first, each once"),
    }
}

fn sectors(key: &str, sectors: &[SectorKeys]) -> CheckResult {
    if sectors.len() > MAX_SECTORS {
        let what = format!("{key} has {} sectors", sectors.len());
        return Err(invalid_value(what, format!("at most {MAX_SECTORS}: merge neighboring ones")));
    }
    each(sector)(key, sectors)
}

fn sector(key: &str, sector: &SectorKeys) -> CheckResult {
    let (from, to, range) = match *sector {
        SectorKeys { from_deg: Some(from), to_deg: Some(to), range, from: None, to: None } => {
            (from, to, range)
        }
        SectorKeys { from_deg: None, to_deg: None, range, from: Some(from), to: Some(to) } => {
            let [now_from, now_to] = [from, to].map(|deg| (deg * 1000.0 - 90_000.0).round() / 1000.0);
            let what = format!(
                "{key} = {{ from = {from}, to = {to}, range = {range} }} counts angles from the right"
            );
            let remedy = format!(
                "angles are counted from ahead now: {{ from_deg = {now_from:?}, to_deg = {now_to:?}, range = {range:?} }}"
            );
            return Err(invalid_value(what, remedy));
        }
        _ => {
            let remedy = "give it both angles, as { from_deg = -77.5, to_deg = -60.0, range = 0.42 }";
            return Err(invalid_value(format!("{key} has a sector without its two angles"), remedy));
        }
    };
    let refuse = |remedy: &str| {
        Err(invalid_value(format!("{key} = {{ from_deg = {from}, to_deg = {to}, range = {range} }}"), remedy))
    };
    if !(-180.0..=180.0).contains(&from) || !(from..=180.0).contains(&to) {
        return refuse(
            "from_deg and to_deg are the sensor's angles in degrees: 0 ahead, 90 left, -90 right, from before to",
        );
    }
    if !(0.001..=MAX_RADIUS_M).contains(&range) {
        return refuse("range is in meters: nearer readings are the robot's own body");
    }
    Ok(())
}

impl SectorKeys {
    fn sector(&self) -> Option<Sector> {
        let mdeg = |deg: f64| (deg * 1000.0).round() as i32;
        let (from_mdeg, to_mdeg) = (mdeg(self.from_deg?), mdeg(self.to_deg?));
        Some(Sector { from_mdeg, to_mdeg, range_mm: in_mm(self.range) })
    }
}

fn start(key: &str, start: &str) -> CheckResult {
    if start.is_empty() { Err(invalid_value(format!("{key} = \"\""), START_VALUES)) } else { Ok(()) }
}

const OFFSET_REMEDY: &str = "meters from the robot's center, at most 100";
/// Maximum radius in meters. In millimeters, a radius must fit into 16 bits.
const MAX_RADIUS_M: f64 = 65.0;
/// Maximum yaw in radians, in either direction. A larger value was probably written in degrees.
const FULL_CIRCLE: f64 = 2.0 * std::f64::consts::PI;

/// Checks that the beams of a sensor cover enough of its largest zone to detect a violation. A zone that cannot be
/// violated is an error in the configuration. The real scanner is unknown here, so the hub repeats the check with its
/// scans.
///
/// Returns [`Kind::Configuration`] with the place of the cause in `table`, which has the values of the link. If `table`
/// does not set the cause, the place is `location`, where the link is defined.
pub(crate) fn check_coverage(
    link: &Link,
    table: &DeTable<'_>,
    location: &str,
    sources: &SourceMap,
) -> Result<(), Failure> {
    let processing = &link.processing;
    let settings = &processing.zones;
    let (beams, min_beams) = (link.scan_heads()[0].count.into(), settings.min_beams);
    let refuse = |keys: &[&str], what: String, remedy: &str| {
        let spans = keys.iter().filter_map(|key| find(table, key).map(Spanned::span));
        // If the last source sets several of the keys, report the first of them.
        let last = spans.rev().max_by_key(|span| sources.index(span));
        let location = last.map_or(location.to_owned(), |span| sources.location(span));
        let message = format!("{location}: link {}: {what}", link.name);
        Err(Failure::new(Kind::Configuration, message, remedy.replace("NAME", &link.name)))
    };
    if usize::from(min_beams) > beams {
        let what = format!("min_beams = {min_beams}, but a scan has {beams} beams");
        return refuse(&["zones.min_beams"], what, "the default is one beam");
    }
    // Returns the maximum number of beams that can detect an object in the largest zone.
    let effective_beams = |settings: &zones::Settings| {
        let of_head = |head: &ScanHead| {
            let beams = usize::from(head.count);
            let mut check = ZoneChecker::new(processing.pose, settings, beams);
            check.update(&Scan::of(*head, &vec![0; beams]), &mut scanhub_schema::Zones::unknown());
            check.effective_beams()
        };
        link.scan_heads().iter().map(of_head).max().unwrap_or_default()
    };
    let max_effective_beams = effective_beams(settings);
    if max_effective_beams >= min_beams {
        return Ok(());
    }
    let circle_m = f64::from(settings.radii_mm.first().copied().unwrap_or_default()) / 1000.0;
    if effective_beams(&zones::Settings { body_mask: Vec::new(), ..settings.clone() }) == 0 {
        return refuse(
            &["pose.x", "pose.y", "pose.yaw"],
            format!("no beam sees into the circle of {circle_m} m"),
            "correct the sensor's pose, or set a circle that it sees: link.NAME.zones.radii",
        );
    }
    if max_effective_beams == 0 {
        return refuse(
            &["zones.body_mask"],
            format!("body_mask covers every beam up to the circle of {circle_m} m"),
            "shorten body_mask: it is only for the robot's own body",
        );
    }
    refuse(
        &["zones.min_beams"],
        format!(
            "min_beams = {min_beams}, but only {max_effective_beams} beams see the circle of {circle_m} m"
        ),
        "set fewer beams, a larger circle, or another pose or body_mask",
    )
}
