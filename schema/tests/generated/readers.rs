//! Fields as the readers of datagrams show them, and the conditions that a valid payload meets.

use std::collections::BTreeMap;

use super::description::{Description, Field, Kind, Layout, Set, snake};
use super::rules::fixed_part;

/// A field as the readers of datagrams show it.
pub(crate) struct ShownField<'a> {
    /// Name in Python and Lua. C may use another name.
    pub(crate) name: String,
    pub(crate) field: &'a Field,
    /// Index of the element, if only one element of the field is shown; otherwise 0.
    pub(crate) index: usize,
    pub(crate) source: FieldSource,
}

pub(crate) enum FieldSource {
    /// The field without a change: a number, a text, an array of numbers, or a struct.
    Plain,
    /// A boolean: 1 means true.
    Bool,
    /// A bit of flags, with the comment of its constant.
    Bit(u64, String),
    /// One element of an array.
    Element(&'static str),
    /// A value that each reader computes, with its comment.
    Computed(&'static str),
}

/// Fields that the readers show as booleans: 1 means true.
const BOOL_FIELDS: [(&str, &str); 3] =
    [("Pose", "upside_down"), ("TrackSensor", "upside_down"), ("Zone", "violated")];

/// Flags that the readers do not show.
const HIDDEN_FIELDS: [(&str, &str); 2] = [("Marks", "no_level"), ("Motion", "open")];

const RENAMED_FIELDS: [(&str, &str, &str); 6] = [
    ("TrackSensor", "x_m", "site_x_m"),
    ("TrackSensor", "y_m", "site_y_m"),
    ("Event", "from", "from_room"),
    ("Event", "to", "to_room"),
    ("Obstacle", "low", "low_m"),
    ("Obstacle", "high", "high_m"),
];

/// Arrays of coordinates that are shown as three fields.
const POSITION_FIELDS: [(&str, &str); 2] = [("CloudPoint", "at"), ("Obstacle", "middle")];
const COORDINATE_NAMES: [(&str, &str); 3] = [
    ("x_m", "meters ahead of the robot's center"),
    ("y_m", "meters to the left of the center"),
    ("z_m", "meters above the floor"),
];

/// Values that readers calculate from other values instead of flags: layout, name and comment.
pub(crate) const COMPUTED_FIELDS: [(&str, &str, &str); 1] =
    [("Motion", "valid", "Whether the summed pose is known, and none of its steps was degenerate.")];

/// Returns the fields before the first array, as the readers show them.
pub(crate) fn shown_fields<'a>(layout: &'a Layout, sets: &BTreeMap<String, Set>) -> Vec<ShownField<'a>> {
    let rust = layout.rust.as_str();
    let mut shown = Vec::new();
    for field in
        layout.fields[..fixed_part(layout).fields].iter().filter(|field| !field.name.starts_with("reserved"))
    {
        let name = field.name.strip_suffix("_text").unwrap_or(&field.name);
        let plain = |source| {
            let renamed = RENAMED_FIELDS.iter().find(|(of, from, _)| *of == rust && *from == name);
            ShownField { name: renamed.map_or(name, |(_, _, to)| to).to_owned(), field, index: 0, source }
        };
        if POSITION_FIELDS.contains(&(rust, name)) {
            for (index, (name, doc)) in COORDINATE_NAMES.into_iter().enumerate() {
                shown.push(ShownField {
                    name: name.to_owned(),
                    field,
                    index,
                    source: FieldSource::Element(doc),
                });
            }
        } else if name == "flags" {
            for (_, name, doc) in COMPUTED_FIELDS.iter().filter(|(of, ..)| *of == rust) {
                shown.push(ShownField {
                    name: (*name).to_owned(),
                    field,
                    index: 0,
                    source: FieldSource::Computed(doc),
                });
            }
            let flags = field.set.as_ref().map_or(&[][..], |set| &sets[set].values);
            for value in flags.iter().filter(|value| !HIDDEN_FIELDS.contains(&(rust, &value.name))) {
                let source = FieldSource::Bit(value.number, value.doc.clone());
                shown.push(ShownField { name: value.name.clone(), field, index: 0, source });
            }
        } else if BOOL_FIELDS.contains(&(rust, name)) {
            shown.push(plain(FieldSource::Bool));
        } else {
            shown.push(plain(FieldSource::Plain));
        }
    }
    shown
}

