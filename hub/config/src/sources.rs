//! Sources of a configuration: files and flags. Each value has its place in its source, so that an error can state the
//! file, line and column, or the flag. `load.rs` merges the sources.

use std::ops::Range;
use std::path::{Path, PathBuf};

use scanhub_files::regular_file;
use scanhub_schema::{Failure, Kind, renamed};
use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeArray, DeTable, DeValue, ValueDeserializer};

/// Sources of values that take precedence over the defaults.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    /// Files, in order of increasing precedence. Each file must exist.
    pub files: Vec<PathBuf>,
    /// Values of the flags `--set KEY=VALUE`.
    pub set: Vec<String>,
    /// Values of the flags `--link NAME=PORT[,KEY=VALUE]..`.
    pub links: Vec<String>,
}

impl Sources {
    /// Returns the existing configuration files of the system: `/etc/scanhub/scanhub.toml`, and then
    /// `/etc/scanhub/conf.d/*.toml` in the order of their names.
    pub fn system() -> Vec<PathBuf> {
        let base = Path::new("/etc/scanhub");
        let mut files: Vec<_> =
            [base.join("scanhub.toml")].into_iter().filter(|file| file.exists()).collect();
        let entries = std::fs::read_dir(base.join("conf.d")).into_iter().flatten().flatten();
        let mut more: Vec<_> = entries.map(|entry| entry.path()).collect();
        more.retain(|path| path.extension().is_some_and(|extension| extension == "toml"));
        more.sort();
        files.extend(more);
        files
    }

    /// Reads each source once. Stops at the first source that cannot be read.
    pub fn read(&self) -> SourceMap {
        let mut map = SourceMap { text: String::new(), lines: vec![0], sources: Vec::new(), failure: None };
        map.failure = self.read_into(&mut map).err();
        map
    }

    fn read_into(&self, map: &mut SourceMap) -> Result<(), Failure> {
        for path in &self.files {
            let text = regular_file::read_text(path, regular_file::MAX_FILE_BYTES).map_err(|error| {
                let message = format!("{}: {error}", path.display());
                Failure::new(Kind::Input, message, "name a readable TOML file")
            })?;
            map.push(SourceKind::File, path.display().to_string(), &text);
        }
        for (kind, flag, toml, what, remedy) in self.flags() {
            let refuse = || Failure::new(Kind::Configuration, format!("{flag}: {what}"), remedy);
            let text = toml.ok_or_else(refuse)?;
            map.push(kind, flag, &text);
        }
        Ok(())
    }

    /// Returns each flag with its TOML, or with `None` if the flag is not valid, and with the problem and the remedy to
    /// report for an invalid flag.
    fn flags(&self) -> impl Iterator<Item = (SourceKind, String, Option<String>, &str, &str)> {
        let links = self.links.iter().map(|flag| {
            let remedy = "write --link NAME=PORT, for example front=/dev/ttyUSB0";
            (SourceKind::Link, format!("--link {flag}"), link_as_toml(flag), "no = in it", remedy)
        });
        links.chain(self.set.iter().map(|flag| {
            let remedy = "write --set link.NAME.KEY=VALUE, as link.front.angle=100, or for all links --set \
                          'zones.radii=[1.2,0.7]'";
            (SourceKind::Setting, format!("--set {flag}"), set_as_toml(flag), "not a setting", remedy)
        }))
    }
}

/// Type of a source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SourceKind {
    File,
    /// Flag `--link`.
    Link,
    /// Flag `--set`.
    Setting,
}

/// Text of all sources, one after the other. A position in this text determines the source, and the line and column in
/// that source.
pub struct SourceMap {
    text: String,
    /// Positions at which the lines start.
    lines: Vec<usize>,
    sources: Vec<Source>,
    /// Failure of the first source that could not be read.
    failure: Option<Failure>,
}

struct Source {
    kind: SourceKind,
    /// Path of the file, or the flag as given.
    name: String,
    /// Range of the text that comes from this source.
    span: Range<usize>,
}

impl SourceMap {
    fn push(&mut self, kind: SourceKind, name: String, text: &str) {
        let begin = self.text.len();
        self.text.push_str(text);
        self.sources.push(Source { kind, name, span: begin..self.text.len() });
        self.text.push('\n');
        self.lines.extend(self.text[begin..].match_indices('\n').map(|(end, _)| begin + end + 1));
    }

