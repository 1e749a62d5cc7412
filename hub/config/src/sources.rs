//! The sources of a configuration: files and flags, one layer each, and the place of each value in them, so that an
//! error can name file, line and column, or the flag. `load.rs` combines the layers.

use std::ops::Range;
use std::path::{Path, PathBuf};

use scanhub_files::regular;
use schema::{Failure, Kind};

use crate::layer::{Layer, link_as_toml, parse, set_as_toml};

/// A layer and its origin.
type SourceLayer = Result<(Origin, Layer), Failure>;

/// Sources of values, in addition to the defaults.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    /// Files in their order; each must exist.
    pub files: Vec<PathBuf>,
    /// `--set KEY=VALUE`, as given.
    pub set: Vec<String>,
    /// `--link NAME=PORT[,KEY=VALUE]..`, as given.
    pub links: Vec<String>,
}

impl Sources {
    /// Returns the system's files that exist: `/etc/scanhub/scanhub.toml`, then `/etc/scanhub/conf.d/*.toml` in the
    /// order of their names.
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

    /// Reads the files one by one.
    pub(crate) fn files(&self) -> impl Iterator<Item = SourceLayer> {
        self.files.iter().map(|path| {
            let origin = Origin::read(path)?;
            let layer = parse(&origin)?;
            Ok((origin, layer))
        })
    }

    /// Parses the links of the command line.
    pub(crate) fn links(&self) -> impl Iterator<Item = SourceLayer> {
        self.links.iter().map(|flag| {
            let remedy = "write --link NAME=PORT, for example front=/dev/ttyUSB0";
            of_flag(format!("--link {flag}"), link_as_toml(flag), "no = in it", remedy)
        })
    }

    /// Parses the single values of the command line.
    pub(crate) fn settings(&self) -> impl Iterator<Item = SourceLayer> {
        self.set.iter().map(|flag| {
            let remedy = "write --set link.NAME.KEY=VALUE, as link.front.angle=100, or for all links --set \
                          'zones.radii=[1.2,0.7]'";
            of_flag(format!("--set {flag}"), set_as_toml(flag), "not a setting", remedy)
        })
    }

    /// Returns all layers. A later one takes precedence.
    pub(crate) fn all(&self) -> impl Iterator<Item = SourceLayer> {
        self.files().chain(self.links()).chain(self.settings())
    }
}

/// Parses `text`, the TOML of a flag. Refuses the flag if there is none.
fn of_flag(flag: String, text: Option<String>, what: &str, remedy: &str) -> SourceLayer {
    let is_none = text.is_none();
    let origin = Origin::Flag { flag, text: text.unwrap_or_default() };
    if is_none {
        return Err(origin.refuse(None, what, remedy));
    }
    let layer = parse(&origin)?;
    Ok((origin, layer))
}

/// One source of values with its text.
#[derive(Clone, Debug)]
pub(crate) enum Origin {
    /// A TOML file, and the offsets of its lines.
    File { path: PathBuf, text: String, lines: Vec<usize> },
    /// A flag of the command line, as given and as TOML.
    Flag { flag: String, text: String },
}

impl Origin {
    /// Reads a file.
    ///
    /// Returns [`Kind::Input`] if it cannot be read.
    pub(crate) fn read(path: &Path) -> Result<Origin, Failure> {
        let text = regular::read_text(path, regular::LONGEST).map_err(|error| {
            let message = format!("{}: {error}", path.display());
            Failure::new(Kind::Input, message, "name a readable TOML file")
        })?;
        let lines = std::iter::once(0).chain(text.match_indices('\n').map(|(end, _)| end + 1)).collect();
        Ok(Origin::File { path: path.to_owned(), text, lines })
    }

    /// Returns its text, as TOML.
    pub(crate) fn text(&self) -> &str {
        match self {
            Origin::File { text, .. } | Origin::Flag { text, .. } => text,
        }
    }