/// A condition that a valid payload meets, in addition to the conditions for its length, its counts and its floats.
pub(crate) enum BoundsCheck {
    /// Each element of an array has a field below a count of the head.
    Below { array: &'static str, field: &'static str, count: &'static str },
    /// Each element of an array has no bit at or above a count of the head.
    Bits { array: &'static str, field: &'static str, count: &'static str },
    /// A field has a value in this range.
    Within { field: &'static str, from: u64, to: u64 },
}

/// Returns the conditions of a payload.
pub(crate) fn checks(payload: &str) -> &'static [BoundsCheck] {
    match payload {
        "Scan" => &[BoundsCheck::Within { field: "contents", from: 0, to: 7 }],
        "Lines" => &[
            BoundsCheck::Below { array: "corner_array", field: "first_line", count: "count" },
            BoundsCheck::Below { array: "corner_array", field: "second_line", count: "count" },
        ],
        "Early" => &[BoundsCheck::Within { field: "verdict", from: 1, to: 2 }],
        "Tracks" => &[BoundsCheck::Bits { array: "track_array", field: "sensors", count: "sensors" }],
        "Event" => &[BoundsCheck::Within { field: "kind", from: 0, to: 2 }],
        _ => &[],
    }
}

/// Rule that states whether the numbers of a field may be infinite or NaN.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum FiniteRule {
    Required,
    /// NaN means unknown.
    MayBeNan,
    NotChecked,
}

/// Returns the condition for the numbers of a field.
pub(crate) fn finite(layout: &Layout, field: &Field) -> FiniteRule {
    match (layout.rust.as_str(), &field.kind) {
        (_, Kind::Number(kind)) if !kind.starts_with('f') => FiniteRule::NotChecked,
        ("Pose", _) => FiniteRule::NotChecked,
        ("Tilt", _) if field.name == "rate_rad_s" => FiniteRule::MayBeNan,
        (_, Kind::Number(_)) => FiniteRule::Required,
        _ => FiniteRule::NotChecked,
    }
}

/// Neighboring numbers of one size that must be finite.
pub(crate) struct FloatRun {
    /// Index of the first field.
    pub(crate) field: usize,
    /// Offset in bytes.
    pub(crate) offset: usize,
    /// Size of a number in bytes.
    pub(crate) size: usize,
    /// Count of the numbers.
    pub(crate) count: usize,
}

/// Returns the numbers that must be finite among the first `fields` fields.
pub(crate) fn finite_runs(layout: &Layout, fields: usize) -> Vec<FloatRun> {
    let mut runs: Vec<FloatRun> = Vec::new();
    for (index, field) in layout.fields[..fields].iter().enumerate() {
        if finite(layout, field) != FiniteRule::Required {
            continue;
        }
        let count = field.len.unwrap_or(1);
        match runs
            .last_mut()
            .filter(|run| run.size == field.element && run.offset + run.size * run.count == field.offset)
        {
            Some(run) => run.count += count,
            None => runs.push(FloatRun { field: index, offset: field.offset, size: field.element, count }),
        }
    }
    runs
}

/// Returns the fields among the first `fields` fields that may be NaN, but not infinite.
pub(crate) fn may_be_nan(layout: &Layout, fields: usize) -> impl Iterator<Item = &Field> {
    layout.fields[..fields].iter().filter(|field| finite(layout, field) == FiniteRule::MayBeNan)
}

/// Returns the enum whose values a field has; `None` if the field has bits, or can have any number.
pub(crate) fn enum_of(field: &Field) -> Option<&str> {
    let set = field.set.as_deref();
    set.filter(|_| !["flags", "reasons", "contents"].contains(&field.name.as_str()))
}

/// Returns all layouts of payloads.
pub(crate) fn layouts(description: &Description) -> impl Iterator<Item = &Layout> {
    description.layouts.iter().filter(|layout| layout.rust != "Header")
}

/// Returns the enums of all fields, in the order of the fields.
pub(crate) fn enums(description: &Description) -> Vec<&str> {
    let mut enums = Vec::new();
    for set in layouts(description).flat_map(|layout| &layout.fields).filter_map(enum_of) {
        if !enums.contains(&set) {
            enums.push(set);
        }
    }
    enums
}

/// Returns the name of the list with the names of an enum's values.
pub(crate) fn names_of(set: &str) -> String {
    match set {
        "MotionMethod" => "METHODS".to_owned(),
        "EventKind" => "EVENTS".to_owned(),
        "Family" => "FAMILIES".to_owned(),
        "PointClass" => "POINT_CLASSES".to_owned(),
        name => format!("{}S", snake(name).to_uppercase()),
    }
}

/// Payloads whose arrays depend on each other, so that Python and Lua read them with code that is not generated. Only
/// their heads are generated.
pub(crate) const VARIABLE_PAYLOADS: [&str; 2] = ["Scan", "Foreground"];

/// Returns a field and one of its values. If this field has this value, `field` is unknown.
pub(crate) fn unknown_if(layout: &Layout, field: &Field) -> Option<(&'static str, u64)> {
    let is_nearest = layout.name == "Zones" && field.name.starts_with("nearest_");
    is_nearest.then_some(("nearest_beam", 0xFFFF))
}

/// Returns a field and one of its values. If this field has another value, the text `field` is empty.
pub(crate) fn text_only_if(layout: &Layout, field: &Field) -> Option<(&'static str, u64)> {
    let is_door =
        layout.name == "Event" && ["door_text", "from_text", "to_text"].contains(&field.name.as_str());
    is_door.then_some(("kind", 2))
}

/// Returns the name that stands for unknown numbers of an enum; `None` if they have no name.
pub(crate) fn other_value(set: &str) -> Option<&'static str> {
    match set {
        "Verdict" | "PointClass" => Some("unknown"),
        "MotionMethod" => Some("refused"),
        "TrackState" => Some("tentative"),
        _ => None,
    }
}
