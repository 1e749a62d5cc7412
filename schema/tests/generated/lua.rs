//! Fields and readers of payloads for `scanhub.lua`, the dissector for Wireshark.

use std::fmt::Write as _;

use scanhub_schema::Topic;

use super::description::{Description, Field, Kind, Layout, first_sentence, snake, upper_first};
use super::readers::{self, BoundsCheck, FieldSource, FiniteRule, ShownField, VARIABLE_PAYLOADS, names_of};
use super::{rules, topics_by_number, wrap};

const MAX_LINE_WIDTH: usize = 120;

/// Returns the names of topics and of values.
pub(crate) fn values(description: &Description) -> String {
    let topics = ["announce"].into_iter().chain(topics_by_number().map(Topic::name));
    let mut text = table("TOPICS", "[0] = ", topics.map(str::to_owned));
    for set in readers::enums(description) {
        let first = if set == "Counter" { "" } else { "[0] = " };
        let names = description.sets[set].values.iter().map(|value| value.name.clone());
        text += &table(&names_of(set), first, names);
    }
    text
}

fn table(name: &str, first: &str, values: impl Iterator<Item = String>) -> String {
    let values: Vec<_> = values.map(|value| format!("\"{value}\"")).collect();
    let line = format!("local {name} = {{ {first}{} }}\n", values.join(", "));
    if line.len() <= MAX_LINE_WIDTH {
        return line;
    }
    let values = format!("{first}{},", values.join(", "));
    format!("local {name} = {{\n{}}}\n", wrap("    ", "    ", &values, MAX_LINE_WIDTH))
}

/// Returns the declarations of the fields of all payloads.
pub(crate) fn fields(description: &Description) -> String {
    let mut text = String::new();
    for (topic, layout) in payloads(description) {
        for layout in [layout].into_iter().chain(elements(description, layout)) {
            for shown in shown_fields(description, layout) {
                text += &declaration(topic, layout, &shown);
            }
        }
        for tail in arrays_of_numbers(description, layout) {
            let (kind, label) = (proto(&Kind::Number(tail.kind)), first_sentence(tail.doc));
            let label = label.split(';').next().unwrap_or_default();
            writeln!(text, "field(\"{}.{}\", \"{kind}\", \"{label}\")", topic.name(), singular(tail.name))
                .expect("a String");
        }
    }
    text
}

fn payloads(description: &Description) -> impl Iterator<Item = (Topic, &Layout)> {
    Topic::ALL.into_iter().filter_map(|topic| Some((topic, description.payload(topic)?)))
}

/// Returns the layouts of the elements of a payload's arrays.
fn elements<'a>(description: &'a Description, layout: &Layout) -> Vec<&'a Layout> {
    let of_fields =
        layout.fields[rules::fixed_part(layout).fields..].iter().filter_map(|field| match &field.kind {
            Kind::Layout(rust) => Some(rust.as_str()),
            _ => None,
        });
    let of_tail = rules::packed_arrays_of(&layout.name).iter().map(|tail| tail.kind);
    let names = of_fields.chain(of_tail.filter(|kind| kind.starts_with(char::is_uppercase)));
    names.map(|rust| description.layout(rust)).collect()
}

fn arrays_of_numbers(description: &Description, layout: &Layout) -> Vec<&'static rules::ArrayRule> {
    let is_number =
        |tail: &&rules::ArrayRule| description.layouts.iter().all(|layout| layout.rust != tail.kind);
    let by_hand = VARIABLE_PAYLOADS.contains(&layout.name.as_str());
    rules::packed_arrays_of(&layout.name).iter().filter(|_| !by_hand).filter(is_number).collect()
}

/// Returns the fields before the first array. They include the fields of structs among them.
fn shown_fields<'a>(description: &'a Description, layout: &'a Layout) -> Vec<ShownField<'a>> {
    let mut all = Vec::new();
    let counts = rules::counts(layout);
    for shown in readers::shown_fields(layout, &description.sets) {
        let is_count = counts.iter().any(|(count, _)| *count == shown.field.name);
        if is_count && shown.field.name != "count" && layout.name != "Foreground" {
            continue;
        }
        match &shown.field.kind {
            Kind::Layout(rust) => all.extend(self::shown_fields(description, description.layout(rust))),
            _ => all.push(shown),
        }
    }
    all
}

/// Returns the part of a field's name after the topic's name.
fn name<'a>(shown: &'a ShownField) -> &'a str {
    match shown.name.as_str() {
        "from_room" => "from",
        "to_room" => "to",
        "point_class" => "class",
        name => name,
    }
}

fn singular(name: &str) -> &str {
    name.strip_suffix('s').unwrap_or(name)
}

