//! Where a configuration value comes from, so that an error can say it: a file with line and column, or a flag.

use std::ops::Range;
use std::path::{Path, PathBuf};

use schema::{Failure, Kind};

use crate::config::LINKS;

/// One source of values with its text.
#[derive(Clone, Debug)]
pub(crate) enum Origin {
    /// A TOML file.
    File { path: PathBuf, text: String },
    /// A flag of the command line, as given, and as TOML.
    Flag { flag: String, text: String },
    /// The program's own links.
    Default,
}

impl Origin {
    /// Reads a file.
    ///
    /// [`Kind::Configuration`] if it cannot be read.
    pub(crate) fn read(path: &Path) -> Result<Origin, Failure> {
        let text = std::fs::read_to_string(path).map_err(|error| {
            let message = format!("{}: {error}", path.display());
            Failure::new(Kind::Configuration, message, "name a readable TOML file")
        })?;
        Ok(Origin::File { path: path.to_owned(), text })
    }

    /// What stands in it, as TOML.
    pub(crate) fn text(&self) -> &str {
        match self {
            Origin::File { text, .. } | Origin::Flag { text, .. } => text,
            Origin::Default => LINKS,
        }
    }

    /// The place of `span` in this source: `FILE:LINE:COLUMN`, or the flag.
    pub(crate) fn place(&self, span: Option<Range<usize>>) -> String {
        match (self, span) {
            (Origin::File { path, text }, Some(span)) => {
                let before = &text[..span.start.min(text.len())];
                let line = before.matches('\n').count() + 1;
                let column = before.chars().rev().take_while(|&c| c != '\n').count() + 1;
                format!("{}:{line}:{column}", path.display())
            }
            (Origin::File { path, .. }, None) => path.display().to_string(),
            (Origin::Flag { flag, .. }, _) => flag.clone(),
            (Origin::Default, _) => "default configuration".to_owned(),
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
        self.refuse(error.span(), message, "see docs/configuration.md")
    }
}
