//! The values in effect, each with the place where it was set. They are the values that the hub would use. For the
//! places, the sources are read again, key by key: the last source that has a key is its place.

use std::collections::BTreeMap;
use std::fmt;

use preprocess::background::{Candidate, Method, Start};
use preprocess::{lines, marks, motion, zones};
use scanhub_drivers::{AUTO, Settings};
use schema::limits::TopicLimits;
use schema::{Failure, Family, Pose};
use serde::Serialize;
use serde_json::{Value as Json, json};
use toml::de::{DeTable, DeValue};

use crate::gateway::Gateway;
use crate::link::{Config, Link};
use crate::processing::{Background, Zones};
use crate::sources::{Origin, Sources};

/// One value in effect.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Value {
    class: &'static str,
    /// Key, as `--set` takes it.
    pub key: String,
    /// Value in the units of the configuration; null if it is not set and has no default.
    pub value: Json,
    /// Place where it is set, `FILE:LINE:COLUMN` or a flag. Otherwise `default`, possibly with the value that it
    /// depends on.
    pub origin: String,
}

/// Returns all values of links, limits and gateway from `sources`.
///
/// Returns [`schema::Kind::Configuration`] with place, value and remedy if a value is not valid.
pub fn values(sources: &Sources) -> Result<Vec<Value>, Failure> {
    let (config, gateway) = (Config::load(sources)?, Gateway::load(sources)?);
    let mut list = List { places: ValueOrigins::of(sources)?, values: Vec::new() };
    for link in &config.links {
        list.link(link);
    }
    let TopicLimits { consumers, .. } = config.limits;
    list.put_general("limits.consumers", json!(consumers));
    list.gateway(&gateway);
    Ok(list.values)
}

struct List {
    places: ValueOrigins,
    values: Vec<Value>,
}

impl List {
    fn link(&mut self, link: &Link) {
        let Link { name, port, scanner, processing, .. } = link;
        let of = |key: &'static str| (name.as_str(), key);
        self.put(of("port"), json!(port.name()), DEFAULT);
        let features = scanner.features();
        let family = link.family();
        let origin = match (family, scanner.settings.model) {
            (None, _) => DEFAULT.to_owned(),
            (_, Some(model)) => format!("default of {model}"),
            _ => "follows from other keys".to_owned(),
        };
        self.put(of("family"), json!(family.map_or(AUTO, Family::name)), &origin);
        let settings = &scanner.settings;
        if family.is_none() {
            self.put(of("beams"), json!(settings.beams), DEFAULT);
        } else if features.models.is_empty() {
            self.reported(link);
        } else {
            self.put(of("model"), json!(scanner.model().name), DEFAULT);
            self.put(of("beams"), json!(settings.beams), DEFAULT);
            if !features.modes.is_empty() {
                self.put(of("mode"), json!(settings.mode.unwrap_or("auto")), DEFAULT);
            }
            if features.can_rest {
                let idle = if settings.stop_when_idle { "stop" } else { "run" };
                self.put(of("idle"), json!(idle), DEFAULT);
            }
        }
        let Pose { x_m, y_m, yaw_rad, upside_down, .. } = processing.pose;
        self.put(of("pose.x"), json!(x_m), DEFAULT);
        self.put(of("pose.y"), json!(y_m), DEFAULT);
        self.put(of("pose.yaw"), json!(yaw_rad), DEFAULT);
        self.put(of("pose.upside_down"), json!(upside_down != 0), DEFAULT);
        self.zones(name, &processing.zones);
        let marks::Settings { i_min, level, max_range_step_mm, max_gap } = processing.marks;
        if family.is_none_or(Family::has_reflector_levels) {
            self.put(of("marks.i_min"), json!(i_min), DEFAULT);
        }
        if family.is_none_or(|family| !family.has_reflector_levels()) {
            self.put(of("marks.level"), json!(level), DEFAULT);
        }
        self.put(of("marks.max_range_step"), json!(metres(max_range_step_mm)), DEFAULT);
        self.put(of("marks.max_gap"), json!(max_gap), DEFAULT);
        let lines::Settings { max, min_points, polish, stop: _ } = processing.lines;
        self.put(of("lines.max"), json!(max), DEFAULT);
        self.put(of("lines.min_points"), json!(min_points), DEFAULT);
        self.put(of("lines.polish"), json!(polish), DEFAULT);
        let motion::Settings { max_step_m, max_turn_deg, min_overlap } = processing.motion;
        self.put(of("motion.max_step"), json!(max_step_m), DEFAULT);
        self.put(of("motion.max_turn"), json!(max_turn_deg), DEFAULT);
        self.put(of("motion.min_overlap"), json!(min_overlap), DEFAULT);
        if features.has_whole_telegrams {
            self.put(of("early.pieces"), json!(processing.early.pieces), DEFAULT);
        }
        self.background(name, &processing.background);
    }