    /// Parses each source into a table, whose spans are positions in this text, and into a value of type `T`.
    ///
    /// Returns [`Kind::Configuration`] with place and remedy if a source is not valid TOML, or has an unknown key or a
    /// value of the wrong type. Returns [`Kind::Input`] if a source cannot be read.
    pub(crate) fn layers<T: DeserializeOwned>(&self) -> Result<Vec<(SourceKind, DeTable<'_>, T)>, Failure> {
        let mut layers = Vec::new();
        for Source { kind, span: Range { start: begin, end }, .. } in &self.sources {
            let table = DeTable::parse(&self.text[*begin..*end]);
            let table = table.map_err(|error| self.explain(&error, *begin))?.into_inner();
            let table = moved_table(table, *begin);
            layers.push((*kind, table.clone(), self.deserialize(table)?));
        }
        self.failure.clone().map_or(Ok(layers), Err)
    }

    /// Deserializes `table`.
    ///
    /// Returns [`Kind::Configuration`] with place and remedy if there is an unknown key or a value of the wrong type.
    pub(crate) fn deserialize<T: DeserializeOwned>(&self, table: DeTable<'_>) -> Result<T, Failure> {
        let begin = table.keys().map(|key| key.span().start).min().unwrap_or_default();
        let table = Spanned::new(begin..begin, DeValue::Table(table));
        T::deserialize(ValueDeserializer::from(table)).map_err(|error| self.explain(&error, 0))
    }

    /// Returns the index of the source that contains `span`.
    pub(crate) fn index(&self, span: &Range<usize>) -> usize {
        self.sources.partition_point(|source| source.span.start <= span.start).saturating_sub(1)
    }

    /// Returns the place of `span`: `FILE:LINE:COLUMN`, or the flag.
    pub(crate) fn location(&self, span: Range<usize>) -> String {
        let Source { kind, name, span: own } = &self.sources[self.index(&span)];
        if *kind != SourceKind::File {
            return name.clone();
        }
        let line = |at: usize| self.lines.partition_point(|&begin| begin <= at);
        let at = span.start.min(own.end);
        let column = self.text[self.lines[line(at) - 1]..at].chars().count() + 1;
        format!("{name}:{}:{column}", line(at) - line(own.start) + 1)
    }

    /// Returns the failure for an invalid value at `span`. `what` states the problem, `remedy` the valid values.
    pub(crate) fn refuse(
        &self,
        span: Range<usize>,
        what: impl std::fmt::Display,
        remedy: impl Into<String>,
    ) -> Failure {
        Failure::new(Kind::Configuration, format!("{}: {what}", self.location(span)), remedy)
    }

    /// Returns the failure for an error of the TOML parser. The parsed text starts at position `begin`. For an unknown
    /// key or word, the remedy suggests the most similar known key or word.
    fn explain(&self, error: &toml::de::Error, begin: usize) -> Failure {
        let span = error.span().unwrap_or_default();
        let span = span.start + begin..span.end + begin;
        let message = error.message();
        let names: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
        let unknown =
            [("unknown field", "unknown key", "Known"), ("unknown variant", "not possible:", "Possible")];
        let known_error = unknown.into_iter().find(|(prefix, ..)| message.starts_with(prefix));
        if let (Some((_, what, label)), [unknown, known @ ..]) = (known_error, &names[..]) {
            let is_here = |key: &&str| key.rsplit('.').next().is_some_and(|last| known.contains(&last));
            if let Some(new) = renamed(unknown).filter(is_here) {
                return self.refuse(span, format!("{what} `{unknown}`"), format!("its new name is `{new}`"));
            }
            let nearest = known
                .iter()
                .max_by(|a, b| strsim::jaro_winkler(a, unknown).total_cmp(&strsim::jaro_winkler(b, unknown)));
            let remedy = nearest.map_or(String::new(), |nearest| {
                format!("did you mean `{nearest}`? {label} here: {}", known.join(", "))
            });
            return self.refuse(span, format!("{what} `{unknown}`"), remedy);
        }
        self.mistyped(message, span.clone())
            .unwrap_or_else(|| self.refuse(span, message, "see docs/configuration.md"))
    }

