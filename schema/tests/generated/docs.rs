//! Lists and tables of `docs/topics.md` and `docs/datagram.md`.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use scanhub_schema::datagram::Announce;
use scanhub_schema::{PublisherKind, Topic};

use super::description::{Description, Field, Kind, Layout, Value, first_sentence, lower_first};
use super::rules::{self, ArrayRule};
use super::wrap;

/// Maximum number of listed values. If a field has more values, only their names are listed.
const MAX_VALUES: usize = 10;
const MAX_LINE_WIDTH: usize = 120;

/// Returns the lists of the layout, of the layouts in it, and of the elements of its arrays.
pub(crate) fn lists(description: &Description, layout: &Layout) -> String {
    let tail = rules::arrays_of(&layout.name);
    let what = if tail.is_empty() { "" } else { " and arrays" };
    let mut text = format!("\n`scanhub.{}.v2`, {} bytes{what}:\n\n", layout.name, layout.size);
    let mut inner = items(description, layout, &mut text);
    let mut at = Some(layout.size);
    for array in tail {
        let offset = at.map_or("then".to_owned(), |at| at.to_string());
        let element = description.layouts.iter().find(|layout| layout.rust == array.kind);
        let condition =
            array.only_if.map_or(String::new(), |(field, bit)| format!(", if `{field}` has bit {bit}"));
        let doc = lower_first(without_rest(array.doc));
        let item = format!("{offset} {}[{}] `{}`{condition}: {doc}", array.kind, array.count, array.name);
        text += &wrap("- ", "  ", &item, MAX_LINE_WIDTH);
        at = at
            .zip(array.count.parse::<usize>().ok())
            .zip(element)
            .map(|((at, count), of)| at + count * of.size);
        inner.extend(element);
    }
    for layout in inner {
        write!(text, "\n`scanhub.{}.v2`, {} bytes:\n\n", layout.name, layout.size).expect("a String");
        items(description, layout, &mut text);
    }
    text + "\n"
}

/// Writes the rows of all fields. Returns the layouts that these fields contain.
fn items<'a>(description: &'a Description, layout: &Layout, text: &mut String) -> Vec<&'a Layout> {
    let mut inner = Vec::new();
    for field in layout.fields.iter().filter(|field| field.doc("") != "0.") {
        if let Kind::Layout(rust) = &field.kind {
            inner.push(description.layout(rust));
        }
        let kind = match (&field.kind, field.len) {
            (Kind::Text, Some(len)) => format!("char[{len}]"),
            _ => field.kind_name(),
        };
        let mut item = format!("{} {kind} {}", field.offset, field_text(description, field));
        let set = field.set.as_ref().filter(|set| description.sets[*set].values.len() <= MAX_VALUES);
        let first = set.map(|set| first_layout_with(description, set));
        if let Some(first) = first.filter(|first| first.name != layout.name) {
            let anchor = first.name.to_lowercase();
            write!(item, "; values as in [{}](#{anchor})", first.name).expect("a String");
        }
        *text += &wrap("- ", "  ", &item, MAX_LINE_WIDTH);
        if let Some(set) = set.filter(|_| first.is_some_and(|first| first.name == layout.name)) {
            for Value { number, name, doc } in &description.sets[set].values {
                let item = format!("{number} `{name}`: {}", first_sentence(doc));
                *text += &wrap("  - ", "    ", &item, MAX_LINE_WIDTH);
            }
        }
    }
    inner
}

/// Returns the first layout with a field that can have the values of `set`. The page lists them only there.
fn first_layout_with<'a>(description: &'a Description, set: &str) -> &'a Layout {
    let has_set = |layout: &&Layout| layout.fields.iter().any(|field| field.set.as_deref() == Some(set));
    description.layouts.iter().find(has_set).expect("a layout with the set")
}

/// Returns name and meaning of a field. Its values are in items below, unless they are too many.
fn field_text(description: &Description, field: &Field) -> String {
    let set = field.set.as_ref().map(|set| &description.sets[set].values);
    let names = set.filter(|values| values.len() > MAX_VALUES).into_iter().flatten();
    let doc = field.doc(&names.map(|value| value.name.as_str()).collect::<Vec<_>>().join(", "));
    let doc = doc.replace(": .", ".").replace(": ;", ";");
    let doc = lower_first(without_rest(&doc));
    let more = doc.strip_prefix(&field.name).and_then(|more| more.strip_prefix([':', '.']));
    match more.unwrap_or(&doc).trim_start() {
        more if more == field.name => format!("`{}`", field.name),
        more => format!("`{}`: {}", field.name, lower_first(more)),
    }
}

