//! Where a configuration value comes from, so that an error can name it: a file with line and column, or a flag.

use std::ops::Range;
use std::path::{Path, PathBuf};

use schema::{Failure, Kind, regular};

/// One source of values with its text.
#[derive(Clone, Debug)]
pub(crate) enum Origin {
    /// A TOML file, and where its lines begin.
    File { path: PathBuf, text: String, lines: Vec<usize> },
    /// A flag of the command line, as given, and as TOML.
    Flag { flag: String, text: String },
}

impl Origin {
    /// Reads a file.
    ///
    /// [`Kind::Input`] if it cannot be read.
    pub(crate) fn read(path: &Path) -> Result<Origin, Failure> {
        let text = regular::read_text(path, regular::LONGEST).map_err(|error| {
            let message = format!("{}: {error}", path.display());
            Failure::new(Kind::Input, message, "name a readable TOML file")
        })?;
        let lines = std::iter::once(0).chain(text.match_indices('\n').map(|(end, _)| end + 1)).collect();
        Ok(Origin::File { path: path.to_owned(), text, lines })
    }

    /// What stands in it, as TOML.
    pub(crate) fn text(&self) -> &str {
        match self {
            Origin::File { text, .. } | Origin::Flag { text, .. } => text,
        }
    }

    /// The place of `span` in this source: `FILE:LINE:COLUMN`, or the flag.
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

    /// A value at `span` that cannot be: `what` it is, `remedy` what could be.
    pub(crate) fn refuse(
        &self,
        span: Option<Range<usize>>,
        what: impl std::fmt::Display,
        remedy: impl Into<String>,
    ) -> Failure {
        Failure::new(Kind::Configuration, format!("{}: {what}", self.place(span)), remedy)
    }

    /// What the TOML parser found wrong; of an unknown key or word the nearest known one.
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

    /// A value of another type than its key has, in words that need no knowledge of the program's own types.
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
