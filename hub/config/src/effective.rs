//! Values in effect, which are those that the hub would use. Each value has the place where it is set.

use std::fmt;

use scanhub_drivers::AUTO;
use scanhub_schema::{Failure, Family};
use serde::Serialize;
use serde_json::{Value as Json, json};

use crate::gateway::{Gateway, LimitsKeys};
use crate::link::{Link, LinkKeys};
use crate::load::{MergedConfig, MergedLink};
use crate::processing::has_key;
use crate::section::{Key, Section};
use crate::sources::Sources;

/// One value in effect.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Value {
    class: &'static str,
    /// Key, as `--set` takes it.
    pub key: String,
    /// Value in the unit of the configuration. Null if the key is not set and has no default.
    pub value: Json,
    /// Place where the value is set: `FILE:LINE:COLUMN` or a flag. If the value is not set, the origin is `default`,
    /// possibly with the setting that determines the default.
    pub origin: String,
}

/// Returns all values of links, limits and gateway from `sources`.
///
/// # Errors
///
/// Returns [`scanhub_schema::Kind::Configuration`] with place, value and remedy if a value is not valid.
pub fn values(sources: &Sources) -> Result<Vec<Value>, Failure> {
    let sources = sources.read();
    let merged = MergedConfig::of(&sources)?;
    let config = merged.config()?;
    let gateway = merged.gateway()?;
    let limits: LimitsKeys = merged.section("limits")?;
    let of_links =
        config.links.iter().zip(&merged.links).flat_map(|(link, keys)| of_link(&merged, link, keys));
    let general = [("limits", limits.values()), ("gateway", gateway.effective_values())];
    let general = general.into_iter().flat_map(|(section, values)| {
        values.into_iter().map(move |(key, value)| (format!("{section}.{key}"), value))
    });
    let general = general.map(|(key, value)| {
        let origin = merged.location(&key).unwrap_or_else(|| DEFAULT.to_owned());
        Value { class: CLASS, key, value, origin }
    });
    Ok(of_links.chain(general).collect())
}

/// Returns the values of one link.
fn of_link(merged: &MergedConfig<'_>, link: &Link, merged_link: &MergedLink<'_>) -> Vec<Value> {
    let Link { name, port, scanner, .. } = link;
    let family = link.family();
    let mut values = vec![
        ("port".to_owned(), json!(port.name())),
        ("family".to_owned(), json!(family.map_or(AUTO, Family::name))),
    ];
    values.extend(scanner.values().map(|(key, value)| (key.to_owned(), value)));
    for (section, keys) in merged_link.keys.sections() {
        let keys = keys.values().into_iter().map(|(key, value)| (format!("{section}.{key}"), value));
        values.extend(keys.filter(|(key, _)| has_key(family, key)));
    }
    let default = |key: &str| match (key, scanner.settings.model, scanner.settings.expected_type) {
        ("family", _, _) if family.is_none() => DEFAULT.to_owned(),
        ("family", Some(model), _) => format!("default of {model}"),
        ("family", None, _) => "follows from other keys".to_owned(),
        ("angle" | "resolution", _, Some(of_type)) => format!("default of {of_type}"),
        _ => DEFAULT.to_owned(),
    };
    let value = |(key, value): (String, Json)| {
        let origin = merged.location_of(merged_link, &key).unwrap_or_else(|| default(&key));
        Value { class: CLASS, key: format!("link.{name}.{key}"), value, origin }
    };
    values.into_iter().map(value).collect()
}

/// Returns the keys of a link, and the keys of each section under the name of the section. Each key has its default
/// value as TOML, or `-` if it has no default.
pub fn keys() -> Vec<(&'static str, Vec<(Key, String)>)> {
    let (link, limits, gateway) = (LinkKeys::default(), LimitsKeys::default(), Gateway::default());
    let keys_of = |section: &dyn Section, values: Vec<(&str, Json)>| {
        let defaults = values.into_iter().map(|(_, value)| TomlValue(&value).to_string());
        section.keys().iter().copied().zip(defaults).collect()
    };
    let mut all = vec![("link", keys_of(&link, link.values()))];
    all.extend(link.sections().map(|(name, section)| (name, keys_of(section, section.values()))));
    all.extend([
        ("limits", keys_of(&limits, limits.values())),
        ("gateway", keys_of(&gateway, gateway.effective_values())),
    ]);
    all
}

impl Value {
    /// Returns the value as it is written in a configuration. Returns `-` for null.
    pub fn text(&self) -> String {
        TomlValue(&self.value).to_string()
    }
}

/// Wrapper that displays JSON as the equivalent TOML.
struct TomlValue<'a>(&'a Json);

impl fmt::Display for TomlValue<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Json::Null => f.write_str("-"),
            Json::Array(values) => {
                let values: Vec<_> = values.iter().map(|value| TomlValue(value).to_string()).collect();
                write!(f, "[{}]", values.join(", "))
            }
            Json::Object(keys) => {
                let keys: Vec<_> =
                    keys.iter().map(|(key, value)| format!("{key} = {}", TomlValue(value))).collect();
                write!(f, "{{ {} }}", keys.join(", "))
            }
            plain => plain.fmt(f),
        }
    }
}

const CLASS: &str = "value";
const DEFAULT: &str = "default";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_formatted_as_toml() {
        let written = |value: Json| TomlValue(&value).to_string();
        assert_eq!(written(json!("a \"b\"")), "\"a \\\"b\\\"\"");
        assert_eq!(written(json!([1.0, 0.6])), "[1.0, 0.6]");
        assert_eq!(
            written(json!([{ "from_deg": -1.5, "to_deg": 2.0 }])),
            "[{ from_deg = -1.5, to_deg = 2.0 }]"
        );
        assert_eq!((written(json!(null)), written(json!(true))), ("-".to_owned(), "true".to_owned()));
    }
}
