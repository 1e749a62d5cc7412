//! The settings of the command line, `KEY=VALUE`: their keys, their valid values, and what each changes in a
//! configuration. A setting that the type of the scanner does not support is refused with the reason.

use lms_configure::{OwnedConfiguration, Plan, eeprom::PowerOn};
use scanhub_drivers::lms::family::Family;
use scanhub_drivers::lms::inquiry::Report;
use scanhub_drivers::lms::variant::{Mode, Unit};
use schema::{Failure, Kind};

/// All settings that the command line requests.
#[derive(Clone, Debug)]
pub(crate) struct SettingsRequest(Vec<Setting>);

#[derive(Clone, Debug, PartialEq)]
enum Setting {
    Unit(Unit),
    Mode(Mode),
    /// Level 1, 2 or 3.
    Availability(u8),
    Indices(bool),
    Sensitivity(u8),
    PowerOn(PowerOn),
    Configuration(OwnedConfiguration),
}

impl SettingsRequest {
    /// Parses settings of the form `KEY=VALUE`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] with key, value and the valid values if a setting is invalid, and
    /// [`Kind::Usage`] if there is none.
    pub(crate) fn parse(settings: &[String]) -> Result<SettingsRequest, Failure> {
        if settings.is_empty() {
            let keys: Vec<String> = KEYS.iter().map(|(key, values, _)| format!("{key}={values}")).collect();
            return Err(Failure::new(Kind::Usage, "nothing to change", keys.join(", ")));
        }
        settings.iter().map(|setting| parse(setting)).collect::<Result<_, _>>().map(SettingsRequest)
    }

    /// Applies every setting to `plan`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if this scanner does not support a setting.
    pub(crate) fn apply(
        &self,
        plan: &mut Plan,
        family: Option<Family>,
        report: &Report,
    ) -> Result<(), Failure> {
        let bits = |plan: &mut Plan, mask: u8, bits: u8| {
            let byte = plan.new.bytes().get(AVAILABILITY).copied().unwrap_or_default();
            plan.new.set(AVAILABILITY, byte & !mask | bits);
        };
        for setting in &self.0 {
            match *setting {
                Setting::Unit(unit) => plan.new.set(UNIT, unit.code()),
                Setting::Mode(mode) => plan.new.set(MODE, mode.0),
                Setting::Availability(3) => bits(plan, LEVEL_2 | LEVEL_3, LEVEL_3),
                Setting::Availability(2) => bits(plan, LEVEL_2 | LEVEL_3, LEVEL_2),
                Setting::Availability(_) => bits(plan, LEVEL_2 | LEVEL_3, 0),
                Setting::Indices(is_on) => bits(plan, INDICES, if is_on { INDICES } else { 0 }),
                Setting::Sensitivity(byte) => {
                    let reason = match family {
                        Some(family) => family.refuses_sensitivity(),
                        None => Some("its type is not known"),
                    };
                    if let Some(reason) = reason {
                        return Err(refused("sensitivity", reason));
                    }
                    plan.new.set(SENSITIVITY, byte);
                }
                Setting::PowerOn(power_on) => {
                    let is_set = report.status().is_some_and(|status| status.has_permanent_baud());
                    // The scanner does not report which rate it keeps, so keeping the present one is always a change.
                    let needed = power_on == PowerOn::KeepBaud || is_set;
                    plan.power_on = needed.then_some(power_on);
                }
                Setting::Configuration(given) if given.bytes().len() != plan.old.bytes().len() => {
                    let (is, given) = (plan.old.bytes().len(), given.bytes().len());
                    return Err(refused("configuration", &format!("it has {is} bytes, not {given}")));
                }
                Setting::Configuration(given) => plan.new = given,
            }
        }
        Ok(())
    }
}

