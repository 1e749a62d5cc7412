//! Requests whose effect ends with a power cycle, and the parameters that several of them share. Hosts encode requests. The
//! simulator, and the verbs that explain telegrams, decode them. Requests that write the EEPROM are in `lms_configure`, so
//! code that has only a [`Request`] cannot write it.

use crate::lms::operating::{self, Operating};
use crate::lms::telegram::{Encoded, Telegram, Writer};
use crate::lms::variant::{Baud, Variant};

/// A request that is forgotten at power-off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// 10h: restart, as after power-on; clears the fault memory.
    Reset,
    /// 20h 24h: send all values of every scan from now on.
    Stream,
    /// 20h 25h: values on request only; so this is the stop command, and the way out of installation mode.
    Stop,
    /// 20h 40h, 41h, 42h, 48h: change the rate of the line; acknowledged at the old one, forgotten at power-off.
    Baud(Baud),
    /// 20h with any other mode.
    Operate(Operating),
    /// 30h: one telegram of values, selected by the byte (Telegram listing 7-14): 1 all, 2 vertical minimum, 3 taught,
    /// 6 every second, 7 every twentieth, 8 the current partial scan.
    Values(u8),
    /// 31h: status of the sensor; the reply is [`crate::lms::reply::Reply::Status`].
    Status,
    /// 32h: errors that are and that were.
    Errors,
    /// 35h: hours and power-ons; LMS 211, 221 and 291 only.
    Counters,
    /// 36h: mean values of so many scans, 2 to 250.
    Means(u8),
    /// 37h: values of a sub-range; bit 15 of its first asks for direct output of a partial scan.
    Range(Span),
    /// 3Ah: type and firmware.
    Type,
    /// 3Bh: switch angle and resolution; forgotten at power-off.
    Variant(Variant),
    /// 3Eh: values of a sub-range with those of the fields A, B and C; at most 100.
    RangeFields(Span),
    /// 3Fh: mean values of so many scans in a sub-range.
    RangeMeans(u8, Span),
    /// 41h: switch the set of fields. The parameters as they are: their layout is not known here.
    FieldSet(Raw),
    /// 44h: all ranges, and the reflectivity of a sub-range; LMS S14 only.
    Reflectivity(Span),
    /// 45h: read a field. The parameters as they are: their layout is not known here.
    Field(Raw),
    /// 4Ah: what the field outputs are at.
    Outputs,
    /// 69h: the ranges of the positioning aid.
    Positioning,
    /// 74h: first part of the configuration, with unit and measuring mode.
    Configuration,
    /// 75h: ranges and reflectivities of one to five sub-ranges.
    Reflectivities(Spans),
    /// 76h: a sub-range as Cartesian coordinates, at most 200.
    Cartesian(Span),
    /// 7Bh: second part of the configuration.
    Configuration2,
}

impl Request {
    /// The telegram that says it to the sensor at `address` (0 is every sensor).
    pub fn encode(self, address: u8) -> Encoded {
        let writer = Writer::new(address, self.command());
        match self {
            Request::Variant(variant) => writer.word(variant.angle_deg).word(variant.resolution_cdeg),
            Request::Stream => writer.byte(operating::STREAM),
            Request::Stop => writer.byte(operating::ON_REQUEST),
            Request::Baud(baud) => writer.byte(operating::of_baud(baud)),
            Request::Operate(operating) => operating.write(writer),
            Request::Values(byte) | Request::Means(byte) => writer.byte(byte),
            Request::Range(span)
            | Request::RangeFields(span)
            | Request::Reflectivity(span)
            | Request::Cartesian(span) => span.write(writer),
            Request::RangeMeans(shots, span) => span.write(writer.byte(shots)),
            Request::Reflectivities(spans) => spans.write(writer.word(spans.as_slice().len() as u16)),
            Request::FieldSet(raw) | Request::Field(raw) => writer.slice(raw.as_slice()),
            Request::Reset
            | Request::Status
            | Request::Errors
            | Request::Counters
            | Request::Type
            | Request::Outputs
            | Request::Positioning
            | Request::Configuration
            | Request::Configuration2 => writer,
        }
        .finish()
    }

