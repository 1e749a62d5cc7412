//! The families of scanners, by number and name, and the scan of one whose head turns. Refuses to know what they speak.

use std::f64::consts::TAU;

use super::{Code, Contents, ScanHead};

/// A family of scanners: what speaks one protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Family {
    /// SICK LMS 200, 211, 221 and 291.
    Lms = 0,
    /// LDROBOT LD06, LD19, STL19P, STL27L and LD14P.
    Ld = 1,
}

impl Family {
    /// All of them.
    pub const ALL: [Family; 2] = [Family::Lms, Family::Ld];

    /// Returns the family's name in configurations and in all output.
    pub fn name(self) -> &'static str {
        match self {
            Family::Lms => "lms",
            Family::Ld => "ld",
        }
    }

    /// Returns the family called `name`.
    pub fn parse(name: &str) -> Option<Family> {
        Family::ALL.into_iter().find(|family| family.name() == name)
    }

    /// Returns the family with this number, as in a scan's head.
    pub fn of_number(number: u8) -> Option<Family> {
        Family::ALL.into_iter().find(|family| *family as u8 == number)
    }
}

impl ScanHead {
    /// Returns the head of a turn of a scanner of `family` that turns clockwise, put on a grid of `beams` equal bins of which
    /// the first is ahead: ranges in millimetres, intensities of 8 bits, exact angles. Its times are to be set.
    pub fn turning(family: Family, beams: usize) -> ScanHead {
        let step = -TAU / beams.max(1) as f64;
        ScanHead {
            step,
            spacing: -step as f32,
            unit_um: 1000,
            count: beams as u16,
            valid_to: Code::Error.value() - 1,
            no_return: Code::NoReturn.value(),
            beyond: Code::NoReturn.value(),
            family: family as u8,
            contents: Contents::TURNING,
            intensity_bits: 8,
            ..ScanHead::default()
        }
    }
}
