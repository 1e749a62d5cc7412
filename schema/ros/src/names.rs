//! Names of topics and frames, and the transforms between frames.

use scanhub_schema::Pose;

use crate::cdr::Cdr;

/// Topic of [`static_transforms`].
pub const TF_STATIC: &str = "/tf_static";

/// Topic of [`diagnosis`](crate::diagnosis).
pub const DIAGNOSTICS: &str = "/diagnostics";

/// Frame of the robot, in which poses are given (REP 105).
pub const BASE_FRAME: &str = "base_link";

/// Returns the default name of the frame in which `sensor` measures.
pub fn frame(sensor: &str) -> &str {
    sensor
}

/// Returns the topic of `sensor`'s scans, with the default [`RosNames`]. The topics of a remote sensor `HUB.SENSOR` are
/// in a namespace for its hub.
pub fn scan_topic(sensor: &str) -> String {
    RosNames::default().topic(sensor, "scan")
}

/// Names of topics and frames.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RosNames {
    /// Start of every topic. This text is empty, or has names with a slash before each name.
    namespace: String,
    /// Part between the namespace and the name of a sensor, in the same form as the namespace.
    prefix: String,
    /// Sensor and frame, for each sensor whose frame does not have the default name.
    frames: Vec<(String, String)>,
}

impl RosNames {
    /// Creates names with `namespace` at the start of every topic, `prefix` after the namespace in topics of sensors,
    /// and a frame for each sensor in `frames`. The slash before the first name is optional.
    ///
    /// # Errors
    ///
    /// Returns the name that is not valid in ROS (<https://design.ros2.org/articles/topic_and_service_names.html>).
    pub fn new(namespace: &str, prefix: &str, frames: Vec<(String, String)>) -> Result<RosNames, String> {
        if let Some((_, invalid)) =
            frames.iter().find(|(_, frame)| frame.is_empty() || to_path(frame).is_none())
        {
            return Err(invalid.clone());
        }
        let path = |text: &str| to_path(text).ok_or_else(|| text.to_owned());
        Ok(RosNames { namespace: path(namespace)?, prefix: path(prefix)?, frames })
    }

    /// Returns the namespace: empty, or names that each follow a slash.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// Returns the topic `name` of `sensor`. The names in the topic have only letters, digits and `_`, and do not start
    /// with a digit.
    pub fn topic(&self, sensor: &str, name: &str) -> String {
        let mut topic = [self.namespace(), &self.prefix].concat();
        for part in sensor.split('.') {
            topic.push('/');
            if part.starts_with(|sign: char| sign.is_ascii_digit()) {
                topic.push_str("sensor_");
            }
            topic.extend(part.chars().map(|sign| if sign.is_ascii_alphanumeric() { sign } else { '_' }));
        }
        topic + "/" + name
    }

    /// Returns the topic `name`, such as [`TF_STATIC`], in the namespace.
    pub fn global_topic(&self, name: &str) -> String {
        [self.namespace(), name].concat()
    }

    /// Returns the sensors for which [`new`](Self::new) got a frame.
    pub fn sensors_with_frame(&self) -> impl Iterator<Item = &str> {
        self.frames.iter().map(|(sensor, _)| &**sensor)
    }

    /// Returns the frame in which `sensor` measures.
    pub fn frame<'a>(&'a self, sensor: &'a str) -> &'a str {
        self.frames
            .iter()
            .find(|(known_sensor, _)| known_sensor == sensor)
            .map_or(frame(sensor), |(_, frame)| frame)
    }
}

/// Appends the `poses` of the sensors on the robot, by their frames, to `message` as `tf2_msgs/msg/TFMessage`, with the
/// stamp `stamp_ns` (since 1970). Pass the poses of all sensors, because a late joiner gets only the last message of
/// the topic.
///
/// A sensor that is mounted upside down is rotated by 180 degrees around its x axis, and then by its yaw around the
/// robot's z axis. The angles of its scans then run in the other direction.
pub fn static_transforms(message: &mut Vec<u8>, stamp_ns: u64, poses: &[(String, Pose)]) {
    let mut cdr = Cdr::begin(message);
    cdr.u32(poses.len() as u32);
    for (frame, pose) in poses {
        cdr.header(stamp_ns, BASE_FRAME);
        cdr.text(frame);
        for value in [pose.x_m, pose.y_m, 0.0].into_iter().chain(rotation(pose)) {
            cdr.f64(value);
        }
    }
}

