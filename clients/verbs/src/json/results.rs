//! Classes of results that the hub and its clients compute from scans: marks, lines, motion, zones, foreground, people,
//! tilt and obstacles. As in the parent module, keys may be added but never changed.

use scanhub_client::{Robot, ZonesUpdate};
use scanhub_schema::{
    Cloud, Corner, Early, Event, Foreground, Header, Line as StraightLine, Lines, Mark, Marks, Motion,
    Obstacle, Obstacles, ROBOT, Segment, Tilt, Tracks, Verdict, Zone, Zones, in_degrees,
};
use serde::{Serialize, Serializer};

use super::{FlagNames, SampleKeys};

/// Returns the line of class `marks`.
pub(crate) fn marks<'a>(sensor: &'a str, header: &Header, marks: &'a Marks) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct MarksJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        available: bool,
        overflow: bool,
        #[serde(serialize_with = "mark_list")]
        marks: &'a [Mark],
        #[serde(flatten)]
        flags: FlagNames,
    }
    MarksJson {
        stamp: SampleKeys::new("marks", sensor, header),
        available: marks.is_available(),
        overflow: marks.is_overflow(),
        marks: marks.marks(),
        flags: FlagNames::of(header),
    }
}

/// Returns the line of class `lines`.
pub(crate) fn lines<'a>(sensor: &'a str, header: &Header, lines: &'a Lines) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct LinesJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        readings: u16,
        points: u16,
        noise_m: f64,
        overflow: bool,
        #[serde(serialize_with = "line_list")]
        lines: &'a [StraightLine],
        #[serde(serialize_with = "corner_list")]
        corners: &'a [Corner],
        #[serde(flatten)]
        flags: FlagNames,
    }
    LinesJson {
        stamp: SampleKeys::new("lines", sensor, header),
        readings: lines.readings,
        points: lines.on_lines,
        noise_m: millionths(lines.noise_m),
        overflow: lines.is_overflow(),
        lines: lines.lines(),
        corners: lines.corners(),
        flags: FlagNames::of(header),
    }
}

/// Returns the line of class `motion`. Unknown values are null.
pub(crate) fn motion<'a>(sensor: &'a str, header: &Header, motion: &Motion) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct MotionJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
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
        refused_steps: u16,
        pose_covariance: Option<[f32; 9]>,
        #[serde(flatten)]
        flags: FlagNames,
    }
    let of_step = |value: f32| motion.has_step().then(|| millionths(value));
    let of_pose = |value: f64| motion.has_pose().then(|| millionths(value));
    MotionJson {
        stamp: SampleKeys::new("motion", sensor, header),
        dx_m: of_step(motion.dx_m),
        dy_m: of_step(motion.dy_m),
        dyaw_deg: motion.has_step().then(|| in_degrees(motion.dyaw_rad.into())),
        covariance: motion.has_step().then_some(motion.covariance),
        overlap: of_step(motion.overlap),
        method: motion.method().name(),
        x_m: of_pose(motion.x_m),
        y_m: of_pose(motion.y_m),
        yaw_deg: motion.has_pose().then(|| in_degrees(motion.yaw_rad)),
        valid: motion.has_valid_pose(),
        degenerate: motion.is_degenerate(),
        refused_steps: motion.refused_steps,
        pose_covariance: motion.sum_covariance().copied(),
        flags: FlagNames::of(header),
    }
}

/// Returns the line of class `early`.
pub(crate) fn early<'a>(sensor: &'a str, header: &Header, early: &Early) -> impl Serialize + use<'a> {
    #[derive(Serialize)]
    struct EarlyJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        verdict: &'static str,
        beam: u16,
        distance_mm: u32,
        bytes_seen: u16,
        beams_seen: u16,
        #[serde(skip_serializing_if = "std::ops::Not::not")]
        withdrawn: bool,
        #[serde(flatten)]
        flags: FlagNames,
    }
    EarlyJson {
        stamp: SampleKeys::new("early", sensor, header),
        verdict: early.verdict().name(),
        beam: early.beam,
        distance_mm: early.distance_mm,
        bytes_seen: early.bytes_seen,
        beams_seen: early.beams_seen,
        withdrawn: early.is_withdrawn(),
        flags: FlagNames::of(header),
    }
}

