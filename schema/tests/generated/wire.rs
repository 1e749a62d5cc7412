//! Offsets in the header of a datagram and in an announcement, for the readers of datagrams in all languages.

use std::fmt::Write as _;

use super::c::{comment_above, with_comment};
use super::description::{Description, Field, Kind, Layout, first_sentence, lower_first, snake};
use super::python::format_code;

/// Returns the start of all names of a layout: `DATAGRAM`, `ANNOUNCE` or `ANNOUNCED`.
fn prefix(layout: &Layout) -> String {
    snake(&layout.name).to_uppercase()
}

/// Returns the offsets as constants, and the bits of the header's flags, for C.
pub(crate) fn c(description: &Description) -> String {
    let mut text = String::new();
    for layout in &description.datagram {
        let (name, prefix) = (snake(&layout.name), prefix(layout));
        text += &comment_above("", &format!("Offsets in bytes. {}.", first_sentence(&layout.doc)));
        writeln!(text, "enum scanhub_{name}_at {{").expect("a String");
        for field in layout.fields.iter().filter(|field| !field.name.starts_with("reserved")) {
            let name = field.name.strip_suffix("_text").unwrap_or(&field.name).to_uppercase();
            let line = format!("    SCANHUB_{prefix}_AT_{name} = {},", field.offset);
            text += &with_comment(&line, &format!("{}.", first_sentence(&description.doc(field))));
        }
        write!(text, "    SCANHUB_{prefix}_AT_END = {}\n}};\n\n", layout.size).expect("a String");
    }
    text += &(comment_above("", "Bits of `flags`.") + "enum scanhub_flag {\n");
    let flags = &description.sets["LanFlags"].values;
    for (index, flag) in flags.iter().enumerate() {
        let comma = if index + 1 < flags.len() { "," } else { "" };
        let line = format!("    SCANHUB_{} = {}{comma}", flag.name.to_uppercase(), flag.number);
        text += &with_comment(&line, &flag.doc);
    }
    text + "};\n"
}

/// Returns the layouts in the form of Python's `struct`, with the names of the values; and sizes of other structs.
pub(crate) fn python(description: &Description) -> String {
    let mut text = String::new();
    for layout in &description.datagram {
        let (fields, prefix) = (layout.fields.iter(), prefix(layout));
        let format: String = fields.map(python_format).collect();
        writeln!(text, "_{prefix} = struct.Struct(\"<{format}\")").expect("a String");
    }
    let crc = description.datagram[0].fields.iter().find(|field| field.name == "crc").expect("a checksum");
    writeln!(text, "_CRC_AT = {}", crc.offset).expect("a String");
    for rust in ["ScanHead", "ForegroundHead", "Segment"] {
        writeln!(text, "_{} = {}", snake(rust).to_uppercase(), description.layout(rust).size)
            .expect("a String");
    }
    let flags = &description.sets["LanFlags"].values;
    let names: Vec<_> = flags.iter().map(|flag| flag.name.to_uppercase()).collect();
    let bits: Vec<_> = flags.iter().map(|flag| flag.number.to_string()).collect();
    writeln!(text, "{} = {}", names.join(", "), bits.join(", ")).expect("a String");
    text
}

fn python_format(field: &Field) -> String {
    match &field.kind {
        _ if field.name.starts_with("reserved") => format!("{}x", field.size()),
        Kind::Number(kind) => match field.len {
            Some(len) => format!("{len}s"),
            None => format_code(kind).to_string(),
        },
        Kind::Text => format!("{}s", field.size()),
        Kind::Layout(_) => panic!("it has no structs"),
    }
}

/// Returns offset and size of all fields for Lua, and the sizes of other structs.
pub(crate) fn lua(description: &Description) -> String {
    let mut text = String::new();
    for layout in &description.datagram {
        writeln!(text, "local {} = {{", prefix(layout)).expect("a String");
        for field in layout.fields.iter().filter(|field| !field.name.starts_with("reserved")) {
            let name = field.name.strip_suffix("_text").unwrap_or(&field.name);
            writeln!(text, "    {name} = {{ {}, {} }},", field.offset, field.size()).expect("a String");
        }
        write!(text, "    size = {},\n}}\n", layout.size).expect("a String");
    }
    for rust in ["ScanHead", "ForegroundHead", "Segment"] {
        writeln!(text, "local {} = {}", snake(rust).to_uppercase(), description.layout(rust).size)
            .expect("a String");
    }
    text
}

/// Returns the table of the header for `docs/datagram.md`.
pub(crate) fn header(description: &Description) -> String {
    let mut text = "\n| offset | size | field |\n|---|---|---|\n".to_owned();
    for field in &description.datagram[0].fields {
        let doc = description.doc(field);
        let doc = lower_first(doc.trim_end_matches('.'));
        let doc = doc.strip_prefix(&format!("{}: ", field.name)).unwrap_or(&doc);
        writeln!(text, "| {} | {} | `{}`: {doc} |", field.offset, field.size(), field.name)
            .expect("a String");
    }
    text + "\n"
}