/// Returns the quaternion x, y, z, w that rotates a direction from the sensor's frame to the robot's frame.
fn rotation(pose: &Pose) -> [f64; 4] {
    let (sin, cos) = (pose.yaw_rad / 2.0).sin_cos();
    if pose.upside_down == 0 { [0.0, 0.0, sin, cos] } else { [cos, sin, 0.0, 0.0] }
}

/// Returns `text` with a slash before each of its names; `None` if one of the names is not valid in ROS.
fn to_path(text: &str) -> Option<String> {
    let text = text.strip_prefix('/').unwrap_or(text);
    if text.is_empty() {
        return Some(String::new());
    }
    let is_word = |word: &str| {
        word.starts_with(|sign: char| sign.is_ascii_alphabetic() || sign == '_')
            && word.chars().all(|sign| sign.is_ascii_alphanumeric() || sign == '_')
    };
    text.split('/').all(is_word).then(|| format!("/{text}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topic_names_are_valid_in_ros() {
        assert_eq!(scan_topic("front"), "/front/scan");
        assert_eq!(scan_topic("front-left_2"), "/front_left_2/scan");
        assert_eq!(scan_topic("5f3a12bc00d1e2f3.front"), "/sensor_5f3a12bc00d1e2f3/front/scan");
    }

    #[test]
    fn topic_and_frame_names_have_namespaces() {
        let frames = vec![("front".to_owned(), "laser".to_owned())];
        let names = RosNames::new("robot1/base", "/lidars", frames).unwrap();
        assert_eq!(names.topic("front", "zones"), "/robot1/base/lidars/front/zones");
        assert_eq!(names.global_topic(TF_STATIC), "/robot1/base/tf_static");
        assert_eq!((names.frame("front"), names.frame("rear")), ("laser", "rear"));
        assert_eq!(RosNames::new("", "/", Vec::new()), Ok(RosNames::default()));
        assert!(RosNames::new("", "", vec![("front".to_owned(), String::new())]).is_err());
        for bad in ["robot 1", "1st", "a//b", "a/", "a-b", "//a"] {
            assert_eq!(RosNames::new(bad, "", Vec::new()), Err(bad.to_owned()));
            assert_eq!(RosNames::new("", bad, Vec::new()), Err(bad.to_owned()));
            assert!(RosNames::new("", "", vec![("front".to_owned(), bad.to_owned())]).is_err());
        }
    }

    /// Returns `v` rotated by the quaternion: v + 2 u x (u x v + w v).
    fn turned([x, y, z, w]: [f64; 4], v: [f64; 3]) -> [f64; 3] {
        let cross = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let u = [x, y, z];
        let inner = cross(u, v);
        let outer = cross(u, std::array::from_fn(|i| inner[i] + w * v[i]));
        std::array::from_fn(|i| v[i] + 2.0 * outer[i])
    }

    #[test]
    fn rotation_of_a_frame_matches_the_pose() {
        for (yaw_rad, upside_down) in [(0.0, 0), (0.7, 0), (2.9, 1), (-1.2, 1), (0.0, 1)] {
            let pose = Pose { yaw_rad, upside_down, ..Pose::default() };
            for angle_deg in [-90.0_f64, -60.0, 0.0, 55.0, 90.0] {
                let (sin, cos) = angle_deg.to_radians().sin_cos();
                let [x, y, z] = turned(rotation(&pose), [cos, sin, 0.0]);
                let (wanted_x, wanted_y) = pose.direction(angle_deg.to_radians());
                let apart = (x - wanted_x).abs() + (y - wanted_y).abs() + z.abs();
                assert!(apart < 1e-12, "{pose:?} {angle_deg}: {x} {y} {z}, not {wanted_x} {wanted_y}");
            }
        }
    }

    #[test]
    fn static_transform_message_has_all_sensors() {
        let front = Pose { x_m: 0.5, ..Pose::default() };
        let poses = [("front".to_owned(), front), ("rear".to_owned(), Pose::default())];
        let mut message = Vec::new();
        static_transforms(&mut message, 1_700_000_000_000_000_007, &poses);
        assert_eq!(message[4..8], [2, 0, 0, 0]);
        assert_eq!(message[8..12], 1_700_000_000_u32.to_le_bytes());
        assert_eq!(message[12..16], [7, 0, 0, 0]);
        // A transform has a stamp and two texts with their ends. Seven numbers follow at a multiple of eight bytes.
        let x = 4 + (4 + 8 + 4 + 12 + 4 + 6_usize).next_multiple_of(8);
        assert_eq!(message[x..x + 8], 0.5f64.to_le_bytes());
        assert!(message[x + 56..].windows(5).any(|some| some == b"rear\0"));
    }
}