/// Returns the line of class `zones`. A line about a silence has neither sequence numbers nor stamps.
pub(crate) fn zones<'a>(sensor: &'a str, update: &'a ZonesUpdate) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct ZonesJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
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
        flags: Option<FlagNames>,
    }
    let zones = &update.zones;
    let (nearest_beam, nearest_mm) = zones.nearest().unzip();
    let stamp = match &update.header {
        Some(header) => SampleKeys::new("zones", sensor, header),
        None => SampleKeys::for_silence("zones", sensor),
    };
    ZonesJson {
        stamp,
        verdict: zones.verdict().name(),
        nearest_mm,
        nearest_beam,
        zones: zones.zones(),
        invalid_beams: zones.invalid_beams,
        provisional: zones.flags & Zones::PROVISIONAL != 0,
        stale: update.stale,
        flags: update.header.as_ref().map(FlagNames::of),
    }
}

/// Returns the line of class `zones` of the robot, with the combined verdict after `update`. `update` has the last
/// zones of one sensor of the robot.
pub(crate) fn robot<'a>(robot: &'a Robot, update: &ZonesUpdate) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct RobotJson<'a> {
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
    RobotJson {
        class: "zones",
        sensor: ROBOT,
        stamp_ns: update.header.map(|header| header.stamp_first_ns),
        wall_ns: update.header.map(|header| header.wall_ns),
        verdict: robot.verdict().name(),
        nearest_mm,
        nearest_sensor,
        sensors: robot,
        stale: update.stale,
    }
}

/// Returns the line of class `foreground`.
pub(crate) fn foreground<'a>(
    sensor: &'a str,
    header: &Header,
    foreground: &'a Foreground,
) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct ForegroundJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        generation: u32,
        #[serde(serialize_with = "scanhub_schema::unit_in_mm")]
        unit_mm: u32,
        #[serde(serialize_with = "beams")]
        beams: &'a Foreground,
        ranges: &'a [u16],
        #[serde(serialize_with = "segment_list")]
        segments: &'a Foreground,
        dropped: u16,
        #[serde(flatten)]
        flags: FlagNames,
    }
    ForegroundJson {
        stamp: SampleKeys::new("foreground", sensor, header),
        generation: foreground.generation,
        unit_mm: foreground.unit_um,
        beams: foreground,
        ranges: foreground.ranges(),
        segments: foreground,
        dropped: foreground.dropped,
        flags: FlagNames::of(header),
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

/// Rounds to six decimals; more would be noise.
fn millionths(value: impl Into<f64>) -> f64 {
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

/// Returns the line of class `tracks`.
pub fn tracks<'a>(sensor: &'a str, header: &Header, tracks: &'a Tracks) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct TracksJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        #[serde(serialize_with = "track_list")]
        tracks: &'a Tracks,
        #[serde(flatten)]
        flags: FlagNames,
    }
    TracksJson { stamp: SampleKeys::new("tracks", sensor, header), tracks, flags: FlagNames::of(header) }
}

/// Returns the line of class `event`.
pub fn event<'a>(sensor: &'a str, header: &Header, event: &'a Event) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct EventJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        kind: Option<&'static str>,
        id: u64,
        room: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        from: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        to: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        door: Option<&'a str>,
        #[serde(flatten)]
        flags: FlagNames,
    }
    let passage = event.door();
    EventJson {
        stamp: SampleKeys::new("event", sensor, header),
        kind: event.kind().map(|kind| kind.name()),
        id: event.id,
        room: event.room_name(),
        from: passage.map(|(_, from, _)| from),
        to: passage.map(|(.., to)| to),
        door: passage.map(|(door, ..)| door),
        flags: FlagNames::of(header),
    }
}

fn track_list<S: Serializer>(tracks: &Tracks, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item<'a> {
        id: u64,
        state: &'static str,
        x_m: f64,
        y_m: f64,
        vx_m_s: f64,
        vy_m_s: f64,
        cov: [f64; 3],
        room: Option<&'a str>,
        sensors: Vec<&'a str>,
        age_s: f64,
        score: f64,
    }
    serializer.collect_seq(tracks.tracks().iter().map(|track| Item {
        id: track.id,
        state: track.state().name(),
        x_m: thousandths(track.x_m),
        y_m: thousandths(track.y_m),
        vx_m_s: thousandths(track.vx_m_s),
        vy_m_s: thousandths(track.vy_m_s),
        cov: track.covariance.map(millionths),
        room: track.room_name(),
        sensors: tracks.sensor_names_of(track).collect(),
        age_s: f64::from(track.age_ms) / 1000.0,
        score: thousandths(track.score),
    }))
}

/// Rounds to a millimeter; more would be noise.
fn thousandths(value: f32) -> f64 {
    (1e3 * f64::from(value)).round() / 1e3
}

