//! Types of ROS messages: their names, their definitions in the language `ros2msg`, and the hashes by which ROS 2
//! distinguishes types on the wire.

use std::fmt::Write;

use sha2::{Digest, Sha256};

/// Type of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Type {
    /// Name, such as `sensor_msgs/msg/LaserScan`.
    pub name: &'static str,
    /// Definition in the language `ros2msg`, as rosbag2 stores it: the fields, then the contained types, each after a
    /// separator.
    pub text: &'static str,
}

impl Type {
    /// Encoding of messages: little-endian CDR (OMG XCDR1).
    pub const ENCODING: &str = "cdr";
    /// Language of [`Type::text`].
    pub const LANGUAGE: &str = "ros2msg";
    /// Separator between two types in [`Type::text`].
    const SEPARATOR: &str =
        "================================================================================\nMSG: ";

    /// Returns the type's hash: SHA-256 of its description in JSON (REP 2016, `rosidl`), such as `RIHS01_64c1..`, with
    /// 64 hex digits after the version.
    pub fn hash(&self) -> String {
        Sha256::digest(description(&MessageDef::of(self))).iter().fold(
            HASH_VERSION.to_owned(),
            |mut hash, byte| {
                let _ = write!(hash, "{byte:02x}");
                hash
            },
        )
    }
}

/// Expands to the definition of a type: the fields of the type, then each contained type once.
macro_rules! text {
    ($($field:literal)+ $(; $($of:ident)+)?) => {
        concat!($($field, "\n",)+ $($(contained!($of),)+)?)
    };
}

/// Expands to the separator and a contained type.
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

/// Type of a message with a scan.
pub const LASER_SCAN: Type = Type {
    name: "sensor_msgs/msg/LaserScan",
    text: text!(
        "std_msgs/Header header" "float32 angle_min" "float32 angle_max" "float32 angle_increment"
        "float32 time_increment" "float32 scan_time" "float32 range_min" "float32 range_max" "float32[] ranges"
        "float32[] intensities"; Header Time
    ),
};

/// Type of a message with points.
pub const POINT_CLOUD: Type = Type {
    name: "sensor_msgs/msg/PointCloud2",
    text: text!(
        "std_msgs/Header header" "uint32 height" "uint32 width" "sensor_msgs/PointField[] fields"
        "bool is_bigendian" "uint32 point_step" "uint32 row_step" "uint8[] data" "bool is_dense"; Header Time PointField
    ),
};

/// Type of a message with shapes that a viewer draws.
pub const MARKER_ARRAY: Type = Type {
    name: "visualization_msgs/msg/MarkerArray",
    text: text!(
        "visualization_msgs/Marker[] markers"; Marker Header Time Pose Point Quaternion Vector3 ColorRGBA Duration
        CompressedImage UVCoordinate MeshFile
    ),
};

/// Type of a message with poses.
pub const POSE_ARRAY: Type = Type {
    name: "geometry_msgs/msg/PoseArray",
    text: text!("std_msgs/Header header" "geometry_msgs/Pose[] poses"; Header Time Pose Point Quaternion),
};

/// Type of a message with a text.
pub const STRING: Type = Type { name: "std_msgs/msg/String", text: text!("string data") };

/// Type of a message with diagnostics.
pub const DIAGNOSTIC_ARRAY: Type = Type {
    name: "diagnostic_msgs/msg/DiagnosticArray",
    text: text!(
        "std_msgs/Header header" "diagnostic_msgs/DiagnosticStatus[] status"; Header Time DiagnosticStatus KeyValue
    ),
};

/// Type of a message with transforms between frames.
pub const TF_MESSAGE: Type = Type {
    name: "tf2_msgs/msg/TFMessage",
    text: text!(
        "geometry_msgs/TransformStamped[] transforms"; TransformStamped Header Time Transform Vector3 Quaternion
    ),
};

/// A parsed definition: a type and the types that it contains.
#[derive(Clone, Debug)]
pub(crate) struct MessageDef<'a> {
    /// Name and fields of each type. The type itself is the first. The names of contained types have no `msg`, as in
    /// `std_msgs/Header`.
    types: Vec<(&'a str, Vec<Field<'a>>)>,
}

/// A field of a type.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Field<'a> {
    pub(crate) name: &'a str,
    /// Name of a primitive type or of a contained type.
    pub(crate) type_name: &'a str,
    /// Whether the field is a sequence of any length.
    pub(crate) is_sequence: bool,
}

