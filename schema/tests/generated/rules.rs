//! Rules for payloads that the structs do not express, such as arrays whose length depends on counts.

use super::description::{Field, Layout};

/// An array after the head of a payload whose length depends on its counts.
pub(crate) struct ArrayRule {
    pub(crate) name: &'static str,
    /// A number, or the Rust name of a layout.
    pub(crate) kind: &'static str,
    /// Number of elements in shared memory, as an expression of the head's fields.
    pub(crate) count: &'static str,
    pub(crate) doc: &'static str,
    /// Field and bit. The array exists only if the field has this bit.
    pub(crate) only_if: Option<(&'static str, u64)>,
}

const fn array(name: &'static str, kind: &'static str, count: &'static str, doc: &'static str) -> ArrayRule {
    ArrayRule { name, kind, count, doc, only_if: None }
}

const fn optional(name: &'static str, kind: &'static str, bit: u64, doc: &'static str) -> ArrayRule {
    ArrayRule { only_if: Some(("contents", bit)), ..array(name, kind, "count", doc) }
}

const SCAN_ARRAYS: [ArrayRule; 4] = [
    optional("exact", "f32", 4, "Exact angles in radians; NaN if nothing was measured."),
    array("ranges", "u16", "count", "Ranges in device units, codes included."),
    optional("wide", "u16", 2, "Intensities of more than 8 bits."),
    optional("upper", "u8", 1, "Intensities of at most 8 bits, or field bits in some modes of an LMS."),
];
const FOREGROUND_ARRAYS: [ArrayRule; 3] = [
    array("segments", "Segment", "64", "The segments in the order of their beams; 0 beyond `segments`."),
    array(
        "bits",
        "u8",
        "2 * ((count + 15) / 16)",
        "The beams in the foreground: beam i is bit i % 8 of byte i / 8.",
    ),
    array(
        "ranges",
        "u16",
        "count",
        "Ranges of these beams in device units, in the same order; 0 beyond `beams`.",
    ),
];
const BACKGROUND_ARRAYS: [ArrayRule; 1] = [array(
    "ranges",
    "u16",
    "count",
    "Ranges in device units; 0 if the background is unknown, 65535 if it is beyond the maximum range.",
)];
const CLOUD_ARRAYS: [ArrayRule; 1] = [array("points", "CloudPoint", "count", "The points.")];

/// Returns the arrays after the head of a payload in shared memory.
pub(crate) fn arrays_of(payload: &str) -> &'static [ArrayRule] {
    match payload {
        "Scan" => &SCAN_ARRAYS,
        "Foreground" => &FOREGROUND_ARRAYS,
        "Background" => &BACKGROUND_ARRAYS,
        "Cloud" => &CLOUD_ARRAYS,
        _ => &[],
    }
}

const PACKED_FOREGROUND_ARRAYS: [ArrayRule; 3] = [
    array("bits", "u8", "(count + 7) / 8", "The beams in the foreground: beam i is bit i % 8 of byte i / 8."),
    array("ranges", "u16", "beams", "Ranges of these beams in device units, in the same order."),
    array("segments", "Segment", "segments", "The segments in the order of their beams."),
];

/// Returns the arrays after the head of a payload in a datagram.
pub(crate) fn packed_arrays_of(payload: &str) -> &'static [ArrayRule] {
    if payload == "Foreground" { &PACKED_FOREGROUND_ARRAYS } else { arrays_of(payload) }
}

/// Start of a payload before its arrays.
pub(crate) struct FixedPart {
    /// Size in bytes.
    pub(crate) size: usize,
    /// Number of fields.
    pub(crate) fields: usize,
}

/// Returns the start of a payload, which has the fields before the first array. In a datagram, this array has only its
/// used elements.
pub(crate) fn fixed_part(layout: &Layout) -> FixedPart {
    let fields = layout.fields.iter().position(|field| field.name.ends_with("_array"));
    let fields = fields.unwrap_or(layout.fields.len());
    FixedPart { size: layout.fields.get(fields).map_or(layout.size, |field| field.offset), fields }
}

/// Returns the field that has the number of used elements of an array: `corners` for `corner_array`, or else `count`.
pub(crate) fn count_of<'a>(layout: &'a Layout, array: &Field) -> &'a str {
    let name = array.name.replace("_array", "s");
    layout.fields.iter().map(|field| field.name.as_str()).find(|field| *field == name).unwrap_or("count")
}

/// Returns the fields that have numbers of elements in a datagram, each with its maximum.
pub(crate) fn counts(layout: &Layout) -> Vec<(&str, usize)> {
    let arrays = layout.fields.iter().filter(|field| field.name.ends_with("_array"));
    let mut counts: Vec<_> = arrays.map(|field| (count_of(layout, field), field.len.unwrap_or(1))).collect();
    if !packed_arrays_of(&layout.name).is_empty() {
        counts.push(("count", scanhub_schema::MAX_BEAMS));
    }
    if layout.name == "Foreground" {
        counts.push(("segments", scanhub_schema::MAX_SEGMENTS));
    }
    counts
}

/// Returns the size of a number in bytes.
pub(crate) fn number_size(kind: &str) -> usize {
    kind[1..].parse::<usize>().expect("a number's type ends with its bits") / 8
}

/// Returns the size in bytes of a payload's first revision if a later revision has more fields. Readers fill the
/// missing fields with 0.
pub(crate) fn first_revision(layout: &str) -> Option<usize> {
    (layout == "Motion").then_some(80)
}
