//! Channels for viewers, and encoders of their messages from a scene and from samples. Scans and poses have types of
//! ROS, which every viewer can draw. Circles and marks have types of Foxglove. States and the verdict are JSON objects.

mod scene_update;

use scanhub_ros::{LASER_SCAN, POINT_CLOUD, TF_MESSAGE, TF_STATIC, Type, scan_topic};
use scanhub_schema::{Background, Counter, Header, Pose, Scan, ScanHead, Tilt, is_remote};
use serde::Serialize;

use super::channels::Channel;
use crate::scene::{Problem, Scene, Sensor, rooms};

pub(crate) use scene_update::{lines, marks, obstacles, tracks, zones};

/// Returns the channel of a sensor's scans, as `sensor_msgs/msg/LaserScan`.
pub(crate) fn scan_channel(sensor: &str) -> Channel {
    ros_channel(scan_topic(sensor), LASER_SCAN, false)
}

/// Returns the channel of a sensor's foreground, as `sensor_msgs/msg/PointCloud2`.
pub(crate) fn foreground_channel(sensor: &str) -> Channel {
    ros_channel(sibling_topic(sensor, "foreground"), POINT_CLOUD, false)
}

/// Returns the channel of a sensor's learned background, as `sensor_msgs/msg/LaserScan`.
pub(crate) fn background_channel(sensor: &str) -> Channel {
    ros_channel(sibling_topic(sensor, "background"), LASER_SCAN, true)
}

/// Returns the channel of the sensors' poses, as `tf2_msgs/msg/TFMessage`.
pub(crate) fn transforms_channel() -> Channel {
    ros_channel(TF_STATIC.to_owned(), TF_MESSAGE, true)
}

/// Returns the channel of the circles around the robot and the beams that violate them, as `foxglove.SceneUpdate`.
pub(crate) fn zones_channel() -> Channel {
    scene_update::channel("/zones")
}

/// Returns the channel of the reflector marks, as `foxglove.SceneUpdate`.
pub(crate) fn marks_channel() -> Channel {
    scene_update::channel("/marks")
}

/// Returns the channel of line features and corners, as `foxglove.SceneUpdate`.
pub(crate) fn lines_channel() -> Channel {
    scene_update::channel("/lines")
}

/// Returns the channel of the people of `tracker` and their tails, as `foxglove.SceneUpdate`.
pub(crate) fn tracks_channel(tracker: &str) -> Channel {
    scene_update::channel(&sibling_topic(tracker, "tracks"))
}

/// Returns the channel of the points of complete sweeps, as `sensor_msgs/msg/PointCloud2` in the robot's frame.
pub(crate) fn cloud_channel(name: &str) -> Channel {
    ros_channel(sibling_topic(name, "cloud"), POINT_CLOUD, false)
}

/// Returns the channel of the last sweep's obstacles, as `foxglove.SceneUpdate`. A message is not kept for later
/// subscribers, because it is valid only for a limited time after its arrival.
pub(crate) fn obstacles_channel(name: &str) -> Channel {
    Channel { is_kept: false, ..scene_update::channel(&sibling_topic(name, "obstacles")) }
}

/// Returns the channel of the verdict and the hub, see [`robot`].
pub(crate) fn robot_channel() -> Channel {
    json_channel("/robot".to_owned(), "scanhub.Robot", include_str!("messages/robot.json"))
}

/// Returns the channel of a sensor's state, see [`status`].
pub(crate) fn status_channel(sensor: &str) -> Channel {
    json_channel(sibling_topic(sensor, "status"), "scanhub.Status", include_str!("messages/status.json"))
}

/// Encodes the verdict of the robot's sensors, whether the sensors are shown in a map, the state of the hub, and a text
/// with the number of people in each room. `problem` is the reason why the scene is empty.
pub(crate) fn robot(scene: &Scene, domain: &str, problem: Option<&Problem>) -> Vec<u8> {
    #[derive(Serialize)]
    struct Robot<'a> {
        verdict: &'a str,
        sensor: Option<&'a str>,
        nearest_m: Option<f64>,
        domain: &'a str,
        hub: bool,
        pid: Option<u32>,
        load_percent: Option<f64>,
        hub_words: String,
        map: bool,
        people: Option<String>,
        problem: Option<ProblemJson<'a>>,
    }
    let (verdict, sensor, nearest_mm) = crate::scene::verdict(scene.robot().map(|(_, sensor)| sensor));
    json_bytes(&Robot {
        verdict: verdict.name(),
        sensor,
        nearest_m: nearest_mm.map(|mm| f64::from(mm) / 1000.0),
        domain,
        hub: scene.hub_is_running,
        pid: (scene.hub_pid != 0).then_some(scene.hub_pid),
        load_percent: scene.hub_percent,
        hub_words: hub_text(scene, domain),
        map: scene.is_in_map(),
        people: rooms(scene.people()),
        problem: problem.map(ProblemJson::of),
    })
}