    /// Returns the place of `span` in this source: `FILE:LINE:COLUMN`, or the flag.
    pub(crate) fn place(&self, span: Option<Range<usize>>) -> String {
        match (self, span) {
            (Origin::File { path, text, lines }, Some(span)) => {
                let at = span.start.min(text.len());
                let line = lines.partition_point(|&begin| begin <= at);
                let column = text[lines[line - 1]..at].chars().count() + 1;
                format!("{}:{line}:{column}", path.display())
            }
            (Origin::File { path, .. }, None) => path.display().to_string(),
            (Origin::Flag { flag, .. }, _) => flag.clone(),
        }
    }

    /// Returns the failure for an invalid value at `span`. `what` states the problem, `remedy` the valid values.
    pub(crate) fn refuse(
        &self,
        span: Option<Range<usize>>,
        what: impl std::fmt::Display,
        remedy: impl Into<String>,
    ) -> Failure {
        Failure::new(Kind::Configuration, format!("{}: {what}", self.place(span)), remedy)
    }

    /// Returns the failure for an error of the TOML parser. For an unknown key or word, it suggests the nearest known
    /// one.
    pub(crate) fn explain(&self, error: &toml::de::Error) -> Failure {
        let message = error.message();
        let names: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
        let unknown =
            [("unknown field", "unknown key", "Known"), ("unknown variant", "not possible:", "Possible")];
        let said = unknown.into_iter().find(|(said, ..)| message.starts_with(said));
        if let (Some((_, what, those)), [unknown, known @ ..]) = (said, &names[..]) {
            let nearest = known
                .iter()
                .max_by(|a, b| strsim::jaro_winkler(a, unknown).total_cmp(&strsim::jaro_winkler(b, unknown)));
            let remedy = nearest.map_or(String::new(), |nearest| {
                format!("did you mean `{nearest}`? {those} here: {}", known.join(", "))
            });
            return self.refuse(error.span(), format!("{what} `{unknown}`"), remedy);
        }
        if let Some(failure) = self.mistyped(message, error.span()) {
            return failure;
        }
        self.refuse(error.span(), message, "see docs/configuration.md")
    }

    /// Returns the failure for a value of the wrong type, in terms of TOML instead of the program's own types.
    fn mistyped(&self, message: &str, span: Option<Range<usize>>) -> Option<Failure> {
        let (_, expected) = message.strip_prefix("invalid type: ")?.rsplit_once(", expected ")?;
        let value = self.text().get(span.clone()?)?;
        let key = self.text()[..span.as_ref()?.start].rsplit(['\n', '{', ',']).next()?.trim();
        let key = key.strip_suffix('=').map_or("", str::trim_end);
        let bare = value.trim_matches(['"', '\'']);
        if expected == "a sequence" && value.starts_with("[link") {
            let what = "[link] is one section, and there may be several links";
            return Some(self.refuse(span, what, "write [[link]], with two brackets"));
        }
        let (wanted, remedy) = match expected {
            "a string" => ("text", format!("{key} = \"{bare}\", with quotes")),
            "a boolean" if ["true", "false"].contains(&bare) => ("a switch", without_quotes(key, bare)),
            "a boolean" => ("a switch", format!("{key} = true, or {key} = false")),
            "u8" | "u32" | "i64" | "usize" | "f64" => {
                let wanted = if expected == "f64" { "a number" } else { "a whole number" };
                match bare.parse::<f64>() {
                    Ok(_) if bare != value => (wanted, without_quotes(key, bare)),
                    _ => (wanted, "see docs/configuration.md".to_owned()),
                }
            }
            "a sequence" => ("a list", format!("{key} = [{value}], with brackets")),
            _ => return None,
        };
        (!key.is_empty()).then(|| self.refuse(span, format!("{key} = {value} is not {wanted}"), remedy))
    }
}

fn without_quotes(key: &str, bare: &str) -> String {
    format!("{key} = {bare}, without quotes")
}