    /// The request that `telegram` says; `None` if it is a reply, unknown, one that writes the EEPROM, or its data are
    /// not as they should be.
    pub fn decode(telegram: Telegram<'_>) -> Option<Request> {
        if telegram.is_reply() {
            return None;
        }
        let data = telegram.data();
        Some(match (telegram.command(), data) {
            (RESET, []) => Request::Reset,
            (MODE, &[operating::STREAM]) => Request::Stream,
            (MODE, &[operating::ON_REQUEST]) => Request::Stop,
            (MODE, &[mode]) if operating::baud_of(mode).is_some() => Request::Baud(operating::baud_of(mode)?),
            (MODE, data) => Request::Operate(Operating::decode(data)?),
            (VALUES, &[selection]) => Request::Values(selection),
            (STATUS, []) => Request::Status,
            (ERRORS, []) => Request::Errors,
            (COUNTERS, []) => Request::Counters,
            (MEANS, &[shots]) => Request::Means(shots),
            (RANGE, data) => Request::Range(Span::read(data)?),
            (TYPE, []) => Request::Type,
            (VARIANT, &[a, b, c, d]) => {
                Request::Variant(Variant::new(u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d]))?)
            }
            (RANGE_FIELDS, data) => Request::RangeFields(Span::read(data)?),
            (RANGE_MEANS, &[shots, ref span @ ..]) => Request::RangeMeans(shots, Span::read(span)?),
            (FIELD_SET, data) => Request::FieldSet(Raw::new(data)?),
            (REFLECTIVITY, data) => Request::Reflectivity(Span::read(data)?),
            (FIELD, data) => Request::Field(Raw::new(data)?),
            (OUTPUTS, []) => Request::Outputs,
            (POSITIONING, []) => Request::Positioning,
            (CONFIGURATION, []) => Request::Configuration,
            (REFLECTIVITIES, data) => Request::Reflectivities(Spans::read_counted(data)?),
            (CARTESIAN, data) => Request::Cartesian(Span::read(data)?),
            (CONFIGURATION_2, []) => Request::Configuration2,
            _ => return None,
        })
    }

    /// The command byte.
    pub fn command(self) -> u8 {
        match self {
            Request::Reset => RESET,
            Request::Stream | Request::Stop | Request::Baud(_) | Request::Operate(_) => MODE,
            Request::Values(_) => VALUES,
            Request::Status => STATUS,
            Request::Errors => ERRORS,
            Request::Counters => COUNTERS,
            Request::Means(_) => MEANS,
            Request::Range(_) => RANGE,
            Request::Type => TYPE,
            Request::Variant(_) => VARIANT,
            Request::RangeFields(_) => RANGE_FIELDS,
            Request::RangeMeans(..) => RANGE_MEANS,
            Request::FieldSet(_) => FIELD_SET,
            Request::Reflectivity(_) => REFLECTIVITY,
            Request::Field(_) => FIELD,
            Request::Outputs => OUTPUTS,
            Request::Positioning => POSITIONING,
            Request::Configuration => CONFIGURATION,
            Request::Reflectivities(_) => REFLECTIVITIES,
            Request::Cartesian(_) => CARTESIAN,
            Request::Configuration2 => CONFIGURATION_2,
        }
    }

    /// Into installation mode, by its `password`; [`Request::Stop`] leads out again.
    pub fn install(password: Password) -> Request {
        Request::Operate(Operating::Installation(password))
    }
}

/// Command: restart.
pub const RESET: u8 = 0x10;
/// Command: change the operating mode.
pub const MODE: u8 = 0x20;
/// Command: values, once.
pub const VALUES: u8 = 0x30;
/// Command: status.
pub const STATUS: u8 = 0x31;
/// Command: errors.
pub const ERRORS: u8 = 0x32;
/// Command: operating data counters.
pub const COUNTERS: u8 = 0x35;
/// Command: mean values.
pub const MEANS: u8 = 0x36;
/// Command: values of a sub-range.
pub const RANGE: u8 = 0x37;
/// Command: type.
pub const TYPE: u8 = 0x3A;
/// Command: switch the variant.
pub const VARIANT: u8 = 0x3B;
/// Command: values of a sub-range with field values.
pub const RANGE_FIELDS: u8 = 0x3E;
/// Command: mean values of a sub-range.
pub const RANGE_MEANS: u8 = 0x3F;
/// Command: switch the set of fields.
pub const FIELD_SET: u8 = 0x41;
/// Command: ranges, and reflectivities of a sub-range.
pub const REFLECTIVITY: u8 = 0x44;
/// Command: read a field.
pub const FIELD: u8 = 0x45;
/// Command: state of the outputs.
pub const OUTPUTS: u8 = 0x4A;
/// Command: positioning aid.
pub const POSITIONING: u8 = 0x69;
/// Command: read the configuration.
pub const CONFIGURATION: u8 = 0x74;
/// Command: ranges and reflectivities of sub-ranges.
pub const REFLECTIVITIES: u8 = 0x75;
/// Command: Cartesian coordinates.
pub const CARTESIAN: u8 = 0x76;
/// Command: read the second part of the configuration.
pub const CONFIGURATION_2: u8 = 0x7B;

