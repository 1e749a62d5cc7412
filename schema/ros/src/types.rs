//! The types of the messages: their names and their texts. Refuses to know values.

/// A type of messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Type {
    /// Its name, such as `sensor_msgs/msg/LaserScan`.
    pub name: &'static str,
    /// Its fields, in the language `ros2msg`; the types that it contains follow, each after a line, as rosbag2 stores them.
    pub text: &'static str,
}

impl Type {
    /// How messages are encoded: little-endian CDR (OMG XCDR1).
    pub const ENCODING: &str = "cdr";
    /// The language of [`Type::text`].
    pub const LANGUAGE: &str = "ros2msg";
}

/// A scan.
pub const LASER_SCAN: Type = Type {
    name: "sensor_msgs/msg/LaserScan",
    text: "\
std_msgs/Header header
float32 angle_min
float32 angle_max
float32 angle_increment
float32 time_increment
float32 scan_time
float32 range_min
float32 range_max
float32[] ranges
float32[] intensities
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
",
};

/// Where frames are in others.
pub const TF_MESSAGE: Type = Type {
    name: "tf2_msgs/msg/TFMessage",
    text: "\
geometry_msgs/TransformStamped[] transforms
================================================================================
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
",
};