/// Returns the line of class `tilt`.
pub(crate) fn tilt<'a>(sensor: &'a str, header: &Header, tilt: &Tilt) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct TiltJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        angle_deg: f64,
        rate_deg_s: Option<f64>,
        #[serde(flatten)]
        flags: FlagNames,
    }
    TiltJson {
        stamp: SampleKeys::new("tilt", sensor, header),
        angle_deg: degrees(tilt.angle_rad),
        rate_deg_s: tilt.rate_rad_s().map(degrees),
        flags: FlagNames::of(header),
    }
}

/// Returns the line of class `cloud`.
pub(crate) fn cloud<'a>(sensor: &'a str, header: &Header, cloud: &'a Cloud) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct CloudJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        sweep: u32,
        generation: u32,
        first: bool,
        last: bool,
        complete: bool,
        unreliable: bool,
        #[serde(serialize_with = "point_list")]
        points: &'a Cloud,
        #[serde(serialize_with = "beam_list")]
        beams: &'a Cloud,
        #[serde(serialize_with = "class_list")]
        classes: &'a Cloud,
        #[serde(flatten)]
        flags: FlagNames,
    }
    CloudJson {
        stamp: SampleKeys::new("cloud", sensor, header),
        sweep: cloud.sweep,
        generation: cloud.generation,
        first: cloud.has(Cloud::FIRST),
        last: cloud.has(Cloud::LAST),
        complete: cloud.has(Cloud::COMPLETE),
        unreliable: cloud.has(Cloud::UNRELIABLE),
        points: cloud,
        beams: cloud,
        classes: cloud,
        flags: FlagNames::of(header),
    }
}

/// Returns the line of class `obstacles`.
pub fn obstacles<'a>(sensor: &'a str, header: &Header, found: &'a Obstacles) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct ObstaclesJson<'a> {
        #[serde(flatten)]
        stamp: SampleKeys<'a>,
        sweep: u32,
        generation: u32,
        complete: bool,
        unreliable: bool,
        #[serde(serialize_with = "obstacle_list")]
        obstacles: &'a Obstacles,
        dropped: u32,
        #[serde(flatten)]
        flags: FlagNames,
    }
    ObstaclesJson {
        stamp: SampleKeys::new("obstacles", sensor, header),
        sweep: found.sweep,
        generation: found.generation,
        complete: found.has(Obstacles::COMPLETE),
        unreliable: found.has(Obstacles::UNRELIABLE),
        obstacles: found,
        dropped: found.dropped,
        flags: FlagNames::of(header),
    }
}

fn point_list<S: Serializer>(cloud: &Cloud, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(cloud.points().iter().map(|point| point.at.map(thousandths)))
}

fn beam_list<S: Serializer>(cloud: &Cloud, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(cloud.points().iter().map(|point| point.beam))
}

fn class_list<S: Serializer>(cloud: &Cloud, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(cloud.points().iter().map(|point| point.class() as u8))
}

fn obstacle_list<S: Serializer>(found: &Obstacles, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item {
        x_m: f64,
        y_m: f64,
        z_m: f64,
        low_m: [f64; 3],
        high_m: [f64; 3],
        distance_m: f64,
        points: u32,
        foreground: bool,
        near: bool,
    }
    serializer.collect_seq(found.obstacles().iter().map(|one| {
        let [x_m, y_m, z_m] = one.middle.map(thousandths);
        Item {
            x_m,
            y_m,
            z_m,
            low_m: one.low.map(thousandths),
            high_m: one.high.map(thousandths),
            distance_m: thousandths(one.distance_m),
            points: one.points,
            foreground: one.has(Obstacle::FOREGROUND),
            near: one.has(Obstacle::NEAR),
        }
    }))
}

