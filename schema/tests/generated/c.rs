//! Structs and constants of `attach.h`, for samples in shared memory.

use std::fmt::Write as _;

use scanhub_schema::Topic;

use super::description::{Description, Field, Kind, Layout, Set, snake};
use super::{rules, wrap};

const MAX_LINE_WIDTH: usize = 120;

/// Returns the numbers of the topics, the structs, and the constants for the values of their fields.
pub(crate) fn structs(description: &Description) -> String {
    let mut text = "/* Topics, and the struct that a payload is or starts with. */\n".to_owned();
    let longest = Topic::ALL.iter().map(|topic| topic.name().len()).max().unwrap_or_default();
    for topic in Topic::ALL {
        let name = topic.name().to_uppercase();
        let about = match description.payload(topic) {
            Some(layout) => format!("struct {}", type_name(&layout.name)),
            None => "length bytes: a telegram of an LMS from STX to CRC, or whole packets of other families"
                .to_owned(),
        };
        let number = format!("{:<2}", topic.number());
        let define = format!("#define SCANHUB_TOPIC_{name:<longest$} {number}");
        writeln!(text, "{define} /* {about} */").expect("a String");
    }
    let mut written = Vec::new();
    for layout in &description.layouts {
        for set in layout.fields.iter().filter_map(|field| field.set.as_ref()) {
            if !written.contains(set) && shared_prefix(set).is_none() {
                text += &constants(set, &description.sets[set], layout);
                written.push(set.clone());
            }
        }
        text += &declaration_of(layout);
    }
    text
}

/// Returns the name of a struct in C.
pub(crate) fn type_name(name: &str) -> String {
    format!("scanhub_{}_v2", snake(name))
}

/// Returns the text with which the names of a set's constants start.
fn prefix(set: &str) -> String {
    let name = match set {
        "ArrayFlags" => "scan".to_owned(),
        "Scan" => "scan_flag".to_owned(),
        "Flags" => "flag".to_owned(),
        "Reasons" => "reason".to_owned(),
        "MotionMethod" => "method".to_owned(),
        "TrackState" => "track".to_owned(),
        "EventKind" => "event".to_owned(),
        "Cloud" | "Obstacles" => "sweep".to_owned(),
        "PointClass" => "class".to_owned(),
        name => snake(name),
    };
    format!("SCANHUB_{}_", name.to_uppercase())
}

/// Returns the set that already has constants for the values of this set, or `None`.
fn shared_prefix(set: &str) -> Option<&'static str> {
    (set == "Obstacles").then_some("Cloud")
}

fn constants(name: &str, set: &Set, layout: &Layout) -> String {
    let prefix = prefix(name);
    let doc = match set.doc.as_str() {
        "" => format!("Flags of struct {}.", type_name(&layout.name)),
        doc => doc.to_owned(),
    };
    let mut text = format!("\n{}", comment_above("", &doc));
    if name == "Counter" {
        text += "enum scanhub_counter {\n";
        let last = set.values.last().map(|value| value.number);
        for value in &set.values {
            let comma = if Some(value.number) == last { "" } else { "," };
            text += &with_comment(&format!("    {prefix}{}{comma}", value.name.to_uppercase()), &value.doc);
        }
        return text + "};\n";
    }
    let longest = set.values.iter().map(|value| value.name.len()).max().unwrap_or_default();
    for value in &set.values {
        let name = value.name.to_uppercase();
        text += &with_comment(&format!("#define {prefix}{name:<longest$} {}", value.number), &value.doc);
    }
    text
}

fn declaration_of(layout: &Layout) -> String {
    let name = type_name(&layout.name);
    let mut doc = layout.doc.clone();
    let arrays = rules::arrays_of(&layout.name).iter().map(|array| {
        let kind = if array.kind.starts_with(char::is_uppercase) {
            format!("struct {}", type_name(array.kind))
        } else {
            number_name(array.kind).to_owned()
        };
        format!("{} ({kind})", array.name)
    });
    let arrays: Vec<_> = arrays.collect();
    if !arrays.is_empty() {
        doc +=
            &format!(" The arrays that follow: {}. Use the functions below to read them.", arrays.join(", "));
    }
    let mut text = format!("\n{}struct {name} {{\n", comment_above("", &doc));
    for field in &layout.fields {
        text += &with_comment(&declaration(field), &comment(field));
    }
    text + "};\n"
}

fn declaration(field: &Field) -> String {
    let kind = match &field.kind {
        Kind::Text => "char".to_owned(),
        Kind::Number(number) => number_name(number).to_owned(),
        Kind::Layout(rust) => format!("struct {}", type_name(rust)),
    };
    let len = field.len.map_or(String::new(), |len| format!("[{len}]"));
    format!("    {kind} {}{len};", field.name)
}

