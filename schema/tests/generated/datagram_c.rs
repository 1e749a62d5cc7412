//! Structs and readers of payloads for `scanhub.h`, which reads datagrams in C.

use std::fmt::Write as _;

use scanhub_schema::Topic;
use scanhub_schema::datagram::Announce;

use super::c::{comment_above, number_name, with_comment};
use super::description::{Description, Field, Kind, Layout, snake};
use super::readers::{self, BoundsCheck, FieldSource, FloatRun, ShownField};
use super::rules;

/// Enums whose values have names in this header: name in Rust, name in C, and start of the names of the values.
const ENUM_NAMES: [(&str, &str, &str); 6] = [
    ("Family", "family", ""),
    ("Verdict", "verdict", ""),
    ("MotionMethod", "method", "MOTION_"),
    ("TrackState", "track_state", ""),
    ("EventKind", "event_kind", ""),
    ("PointClass", "point_class", "POINT_"),
];

/// Returns the numbers of topics, and the values of fields.
pub(crate) fn values(description: &Description) -> String {
    let mut text =
        comment_above("", "Topics, and the groups that they are sent to.") + "enum scanhub_topic {\n";
    text += &with_comment("    SCANHUB_ANNOUNCE = 0,", &format!("239.255.76.{}", Announce::GROUP));
    for topic in Topic::ALL {
        let comma = if topic == Topic::ALL[Topic::ALL.len() - 1] { "" } else { "," };
        let line = format!("    SCANHUB_{} = {}{comma}", topic.name().to_uppercase(), topic.number());
        text += &with_comment(&line, &format!("239.255.76.{}", topic.spec().group));
    }
    text += "};\n";
    let end = Topic::ALL.iter().map(|topic| topic.number() + 1).max().unwrap_or_default();
    text += &comment_above("", "All numbers of topics are below this one.");
    writeln!(text, "#define SCANHUB_TOPICS {end}").expect("a String");
    for (set, name, prefix) in ENUM_NAMES {
        let set = &description.sets[set];
        write!(text, "\n{}enum scanhub_{name} {{\n", comment_above("", &set.doc)).expect("a String");
        for (index, value) in set.values.iter().enumerate() {
            let comma = if index + 1 < set.values.len() { "," } else { "" };
            let line = format!("    SCANHUB_{prefix}{} = {}{comma}", value.name.to_uppercase(), value.number);
            text += &with_comment(&line, &value.doc);
        }
        text += "};\n";
    }
    text
}

/// Returns the structs and functions of all payloads.
pub(crate) fn payloads(description: &Description) -> String {
    let mut text = String::new();
    for topic in Topic::ALL {
        let Some(layout) = description.payload(topic) else { continue };
        let arrays = arrays(description, layout);
        let doc = layout
            .doc
            .replace("Head of a", "A")
            .replace(", before the arrays", "")
            .replace(", before the ranges", "");
        let doc = doc.replace(", before the points", "");
        write!(text, "\n{}struct scanhub_{} {{\n", comment_above("", &doc), topic.name()).expect("a String");
        text += &members(description, layout);
        for array in &arrays {
            let what = match array.element {
                Some(element) => format!("See scanhub_{}.", element_name(element)),
                None if array.size == 1 => String::new(),
                None => format!("Each has {} bytes.", array.size),
            };
            let none = if array.only_if.is_some() { " NULL if the scan does not have them." } else { "" };
            let comment = format!("{}{none} {what}", array.doc);
            text += &with_comment(&format!("    const uint8_t *{};", array.name), comment.trim_end());
        }
        text += "};\n";
        for array in &arrays {
            if let Some(element) = array.element {
                text += &accessor(description, topic, array, element);
            }
        }
        text += &reader(description, topic, layout, &arrays);
    }
    text
}

struct Array<'a> {
    /// Name in this header.
    name: String,
    doc: String,
    element: Option<&'a Layout>,
    /// Size of an element in bytes.
    size: usize,
    /// Number of elements, as an expression.
    count: String,
    only_if: Option<(&'static str, u64)>,
    /// Name of the array in the rules.
    rule: &'a str,
}

