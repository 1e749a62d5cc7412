//! Classes of `--json`: their keys, and the order of the keys. They are a contract with scripts and other languages, so
//! keys may be added but never changed.

mod results;

use scanhub_schema::{
    Code, Counters, Failure, Family, Flags, Header, Intensities, Reasons, Scan, Status, Telegram, Verb,
    in_degrees,
};
use serde::Serialize;
use serde::ser::{SerializeMap, Serializer};
use std::rc::Rc;

use crate::follow::Notice;
use crate::names::TopicName;
use crate::output::{ExitReason, Output};
use crate::receive_stats::ReceiveStats;

pub use results::*;
// The line of class `background` has the same content as a file with a model.
pub(crate) use scanhub_schema::as_json as background;

/// Keys at the start of every line about a sample.
#[derive(Serialize)]
struct SampleKeys<'a> {
    class: &'static str,
    sensor: &'a str,
    seq: Option<u64>,
    topic_seq: Option<u64>,
    stamp_ns: Option<u64>,
    wall_ns: Option<u64>,
    #[serde(serialize_with = "id")]
    boot: Option<u64>,
    quality: Option<&'static str>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    reasons: Vec<&'static str>,
}

impl<'a> SampleKeys<'a> {
    fn new(class: &'static str, sensor: &'a str, header: &Header) -> SampleKeys<'a> {
        SampleKeys {
            class,
            sensor,
            seq: Some(header.seq),
            topic_seq: Some(header.topic_seq),
            stamp_ns: Some(header.stamp_first_ns),
            wall_ns: Some(header.wall_ns),
            boot: known(header.boot, 0),
            quality: Some(header.quality().name()),
            reasons: Reasons::names(header.reasons).collect(),
        }
    }

    /// Returns the keys of a line about a silence. A silence belongs to no telegram.
    fn for_silence(class: &'static str, sensor: &'a str) -> SampleKeys<'a> {
        let (seq, topic_seq, stamp_ns, wall_ns, boot, quality) = (None, None, None, None, None, None);
        SampleKeys { class, sensor, seq, topic_seq, stamp_ns, wall_ns, boot, quality, reasons: Vec::new() }
    }
}

/// Last key of a line about a sample: the flags that are set. The key is absent if no flag is set.
#[derive(Serialize)]
pub struct FlagNames {
    #[serde(skip_serializing_if = "Vec::is_empty")]
    flags: Vec<&'static str>,
}

impl FlagNames {
    /// Returns the names of the flags in `header`.
    pub fn of(header: &Header) -> FlagNames {
        FlagNames { flags: Flags::names(header.flags).collect() }
    }
}

/// Returns the line of class `telegram`.
pub(crate) fn telegram<'a>(sensor: &'a str, header: &Header, bytes: &'a [u8]) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct TelegramJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        #[serde(skip_serializing_if = "Option::is_none")]
        family: Option<&'static str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        address: Option<u8>,
        #[serde(skip_serializing_if = "Option::is_none")]
        command: Option<u8>,
        #[serde(skip_serializing_if = "Option::is_none")]
        kind: Option<&'static str>,
        /// Whether the checksums are correct; `null` if the family has no checksums.
        #[serde(skip_serializing_if = "Option::is_none")]
        checked: Option<Option<bool>>,
        #[serde(skip_serializing_if = "Option::is_none")]
        packets: Option<usize>,
        length: usize,
        #[serde(serialize_with = "hex")]
        data: &'a [u8],
        #[serde(flatten)]
        flags: FlagNames,
    }
    let telegram = Telegram { family: header.family(), bytes };
    let (is_lms, packets) = (telegram.is_lms(), telegram.packets());
    TelegramJson {
        stamp: SampleKeys::new("telegram", sensor, header),
        family: (!is_lms).then(|| header.family().map_or("unknown", Family::name)),
        address: is_lms.then(|| telegram.address()),
        command: is_lms.then(|| telegram.command()),
        kind: packets.map(|packets| packets.kind),
        checked: packets.map(|packets| packets.checked),
        packets: packets.map(|packets| packets.packets),
        length: if is_lms { telegram.length().into() } else { bytes.len() },
        data: bytes,
        flags: FlagNames::of(header),
    }
}