    /// Adds the settings of a scanner that reports its model.
    fn reported(&mut self, Link { name, scanner, .. }: &Link) {
        let of = |key: &'static str| (name.as_str(), key);
        let by_type = match scanner.settings.expected_type {
            Some(name) => format!("default of {name}"),
            None => DEFAULT.to_owned(),
        };
        let Settings { view, unit_mm, mode_number, baud, .. } = scanner.settings;
        let (angle_deg, resolution_cdeg) = view.unzip();
        self.put(of("type"), json!(scanner.settings.expected_type), DEFAULT);
        self.put(of("angle"), json!(angle_deg), &by_type);
        self.put(of("resolution"), json!(resolution_cdeg.map(|cdeg| f64::from(cdeg) / 100.0)), &by_type);
        self.put(of("unit"), json!(unit_mm.map(|mm| if mm == 1 { "mm" } else { "cm" })), DEFAULT);
        self.put(of("mode"), json!(mode_number), DEFAULT);
        self.put(of("baud"), json!(baud), DEFAULT);
    }

    fn zones(&mut self, link: &str, zones: &Zones) {
        let radii: Vec<f64> = zones.radii_mm.iter().copied().map(metres).collect();
        let sector = |sector: &zones::Sector| {
            let [from, to] = [sector.from_mdeg, sector.to_mdeg].map(|mdeg| f64::from(mdeg) / 1000.0);
            json!({ "from_deg": from, "to_deg": to, "range": metres(sector.range_mm) })
        };
        let self_min: Vec<Json> = zones.self_min.iter().map(sector).collect();
        self.put((link, "zones.radii"), json!(radii), DEFAULT);
        self.put((link, "zones.self_min"), json!(self_min), DEFAULT);
        self.put((link, "zones.margin"), json!(metres(zones.margin_mm)), DEFAULT);
        self.put((link, "zones.min_beams"), json!(zones.min_beams), DEFAULT);
        self.put((link, "zones.min_scans"), json!(zones.min_scans), DEFAULT);
        self.put((link, "zones.max_invalid"), json!(zones.max_invalid), DEFAULT);
        self.put((link, "zones.exact"), json!(zones.exact), DEFAULT);
        self.put((link, "zones.no_return_is_far"), json!(zones.no_return_is_far), DEFAULT);
    }

    fn background(&mut self, link: &str, background: &Background) {
        let learning = &background.learning;
        let method = match learning.method {
            _ if !background.is_kept => "off",
            Method::Moving => "moving",
            Method::Multi => "multi",
            Method::Paper => "paper",
        };
        let candidate = match learning.candidate {
            Candidate::First => "first",
            Candidate::Latest => "latest",
        };
        let start = match (&background.file, learning.start) {
            (Some(file), _) => file.display().to_string(),
            (None, Start::Empty) => "empty".to_owned(),
            (None, Start::FirstScan) => "first-scan".to_owned(),
        };
        let publish = if background.every_scan { "every-scan" } else { "on-demand" };
        // A value that is not set and follows from unit, resolution and method (docs/configuration.md) is null.
        self.put((link, "background.method"), json!(method), DEFAULT);
        self.put((link, "background.threshold_mm"), json!(learning.threshold_mm), DEFAULT);
        self.put((link, "background.candidate_mm"), json!(learning.candidate_mm), DEFAULT);
        self.put((link, "background.scans"), json!(learning.scans), DEFAULT);
        self.put((link, "background.candidate"), json!(candidate), DEFAULT);
        // If it is not set, the hub starts with the background that an earlier hub has saved, if that fits.
        let start = background.start_is_said.then_some(start);
        self.put((link, "background.start"), json!(start), DEFAULT);
        self.put((link, "background.keep"), json!(background.is_handed_on), DEFAULT);
        self.put((link, "background.no_return_is_far"), json!(learning.no_return_is_far), DEFAULT);
        self.put((link, "background.publish"), json!(publish), DEFAULT);
    }