/// Returns `doc` without its end: the full stop, and the value of unused elements, which the page has for all arrays.
fn without_rest(doc: &str) -> &str {
    doc.split("; 0 beyond").next().unwrap_or_default().trim_end_matches(['.', ':', ' '])
}

/// Returns the table of the payloads in datagrams.
pub(crate) fn payloads(description: &Description) -> String {
    let mut text = "\n| topic | offset | size | |\n|---|---|---|---|\n".to_owned();
    for topic in Topic::ALL {
        let Some(layout) = description.payload(topic) else { continue };
        let name = format!("`scanhub.{}.v2`", layout.name);
        let head = rules::fixed_part(layout);
        let arrays: Vec<_> = layout.fields[head.fields..].iter().collect();
        let tail = rules::packed_arrays_of(&layout.name);
        let whole = arrays.is_empty() && tail.is_empty();
        let what = if whole { name } else { format!("head of {name}") };
        let counts = rules::counts(layout);
        let limits: String =
            counts.iter().map(|(count, maximum)| format!("; `{count}` is at most {maximum}")).collect();
        writeln!(text, "| {} | 0 | {} | {what}{limits} |", topic.name(), head.size).expect("a String");
        let mut at = format!(" {}", head.size);
        let mut row = |size: String, about: String| {
            writeln!(text, "| |{at} | {size} | {about} |").expect("a String");
            at = String::new();
        };
        for field in arrays {
            let count = rules::count_of(layout, field);
            row(format!("{} {count}", field.element), format!("the used elements of `{}`", field.name));
        }
        for ArrayRule { name, kind, count, only_if, .. } in tail {
            let (element, of) = match description.layouts.iter().find(|layout| layout.rust == *kind) {
                Some(layout) => (layout.size, format!("`scanhub.{}.v2`", layout.name)),
                None => (rules::number_size(kind), (*kind).to_owned()),
            };
            let condition =
                only_if.map_or(String::new(), |(field, bit)| format!(", if `{field}` has bit {bit}"));
            let size = if element == 1 { (*count).to_owned() } else { format!("{element} {count}") };
            row(size, format!("`{name}`, each {of}{condition}"));
        }
    }
    text + "\n"
}

/// Returns the table of the services of all topics.
pub(crate) fn services() -> String {
    let mut text = "\n| service | payload | history | buffer |\n|---|---|---|---|\n".to_owned();
    for topic in Topic::ALL {
        let owner = match topic.publisher_kind() {
            PublisherKind::Link => "SENSOR",
            PublisherKind::Tracker => "TRACKER",
            PublisherKind::Mount => "MOUNT",
            PublisherKind::Tilted => "NAME",
        };
        let payload =
            match (topic.payload(), topic.payload().trim_start_matches("scanhub.").trim_end_matches(".v2")) {
                ("u8[]", _) => format!("`[u8]`, at most {}", scanhub_schema::Telegram::MAX_LEN),
                (payload, name) if rules::arrays_of(name).is_empty() => format!("`{payload}`"),
                (payload, _) => format!("`[{payload}]`"),
            };
        let row = topic.spec();
        let service = topic.service(owner);
        writeln!(text, "| `{service}` | {payload} | {} | {} |", row.history_len, row.queue_len)
            .expect("a String");
    }
    text + "\n"
}

/// Returns the table of the multicast groups with their topics.
pub(crate) fn groups() -> String {
    let mut text = "\n| group, port 22200 | topics with their numbers |\n|---|---|\n".to_owned();
    let announce = (Announce::GROUP, format!("{} announce", Announce::NUMBER));
    let topics = Topic::ALL.map(|topic| (topic.spec().group, format!("{} {}", topic.number(), topic.name())));
    let all: Vec<_> = [announce].into_iter().chain(topics).collect();
    let groups: BTreeSet<u8> = all.iter().map(|(group, _)| *group).collect();
    for group in groups {
        let topics: Vec<_> =
            all.iter().filter(|(of, _)| *of == group).map(|(_, topic)| topic.as_str()).collect();
        writeln!(text, "| 239.255.76.{group} | {} |", topics.join(", ")).expect("a String");
    }
    text + "\n"
}
