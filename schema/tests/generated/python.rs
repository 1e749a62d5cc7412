//! Constants, dataclasses and readers of payloads for `scanhub_lan.py`.

use std::fmt::Write as _;

use scanhub_schema::Topic;

use super::description::{Description, Field, Kind, Layout, upper_first};
use super::readers::{self, BoundsCheck, FieldSource, ShownField, VARIABLE_PAYLOADS, layouts, names_of};
use super::{rules, topics_by_number, wrap};

const MAX_LINE_WIDTH: usize = 120;

/// Order of fields in the dataclasses whose order differs from the order in memory. Fields that are not listed follow.
const PARAMETER_ORDER: [(&str, &[&str]); 6] = [
    (
        "Scan",
        &[
            "family",
            "unit_um",
            "count",
            "first_angle",
            "step",
            "spacing",
            "beam_time_ns",
            "first_beam_ns",
            "turns",
            "turn_ns",
            "valid_to",
            "no_return",
            "beyond",
            "collisions",
            "incomplete",
            "intensity_bits",
        ],
    ),
    ("Foreground", &["generation", "count", "unit_um", "dropped"]),
    ("Background", &["generation", "known_beams", "count", "unit_um", "first_angle", "step", "frozen"]),
    ("TrackSensor", &["name"]),
    ("Event", &["kind"]),
    ("Obstacles", &["sweep", "generation", "complete", "unreliable", "dropped"]),
];

/// Returns the name of a layout's class.
fn class(layout: &Layout) -> String {
    match layout.name.as_str() {
        "TrackSensor" => "Site".to_owned(),
        "CloudPoint" => "Point".to_owned(),
        name if VARIABLE_PAYLOADS.contains(&name) => format!("_{name}Head"),
        name => name.to_owned(),
    }
}

/// Returns the name of an array's field in the dataclass: `lines` for `line_array`.
fn array_name(field: &Field) -> String {
    match field.name.as_str() {
        "sensor_array" => "sites".to_owned(),
        name => name.replace("_array", "s"),
    }
}

/// Returns the names and groups of topics, and the names of values.
pub(crate) fn constants(description: &Description) -> String {
    let topics = ["announce"].into_iter().chain(topics_by_number().map(Topic::name));
    let mut text = tuple("TOPICS", topics.map(str::to_owned));
    let groups = topics_by_number().map(|topic| topic.spec().group);
    let groups = [scanhub_schema::datagram::Announce::GROUP].into_iter().chain(groups);
    text +=
        &format!("_GROUPS = ({})\n", groups.map(|group| group.to_string()).collect::<Vec<_>>().join(", "));
    for set in readers::enums(description) {
        let names = description.sets[set].values.iter().map(|value| value.name.clone());
        text += &tuple(&names_of(set), names);
    }
    text
}

fn tuple(name: &str, values: impl Iterator<Item = String>) -> String {
    let values: Vec<_> = values.map(|value| format!("\"{value}\"")).collect();
    let line = format!("{name} = ({})\n", values.join(", "));
    if line.len() <= MAX_LINE_WIDTH {
        return line;
    }
    format!("{name} = (\n{})\n", wrap("    ", "    ", &format!("{},", values.join(", ")), MAX_LINE_WIDTH))
}

/// Returns the classes of all payloads and array elements.
pub(crate) fn classes(description: &Description) -> String {
    let mut text = String::new();
    for layout in layouts(description) {
        let doc = format!("{}\"\"\"", layout.doc);
        write!(text, "\n@dataclass(frozen=True)\nclass {}:\n", class(layout)).expect("a String");
        text += &wrap("    \"\"\"", "    ", &doc, MAX_LINE_WIDTH);
        text.push('\n');
        for (name, kind, doc) in members(description, layout) {
            writeln!(text, "    {name}: {kind}").expect("a String");
            text += &wrap("    \"\"\"", "    ", &format!("{doc}\"\"\""), MAX_LINE_WIDTH);
        }
        text.push('\n');
    }
    text.trim_start_matches('\n').to_owned() + "\n"
}

