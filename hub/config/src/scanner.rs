//! The scanner of a link: its family and settings, as values in effect and as keys of the sources. The family checks the
//! settings; this module knows where each one is set.

use std::collections::BTreeMap;
use std::ops::Range;

use port::Source;
use scanhub_drivers::{
    ANY, AUTO, Features, Key, Model, Refusal, Settings, SettingsRequest, Value, auto_or, family_of, features,
};
use schema::{Failure, Family};
use toml::Spanned;

use crate::sources::Origin;

/// Family of a scanner, with its settings.
#[derive(Clone, Debug)]
pub struct Scanner {
    /// Family of the scanner. `None`: the hub searches for it.
    pub family: Option<Family>,
    /// Values that are set for the session. Those of the port follow from the link.
    pub settings: Settings,
    /// Keys that name the family: `family`, and those that only one family has.
    pub named_by: Vec<&'static str>,
}

impl PartialEq for Scanner {
    /// Compares what the link does. The keys that name the family are only for messages.
    fn eq(&self, other: &Scanner) -> bool {
        (self.family, &self.settings) == (other.family, &other.settings)
    }
}

impl Eq for Scanner {}

impl Scanner {
    /// Returns the models and settings of the family, or of all families if it is searched for.
    pub fn features(&self) -> &'static Features {
        self.family.map_or(&ANY, features)
    }

    /// Returns the model, or the values for an unknown one if the session must detect it.
    pub fn model(&self) -> Model {
        let features = self.features();
        let named = features.models.iter().find(|model| Some(model.name) == self.settings.model);
        named.copied().unwrap_or(features.auto)
    }

    /// Returns whether the session must detect the model, and with it the number of beams.
    pub fn is_auto(&self) -> bool {
        let Settings { model, beams, .. } = self.settings;
        let has_models = self.family.is_none_or(|family| !features(family).models.is_empty());
        has_models && model.is_none() && beams.is_none()
    }

    /// Returns the number of beams of a scan, or its maximum if it is not known before.
    pub fn max_beams(&self) -> usize {
        let Some(beams) = self.settings.beams else { return self.model().beams };
        if self.family.is_some() {
            return beams;
        }
        // A scanner that reports its model has its own number of beams.
        let own = Family::ALL.into_iter().map(features).filter(|features| features.models.is_empty());
        own.map(|features| features.auto.beams).max().unwrap_or(beams).max(beams)
    }

    /// Returns the rate at which a tty is opened, in bits per second.
    pub fn rate(&self) -> u32 {
        self.settings.baud.unwrap_or(self.model().baud)
    }

    /// Returns the highest rate that the scanner can have.
    fn max_rate(&self) -> u32 {
        let families =
            self.family.map_or(Family::ALL.to_vec(), |family| vec![family]).into_iter().map(features);
        let all = families.flat_map(|features| features.models.iter().chain([&features.auto]));
        let all = all.map(|model| model.baud);
        if self.is_auto() { all.max().unwrap_or(self.rate()) } else { self.rate() }
    }

    /// Returns the highest rate that the scanner can have at `port`. A serial server has its own rate, whatever is
    /// configured here.
    pub fn max_rate_at(&self, port: &Source) -> u32 {
        if matches!(port, Source::Tty(_)) { self.rate() } else { self.max_rate() }
    }

    /// Returns the settings of a session at `port`. `listen_only` is whether nothing may be sent.
    pub fn settings_at(&self, port: &Source, listen_only: bool) -> Settings {
        let fixed_rate = !matches!(port, Source::Tty(_));
        let is_found = self.family.is_none() || self.settings.is_found;
        Settings { max_beams: Some(self.max_beams()), fixed_rate, listen_only, is_found, ..self.settings }
    }
}

/// Keys of a scanner in one source.
pub(crate) struct ScannerLayer {
    pub(crate) family: Option<Spanned<String>>,
    pub(crate) expected_type: Option<Spanned<String>>,
    pub(crate) model: Option<Spanned<String>>,
    pub(crate) beams: Option<Spanned<i64>>,
    pub(crate) angle: Option<Spanned<f64>>,
    pub(crate) resolution: Option<Spanned<f64>>,
    pub(crate) unit: Option<Spanned<String>>,
    /// A number or a name.
    pub(crate) mode: Option<Spanned<toml::Value>>,
    pub(crate) idle: Option<Spanned<String>>,
    pub(crate) baud: Option<Spanned<u32>>,
}

/// Values of all sources with their places.
#[derive(Default)]
pub(crate) struct ScannerDraft {
    /// The family, or that it is searched for.
    family: Option<(Option<Family>, String)>,
    request: SettingsRequest,
    places: BTreeMap<Key, String>,
}