/// Returns the arrays that follow the head in a datagram.
fn arrays<'a>(description: &'a Description, layout: &'a Layout) -> Vec<Array<'a>> {
    let fields = layout.fields[rules::fixed_part(layout).fields..].iter().map(|field| {
        let Kind::Layout(rust) = &field.kind else { panic!("an array of structs") };
        let doc = field.doc("");
        let doc = doc.split("; 0 beyond").next().unwrap_or_default().trim_end_matches('.');
        Array {
            name: field.name.replace("_array", "s"),
            doc: format!("{doc}."),
            element: Some(description.layout(rust)),
            size: field.element,
            count: format!("out->{}", count_name(layout, rules::count_of(layout, field))),
            only_if: None,
            rule: &field.name,
        }
    });
    let tail = rules::packed_arrays_of(&layout.name).iter().map(|tail| {
        let element = description.layouts.iter().find(|layout| layout.rust == tail.kind);
        let count = tail.count.split_inclusive(' ').map(|word| {
            let name = word.trim_matches(['(', ')', ' ']);
            if layout.fields.iter().any(|field| field.name == name) {
                word.replace(name, &format!("out->{}", count_name(layout, name)))
            } else {
                word.to_owned()
            }
        });
        Array {
            name: if tail.name == "exact" { "angles".to_owned() } else { tail.name.to_owned() },
            doc: tail.doc.to_owned(),
            element,
            size: element.map_or_else(|| rules::number_size(tail.kind), |element| element.size),
            count: count.collect(),
            only_if: tail.only_if,
            rule: tail.name,
        }
    });
    fields.chain(tail).collect()
}

/// Returns the name of a field that contains a number of elements. The name must differ from the array's name.
fn count_name(layout: &Layout, name: &str) -> String {
    let is_count = rules::counts(layout).iter().any(|(count, _)| *count == name);
    if is_count && name != "count" {
        format!("{}_count", name.trim_end_matches('s'))
    } else {
        name.to_owned()
    }
}

fn element_name(element: &Layout) -> String {
    if element.name == "CloudPoint" { "point".to_owned() } else { snake(&element.name) }
}

/// Returns the fields of the head that the struct in C has, each with its offset and its layout. They include the
/// fields of structs in the head.
fn shown_layouts<'a>(
    description: &'a Description,
    layout: &'a Layout,
) -> Vec<(usize, &'a Layout, ShownField<'a>)> {
    let mut all = Vec::new();
    for shown in readers::shown_fields(layout, &description.sets) {
        match &shown.field.kind {
            Kind::Layout(rust) => {
                let inner = self::shown_layouts(description, description.layout(rust));
                all.extend(
                    inner.into_iter().map(|(at, layout, inner)| (at + shown.field.offset, layout, inner)),
                );
            }
            _ if shown.name == "contents" => {}
            _ => all.push((shown.field.offset, layout, shown)),
        }
    }
    all
}

/// Returns the name of a field in this header.
fn name(layout: &Layout, shown: &ShownField) -> String {
    match (layout.name.as_str(), shown.name.as_str()) {
        (_, "site_x_m") => "x_m".to_owned(),
        (_, "site_y_m") => "y_m".to_owned(),
        (_, "from_room") => "from".to_owned(),
        (_, "to_room") => "to".to_owned(),
        (_, name) => count_name(layout, name),
    }
}

fn members(description: &Description, layout: &Layout) -> String {
    let mut text = String::new();
    for (_, of, shown) in shown_layouts(description, layout) {
        let field = shown.field;
        let name = name(of, &shown);
        let line = match (&shown.source, &field.kind) {
            (FieldSource::Bit(..) | FieldSource::Bool | FieldSource::Computed(_), _) => {
                format!("    uint8_t {name};")
            }
            (FieldSource::Element(_), Kind::Number(kind)) => format!("    {} {name};", number_name(kind)),
            (_, Kind::Text) => format!("    char {name}[{}];", field.len.unwrap_or(1) + 1),
            (_, Kind::Number(kind)) => {
                let len = field.len.map_or(String::new(), |len| format!("[{len}]"));
                format!("    {} {name}{len};", number_name(kind))
            }
            (_, Kind::Layout(_)) => panic!("its fields are shown"),
        };
        let comment = match &shown.source {
            FieldSource::Bit(_, doc) => format!("1: {doc}"),
            FieldSource::Element(doc) => super::description::upper_first(doc) + ".",
            FieldSource::Computed(doc) => doc.replacen("Whether", "1:", 1),
            FieldSource::Plain | FieldSource::Bool => match field.set.as_deref() {
                Some(set) => match ENUM_NAMES.iter().find(|(of, ..)| *of == set) {
                    Some((_, name, _)) => field.doc(&format!("enum scanhub_{name}")),
                    None => description.doc(field),
                },
                None => field.doc(""),
            },
        };
        text += &with_comment(&line, &comment);
    }
    if layout.name == "Segment" {
        let doc =
            "1 if it is supported: it has several beams, or the foreground of the previous scan was near it.";
        text += &with_comment("    uint8_t support;", doc);
    }
    text
}

