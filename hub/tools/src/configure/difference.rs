//! What a plan would change, value by value, in words.

use std::fmt;

use lms_configure::{Plan, eeprom::PowerOn};
use scanhub_drivers::lms::configuration::{Item, availability_words};
use scanhub_drivers::lms::family::Family;
use scanhub_drivers::lms::variant::{Mode, Unit};
use serde::Serialize;

use super::wanted::{AVAILABILITY, MODE, SENSITIVITIES, SENSITIVITY, UNIT};
use crate::probe::{hex, measuring};

/// One value that would change; class `difference`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    class: &'static str,
    port: String,
    item: &'static str,
    /// Its first byte in the configuration; none: it is kept elsewhere.
    offset: Option<usize>,
    before: String,
    after: String,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Difference { item, before, after, .. } = self;
        write!(f, "{item}: {before} -> {after}")
    }
}

/// All that `plan` changes in the sensor at `port`.
///
/// `was_permanent`: whether another rate than 9600 came after power-on so far, if it told.
pub(crate) fn between(
    port: &str,
    plan: &Plan,
    family: Option<Family>,
    was_permanent: Option<bool>,
) -> Vec<Difference> {
    let told = |item, offset, before, after| Difference {
        class: "difference",
        port: port.to_owned(),
        item,
        offset,
        before,
        after,
    };
    let items = plan.old.differences(&plan.new);
    let mut found: Vec<Difference> = items
        .map(|item| {
            let words = |bytes: &[u8]| words(item, bytes, family);
            told(item.name, Some(item.at), words(plan.old.bytes()), words(plan.new.bytes()))
        })
        .collect();
    found.extend(plan.power_on.map(|power_on| {
        let before = match was_permanent {
            Some(false) => "9600 Bd",
            Some(true) => "not 9600 Bd; the sensor does not report the rate",
            None => "not reported by the sensor",
        };
        let after = match power_on {
            PowerOn::KeepBaud => {
                format!("{} Bd: the present rate of the line becomes permanent", plan.baud.rate())
            }
            _ => "9600 Bd".to_owned(),
        };
        told("rate after power-on", None, before.to_owned(), after)
    }));
    found
}

fn words(item: Item, bytes: &[u8], family: Option<Family>) -> String {
    let value = bytes.get(item.at..item.at + item.len).unwrap_or_default();
    let byte = value.first().copied().unwrap_or_default();
    let words = match item.at {
        SENSITIVITY if family == Some(Family::Lms291) => {
            SENSITIVITIES.get(usize::from(byte)).map_or(String::new(), |name| (*name).to_owned())
        }
        AVAILABILITY => availability_words(byte).to_owned(),
        MODE => measuring(Mode(byte)),
        UNIT => Unit::of_code(byte).map_or(String::new(), |unit| format!("{} mm", unit.mm())),
        _ => String::new(),
    };
    let hex = hex(value);
    if words.is_empty() { format!("{hex}h") } else { format!("{hex}h ({words})") }
}
