//! Settings of a scanner: keys of a configuration, and the checked settings of a session. Each family lists the keys
//! that no other family has, and checks their values. The crate `config` adds the position of each key in a file.

use std::fmt;

use scanhub_schema::Family;

use crate::families::{check, features};
use crate::line;
use crate::line::family::Features;
use crate::lms;

/// Declares the keys, each with its name in a configuration and its field in a request.
macro_rules! keys {
    ($($(#[doc = $doc:literal])+ $key:ident $name:literal $field:ident: $type:ty,)+) => {
        /// Key of a setting.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Key {
            $($(#[doc = $doc])+ $key,)+
        }

        impl Key {
            /// All keys, in the order of declaration.
            pub const ALL: [Key; [$(Key::$key),+].len()] = [$(Key::$key),+];

            /// Returns the name of the key in a configuration.
            pub fn name(self) -> &'static str {
                match self { $(Key::$key => $name,)+ }
            }
        }

        /// Settings that a user requests, which the family has not checked yet. Each value is valid by itself.
        #[derive(Clone, Debug, Default, PartialEq)]
        pub struct SettingsRequest {
            $($(#[doc = $doc])+ pub $field: Option<$type>,)+
        }

        impl SettingsRequest {
            /// Returns whether the request sets `key`.
            fn has(&self, key: Key) -> bool {
                match key { $(Key::$key => self.$field.is_some(),)+ }
            }
        }
    };
}

keys! {
    /// Type that the scanner is expected to report.
    Type "type" expected_type: &'static str,
    /// Angle of view in degrees.
    Angle "angle" angle_deg: u16,
    /// Angle between two beams, in hundredths of a degree.
    Resolution "resolution" resolution_cdeg: u16,
    /// Unit of ranges, in millimeters.
    Unit "unit" unit_mm: u8,
    /// Number of the measurement mode.
    ModeNumber "mode" mode_number: u8,
    /// Baud rate in bits per second.
    Baud "baud" baud: u32,
    /// Name of the model; `None` for [`AUTO`].
    Model "model" model: String,
    /// Number of beams.
    Beams "beams" beams: usize,
    /// Name of the scan mode; `None` for [`AUTO`].
    ModeName "mode" mode: String,
    /// Whether the motor stops while the sensor has no subscribers.
    Idle "idle" stop_when_idle: bool,
}

impl Key {
    /// Returns whether every family accepts the key with its default value, [`AUTO`] or `run`.
    fn has_default(self) -> bool {
        matches!(self, Key::Model | Key::Beams | Key::ModeName | Key::Idle)
    }
}

/// Value of a setting, as the user wrote it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'a> {
    /// Text.
    Text(&'a str),
    /// Whole number.
    Whole(i64),
    /// Number with a fraction.
    Number(f64),
    /// Value of any other type, as the user wrote it.
    Other(&'a str),
}

impl fmt::Display for Value<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Value::Text(text) => write!(f, "\"{text}\""),
            Value::Whole(number) => number.fmt(f),
            Value::Number(number) => number.fmt(f),
            Value::Other(text) => f.write_str(text),
        }
    }
}

/// Reason why a setting is not valid, as text for the user.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Keys whose values cause the problem, the most important key first. If this key is not set, the next key that is
    /// set replaces it.
    pub keys: Vec<Key>,
    /// Problem, with the value.
    pub what: String,
    /// Remedy for the user.
    pub remedy: String,
}

impl Refusal {
    pub(crate) fn new(keys: &[Key], what: String, remedy: impl Into<String>) -> Refusal {
        Refusal { keys: keys.to_vec(), what, remedy: remedy.into() }
    }
}

/// Checked settings of a session. All families have the same type of settings, so models and modes are names. A family
/// ignores settings that it does not have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settings {
    /// Name of one of the [`Features::models`]. `None` if the session detects the model.
    pub model: Option<&'static str>,
    /// Name of one of the [`Features::modes`]. `None` if the session chooses the best mode.
    pub mode: Option<&'static str>,
    /// Number of beams of the grid. `None` for the model's number, up to [`max_beams`](Self::max_beams).
    pub beams: Option<usize>,
    /// Maximum number of beams. `None` for the maximum of a grid.
    pub max_beams: Option<usize>,
    /// Angle of view in degrees, and angle between two beams in hundredths of a degree. `None` for the family's
    /// default.
    pub view: Option<(u16, u16)>,
    /// Baud rate for the stream, in bits per second. `None` for the default of the model or family.
    pub baud: Option<u32>,
    /// Type that the scanner is expected to report. `scanhub doctor` compares it with the reported type. A session does
    /// not use it.
    pub expected_type: Option<&'static str>,
    /// Expected unit of ranges, in millimeters. The hub and `scanhub doctor` compare it with the unit that the scanner
    /// reports. No session changes the unit of a scanner.
    pub unit_mm: Option<u8>,
    /// Number of the measurement mode, which defines the meaning of values. Used for a recording that does not contain
    /// this number.
    pub mode_number: Option<u8>,
    /// Whether the port has a fixed baud rate, and bytes do not arrive at the speed of a line. This applies to a serial
    /// server on the network and to a recording.
    pub fixed_rate: bool,
    /// Whether the session cannot send, because the bytes come from a recording.
    pub listen_only: bool,
    /// Whether the motor stops while the sensor has no subscribers, if the family [supports
    /// it](Features::can_stop_motor).
    pub stop_when_idle: bool,
    /// Whether a search has found the scanner. The number of beams then depends on the data that the scanner reports.
    pub is_found: bool,
}

