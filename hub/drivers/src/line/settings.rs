//! Settings of a scanner as a user gives them, key by key, and what all families check alike.

use std::fmt;

use schema::Family;

use crate::line::family::{Features, Settings};

/// Key of a setting.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Key {
    /// Type that the scanner is expected to report.
    Type,
    /// Angle of view in degrees.
    Angle,
    /// Angle between two beams in degrees.
    Resolution,
    /// Unit of ranges.
    Unit,
    /// Number of the measuring mode.
    ModeNumber,
    /// Rate in bits per second.
    Baud,
    /// Model.
    Model,
    /// Number of beams.
    Beams,
    /// Name of the scan mode.
    ModeName,
    /// Behavior of the motor while there are no subscribers.
    Idle,
}

impl Key {
    /// All keys.
    pub const ALL: [Key; 10] = [
        Key::Type,
        Key::Angle,
        Key::Resolution,
        Key::Unit,
        Key::ModeNumber,
        Key::Baud,
        Key::Model,
        Key::Beams,
        Key::ModeName,
        Key::Idle,
    ];

    /// Returns its name in a configuration.
    pub fn name(self) -> &'static str {
        match self {
            Key::Type => "type",
            Key::Angle => "angle",
            Key::Resolution => "resolution",
            Key::Unit => "unit",
            Key::ModeNumber | Key::ModeName => "mode",
            Key::Baud => "baud",
            Key::Model => "model",
            Key::Beams => "beams",
            Key::Idle => "idle",
        }
    }

    /// Returns whether every family accepts it with its default, [`AUTO`] or `run`.
    pub(crate) fn has_default(self) -> bool {
        matches!(self, Key::Model | Key::Beams | Key::ModeName | Key::Idle)
    }
}

/// Value of a setting, as given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'a> {
    /// Text.
    Text(&'a str),
    /// A whole number.
    Whole(i64),
    /// Another number.
    Number(f64),
    /// Anything else, as it is written.
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

/// A setting that is not valid, as text for a user.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Keys whose values cause the problem, the main one first. The others stand for it if it is not set.
    pub keys: Vec<Key>,
    /// The problem, with the value.
    pub what: String,
    /// The remedy.
    pub remedy: String,
}

impl Refusal {
    pub(crate) fn new(keys: &[Key], what: String, remedy: impl Into<String>) -> Refusal {
        Refusal { keys: keys.to_vec(), what, remedy: remedy.into() }
    }
}

/// Settings that a user requests, before the family has checked them. Each value alone is valid.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SettingsRequest {
    /// Name of the model; `None` for [`AUTO`].
    pub model: Option<String>,
    /// Number of beams.
    pub beams: Option<usize>,
    /// Name of the scan mode; `None` for [`AUTO`].
    pub mode: Option<String>,
    /// Whether the motor stops while there are no subscribers.
    pub stop_when_idle: Option<bool>,
    /// Name of the expected type.
    pub expected_type: Option<&'static str>,
    /// Angle of view in degrees.
    pub angle_deg: Option<u16>,
    /// Angle between two beams in hundredths of a degree.
    pub resolution_cdeg: Option<u16>,
    /// Unit of ranges in mm.
    pub unit_mm: Option<u8>,
    /// Number of the measuring mode.
    pub mode_number: Option<u8>,
    /// Rate in bits per second.
    pub baud: Option<u32>,
}

impl SettingsRequest {
    /// Returns the settings of a scanner of `family`, which has `features` with models.
    pub(crate) fn check_models(&self, family: Family, features: &Features) -> Result<Settings, Refusal> {
        let stop_when_idle = self.stop_when_idle.unwrap_or(false);
        let mut settings = Settings { beams: self.beams, stop_when_idle, ..Settings::default() };
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
                        let what = format!("{what}, and an {} measures in one way only", family.name());
                        Refusal::new(&[Key::ModeName], what, "leave it out")
                    }
                    modes => Refusal::new(&[Key::ModeName], what, auto_or(modes.iter().copied())),
                }
            })?);
        }
        Ok(settings)
    }

    /// Returns whether `key` is set.
    pub(crate) fn has(&self, key: Key) -> bool {
        match key {
            Key::Type => self.expected_type.is_some(),
            Key::Angle => self.angle_deg.is_some(),
            Key::Resolution => self.resolution_cdeg.is_some(),
            Key::Unit => self.unit_mm.is_some(),
            Key::ModeNumber => self.mode_number.is_some(),
            Key::Baud => self.baud.is_some(),
            Key::Model => self.model.is_some(),
            Key::Beams => self.beams.is_some(),
            Key::ModeName => self.mode.is_some(),
            Key::Idle => self.stop_when_idle.is_some(),
        }
    }
}

/// Returns the refusal of a value that no scanner can have.
pub(crate) fn refused(key: Key, value: Value<'_>, remedy: impl Into<String>) -> Refusal {
    Refusal::new(&[key], format!("{} = {value}", key.name()), remedy)
}

/// Returns the remedy that lists `names`.
pub fn auto_or(names: impl Iterator<Item = &'static str>) -> String {
    format!("{AUTO}, or one of: {}", names.collect::<Vec<_>>().join(", "))
}

/// The hub or the session detects or chooses the value.
pub const AUTO: &str = "auto";