/// Returns the name of a number's type in C.
pub(crate) fn number_name(number: &str) -> &'static str {
    match number {
        "u8" => "uint8_t",
        "u16" => "uint16_t",
        "u32" => "uint32_t",
        "u64" => "uint64_t",
        "i8" => "int8_t",
        "i16" => "int16_t",
        "i32" => "int32_t",
        "i64" => "int64_t",
        "f32" => "float",
        "f64" => "double",
        _ => panic!("{number} has no type in C"),
    }
}

fn comment(field: &Field) -> String {
    let values = match field.set.as_deref() {
        Some("Counter") => "by enum scanhub_counter".to_owned(),
        Some(set) => format!("{}..", prefix(set)),
        None => String::new(),
    };
    let text = match field.kind {
        Kind::Text => format!("{} UTF-8, padded with 0; a text that fills it has no 0.", field.doc(&values)),
        _ => field.doc(&values),
    };
    if text == "0." { String::new() } else { text }
}

/// Returns a line with its comment. If the comment is too long for the line, the comment is above the line.
pub(crate) fn with_comment(line: &str, comment: &str) -> String {
    let indent = &line[..line.len() - line.trim_start().len()];
    let on_same_line = format!("{line} /* {comment} */");
    if comment.is_empty() {
        format!("{line}\n")
    } else if on_same_line.len() <= MAX_LINE_WIDTH {
        format!("{on_same_line}\n")
    } else {
        comment_above(indent, comment) + line + "\n"
    }
}

/// Returns a comment in separate lines.
pub(crate) fn comment_above(indent: &str, comment: &str) -> String {
    // Keep the end of the comment on the same line as its text.
    let lines =
        wrap(&format!("{indent}/* "), &format!("{indent} * "), &format!("{comment}\u{1}*/"), MAX_LINE_WIDTH);
    lines.replace('\u{1}', " ")
}

/// Returns the sizes of arrays whose length depends on counts: the arrays of a scan, which depend on its contents, and
/// the segments.
pub(crate) fn arrays(description: &Description) -> String {
    let segments =
        rules::arrays_of("Foreground").iter().find(|array| array.kind == "Segment").expect("segments");
    let ranges = (1 + rules::arrays_of("Scan")
        .iter()
        .filter_map(|array| array.only_if)
        .map(|(_, bit)| bit)
        .sum::<u64>())
    .next_power_of_two();
    let mut text = format!(
        "/* Segments that a foreground has room for. */\n#define SCANHUB_FOREGROUND_SEGMENTS {}\n\n\
         /* Stands for the ranges, which every scan has, in addition to the bits of `contents`. */\n\
         #define SCANHUB_SCAN_RANGES {ranges}u\n\n\
         /* Bytes of a beam in the arrays of `contents` and SCANHUB_SCAN_RANGES. */\n\
         static inline size_t scanhub_scan_width(unsigned contents)\n{{\n    return ",
        segments.count
    );
    let contents = &description.sets["ArrayFlags"].values;
    let widths = rules::arrays_of("Scan").iter().map(|array| {
        let name = match array.only_if {
            Some((_, bit)) => {
                contents.iter().find(|value| value.number == bit).expect("a bit").name.to_uppercase()
            }
            None => "RANGES".to_owned(),
        };
        format!("(contents & SCANHUB_SCAN_{name} ? {}u : 0u)", rules::number_size(array.kind))
    });
    text += &widths.collect::<Vec<_>>().join("\n        + ");
    text + ";\n}\n"
}

/// Returns the checks that fail if a compiler has another layout.
pub(crate) fn checks(description: &Description) -> String {
    let mut text = String::new();
    for layout in &description.layouts {
        let name = type_name(&layout.name);
        writeln!(text, "SCANHUB_SIZE({name}, {});", layout.size).expect("a String");
        for field in &layout.fields {
            writeln!(text, "SCANHUB_AT({name}, {}, {});", field.name, field.offset).expect("a String");
        }
    }
    text
}

/// Returns the topics of the structs, for C++.
pub(crate) fn topics(description: &Description) -> String {
    let mut text = String::new();
    for topic in Topic::ALL {
        if let Some(layout) = description.payload(topic) {
            let (kind, topic) = (type_name(&layout.name), topic.name().to_uppercase());
            let number = format!("enum {{ number = SCANHUB_TOPIC_{topic} }};");
            writeln!(text, "template <> struct TopicOf<{kind}> {{ {number} }};").expect("a String");
        }
    }
    text
}