/// Returns the expression of a number.
fn number(kind: &str, base: &str, at: usize) -> String {
    let at = if at == 0 { base.to_owned() } else { format!("{base} + {at}") };
    match kind {
        "u8" => match at.strip_prefix(&format!("{base} + ")) {
            Some(at) => format!("{base}[{at}]"),
            None => format!("{base}[0]"),
        },
        kind => format!("scanhub_{kind}({at})"),
    }
}

fn field_number(layout: &Layout, name: &str, base: &str) -> String {
    let field = layout.fields.iter().find(|field| field.name == name).expect("a field");
    let Kind::Number(kind) = field.kind else { panic!("{name} is not a number") };
    number(kind, base, field.offset)
}

/// Returns the statements that read all fields to `out`.
fn statements(description: &Description, layout: &Layout, out: &str) -> String {
    let mut text = String::new();
    for (at, of, shown) in shown_layouts(description, layout) {
        let field = shown.field;
        let name = format!("{out}{}", name(of, &shown));
        let kind = if let Kind::Number(kind) = field.kind { kind } else { "u8" };
        let value = number(kind, "at", at);
        let line = match (&shown.source, &field.kind) {
            (FieldSource::Bit(1, _), _) => format!("{name} = {value} & 1;"),
            (FieldSource::Bit(bit, _), _) => format!("{name} = {value} >> {} & 1;", bit.trailing_zeros()),
            (FieldSource::Bool, _) => format!("{name} = {value} == 1;"),
            (FieldSource::Element(_), _) => {
                format!("{name} = {};", number(kind, "at", at + field.element * shown.index))
            }
            // Flag 2 is `open`.
            (FieldSource::Computed(_), _) => {
                let method = field_number(layout, "method", "at");
                format!(
                    "{name} = {method} <= SCANHUB_MOTION_BOTH && {method} != SCANHUB_MOTION_REFUSED \
                     && !({value} & 2);"
                )
            }
            (_, Kind::Text) => {
                let len = field.len.unwrap_or(1);
                let len = match readers::text_only_if(layout, field) {
                    Some((of, value)) => format!("{} == {value} ? {len} : 0", field_number(layout, of, "at")),
                    None => len.to_string(),
                };
                format!("scanhub_text({name}, at + {at}, {len});")
            }
            _ => match field.len {
                Some(len) => format!(
                    "for (n = 0; n < {len}; n++)\n        {name}[n] = {};",
                    number(kind, &format!("at + {at} + {} * (size_t)n", field.element), 0)
                ),
                None => format!("{name} = {value};"),
            },
        };
        writeln!(text, "    {line}").expect("a String");
    }
    text
}

fn has_loop(description: &Description, layout: &Layout) -> bool {
    shown_layouts(description, layout).iter().any(|(_, _, shown)| {
        matches!(shown.source, FieldSource::Plain)
            && shown.field.len.is_some()
            && shown.field.kind != Kind::Text
    })
}

/// Returns the struct of an array's elements, and the function that reads one.
fn accessor(description: &Description, topic: Topic, array: &Array, element: &Layout) -> String {
    let (name, payload) = (element_name(element), topic.name());
    let mut text = format!("{}struct scanhub_{name} {{\n", comment_above("", &element.doc));
    text += &members(description, element);
    let count = array.count.trim_start_matches("out->");
    write!(
        text,
        "}};\n/* Returns element i of `{0}`, i below `{count}`. */\n\
         static inline struct scanhub_{name} scanhub_{name}(const struct scanhub_{payload} *{payload}, unsigned i)\n\
         {{\n    const uint8_t *at = {payload}->{0} + {1} * (size_t)i;\n    struct scanhub_{name} out;\n",
        array.name, array.size
    )
    .expect("a String");
    if has_loop(description, element) {
        text += "    unsigned n;\n";
    }
    text += &statements(description, element, "out.");
    if element.name == "Segment" {
        text += "    out.support = (uint8_t)(foreground->supported >> i & 1);\n";
    }
    text + "    return out;\n}\n"
}

/// Returns conditions that are true if a number is not finite. Neighboring numbers are checked together.
fn non_finite_conditions(layout: &Layout, base: &str, fields: usize) -> Vec<String> {
    let infinite =
        readers::may_be_nan(layout, fields).map(|field| format!("isinf({})", number_of(field, base)));
    let runs = readers::finite_runs(layout, fields).into_iter().map(
        |FloatRun { offset: at, size, count, .. }| match at {
            0 => format!("!scanhub_are_finite({base}, {size}, {count})"),
            at => format!("!scanhub_are_finite({base} + {at}, {size}, {count})"),
        },
    );
    infinite.chain(runs).collect()
}