    /// Returns the failure for a value of the wrong type, in terms of TOML instead of Rust types. Returns `None` for
    /// other errors.
    fn mistyped(&self, message: &str, span: Range<usize>) -> Option<Failure> {
        let (_, expected) = message.strip_prefix("invalid type: ")?.rsplit_once(", expected ")?;
        let value = self.text.get(span.clone())?;
        let key = self.text[..span.start].rsplit(['\n', '{', ',']).next()?.trim();
        let key = key.strip_suffix('=').map_or("", str::trim_end);
        let bare = value.trim_matches(['"', '\'']);
        if expected == "a sequence" && value.starts_with("[link") {
            let what = "[link] is one section, and there may be several links";
            return Some(self.refuse(span, what, "write [[link]], with two brackets"));
        }
        let (number_kind, remedy) = match expected {
            "a string" => ("text", format!("{key} = \"{bare}\", with quotes")),
            "a boolean" if ["true", "false"].contains(&bare) => ("a switch", without_quotes(key, bare)),
            "a boolean" => ("a switch", format!("{key} = true, or {key} = false")),
            "i64" | "f64" => {
                let wanted = if expected == "f64" { "a number" } else { "a whole number" };
                match bare.parse::<f64>() {
                    Ok(_) if bare != value => (wanted, without_quotes(key, bare)),
                    _ => (wanted, "see docs/configuration.md".to_owned()),
                }
            }
            "a sequence" => ("a list", format!("{key} = [{value}], with brackets")),
            _ => return None,
        };
        (!key.is_empty()).then(|| self.refuse(span, format!("{key} = {value} is not {number_kind}"), remedy))
    }
}

/// Moves all spans in `table` by `begin`.
fn moved_table(table: DeTable<'_>, begin: usize) -> DeTable<'_> {
    table.into_iter().map(|(key, value)| (moved(key, begin), moved_value(value, begin))).collect()
}

fn moved_value(value: Spanned<DeValue<'_>>, begin: usize) -> Spanned<DeValue<'_>> {
    let span = value.span();
    let value = match value.into_inner() {
        DeValue::Table(table) => DeValue::Table(moved_table(table, begin)),
        DeValue::Array(values) => {
            let mut array = DeArray::new();
            values.into_iter().for_each(|value| array.push(moved_value(value, begin)));
            DeValue::Array(array)
        }
        plain => plain,
    };
    moved(Spanned::new(span, value), begin)
}

fn moved<T>(value: Spanned<T>, begin: usize) -> Spanned<T> {
    let span = value.span();
    Spanned::new(span.start + begin..span.end + begin, value.into_inner())
}

/// Converts `link.NAME.KEY=VALUE`, or a key for all links such as `zones.margin=0.05`, to TOML. A value that is not
/// valid TOML becomes text.
fn set_as_toml(flag: &str) -> Option<String> {
    let (path, value) = flag.split_once('=')?;
    let (table, key) = path.split_once('.')?;
    let (head, key) = match (table, key.split_once('.')) {
        ("link", Some((name, key))) => (format!("[[link]]\nname = {}\n", quoted(name)), key),
        ("link", None) => return None,
        _ => (String::new(), path),
    };
    let is_key = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if key == "name" || key.split('.').any(|word| word.is_empty() || !word.chars().all(is_key)) {
        return None;
    }
    Some(format!("{head}{key} = {}", to_toml(value)))
}

/// Converts `NAME=PORT`, which may be followed by several `,KEY=VALUE`, to TOML.
fn link_as_toml(flag: &str) -> Option<String> {
    let (name, rest) = flag.split_once('=')?;
    let is_set = |part: &&str| {
        part.split_once('=')
            .is_some_and(|(key, _)| key.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c == '.'))
    };
    // The port may contain a comma, so only the parts at the end that have the form `KEY=VALUE` are keys.
    let parts: Vec<&str> = rest.split(',').collect();
    let set = parts.iter().rev().take_while(|part| is_set(part)).count().min(parts.len() - 1);
    let (port, set) = parts.split_at(parts.len() - set);
    let mut text = format!("[[link]]\nname = {}\nport = {}", quoted(name), quoted(&port.join(",")));
    for (key, value) in set.iter().filter_map(|part| part.split_once('=')) {
        text = format!("{text}\n{key} = {}", to_toml(value));
    }
    Some(text)
}

/// Converts `value` to TOML. A value that is not valid TOML becomes text.
fn to_toml(value: &str) -> String {
    match toml::from_str::<toml::Table>(&format!("v = {value}")) {
        Ok(table) if table.len() == 1 => value.to_owned(),
        _ => quoted(value),
    }
}

/// Converts `text` to a TOML string.
fn quoted(text: &str) -> String {
    let escaped: String = text
        .chars()
        .map(|c| match c {
            '"' | '\\' => format!("\\{c}"),
            c if c.is_control() => format!("\\u{:04X}", c as u32),
            c => c.to_string(),
        })
        .collect();
    format!("\"{escaped}\"")
}

fn without_quotes(key: &str, bare: &str) -> String {
    format!("{key} = {bare}, without quotes")
}
