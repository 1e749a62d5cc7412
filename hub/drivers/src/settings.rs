//! Settings that a user requests: which family they name, and whether a family has them. The family checks their values, and
//! makes [`Settings`] of them. A configuration adds the place of each key.

use schema::Family;

use crate::families::{check, features};
use crate::line::family::{Features, Settings};
use crate::line::grid;
use crate::line::settings::{AUTO, Key, Refusal, SettingsRequest, Value, auto_or, refused};
use crate::lms;

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
                let beams = usize::try_from(number).ok().filter(|beams| grid::BEAMS.contains(beams));
                let (least, most) = (grid::BEAMS.start(), grid::BEAMS.end());
                let remedy = || format!("a whole number from {least} to {most}");
                self.beams = Some(beams.ok_or_else(|| refused(Key::Beams, value, remedy()))?);
            }
            (Key::Idle, Value::Text(text)) => {
                let known = IDLE.iter().find(|(word, _)| *word == text);
                let remedy = || format!("one of: {}", IDLE.map(|(word, _)| word).join(", "));
                self.stop_when_idle = Some(known.ok_or_else(|| refused(Key::Idle, value, remedy()))?.1);
            }
            _ => lms::settings::set(self, key, value)?,
        }
        Ok(())
    }

    /// Returns the keys that name a family, because only one has them. Each comes with its family and with its text in a
    /// message.
    pub fn naming(&self) -> impl Iterator<Item = (Key, Family, String)> {
        Key::ALL.into_iter().filter_map(|key| {
            let (family, what) = match (key, &self.model, &self.mode) {
                (Key::Model, Some(model), _) => (family_of(model)?, format!("model = \"{model}\"")),
                (Key::ModeName, _, Some(mode)) => (owner(key)?, format!("mode = \"{mode}\"")),
                _ => (owner(key).filter(|_| self.has(key))?, key.name().to_owned()),
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
        let without: Vec<_> = all()
            .filter(|(_, features)| features.models.is_empty())
            .map(|(family, _)| family.name().to_uppercase())
            .collect();
        let remedy = format!(
            "{names}; leave it out for an {}, which reports its model; `type` is the expected one",
            without.join(" or ")
        );
        Err(Refusal::new(&[Key::Model], format!("model = \"{model}\""), remedy))
    }

    /// Returns the settings of a scanner of `family`.
    ///
    /// # Errors
    ///
    /// Returns a refusal if the family does not have a setting, or not with this value.
    pub fn check(&self, family: Family) -> Result<Settings, Refusal> {
        if self.stop_when_idle == Some(true) && !features(family).can_rest {
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
        let owner = owner(key).unwrap_or(family).name();
        let what =
            format!("{} is of family {owner}; a scanner of another family has no such setting", key.name());
        let remedy = match (key, features.modes) {
            (Key::Baud, _) => "leave it out: the rate is the model's".to_owned(),
            (Key::ModeNumber, [_, ..]) => format!("name one of: {}", features.modes.join(", ")),
            _ => format!("leave it out, or set family = \"{owner}\""),
        };
        Err(Refusal::new(&[key], what, remedy))
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
            Key::Idle => IDLE
                .iter()
                .find(|(_, stops)| *stops == self.stop_when_idle)
                .map(|(word, _)| Value::Text(word)),
        }
    }
}

/// Returns the family that alone has `key`.
fn owner(key: Key) -> Option<Family> {
    Family::ALL.into_iter().find(|&family| features(family).keys.contains(&key))
}

/// Returns the family of the model called `model`. Each name belongs to one family.
pub fn family_of(model: &str) -> Option<Family> {
    let has =
        |family: &Family| features(*family).models.iter().any(|known| known.name.eq_ignore_ascii_case(model));
    Family::ALL.into_iter().find(has)
}

/// Values of `idle`, and whether the motor then stops while there are no subscribers.
const IDLE: [(&str, bool); 2] = [("run", false), ("stop", true)];
