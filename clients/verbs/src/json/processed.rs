//! The classes of the results that the hub computes from a scan: marks, lines, motion, zones, foreground. A contract, like its parent
//! module.

use scanhub_client::{Heard, Robot};
use scanhub_schema::{
    Corner, Early, Foreground, Header, Line as StraightLine, Lines, Mark, Marks, Motion, ROBOT, Segment,
    Verdict, Zone, Zones, in_degrees,
};
use serde::{Serialize, Serializer};

use super::{Stamp, Words};

/// Class `marks`.
pub(crate) fn marks<'a>(sensor: &'a str, header: &Header, marks: &'a Marks) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        available: bool,
        overflow: bool,
        #[serde(serialize_with = "mark_list")]
        marks: &'a [Mark],
        #[serde(flatten)]
        flags: Words,
    }
    Line {
        stamp: Stamp::new("marks", sensor, header),
        available: marks.is_available(),
        overflow: marks.is_overflow(),
        marks: marks.marks(),
        flags: Words::of(header),
    }
}

/// Class `lines`.
pub(crate) fn lines<'a>(sensor: &'a str, header: &Header, lines: &'a Lines) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        readings: u16,
        points: u16,
        noise_m: f64,
        overflow: bool,
        #[serde(serialize_with = "line_list")]
        lines: &'a [StraightLine],
        #[serde(serialize_with = "corner_list")]
        corners: &'a [Corner],
        #[serde(flatten)]
        flags: Words,
    }
    Line {
        stamp: Stamp::new("lines", sensor, header),
        readings: lines.readings,
        points: lines.on_lines,
        noise_m: millionths(lines.noise_m),
        overflow: lines.is_overflow(),
        lines: lines.lines(),
        corners: lines.corners(),
        flags: Words::of(header),
    }
}

/// Class `motion`; what is not known is null.
pub(crate) fn motion<'a>(sensor: &'a str, header: &Header, motion: &Motion) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        dx_m: Option<f64>,
        dy_m: Option<f64>,
        dyaw_deg: Option<f64>,
        covariance: Option<[f32; 9]>,
        overlap: Option<f64>,
        method: &'static str,
        x_m: Option<f64>,
        y_m: Option<f64>,
        yaw_deg: Option<f64>,
        valid: bool,
        degenerate: bool,
        breaks: u16,
        pose_covariance: Option<[f32; 9]>,
        #[serde(flatten)]
        flags: Words,
    }
    let of_step = |value: f32| motion.has_step().then(|| millionths(value));
    let of_pose = |value: f64| motion.has_pose().then(|| millionths(value));
    Line {
        stamp: Stamp::new("motion", sensor, header),
        dx_m: of_step(motion.dx_m),
        dy_m: of_step(motion.dy_m),
        dyaw_deg: motion.has_step().then(|| in_degrees(motion.dyaw_rad.into())),
        covariance: motion.has_step().then_some(motion.covariance),
        overlap: of_step(motion.overlap),
        method: motion.how().name(),
        x_m: of_pose(motion.x_m),
        y_m: of_pose(motion.y_m),
        yaw_deg: motion.has_pose().then(|| in_degrees(motion.yaw_rad)),
        valid: motion.has_valid_pose(),
        degenerate: motion.is_degenerate(),
        breaks: motion.breaks,
        pose_covariance: motion.sum_covariance().copied(),
        flags: Words::of(header),
    }
}

/// Class `early`.
pub(crate) fn early<'a>(sensor: &'a str, header: &Header, early: &Early) -> impl Serialize + use<'a> {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        verdict: &'static str,
        beam: u16,
        distance_mm: u32,
        bytes_seen: u16,
        beams_seen: u16,
        #[serde(skip_serializing_if = "std::ops::Not::not")]
        withdrawn: bool,
        #[serde(flatten)]
        flags: Words,
    }
    Line {
        stamp: Stamp::new("early", sensor, header),
        verdict: early.verdict().name(),
        beam: early.beam,
        distance_mm: early.distance_mm,
        bytes_seen: early.bytes_seen,
        beams_seen: early.beams_seen,
        withdrawn: early.is_withdrawn(),
        flags: Words::of(header),
    }
}

/// Class `zones`; a silence has neither numbers nor stamps.
pub(crate) fn zones<'a>(sensor: &'a str, heard: &'a Heard) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        verdict: &'static str,
        nearest_mm: Option<u32>,
        nearest_beam: Option<u16>,
        #[serde(serialize_with = "zone_list")]
        zones: &'a [Zone],
        invalid_beams: u16,
        #[serde(skip_serializing_if = "std::ops::Not::not")]
        provisional: bool,
        #[serde(skip_serializing_if = "std::ops::Not::not")]
        stale: bool,
        #[serde(flatten)]
        flags: Option<Words>,
    }
    let zones = &heard.zones;
    let (nearest_beam, nearest_mm) = zones.nearest().unzip();
    let stamp = match &heard.header {
        Some(header) => Stamp::new("zones", sensor, header),
        None => Stamp::unheard("zones", sensor),
    };
    Line {
        stamp,
        verdict: zones.verdict().name(),
        nearest_mm,
        nearest_beam,
        zones: zones.zones(),
        invalid_beams: zones.invalid_beams,
        provisional: zones.flags & Zones::PROVISIONAL != 0,
        stale: heard.stale,
        flags: heard.header.as_ref().map(Words::of),
    }
}