impl<'a> MessageDef<'a> {
    /// Parses the definition of `message_type`. The names of contained types must include the package.
    pub(crate) fn of(message_type: &'a Type) -> MessageDef<'a> {
        let types = message_type.text.split(Type::SEPARATOR).enumerate().map(|(index, text)| {
            let (name, fields) = if index == 0 {
                (message_type.name, text)
            } else {
                text.split_once('\n').unwrap_or((text, ""))
            };
            (name, fields.lines().filter_map(field).collect())
        });
        MessageDef { types: types.collect() }
    }

    /// Returns the fields of the type `name`; `None` for a primitive type.
    pub(crate) fn fields(&self, name: &str) -> Option<&[Field<'a>]> {
        self.types.iter().find(|(type_name, _)| *type_name == name).map(|(_, fields)| &fields[..])
    }
}

/// Parses a line with type, name and an optional default. The default is not part of messages.
fn field(line: &str) -> Option<Field<'_>> {
    let mut words = line.split_whitespace();
    let (type_name, name) = (words.next()?, words.next()?);
    let element_type = type_name.strip_suffix("[]");
    Some(Field { name, type_name: element_type.unwrap_or(type_name), is_sequence: element_type.is_some() })
}

/// Returns the text that is hashed: the description of the type, and then the descriptions of the types that it
/// contains, sorted by name. The hash covers the spaces, too.
fn description(layout: &MessageDef<'_>) -> String {
    let mut types: Vec<String> =
        layout.types.iter().map(|(name, fields)| type_description(name, fields)).collect();
    let main_type = types.remove(0);
    types.sort_unstable();
    format!(r#"{{"type_description": {main_type}, "referenced_type_descriptions": [{}]}}"#, types.join(", "))
}

fn type_description(name: &str, fields: &[Field<'_>]) -> String {
    let fields: Vec<String> = fields.iter().map(field_description).collect();
    format!(r#"{{"type_name": "{}", "fields": [{}]}}"#, full_name(name), fields.join(", "))
}

fn field_description(field: &Field<'_>) -> String {
    let (number, nested) = match primitive_type_id(field.type_name) {
        Some(number) => (number, String::new()),
        None => (NESTED_TYPE_ID, full_name(field.type_name)),
    };
    let number = if field.is_sequence { number + SEQUENCE_OFFSET } else { number };
    format!(
        r#"{{"name": "{}", "type": {{"type_id": {number}, "capacity": 0, "string_capacity": 0, "nested_type_name": "{nested}"}}}}"#,
        field.name
    )
}

/// Returns the full name of a type: `std_msgs/msg/Header` for `std_msgs/Header`.
fn full_name(name: &str) -> String {
    match name.split_once('/') {
        Some((package, rest)) if !rest.starts_with("msg/") => format!("{package}/msg/{rest}"),
        _ => name.to_owned(),
    }
}

/// Returns the number of a primitive type (`type_description_interfaces/msg/FieldType`).
fn primitive_type_id(type_name: &str) -> Option<u8> {
    let types = [
        ("uint8", 3),
        ("int32", 6),
        ("uint32", 7),
        ("float32", 10),
        ("float64", 11),
        ("bool", 15),
        ("byte", 16),
        ("string", 17),
    ];
    types.into_iter().find(|(of, _)| *of == type_name).map(|(_, number)| number)
}

/// Version of the hash.
const HASH_VERSION: &str = "RIHS01_";
/// Number of a type that has its own description.
const NESTED_TYPE_ID: u8 = 1;
/// Offset that is added to the number of a type for a sequence of any length.
const SEQUENCE_OFFSET: u8 = 144;

#[cfg(test)]
mod tests {
    use super::*;

    /// Hashes that PyPI's `rosbags` 0.11.9 computes for Jazzy. `zenoh-ros2-sdk` 0.1.8 computes the same hashes from the
    /// same definitions. Other published code has the same hashes, taken from ROS itself.
    const GOLDEN: [(Type, &str); 7] = [
        (LASER_SCAN, "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"),
        (POINT_CLOUD, "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"),
        (MARKER_ARRAY, "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf"),
        (POSE_ARRAY, "af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0"),
        (STRING, "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        (DIAGNOSTIC_ARRAY, "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"),
        (TF_MESSAGE, "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
    ];

    #[test]
    fn type_hashes_match_independent_implementations() {
        for (of, golden) in GOLDEN {
            assert_eq!(of.hash(), format!("RIHS01_{golden}"), "{}", of.name);
        }
    }

    #[test]
    fn every_contained_type_is_listed_once() {
        for (of, _) in GOLDEN {
            let layout = MessageDef::of(&of);
            let fields = layout.types.iter().flat_map(|(_, fields)| fields);
            let used: std::collections::BTreeSet<_> =
                fields.map(|field| field.type_name).filter(|of| primitive_type_id(of).is_none()).collect();
            let there: Vec<_> = layout.types.iter().skip(1).map(|(name, _)| *name).collect();
            assert_eq!(there.len(), used.len(), "{}", of.name);
            assert!(there.iter().all(|name| used.contains(name)), "{}: {there:?}", of.name);
        }
    }
}
