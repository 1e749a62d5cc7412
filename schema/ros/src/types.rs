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
    /// Stands between two types in [`Type::text`].
    pub(crate) const LINE: &str =
        "================================================================================\nMSG: ";
}

/// The text of a type: its own fields, then each type that it contains, once.
macro_rules! text {
    ($($field:literal)+ $(; $($of:ident)+)?) => {
        concat!($($field, "\n",)+ $($(contained!($of),)+)?)
    };
}

/// A contained type, behind its line.
macro_rules! contained {
    (Header) => { contained!("std_msgs/Header": "builtin_interfaces/Time stamp" "string frame_id") };
    (Time) => { contained!("builtin_interfaces/Time": "int32 sec" "uint32 nanosec") };
    (Duration) => { contained!("builtin_interfaces/Duration": "int32 sec" "uint32 nanosec") };
    (TransformStamped) => {
        contained!("geometry_msgs/TransformStamped":
            "std_msgs/Header header" "string child_frame_id" "geometry_msgs/Transform transform")
    };
    (Transform) => {
        contained!("geometry_msgs/Transform":
            "geometry_msgs/Vector3 translation" "geometry_msgs/Quaternion rotation")
    };
    (Vector3) => { contained!("geometry_msgs/Vector3": "float64 x" "float64 y" "float64 z") };
    (Quaternion) => {
        contained!("geometry_msgs/Quaternion": "float64 x 0" "float64 y 0" "float64 z 0" "float64 w 1")
    };
    (Point) => { contained!("geometry_msgs/Point": "float64 x" "float64 y" "float64 z") };
    (Pose) => {
        contained!("geometry_msgs/Pose": "geometry_msgs/Point position" "geometry_msgs/Quaternion orientation")
    };
    (ColorRGBA) => { contained!("std_msgs/ColorRGBA": "float32 r" "float32 g" "float32 b" "float32 a") };
    (PointField) => {
        contained!("sensor_msgs/PointField":
            "string name" "uint32 offset" "uint8 datatype" "uint32 count")
    };
    (CompressedImage) => {
        contained!("sensor_msgs/CompressedImage": "std_msgs/Header header" "string format" "uint8[] data")
    };
    (Marker) => {
        contained!("visualization_msgs/Marker":
            "std_msgs/Header header" "string ns" "int32 id" "int32 type" "int32 action"
            "geometry_msgs/Pose pose" "geometry_msgs/Vector3 scale" "std_msgs/ColorRGBA color"
            "builtin_interfaces/Duration lifetime" "bool frame_locked" "geometry_msgs/Point[] points"
            "std_msgs/ColorRGBA[] colors" "string texture_resource" "sensor_msgs/CompressedImage texture"
            "visualization_msgs/UVCoordinate[] uv_coordinates" "string text" "string mesh_resource"
            "visualization_msgs/MeshFile mesh_file" "bool mesh_use_embedded_materials")
    };
    (UVCoordinate) => { contained!("visualization_msgs/UVCoordinate": "float32 u" "float32 v") };
    (MeshFile) => { contained!("visualization_msgs/MeshFile": "string filename" "uint8[] data") };
    (DiagnosticStatus) => {
        contained!("diagnostic_msgs/DiagnosticStatus":
            "byte level" "string name" "string message" "string hardware_id" "diagnostic_msgs/KeyValue[] values")
    };
    (KeyValue) => { contained!("diagnostic_msgs/KeyValue": "string key" "string value") };
    ($name:literal: $($field:literal)+) => {
        concat!(
            "================================================================================\nMSG: ",
            $name,
            "\n",
            $($field, "\n",)+
        )
    };
}

/// A scan.
pub const LASER_SCAN: Type = Type {
    name: "sensor_msgs/msg/LaserScan",
    text: text!(
        "std_msgs/Header header" "float32 angle_min" "float32 angle_max" "float32 angle_increment"
        "float32 time_increment" "float32 scan_time" "float32 range_min" "float32 range_max" "float32[] ranges"
        "float32[] intensities"; Header Time
    ),
};

/// Points.
pub const POINT_CLOUD: Type = Type {
    name: "sensor_msgs/msg/PointCloud2",
    text: text!(
        "std_msgs/Header header" "uint32 height" "uint32 width" "sensor_msgs/PointField[] fields"
        "bool is_bigendian" "uint32 point_step" "uint32 row_step" "uint8[] data" "bool is_dense"; Header Time PointField
    ),
};

/// Shapes to be drawn.
pub const MARKER_ARRAY: Type = Type {
    name: "visualization_msgs/msg/MarkerArray",
    text: text!(
        "visualization_msgs/Marker[] markers"; Marker Header Time Pose Point Quaternion Vector3 ColorRGBA Duration
        CompressedImage UVCoordinate MeshFile
    ),
};

/// Places with directions.
pub const POSE_ARRAY: Type = Type {
    name: "geometry_msgs/msg/PoseArray",
    text: text!("std_msgs/Header header" "geometry_msgs/Pose[] poses"; Header Time Pose Point Quaternion),
};

/// A word.
pub const STRING: Type = Type { name: "std_msgs/msg/String", text: text!("string data") };

/// How parts of the robot are.
pub const DIAGNOSTIC_ARRAY: Type = Type {
    name: "diagnostic_msgs/msg/DiagnosticArray",
    text: text!(
        "std_msgs/Header header" "diagnostic_msgs/DiagnosticStatus[] status"; Header Time DiagnosticStatus KeyValue
    ),
};

/// Where frames are in others.
pub const TF_MESSAGE: Type = Type {
    name: "tf2_msgs/msg/TFMessage",
    text: text!(
        "geometry_msgs/TransformStamped[] transforms"; TransformStamped Header Time Transform Vector3 Quaternion
    ),
};
