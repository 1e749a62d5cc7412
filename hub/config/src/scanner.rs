//! Scanner of a link: its family and settings, as values in effect and as keys of the sources. The family checks the
//! settings, and this module adds the place where each setting is set.

use scanhub_drivers::{
    ANY_FAMILY, AUTO, Features, Key, Model, Refusal, Settings, SettingsRequest, Value, auto_or, family_of,
    features,
};
use scanhub_port::PortSpec;
use scanhub_schema::{Failure, Family};
use serde_json::Value as Json;
use toml::Spanned;
use toml::de::DeTable;

use crate::link::LinkKeys;
use crate::section::{Section, find};
use crate::sources::SourceMap;

/// Family and settings of a scanner.
#[derive(Clone, Debug)]
pub struct Scanner {
    /// Family of the scanner. `None` if the hub searches for the family.
    pub family: Option<Family>,
    /// Settings of the session, except those that follow from the port of the link.
    pub settings: Settings,
    /// Keys that determine the family: `family`, and keys that only one family has.
    pub named_by: Vec<&'static str>,
}

impl PartialEq for Scanner {
    /// Compares family and settings. The keys that determine the family are only used in messages.
    fn eq(&self, other: &Scanner) -> bool {
        (self.family, &self.settings) == (other.family, &other.settings)
    }
}

impl Eq for Scanner {}

impl Scanner {
    /// Returns the models and settings of the family, or of all families if the family is unknown.
    pub fn features(&self) -> &'static Features {
        self.family.map_or(&ANY_FAMILY, features)
    }

    /// Returns the configured model, or the defaults of the family if the session must detect the model.
    pub fn model(&self) -> Model {
        let features = self.features();
        let named = features.models.iter().find(|model| Some(model.name) == self.settings.model);
        named.copied().unwrap_or(features.defaults)
    }

    /// Returns whether the session must detect the model, which determines the number of beams.
    pub fn is_auto(&self) -> bool {
        let Settings { model, beams, .. } = self.settings;
        let has_models = self.family.is_none_or(|family| !features(family).models.is_empty());
        has_models && model.is_none() && beams.is_none()
    }

    /// Returns the number of beams of a scan, or the maximum number if the number is unknown.
    pub fn max_beams(&self) -> usize {
        let Some(beams) = self.settings.beams else { return self.model().beams };
        if self.family.is_some() {
            return beams;
        }
        // The scanner may belong to a family without a list of models, such as LMS. This family has its own number of
        // beams, which may be greater.
        let own = Family::ALL.into_iter().map(features).filter(|features| features.models.is_empty());
        own.map(|features| features.defaults.beams).max().unwrap_or(beams).max(beams)
    }

    /// Returns the baud rate at which a tty is opened, in bits per second.
    pub fn rate(&self) -> u32 {
        self.settings.baud.unwrap_or(self.model().baud)
    }

    /// Returns the highest baud rate that the scanner can have.
    fn max_rate(&self) -> u32 {
        let families =
            self.family.map_or(Family::ALL.to_vec(), |family| vec![family]).into_iter().map(features);
        let all = families.flat_map(|features| features.models.iter().chain([&features.defaults]));
        let all = all.map(|model| model.baud);
        if self.is_auto() { all.max().unwrap_or(self.rate()) } else { self.rate() }
    }

    /// Returns the highest baud rate that the scanner can have at `port`. The rate of a serial server is set on the
    /// server, so it may differ from the configured rate.
    pub fn max_rate_at(&self, port: &PortSpec) -> u32 {
        if matches!(port, PortSpec::Tty(_)) { self.rate() } else { self.max_rate() }
    }

    /// Returns the settings of a session at `port`. With `listen_only`, the session sends nothing to the scanner.
    pub fn settings_at(&self, port: &PortSpec, listen_only: bool) -> Settings {
        let fixed_rate = !matches!(port, PortSpec::Tty(_));
        let is_found = self.family.is_none() || self.settings.is_found;
        Settings { max_beams: Some(self.max_beams()), fixed_rate, listen_only, is_found, ..self.settings }
    }

    /// Returns the keys of settings that this scanner has, with their values.
    pub(crate) fn values(&self) -> impl Iterator<Item = (&'static str, Json)> {
        let has_models = !self.features().models.is_empty();
        let own = self.family.map_or(&[][..], |_| self.features().keys);
        let keys = Key::ALL.into_iter().filter(move |key| match key {
            Key::Beams => self.family.is_none() || has_models,
            Key::Model => self.family.is_some() && has_models,
            key => own.contains(key),
        });
        keys.map(|key| (key.name(), self.settings.value(key).map_or(Json::Null, json)))
    }

    /// Returns the names of the keys whose values differ in `other`.
    pub(crate) fn differences(&self, other: &Scanner) -> Vec<&'static str> {
        let is_other_family = self.family != other.family;
        let differs = |key: &Key| {
            // The defaults of these keys depend on the family, so a different value follows from the different family.
            let follows = is_other_family && matches!(key, Key::Angle | Key::Resolution);
            !follows && self.settings.value(*key) != other.settings.value(*key)
        };
        let family = is_other_family.then_some("family");
        let mut keys: Vec<_> =
            family.into_iter().chain(Key::ALL.into_iter().filter(differs).map(Key::name)).collect();
        keys.dedup();
        keys
    }
}

