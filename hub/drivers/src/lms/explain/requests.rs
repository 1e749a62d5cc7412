//! The parameters of requests, field by field (Telegram listing 7).

use super::walk::{Walk, said};
use super::{Degrees, replies};
use crate::lms::command::{
    CARTESIAN, MEANS, MODE, RANGE, RANGE_FIELDS, RANGE_MEANS, REFLECTIVITIES, REFLECTIVITY, VALUES, VARIANT,
};
use crate::lms::operating;
use crate::lms::telegram::Telegram;

/// The fields of a request's data; what has no layout here is left.
pub(super) fn fields(walk: &mut Walk<'_, '_>, telegram: Telegram<'_>) -> Option<()> {
    match telegram.command() {
        MODE => mode(walk),
        VALUES => walk.byte_as("selection", selection).map(drop),
        MEANS => shots(walk),
        RANGE => {
            walk.word_as("first value", |first| {
                said(move |f| match first & DIRECT {
                    0 => Ok(()),
                    _ => write!(f, "{}, direct output of a partial scan", first & !DIRECT),
                })
            })?;
            walk.word("last value").map(drop)
        }
        RANGE_FIELDS | REFLECTIVITY | CARTESIAN => span(walk),
        RANGE_MEANS => shots(walk).and_then(|()| span(walk)),
        REFLECTIVITIES => spans(walk),
        VARIANT => {
            walk.word_as("angle", |angle| said(move |f| write!(f, "{angle} degrees")))?;
            walk.word_as("resolution", |step| said(move |f| write!(f, "{} degrees", Degrees(step)))).map(drop)
        }
        WRITE_CONFIGURATION => replies::configuration(walk),
        POWER_ON_RATE => walk.byte_as("rate after power-on", power_on).map(drop),
        _ => walk.rest("parameters"),
    }
}

fn mode(walk: &mut Walk<'_, '_>) -> Option<()> {
    match walk.byte_as("operating mode", operating::name)? {
        operating::INSTALLATION | 0x30 => walk.text("password", 8),
        0x26 => shots(walk),
        0x27 | 0x29 | 0x50 => span(walk),
        0x28 => shots(walk).and_then(|()| span(walk)),
        0x2B => spans(walk),
        _ => walk.rest("parameters"),
    }
}

fn shots(walk: &mut Walk<'_, '_>) -> Option<()> {
    walk.byte_as("scans", |shots| said(move |f| write!(f, "mean of {shots}"))).map(drop)
}

pub(super) fn span(walk: &mut Walk<'_, '_>) -> Option<()> {
    walk.word("first value")?;
    walk.word("last value").map(drop)
}

fn spans(walk: &mut Walk<'_, '_>) -> Option<()> {
    for _ in 0..walk.word("sub-ranges")? {
        span(walk)?;
    }
    Some(())
}

/// What 66h sets, in words.
pub(super) fn power_on(byte: u8) -> &'static str {
    match byte {
        0 => "9600",
        1 => "the present rate is kept",
        2 => "the type is kept",
        _ => "unknown",
    }
}

fn selection(byte: u8) -> &'static str {
    match byte {
        1 => "all values",
        2 => "least vertical distance",
        3 => "taught values",
        6 => "every 2nd value",
        7 => "every 20th value",
        8 => "the current partial scan",
        _ => "unknown",
    }
}

/// Two requests that write the EEPROM. They are explained here and made in `lms_configure` only.
const POWER_ON_RATE: u8 = 0x66;
/// See [`POWER_ON_RATE`].
const WRITE_CONFIGURATION: u8 = 0x77;
/// Bit of the first value of a sub-range.
const DIRECT: u16 = 1 << 15;