fn number_of(field: &Field, base: &str) -> String {
    let Kind::Number(kind) = field.kind else { panic!("{} is not a number", field.name) };
    number(kind, base, field.offset)
}

/// Returns the function that reads a payload. For a foreground, another function calls the returned function and also
/// checks the bits.
fn reader(description: &Description, topic: Topic, layout: &Layout, arrays: &[Array]) -> String {
    let name = topic.name();
    let head = rules::fixed_part(layout);
    let first = rules::first_revision(&layout.name);
    let function = if layout.name == "Foreground" { "foreground_arrays" } else { name };
    let mut text = format!(
        "static inline enum scanhub_result scanhub_read_{function}(const struct scanhub_datagram *datagram,\n    \
         struct scanhub_{name} *out)\n\
         {{\n    const uint8_t *at = datagram->payload;\n    \
         enum scanhub_result result = scanhub_expect(datagram, SCANHUB_{}, {});\n",
        name.to_uppercase(),
        first.unwrap_or(head.size)
    );
    if first.is_some() {
        writeln!(text, "    uint8_t whole[{}] = {{0}};", layout.size).expect("a String");
    }
    let mut loops = String::new();
    for array in arrays {
        let Some(element) = array.element else { continue };
        let mut conditions = non_finite_conditions(element, "at", element.fields.len());
        for check in readers::checks(&layout.name) {
            match check {
                BoundsCheck::Below { array: of, field, count } if *of == array.rule => {
                    conditions.push(format!("{} >= out->{count}", field_number(element, field, "at")));
                }
                BoundsCheck::Bits { array: of, field, count } if *of == array.rule => {
                    let count = count_name(layout, count);
                    conditions
                        .push(format!("(uint64_t){} >> out->{count}", field_number(element, field, "at")));
                }
                _ => {}
            }
        }
        if !conditions.is_empty() {
            write!(
                loops,
                "    for (i = 0; i < {}; i++) {{\n        at = out->{} + {} * (size_t)i;\n        \
                 if ({})\n            return SCANHUB_BAD_PAYLOAD;\n    }}\n",
                array.count,
                array.name,
                array.size,
                conditions.join("\n            || ")
            )
            .expect("a String");
        }
    }
    if !loops.is_empty() {
        text += "    unsigned i;\n";
    }
    if has_loop(description, layout) {
        text += "    unsigned n;\n";
    }
    text += "    if (result != SCANHUB_OK)\n        return result;\n";
    if let Some(first) = first {
        let size = layout.size;
        write!(
            text,
            "    /* Revision 1 has only the first {first} bytes. */\n    memcpy(whole, at, datagram->payload_len < {size} ? {first} \
             : {size});\n    at = whole;\n"
        )
        .expect("a String");
    }
    text += &statements(description, layout, "out->");
    let mut conditions: Vec<String> = rules::counts(layout)
        .iter()
        .map(|(count, maximum)| format!("{} > {maximum}", field_number(layout, count, "at")))
        .collect();
    for check in readers::checks(&layout.name) {
        if let BoundsCheck::Within { field, from, to } = check {
            let value = field_number(layout, field, "at");
            if *from > 0 {
                conditions.push(format!("{value} < {from}"));
            }
            conditions.push(format!("{value} > {to}"));
        }
    }
    let only_if = |array: &Array| {
        array.only_if.map(|(field, bit)| format!("{} & {bit}", field_number(layout, field, "at")))
    };
    let mut lengths = vec![head.size.to_string()];
    for array in arrays {
        let length = format!("{} * (size_t)({})", array.size, array.count);
        lengths.push(match only_if(array) {
            Some(condition) => format!("({condition} ? {length} : 0)"),
            None => length,
        });
    }
    if !arrays.is_empty() {
        conditions.push(format!("datagram->payload_len < {}", lengths.join("\n            + ")));
    }
    conditions.extend(non_finite_conditions(layout, "at", head.fields));
    if !conditions.is_empty() {
        let conditions = conditions.join("\n        || ");
        writeln!(text, "    if ({conditions})\n        return SCANHUB_BAD_PAYLOAD;").expect("a String");
    }
    let mut before = format!("at + {}", head.size);
    for array in arrays {
        let length = format!("{} * (size_t)({})", array.size, array.count);
        match only_if(array) {
            Some(condition) => {
                writeln!(text, "    out->{} = {condition} ? {before} : NULL;", array.name).expect("a String");
                before = format!("{before} + ({condition} ? {length} : 0)");
            }
            None => {
                writeln!(text, "    out->{} = {before};", array.name).expect("a String");
                before = format!("out->{} + {length}", array.name);
            }
        }
    }
    text + &loops + "    return SCANHUB_OK;\n}\n"
}
