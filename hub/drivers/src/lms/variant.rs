//! Settings of a scanner: variant (angle and resolution), unit, measuring mode and baud rate, and the times that follow
//! from them. The measuring mode determines which of the 16 bits of a measured value are the range or a code. The other
//! bits are the upper bits (Telegram listing, 77h block D and 10.8).

use core::fmt;

use scanhub_schema::Nanos;

/// Duration of one revolution of the mirror: 75 Hz nominal (Telegram listing 10; a real motor word of 148 gives 13.32
/// ms).
pub const MIRROR_PERIOD: Nanos = 13_320_000;
/// Maximum number of bytes that the scanner sends per revolution. The scanner therefore sends a telegram of 732 bytes
/// in two bursts.
pub const BYTES_PER_REVOLUTION: usize = 508;
/// Maximum number of beams in one telegram: 100 degrees at 0.25.
pub const MAX_BEAMS: usize = 401;

/// Angle and resolution of a scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Variant {
    /// Field of view in degrees: 100 or 180.
    pub angle_deg: u16,
    /// Step between beams in 1/100 degree: 25, 50 or 100.
    pub resolution_cdeg: u16,
}

impl Variant {
    /// 180 degrees at 0.5 with 361 beams, the factory setting of an LMS 200 and 291.
    pub const HALF: Variant = Variant { angle_deg: 180, resolution_cdeg: 50 };

    /// All variants whose scans fit into a telegram. The scan of 180 degrees at 0.25 does not fit, because the maximum
    /// is 401 values.
    pub const ALL: [Variant; 5] = [
        Variant { angle_deg: 180, resolution_cdeg: 100 },
        Variant::HALF,
        Variant { angle_deg: 100, resolution_cdeg: 100 },
        Variant { angle_deg: 100, resolution_cdeg: 50 },
        Variant { angle_deg: 100, resolution_cdeg: 25 },
    ];

    /// Returns the variant of `angle_deg` degrees in steps of `resolution_cdeg` hundredths of a degree. Returns `None`
    /// if this variant does not exist.
    pub fn new(angle_deg: u16, resolution_cdeg: u16) -> Option<Variant> {
        Variant::ALL.into_iter().find(|v| v.angle_deg == angle_deg && v.resolution_cdeg == resolution_cdeg)
    }

    /// Returns the variant whose telegrams have `beams` values.
    pub fn of_beams(beams: usize) -> Option<Variant> {
        Variant::ALL.into_iter().find(|v| v.beams() == beams)
    }

    /// Returns the number of values in a telegram: 101, 181, 201, 361 or 401.
    pub fn beams(self) -> usize {
        usize::from(self.angle_deg * 100 / self.resolution_cdeg) + 1
    }

    /// Returns the number of revolutions of the mirror per scan: 1, 2 or 4.
    pub fn revolutions(self) -> u64 {
        u64::from(100 / self.resolution_cdeg)
    }

    /// Returns the angle of the first beam in 1/1000 degree, counterclockwise from straight ahead. Beams are symmetric
    /// to straight ahead.
    pub fn first_angle_mdeg(self) -> i32 {
        -500 * i32::from(self.angle_deg)
    }

    /// Returns the time between telegrams of `telegram_len` bytes at `baud`. This time is the smallest multiple of the
    /// scan time in which the line can carry a telegram (Telegram listing table 10-17).
    pub fn period(self, telegram_len: usize, baud: u32) -> Nanos {
        let scan = self.revolutions() * MIRROR_PERIOD;
        scan * scanhub_schema::line_time(telegram_len, baud).div_ceil(scan).max(1)
    }
}

/// Unit of a range.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Centimeters.
    Cm,
    /// Millimeters.
    Mm,
    /// Ten centimeters (reserved in the listing, but supported by several drivers).
    Dm,
}

impl Unit {
    /// Returns the number of millimeters per unit: 1, 10 or 100.
    pub fn mm(self) -> u8 {
        match self {
            Unit::Cm => 10,
            Unit::Mm => 1,
            Unit::Dm => 100,
        }
    }

    /// Returns the unit with code 0, 1 or 2, as in bits 14 and 15 of a count word and in byte 6 of the configuration.
    pub fn of_code(code: u8) -> Option<Unit> {
        [Unit::Cm, Unit::Mm, Unit::Dm].get(usize::from(code)).copied()
    }

    /// Returns the code of the unit.
    pub fn code(self) -> u8 {
        self as u8
    }
}

/// Measuring-mode byte of the configuration, which determines the range bits and the upper bits of a 16-bit value
/// (Telegram listing, 77h block D).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mode(pub u8);

impl Mode {
    /// Returns the number of low bits that are the range: 13, 14 or 15.
    pub fn range_bits(self) -> u8 {
        match self.0 {
            0x03 | 0x04 => 14,
            0x05 | 0x06 | 0x0F => 15,
            _ => 13,
        }
    }

    /// Returns the number of upper bits that are a reflector level: 3, 2 or 1. Returns 0 if the upper bits are field
    /// bits.
    pub fn intensity_bits(self) -> u8 {
        match self.0 {
            0x01 => 3,
            0x03 => 2,
            0x05 => 1,
            _ => 0,
        }
    }