/// Returns the line of class `scan`.
pub(crate) fn scan<'a>(sensor: &'a str, header: &Header, scan: &'a Scan) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct ScanJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        family: &'static str,
        unit_um: u32,
        count: usize,
        first_angle_deg: f64,
        step_deg: f64,
        beam_time_ns: u32,
        #[serde(serialize_with = "ranges")]
        ranges: &'a Scan,
        #[serde(serialize_with = "codes")]
        codes: &'a Scan,
        #[serde(serialize_with = "intensities", skip_serializing_if = "Intensities::is_empty")]
        intensities: Intensities<'a>,
        #[serde(serialize_with = "angles", skip_serializing_if = "has_grid_only")]
        angles_deg: &'a Scan,
        #[serde(skip_serializing_if = "Option::is_none")]
        collisions: Option<u16>,
        #[serde(skip_serializing_if = "std::ops::Not::not")]
        incomplete: bool,
        #[serde(flatten)]
        flags: FlagNames,
    }
    ScanJson {
        stamp: SampleKeys::new("scan", sensor, header),
        family: Family::of_number(scan.family).map_or("unknown", Family::name),
        unit_um: scan.unit_um,
        count: scan.beams(),
        first_angle_deg: in_degrees(scan.first_angle),
        step_deg: in_degrees(scan.step),
        beam_time_ns: scan.beam_time_ns,
        ranges: scan,
        codes: scan,
        intensities: scan.intensities(),
        angles_deg: scan,
        // A scan without exact angles has no collisions, because its beams were measured at the angles of the grid.
        collisions: (!has_grid_only(scan)).then_some(scan.collisions),
        incomplete: scan.is_incomplete(),
        flags: FlagNames::of(header),
    }
}

/// Pose in a status.
#[derive(Serialize)]
struct PoseJson {
    x_m: f64,
    y_m: f64,
    yaw_rad: f64,
    upside_down: bool,
}

/// Availability of topic `marks` in a status, with the command or setting that makes it available.
#[derive(Serialize)]
struct MarksAvailability {
    available: Option<bool>,
    remedy: Option<String>,
}

/// Returns the line of class `status`. Unknown values are null.
pub(crate) fn status<'a>(sensor: &'a str, status: &'a Status) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct StatusJson<'a> {
        class: &'static str,
        sensor: &'a str,
        state: &'static str,
        family: Option<&'static str>,
        model: Option<String>,
        baud: Option<u32>,
        mode: Option<Mode<'a>>,
        #[serde(rename = "type")]
        sensor_type: &'a str,
        unit_mm: Option<u8>,
        angle_deg: Option<u16>,
        step_deg: Option<f64>,
        hz: Option<f64>,
        port: &'a str,
        since_ns: u64,
        #[serde(serialize_with = "counters")]
        counters: &'a Counters,
        last_error: &'a str,
        pose: PoseJson,
        marks: MarksAvailability,
        damaged: f64,
        lost_on_line: Option<u64>,
    }
    #[derive(Serialize)]
    #[serde(untagged)]
    enum Mode<'a> {
        Number(u8),
        Name(&'a str),
    }
    StatusJson {
        class: "status",
        sensor,
        state: status.state().map_or("unknown", |state| state.name()),
        family: status.family().map(Family::name),
        model: status.model(),
        baud: known(status.baud, 0),
        mode: known(status.mode, Status::MODE_UNKNOWN)
            .map(Mode::Number)
            .or(status.mode_name().map(Mode::Name)),
        sensor_type: status.sensor_type(),
        unit_mm: known(status.unit_mm, 0),
        angle_deg: known(status.angle_deg, 0),
        step_deg: known(status.resolution_cdeg, 0).map(|step| f64::from(step) / 100.0),
        hz: status.rate_hz(),
        port: status.port(),
        since_ns: status.since_ns,
        counters: &status.counters,
        last_error: status.last_error(),
        pose: PoseJson {
            x_m: status.pose.x_m,
            y_m: status.pose.y_m,
            yaw_rad: status.pose.yaw_rad,
            upside_down: status.pose.upside_down != 0,
        },
        marks: MarksAvailability { available: status.has_marks(), remedy: marks_remedy(sensor, status) },
        damaged: status.damaged_share(),
        lost_on_line: status.lost_on_line(),
    }
}

/// Returns the command that makes topic `marks` available, or the setting of link `sensor` that does. Returns `None` if
/// `marks` is available, if that is unknown, or if the sensor can never publish marks.
pub(crate) fn marks_remedy(sensor: &str, status: &Status) -> Option<String> {
    // Name of the sensor on the machine to which it is connected.
    let name = sensor.rsplit('.').next().unwrap_or(sensor);
    if status.family()?.has_reflector_levels() {
        let mode = status.missing_reflector_mode()?;
        Some(format!("scanhub configure {} mode={mode:#04x}", status.port()))
    } else {
        (!status.has_mark_level()).then(|| format!("set link.{name}.marks.level"))
    }
}