/// Class `zones` of the robot: the fold over its sensors after `heard`, the last sample of one of them.
pub(crate) fn robot<'a>(robot: &'a Robot, heard: &Heard) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'static str,
        stamp_ns: Option<u64>,
        wall_ns: Option<u64>,
        verdict: &'static str,
        nearest_mm: Option<u32>,
        nearest_sensor: Option<&'a str>,
        #[serde(serialize_with = "verdict_list")]
        sensors: &'a Robot,
        #[serde(skip_serializing_if = "std::ops::Not::not")]
        stale: bool,
    }
    let (nearest_mm, nearest_sensor) = robot.nearest().unzip();
    Line {
        class: "zones",
        sensor: ROBOT,
        stamp_ns: heard.header.map(|header| header.stamp_first_ns),
        wall_ns: heard.header.map(|header| header.wall_ns),
        verdict: robot.verdict().name(),
        nearest_mm,
        nearest_sensor,
        sensors: robot,
        stale: heard.stale,
    }
}

/// Class `foreground`.
pub(crate) fn foreground<'a>(
    sensor: &'a str,
    header: &Header,
    foreground: &'a Foreground,
) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        generation: u32,
        #[serde(serialize_with = "scanhub_schema::unit_in_mm")]
        unit_mm: u32,
        #[serde(serialize_with = "beams")]
        beams: &'a Foreground,
        ranges: &'a [u16],
        #[serde(serialize_with = "segment_list")]
        segments: &'a Foreground,
        left_out: u16,
        #[serde(flatten)]
        flags: Words,
    }
    Line {
        stamp: Stamp::new("foreground", sensor, header),
        generation: foreground.generation,
        unit_mm: foreground.unit_um,
        beams: foreground,
        ranges: foreground.ranges(),
        segments: foreground,
        left_out: foreground.left_out,
        flags: Words::of(header),
    }
}

fn mark_list<S: Serializer>(marks: &[Mark], serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item {
        angle_deg: f64,
        range_mm: f64,
        peak: u8,
        weight: u16,
        first_beam: u16,
        last_beam: u16,
        edge: bool,
    }
    serializer.collect_seq(marks.iter().map(|mark| Item {
        angle_deg: f64::from(mark.angle_mdeg) / 1000.0,
        range_mm: f64::from(mark.range_dmm) / 10.0,
        peak: mark.peak,
        weight: mark.weight,
        first_beam: mark.first_beam,
        last_beam: mark.last_beam,
        edge: mark.edge != 0,
    }))
}

fn line_list<S: Serializer>(lines: &[StraightLine], serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item {
        x1_m: f64,
        y1_m: f64,
        x2_m: f64,
        y2_m: f64,
        r_m: f64,
        alpha_deg: f64,
        first: u16,
        last: u16,
        points: u16,
        sd_r_m: f64,
        sd_alpha_deg: f64,
    }
    serializer.collect_seq(lines.iter().map(|line| Item {
        x1_m: millionths(line.x1_m),
        y1_m: millionths(line.y1_m),
        x2_m: millionths(line.x2_m),
        y2_m: millionths(line.y2_m),
        r_m: millionths(line.r_m),
        alpha_deg: millionths(in_degrees(line.alpha_rad.into())),
        first: line.first,
        last: line.last,
        points: line.points,
        sd_r_m: millionths(line.sd_r_m),
        sd_alpha_deg: millionths(in_degrees(line.sd_alpha_rad.into())),
    }))
}

fn corner_list<S: Serializer>(corners: &[Corner], serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item {
        x_m: f64,
        y_m: f64,
        first: u16,
        second: u16,
    }
    serializer.collect_seq(corners.iter().map(|corner| Item {
        x_m: millionths(corner.x_m),
        y_m: millionths(corner.y_m),
        first: corner.first_line,
        second: corner.second_line,
    }))
}

/// As many digits as there is sense in: six behind the point.
pub(super) fn millionths(value: impl Into<f64>) -> f64 {
    (1e6 * value.into()).round() / 1e6
}

fn zone_list<S: Serializer>(zones: &[Zone], serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item {
        radius_mm: u16,
        violated: bool,
        beams: u16,
    }
    serializer.collect_seq(zones.iter().map(|zone| Item {
        radius_mm: zone.radius_mm,
        violated: zone.violated != 0,
        beams: zone.beams,
    }))
}

fn verdict_list<S: Serializer>(robot: &Robot, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item<'a> {
        sensor: &'a str,
        verdict: &'static str,
    }
    let item = |(sensor, verdict): (_, Verdict)| Item { sensor, verdict: verdict.name() };
    serializer.collect_seq(robot.sensors().map(item))
}

fn segment_list<S: Serializer>(foreground: &Foreground, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item {
        first: u16,
        last: u16,
        nearest_mm: u64,
        width_mm: u64,
        x_mm: i32,
        y_mm: i32,
        support: bool,
    }
    let in_mm = |range: u16| u64::from(range) * u64::from(foreground.unit_um) / 1000;
    let item = |(i, segment): (usize, &Segment)| Item {
        first: segment.first,
        last: segment.last,
        nearest_mm: in_mm(segment.nearest),
        width_mm: in_mm(segment.width),
        x_mm: segment.x_mm,
        y_mm: segment.y_mm,
        support: foreground.has_support(i),
    };
    serializer.collect_seq(foreground.segments().iter().enumerate().map(item))
}

fn beams<S: Serializer>(foreground: &Foreground, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(foreground.readings().map(|(beam, _)| beam))
}
