//! Description of all layouts, read from the sources of this crate: every struct of a payload with its fields,
//! their types and comments, and the constants and enums that the comments link to.
//!
//! Offsets are sums of sizes. The sums are exact, because each of these structs derives `Pod`, which rejects padding.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use scanhub_schema::Topic;
use syn::{Attribute, Expr, ImplItem, Item, Lit, Type};

use super::rules;

/// All layouts. A layout of a field or an element comes before the layout that contains it.
pub(crate) struct Description {
    pub(crate) layouts: Vec<Layout>,
    /// Layouts of the header of a datagram, and of an announcement with its topics.
    pub(crate) datagram: Vec<Layout>,
    pub(crate) sets: BTreeMap<String, Set>,
}

/// Layout of one struct.
pub(crate) struct Layout {
    /// Name without `Head`, as in `scanhub.Scan.v2`.
    pub(crate) name: String,
    /// Name of the Rust struct.
    pub(crate) rust: String,
    /// Size in bytes.
    pub(crate) size: usize,
    /// Alignment in bytes.
    pub(crate) align: usize,
    pub(crate) doc: String,
    pub(crate) fields: Vec<Field>,
}

#[derive(Clone)]
pub(crate) struct Field {
    pub(crate) name: String,
    /// Offset in bytes.
    pub(crate) offset: usize,
    pub(crate) kind: Kind,
    /// Number of elements of an array.
    pub(crate) len: Option<usize>,
    /// Size of one element in bytes.
    pub(crate) element: usize,
    doc: String,
    /// Set of the values or bits that the field can have.
    pub(crate) set: Option<String>,
}

#[derive(Clone, PartialEq)]
pub(crate) enum Kind {
    /// `u8`, `i32`, `f64` and so on.
    Number(&'static str),
    /// UTF-8, padded with 0.
    Text,
    /// Another layout, by its Rust name.
    Layout(String),
}

/// Values of an enum, or bits of a field of flags.
pub(crate) struct Set {
    pub(crate) doc: String,
    pub(crate) values: Vec<Value>,
}

pub(crate) struct Value {
    pub(crate) number: u64,
    /// Lower case, as in `too_near`.
    pub(crate) name: String,
    pub(crate) doc: String,
}

const NUMBER_TYPES: [(&str, usize); 10] = [
    ("u8", 1),
    ("u16", 2),
    ("u32", 4),
    ("u64", 8),
    ("i8", 1),
    ("i16", 2),
    ("i32", 4),
    ("i64", 8),
    ("f32", 4),
    ("f64", 8),
];

/// Character in a comment that stands for the values of the field's set.
const VALUES_MARK: char = '\u{1}';

impl Field {
    /// Returns the comment, with `values` in place of [`VALUES_MARK`].
    pub(crate) fn doc(&self, values: &str) -> String {
        self.doc.replace(VALUES_MARK, values)
    }

    /// Returns the size in bytes.
    pub(crate) fn size(&self) -> usize {
        self.element * self.len.unwrap_or(1)
    }

    /// Returns the type for readers: `u8`, `f32[9]`, `text[24]` or `Mark[64]`.
    pub(crate) fn kind_name(&self) -> String {
        let name = match &self.kind {
            Kind::Number(name) => name,
            Kind::Text => "text",
            Kind::Layout(name) => name.as_str(),
        };
        self.len.map_or(name.to_owned(), |len| format!("{name}[{len}]"))
    }
}

impl Set {
    /// Returns `0 lms, 1 ld`.
    pub(crate) fn summary(&self) -> String {
        let values = self.values.iter().map(|value| format!("{} {}", value.number, value.name));
        values.collect::<Vec<_>>().join(", ")
    }
}

impl Description {
    pub(crate) fn layout(&self, rust: &str) -> &Layout {
        let found = self.layouts.iter().find(|layout| layout.rust == rust);
        found.unwrap_or_else(|| panic!("there is no layout of {rust}"))
    }

    /// Returns the layout with which a payload of `topic` starts; `None` for `telegram`, whose payload is bytes.
    pub(crate) fn payload(&self, topic: Topic) -> Option<&Layout> {
        let name = topic.payload().strip_prefix("scanhub.")?.strip_suffix(".v2")?;
        self.layouts.iter().find(|layout| layout.name == name)
    }

    /// Returns the field's comment with all values, as in `Family: 0 lms, 1 ld.`
    pub(crate) fn doc(&self, field: &Field) -> String {
        field.doc(&field.set.as_ref().map_or(String::new(), |set| self.sets[set].summary()))
    }