/// Returns name, type and comment of each member of a class.
fn members(description: &Description, layout: &Layout) -> Vec<(String, String, String)> {
    let mut members = Vec::new();
    for shown in ordered(description, layout) {
        members.push((shown.name.clone(), kind(layout, &shown), comment(description, &shown)));
    }
    if layout.name == "Segment" {
        let doc = "Whether it has several beams, or the foreground of the previous scan was near it.";
        members.push(("support".to_owned(), "bool".to_owned(), doc.to_owned()));
    }
    let mut arrays: Vec<_> = layout.fields[rules::fixed_part(layout).fields..].iter().collect();
    arrays.reverse();
    if layout.name != "Tracks" {
        arrays.reverse();
    }
    for field in arrays {
        let Kind::Layout(rust) = &field.kind else { continue };
        let doc = field.doc("");
        let doc = doc.split("; 0 beyond").next().unwrap_or_default().trim_end_matches('.');
        let kind = format!("\"tuple[{}, ...]\"", class(description.layout(rust)));
        members.push((array_name(field), kind, format!("{doc}.")));
    }
    if !VARIABLE_PAYLOADS.contains(&layout.name.as_str()) {
        for tail in rules::packed_arrays_of(&layout.name) {
            let element = description.layouts.iter().find(|layout| layout.rust == tail.kind).map(class);
            let kind = format!("\"tuple[{}, ...]\"", element.as_deref().unwrap_or("int"));
            members.push((tail.name.to_owned(), kind, tail.doc.to_owned()));
        }
    }
    members
}

/// Returns the fields of the head that a class has, in the order of the class.
fn ordered<'a>(description: &Description, layout: &'a Layout) -> Vec<ShownField<'a>> {
    let mut shown = readers::shown_fields(layout, &description.sets);
    // The number of elements is the length of a tuple.
    let counts = rules::counts(layout);
    shown.retain(|shown| {
        let is_count = counts.iter().any(|(count, _)| *count == shown.field.name);
        let is_kept =
            shown.name == "count" && ["Scan", "Foreground", "Background"].contains(&layout.name.as_str());
        !is_count || is_kept
    });
    shown.retain(|shown| match layout.name.as_str() {
        "Foreground" => !["beams", "supported"].contains(&shown.name.as_str()),
        "Scan" => shown.name != "contents",
        _ => true,
    });
    if let Some((_, order)) = PARAMETER_ORDER.iter().find(|(name, _)| *name == layout.name) {
        shown.sort_by_key(|shown| order.iter().position(|name| *name == shown.name).unwrap_or(order.len()));
    }
    shown
}

fn is_float(field: &Field) -> bool {
    matches!(field.kind, Kind::Number(kind) if kind.starts_with('f'))
}

fn kind(layout: &Layout, shown: &ShownField) -> String {
    let field = shown.field;
    let number = if is_float(field) { "float" } else { "int" };
    match (&shown.source, &field.kind) {
        (FieldSource::Bit(..) | FieldSource::Bool | FieldSource::Computed(_), _) => "bool".to_owned(),
        (FieldSource::Element(_), _) => number.to_owned(),
        (_, Kind::Text) => "str".to_owned(),
        (_, Kind::Layout(rust)) => rust.clone(),
        _ => match readers::enum_of(field) {
            Some("Counter") => "\"dict[str, int]\"".to_owned(),
            Some("EventKind") => "str".to_owned(),
            Some(set) if readers::other_value(set).is_some() => "str".to_owned(),
            Some(_) => "Optional[str]".to_owned(),
            None if field.len.is_some() => format!("\"tuple[{number}, ...]\""),
            None if readers::unknown_if(layout, field).is_some() => format!("Optional[{number}]"),
            None => number.to_owned(),
        },
    }
}

