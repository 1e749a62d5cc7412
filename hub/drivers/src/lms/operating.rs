//! Operating modes: what follows command 20h. The two that every conversation needs, and the rates, are requests of
//! their own; all others are here.

use crate::lms::command::{Password, Raw, Span, Spans};
use crate::lms::telegram::Writer;
use crate::lms::variant::Baud;

/// An operating mode beside [`crate::lms::command::Request::Stream`], `Stop` and `Baud` (Telegram listing 7.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operating {
    /// 00h: installation, the only mode in which the EEPROM can be written; the fields' outputs are blocked in it.
    Installation(Password),
    /// 10h: diagnosis.
    Diagnosis,
    /// 20h: the least value of each segment, continuously.
    SegmentMinimum,
    /// 21h: the same, when an object is in a field.
    SegmentMinimumOnObject,
    /// 22h: the least vertical distance, continuously.
    VerticalMinimum,
    /// 23h: the same, when an object is in a field.
    VerticalMinimumOnObject,
    /// 26h: mean values of so many scans, continuously; each telegram is a B6h.
    Means(u8),
    /// 27h: a sub-range, continuously; each telegram is a B7h.
    Range(Span),
    /// 28h: mean values of a sub-range, continuously; BFh.
    RangeMeans(u8, Span),
    /// 29h: a sub-range with field values, continuously; BEh.
    RangeFields(Span),
    /// 2Ah: each mirror turn as soon as it is through; B0h of partial scans.
    Partial,
    /// 2Bh: ranges and reflectivities of sub-ranges, continuously; F5h.
    Reflectivities(Spans),
    /// 2Ch: the least value of each segment in a sub-range. The parameters as they are: their layout is not known here.
    SegmentMinimumOfRange(Raw),
    /// 2Eh: records for navigation.
    Navigation,
    /// 30h: asks whether a password is right.
    TestPassword(Password),
    /// 50h: ranges, and reflectivities of a sub-range, continuously; C4h. LMS S14 only.
    Reflectivity(Span),
}

impl Operating {
    /// The mode that `data`, all bytes after command 20h, ask for.
    pub(crate) fn decode(data: &[u8]) -> Option<Operating> {
        let (&mode, parameters) = data.split_first()?;
        Some(match (mode, parameters) {
            (INSTALLATION, _) => Operating::Installation(Password(parameters.try_into().ok()?)),
            (0x10, []) => Operating::Diagnosis,
            (0x20, []) => Operating::SegmentMinimum,
            (0x21, []) => Operating::SegmentMinimumOnObject,
            (0x22, []) => Operating::VerticalMinimum,
            (0x23, []) => Operating::VerticalMinimumOnObject,
            (MEANS, &[shots]) => Operating::Means(shots),
            (RANGE, span) => Operating::Range(Span::read(span)?),
            (RANGE_MEANS, &[shots, ref span @ ..]) => Operating::RangeMeans(shots, Span::read(span)?),
            (RANGE_FIELDS, span) => Operating::RangeFields(Span::read(span)?),
            (PARTIAL, []) => Operating::Partial,
            (REFLECTIVITIES, spans) => Operating::Reflectivities(Spans::read_counted(spans)?),
            (0x2C, raw) => Operating::SegmentMinimumOfRange(Raw::new(raw)?),
            (0x2E, []) => Operating::Navigation,
            (0x30, _) => Operating::TestPassword(Password(parameters.try_into().ok()?)),
            (0x50, span) => Operating::Reflectivity(Span::read(span)?),
            _ => return None,
        })
    }

    pub(crate) fn write(self, writer: Writer) -> Writer {
        let writer = writer.byte(self.byte());
        match self {
            Operating::Installation(password) | Operating::TestPassword(password) => {
                writer.slice(&password.0)
            }
            Operating::Means(shots) => writer.byte(shots),
            Operating::Range(span) | Operating::RangeFields(span) | Operating::Reflectivity(span) => {
                span.write(writer)
            }
            Operating::RangeMeans(shots, span) => span.write(writer.byte(shots)),
            Operating::Reflectivities(spans) => spans.write(writer.word(spans.as_slice().len() as u16)),
            Operating::SegmentMinimumOfRange(raw) => writer.slice(raw.as_slice()),
            Operating::Diagnosis
            | Operating::SegmentMinimum
            | Operating::SegmentMinimumOnObject
            | Operating::VerticalMinimum
            | Operating::VerticalMinimumOnObject
            | Operating::Partial
            | Operating::Navigation => writer,
        }
    }