fn json(value: Value<'_>) -> Json {
    match value {
        Value::Text(text) | Value::Other(text) => text.into(),
        Value::Whole(number) => number.into(),
        Value::Number(number) => number.into(),
    }
}

/// Scanner that the keys of a link request, with the places where they are set.
pub(crate) struct ScannerRequest<'a> {
    /// Value of the key `family`, if it is set. `Some(None)` means `auto`.
    family: Option<Option<Family>>,
    request: SettingsRequest,
    table: &'a DeTable<'a>,
    sources: &'a SourceMap,
}

impl<'a> ScannerRequest<'a> {
    /// Creates the request from `keys`, which were read from `table`.
    ///
    /// Returns [`scanhub_schema::Kind::Configuration`] with place, value and remedy if a value is not valid for any
    /// scanner.
    pub(crate) fn of(
        keys: &LinkKeys,
        table: &'a DeTable<'a>,
        sources: &'a SourceMap,
    ) -> Result<ScannerRequest<'a>, Failure> {
        let span = |key: &str| find(table, key).map(Spanned::span).unwrap_or_default();
        let family = keys.family.as_ref().map(|name| match Family::parse(name) {
            None if !name.eq_ignore_ascii_case(AUTO) => {
                let names = auto_or(Family::ALL.into_iter().map(Family::name));
                Err(sources.refuse(span("family"), format!("family = \"{name}\""), names))
            }
            known => Ok(known),
        });
        let mut request = SettingsRequest::default();
        let values = keys.json();
        let mode = keys.mode.as_ref().map(ToString::to_string).unwrap_or_default();
        for key in Key::ALL {
            let value = match &values[key.name()] {
                Json::Null if find(table, key.name()).is_none() => continue,
                // JSON has neither NaN nor infinity, so these values are null.
                Json::Null if key.name() != "mode" => Value::Number(f64::NAN),
                Json::String(text) => Value::Text(text),
                Json::Number(number) => match (number.as_i64(), number.as_f64()) {
                    (Some(number), _) => Value::Whole(number),
                    (_, Some(number)) if key.name() != "mode" => Value::Number(number),
                    _ => Value::Other(&mode),
                },
                _ => Value::Other(&mode),
            };
            // Two settings have the key `mode`: a name for text, and a number for all other types.
            if (key == Key::ModeName) != matches!(value, Value::Text(_)) && key.name() == "mode" {
                continue;
            }
            request
                .set(key, value)
                .map_err(|Refusal { what, remedy, .. }| sources.refuse(span(key.name()), what, remedy))?;
        }
        Ok(ScannerRequest { family: family.transpose()?, request, table, sources })
    }

    /// Returns the place where the number of a measurement mode is set. Returns `None` if no number is set.
    pub(crate) fn mode_number_location(&self) -> Option<String> {
        self.request.mode_number?;
        self.location("mode")
    }

    /// Returns the scanner. `refuse` creates a failure from a place, a problem and a remedy. Without a place, `refuse`
    /// uses the place of the link.
    pub(crate) fn finish(
        &self,
        refuse: impl Fn(Option<String>, String, &str) -> Failure,
    ) -> Result<Scanner, Failure> {
        let refused = |Refusal { keys, what, remedy }: Refusal| {
            refuse(keys.iter().find_map(|key| self.location(key.name())), what, &remedy)
        };
        let set = self.family.flatten();
        let named = if set.is_some() { None } else { self.named_family(&refuse)? };
        let model = self.request.model.as_deref();
        match (model, set) {
            (Some(model), Some(family)) => {
                if let Some(implied) = family_of(model).filter(|implied| *implied != family) {
                    let [implied, family] = [implied.name(), family.name()];
                    let location = self.location("family").unwrap_or_default();
                    let what = format!(
                        "model = \"{model}\" belongs to family {implied}, but {location} sets {family}"
                    );
                    let remedy = format!("leave `family` out, or set family = \"{implied}\"");
                    return Err(refuse(self.location(Key::Model.name()), what, &remedy));
                }
            }
            (_, None) => self.request.check_model().map_err(refused)?,
            (None, Some(_)) => {}
        }
        let family = set.or(named);
        let settings = match family {
            Some(family) => self.request.check(family).map_err(refused)?,
            None => Settings { beams: self.request.beams, ..Settings::default() },
        };
        let keys = self.request.family_keys().map(|(key, ..)| key.name());
        let mut named_by: Vec<_> = set.map(|_| "family").into_iter().chain(keys).collect();
        named_by.dedup();
        Ok(Scanner { family, settings, named_by })
    }

    /// Returns the family whose own keys are set. Returns `None` if no key determines the family.
    fn named_family(
        &self,
        refuse: impl Fn(Option<String>, String, &str) -> Failure,
    ) -> Result<Option<Family>, Failure> {
        let mut all = self.request.family_keys();
        let Some((first_key, first, first_what)) = all.next() else { return Ok(None) };
        if let Some((key, other, what)) = all.find(|(_, other, _)| *other != first) {
            let what = format!(
                "{what} belongs to family {}, but {first_what} at {} belongs to family {}",
                other.name(),
                self.location(first_key.name()).unwrap_or_default(),
                first.name()
            );
            return Err(refuse(
                self.location(key.name()),
                what,
                "set only keys of the family that the scanner has",
            ));
        }
        Ok(Some(first))
    }

    /// Returns the place where `key` is set.
    fn location(&self, key: &str) -> Option<String> {
        find(self.table, key).map(|value| self.sources.location(value.span()))
    }
}
