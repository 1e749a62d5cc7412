//! Where a value is in the file of a world, so that a failure can name it: file, line and column. Knows no keys.

use std::ops::{Range, RangeInclusive};

use schema::{Failure, Kind};
use toml::Spanned;

/// A file with the name that failures call it.
pub(crate) struct Origin<'a> {
    pub(crate) name: &'a str,
    pub(crate) text: &'a str,
}

impl Origin<'_> {
    /// A value within `allowed`, or `usual` where none is said.
    pub(crate) fn number(
        &self,
        value: &Option<Spanned<f64>>,
        usual: f64,
        allowed: RangeInclusive<f64>,
    ) -> Result<f64, Failure> {
        match value {
            None => Ok(usual),
            Some(value) if allowed.contains(value.get_ref()) => Ok(*value.get_ref()),
            Some(value) => {
                let remedy = format!("a number from {} to {}", allowed.start(), allowed.end());
                Err(self.refuse(value.span(), format!("{} is out of range", value.get_ref()), remedy))
            }
        }
    }

    /// From when until when something is there: without words for ever.
    pub(crate) fn interval(
        &self,
        from: &Option<Spanned<f64>>,
        until: &Option<Spanned<f64>>,
    ) -> Result<(f64, f64), Failure> {
        let from_s = self.number(from, 0.0, 0.0..=1e6)?;
        let until_s = self.number(until, f64::INFINITY, 0.0..=1e6)?;
        match until {
            Some(until) if until_s <= from_s => {
                let what = format!("until_s = {until_s}, and from_s = {from_s}");
                Err(self.refuse(until.span(), what, "an end after the start"))
            }
            _ => Ok((from_s, until_s)),
        }
    }

    /// A value at `span` that cannot be: `what` it is, `remedy` what could be.
    pub(crate) fn refuse(
        &self,
        span: Range<usize>,
        what: impl std::fmt::Display,
        remedy: impl Into<String>,
    ) -> Failure {
        let before = &self.text[..span.start.min(self.text.len())];
        let line = before.matches('\n').count() + 1;
        let column = before.chars().rev().take_while(|&c| c != '\n').count() + 1;
        Failure::new(Kind::Configuration, format!("{}:{line}:{column}: {what}", self.name), remedy)
    }

    /// What the TOML parser found wrong; of an unknown key the nearest known one.
    pub(crate) fn explain(&self, error: &toml::de::Error) -> Failure {
        let (span, message) = (error.span().unwrap_or_default(), error.message());
        let names: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
        match names[..] {
            [unknown, ref known @ ..] if message.starts_with("unknown field") => {
                let likeness = |name: &str| strsim::jaro_winkler(name, unknown);
                let nearest = known.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)));
                let nearest = nearest.map_or(String::new(), |name| format!("did you mean `{name}`? "));
                let remedy = format!("{nearest}Known here: {}", known.join(", "));
                self.refuse(span, format!("unknown key `{unknown}`"), remedy)
            }
            _ => self.refuse(span, message, "docs/worlds.md has the keys and their forms"),
        }
    }
}