impl SettingsRequest {
    /// Sets `key` to `value`. The name of a mode replaces a mode number, and a mode number replaces the name of a mode.
    ///
    /// # Errors
    ///
    /// Returns a refusal if the value is not valid for any scanner.
    pub fn set(&mut self, key: Key, value: Value<'_>) -> Result<(), Refusal> {
        let is_auto = matches!(value, Value::Text(text) if text.eq_ignore_ascii_case(AUTO));
        match (key, value) {
            (Key::Model, Value::Text(model)) => self.model = (!is_auto).then(|| model.to_owned()),
            (Key::ModeName, Value::Text(mode)) => {
                (self.mode, self.mode_number) = ((!is_auto).then(|| mode.to_owned()), None);
            }
            (Key::Beams, Value::Whole(number)) => {
                let beams = usize::try_from(number).ok().filter(|beams| line::BEAM_RANGE.contains(beams));
                let (min, max) = (line::BEAM_RANGE.start(), line::BEAM_RANGE.end());
                let remedy = || format!("a whole number from {min} to {max}");
                self.beams = Some(beams.ok_or_else(|| refusal(Key::Beams, value, remedy()))?);
            }
            (Key::Idle, Value::Text(text)) => {
                let known = IDLE_VALUES.iter().find(|(word, _)| *word == text);
                let remedy = || format!("one of: {}", IDLE_VALUES.map(|(word, _)| word).join(", "));
                self.stop_when_idle = Some(known.ok_or_else(|| refusal(Key::Idle, value, remedy()))?.1);
            }
            _ => lms::set(self, key, value)?,
        }
        Ok(())
    }

    /// Returns the keys of this request that only one family has, each with its family and its text for a message.
    pub fn family_keys(&self) -> impl Iterator<Item = (Key, Family, String)> {
        Key::ALL.into_iter().filter_map(|key| {
            let (family, what) = match (key, &self.model, &self.mode) {
                (Key::Model, Some(model), _) => (family_of(model)?, format!("model = \"{model}\"")),
                (Key::ModeName, _, Some(mode)) => (owning_family(key)?, format!("mode = \"{mode}\"")),
                _ => (owning_family(key).filter(|_| self.has(key))?, key.name().to_owned()),
            };
            Some((key, family, what))
        })
    }

    /// Checks the model, if a model is set.
    ///
    /// # Errors
    ///
    /// Returns a refusal if no family has this model.
    pub fn check_model(&self) -> Result<(), Refusal> {
        let Some(model) = self.model.as_ref().filter(|model| family_of(model).is_none()) else {
            return Ok(());
        };
        let all = || Family::ALL.into_iter().map(|family| (family, features(family)));
        let names = auto_or(all().flat_map(|(_, features)| features.models).map(|model| model.name));
        let without_models: Vec<_> = all()
            .filter(|(_, features)| features.models.is_empty())
            .map(|(family, _)| family.name().to_uppercase())
            .collect();
        let remedy = format!(
            "{names}; leave it out for an {}, which reports its model; `type` is the expected model",
            without_models.join(" or ")
        );
        Err(Refusal::new(&[Key::Model], format!("model = \"{model}\""), remedy))
    }

    /// Returns the settings of a session with a scanner of `family`.
    ///
    /// # Errors
    ///
    /// Returns a refusal if the family does not have one of the settings, or does not support its value.
    pub fn check(&self, family: Family) -> Result<Settings, Refusal> {
        if self.stop_when_idle == Some(true) && !features(family).can_stop_motor {
            let what = format!("idle = \"stop\", but the motor of an {} cannot be stopped", family.name());
            return Err(Refusal::new(&[Key::Idle], what, "leave it out"));
        }
        let settings = check(family, self)?;
        self.check_keys(family, features(family))?;
        Ok(settings)
    }