/// Returns the state of the hub as text.
fn hub_text(scene: &Scene, domain: &str) -> String {
    if !scene.hub_is_running {
        return "no hub".to_owned();
    }
    let pid = if scene.hub_pid == 0 { String::new() } else { format!(", hub process {}", scene.hub_pid) };
    let load = scene.hub_percent.map_or(String::new(), |load| format!(", CPU {load:.1} %"));
    format!("domain {domain}{pid}{load}")
}

/// Encodes state, rate, ages and losses of `sensor`, the pose if it is known, and whether the scans come from a
/// simulator or a recording.
pub(crate) fn status(sensor: &Sensor) -> Vec<u8> {
    #[derive(Serialize)]
    struct SensorState<'a> {
        name: &'a str,
        state: &'a str,
        family: Option<&'a str>,
        model: Option<String>,
        port: Option<&'a str>,
        remote: bool,
        pose: Option<PoseJson>,
        hz: Option<f64>,
        missed: u64,
        lost_on_line: Option<u64>,
        lost_share: Option<f64>,
        damaged: f64,
        suspect: u64,
        age_p50_ms: Option<f64>,
        age_p99_ms: Option<f64>,
        frozen: bool,
        simulated: bool,
        replayed: bool,
        known_beams: Option<u32>,
        objects: Option<usize>,
        marks: Option<usize>,
        verdict: &'a str,
        nearest_m: Option<f64>,
        problem: Option<ProblemJson<'a>>,
    }
    #[derive(Serialize)]
    struct PoseJson {
        x_m: f64,
        y_m: f64,
        yaw_rad: f64,
        upside_down: bool,
    }
    let pose = |Pose { x_m, y_m, yaw_rad, upside_down, .. }| PoseJson {
        x_m,
        y_m,
        yaw_rad,
        upside_down: upside_down != 0,
    };
    let status = sensor.status.as_ref();
    let ages = sensor.meter.age_percentiles_ms();
    let problem = sensor.problem();
    json_bytes(&SensorState {
        name: &sensor.name,
        state: sensor.state(),
        family: status.and_then(|status| status.family()).map(|family| family.name()),
        model: status.and_then(|status| status.model()),
        port: status.map(|status| status.port()).filter(|port| !port.is_empty()),
        remote: is_remote(&sensor.name),
        pose: sensor.placement.pose().map(pose),
        hz: sensor.meter.hz(),
        missed: sensor.missed,
        lost_on_line: status.and_then(|status| status.lost_on_line()),
        lost_share: status.and_then(|status| status.lost_share()),
        damaged: status.map_or(0.0, |status| status.damaged_share()),
        suspect: sensor.count(Counter::Suspect),
        age_p50_ms: ages.map(|(half, _)| half),
        age_p99_ms: ages.map(|(_, most)| most),
        frozen: sensor.is_frozen(),
        simulated: sensor.is_simulated(),
        replayed: sensor.is_replayed(),
        known_beams: sensor.background.as_ref().map(|model| u32::from(model.known_beams)),
        objects: sensor.foreground.as_ref().map(|foreground| foreground.segments().len()),
        marks: sensor.marks.map(|marks| marks.marks().len()),
        verdict: sensor.zones.verdict().name(),
        nearest_m: sensor.zones.nearest().map(|(_, mm)| f64::from(mm) / 1000.0),
        problem: problem.as_ref().map(ProblemJson::of),
    })
}

/// Encodes the background of `sensor` as a scan. A range is NaN where the background is unknown, and +inf where the
/// background is out of range.
pub(crate) fn background(message: &mut Vec<u8>, sensor: &str, wall_ns: u64, model: &Background) {
    let as_scan = |range: &u16| match *range {
        Background::UNKNOWN => Scan::NOT_MEASURED,
        Background::FAR => BEYOND_RANGE,
        range => range.min(BEYOND_RANGE - 1),
    };
    let ranges: Vec<u16> = model.ranges().iter().map(as_scan).collect();
    let head = ScanHead {
        first_angle: model.first_angle,
        step: model.step,
        unit_um: model.unit_um,
        valid_to: BEYOND_RANGE - 1,
        no_return: BEYOND_RANGE,
        beyond: BEYOND_RANGE,
        ..ScanHead::default()
    };
    let header = Header { wall_ns, ..Header::default() };
    scanhub_ros::laser_scan(message, scanhub_ros::frame(sensor), &header, &Scan::of(head, &ranges));
}

/// Value in the scan where the background is out of range.
const BEYOND_RANGE: u16 = u16::MAX - 1;

/// Encodes the known poses of the sensors.
pub(crate) fn transforms(scene: &Scene, wall_ns: u64) -> Vec<u8> {
    let pose = |sensor: &Sensor| Some((sensor.name.clone(), sensor.placement.pose()?));
    let poses: Vec<_> = scene.sensors.iter().filter_map(pose).collect();
    let mut message = Vec::new();
    scanhub_ros::static_transforms(&mut message, wall_ns, &poses);
    message
}

/// Returns the channel of the angles of `mount`, see [`tilt`].
pub(crate) fn tilt_channel(mount: &str) -> Channel {
    let schema = include_str!("messages/tilt.json");
    Channel { is_kept: false, ..json_channel(sibling_topic(mount, "tilt"), "scanhub.Tilt", schema) }
}