    /// Returns `layouts.txt`: a line for each struct, for each of its fields, and for each value that a field can have.
    pub(crate) fn text(&self) -> String {
        let mut text = String::new();
        for Layout { rust, size, align, doc, fields, .. } in &self.layouts {
            writeln!(text, "scanhub.{rust}.v2 {size} {align} {doc}").expect("a String");
            for field in fields {
                let doc = self.doc(field);
                writeln!(text, "  {} {} {} {doc}", field.name, field.offset, field.kind_name())
                    .expect("a String");
                for Value { number, name, doc } in field.set.iter().flat_map(|set| &self.sets[set].values) {
                    writeln!(text, "    {number} {name} {doc}").expect("a String");
                }
            }
        }
        text
    }

    /// Reads the description from the sources.
    pub(crate) fn read() -> Description {
        let mut sources = Sources::default();
        sources.read_folder(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"));
        let mut description =
            Description { layouts: Vec::new(), datagram: Vec::new(), sets: BTreeMap::new() };
        description.add("Header", &sources);
        for topic in Topic::ALL {
            let Some(name) = topic.payload().strip_prefix("scanhub.") else { continue };
            let name = name.strip_suffix(".v2").expect("a version");
            for element in
                rules::arrays_of(name).iter().filter(|tail| sources.structs.contains_key(tail.kind))
            {
                description.add(element.kind, &sources);
            }
            let head = format!("{name}Head");
            description.add(if sources.structs.contains_key(&head) { &head } else { name }, &sources);
        }
        let payloads = description.layouts.len();
        for rust in ["DatagramHead", "AnnounceHead", "Announced"] {
            description.add(rust, &sources);
        }
        description.datagram = description.layouts.split_off(payloads);
        description
    }

    fn add(&mut self, rust: &str, sources: &Sources) {
        if self.layouts.iter().any(|layout| layout.rust == rust) {
            return;
        }
        let item = &sources.structs[rust];
        let mut layout = Layout {
            name: rust.strip_suffix("Head").unwrap_or(rust).to_owned(),
            rust: rust.to_owned(),
            size: 0,
            align: 1,
            doc: plain(&doc_of(&item.attrs)),
            fields: Vec::new(),
        };
        for field in &item.fields {
            let name = field.ident.as_ref().expect("a name").to_string();
            let (mut kind, len) = sources.kind(&field.ty);
            if kind == Kind::Number("u8") && name.ends_with("_text") {
                kind = Kind::Text;
            }
            let (element, align) = match &kind {
                Kind::Number(number) => {
                    let size = NUMBER_TYPES.iter().find(|(name, _)| name == number).expect("a number").1;
                    (size, size)
                }
                Kind::Text => (1, 1),
                Kind::Layout(inner) => {
                    self.add(inner, sources);
                    let inner = self.layout(inner);
                    (inner.size, inner.align)
                }
            };
            let (doc, set) = sources.resolve(rust, item, &doc_of(&field.attrs));
            assert!(!doc.is_empty(), "{rust}.{name} needs a comment that does not only link to a function");
            if let Some(set) = &set {
                self.sets.entry(set.clone()).or_insert_with(|| sources.set(set));
            }
            let field = Field { name, offset: layout.size, kind, len, element, doc, set };
            layout.size += field.size();
            layout.align = layout.align.max(align);
            layout.fields.push(field);
        }
        self.layouts.push(layout);
    }
}

/// Items of all sources, by name.
#[derive(Default)]
struct Sources {
    structs: BTreeMap<String, syn::ItemStruct>,
    enums: BTreeMap<String, (String, Vec<NumberNameDoc>)>,
    /// Number and comment of each constant, by `Type::NAME`, or by `NAME` for a constant outside of a type.
    consts: BTreeMap<String, (u64, String)>,
    /// Names of the constants, in the order of the source.
    const_order: Vec<String>,
}

/// Number, name and comment.
type NumberNameDoc = (u64, String, String);

impl Sources {
    fn read_folder(&mut self, folder: &Path) {
        let mut paths: Vec<_> =
            fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path()).collect();
        paths.sort();
        for path in paths {
            if path.is_dir() {
                self.read_folder(&path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let text = fs::read_to_string(&path).expect("a source");
                self.read_items(syn::parse_file(&text).expect("Rust").items);
            }
        }
    }