/// Writes lines of class `notice`: one line for each name in `names`, or a single line without a name if `names` is
/// empty.
pub(crate) fn notices(
    output: &mut Output<'_>,
    names: &[Rc<TopicName>],
    notice: &Notice,
) -> Result<(), ExitReason> {
    #[derive(Serialize)]
    struct NoticesJson<'a> {
        class: &'static str,
        kind: &'static str,
        sensor: Option<&'a str>,
        topic: Option<&'static str>,
        missed: u64,
        #[serde(skip_serializing_if = "Option::is_none")]
        hint: Option<&'a str>,
    }
    let (kind, missed, hint) = match notice {
        Notice::Missed(missed) => ("missed", *missed, None),
        Notice::Stale => ("stale", 0, None),
        Notice::NoHub(failure) => ("hub_gone", 0, Some(failure.hint.as_str())),
        Notice::HubGone => ("hub_gone", 0, None),
        Notice::HubBack => ("hub_back", 0, None),
    };
    if names.is_empty() {
        return output.json(&NoticesJson { class: "notice", kind, sensor: None, topic: None, missed, hint });
    }
    names.iter().try_for_each(|name| {
        let (sensor, topic) = (Some(name.sensor.as_str()), Some(name.topic.name()));
        output.json(&NoticesJson { class: "notice", kind, sensor, topic, missed, hint })
    })
}

/// Returns the line of class `summary`.
pub(crate) fn summary<'a>(name: &'a TopicName, stats: &ReceiveStats) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct SummaryJson<'a> {
        class: &'static str,
        sensor: &'a str,
        topic: &'static str,
        received: u64,
        missed: u64,
        seconds: f64,
        hz: Option<f64>,
        damaged: Option<f64>,
        lost_on_line: Option<u64>,
    }
    SummaryJson {
        class: "summary",
        sensor: &name.sensor,
        topic: name.topic.name(),
        received: stats.received,
        missed: stats.missed,
        seconds: stats.seconds(),
        hz: stats.hz(),
        damaged: stats.loss.damaged,
        lost_on_line: stats.loss.lost_on_line,
    }
}

/// Returns the line of class `control`.
pub(crate) fn control<'a>(sensor: &'a str, verb: Verb) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct ControlJson<'a> {
        class: &'static str,
        sensor: &'a str,
        verb: &'static str,
        outcome: &'static str,
    }
    ControlJson { class: "control", sensor, verb: verb.name(), outcome: "taken" }
}

/// Returns the line of class `error`, without a line feed. A program writes it when a verb has failed.
pub fn error(failure: &Failure) -> String {
    #[derive(Serialize)]
    struct ErrorJson<'a> {
        class: &'a str,
        kind: &'a str,
        message: &'a str,
        hint: &'a str,
    }
    let line = ErrorJson {
        class: "error",
        kind: failure.kind.name(),
        message: &failure.message,
        hint: &failure.hint,
    };
    scanhub_schema::json_line(serde_json::to_string(&line).unwrap_or_default())
}

fn known<T: PartialEq>(value: T, unknown: T) -> Option<T> {
    (value != unknown).then_some(value)
}

fn id<S: Serializer>(value: &Option<u64>, serializer: S) -> Result<S::Ok, S::Error> {
    match value {
        Some(value) => serializer.collect_str(&format_args!("{value:016x}")),
        None => serializer.serialize_none(),
    }
}

fn hex<S: Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&crate::text::Hex(bytes))
}

fn ranges<S: Serializer>(scan: &Scan, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq((0..scan.beams()).map(|i| scan.range(i)))
}

fn codes<S: Serializer>(scan: &Scan, serializer: S) -> Result<S::Ok, S::Error> {
    let code = |i| Some((i, scan.code(i).filter(|code| *code != Code::NotMeasured)?.name()));
    serializer.collect_seq((0..scan.beams()).filter_map(code))
}

fn intensities<S: Serializer>(intensities: &Intensities<'_>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(intensities.iter())
}

/// Serializes the exact angle of each beam that has a range.
fn angles<S: Serializer>(scan: &Scan, serializer: S) -> Result<S::Ok, S::Error> {
    let angle = |i| scan.range(i).map(|_| (scan.angle_deg(i) * 1e4).round() / 1e4);
    serializer.collect_seq((0..scan.beams()).map(angle))
}

fn has_grid_only(scan: &Scan) -> bool {
    scan.exact_angles().is_empty()
}

fn counters<S: Serializer>(counters: &Counters, serializer: S) -> Result<S::Ok, S::Error> {
    let mut map = serializer.serialize_map(None)?;
    for (name, value) in counters.named_values() {
        map.serialize_entry(name, &value)?;
    }
    map.end()
}

#[cfg(test)]
mod tests {
    use scanhub_schema::{ArrayFlags, Code, Family, Flags, Header, Pose, Reasons, Scan, ScanHead, Status};

