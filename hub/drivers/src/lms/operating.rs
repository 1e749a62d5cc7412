//! Operating modes, which follow the command byte 20h. The requests to stream, to stop and to change the baud rate are
//! not part of [`Operating`].

use crate::lms::command::{Parameter, Password, RawParameters, SubRange, SubRanges, requests};
use crate::lms::telegram::Writer;
use crate::lms::variant::Baud;

requests! {
    /// An operating mode other than [`crate::lms::command::Request::Stream`], `Stop` and `Baud` (Telegram listing 7.3).
    Operating by byte {
        /// 00h: installation, the only mode in which the EEPROM can be written. This mode blocks the field outputs.
        Installation(password: Password) = INSTALLATION,
        /// 10h: diagnosis.
        Diagnosis = 0x10,
        /// 20h: the lowest value of each segment, continuously.
        SegmentMinimum = 0x20,
        /// 21h: the lowest value of each segment, when an object is in a field.
        SegmentMinimumOnObject = 0x21,
        /// 22h: the shortest vertical distance, continuously.
        VerticalMinimum = 0x22,
        /// 23h: the shortest vertical distance, when an object is in a field.
        VerticalMinimumOnObject = 0x23,
        /// 26h: mean values of this number of scans, continuously; each telegram is a B6h.
        Means(number: u8) = MEANS,
        /// 27h: a sub-range, continuously; each telegram is a B7h.
        Range(span: SubRange) = RANGE,
        /// 28h: mean values of a sub-range, continuously; each telegram is a BFh.
        RangeMeans(number: u8, span: SubRange) = RANGE_MEANS,
        /// 29h: a sub-range with field values, continuously; each telegram is a BEh.
        RangeFields(span: SubRange) = RANGE_FIELDS,
        /// 2Ah: a partial scan after each revolution of the mirror; each telegram is a B0h.
        Partial = PARTIAL,
        /// 2Bh: ranges and reflectivities of sub-ranges, continuously; each telegram is an F5h.
        Reflectivities(spans: SubRanges) = REFLECTIVITIES,
        /// 2Ch: the lowest value of each segment in a sub-range. The parameters are not decoded.
        SegmentMinimumOfRange(raw: RawParameters) = 0x2C,
        /// 2Eh: records for navigation.
        Navigation = 0x2E,
        /// 30h: tests a password.
        TestPassword(password: Password) = 0x30,
        /// 50h: ranges, and reflectivities of a sub-range, continuously; each telegram is a C4h. Version S14 only.
        Reflectivity(span: SubRange) = 0x50,
    }
}

impl Parameter for Operating {
    fn read(data: &[u8]) -> Option<(Operating, &[u8])> {
        let (&mode, parameters) = data.split_first()?;
        Some((Operating::read_parameters(mode, parameters)?, &[]))
    }

    fn write(self, writer: Writer) -> Writer {
        self.write_parameters(writer.byte(self.byte()))
    }
}

/// Returns the name of an operating mode (Telegram listing 7.3).
pub fn name(mode: u8) -> &'static str {
    match mode {
        INSTALLATION => "installation",
        0x10 => "diagnosis",
        0x20 => "lowest value of each segment, continuously",
        0x21 => "lowest value of each segment, on an object",
        0x22 => "shortest vertical distance, continuously",
        0x23 => "shortest vertical distance, on an object",
        STREAM => "all values, continuously",
        ON_REQUEST => "values on request",
        MEANS => "mean values, continuously",
        RANGE => "values of a sub-range, continuously",
        RANGE_MEANS => "mean values of a sub-range, continuously",
        RANGE_FIELDS => "values of a sub-range with field values, continuously",
        PARTIAL => "partial scans, immediately",
        REFLECTIVITIES => "ranges and reflectivities of sub-ranges, continuously",
        0x2C => "lowest value of each segment in a sub-range, continuously",
        0x2E => "records for navigation",
        0x30 => "test of a password",
        0x40 => "38400 baud",
        0x41 => "19200 baud",
        0x42 => "9600 baud",
        0x48 => "500000 baud",
        0x50 => "ranges, and reflectivities of a sub-range, continuously",
        _ => "unknown",
    }
}