    fn read_items(&mut self, items: Vec<Item>) {
        for item in items {
            match item {
                Item::Struct(item) => drop(self.structs.insert(item.ident.to_string(), item)),
                Item::Enum(item) => {
                    let mut next = 0;
                    let mut values = Vec::new();
                    for variant in &item.variants {
                        next = variant
                            .discriminant
                            .as_ref()
                            .and_then(|(_, value)| number(value))
                            .unwrap_or(next);
                        values.push((next, snake(&variant.ident.to_string()), doc_of(&variant.attrs)));
                        next += 1;
                    }
                    self.enums.insert(item.ident.to_string(), (doc_of(&item.attrs), values));
                }
                Item::Const(item) => self.read_const(item.ident.to_string(), &item.expr, &item.attrs),
                Item::Impl(item) => {
                    let Type::Path(path) = &*item.self_ty else { continue };
                    let Some(owner) = path.path.get_ident() else { continue };
                    for inner in &item.items {
                        if let ImplItem::Const(inner) = inner {
                            self.read_const(format!("{owner}::{}", inner.ident), &inner.expr, &inner.attrs);
                        }
                    }
                }
                // Each line has a variant, a name and a comment. Only the name and the comment are string literals.
                Item::Macro(item) if item.mac.path.is_ident("counters") => {
                    let literals = item.mac.tokens.into_iter().filter_map(|token| {
                        syn::parse2::<syn::LitStr>(token.into()).ok().map(|literal| literal.value())
                    });
                    let literals: Vec<String> = literals.collect();
                    let values = literals.chunks_exact(2).zip(0..);
                    let values = values.map(|(pair, number)| (number, pair[0].clone(), pair[1].clone()));
                    self.enums
                        .insert("Counter".to_owned(), ("Counters of a link.".to_owned(), values.collect()));
                }
                _ => {}
            }
        }
    }

    fn read_const(&mut self, name: String, value: &Expr, attrs: &[Attribute]) {
        if let Some(value) = number(value) {
            self.consts.insert(name.clone(), (value, doc_of(attrs)));
            self.const_order.push(name);
        }
    }

    /// Returns the type of a field, and its number of elements if it is an array.
    fn kind(&self, ty: &Type) -> (Kind, Option<usize>) {
        match ty {
            Type::Array(array) => {
                let len = number(&array.len).or_else(|| {
                    let Expr::Path(path) = &array.len else { return None };
                    let names: Vec<_> =
                        path.path.segments.iter().map(|part| part.ident.to_string()).collect();
                    self.consts.get(&names.join("::")).map(|(value, _)| *value)
                });
                (self.kind(&array.elem).0, Some(len.expect("a constant length") as usize))
            }
            Type::Path(path) => {
                let name = path.path.require_ident().expect("a plain type").to_string();
                if let Some((number, _)) = NUMBER_TYPES.iter().find(|(number, _)| *number == name) {
                    return (Kind::Number(number), None);
                }
                // A struct that wraps an array is described as this array.
                match &self.structs[&name].fields {
                    syn::Fields::Unnamed(inner) => self.kind(&inner.unnamed[0].ty),
                    _ => (Kind::Layout(name), None),
                }
            }
            _ => panic!("a field is a number, an array or a struct"),
        }
    }

    /// Returns `doc` without links, and the set that it links to. A link to an enum or to flags is replaced by
    /// [`VALUES_MARK`], and a link to another constant by the constant's number. A sentence with a link to a function
    /// is left out.
    fn resolve(&self, rust: &str, item: &syn::ItemStruct, doc: &str) -> (String, Option<String>) {
        let mut set = None;
        let mut kept = Vec::new();
        'sentences: for sentence in sentences(doc) {
            let mut text = String::new();
            let mut rest = sentence.as_str();
            while let Some((before, link)) = rest.split_once("[`") {
                let (shown, after) = link.split_once("`]").expect("the end of a link");
                let (target, after) = match after.strip_prefix('(').and_then(|after| after.split_once(')')) {
                    Some((target, after)) => (target, after),
                    None => (shown, after),
                };
                let owner = rust.strip_suffix("Head").unwrap_or(rust);
                let target = target.trim_start_matches("crate::").replace("Self::", &format!("{owner}::"));
                let last = target.rsplit("::").next().unwrap_or(&target);
                text += before;
                let is_set = self.enums.contains_key(&target)
                    || self.structs.get(&target).is_some_and(|of| matches!(of.fields, syn::Fields::Unit));
                if is_set {
                    set = Some(target.clone());
                    text.push(VALUES_MARK);
                } else if let Some((number, about)) = self.consts.get(&target) {
                    if about.starts_with("Flag") {
                        set = Some(target.split("::").next().expect("a type").to_owned());
                        text.push(VALUES_MARK);
                    } else {
                        text += &number.to_string();
                    }
                } else if item
                    .fields
                    .iter()
                    .any(|field| field.ident.as_ref().is_some_and(|name| name == last))
                {
                    text += &format!("`{last}`");
                } else {
                    continue 'sentences;
                }
                rest = after;
            }
            text += rest;
            for between in [", ", " and "] {
                while text.contains(&format!("{VALUES_MARK}{between}{VALUES_MARK}")) {
                    text = text
                        .replace(&format!("{VALUES_MARK}{between}{VALUES_MARK}"), &VALUES_MARK.to_string());
                }
            }
            kept.push(text);
        }
        (kept.join(" "), set)
    }

