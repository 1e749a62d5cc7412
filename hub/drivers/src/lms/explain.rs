//! A telegram for people: every byte of it belongs to a field, and every field has a name, a value and, where there are
//! any, words. Without a heap, so the fields are shown to a visitor one after the other. Refuses to know how they are
//! printed.

mod headline;
mod names;
mod replies;
mod requests;
mod walk;

pub use headline::Headline;
pub use names::name;
pub use walk::{Field, Value};

use crate::lms::condition::Condition;
use crate::lms::telegram::{REPLY, Telegram};
use crate::lms::variant::{Mode, Unit};
use core::fmt;
use walk::{Walk, said};

/// Shows the fields of `telegram` to `visit`, from STX to the checksum, without a gap.
///
/// `mode` is how the sensor splits its values, which a telegram of values does not tell; without it their lower 13 bits
/// are taken for the range.
pub fn explain(telegram: Telegram<'_>, mode: Option<Mode>, visit: &mut dyn FnMut(&Field<'_>)) {
    let mut walk = Walk::new(telegram.bytes(), visit);
    // A telegram that is shorter than its layout ends early; the rest is shown as bytes.
    let _ = fields(&mut walk, telegram, mode);
    walk.leave(2 + usize::from(telegram.status().is_some()));
    if telegram.status().is_some() {
        walk.byte_as("status", Condition);
    }
    walk.word("checksum");
}

fn fields(walk: &mut Walk<'_, '_>, telegram: Telegram<'_>, mode: Option<Mode>) -> Option<()> {
    walk.open(5);
    walk.byte("STX")?;
    walk.byte_as("address", |byte| {
        said(move |f| match byte {
            0 => f.write_str("to all sensors"),
            1..REPLY => write!(f, "to sensor {byte}"),
            _ => write!(f, "from sensor {}", byte & !REPLY),
        })
    })?;
    walk.word_as("length", |length| said(move |f| write!(f, "{length} bytes from command to checksum")))?;
    walk.byte_as("command", |command| name(command, telegram.is_reply()).unwrap_or("unknown"))?;
    walk.open(5 + telegram.data().len());
    if telegram.is_reply() { replies::fields(walk, telegram, mode) } else { requests::fields(walk, telegram) }
}

/// Measured values with what is needed to read them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ranges<'a> {
    bytes: &'a [u8],
    /// How they are split.
    pub mode: Mode,
    /// Whether that is known, or taken for granted.
    pub mode_known: bool,
    /// Unit of the ranges.
    pub unit: Unit,
}

impl<'a> Ranges<'a> {
    /// The value words as they are.
    pub fn raw(&self) -> impl ExactSizeIterator<Item = u16> + 'a {
        self.bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]))
    }

    /// The range of each value in millimetres, or why there is none.
    pub fn millimetres(&self) -> impl ExactSizeIterator<Item = Result<u32, crate::lms::value::Code>> + 'a {
        let (mode, mm) = (self.mode, u32::from(self.unit.mm()));
        self.raw().map(move |word| mode.split(word).range.map(|range| u32::from(range) * mm))
    }

    /// The bits above the range.
    pub fn upper(&self) -> impl ExactSizeIterator<Item = u8> + 'a {
        let mode = self.mode;
        self.raw().map(move |word| mode.split(word).upper)
    }
}

impl fmt::Display for Ranges<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.mode_known && !self.mode.has_ranges() {
            return write!(f, "mode {:02X}h: {}", self.mode.0, self.mode.name());
        }
        let all = self.millimetres().len();
        let ranges = || self.millimetres().flatten();
        let none = all - ranges().count();
        match (ranges().min(), ranges().max()) {
            (Some(nearest), Some(farthest)) => write!(f, "{nearest} to {farthest} mm")?,
            _ => f.write_str("no range")?,
        }
        if none > 0 {
            write!(f, ", {none} of {all} without")?;
        }
        let bits = self.mode.range_bits();
        match (self.mode_known, self.mode.intensity_bits()) {
            (false, _) => write!(f, "; measuring mode unknown, {bits} bits taken for the range"),
            (true, 0) => write!(f, "; {bits} bits"),
            (true, levels) => write!(f, "; {bits} bits and {levels} of reflector level"),
        }
    }
}

/// Hundredths of a degree as people write them: 0.25, 0.5, 1.
struct Degrees(u16);

impl fmt::Display for Degrees {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.0 / 100, self.0 % 100) {
            (whole, 0) => write!(f, "{whole}"),
            (whole, part) if part % 10 == 0 => write!(f, "{whole}.{}", part / 10),
            (whole, part) => write!(f, "{whole}.{part:02}"),
        }
    }
}

fn unit_name(unit: Unit) -> &'static str {
    match unit {
        Unit::Cm => "cm",
        Unit::Mm => "mm",
        Unit::Dm => "10 cm",
    }
}

fn unit_words(code: u8) -> &'static str {
    Unit::of_code(code).map_or("unknown", unit_name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::Request;
    use crate::lms::measured;
    use std::string::{String, ToString};
    use std::vec::Vec;
    use std::{format, vec};

    fn told(telegram: Telegram<'_>, mode: Option<Mode>) -> Vec<(usize, String)> {
        let mut lines = vec![];
        explain(telegram, mode, &mut |field| {
            let words = field.words.map(|words| words.to_string()).unwrap_or_default();
            lines.push((field.offset, format!("{}: {words}", field.name)));
        });
        lines
    }

    #[test]
    fn a_request_field_by_field() {
        let request = Request::Variant(crate::lms::variant::Variant::HALF).encode(0);
        let lines = told(request.telegram(), None);
        let expected = [
            (0, "STX: "),
            (1, "address: to all sensors"),
            (2, "length: 5 bytes from command to checksum"),
            (4, "command: switch of angle and resolution"),
            (5, "angle: 180 degrees"),
            (7, "resolution: 0.5 degrees"),
            (9, "checksum: "),
        ];
        assert_eq!(lines, expected.map(|(at, line)| (at, line.to_string())));
    }

    #[test]
    fn a_scan_with_and_without_its_mode() {
        let encoded = measured::encode(1, Unit::Cm, &[0xA3E8, 0x3FFF, 200], 0x92);
        let words =
            |mode| told(encoded.telegram(), mode).into_iter().map(|(_, line)| line).collect::<Vec<_>>();
        let lines = words(None);
        assert_eq!(lines[1], "address: from sensor 1");
        assert_eq!(lines[4], "count and unit: 3 values in cm");
        assert!(lines[5].ends_with(
            "2000 to 10000 mm, 1 of 3 without; measuring mode unknown, 13 bits taken for the range"
        ));
        assert!(words(Some(Mode(1)))[5].ends_with("13 bits and 3 of reflector level"));
        assert!(words(Some(Mode(0x3F)))[5].contains("energy"));
        assert_eq!(lines[6], "status: warning, window polluted");
    }
}