fn comment(description: &Description, shown: &ShownField) -> String {
    let field = shown.field;
    match &shown.source {
        FieldSource::Bit(_, doc) => doc.clone(),
        FieldSource::Element(doc) => format!("{}.", upper_first(doc)),
        FieldSource::Computed(doc) => (*doc).to_owned(),
        FieldSource::Bool => description.doc(field).replacen("1 if", "True if", 1),
        FieldSource::Plain => match readers::enum_of(field) {
            Some("Counter") => "Counters by name: those of COUNTERS.".to_owned(),
            Some(set) => {
                let none =
                    if kind_is_optional(set) { " None if this version does not have the value." } else { "" };
                let doc = field.doc(&format!("one of {}", names_of(set)));
                // Leave out the sentence about other numbers, because the reader already handles them.
                let doc = doc.split(" Treat ").next().unwrap_or_default();
                format!("{doc}{none}")
            }
            None => description.doc(field),
        },
    }
}

fn kind_is_optional(set: &str) -> bool {
    set != "EventKind" && readers::other_value(set).is_none()
}

/// Returns the type of any payload.
pub(crate) fn union(description: &Description) -> String {
    let payloads = Topic::ALL.into_iter().filter_map(|topic| description.payload(topic));
    let names =
        payloads.map(|layout| class(layout).trim_start_matches('_').trim_end_matches("Head").to_owned());
    let names: Vec<_> = ["Announce", "Telegram"].map(str::to_owned).into_iter().chain(names).collect();
    format!(
        "Payload = Union[\n{}]\n",
        wrap("    ", "    ", &format!("{},", names.join(", ")), MAX_LINE_WIDTH)
    )
}

/// Returns the functions that read payloads and elements of arrays.
pub(crate) fn functions(description: &Description) -> String {
    let mut text = String::new();
    for layout in layouts(description) {
        text += &function(description, layout);
        text.push('\n');
    }
    text += "\n_UNPACK = {\n";
    for topic in Topic::ALL {
        if let Some(layout) = description.payload(topic) {
            let name = function_name(layout).trim_end_matches("_head").to_owned();
            writeln!(text, "    \"{}\": {name},", topic.name()).expect("a String");
        }
    }
    text + "}\n"
}

fn function_name(layout: &Layout) -> String {
    let name = super::description::snake(&layout.name);
    if VARIABLE_PAYLOADS.contains(&layout.name.as_str()) {
        format!("_{name}_head")
    } else {
        format!("_{name}")
    }
}

/// A head in the form of Python's `struct`, with the position of each field in the values.
struct StructFormat {
    format: String,
    positions: Vec<(String, usize, usize)>,
}

impl StructFormat {
    fn of_layout(description: &Description, layout: &Layout) -> StructFormat {
        let mut values = StructFormat { format: "<".to_owned(), positions: Vec::new() };
        let mut next = 0;
        for field in &layout.fields[..rules::fixed_part(layout).fields] {
            let len = field.len.unwrap_or(1);
            let (format, count) = match &field.kind {
                _ if field.name.starts_with("reserved") => (format!("{}x", field.size()), 0),
                Kind::Text => (format!("{len}s"), 1),
                Kind::Number(kind) => (
                    format!(
                        "{}{}",
                        field.len.map_or(String::new(), |len| len.to_string()),
                        format_code(kind)
                    ),
                    len,
                ),
                Kind::Layout(rust) => {
                    // A struct in a struct is read by its own function.
                    (format!("{}x", description.layout(rust).size), 0)
                }
            };
            values.format += &format;
            values.positions.push((field.name.clone(), next, count));
            next += count;
        }
        values
    }

    /// Returns the expression of a field's value.
    fn of_field(&self, name: &str) -> String {
        let (_, at, count) = self.positions.iter().find(|(field, ..)| field == name).expect("a field");
        if *count == 1 { format!("v[{at}]") } else { format!("v[{at}:{}]", at + count) }
    }
}