impl ScannerDraft {
    /// Applies the keys that are set in `layer`.
    pub(crate) fn apply(&mut self, layer: ScannerLayer, origin: &Origin) -> Result<(), Failure> {
        let ScannerLayer { family, expected_type, model, beams, angle, resolution, unit, mode, idle, baud } =
            layer;
        if let Some(family) = family {
            let known = Family::parse(family.get_ref());
            if known.is_none() && !family.get_ref().eq_ignore_ascii_case(AUTO) {
                let what = format!("family = \"{}\"", family.get_ref());
                let names = auto_or(Family::ALL.into_iter().map(Family::name));
                return Err(origin.refuse(Some(family.span()), what, names));
            }
            self.family = Some((known, origin.place(Some(family.span()))));
        }
        for (key, text) in
            [(Key::Model, model), (Key::Idle, idle), (Key::Type, expected_type), (Key::Unit, unit)]
        {
            self.set(key, text.as_ref().map(|text| (Value::Text(text.get_ref()), text.span())), origin)?;
        }
        for (key, whole) in [(Key::Beams, beams), (Key::Baud, baud.map(widened))] {
            self.set(key, whole.map(|whole| (Value::Whole(*whole.get_ref()), whole.span())), origin)?;
        }
        for (key, number) in [(Key::Angle, angle), (Key::Resolution, resolution)] {
            self.set(key, number.map(|number| (Value::Number(*number.get_ref()), number.span())), origin)?;
        }
        let Some(mode) = mode else { return Ok(()) };
        let other = mode.get_ref().to_string();
        let (key, value) = match mode.get_ref() {
            toml::Value::String(name) => (Key::ModeName, Value::Text(name)),
            toml::Value::Integer(number) => (Key::ModeNumber, Value::Whole(*number)),
            _ => (Key::ModeNumber, Value::Other(&other)),
        };
        self.set(key, Some((value, mode.span())), origin)
    }

    /// Sets `key`, if there is a value for it.
    fn set(
        &mut self,
        key: Key,
        value: Option<(Value<'_>, Range<usize>)>,
        origin: &Origin,
    ) -> Result<(), Failure> {
        let Some((value, span)) = value else { return Ok(()) };
        self.places.insert(key, origin.place(Some(span.clone())));
        self.request
            .set(key, value)
            .map_err(|Refusal { what, remedy, .. }| origin.refuse(Some(span), what, remedy))
    }

    /// Returns the place of the number of a measuring mode, if one is set.
    pub(crate) fn mode_number_place(&self) -> Option<&str> {
        self.request.mode_number?;
        self.places.get(&Key::ModeNumber).map(String::as_str)
    }

    /// Returns the scanner. `refuse` creates the failure for a place, a problem and a remedy. Without a place, it is that
    /// of the link.
    pub(crate) fn finish(
        &self,
        refuse: impl Fn(Option<&str>, String, &str) -> Failure,
    ) -> Result<Scanner, Failure> {
        let refused = |Refusal { keys, what, remedy }: Refusal| {
            refuse(keys.iter().find_map(|key| self.place(*key)), what, &remedy)
        };
        let named = match &self.family {
            Some((Some(_), _)) => None,
            _ => self.named_family(&refuse)?,
        };
        let model = self.request.model.as_deref();
        let set = self.family.as_ref().and_then(|(family, place)| Some(((*family)?, place)));
        match (model, set) {
            (Some(model), Some((family, family_place))) => {
                if let Some(implied) = family_of(model).filter(|implied| *implied != family) {
                    let [implied, family] = [implied.name(), family.name()];
                    let what = format!(
                        "model = \"{model}\" is of family {implied}, but {family_place} says {family}"
                    );
                    let remedy = format!("leave `family` out, or set family = \"{implied}\"");
                    return Err(refuse(self.place(Key::Model), what, &remedy));
                }
            }
            (_, None) => self.request.check_model().map_err(refused)?,
            (None, Some(_)) => {}
        }
        let family = set.map(|(family, _)| family).or(named);
        let settings = match family {
            Some(family) => self.request.check(family).map_err(refused)?,
            None => Settings { beams: self.request.beams, ..Settings::default() },
        };
        let keys = self.request.naming().map(|(key, ..)| key.name());
        let mut named_by: Vec<_> = set.map(|_| "family").into_iter().chain(keys).collect();
        named_by.dedup();
        Ok(Scanner { family, settings, named_by })
    }

    /// Returns the family that the keys name which only one family has. `None` if there are none.
    fn named_family(
        &self,
        refuse: impl Fn(Option<&str>, String, &str) -> Failure,
    ) -> Result<Option<Family>, Failure> {
        let mut all = self.request.naming();
        let Some((first_key, first, first_what)) = all.next() else { return Ok(None) };
        if let Some((key, other, what)) = all.find(|(_, other, _)| *other != first) {
            let what = format!(
                "{what} is of family {}, but {first_what} at {} is of family {}",
                other.name(),
                self.place(first_key).unwrap_or_default(),
                first.name()
            );
            return Err(refuse(self.place(key), what, "set only keys of the family that the scanner has"));
        }
        Ok(Some(first))
    }

    fn place(&self, key: Key) -> Option<&str> {
        self.places.get(&key).map(String::as_str)
    }
}

fn widened(value: Spanned<u32>) -> Spanned<i64> {
    Spanned::new(value.span(), i64::from(*value.get_ref()))
}