    /// The byte after command 20h, which a status report tells.
    pub fn byte(self) -> u8 {
        match self {
            Operating::Installation(_) => INSTALLATION,
            Operating::Diagnosis => 0x10,
            Operating::SegmentMinimum => 0x20,
            Operating::SegmentMinimumOnObject => 0x21,
            Operating::VerticalMinimum => 0x22,
            Operating::VerticalMinimumOnObject => 0x23,
            Operating::Means(_) => MEANS,
            Operating::Range(_) => RANGE,
            Operating::RangeMeans(..) => RANGE_MEANS,
            Operating::RangeFields(_) => RANGE_FIELDS,
            Operating::Partial => PARTIAL,
            Operating::Reflectivities(_) => REFLECTIVITIES,
            Operating::SegmentMinimumOfRange(_) => 0x2C,
            Operating::Navigation => 0x2E,
            Operating::TestPassword(_) => 0x30,
            Operating::Reflectivity(_) => 0x50,
        }
    }
}

/// What an operating mode is, in words (Telegram listing 7.3).
pub fn name(mode: u8) -> &'static str {
    match mode {
        INSTALLATION => "installation",
        0x10 => "diagnosis",
        0x20 => "least value of each segment, continuously",
        0x21 => "least value of each segment, on an object",
        0x22 => "least vertical distance, continuously",
        0x23 => "least vertical distance, on an object",
        STREAM => "all values, continuously",
        ON_REQUEST => "values on request",
        MEANS => "mean values, continuously",
        RANGE => "values of a sub-range, continuously",
        RANGE_MEANS => "mean values of a sub-range, continuously",
        RANGE_FIELDS => "values of a sub-range with field values, continuously",
        PARTIAL => "partial scans, at once",
        REFLECTIVITIES => "ranges and reflectivities of sub-ranges, continuously",
        0x2C => "least value of each segment in a sub-range, continuously",
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

/// The mode that changes the line's rate to `baud`.
pub fn of_baud(baud: Baud) -> u8 {
    match baud {
        Baud::B38400 => 0x40,
        Baud::B19200 => 0x41,
        Baud::B9600 => 0x42,
        Baud::B500000 => 0x48,
    }
}

/// The rate that a mode changes the line to.
pub fn baud_of(mode: u8) -> Option<Baud> {
    Baud::ALL.into_iter().find(|&baud| of_baud(baud) == mode)
}

/// Operating mode: installation.
pub const INSTALLATION: u8 = 0x00;
/// Operating mode: all values, continuously.
pub const STREAM: u8 = 0x24;
/// Operating mode: values on request; so a sensor begins.
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
    fn every_mode_both_ways() {
        let span = Span { first: 1, last: 181 };
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
            Operating::Reflectivities(Spans::new(&[span, span]).unwrap()),
            Operating::SegmentMinimumOfRange(Raw::new(&[1, 0, 1, 0]).unwrap()),
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
    fn one_range_as_drivers_ask_for_it() {
        // 20 2B 01 00 01 00 B5 00, as CARMEN says it.
        let spans = Spans::new(&[Span { first: 1, last: 181 }]).unwrap();
        let encoded = Request::Operate(Operating::Reflectivities(spans)).encode(0);
        assert_eq!(encoded.telegram().data(), [0x2B, 1, 0, 1, 0, 0xB5, 0]);
    }

    #[test]
    fn a_mode_with_wrong_parameters_is_none() {
        for data in [&[][..], &[0, 1, 2], &[0x24, 0], &[0x26], &[0x27, 1, 0, 2], &[0x43], &[0x2B, 6, 0]] {
            let telegram = Writer::new(0, MODE).slice(data).finish();
            assert_eq!(Request::decode(telegram.telegram()), None, "{data:?}");
        }
    }
}