fn parse(text: &str) -> Result<Setting, Failure> {
    let refuse =
        |what: &str, remedy: String| Failure::new(Kind::Configuration, format!("{text}: {what}"), remedy);
    let (key, value) = text
        .split_once('=')
        .ok_or_else(|| refuse("no = in it", "write KEY=VALUE, for example unit=mm".into()))?;
    let Some((_, values, parse)) = KEYS.iter().find(|(known, ..)| *known == key) else {
        let keys: Vec<&str> = KEYS.iter().map(|(key, ..)| *key).collect();
        let nearest =
            keys.iter().max_by(|a, b| strsim::jaro_winkler(a, key).total_cmp(&strsim::jaro_winkler(b, key)));
        let near = nearest.filter(|known| strsim::jaro_winkler(known, key) > 0.75);
        let near = near.map_or(String::new(), |known| format!("did you mean {known}? "));
        return Err(refuse("unknown key", format!("{near}there are: {}", keys.join(", "))));
    };
    parse(value).ok_or_else(|| refuse("not possible", values.to_string()))
}

fn refused(key: &str, reason: &str) -> Failure {
    let message = format!("{key} cannot be set on this sensor: {reason}");
    Failure::new(Kind::Configuration, message, "nothing was written")
}

type Parse = fn(&str) -> Option<Setting>;

/// The keys, their valid values as text, and their parsers.
const KEYS: [(&str, &str, Parse); 7] = [
    ("unit", "mm or cm", |value| match value {
        "mm" => Some(Setting::Unit(Unit::Mm)),
        "cm" => Some(Setting::Unit(Unit::Cm)),
        _ => None,
    }),
    (
        "mode",
        "fields-abd (0x00), reflector3 (0x01), fields-abc (0x02), reflector2 (0x03), fields-ab (0x04), \
         reflector1 (0x05), field-a (0x06), range (0x0F), energy (0x3F), or 0x0D and 0x0E",
        |value| mode(value).map(Mode).map(Setting::Mode),
    ),
    ("availability", "1, 2 or 3", |value| match value.parse() {
        Ok(level @ 1..=3) => Some(Setting::Availability(level)),
        _ => None,
    }),
    ("indices", "on or off", |value| match value {
        "on" => Some(Setting::Indices(true)),
        "off" => Some(Setting::Indices(false)),
        _ => None,
    }),
    ("sensitivity", "standard, medium, low or high", |value| {
        let at = SENSITIVITIES.iter().position(|name| *name == value)?;
        Some(Setting::Sensitivity(at as u8))
    }),
    ("power_on_baud", "9600, or keep for the present rate", |value| match value {
        "9600" => Some(Setting::PowerOn(PowerOn::Baud9600)),
        "keep" => Some(Setting::PowerOn(PowerOn::KeepBaud)),
        _ => None,
    }),
    ("configuration", "all 32 or 34 bytes in hex, as probe shows them", |value| {
        let digits: Vec<u8> = value.chars().map(|c| Some(c.to_digit(16)? as u8)).collect::<Option<_>>()?;
        let bytes: Vec<u8> =
            digits.chunks(2).map(|pair| pair.iter().fold(0, |sum, d| sum << 4 | d)).collect();
        digits
            .len()
            .is_multiple_of(2)
            .then(|| OwnedConfiguration::new(&bytes))
            .flatten()
            .map(Setting::Configuration)
    }),
];

/// Measuring modes by name or number (Telegram listing, 77h block D).
fn mode(value: &str) -> Option<u8> {
    const NAMES: [(&str, u8); 9] = [
        ("fields-abd", 0x00),
        ("reflector3", 0x01),
        ("fields-abc", 0x02),
        ("reflector2", 0x03),
        ("fields-ab", 0x04),
        ("reflector1", 0x05),
        ("field-a", 0x06),
        ("range", 0x0F),
        ("energy", 0x3F),
    ];
    if let Some((_, byte)) = NAMES.iter().find(|(name, _)| *name == value) {
        return Some(*byte);
    }
    let byte = match value.strip_prefix("0x") {
        Some(hex) => u8::from_str_radix(hex, 16).ok()?,
        None => value.parse().ok()?,
    };
    (NAMES.iter().any(|(_, known)| *known == byte) || matches!(byte, 0x0D | 0x0E)).then_some(byte)
}