pub(crate) fn format_code(kind: &str) -> char {
    match kind {
        "u8" => 'B',
        "u16" => 'H',
        "u32" => 'I',
        "u64" => 'Q',
        "i8" => 'b',
        "i16" => 'h',
        "i32" => 'i',
        "i64" => 'q',
        "f32" => 'f',
        _ => 'd',
    }
}

fn function(description: &Description, layout: &Layout) -> String {
    let values = StructFormat::of_layout(description, layout);
    let is_head = VARIABLE_PAYLOADS.contains(&layout.name.as_str());
    let is_payload = Topic::ALL
        .into_iter()
        .any(|topic| description.payload(topic).is_some_and(|payload| payload.rust == layout.rust));
    let (name, class) = (function_name(layout), class(layout));
    let (arguments, result) = match () {
        () if is_head => ("payload: bytes", "\"tuple[dict, dict]\"".to_owned()),
        () if is_payload => ("payload: bytes", class.clone()),
        () if layout.name == "Segment" => ("payload: bytes, at: int, support: bool", class.clone()),
        () => ("payload: bytes, at: int", class.clone()),
    };
    let at = if is_payload { "" } else { ", at" };
    let mut text = format!("\ndef {name}({arguments}) -> {result}:\n");
    if let Some(first) = rules::first_revision(&layout.name) {
        writeln!(text, "    # Revision 1 has only the first {first} bytes.").expect("a String");
        writeln!(text, "    if {first} <= len(payload) < {}:", layout.size).expect("a String");
        writeln!(text, "        payload = payload[:{first}].ljust({}, b\"\\0\")", layout.size)
            .expect("a String");
    }
    writeln!(text, "    v = struct.unpack_from(\"{}\", payload{at})", values.format).expect("a String");
    let mut limit = |condition: String| writeln!(text, "    _limit({condition})").expect("a String");
    let counts = rules::counts(layout);
    for (count, maximum) in &counts {
        limit(format!("{} <= {maximum}", values.of_field(count)));
    }
    let fields = rules::fixed_part(layout).fields;
    for field in readers::may_be_nan(layout, fields) {
        limit(format!("not math.isinf({})", values.of_field(&field.name)));
    }
    // Neighboring runs are checked together, even if their numbers have different sizes.
    let mut finite: Vec<(usize, usize)> = Vec::new();
    for run in readers::finite_runs(layout, fields) {
        let (_, at, _) = values.positions[run.field];
        match finite.last_mut().filter(|(_, end)| *end == at) {
            Some((_, end)) => *end += run.count,
            None => finite.push((at, at + run.count)),
        }
    }
    for (at, end) in finite {
        limit(if end == at + 1 {
            format!("math.isfinite(v[{at}])")
        } else {
            format!("all(map(math.isfinite, v[{at}:{end}]))")
        });
    }
    for check in readers::checks(&layout.name) {
        if let BoundsCheck::Within { field, from, to } = check {
            limit(format!("{from} <= {} <= {to}", values.of_field(field)));
        }
    }
    let mut members: Vec<(String, String)> = ordered(description, layout)
        .iter()
        .map(|shown| (shown.name.clone(), value(description, layout, &values, shown)))
        .collect();
    if layout.name == "Segment" {
        members.push(("support".to_owned(), "support".to_owned()));
    }
    if is_head {
        let raw = layout.fields.iter().filter(|field| !field.name.starts_with("reserved"));
        let raw: Vec<_> = raw.map(|field| field.name.as_str()).collect();
        text += "    names = (\n";
        text += &wrap("        \"", "        \"", &format!("{}\"", raw.join(" ")), MAX_LINE_WIDTH)
            .replace("\n        \"", " \"\n        \"");
        text += "    ).split()\n";
    }
    let mut begin = rules::fixed_part(layout).size.to_string();
    for field in &layout.fields[rules::fixed_part(layout).fields..] {
        let Kind::Layout(rust) = &field.kind else { panic!("an array of structs") };
        let (name, read) = (array_name(field), function_name(description.layout(rust)));
        let count = values.of_field(rules::count_of(layout, field));
        let at = format!("{begin} + {} * i", field.element);
        writeln!(text, "    {name} = tuple({read}(payload, {at}) for i in range({count}))")
            .expect("a String");
        begin += &format!(" + {} * {count}", field.element);
        members.push((name.clone(), name));
    }
    if !is_head {
        for tail in rules::packed_arrays_of(&layout.name) {
            let (name, count) = (tail.name, values.of_field(tail.count));
            let element = description.layouts.iter().find(|layout| layout.rust == tail.kind);
            match element {
                Some(element) => {
                    let read = function_name(element);
                    let at = format!("{begin} + {} * i", element.size);
                    writeln!(text, "    {name} = tuple({read}(payload, {at}) for i in range({count}))")
                }
                None => {
                    let form = format!("f\"<{{{count}}}{}\"", format_code(tail.kind));
                    writeln!(text, "    {name} = struct.unpack_from({form}, payload, {begin})")
                }
            }
            .expect("a String");
            members.push((name.to_owned(), name.to_owned()));
        }
    }
    for check in readers::checks(&layout.name) {
        let (array, condition) = match check {
            BoundsCheck::Below { array, field, count } => {
                (array, format!("one.{field} < {}", values.of_field(count)))
            }
            BoundsCheck::Bits { array, field, count } => {
                (array, format!("not one.{field} >> {}", values.of_field(count)))
            }
            BoundsCheck::Within { .. } => continue,
        };
        let array = layout.fields.iter().find(|field| field.name == *array).expect("an array");
        writeln!(text, "    _limit(all({condition} for one in {}))", array_name(array)).expect("a String");
    }
    let call = if is_head { "dict" } else { class.as_str() };
    writeln!(text, "    {}{call}(", if is_head { "fields = " } else { "return " }).expect("a String");
    for (name, value) in members {
        writeln!(text, "        {name}={value},").expect("a String");
    }
    text += "    )\n";
    if is_head {
        text += "    return fields, dict(zip(names, v))\n";
    }
    text
}

