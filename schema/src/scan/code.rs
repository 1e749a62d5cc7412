//! Why a beam has no valid reading: the values above the ranges. Those of an LMS are its own; for all
//! other families they are the same, at the upper end.

use super::{Family, Scan, ScanHead, lms};

/// Why a beam has no valid reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// Nothing was measured there.
    NotMeasured,
    /// No echo.
    NoReturn,
    /// An echo from beyond the range limit.
    Beyond,
    /// Something is nearer than can be measured.
    TooNear,
    /// The receiver was dazzled.
    TooBright,
    /// Too little signal for the noise.
    Weak,
    /// The measurement overflowed.
    Overflow,
    /// The sensor could not read its own measurement.
    Error,
}

impl Code {
    /// Returns the word for it in all output.
    pub fn name(self) -> &'static str {
        match self {
            Code::NotMeasured => "not_measured",
            Code::NoReturn => "no_return",
            Code::Beyond => "beyond",
            Code::TooNear => "too_near",
            Code::TooBright => "too_bright",
            Code::Weak => "weak",
            Code::Overflow => "overflow",
            Code::Error => "error",
        }
    }

    /// Returns the value that stands for it in scans of all families but the LMS.
    pub const fn value(self) -> u16 {
        match self {
            Code::NotMeasured => Scan::NOT_MEASURED,
            Code::NoReturn => 0xFFFE,
            Code::Beyond => 0xFFFD,
            Code::TooNear => 0xFFFC,
            Code::TooBright => 0xFFFB,
            Code::Weak => 0xFFFA,
            Code::Overflow => 0xFFF9,
            Code::Error => 0xFFF8,
        }
    }

    /// Returns what `value` stands for in a scan with `head`, where it is no range.
    pub(super) fn of(head: &ScanHead, value: u16) -> Code {
        if value == Scan::NOT_MEASURED {
            return Code::NotMeasured;
        }
        if head.family == Family::Lms as u8 {
            return lms::code(head, value);
        }
        let all = [Code::NoReturn, Code::Beyond, Code::TooNear, Code::TooBright, Code::Weak, Code::Overflow];
        all.into_iter().find(|code| code.value() == value).unwrap_or(Code::Error)
    }
}
