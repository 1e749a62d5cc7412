//! What the 16 bits of a measured value say, given the measuring mode: a range, or a code in its place, and the bits
//! above it (Telegram listing, 77h block D and 10.8).

use crate::lms::variant::Mode;
use core::fmt;

/// A measured value, split.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Value {
    /// The range in device units, or why there is none.
    pub range: Result<u16, Code>,
    /// The bits above the range, moved down: a reflector level or field bits, as [`Mode::intensity_bits`] says. The
    /// documents contradict each other about which field bit is dazzle and which is field A, so they stay bits.
    pub upper: u8,
}

/// Why there is no range: the greatest values are codes, counted down from the greatest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// 0: no stop signal, nothing came back.
    NoReturn,
    /// 1: dazzled.
    Dazzled,
    /// 2: overflow of the calculation.
    Overflow,
    /// 4: signal to noise too small.
    Noise,
    /// 5: channel 1 could not be read.
    Channel1,
    /// 8: more than the greatest range.
    TooFar,
    /// 3, 6 or 7, without a meaning.
    Reserved(u8),
}

impl Code {
    /// The code of a value that is so much less than the greatest; `None` if it is a range.
    pub fn of_distance(below_max: u16) -> Option<Code> {
        Some(match below_max {
            0 => Code::NoReturn,
            1 => Code::Dazzled,
            2 => Code::Overflow,
            4 => Code::Noise,
            5 => Code::Channel1,
            8 => Code::TooFar,
            3 | 6 | 7 => Code::Reserved(below_max as u8),
            _ => return None,
        })
    }
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Code::NoReturn => "no return",
            Code::Dazzled => "dazzled",
            Code::Overflow => "overflow",
            Code::Noise => "too much noise",
            Code::Channel1 => "channel 1 unreadable",
            Code::TooFar => "beyond the range",
            Code::Reserved(code) => return write!(f, "reserved code {code}"),
        })
    }
}

impl Mode {
    /// `word` as this mode splits it.
    pub fn split(self, word: u16) -> Value {
        let range = word & self.max_value();
        let code = Code::of_distance(self.max_value() - range);
        Value { range: code.map_or(Ok(range), Err), upper: (word >> self.range_bits()) as u8 }
    }

    /// Whether its values hold a range at all, split in a way that the listing tells: 3Fh is energy, and 0Dh and 0Eh are
    /// reserved there.
    pub fn has_ranges(self) -> bool {
        matches!(self.0, 0x00..=0x06 | 0x0F)
    }

    /// What it measures, in words.
    pub fn name(self) -> &'static str {
        match self.0 {
            0x00 => "8 m (80 m), fields A and B, dazzle",
            0x01 => "8 m (80 m), 8 reflector levels",
            0x02 => "8 m (80 m), fields A, B and C",
            0x03 => "16 m (160 m), 4 reflector levels",
            0x04 => "16 m (160 m), fields A and B",
            0x05 => "32 m, 2 reflector levels",
            0x06 => "32 m, field A",
            0x0F => "32 m, no bits above",
            0x0D => "reserved; drivers use it for normalised remission",
            0x0E => "reserved; drivers use it for remission",
            0x3F => "energy, no range",
            _ => "unknown",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_of_the_listing() {
        // 13, 14 and 15 bits; the listing prints 16385 for 16375.
        for (mode, words) in [
            (Mode(0), [8191, 8190, 8189, 8187, 8186, 8183]),
            (Mode(4), [16383, 16382, 16381, 16379, 16378, 16375]),
            (Mode(6), [32767, 32766, 32765, 32763, 32762, 32759]),
        ] {
            let codes =
                [Code::NoReturn, Code::Dazzled, Code::Overflow, Code::Noise, Code::Channel1, Code::TooFar];
            for (word, code) in words.into_iter().zip(codes) {
                assert_eq!(mode.split(word), Value { range: Err(code), upper: 0 });
            }
            assert_eq!(mode.split(words[5] - 1).range, Ok(words[5] - 1));
        }
    }

    #[test]
    fn upper_bits() {
        assert_eq!(Mode(1).split(0xA3E8), Value { range: Ok(1000), upper: 5 });
        assert_eq!(Mode(4).split(0xC3E8), Value { range: Ok(1000), upper: 3 });
        assert_eq!(Mode(5).split(0x83E8), Value { range: Ok(1000), upper: 1 });
        assert!(Mode(0x0F).has_ranges() && !Mode(0x3F).has_ranges() && !Mode(0x0D).has_ranges());
    }
}