    /// Returns the values of an enum, the bits of a type that has only bits, or the flags of a payload.
    fn set(&self, name: &str) -> Set {
        if let Some((doc, values)) = self.enums.get(name) {
            let values = values.iter().map(|(number, name, doc)| Value {
                number: *number,
                name: name.clone(),
                doc: plain(doc),
            });
            return Set { doc: plain(doc), values: values.collect() };
        }
        let is_unit = self.structs.get(name).is_some_and(|of| matches!(of.fields, syn::Fields::Unit));
        let mut values = Vec::new();
        for of in &self.const_order {
            let Some(bit) = of.strip_prefix(&format!("{name}::")) else { continue };
            let (number, doc) = &self.consts[of];
            let doc = match doc.split_once(": ") {
                Some((flag, doc)) if flag.starts_with("Flag") => doc,
                _ if is_unit => doc,
                _ => continue,
            };
            if number.is_power_of_two() {
                values.push(Value {
                    number: *number,
                    name: bit.to_lowercase(),
                    doc: plain(&upper_first(doc)),
                });
            }
        }
        let doc = self.structs.get(name).map_or(String::new(), |item| doc_of(&item.attrs));
        Set { doc: if is_unit { plain(&doc) } else { String::new() }, values }
    }
}

/// Returns the first paragraph of a doc comment as one line.
fn doc_of(attrs: &[Attribute]) -> String {
    let mut lines = Vec::new();
    for attribute in attrs.iter().filter(|attribute| attribute.path().is_ident("doc")) {
        let Ok(line) = attribute.meta.require_name_value() else { continue };
        let Expr::Lit(line) = &line.value else { continue };
        let Lit::Str(line) = &line.lit else { continue };
        match line.value().trim() {
            "" => break,
            line => lines.push(line.to_owned()),
        }
    }
    lines.join(" ")
}

/// Returns the value of an expression if the expression is a simple number.
fn number(value: &Expr) -> Option<u64> {
    match value {
        Expr::Lit(literal) => match &literal.lit {
            Lit::Int(number) => number.base10_parse().ok(),
            _ => None,
        },
        Expr::Path(path) => {
            let names: Vec<String> = path.path.segments.iter().map(|part| part.ident.to_string()).collect();
            match names.join("::").as_str() {
                "u16::MAX" => Some(u16::MAX.into()),
                "u32::MAX" => Some(u32::MAX.into()),
                _ => None,
            }
        }
        _ => None,
    }
}

/// Returns the sentences of a text, each with its full stop.
fn sentences(text: &str) -> Vec<String> {
    text.split_inclusive(". ").map(|sentence| sentence.trim().to_owned()).collect()
}

/// Returns the first sentence of a text, without its full stop.
pub(crate) fn first_sentence(text: &str) -> String {
    let first = text.split(". ").next().unwrap_or_default();
    first.strip_suffix('.').unwrap_or(first).to_owned()
}

/// Returns a text whose links are names: `no_level` for a link to `Marks::NO_LEVEL`.
fn plain(text: &str) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some((before, link)) = rest.split_once("[`") {
        let (shown, after) = link.split_once("`]").expect("the end of a link");
        let after = match after.strip_prefix('(').and_then(|after| after.split_once(')')) {
            Some((_, after)) => after,
            None => after,
        };
        let name = shown.rsplit("::").next().unwrap_or(shown).to_lowercase();
        out += &format!("{before}`{name}`");
        rest = after;
    }
    out + rest
}

/// Returns `between_rooms` for `BetweenRooms`.
pub(crate) fn snake(name: &str) -> String {
    let mut snake = String::new();
    for letter in name.chars() {
        if letter.is_uppercase() && !snake.is_empty() {
            snake.push('_');
        }
        snake.extend(letter.to_lowercase());
    }
    snake
}

/// Returns the text with its first letter in upper case.
pub(crate) fn upper_first(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

/// Returns the text with its first letter in lower case, unless it starts with an abbreviation.
pub(crate) fn lower_first(text: &str) -> String {
    let mut letters = text.chars();
    let first = letters.next();
    if letters.clone().next().is_none_or(|second| !second.is_lowercase()) {
        return text.to_owned();
    }
    first.map_or(String::new(), |first| first.to_lowercase().chain(letters).collect())
}