/// Returns the expression of a member.
fn value(description: &Description, layout: &Layout, values: &StructFormat, shown: &ShownField) -> String {
    let field = shown.field;
    let raw = || values.of_field(&field.name);
    match (&shown.source, &field.kind) {
        (FieldSource::Bit(bit, _), _) => format!("bool({} & {bit})", raw()),
        (FieldSource::Bool, _) => format!("{} == 1", raw()),
        (FieldSource::Element(_), _) => {
            let (_, at, _) = values.positions.iter().find(|(name, ..)| *name == field.name).expect("a field");
            format!("v[{}]", at + shown.index)
        }
        // Method 1 is `refused`, and flag 2 is `open`.
        (FieldSource::Computed(_), _) => {
            format!(
                "_name(METHODS, {}, \"refused\") != \"refused\" and not {} & 2",
                values.of_field("method"),
                raw()
            )
        }
        (_, Kind::Text) => match readers::text_only_if(layout, field) {
            Some((of, value)) => format!("_text({}) if {} == {value} else \"\"", raw(), values.of_field(of)),
            None => format!("_text({})", raw()),
        },
        (_, Kind::Layout(rust)) => {
            format!("{}(payload, {})", function_name(description.layout(rust)), field.offset)
        }
        _ => match readers::enum_of(field) {
            Some("Counter") => format!("dict(zip(COUNTERS, {}))", raw()),
            Some(set) => {
                let other =
                    readers::other_value(set).map_or("None".to_owned(), |other| format!("\"{other}\""));
                format!("_name({}, {}, {other})", names_of(set), raw())
            }
            None => match readers::unknown_if(layout, field) {
                Some((of, value)) => format!("None if {} == {value} else {}", values.of_field(of), raw()),
                None => raw(),
            },
        },
    }
}
