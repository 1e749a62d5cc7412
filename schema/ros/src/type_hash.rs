//! The hash by which ROS 2 tells types apart on the wire: SHA-256 of a type's description in JSON (REP 2016, `rosidl`). Made
//! from the type's text. Refuses to know which release of ROS uses it.

use std::fmt::Write;

use sha2::{Digest, Sha256};

use crate::Type;
use crate::layout::{Field, Layout};

/// The version of the hash, which stands before it.
const PREFIX: &str = "RIHS01_";

impl Type {
    /// Returns its hash, such as `RIHS01_64c1..`: 64 hex digits behind the version.
    pub fn hash(&self) -> String {
        Sha256::digest(description(&Layout::of(self))).iter().fold(PREFIX.to_owned(), |mut hash, byte| {
            let _ = write!(hash, "{byte:02x}");
            hash
        })
    }
}

/// The description of the type and, by their names, of those that it contains: exactly these spaces.
fn description(layout: &Layout<'_>) -> String {
    let mut types: Vec<String> =
        layout.types.iter().map(|(name, fields)| type_description(name, fields)).collect();
    let itself = types.remove(0);
    types.sort_unstable();
    format!(r#"{{"type_description": {itself}, "referenced_type_descriptions": [{}]}}"#, types.join(", "))
}

fn type_description(name: &str, fields: &[Field<'_>]) -> String {
    let fields: Vec<String> = fields.iter().map(field_description).collect();
    format!(r#"{{"type_name": "{}", "fields": [{}]}}"#, full_name(name), fields.join(", "))
}

fn field_description(field: &Field<'_>) -> String {
    let (number, nested) = match number(field.of) {
        Some(number) => (number, String::new()),
        None => (NESTED, full_name(field.of)),
    };
    let number = if field.is_sequence { number + SEQUENCE } else { number };
    format!(
        r#"{{"name": "{}", "type": {{"type_id": {number}, "capacity": 0, "string_capacity": 0, "nested_type_name": "{nested}"}}}}"#,
        field.name
    )
}

/// `std_msgs/Header` is `std_msgs/msg/Header`.
fn full_name(name: &str) -> String {
    match name.split_once('/') {
        Some((package, rest)) if !rest.starts_with("msg/") => format!("{package}/msg/{rest}"),
        _ => name.to_owned(),
    }
}

/// The number of a word of the language (`type_description_interfaces/msg/FieldType`).
fn number(word: &str) -> Option<u8> {
    let words = [
        ("uint8", 3),
        ("int32", 6),
        ("uint32", 7),
        ("float32", 10),
        ("float64", 11),
        ("bool", 15),
        ("byte", 16),
        ("string", 17),
    ];
    words.into_iter().find(|(of, _)| *of == word).map(|(_, number)| number)
}

/// A type that is described itself.
const NESTED: u8 = 1;
/// Added for a sequence of any length.
const SEQUENCE: u8 = 144;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::*;

    /// As PyPI's `rosbags` 0.11.9 computes them for Jazzy, `zenoh-ros2-sdk` 0.1.8 from the same text, and as they stand in
    /// published code of others who took them from ROS itself.
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
    fn hashes_are_those_of_independent_implementations() {
        for (of, golden) in GOLDEN {
            assert_eq!(of.hash(), format!("RIHS01_{golden}"), "{}", of.name);
        }
    }

    #[test]
    fn every_contained_type_is_there_once() {
        for (of, _) in GOLDEN {
            let layout = Layout::of(&of);
            let fields = layout.types.iter().flat_map(|(_, fields)| fields);
            let used: std::collections::BTreeSet<_> =
                fields.map(|field| field.of).filter(|of| number(of).is_none()).collect();
            let there: Vec<_> = layout.types.iter().skip(1).map(|(name, _)| *name).collect();
            assert_eq!(there.len(), used.len(), "{}", of.name);
            assert!(there.iter().all(|name| used.contains(name)), "{}: {there:?}", of.name);
        }
    }
}