    /// Returns the bits of a value that this mode never sets.
    pub fn forbidden(self) -> u16 {
        if self.0 == 0x0F { 0x8000 } else { 0 }
    }

    /// Returns the maximum value of the range bits. A value with this maximum means "no return".
    pub fn max_value(self) -> u16 {
        (1 << self.range_bits()) - 1
    }
}

/// Baud rate of the scanner's line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Baud {
    /// 9,600 bits per second, the rate after power-on.
    B9600,
    /// 19,200 bits per second.
    B19200,
    /// 38,400 bits per second.
    B38400,
    /// 500,000 bits per second; RS-422 only.
    B500000,
}

impl Baud {
    /// All baud rates, the slowest first.
    pub const ALL: [Baud; 4] = [Baud::B9600, Baud::B19200, Baud::B38400, Baud::B500000];

    /// Returns the rate in bits per second.
    pub const fn rate(self) -> u32 {
        match self {
            Baud::B9600 => 9_600,
            Baud::B19200 => 19_200,
            Baud::B38400 => 38_400,
            Baud::B500000 => 500_000,
        }
    }

    /// Returns the baud rate of `rate` bits per second.
    pub fn of_rate(rate: u32) -> Option<Baud> {
        Baud::ALL.into_iter().find(|b| b.rate() == rate)
    }
}

/// A measured value, split into its parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Value {
    /// Range in device units, or the code with the reason why there is no range.
    pub range: Result<u16, Code>,
    /// Bits above the range bits, shifted down: a reflector level or field bits, see [`Mode::intensity_bits`]. The
    /// documents contradict each other about which field bit is dazzle and which is field A. Field bits are therefore
    /// not decoded.
    pub upper: u8,
}

/// Reason why a value has no range. The highest values of the range bits are codes. A code is the difference between
/// the maximum and the value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// 0: no stop signal, because nothing was reflected.
    NoReturn,
    /// 1: dazzled.
    Dazzled,
    /// 2: overflow of the calculation.
    Overflow,
    /// 4: signal to noise too small.
    Noise,
    /// 5: channel 1 could not be read.
    Channel1,
    /// 8: the range exceeds the maximum.
    TooFar,
    /// 3, 6 or 7, which are undefined.
    Reserved(u8),
}

impl Code {
    /// Returns the code of a value that is `below_max` less than the maximum. Returns `None` if the value is a range.
    pub fn from_distance(below_max: u16) -> Option<Code> {
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
    /// Splits `word` into range and upper bits according to this mode.
    pub fn split(self, word: u16) -> Value {
        let range = word & self.max_value();
        let code = Code::from_distance(self.max_value() - range);
        Value { range: code.map_or(Ok(range), Err), upper: (word >> self.range_bits()) as u8 }
    }

    /// Returns whether values contain a range in a documented layout. 3Fh is energy, and 0Dh and 0Eh are reserved in
    /// the listing.
    pub fn has_ranges(self) -> bool {
        matches!(self.0, 0x00..=0x06 | 0x0F)
    }

    /// Returns the meaning of the mode as text.
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
            0x0D => "reserved; drivers use it for normalized remission",
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
    fn beams_and_periods_match_the_listing() {
        assert_eq!(Variant::ALL.map(Variant::beams), [181, 361, 101, 201, 401]);
        assert_eq!(Variant::of_beams(361), Some(Variant::HALF));
        assert_eq!(Variant::new(180, 25), None);
        // Table 10-17: depending on the baud rate, the scanner sends a telegram of 361 beams in every 29, 15, 8 or 1
        // scans.
        let scans = Baud::ALL.map(|b| Variant::HALF.period(732, b.rate()) / (2 * MIRROR_PERIOD));
        assert_eq!(scans, [29, 15, 8, 1]);
        assert_eq!(Variant::new(100, 25).unwrap().period(812, 9_600) / MIRROR_PERIOD, 64);
        assert_eq!(Variant::new(100, 25).unwrap().first_angle_mdeg(), -50_000);
    }

    #[test]
    fn mode_determines_bits_of_a_value() {
        assert_eq!((Mode(1).range_bits(), Mode(1).intensity_bits(), Mode(1).max_value()), (13, 3, 8191));
        assert_eq!((Mode(4).range_bits(), Mode(4).intensity_bits()), (14, 0));
        assert_eq!((Mode(5).range_bits(), Mode(5).intensity_bits()), (15, 1));
    }

    #[test]
    fn codes_match_the_listing() {
        // The modes have 13, 14 and 15 range bits. The listing has a misprint: 16385 in place of 16375.
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
    fn splits_upper_bits_from_the_range() {
        assert_eq!(Mode(1).split(0xA3E8), Value { range: Ok(1000), upper: 5 });
        assert_eq!(Mode(4).split(0xC3E8), Value { range: Ok(1000), upper: 3 });
        assert_eq!(Mode(5).split(0x83E8), Value { range: Ok(1000), upper: 1 });
        assert!(Mode(0x0F).has_ranges() && !Mode(0x3F).has_ranges() && !Mode(0x0D).has_ranges());
    }
}