/// Returns the mode byte that changes the baud rate to `baud`.
pub fn of_baud(baud: Baud) -> u8 {
    match baud {
        Baud::B38400 => 0x40,
        Baud::B19200 => 0x41,
        Baud::B9600 => 0x42,
        Baud::B500000 => 0x48,
    }
}

impl Parameter for Baud {
    fn read(data: &[u8]) -> Option<(Baud, &[u8])> {
        let (&mode, rest) = data.split_first()?;
        Some((Baud::ALL.into_iter().find(|&baud| of_baud(baud) == mode)?, rest))
    }

    fn write(self, writer: Writer) -> Writer {
        writer.byte(of_baud(self))
    }
}

/// Operating mode: installation.
pub const INSTALLATION: u8 = 0x00;
/// Operating mode: all values, continuously.
pub const STREAM: u8 = 0x24;
/// Operating mode: values on request, as after power-on.
pub const ON_REQUEST: u8 = 0x25;
/// Operating mode: mean values.
pub const MEANS: u8 = 0x26;
/// Operating mode: a sub-range.
pub const RANGE: u8 = 0x27;
/// Operating mode: mean values of a sub-range.
pub const RANGE_MEANS: u8 = 0x28;
/// Operating mode: a sub-range with field values.
pub const RANGE_FIELDS: u8 = 0x29;
/// Operating mode: partial scans.
pub const PARTIAL: u8 = 0x2A;
/// Operating mode: ranges and reflectivities of sub-ranges.
pub const REFLECTIVITIES: u8 = 0x2B;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::{MODE, Request};

    #[test]
    fn every_operating_mode_round_trips() {
        let span = SubRange { first: 1, last: 181 };
        let modes = [
            Operating::Installation(Password::FACTORY),
            Operating::Diagnosis,
            Operating::SegmentMinimum,
            Operating::SegmentMinimumOnObject,
            Operating::VerticalMinimum,
            Operating::VerticalMinimumOnObject,
            Operating::Means(20),
            Operating::Range(span),
            Operating::RangeMeans(2, span),
            Operating::RangeFields(span),
            Operating::Partial,
            Operating::Reflectivities(SubRanges::new(&[span, span]).unwrap()),
            Operating::SegmentMinimumOfRange(RawParameters::new(&[1, 0, 1, 0]).unwrap()),
            Operating::Navigation,
            Operating::TestPassword(Password(*b"password")),
            Operating::Reflectivity(span),
        ];
        for mode in modes {
            let encoded = Request::Operate(mode).encode(0);
            assert_eq!(encoded.telegram().data()[0], mode.byte());
            assert_eq!(Request::decode(encoded.telegram()), Some(Request::Operate(mode)));
            assert_ne!(name(mode.byte()), "unknown");
        }
    }

    #[test]
    fn reflectivity_request_matches_carmen() {
        // CARMEN sends 20 2B 01 00 01 00 B5 00.
        let spans = SubRanges::new(&[SubRange { first: 1, last: 181 }]).unwrap();
        let encoded = Request::Operate(Operating::Reflectivities(spans)).encode(0);
        assert_eq!(encoded.telegram().data(), [0x2B, 1, 0, 1, 0, 0xB5, 0]);
    }

    #[test]
    fn operating_mode_with_bad_parameters_is_refused() {
        for data in [&[][..], &[0, 1, 2], &[0x24, 0], &[0x26], &[0x27, 1, 0, 2], &[0x43], &[0x2B, 6, 0]] {
            let telegram = Writer::new(0, MODE).slice(data).finish();
            assert_eq!(Request::decode(telegram.telegram()), None, "{data:?}");
        }
    }
}
