//! Description of all messages that every recording contains, `schema/src/file/layout.txt`.

use scanhub_schema::{Header, Topic};

use super::description::{Description, Field, Kind, Layout, first_sentence, lower_first};
use super::rules::{self, ArrayRule};
use super::wrap;

const MAX_LINE_WIDTH: usize = 120;
/// Column of the text after the name of a type.
const NAME_COLUMN: usize = 25;
/// Maximum number of values of a set. A larger set is not listed.
const MAX_VALUES: usize = 10;
/// Character for a space at which a line must not end.
const JOIN_MARK: &str = "\u{1}";

/// Returns the description: the header, and a paragraph for each topic.
pub(crate) fn layout(description: &Description) -> String {
    let mut text = format!(
        "A message of scanhub: {} bytes of header, then the payload. All numbers are little-endian. Names end with their \
         unit;\ndocs/topics.md explains all fields.\n\nheader\n",
        size_of::<Header>()
    );
    for field in &description.layout("Header").fields {
        let about = lower_first(&first_sentence(&field.doc("")));
        let about = match values(description, field) {
            values if values.is_empty() => about,
            values => format!("{}: {values}", about.split(':').next().unwrap_or_default()),
        };
        let name = format!("{:>3} {} {}", field.offset, kind(field), field.name);
        text += &wrap(&format!("{name:<NAME_COLUMN$}"), &" ".repeat(NAME_COLUMN), &about, MAX_LINE_WIDTH);
    }
    text.push('\n');
    for topic in Topic::ALL {
        let (name, about) = match description.payload(topic) {
            Some(layout) => (layout.name.as_str(), payload(description, layout)),
            None => (
                "Telegram",
                "bytes that the scanner sent: of an LMS a telegram from STX to CRC, of other families whole \
                packets that arrived together"
                    .to_owned(),
            ),
        };
        let name = format!("scanhub.{name}.v2");
        text += &wrap(&format!("{name:<NAME_COLUMN$}"), &" ".repeat(NAME_COLUMN), &about, MAX_LINE_WIDTH);
    }
    text.replace(JOIN_MARK, " ")
}

/// Returns all fields of a payload as a recording has them: without the unused elements of arrays.
fn payload(description: &Description, layout: &Layout) -> String {
    let head = rules::fixed_part(layout).fields;
    let mut parts: Vec<String> = layout.fields[..head].iter().map(|field| item(description, field)).collect();
    for array in &layout.fields[head..] {
        let Kind::Layout(rust) = &array.kind else { panic!("an array of structs") };
        let count = rules::count_of(layout, array);
        parts.push(format!("{count} of {}", elements(description, rust)));
    }
    for ArrayRule { name, kind, count, only_if, .. } in rules::packed_arrays_of(&layout.name) {
        let condition = only_if.map_or(String::new(), |(field, bit)| format!("if {field} has bit {bit}: "));
        parts.push(match description.layouts.iter().any(|layout| layout.rust == *kind) {
            true => format!("{condition}{count} of {}", elements(description, kind)),
            false => format!("{condition}{count} of {kind} {name}"),
        });
    }
    let older = rules::first_revision(&layout.name);
    let older =
        older.map_or(String::new(), |len| format!(". Older recordings have only the first {len} bytes"));
    parts.join(", ") + &older
}

fn elements(description: &Description, rust: &str) -> String {
    let fields = description.layout(rust).fields.iter().map(|field| item(description, field));
    format!("{{{}}}", fields.collect::<Vec<_>>().join(", "))
}

/// Returns type and name of a field, with the values that it can have.
fn item(description: &Description, field: &Field) -> String {
    if field.name.starts_with("reserved") {
        return format!("{}{JOIN_MARK}0", kind(field));
    }
    let name = field.name.strip_suffix("_text").unwrap_or(&field.name);
    if let Kind::Layout(rust) = &field.kind {
        return format!("{name}{JOIN_MARK}{}", elements(description, rust));
    }
    match values(description, field) {
        values if values.is_empty() => format!("{}{JOIN_MARK}{name}", kind(field)),
        values => format!("{}{JOIN_MARK}{name} ({values})", kind(field)),
    }
}

fn kind(field: &Field) -> String {
    let kind = match &field.kind {
        Kind::Number(kind) => kind,
        Kind::Text => "char",
        Kind::Layout(_) => panic!("its fields are described"),
    };
    field.len.map_or(kind.to_owned(), |len| format!("{kind}[{len}]"))
}

fn values(description: &Description, field: &Field) -> String {
    let set = field.set.as_ref().map(|set| &description.sets[set].values);
    let values = set.into_iter().filter(|values| values.len() <= MAX_VALUES).flatten();
    values.map(|value| format!("{}{JOIN_MARK}{}", value.number, value.name)).collect::<Vec<_>>().join(", ")
}