    fn gateway(&mut self, gateway: &Gateway) {
        let Gateway { interface, topics, to, bare, key_file, ttl, background_every, mtu } = gateway;
        let every = background_every.as_ref().map(|(text, _)| text);
        for (key, value) in [
            ("gateway.interface", json!(interface)),
            ("gateway.topics", json!(topics)),
            ("gateway.to", json!(to.as_deref().unwrap_or_default())),
            ("gateway.bare", json!(bare.unwrap_or_default())),
            ("gateway.key_file", json!(key_file)),
            ("gateway.ttl", json!(ttl.unwrap_or(Gateway::TTL))),
            ("gateway.background_every", json!(every)),
            ("gateway.mtu", json!(mtu.unwrap_or(Gateway::MTU))),
        ] {
            self.put_general(key, value);
        }
    }

    /// Adds a value that does not belong to a link.
    fn put_general(&mut self, key: &str, value: Json) {
        let origin = self.places.of_key(key).unwrap_or(DEFAULT).to_owned();
        self.values.push(Value { class: CLASS, key: key.to_owned(), value, origin });
    }

    /// Adds a value of a link. `default` is its origin if no source sets it.
    fn put(&mut self, (link, key): (&str, &str), value: Json, default: &str) {
        let origin = self.places.of_link(link, key).unwrap_or(default).to_owned();
        self.values.push(Value { class: CLASS, key: format!("link.{link}.{key}"), value, origin });
    }
}

impl Value {
    /// Returns the value as it is written in a configuration; `-` for null.
    pub fn text(&self) -> String {
        TomlValue(&self.value).to_string()
    }
}

/// Formats JSON as the equivalent TOML.
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

fn metres(mm: u16) -> f64 {
    f64::from(mm) / 1000.0
}

const CLASS: &str = "value";
const DEFAULT: &str = "default";

/// Place of each key that is set, such as `link.front.zones.radii` and `zones.radii`.
pub(crate) struct ValueOrigins(BTreeMap<String, String>);

impl ValueOrigins {
    /// Reads `sources`.
    ///
    /// Returns [`schema::Kind::Configuration`] with place, value and remedy if a source is not valid.
    pub(crate) fn of(sources: &Sources) -> Result<ValueOrigins, Failure> {
        let mut places = ValueOrigins(BTreeMap::new());
        for said in sources.all() {
            let (origin, _) = said?;
            let table = DeTable::parse(origin.text()).map_err(|error| origin.explain(&error))?;
            places.note(table.get_ref(), "", &origin);
        }
        Ok(places)
    }

    /// Returns the last place where `key` of link `link` is set. A value for one link takes precedence over one for all
    /// links.
    pub(crate) fn of_link(&self, link: &str, key: &str) -> Option<&str> {
        self.of_key(&format!("link.{link}.{key}")).or_else(|| self.of_key(key))
    }

    /// Returns the last place where `key` is set.
    pub(crate) fn of_key(&self, key: &str) -> Option<&str> {
        self.0.get(key).map(String::as_str)
    }

    fn note(&mut self, table: &DeTable<'_>, path: &str, origin: &Origin) {
        for (key, value) in table.iter() {
            let path =
                if path.is_empty() { key.get_ref().to_string() } else { format!("{path}.{}", key.get_ref()) };
            match value.get_ref() {
                DeValue::Table(table) => self.note(table, &path, origin),
                DeValue::Array(links) if path == "link" => {
                    for table in links.iter().filter_map(|link| link.get_ref().as_table()) {
                        if let Some(name) = table.get("name").and_then(|name| name.get_ref().as_str()) {
                            self.note(table, &format!("link.{name}"), origin);
                        }
                    }
                }
                _ => drop(self.0.insert(path, origin.place(Some(value.span())))),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_written_as_a_configuration_says_it() {
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