/// Encodes the angle of a mount, and its rate if that is known.
pub(crate) fn tilt(tilt: &Tilt) -> Vec<u8> {
    #[derive(Serialize)]
    struct Angle {
        angle_deg: f64,
        rate_deg_s: Option<f64>,
    }
    let rate_deg_s = tilt.rate_rad_s().map(f64::to_degrees);
    json_bytes(&Angle { angle_deg: tilt.angle_rad.to_degrees(), rate_deg_s })
}

#[derive(Serialize)]
struct ProblemJson<'a> {
    what: &'a str,
    remedy: &'a str,
}

impl ProblemJson<'_> {
    fn of(problem: &Problem) -> ProblemJson<'_> {
        ProblemJson { what: &problem.description, remedy: &problem.remedy }
    }
}

/// Returns the topic `word` in the namespace of the sensor's scans.
fn sibling_topic(sensor: &str, word: &str) -> String {
    let topic = scan_topic(sensor);
    format!("{}{word}", topic.strip_suffix("scan").unwrap_or(&topic))
}

fn ros_channel(topic: String, kind: Type, is_kept: bool) -> Channel {
    let Type { name, text } = kind;
    Channel {
        topic,
        encoding: Type::ENCODING,
        schema_name: name,
        schema_encoding: Type::LANGUAGE,
        schema: text,
        is_kept,
    }
}

pub(super) fn json_channel(topic: String, schema_name: &'static str, schema: &'static str) -> Channel {
    Channel { topic, encoding: "json", schema_name, schema_encoding: "jsonschema", schema, is_kept: true }
}

pub(super) fn json_bytes(value: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(value).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_ros::read;
    use scanhub_schema::BackgroundHead;

    use crate::server::player;

    #[test]
    fn background_is_encoded_as_a_scan() {
        let head =
            BackgroundHead { first_angle: -1.0, step: 0.5, unit_um: 1000, ..BackgroundHead::default() };
        let model = Background::of(head, &[4000, Background::UNKNOWN, Background::FAR]);
        let mut message = Vec::new();
        background(&mut message, "front", 7, &model);
        let decoded = read(&LASER_SCAN, &message).unwrap();
        assert_eq!((decoded.text("header.frame_id"), decoded.number("ranges.0")), (Some("front"), Some(4.0)));
        assert!(decoded.number("ranges.1").unwrap().is_nan());
        assert_eq!(decoded.number("ranges.2"), Some(f64::INFINITY));
    }

    #[test]
    fn unknown_values_are_null() {
        let mut scene = Scene::default();
        let object = |bytes: Vec<u8>| serde_json::from_slice::<serde_json::Value>(&bytes).unwrap();
        let decoded = object(robot(&scene, "default", None));
        assert_eq!((&decoded["verdict"], &decoded["hub"]), (&"unknown".into(), &false.into()));
        assert_eq!((&decoded["hub_words"], &decoded["people"]), (&"no hub".into(), &serde_json::Value::Null));
        let decoded = object(status(scene.sensor("front")));
        assert_eq!((&decoded["state"], &decoded["hz"]), (&"no status".into(), &serde_json::Value::Null));
        assert_eq!(decoded["pose"], serde_json::Value::Null, "its pose is unknown");
        assert_eq!(decoded["problem"]["what"], "no data from it yet");
    }

    #[test]
    fn hub_text_has_domain_process_and_cpu_usage() {
        let mut scene = Scene { hub_is_running: true, ..Scene::default() };
        assert_eq!(hub_text(&scene, "default"), "domain default");
        (scene.hub_pid, scene.hub_percent) = (77, Some(1.26));
        assert_eq!(hub_text(&scene, "default"), "domain default, hub process 77, CPU 1.3 %");
    }

    #[test]
    fn messages_have_the_keys_of_their_schema() {
        let mut scene = Scene::default();
        scene.sensor("front");
        let keys = |value: &serde_json::Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        let pairs = [
            (robot_channel(), robot(&scene, "default", None)),
            (status_channel("front"), status(&scene.sensors[0])),
            (zones_channel(), zones(&scene, 1)),
            (marks_channel(), marks(&scene, 1)),
            (lines_channel(), lines(&scene, 1)),
            (tracks_channel("house"), tracks(&crate::scene::People::default(), 1)),
            (player::channel(), player::message(&player::Progress::default())),
            (tilt_channel("mount"), tilt(&Tilt::default())),
            (obstacles_channel("hall"), obstacles(&Header::default(), &scanhub_schema::Obstacles::default())),
        ];
        for (channel, message) in pairs {
            let schema: serde_json::Value = serde_json::from_str(channel.schema).unwrap();
            let message: serde_json::Value = serde_json::from_slice(&message).unwrap();
            assert_eq!(keys(&schema["properties"]), keys(&message), "{}", channel.topic);
        }
        assert_eq!(status_channel("hub1.front").topic, "/hub1/front/status");
    }
}