fn proto(kind: &Kind) -> String {
    match kind {
        Kind::Text => "string".to_owned(),
        Kind::Number("f32") => "float".to_owned(),
        Kind::Number("f64") => "double".to_owned(),
        Kind::Number(number) => number.replace('u', "uint").replace('i', "int").replace("uintnt", "uint"),
        Kind::Layout(_) => panic!("a struct has no field of its own"),
    }
}

fn declaration(topic: Topic, layout: &Layout, shown: &ShownField) -> String {
    let field = shown.field;
    let topic = topic.name();
    if field.set.as_deref() == Some("Counter") {
        return format!(
            "for _, name in ipairs(COUNTERS) do\n    field(\"{topic}.\" .. name, \"uint64\", name)\nend\n"
        );
    }
    let (label, more) = match &shown.source {
        FieldSource::Bit(bit, _) => {
            (upper_first(&shown.name.replace('_', " ")), format!(", base.DEC, nil, {bit}"))
        }
        FieldSource::Element(doc) => (upper_first(doc), String::new()),
        FieldSource::Computed(doc) => (first_sentence(doc), String::new()),
        FieldSource::Plain | FieldSource::Bool => {
            let more = match field.set.as_deref() {
                Some(_) => match readers::enum_of(field) {
                    Some(set) => format!(", base.DEC, {}", names_of(set)),
                    None => ", base.HEX".to_owned(),
                },
                None if layout.name == "Status" && field.name == "mode" => ", base.HEX".to_owned(),
                None => String::new(),
            };
            let label = first_sentence(&field.doc(""));
            // Without a set, keep the text after a colon: several fields may have the same text before it, such as
            // `Summed pose`.
            let ends: &[char] = if field.set.is_some() { &[';', ':'] } else { &[';'] };
            (label.split(ends).next().unwrap_or_default().trim().replace('`', ""), more)
        }
    };
    let call = format!("field(\"{topic}.{}\", \"{}\", \"{label}\"{more})\n", name(shown), proto(&field.kind));
    if call.len() <= MAX_LINE_WIDTH + 1 {
        call
    } else {
        call.replace("\", \"", "\",\n    \"").replacen("\",\n    \"", "\", \"", 1)
    }
}

/// Returns the functions that read payloads.
pub(crate) fn functions(description: &Description) -> String {
    let mut text = String::new();
    for (topic, layout) in payloads(description) {
        for element in elements(description, layout) {
            write!(text, "\nlocal function add_{}(tree, payload, at)\n", snake(&element.name))
                .expect("a String");
            text += &additions(description, topic, element, "at");
            text += "end\n";
        }
        if VARIABLE_PAYLOADS.contains(&layout.name.as_str()) {
            text += &head(description, topic, layout);
        } else {
            text += &function(description, topic, layout);
        }
    }
    text
}

/// Returns the functions for the head of a payload whose arrays are read by code that is not generated.
fn head(description: &Description, topic: Topic, layout: &Layout) -> String {
    let topic_name = topic.name();
    let mut text =
        format!("\n-- The numbers of a valid head, or nothing.\nlocal function {topic_name}_head(payload)\n");
    text += &conditions(layout);
    text += "    return {\n";
    for field in layout.fields.iter().filter(|field| !field.name.starts_with("reserved")) {
        if matches!(field.kind, Kind::Number("u8" | "u16" | "u32")) {
            writeln!(text, "        {} = {},", field.name, number(field, "")).expect("a String");
        }
    }
    write!(text, "    }}\nend\n\nlocal function add_{topic_name}(tree, payload)\n").expect("a String");
    text += &additions(description, topic, layout, "");
    text + "end\n"
}

/// Returns the expression of a number.
fn number(field: &Field, at: &str) -> String {
    format!("payload({}, {}):le_uint()", offset(at, field.offset), field.element)
}

fn offset(base: &str, at: usize) -> String {
    match (base, at) {
        ("", at) => at.to_string(),
        (base, 0) => base.to_owned(),
        (base, at) => format!("{base} + {at}"),
    }
}

/// Returns the statements that reject a head that is not valid. They do not check the lengths of its arrays.
fn conditions(layout: &Layout) -> String {
    let size = rules::first_revision(&layout.name).unwrap_or(rules::fixed_part(layout).size);
    let mut text = format!("    if payload:len() < {size} then return nil end\n");
    let mut refuse =
        |condition: String| writeln!(text, "    if {condition} then return nil end").expect("a String");
    for (count, maximum) in rules::counts(layout) {
        refuse(format!("{} > {maximum}", number(field(layout, count), "")));
    }
    for check in readers::checks(&layout.name) {
        if let BoundsCheck::Within { field: name, from, to } = check {
            let value = number(field(layout, name), "");
            let low = if *from > 0 { format!("{value} < {from} or ") } else { String::new() };
            refuse(format!("{low}{value} > {to}"));
        }
    }
    for condition in finite_conditions(layout, "", rules::fixed_part(layout).fields) {
        refuse(condition);
    }
    text
}