    fn header() -> Header {
        Header {
            seq: 7,
            topic_seq: 6,
            stamp_first_ns: 1_000_000_000,
            wall_ns: 1_700_000_000_000_000_000,
            boot: 0xAB,
            ..Header::default()
        }
    }

    fn line(header: &Header, scan: &Scan) -> String {
        serde_json::to_string(&super::scan("front", header, scan)).unwrap()
    }

    const BEGIN: &str = r#"{"class":"scan","sensor":"front","seq":7,"topic_seq":6,"stamp_ns":1000000000,"wall_ns":1700000000000000000,"boot":"00000000000000ab","quality":"#;

    #[test]
    fn lms_scan_is_written_as_json() {
        let mut scan = Scan::of(ScanHead::lms(5, -90_000, 500, 10, 13), &[1000, 0x1FFF, 0x1FFE, 0x1FF7, 7]);
        let before = r#""clean","family":"lms","unit_um":10000,"count":5,"first_angle_deg":-90.0,"step_deg":0.5,"beam_time_ns":18500,"#;
        let measured =
            r#""ranges":[1000,null,null,null,7],"codes":[[1,"no_return"],[2,"too_bright"],[3,"beyond"]]"#;
        assert_eq!(line(&header(), &scan), [BEGIN, before, measured, "}"].concat());
        // Field bits do not count as intensities, but reflector levels do.
        scan.arrays().upper.copy_from_slice(&[0, 0, 0, 0, 3]);
        assert_eq!(line(&header(), &scan), [BEGIN, before, measured, "}"].concat());
        scan.intensity_bits = 3;
        let flags = Header { flags: Flags::SIMULATED, ..header() };
        let levels = r#","intensities":[0,0,0,0,3],"flags":["simulated"]}"#;
        assert_eq!(line(&flags, &scan), [BEGIN, before, measured, levels].concat());
    }

    #[test]
    fn scan_with_exact_angles_is_written_as_json() {
        let head = ScanHead {
            step: -90_f64.to_radians(),
            beam_time_ns: 62_500,
            unit_um: 250,
            valid_to: 0xFFEF,
            no_return: Code::NoReturn.value(),
            collisions: 2,
            family: Family::Ld as u8,
            flags: Scan::INCOMPLETE,
            contents: ArrayFlags::ANGLES | ArrayFlags::WIDE,
            intensity_bits: 16,
            ..ScanHead::default()
        };
        let mut scan = Scan::of(head, &[4001, Code::NoReturn.value(), Scan::NOT_MEASURED, 0]);
        let arrays = scan.arrays();
        arrays.angles.copy_from_slice(&[0.25, -1.5, f32::NAN, -4.75]);
        arrays.wide.copy_from_slice(&[700, 1, 0, 65_535]);
        let header = Header { quality: 1, reasons: Reasons::SLOW, flags: Flags::SIMULATED, ..header() };
        let head = r#""suspect","reasons":["slow"],"family":"ld","unit_um":250,"count":4,"first_angle_deg":0.0,"step_deg":-90.0,"beam_time_ns":62500,"#;
        let measured = r#""ranges":[4001,null,null,0],"codes":[[1,"no_return"]],"intensities":[700,1,0,65535],"angles_deg":[14.3239,null,null,-272.155],"#;
        let end = r#""collisions":2,"incomplete":true,"flags":["simulated"]}"#;
        assert_eq!(line(&header, &scan), [BEGIN, head, measured, end].concat());
        (scan.collisions, scan.flags) = (0, 0);
        let end = r#""collisions":0,"flags":["simulated"]}"#;
        assert_eq!(line(&header, &scan), [BEGIN, head, measured, end].concat());
    }

    #[test]
    fn marks_need_reflector_bits_or_a_threshold() {
        let remedy = |family: u8, mode, has_mark_level| {
            let mut status = Status { family, mode, ..Status::default() };
            status.set_port("/dev/ttyUSB0");
            status.set_processing(Pose::default(), has_mark_level);
            super::marks_remedy("robot1.front", &status)
        };
        let configure = Some("scanhub configure /dev/ttyUSB0 mode=0x01".to_owned());
        for family in Family::ALL {
            let number = family as u8;
            let [without, with] =
                [false, true].map(|has_level| remedy(number, Status::MODE_UNKNOWN, has_level));
            if family.has_reflector_levels() {
                assert_eq!((without, with), (None, None));
                assert_eq!((remedy(number, 0, true), remedy(number, 1, false)), (configure.clone(), None));
            } else {
                assert_eq!((without, with), (Some("set link.front.marks.level".to_owned()), None));
            }
        }
        assert_eq!(remedy(Family::UNKNOWN, Status::MODE_UNKNOWN, true), None, "while the hub searches");
    }
}