/// Commands that write the sensor's EEPROM: fields, password, taught fields, permanent rate, configuration parts 1 and 2
/// (Telegram listing 7-1: those that need the installation mode). They are written by `lms_configure`, never a
/// [`Request`].
pub const EEPROM_WRITES: [u8; 6] = [0x40, 0x42, 0x46, 0x66, 0x77, 0x7C];

/// A sub-range of the values, both ends included, counted from 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Span {
    /// The first value.
    pub first: u16,
    /// The last value.
    pub last: u16,
}

impl Span {
    /// Bytes on the wire: two words.
    pub const LEN: usize = 4;

    /// The span that exactly these four bytes are.
    pub(crate) fn read(bytes: &[u8]) -> Option<Span> {
        let &[a, b, c, d] = bytes else { return None };
        Some(Span { first: u16::from_le_bytes([a, b]), last: u16::from_le_bytes([c, d]) })
    }

    pub(crate) fn write(self, writer: Writer) -> Writer {
        writer.word(self.first).word(self.last)
    }
}

/// One to five sub-ranges.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Spans {
    list: [Span; Spans::MAX],
    len: u8,
}

impl Spans {
    /// As many as a telegram may name (Telegram listing, 75h).
    pub const MAX: usize = 5;

    /// `None` if there are none, or more than five.
    pub fn new(spans: &[Span]) -> Option<Spans> {
        if spans.is_empty() {
            return None;
        }
        let mut list = [Span::default(); Spans::MAX];
        list.get_mut(..spans.len())?.copy_from_slice(spans);
        Some(Spans { list, len: spans.len() as u8 })
    }

    /// The spans in their order.
    pub fn as_slice(&self) -> &[Span] {
        &self.list[..usize::from(self.len)]
    }

    /// A word that counts them, then as many.
    pub(crate) fn read_counted(bytes: &[u8]) -> Option<Spans> {
        let (count, rest) = bytes.split_first_chunk()?;
        let count = usize::from(u16::from_le_bytes(*count));
        if count > Spans::MAX || rest.len() != count * Span::LEN {
            return None;
        }
        let mut list = [Span::default(); Spans::MAX];
        for (span, bytes) in list.iter_mut().zip(rest.chunks_exact(Span::LEN)) {
            *span = Span::read(bytes)?;
        }
        Spans::new(&list[..count])
    }

    pub(crate) fn write(&self, writer: Writer) -> Writer {
        self.as_slice().iter().fold(writer, |writer, span| span.write(writer))
    }
}

/// The eight characters that open the installation mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Password(pub [u8; 8]);

impl Password {
    /// The one that every sensor leaves the factory with (Telegram listing 6-4).
    pub const FACTORY: Password = Password(*b"SICK_LMS");
}

/// Parameters of which no layout is known here: at most sixteen bytes, as they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Raw {
    bytes: [u8; Raw::MAX],
    len: u8,
}

impl Raw {
    /// Longest parameters that are kept.
    pub const MAX: usize = 16;

    /// `None` if they are longer than [`Raw::MAX`].
    pub fn new(bytes: &[u8]) -> Option<Raw> {
        let mut kept = [0; Raw::MAX];
        kept.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(Raw { bytes: kept, len: bytes.len() as u8 })
    }

