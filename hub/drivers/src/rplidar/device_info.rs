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
    /// Length of a reply, in bytes.
    pub(crate) const LEN: usize = 20;

    /// Decodes a reply.
    pub(crate) fn parse(reply: &[u8]) -> Option<Info> {
        let &[id, minor, major, hardware, ref serial @ ..] = reply.first_chunk::<{ Info::LEN }>()?;
        Some(Info { id, firmware: (major, minor), hardware, serial: *serial })
    }

    /// Returns the identity of a scanner whose status has this `text` as its type, such as `S2 denseboost 1.02`. A status has
    /// no hardware revision and no serial number: they are 0. Returns `None` if neither `model` nor the text has the number
    /// of the model.
    pub(crate) fn of_status(model: Option<Model>, text: &str) -> Option<Info> {
        let words: Vec<&str> = text.split_whitespace().collect();
        let number = |word: &&str| u8::from_str_radix(word.strip_prefix("0x")?, 16).ok();
        let version = |word: &&str| {
            let (major, minor) = word.split_once('.')?;
            major.parse().ok().zip(minor.parse().ok())
        };
        let id = model.map(Model::id).or_else(|| words.first().and_then(number))?;
        let firmware = words.last().and_then(version).unwrap_or_default();
        Some(Info { id, firmware, hardware: 0, serial: [0; 16] })
    }

    /// Encodes the reply.
    pub(crate) fn encode(&self) -> [u8; Info::LEN] {
        let mut reply = [0; Info::LEN];
        let (major, minor) = self.firmware;
        reply[..4].copy_from_slice(&[self.id, minor, major, self.hardware]);
        reply[4..].copy_from_slice(&self.serial);
        reply
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identity_of_a_status() {
        let info = Info::of_status(Some(Model::S2), "S2 denseboost 1.02").unwrap();
        assert_eq!((info.id, info.firmware), (0x71, (1, 2)));
        assert_eq!(Info::parse(&info.encode()), Some(info));
        let unknown = Info::of_status(None, "0x95 standard 1.30").unwrap();
        assert_eq!((unknown.id, unknown.firmware), (0x95, (1, 30)));
        assert_eq!(Info::of_status(Some(Model::A1), "").map(|info| info.firmware), Some((0, 0)));
        assert_eq!(Info::of_status(None, "A7 standard"), None);
    }
}
