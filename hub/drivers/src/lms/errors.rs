//! The errors of a B2h reply: pairs of a type and a number, what is and what was (Telegram listing 7-18 and 9).

use crate::lms::condition::Severity;
use core::fmt;

/// The errors of a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Errors<'a>(&'a [u8]);

impl<'a> Errors<'a> {
    /// The pairs that `bytes` are; `None` if one is cut.
    pub fn new(bytes: &'a [u8]) -> Option<Errors<'a>> {
        bytes.len().is_multiple_of(2).then_some(Errors(bytes))
    }

    /// The bytes as they came.
    pub fn bytes(&self) -> &'a [u8] {
        self.0
    }

    /// In the order in which the sensor tells them.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Fault> + Clone + 'a {
        self.0.chunks_exact(2).map(|pair| Fault { kind: pair[0], number: pair[1] })
    }
}

/// One error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault {
    /// Its type: the severity, and 80h if it is past.
    pub kind: u8,
    /// Its number.
    pub number: u8,
}

impl Fault {
    /// How bad it is; `None` for codes without a meaning.
    pub fn severity(self) -> Option<Severity> {
        Severity::of_code(self.kind & !PAST)
    }

    /// Whether it is over, and only kept in memory; 10h clears it.
    pub fn is_past(self) -> bool {
        self.kind & PAST != 0
    }

    /// What its number means; `None` for one that is not known here.
    pub fn meaning(self) -> Option<&'static str> {
        Some(match self.number {
            5 => "dazzled",
            6 | 7 => "comparator",
            15 => "time measurement (TDC)",
            17 | 20 => "oil on the window",
            18 | 19 => "dirt on the window",
            21 | 22 => "reference of the pollution measurement",
            27 | 28 => "switching outputs",
            29 => "motor revolutions",
            37 => "calibration of the pollution measurement",
            45 => "a value is missing",
            46 => "a scan is missing",
            47 => "reference target",
            48 | 49 => "laser power",
            53 => "FLASH written",
            56 => "watchdog",
            57 => "no zero index",
            58..=61 => "synchronisation of two sensors",
            62 => "DIP switches",
            86..=92 => "reference target",
            124..=126 => "memory",
            _ => return None,
        })
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.is_past() { "past " } else { "" })?;
        match self.severity() {
            Some(severity) => f.write_str(severity.name())?,
            None => write!(f, "type {:02X}", self.kind & !PAST)?,
        }
        write!(f, " {}", self.number)?;
        match self.meaning() {
            Some(meaning) => write!(f, ": {meaning}"),
            None => Ok(()),
        }
    }
}

/// Added to the type of an error that is over.
const PAST: u8 = 0x80;

#[cfg(test)]
mod tests {
    use super::*;
    use std::{string::ToString, vec::Vec};

    #[test]
    fn a_captured_list() {
        // B2 84 16 (84 31)x8 84 16 01 31, less the eight.
        let errors = Errors::new(&[0x84, 0x16, 0x84, 0x31, 1, 0x31]).unwrap();
        let words: Vec<_> = errors.iter().map(|fault| fault.to_string()).collect();
        assert_eq!(
            words,
            [
                "past fatal 22: reference of the pollution measurement",
                "past fatal 49: laser power",
                "info 49: laser power"
            ]
        );
        assert_eq!(Errors::new(&[1]), None);
        assert_eq!(Fault { kind: 0x7F, number: 1 }.to_string(), "type 7F 1");
    }
}