/// Sensitivities of the LMS 291 by their number: 30, 25, 20 and 42 m at 10 % (Telegram listing, 77h block C).
pub(crate) const SENSITIVITIES: [&str; 4] = ["standard", "medium", "low", "high"];

/// Index of the sensitivity in the configuration. All indices are from the Telegram listing, 77h blocks C to E.
pub(crate) const SENSITIVITY: usize = 3;
/// See [`SENSITIVITY`].
pub(crate) const AVAILABILITY: usize = 4;
/// See [`SENSITIVITY`].
pub(crate) const MODE: usize = 5;
/// See [`SENSITIVITY`].
pub(crate) const UNIT: usize = 6;
const LEVEL_3: u8 = 1;
const INDICES: u8 = 2;
const LEVEL_2: u8 = 4;

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_drivers::lms::configuration::factory;
    use scanhub_drivers::lms::parameters::Password;
    use scanhub_drivers::lms::variant::Baud;

    fn plan() -> Plan {
        let old = OwnedConfiguration::new(&factory(Mode(1), Unit::Mm)).unwrap();
        Plan {
            baud: Baud::B9600,
            address: 0,
            operating_mode: 0x25,
            old,
            new: old,
            power_on: None,
            password: Password::FACTORY,
        }
    }

    fn applied(settings: &[&str], family: Option<Family>) -> Result<Plan, Failure> {
        let settings: Vec<String> = settings.iter().map(|setting| (*setting).to_owned()).collect();
        let mut plan = plan();
        SettingsRequest::parse(&settings)?.apply(&mut plan, family, &Report::default())?;
        Ok(plan)
    }

    #[test]
    fn each_key_changes_its_place() {
        let byte = |setting: &str, at: usize| {
            let plan = applied(&[setting], Some(Family::Lms291)).unwrap();
            plan.new.bytes()[at]
        };
        assert_eq!((byte("unit=cm", 6), byte("unit=mm", 6)), (0, 1));
        assert_eq!((byte("mode=reflector1", 5), byte("mode=0x0F", 5), byte("mode=13", 5)), (5, 15, 13));
        assert_eq!((byte("availability=3", 4), byte("availability=2", 4)), (1, 4));
        assert_eq!((byte("indices=on", 4), byte("sensitivity=high", 3)), (2, 3));
        let both = applied(&["indices=on", "availability=3", "indices=off"], None).unwrap();
        assert_eq!(both.new.bytes()[4], 1);
        assert!(applied(&["unit=mm", "mode=1", "power_on_baud=9600"], None).unwrap().is_empty());
        assert_eq!(applied(&["power_on_baud=keep"], None).unwrap().power_on, Some(PowerOn::KeepBaud));
        let hex = "00".repeat(34);
        assert_eq!(applied(&[&format!("configuration={hex}")], None).unwrap().new.bytes(), [0; 34]);
    }

    #[test]
    fn what_cannot_be_is_refused_with_what_can() {
        let refusal = |setting: &str, family| {
            let failure = applied(&[setting], family).unwrap_err();
            assert_eq!(failure.kind, Kind::Configuration);
            failure.to_string()
        };
        for (setting, words) in [
            ("unit", "KEY=VALUE"),
            ("units=mm", "did you mean unit?"),
            ("unit=dm", "mm or cm"),
            ("mode=7", "reflector3 (0x01)"),
            ("mode=0x100", "reflector3"),
            ("availability=4", "1, 2 or 3"),
            ("power_on_baud=500000", "9600, or keep"),
            ("configuration=00", "32 or 34 bytes"),
            ("sensitivity=high", "only the LMS 291"),
        ] {
            let text = refusal(setting, Some(Family::Lms200));
            assert!(text.contains(words), "{setting}: {text}");
        }
        assert!(refusal("sensitivity=low", None).contains("not known"));
        let old = format!("configuration={}", "00".repeat(32));
        assert!(refusal(&old, None).contains("34 bytes, not 32"));
        assert_eq!(SettingsRequest::parse(&[]).unwrap_err().kind, Kind::Usage);
    }
}
