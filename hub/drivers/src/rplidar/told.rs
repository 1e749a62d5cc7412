//! What a scanner says of itself, and what a session does, in plain values.

use core::fmt;

use crate::rplidar::model::{Mode, Model, Motor};

/// What a scanner says that it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Info {
    /// The number of its model: the series in the upper half.
    pub id: u8,
    /// Version of its firmware, before and after the point.
    pub firmware: (u8, u8),
    /// Revision of its hardware.
    pub hardware: u8,
    /// Its serial number.
    pub serial: [u8; 16],
}

impl Info {
    pub(crate) fn parse(reply: &[u8]) -> Option<Info> {
        let &[id, minor, major, hardware, ref serial @ ..] = reply.first_chunk::<20>()?;
        Some(Info { id, firmware: (major, minor), hardware, serial: *serial })
    }

    /// Its model, if it is known here.
    pub fn model(&self) -> Option<Model> {
        Model::of_id(self.id)
    }

    pub(crate) fn motor(&self) -> Motor {
        match self.id >> 4 {
            0 | 1 => Motor::Dtr,
            2..=5 => Motor::Board,
            _ => Motor::Speed,
        }
    }
}

/// How a scanner says that it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Health {
    /// Well.
    Good,
    /// It measures, and may not for long; its code.
    Warning(u16),
    /// It does not measure; its code.
    Error(u16),
}

impl Health {
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

/// Why a session is not where it should be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trouble {
    /// No answer, or in a recording no packets.
    NoAnswer {
        /// The only rate at which was asked; `None`: at all of them.
        baud: Option<u32>,
        /// For how long already, in steps that grow.
        seconds: u32,
    },
    /// One second without measured data.
    Silence,
    /// Packets come, but the head does not turn.
    StandsStill,
    /// The scanner says that it is not well, or that it may not be for long.
    Unwell(Health),
    /// It answers, but does not begin to measure.
    Refused,
    /// In a recording there are packets that look like those of two kinds, and nothing tells of which they are.
    Alike,
    /// It does not have this mode, or its line cannot carry it: it measures in another one.
    NoMode(Mode),
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Trouble::NoAnswer { baud, seconds } => {
                f.write_str("no answer at ")?;
                match baud {
                    Some(baud) => write!(f, "{baud}")?,
                    None => f.write_str("115200, 256000, 460800 and 1000000")?,
                }
                write!(f, " baud for {seconds} s: power, cable, other port?")
            }
            Trouble::Silence => f.write_str("no measured data for one second"),
            Trouble::StandsStill => f.write_str("packets come, but the head does not turn: is it blocked?"),
            Trouble::Unwell(health) => write!(f, "the scanner reports: {health}"),
            Trouble::Refused => f.write_str("the scanner answers, but does not begin to measure"),
            Trouble::Alike => f.write_str(
                "the packets may be of two kinds (82h or 85h), which nothing here tells: name the model or the mode",
            ),
            Trouble::NoMode(mode) => {
                write!(
                    f,
                    "the scanner or its line cannot do mode {}: it measures in its fastest one",
                    mode.name()
                )
            }
        }
    }
}
