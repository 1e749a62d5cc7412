//! The data of replies, field by field (Telegram listing 7).

use super::requests::{power_on, span};
use super::walk::{Walk, said};
use super::{Degrees, Ranges, unit_name, unit_words};
use crate::lms::configuration::{self, availability_words};
use crate::lms::errors::Fault;
use crate::lms::measured::{COUNT, MEASURED, PARTIAL};
use crate::lms::operating;
use crate::lms::reply::{POWER_ON, REFUSED, RESET};
use crate::lms::status_report::{self, Kind};
use crate::lms::telegram::Telegram;
use crate::lms::variant::{Baud, Mode, Unit};

/// The fields of a reply's data; what has no layout here is left.
pub(super) fn fields(walk: &mut Walk<'_, '_>, telegram: Telegram<'_>, mode: Option<Mode>) -> Option<()> {
    match telegram.command() {
        RESET | REFUSED => Some(()),
        POWER_ON | 0xBA => walk.text("type, number, firmware", walk.left()),
        0xA0 => walk.byte_as("outcome", done_if_zero).map(drop),
        MEASURED => values(walk, mode),
        0xB1 => status(walk),
        0xB2 => errors(walk),
        0xB5 => {
            walk.word_as("hours", |hours| said(move |f| write!(f, "{} h", 2 * u32::from(hours))))?;
            walk.word("power-ons").map(drop)
        }
        0xB6 => walk.byte("scans").and_then(|_| values(walk, mode)),
        0xB7 => span(walk).and_then(|()| values(walk, mode)),
        0xBB => {
            walk.byte_as("outcome", done_if_one)?;
            walk.word_as("angle", |angle| said(move |f| write!(f, "{angle} degrees")))?;
            walk.word_as("resolution", |step| said(move |f| write!(f, "{} degrees", Degrees(step)))).map(drop)
        }
        0xBE => {
            span(walk)?;
            let count = count_word(walk)?;
            walk.rows("values", count, &["value", "field A", "field B", "field C"])?;
            indices(walk)
        }
        0xBF => {
            walk.byte("scans")?;
            span(walk).and_then(|()| values(walk, mode))
        }
        0xC4 => {
            let (count, unit) = counted(walk)?;
            ranges(walk, count, unit, mode)?;
            let levels = usize::from(walk.word("reflectivities")? & COUNT);
            span(walk)?;
            walk.raw("reflectivity", levels)?;
            indices(walk)
        }
        0xE6 => {
            walk.byte("outcome")?;
            walk.byte_as("rate after power-on", power_on).map(drop)
        }
        0xF4 => configuration(walk),
        0xF5 => {
            for _ in 0..walk.word("sub-ranges")? {
                span(walk)?;
                let count = count_word(walk)?;
                walk.rows("values", count, &["distance", "reflectivity"])?;
            }
            indices(walk)
        }
        0xF7 => walk.byte_as("outcome", done_if_one).and_then(|_| configuration(walk)),
        0xFC => walk.byte_as("outcome", done_if_one).and_then(|_| walk.rest("parameters")),
        _ => walk.rest("data"),
    }
}

/// Count word, values, and the two indices where they are.
fn values(walk: &mut Walk<'_, '_>, mode: Option<Mode>) -> Option<()> {
    let (count, unit) = counted(walk)?;
    ranges(walk, count, unit, mode)?;
    indices(walk)
}

fn ranges(walk: &mut Walk<'_, '_>, count: usize, unit: Unit, mode: Option<Mode>) -> Option<()> {
    walk.ranges("values", count, |bytes| Ranges {
        bytes,
        mode: mode.unwrap_or(Mode(0)),
        mode_known: mode.is_some(),
        unit,
    })
}

fn counted(walk: &mut Walk<'_, '_>) -> Option<(usize, Unit)> {
    let word = walk.word_as("count and unit", |word| {
        said(move |f| {
            write!(f, "{} values in {}", word & COUNT, unit_words((word >> 14) as u8))?;
            match word & PARTIAL {
                0 => Ok(()),
                _ => write!(f, ", partial scan from x.{:02}", 25 * (word >> 11 & 3)),
            }
        })
    })?;
    Some((usize::from(word & COUNT), Unit::of_code((word >> 14) as u8).unwrap_or(Unit::Mm)))
}

fn count_word(walk: &mut Walk<'_, '_>) -> Option<usize> {
    counted(walk).map(|(count, _)| count)
}

fn indices(walk: &mut Walk<'_, '_>) -> Option<()> {
    if walk.left() == 2 {
        walk.byte("scan index")?;
        walk.byte("telegram index")?;
    }
    Some(())
}

fn errors(walk: &mut Walk<'_, '_>) -> Option<()> {
    while walk.left() >= 2 {
        // Both bytes are one error.
        walk.word_as("error", |word| {
            let [kind, number] = word.to_le_bytes();
            Fault { kind, number }
        })?;
    }
    Some(())
}

fn status(walk: &mut Walk<'_, '_>) -> Option<()> {
    for item in status_report::ITEMS {
        match item.kind {
            Kind::Text => walk.text(item.name, item.len)?,
            Kind::Words => walk.rows(item.name, item.len / 2, &["channel"])?,
            Kind::Bytes => walk.raw(item.name, item.len)?,
            Kind::Number => {
                let name = item.name;
                let words = move |value: u32| {
                    said(move |f| match name {
                        "operating mode" => f.write_str(operating::name(value as u8)),
                        "measuring mode" => f.write_str(Mode(value as u8).name()),
                        "unit" => f.write_str(unit_words(value as u8)),
                        "defective" => f.write_str(if value == 0 { "no" } else { "yes" }),
                        "laser" => f.write_str(if value == 0 { "off" } else { "on" }),
                        "motor" => write!(f, "{} us a turn", 90 * value),
                        "laser power" => write!(f, "{value} %"),
                        "scan angle" => write!(f, "{value} degrees"),
                        "resolution" => write!(f, "{} degrees", Degrees(value as u16)),
                        "permanent rate" => f.write_str(if value == 0 { "9600" } else { "another" }),
                        "rate of the line" => match status_report::baud_of_divisor(value as u16) {
                            Some(baud) => write!(f, "{} baud", Baud::rate(baud)),
                            None => f.write_str("unknown"),
                        },
                        "calibration interval" => write!(f, "{value} ns"),
                        _ => Ok(()),
                    })
                };
                walk.number(item.name, item.len, Some(words)).map(drop)?;
            }
        }
    }
    Some(())
}

/// As many bytes of the configuration as there are.
pub(super) fn configuration(walk: &mut Walk<'_, '_>) -> Option<()> {
    for item in configuration::ITEMS {
        if walk.left() < item.len {
            break;
        }
        let name = item.name;
        let words = move |value: u32| {
            said(move |f| match name {
                "blanking" => write!(f, "{value} cm"),
                "stop threshold" => write!(f, "{value} mV"),
                "availability" => f.write_str(availability_words(value as u8)),
                "measuring mode" => f.write_str(Mode(value as u8).name()),
                "unit" => f.write_str(Unit::of_code(value as u8).map_or("unknown", unit_name)),
                _ => Ok(()),
            })
        };
        walk.number(item.name, item.len, Some(words)).map(drop)?;
    }
    Some(())
}

fn done_if_zero(outcome: u8) -> &'static str {
    if outcome == 0 { "done" } else { "not done: wrong password, or a fault" }
}

fn done_if_one(outcome: u8) -> &'static str {
    if outcome == 1 { "done" } else { "not done: what is in force follows" }
}
