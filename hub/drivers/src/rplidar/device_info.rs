//! Identity and health that a scanner reports.

use core::fmt;

use crate::rplidar::model::{Model, Motor};

/// Identity of a scanner, from its reply to `A5 50`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Info {
    /// Number of the model. The upper four bits are the series.
    pub id: u8,
    /// Version of the firmware: major, minor.
    pub firmware: (u8, u8),
    /// Revision of the hardware.
    pub hardware: u8,
    /// Serial number.
    pub serial: [u8; 16],
}

impl Info {
    /// Decodes a reply.
    pub(crate) fn parse(reply: &[u8]) -> Option<Info> {
        let &[id, minor, major, hardware, ref serial @ ..] = reply.first_chunk::<20>()?;
        Some(Info { id, firmware: (major, minor), hardware, serial: *serial })
    }

    /// Returns the model, if scanhub knows its number.
    pub fn model(&self) -> Option<Model> {
        Model::of_id(self.id)
    }

    /// Returns how the motor is controlled.
    pub(crate) fn motor(&self) -> Motor {
        match self.id >> 4 {
            0 | 1 => Motor::Dtr,
            2..=5 => Motor::Board,
            _ => Motor::Speed,
        }
    }
}

/// Health of a scanner, from its reply to `A5 52`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Health {
    /// The scanner works.
    Good,
    /// The scanner measures, but may fail soon; with its error code.
    Warning(u16),
    /// The scanner does not measure; with its error code.
    Error(u16),
}

impl Health {
    /// Decodes a reply.
    pub(crate) fn parse(reply: &[u8]) -> Option<Health> {
        let &[status, low, high] = reply.first_chunk()?;
        let code = u16::from_le_bytes([low, high]);
        Some(match status {
            0 => Health::Good,
            1 => Health::Warning(code),
            _ => Health::Error(code),
        })
    }
}

impl fmt::Display for Health {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Health::Good => f.write_str("good"),
            Health::Warning(code) => write!(f, "warning, code {code:04X}h: it measures, and may fail soon"),
            Health::Error(code) => {
                write!(
                    f,
                    "error, code {code:04X}h: it protects itself and does not measure; is its head blocked?"
                )
            }
        }
    }
}
