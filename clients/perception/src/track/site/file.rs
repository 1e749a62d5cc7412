//! Site files: TOML, with the place of every value for errors. Refuses to know whether the plan makes sense.

use std::ops::Range;

use scanhub_schema::{Failure, Kind};
use serde::Deserialize;
use toml::Spanned;

use super::{Site, check};
use crate::track::geometry::Point;

/// A file's text and the name that errors call it by.
pub(super) struct Source<'a> {
    pub(super) name: &'a str,
    pub(super) text: &'a str,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct File {
    #[serde(default)]
    pub(super) sensor: Vec<SensorEntry>,
    #[serde(default)]
    pub(super) room: Vec<RoomEntry>,
    #[serde(default)]
    pub(super) door: Vec<DoorEntry>,
    #[serde(default)]
    pub(super) gap: Vec<GapEntry>,
    #[serde(default)]
    pub(super) ignore: Vec<IgnoreEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SensorEntry {
    pub(super) name: Spanned<String>,
    pub(super) pose: Spanned<PoseEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PoseEntry {
    pub(super) x: f64,
    pub(super) y: f64,
    pub(super) yaw: f64,
    #[serde(default)]
    pub(super) upside_down: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RoomEntry {
    pub(super) name: Spanned<String>,
    pub(super) polygon: Spanned<Vec<Point>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DoorEntry {
    pub(super) name: Spanned<String>,
    pub(super) from: Spanned<String>,
    pub(super) to: Spanned<String>,
    pub(super) between: Spanned<[Point; 2]>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct GapEntry {
    pub(super) between: Spanned<[Spanned<String>; 2]>,
    pub(super) seconds: Spanned<[f64; 2]>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct IgnoreEntry {
    pub(super) name: Spanned<String>,
    pub(super) polygon: Spanned<Vec<Point>>,
}

impl Site {
    /// Returns the site that `text` describes; errors call it `name`.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`] with place, value and remedy.
    ///
    /// # Examples
    ///
    /// ```
    /// let text = r#"
    ///     [[sensor]]
    ///     name = "front"
    ///     pose = { x = 0.0, y = 2.0, yaw = 0.0 }
    ///     [[room]]
    ///     name = "hall"
    ///     polygon = [[0, 0], [5, 0], [5, 4], [0, 4]]
    /// "#;
    /// let site = scanhub_perception::track::Site::parse("hall.toml", text)?;
    /// assert_eq!(site.room_at([1.0, 1.0]), Some(0));
    /// # Ok::<(), scanhub_schema::Failure>(())
    /// ```
    pub fn parse(name: &str, text: &str) -> Result<Site, Failure> {
        let source = Source { name, text };
        let file: File = toml::from_str(text).map_err(|error| source.explain(&error))?;
        check::check(&source, &file)
    }
}

impl Source<'_> {
    /// A value that cannot be: `what` it is, `remedy` what could be.
    pub(super) fn refuse(
        &self,
        span: Option<Range<usize>>,
        what: impl std::fmt::Display,
        remedy: impl Into<String>,
    ) -> Failure {
        let place = match span {
            Some(span) => {
                let before = &self.text[..span.start.min(self.text.len())];
                let line = before.matches('\n').count() + 1;
                let column = before.rsplit('\n').next().unwrap_or_default().chars().count() + 1;
                format!("{}:{line}:{column}", self.name)
            }
            None => self.name.to_owned(),
        };
        Failure::new(Kind::Configuration, format!("{place}: {what}"), remedy)
    }

    fn explain(&self, error: &toml::de::Error) -> Failure {
        let message = error.message();
        let names: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
        if let (true, [unknown, known @ ..]) = (message.starts_with("unknown field"), &names[..]) {
            let remedy = format!("{}Known here: {}", nearest(unknown, known), known.join(", "));
            return self.refuse(error.span(), format!("unknown key `{unknown}`"), remedy);
        }
        self.refuse(error.span(), message, "see docs/tracks.md")
    }
}

/// Asks whether the nearest of `known` was meant; nothing if there is none.
pub(super) fn nearest(word: &str, known: &[&str]) -> String {
    let near = |a: &str| strsim::jaro_winkler(a, word);
    let best = known.iter().max_by(|a, b| near(a).total_cmp(&near(b)));
    best.map_or(String::new(), |best| format!("did you mean `{best}`? "))
}