fn field<'a>(layout: &'a Layout, name: &str) -> &'a Field {
    let found = layout.fields.iter().find(|field| field.name == name);
    found.unwrap_or_else(|| panic!("{} has no {name}", layout.name))
}

/// Returns conditions that are true if a number is not finite. Neighboring numbers are checked together.
fn finite_conditions(layout: &Layout, base: &str, fields: usize) -> Vec<String> {
    let mut conditions = Vec::new();
    let mut runs: Vec<(usize, usize, usize)> = Vec::new();
    for field in &layout.fields[..fields] {
        let len = field.len.unwrap_or(1);
        match (readers::finite(layout, field), runs.last_mut()) {
            (FiniteRule::Required, Some((at, size, count)))
                if *size == field.element && *at + *size * *count == field.offset =>
            {
                *count += len;
            }
            (FiniteRule::Required, _) => runs.push((field.offset, field.element, len)),
            (FiniteRule::MayBeNan, _) => {
                conditions.push(format!(
                    "is_infinite(payload({}, {}):le_float())",
                    offset(base, field.offset),
                    field.element
                ));
            }
            (FiniteRule::NotChecked, _) => {}
        }
    }
    let run = |(at, size, count)| {
        let condition = format!("not are_finite(payload, {}, {size}, {count})", offset(base, at));
        match is_later(layout, at) {
            true => format!("payload:len() >= {} and {condition}", layout.size),
            false => condition,
        }
    };
    conditions.extend(runs.into_iter().map(run));
    conditions
}

/// Returns whether a field at this offset is missing in revision 1.
fn is_later(layout: &Layout, at: usize) -> bool {
    rules::first_revision(&layout.name).is_some_and(|size| at >= size)
}

/// Returns calls that add all fields to a tree.
fn additions(description: &Description, topic: Topic, layout: &Layout, base: &str) -> String {
    let mut text = String::new();
    for shown in readers::shown_fields(layout, &description.sets) {
        if let Kind::Layout(rust) = &shown.field.kind {
            text +=
                &additions(description, topic, description.layout(rust), &offset(base, shown.field.offset));
        }
    }
    let kept = shown_fields(description, layout);
    for shown in
        kept.iter().filter(|shown| layout.fields.iter().any(|field| std::ptr::eq(field, shown.field)))
    {
        let shown_field = shown.field;
        let (at, len) = (offset(base, shown_field.offset), shown_field.element);
        let name = format!("{}.{}", topic.name(), name(shown));
        let line = match (&shown.source, &shown_field.kind) {
            (FieldSource::Computed(_), _) => {
                // Method 1 is `refused`, and flag 2 is `open`.
                let method = number(field(layout, "method"), base);
                format!(
                    "    local method = {method}\n    \
                     local is_valid = METHODS[method] and method ~= 1 and {} % 4 < 2\n    \
                     tree:add(f[\"{name}\"], payload({at}, {len}), is_valid and 1 or 0)",
                    number(shown_field, base)
                )
            }
            (FieldSource::Element(_), _) => {
                let at = offset(base, shown_field.offset + len * shown.index);
                format!("    tree:add_le(f[\"{name}\"], payload({at}, {len}))")
            }
            (_, Kind::Text) => {
                let len = shown_field.len.unwrap_or(1);
                let text = format!("add_text(tree, \"{name}\", payload({at}, {len}))");
                match readers::text_only_if(layout, shown_field) {
                    Some((of, value)) => {
                        format!("    if {} == {value} then {text} end", number(field(layout, of), base))
                    }
                    None => format!("    {text}"),
                }
            }
            _ if shown_field.set.as_deref() == Some("Counter") => format!(
                "    for i, name in ipairs(COUNTERS) do\n        \
                 tree:add_le(f[\"{}.\" .. name], payload({} + {len} * i, {len}))\n    end",
                topic.name(),
                offset(base, shown_field.offset - len)
            ),
            _ => match shown_field.len {
                Some(count) => format!(
                    "    for i = 0, {} do\n        \
                     tree:add_le(f[\"{name}\"], payload({at} + {len} * i, {len}))\n    end",
                    count - 1
                ),
                None => format!("    tree:add_le(f[\"{name}\"], payload({at}, {len}))"),
            },
        };
        if is_later(layout, shown_field.offset) {
            writeln!(
                text,
                "    if payload:len() >= {} then\n    {}\n    end",
                layout.size,
                line.replace('\n', "\n    ")
            )
            .expect("a String");
            continue;
        }
        text += &line;
        text.push('\n');
    }
    text
}