fn degrees(angle_rad: f64) -> f64 {
    (1e4 * angle_rad.to_degrees()).round() / 1e4
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{CloudHead, CloudPoint, EventKind, Pose, Track, TrackSensor, TrackState};

    const HEAD: &str = r#""sensor":"house","seq":7,"topic_seq":6,"stamp_ns":5,"wall_ns":4,"boot":"00000000000000ab","quality":"clean","#;

    fn header() -> Header {
        Header { seq: 7, topic_seq: 6, stamp_first_ns: 5, wall_ns: 4, boot: 0xAB, ..Header::default() }
    }

    #[test]
    fn tracks_have_the_exact_json_form() {
        let mut all = Tracks::default();
        for name in ["front", "kitchen.rear"] {
            all.push_sensor(TrackSensor::new(name, &Pose::default()));
        }
        let mut track = Track {
            id: 3,
            x_m: 1.2344,
            y_m: -2.0,
            vx_m_s: 0.5,
            covariance: [0.01, 0.0, 0.02],
            score: 0.75,
            age_ms: 12_345,
            sensors: 2,
            state: TrackState::Confirmed as u8,
            ..Track::default()
        };
        track.set_room("hall");
        all.push(track);
        all.push(Track { id: 4, ..Track::default() });
        let line = letters(tracks("house", &header(), &all));
        let first = r#"{"id":3,"state":"confirmed","x_m":1.234,"y_m":-2.0,"vx_m_s":0.5,"vy_m_s":0.0,"cov":[0.01,0.0,0.02],"room":"hall","sensors":["kitchen.rear"],"age_s":12.345,"score":0.75}"#;
        let second = r#"{"id":4,"state":"tentative","x_m":0.0,"y_m":0.0,"vx_m_s":0.0,"vy_m_s":0.0,"cov":[0.0,0.0,0.0],"room":null,"sensors":[],"age_s":0.0,"score":0.0}"#;
        assert_eq!(line, format!(r#"{{"class":"tracks",{HEAD}"tracks":[{first},{second}]}}"#));
    }

    #[test]
    fn events_have_the_exact_json_form() {
        let door = Event::new(EventKind::Door, 3, Some("hall")).with_door("left", "outside", "hall");
        let line = letters(event("house", &header(), &door));
        let rest = r#""kind":"door","id":3,"room":"hall","from":"outside","to":"hall","door":"left"}"#;
        assert_eq!(line, format!(r#"{{"class":"event",{HEAD}{rest}"#));
        let left = Event::new(EventKind::Left, 4, None);
        let line = letters(event("house", &header(), &left));
        assert_eq!(line, format!(r#"{{"class":"event",{HEAD}"kind":"left","id":4,"room":null}}"#));
    }

    fn letters(line: impl Serialize) -> String {
        serde_json::to_string(&line).unwrap()
    }

    #[test]
    fn tilt_angles_have_the_exact_json_form() {
        let sample = Tilt { angle_rad: -0.5, rate_rad_s: 0.25 };
        let rest = r#""angle_deg":-28.6479,"rate_deg_s":14.3239}"#;
        assert_eq!(letters(tilt("house", &header(), &sample)), format!(r#"{{"class":"tilt",{HEAD}{rest}"#));
        let rest = r#""angle_deg":0.0,"rate_deg_s":null}"#;
        let line = letters(tilt("house", &header(), &Tilt::default()));
        assert_eq!(line, format!(r#"{{"class":"tilt",{HEAD}{rest}"#));
    }

    #[test]
    fn cloud_has_the_exact_json_form() {
        let point =
            |beam, point_class| CloudPoint { at: [1.0, -2.5, 0.1234], beam, point_class, reserved: 0 };
        let flags = Cloud::FIRST | Cloud::COMPLETE;
        let head = CloudHead { sweep: 3, generation: 1, flags, ..CloudHead::default() };
        // An unknown point class is printed as 0.
        let line = letters(cloud("house", &header(), &Cloud::of(head, &[point(90, 2), point(91, 9)])));
        let rest = r#""sweep":3,"generation":1,"first":true,"last":false,"complete":true,"unreliable":false,"points":[[1.0,-2.5,0.123],[1.0,-2.5,0.123]],"beams":[90,91],"classes":[2,0]}"#;
        assert_eq!(line, format!(r#"{{"class":"cloud",{HEAD}{rest}"#));
    }

    #[test]
    fn obstacles_have_the_exact_json_form() {
        let mut found = Obstacles { sweep: 3, flags: Obstacles::COMPLETE, ..Obstacles::default() };
        found.push(Obstacle {
            middle: [2.0, 0.0, 0.5],
            low: [1.95, -0.05, 0.0],
            high: [2.05, 0.05, 1.0],
            distance_m: 1.95,
            points: 120,
            flags: Obstacle::FOREGROUND,
            ..Obstacle::default()
        });
        let line = letters(obstacles("house", &header(), &found));
        let one = r#"{"x_m":2.0,"y_m":0.0,"z_m":0.5,"low_m":[1.95,-0.05,0.0],"high_m":[2.05,0.05,1.0],"distance_m":1.95,"points":120,"foreground":true,"near":false}"#;
        let rest = format!(
            r#""sweep":3,"generation":0,"complete":true,"unreliable":false,"obstacles":[{one}],"dropped":0}}"#
        );
        assert_eq!(line, format!(r#"{{"class":"obstacles",{HEAD}{rest}"#));
    }
}
