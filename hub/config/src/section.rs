//! Sections of the configuration. Each section is a struct that the macro [`section!`] declares. Each field is a key,
//! with its description, its default and its check.
//!
//! To add a key, add a field and the code that uses it. Then let the generator write the default configuration and the
//! page again (`hub/config/tests/reference.rs`). A key of a scanner also needs an entry in
//! `hub/drivers/src/settings.rs`.

use std::borrow::Borrow;
use std::ops::RangeInclusive;

use scanhub_schema::Failure;
use serde_json::Value as Json;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::sources::SourceMap;

/// Declares a section as a struct that serde reads and writes.
///
/// The first paragraph of a key's description is its comment in the default configuration. The other paragraphs are for
/// `docs/configuration.md`. A key without a default has an `example`.
macro_rules! section {
    (
        $(#[doc = $about:literal])+
        $vis:vis struct $section:ident: $expecting:literal {
            $(
                $(#[doc = $doc:literal])+
                $field:ident $(($name:literal))?: $type:ty = $default:expr
                    $(, check $check:expr)? $(, example $example:literal)?;
            )+
        }
    ) => {
        $(#[doc = $about])+
        #[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
        #[serde(default, deny_unknown_fields, expecting = $expecting)]
        $vis struct $section {
            $($(#[doc = $doc])+ $(#[serde(rename = $name)])? $vis $field: $type,)+
        }

        impl Default for $section {
            fn default() -> Self {
                $section { $($field: $default),+ }
            }
        }

        impl $crate::section::Section for $section {
            fn keys(&self) -> &'static [$crate::section::Key] {
                &[$($crate::section::Key {
                    name: [$($name,)? stringify!($field)][0],
                    text: concat!($($doc, "\n"),+),
                    example: [$($example,)? ""][0],
                }),+]
            }

            fn json(&self) -> serde_json::Value {
                serde_json::to_value(self).unwrap_or_default()
            }

            fn find_invalid(&self) -> Option<(&'static str, $crate::section::InvalidValue)> {
                $($(
                    let name = stringify!($field);
                    if let Err(refused) = ($check)(name, &self.$field) {
                        return Some((name, refused));
                    }
                )?)+
                None
            }
        }
    };
}
pub(crate) use section;

/// Key of a section.
#[derive(Clone, Copy, Debug)]
pub struct Key {
    /// Name of the key.
    pub name: &'static str,
    /// Description of the key, as lines of a doc comment. The first paragraph is short.
    pub text: &'static str,
    /// Example for a key without a default, as TOML. Empty if the key has a default.
    pub example: &'static str,
}

/// Description of a value that is not valid.
#[derive(Debug)]
pub(crate) struct InvalidValue {
    what: String,
    remedy: String,
    /// Index of the invalid element, if the value is a list.
    at: Option<usize>,
}

/// Result of a check of one value.
pub(crate) type CheckResult = Result<(), InvalidValue>;

pub(crate) trait Section {
    /// Returns the keys of the section in their order.
    fn keys(&self) -> &'static [Key];

    /// Returns all values of the section as one JSON object.
    fn json(&self) -> Json;

    /// Returns the first key whose value is not valid, with the reason.
    fn find_invalid(&self) -> Option<(&'static str, InvalidValue)>;

    /// Returns the keys with their values, in their order.
    fn values(&self) -> Vec<(&'static str, Json)> {
        let json = self.json();
        self.keys().iter().map(|key| (key.name, json[key.name].clone())).collect()
    }

    /// Checks the values, which were read from `table`.
    ///
    /// Returns [`scanhub_schema::Kind::Configuration`] with place, value and remedy if a value is not valid.
    fn check(&self, table: &DeTable<'_>, sources: &SourceMap) -> Result<(), Failure> {
        let Some((key, InvalidValue { what, remedy, at })) = self.find_invalid() else { return Ok(()) };
        let list = find(table, key);
        let element = || list?.get_ref().as_array()?.get(at?);
        let span = element().or(list).map(Spanned::span).unwrap_or_default();
        Err(sources.refuse(span, what, remedy))
    }
}

/// Returns the value at `path` in `table`. A path is a key, or a section and a key such as `zones.margin`.
pub(crate) fn find<'t, 'i>(table: &'t DeTable<'i>, path: &str) -> Option<&'t Spanned<DeValue<'i>>> {
    match path.split_once('.') {
        None => table.get(path),
        Some((section, rest)) => find(table.get(section)?.get_ref().as_table()?, rest),
    }
}

/// Creates the description of a value that is not valid. `remedy` states the valid values.
pub(crate) fn invalid_value(what: impl Into<String>, remedy: impl Into<String>) -> InvalidValue {
    InvalidValue { what: what.into(), remedy: remedy.into(), at: None }
}

/// Returns a check for a number in the range `allowed`. `remedy` states the range.
pub(crate) fn within(allowed: RangeInclusive<f64>, remedy: &str) -> impl Fn(&str, &f64) -> CheckResult {
    // NaN is not in any range.
    move |key, value| match allowed.contains(value) {
        true => Ok(()),
        false => Err(invalid_value(format!("{key} = {value}"), remedy)),
    }
}

/// Returns a check for a length in meters.
pub(crate) fn meters(allowed: RangeInclusive<f64>) -> impl Fn(&str, &f64) -> CheckResult {
    let remedy = format!("meters, from {} to {}", allowed.start(), allowed.end());
    move |key, value| within(allowed.clone(), &remedy)(key, value)
}

/// Returns a check for a whole number.
pub(crate) fn whole(allowed: RangeInclusive<i64>) -> impl Fn(&str, &i64) -> CheckResult {
    let remedy = format!("a whole number from {} to {}", allowed.start(), allowed.end());
    whole_or(allowed, remedy)
}

/// Returns a check for a whole number that has its own `remedy`.
pub(crate) fn whole_or(allowed: RangeInclusive<i64>, remedy: String) -> impl Fn(&str, &i64) -> CheckResult {
    move |key, value| match allowed.contains(value) {
        true => Ok(()),
        false => Err(invalid_value(format!("{key} = {value}"), &remedy)),
    }
}

/// Returns a check for an optional value. A missing value is valid.
pub(crate) fn optional<T: Borrow<U>, U: ?Sized>(
    check: impl Fn(&str, &U) -> CheckResult,
) -> impl Fn(&str, &Option<T>) -> CheckResult {
    move |key, value| value.as_ref().map_or(Ok(()), |value| check(key, value.borrow()))
}

/// Returns a check for every element of a list.
pub(crate) fn each<T>(check: impl Fn(&str, &T) -> CheckResult) -> impl Fn(&str, &[T]) -> CheckResult {
    move |key, values| {
        let checked =
            |(at, value)| check(key, value).map_err(|invalid| InvalidValue { at: Some(at), ..invalid });
        values.iter().enumerate().try_for_each(checked)
    }
}