fn function(description: &Description, topic: Topic, layout: &Layout) -> String {
    let mut text = format!("\nunpack_payload[{}] = function(payload, tree)\n", topic.number());
    text += &conditions(layout);
    // For each array: its name, the layout and the size of an element, the variable with the number of elements, and
    // the offset.
    let mut arrays = Vec::new();
    let mut begin = rules::fixed_part(layout).size.to_string();
    let mut add = |text: &mut String, name: String, element: Option<&'_ Layout>, size: usize, count: &str| {
        let variable = if count == "count" { "count".to_owned() } else { format!("{count}_count") };
        writeln!(text, "    local {variable} = {}", number(field(layout, count), "")).expect("a String");
        arrays.push((name, element.map(|layout| layout.rust.clone()), size, variable.clone(), begin.clone()));
        begin += &format!(" + {size} * {variable}");
    };
    for array in &layout.fields[rules::fixed_part(layout).fields..] {
        let Kind::Layout(rust) = &array.kind else { panic!("an array of structs") };
        let count = rules::count_of(layout, array);
        add(&mut text, array.name.clone(), Some(description.layout(rust)), array.element, count);
    }
    for tail in rules::packed_arrays_of(&layout.name) {
        let element = description.layouts.iter().find(|layout| layout.rust == tail.kind);
        let size = element.map_or_else(|| rules::number_size(tail.kind), |layout| layout.size);
        add(&mut text, tail.name.to_owned(), element, size, tail.count);
    }
    if !arrays.is_empty() {
        writeln!(text, "    if payload:len() < {begin} then return nil end").expect("a String");
    }
    for (name, element, size, count, begin) in &arrays {
        let Some(element) = element.as_ref().map(|rust| description.layout(rust)) else { continue };
        let mut conditions = finite_conditions(element, "at", element.fields.len());
        for check in readers::checks(&layout.name) {
            match check {
                BoundsCheck::Below { array, field: of, count } if array == name => {
                    conditions.push(format!("{} >= {count}", number(field(element, of), "at")));
                }
                BoundsCheck::Bits { array, field: of, count } if array == name => {
                    conditions.push(format!("{} >= 2 ^ {count}_count", number(field(element, of), "at")));
                }
                _ => {}
            }
        }
        if !conditions.is_empty() {
            writeln!(text, "    for i = 0, {count} - 1 do\n        local at = {begin} + {size} * i")
                .expect("a String");
            for condition in conditions {
                writeln!(text, "        if {condition} then return nil end").expect("a String");
            }
            text += "    end\n";
        }
    }
    text += &additions(description, topic, layout, "");
    for (name, element, size, count, begin) in &arrays {
        writeln!(text, "    for i = 0, {count} - 1 do\n        local at = {begin} + {size} * i")
            .expect("a String");
        match element.as_ref().map(|rust| description.layout(rust)) {
            Some(element) => {
                let item = format!("tree:add(payload(at, {size}), \"{} \" .. i)", element.name);
                writeln!(text, "        add_{}({item}, payload, at)", snake(&element.name))
            }
            None => {
                let field = format!("f[\"{}.{}\"]", topic.name(), singular(name));
                writeln!(text, "        tree:add_le({field}, payload(at, {size})):prepend_text(i .. \": \")")
            }
        }
        .expect("a String");
        text += "    end\n";
    }
    let arrays: Vec<_> =
        arrays.iter().map(|(name, _, _, count, _)| (name.as_str(), count.as_str())).collect();
    text += &summary(description, layout, &arrays);
    text += "end\n";
    text
}

/// Returns the lines that return the text for the column "Info": the name of a value, numbers of elements, and the
/// flags that are set.
fn summary(description: &Description, layout: &Layout, arrays: &[(&str, &str)]) -> String {
    let mut parts = Vec::new();
    let fields = layout.fields[..rules::fixed_part(layout).fields].iter();
    let mut enums = fields.filter_map(|field| Some((field, readers::enum_of(field)?)));
    if let Some((field, set)) = enums.find(|(_, set)| !["Counter", "Family"].contains(set)) {
        let other = readers::other_value(set).unwrap_or("unknown");
        parts.push(format!("({}[{}] or \"{other}\")", names_of(set), number(field, "")));
    } else if layout.name == "Tilt" {
        parts.push("string.format(\"%.2f deg\", math.deg(payload(0, 8):le_float()))".to_owned());
    }
    for (name, count) in arrays {
        let name = name.replace("_array", "s");
        let comma = if parts.is_empty() { "" } else { "\", \" .. " };
        parts.push(format!("{comma}{count} .. \" {name}\""));
    }
    let mut text = format!("    local words = {}\n", parts.join(" .. "));
    for shown in readers::shown_fields(layout, &description.sets) {
        if let FieldSource::Bit(bit, _) = shown.source {
            let (value, name) = (number(shown.field, ""), shown.name.replace('_', " "));
            writeln!(text, "    if {value} % {} >= {bit} then words = words .. \", {name}\" end", 2 * bit)
                .expect("a String");
        }
    }
    text + "    return words\n"
}
