//! Settings of a scanner: the keys of a configuration, and the settings of a session. A family lists the keys that only it has,
//! and checks their values. A configuration adds the place of each key.

use std::fmt;

use scanhub_schema::Family;

use crate::families::{check, features};
use crate::line;
use crate::line::family::Features;
use crate::lms;

/// Declares the keys, each with its name in a configuration, and the field that a request has for its value.
macro_rules! keys {
    ($($(#[doc = $doc:literal])+ $key:ident $name:literal $field:ident: $type:ty,)+) => {
        /// Key of a setting.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Key {
            $($(#[doc = $doc])+ $key,)+
        }

        impl Key {
            /// All keys.
            pub const ALL: [Key; [$(Key::$key),+].len()] = [$(Key::$key),+];

            /// Returns its name in a configuration.
            pub fn name(self) -> &'static str {
                match self { $(Key::$key => $name,)+ }
            }
        }

        /// Settings that a user requests, before the family has checked them. Each value alone is valid.
        #[derive(Clone, Debug, Default, PartialEq)]
        pub struct SettingsRequest {
            $($(#[doc = $doc])+ pub $field: Option<$type>,)+
        }

        impl SettingsRequest {
            /// Returns whether `key` is set.
            fn has(&self, key: Key) -> bool {
                match key { $(Key::$key => self.$field.is_some(),)+ }
            }
        }
    };
}

keys! {
    /// Name of the type that the scanner is expected to report.
    Type "type" expected_type: &'static str,
    /// Angle of view in degrees.
    Angle "angle" angle_deg: u16,
    /// Angle between two beams in hundredths of a degree.
    Resolution "resolution" resolution_cdeg: u16,
    /// Unit of ranges in mm.
    Unit "unit" unit_mm: u8,
    /// Number of the measuring mode.
    ModeNumber "mode" mode_number: u8,
    /// Rate in bits per second.
    Baud "baud" baud: u32,
    /// Name of the model; `None` for [`AUTO`].
    Model "model" model: String,
    /// Number of beams.
    Beams "beams" beams: usize,
    /// Name of the scan mode; `None` for [`AUTO`].
    ModeName "mode" mode: String,
    /// Whether the motor stops while there are no subscribers.
    Idle "idle" stop_when_idle: bool,
}

impl Key {
    /// Returns whether every family accepts it with its default, [`AUTO`] or `run`.
    fn has_default(self) -> bool {
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

/// Settings of a session, with names and numbers in place of a family's types. A family ignores what it does not have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settings {
    /// Name of one of the [`Features::models`]. `None`: the session finds it out.
    pub model: Option<&'static str>,
    /// Name of one of the [`Features::modes`]. `None`: the best one.
    pub mode: Option<&'static str>,
    /// Number of beams of the grid. `None`: the model's number, at most [`max_beams`](Self::max_beams).
    pub beams: Option<usize>,
    /// Maximum number of beams. `None`: the maximum of a grid.
    pub max_beams: Option<usize>,
    /// Angle of view in degrees and angle between two beams in hundredths of a degree. `None`: the family's usual ones.
    pub view: Option<(u16, u16)>,
    /// Rate to stream at, in bits per second. `None`: that of the model or family.
    pub baud: Option<u32>,
    /// Name of the expected type. It is compared, never written.
    pub expected_type: Option<&'static str>,
    /// Expected unit of ranges in mm. It is compared, never written.
    pub unit_mm: Option<u8>,
    /// Number of the mode that defines the meaning of values, for a recording that does not contain it.
    pub mode_number: Option<u8>,
    /// Whether the port has one fixed rate and bytes do not arrive at the pace of a line, as with a serial server on
    /// the network or a recording.
    pub fixed_rate: bool,
    /// Whether nothing can be sent, because the bytes are from a recording.
    pub listen_only: bool,
    /// Whether the motor stops while there are no subscribers, if it [can](Features::can_stop_motor).
    pub stop_when_idle: bool,
    /// Whether a search has found the scanner. Its number of beams then follows what it reports.
    pub is_found: bool,
}

impl SettingsRequest {
    /// Sets `key` to `value`. A name of a mode replaces a number, and a number a name.
    ///
    /// # Errors
    ///
    /// Returns a refusal if no scanner can have this value.
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

    /// Returns the keys that name a family, because only one has them. Each comes with its family and with its text in a
    /// message.
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

    /// Checks that some family has the model, if one is set.
    ///
    /// # Errors
    ///
    /// Returns a refusal if no family has it.
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
            "{names}; leave it out for an {}, which reports its model; `type` is the expected one",
            without_models.join(" or ")
        );
        Err(Refusal::new(&[Key::Model], format!("model = \"{model}\""), remedy))
    }

    /// Returns the settings of a scanner of `family`.
    ///
    /// # Errors
    ///
    /// Returns a refusal if the family does not have a setting, or not with this value.
    pub fn check(&self, family: Family) -> Result<Settings, Refusal> {
        if self.stop_when_idle == Some(true) && !features(family).can_stop_motor {
            let what = format!("idle = \"stop\", and an {} cannot be told to rest", family.name());
            return Err(Refusal::new(&[Key::Idle], what, "leave it out"));
        }
        let settings = check(family, self)?;
        self.check_keys(family, features(family))?;
        Ok(settings)
    }

    /// Refuses a key that only another family than `family` has.
    fn check_keys(&self, family: Family, features: &Features) -> Result<(), Refusal> {
        let is_foreign = |key: &Key| self.has(*key) && !key.has_default() && !features.keys.contains(key);
        let Some(key) = Key::ALL.into_iter().find(is_foreign) else { return Ok(()) };
        let owner = owning_family(key).unwrap_or(family).name();
        let what =
            format!("{} is of family {owner}; a scanner of another family has no such setting", key.name());
        let remedy = match (key, features.modes) {
            (Key::Baud, _) => "leave it out: the rate is the model's".to_owned(),
            (Key::ModeNumber, [_, ..]) => format!("name one of: {}", features.modes.join(", ")),
            _ => format!("leave it out, or set family = \"{owner}\""),
        };
        Err(Refusal::new(&[key], what, remedy))
    }

    /// Returns the settings of a scanner of `family`, which has `features` with models.
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
                        let what = format!("{what}, and an {} measures in one way only", family.name());
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
    /// Returns the value of `key` in a configuration. `None` if it is not set and has no default.
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

/// Returns the family that alone has `key`.
fn owning_family(key: Key) -> Option<Family> {
    Family::ALL.into_iter().find(|&family| features(family).keys.contains(&key))
}

/// Returns the family of the model called `model`. Each name belongs to one family.
pub fn family_of(model: &str) -> Option<Family> {
    let has =
        |family: &Family| features(*family).models.iter().any(|known| known.name.eq_ignore_ascii_case(model));
    Family::ALL.into_iter().find(has)
}

/// Values of `idle`, and whether the motor then stops while there are no subscribers.
const IDLE_VALUES: [(&str, bool); 2] = [("run", false), ("stop", true)];

/// Returns the refusal of a value that no scanner can have.
pub(crate) fn refusal(key: Key, value: Value<'_>, remedy: impl Into<String>) -> Refusal {
    Refusal::new(&[key], format!("{} = {value}", key.name()), remedy)
}

/// Returns the remedy that lists `names`.
pub fn auto_or(names: impl Iterator<Item = &'static str>) -> String {
    format!("{AUTO}, or one of: {}", names.collect::<Vec<_>>().join(", "))
}

/// The hub or the session detects or chooses the value.
pub const AUTO: &str = "auto";