    /// The bytes.
    pub fn as_slice(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn variant(angle_deg: u16, resolution_cdeg: u16) -> Request {
        Request::Variant(Variant { angle_deg, resolution_cdeg })
    }

    #[test]
    fn printed_requests_both_ways() {
        let vectors: [(Request, &[u8]); 23] = [
            (Request::Reset, &[0x02, 0, 1, 0, 0x10, 0x34, 0x12]),
            (Request::Status, &[0x02, 0, 1, 0, 0x31, 0x15, 0x12]),
            (Request::Errors, &[0x02, 0, 1, 0, 0x32, 0x16, 0x12]),
            (Request::Type, &[0x02, 0, 1, 0, 0x3A, 0x1E, 0x12]),
            (Request::Configuration, &[0x02, 0, 1, 0, 0x74, 0x50, 0x12]),
            (Request::Outputs, &[0x02, 0, 1, 0, 0x4A, 0x6E, 0x12]),
            (Request::Values(1), &[0x02, 0, 2, 0, 0x30, 0x01, 0x31, 0x18]),
            (Request::Values(8), &[0x02, 0, 2, 0, 0x30, 0x08, 0x38, 0x18]),
            (Request::Stream, &[0x02, 0, 2, 0, 0x20, 0x24, 0x34, 0x08]),
            (Request::Stop, &[0x02, 0, 2, 0, 0x20, 0x25, 0x35, 0x08]),
            (Request::Operate(Operating::Partial), &[0x02, 0, 2, 0, 0x20, 0x2A, 0x3A, 0x08]),
            (Request::Baud(Baud::B38400), &[0x02, 0, 2, 0, 0x20, 0x40, 0x50, 0x08]),
            (Request::Baud(Baud::B19200), &[0x02, 0, 2, 0, 0x20, 0x41, 0x51, 0x08]),
            (Request::Baud(Baud::B9600), &[0x02, 0, 2, 0, 0x20, 0x42, 0x52, 0x08]),
            (Request::Baud(Baud::B500000), &[0x02, 0, 2, 0, 0x20, 0x48, 0x58, 0x08]),
            (
                Request::install(Password::FACTORY),
                b"\x02\x00\x0A\x00\x20\x00\x53\x49\x43\x4B\x5F\x4C\x4D\x53\xBE\xC5",
            ),
            (
                Request::Operate(Operating::Range(Span { first: 27, last: 299 })),
                &[0x02, 0, 6, 0, 0x20, 0x27, 0x1B, 0, 0x2B, 0x01, 0xFF, 0xFE],
            ),
            (
                Request::Range(Span { first: 1, last: 361 }),
                &[0x02, 0, 5, 0, 0x37, 0x01, 0, 0x69, 0x01, 0xEB, 0x75],
            ),
            (variant(180, 50), &[0x02, 0, 5, 0, 0x3B, 0xB4, 0, 0x32, 0, 0x3B, 0x1F]),
            (variant(180, 100), &[0x02, 0, 5, 0, 0x3B, 0xB4, 0, 0x64, 0, 0x97, 0x49]),
            (variant(100, 100), &[0x02, 0, 5, 0, 0x3B, 0x64, 0, 0x64, 0, 0x1D, 0x0F]),
            (variant(100, 50), &[0x02, 0, 5, 0, 0x3B, 0x64, 0, 0x32, 0, 0xB1, 0x59]),
            (variant(100, 25), &[0x02, 0, 5, 0, 0x3B, 0x64, 0, 0x19, 0, 0xE7, 0x72]),
        ];
        for (request, bytes) in vectors {
            assert_eq!(request.encode(0).bytes(), bytes, "{request:?}");
            assert_eq!(Request::decode(Telegram::check(bytes).unwrap()), Some(request));
            assert!(!EEPROM_WRITES.contains(&request.command()));
        }
    }

    #[test]
    fn every_other_request_both_ways() {
        let span = Span { first: 1, last: 181 };
        let spans = Spans::new(&[span, Span { first: 200, last: 201 }]).unwrap();
        for request in [
            Request::Counters,
            Request::Means(250),
            Request::Positioning,
            Request::Configuration2,
            Request::RangeFields(span),
            Request::RangeMeans(2, span),
            Request::Reflectivity(span),
            Request::Cartesian(span),
            Request::Reflectivities(spans),
            Request::FieldSet(Raw::new(&[1]).unwrap()),
            Request::Field(Raw::new(&[1, 2]).unwrap()),
            Request::Field(Raw::new(&[]).unwrap()),
        ] {
            let encoded = request.encode(3);
            assert_eq!(encoded.telegram().address(), 3);
            assert_eq!(Request::decode(encoded.telegram()), Some(request));
        }
    }

    #[test]
    fn what_is_none_is_no_request() {
        let variant = Writer::new(0, VARIANT).word(180).word(25);
        let cut = Writer::new(0, RANGE).word(180);
        let too_many = Writer::new(0, REFLECTIVITIES).word(6).slice(&[1; 24]);
        let reply = Writer::new(0x80, STATUS).byte(0x10);
        for telegram in [variant, cut, too_many, reply] {
            assert_eq!(Request::decode(telegram.finish().telegram()), None);
        }
        for command in EEPROM_WRITES {
            assert_eq!(Request::decode(Writer::new(0, command).byte(0).finish().telegram()), None);
        }
    }

    #[test]
    fn one_to_five_spans() {
        let span = Span { first: 1, last: 2 };
        assert_eq!(Spans::new(&[]), None);
        assert_eq!(Spans::new(&[span; 6]), None);
        assert_eq!(Spans::new(&[span; 5]).unwrap().as_slice(), [span; 5]);
        assert_eq!(Spans::read_counted(&[1, 0, 1, 0, 2, 0]), Spans::new(&[span]));
        assert_eq!(Spans::read_counted(&[2, 0, 1, 0, 2, 0]), None);
        assert_eq!(Spans::read_counted(&[0, 0]), None);
        assert_eq!(Spans::read_counted(&[0]), None);
    }

    #[test]
    fn raw_parameters_end_somewhere() {
        assert_eq!(Raw::new(&[7; 16]).unwrap().as_slice(), [7; 16]);
        assert_eq!(Raw::new(&[7; 17]), None);
    }
}