    /// Returns a refusal if the request sets a key that `family` does not have.
    fn check_keys(&self, family: Family, features: &Features) -> Result<(), Refusal> {
        let is_foreign = |key: &Key| self.has(*key) && !key.has_default() && !features.keys.contains(key);
        let Some(key) = Key::ALL.into_iter().find(is_foreign) else { return Ok(()) };
        let owner = owning_family(key).unwrap_or(family).name();
        let what = format!("{} is a setting of family {owner}; no other family has it", key.name());
        let remedy = match (key, features.modes) {
            (Key::Baud, _) => "leave it out: the rate is the model's".to_owned(),
            (Key::ModeNumber, [_, ..]) => format!("name one of: {}", features.modes.join(", ")),
            _ => format!("leave it out, or set family = \"{owner}\""),
        };
        Err(Refusal::new(&[key], what, remedy))
    }

    /// Checks the names of the model and the mode. Returns the settings for `family`. The models of the family are in
    /// `features`.
    pub(crate) fn check_models(&self, family: Family, features: &Features) -> Result<Settings, Refusal> {
        let mut settings = self.unchecked_settings();
        if let Some(model) = &self.model {
            let known = features.models.iter().find(|known| known.name.eq_ignore_ascii_case(model));
            settings.model = Some(known.map(|known| known.name).ok_or_else(|| {
                let names = features.models.iter().map(|model| model.name);
                Refusal::new(&[Key::Model], format!("model = \"{model}\""), auto_or(names))
            })?);
        }
        if let Some(mode) = &self.mode {
            let known = features.modes.iter().find(|known| known.eq_ignore_ascii_case(mode));
            settings.mode = Some(*known.ok_or_else(|| {
                let what = format!("mode = \"{mode}\"");
                match features.modes {
                    [] => {
                        let what = format!("{what}, but an {} has only one scan mode", family.name());
                        Refusal::new(&[Key::ModeName], what, "leave it out")
                    }
                    modes => Refusal::new(&[Key::ModeName], what, auto_or(modes.iter().copied())),
                }
            })?);
        }
        Ok(settings)
    }

    /// Returns the settings that need no further check.
    pub(crate) fn unchecked_settings(&self) -> Settings {
        Settings {
            beams: self.beams,
            expected_type: self.expected_type,
            baud: self.baud,
            unit_mm: self.unit_mm,
            mode_number: self.mode_number,
            stop_when_idle: self.stop_when_idle.unwrap_or_default(),
            ..Settings::default()
        }
    }
}

impl Settings {
    /// Returns the value of `key`, as in a configuration. Returns `None` if the key is not set and has no default.
    pub fn value(&self, key: Key) -> Option<Value<'static>> {
        let whole = |number: u32| Value::Whole(number.into());
        match key {
            Key::Type => self.expected_type.map(Value::Text),
            Key::Angle => self.view.map(|(angle_deg, _)| whole(angle_deg.into())),
            Key::Resolution => self.view.map(|(_, cdeg)| Value::Number(f64::from(cdeg) / 100.0)),
            Key::Unit => self.unit_mm.map(|mm| Value::Text(if mm == 1 { "mm" } else { "cm" })),
            Key::ModeNumber => self.mode_number.map(|number| whole(number.into())),
            Key::Baud => self.baud.map(whole),
            Key::Model => Some(Value::Text(self.model.unwrap_or(AUTO))),
            Key::Beams => self.beams.map(|beams| whole(beams as u32)),
            Key::ModeName => Some(Value::Text(self.mode.unwrap_or(AUTO))),
            Key::Idle => IDLE_VALUES
                .iter()
                .find(|(_, stops)| *stops == self.stop_when_idle)
                .map(|(word, _)| Value::Text(word)),
        }
    }
}

/// Returns the family that has `key`, if only one family has it.
fn owning_family(key: Key) -> Option<Family> {
    Family::ALL.into_iter().find(|&family| features(family).keys.contains(&key))
}

/// Returns the family with a model whose name is `model`. A name belongs to only one family.
pub fn family_of(model: &str) -> Option<Family> {
    let has =
        |family: &Family| features(*family).models.iter().any(|known| known.name.eq_ignore_ascii_case(model));
    Family::ALL.into_iter().find(has)
}

/// Values of `idle`, each with whether the motor stops while the sensor has no subscribers.
const IDLE_VALUES: [(&str, bool); 2] = [("run", false), ("stop", true)];

/// Returns the refusal of a value that is not valid for any scanner.
pub(crate) fn refusal(key: Key, value: Value<'_>, remedy: impl Into<String>) -> Refusal {
    Refusal::new(&[key], format!("{} = {value}", key.name()), remedy)
}

/// Returns a remedy that lists [`AUTO`] and `names`.
pub fn auto_or(names: impl Iterator<Item = &'static str>) -> String {
    format!("{AUTO}, or one of: {}", names.collect::<Vec<_>>().join(", "))
}

/// Value that lets the hub or the session detect or choose the setting.
pub const AUTO: &str = "auto";
