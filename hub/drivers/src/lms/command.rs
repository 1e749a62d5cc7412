//! Requests of the LMS whose effect ends with a power cycle, and their parameters. The hub encodes them. The simulator,
//! and the verbs that explain telegrams, decode them.
//!
//! Requests that write the EEPROM are in `lms_configure`, so code that has only a [`Request`] cannot write the EEPROM.

use crate::lms::operating::{self, Operating};
use crate::lms::telegram::{EncodedTelegram, Telegram, Writer};
use crate::lms::variant::{Baud, Variant};

/// A parameter of a request.
pub(crate) trait Parameter: Sized {
    /// Decodes the parameter at the beginning of `data`. Returns the parameter and the rest of `data`.
    fn read(data: &[u8]) -> Option<(Self, &[u8])>;

    /// Appends the parameter to a telegram.
    fn write(self, writer: Writer) -> Writer;
}

/// Declares an enum of requests. Each request has parameters and a command code. If the request always has the same
/// mode byte, this byte follows the code.
macro_rules! requests {
    ($(#[$doc:meta])* $Enum:ident by $code_of:ident {
        $($(#[doc = $text:literal])+ $Name:ident $(($($field:ident: $Type:ty),+))? = $code:tt $(+ $after:path)?,)+
    }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $Enum {
            $($(#[doc = $text])+ $Name $(($($Type),+))?,)+
        }

        impl $Enum {
            /// Returns the command code.
            pub fn $code_of(self) -> u8 {
                match self { $($Enum::$Name { .. } => $code,)+ }
            }

            /// Appends the parameters.
            fn write_parameters(self, writer: Writer) -> Writer {
                match self {
                    $($Enum::$Name $(($($field),+))? => {
                        $(let writer = writer.byte($after);)?
                        $($(let writer = Parameter::write($field, writer);)+)?
                        writer
                    })+
                }
            }

            /// Returns the request with this `code` whose parameters use all of `data`.
            fn read_parameters(code: u8, data: &[u8]) -> Option<$Enum> {
                $(if code == $code {
                    let read = || {
                        $(let data = data.strip_prefix(&[$after])?;)?
                        $($(let ($field, data) = <$Type as Parameter>::read(data)?;)+)?
                        data.is_empty().then_some($Enum::$Name $(($($field),+))?)
                    };
                    if let Some(request) = read() {
                        return Some(request);
                    }
                })+
                None
            }
        }
    };
}
pub(crate) use requests;

requests! {
    /// A request whose effect ends with a power cycle.
    Request by command {
        /// 10h: restart, as after power-on. Clears the error memory.
        Reset = RESET,
        /// 20h 24h: send all values of every scan continuously.
        Stream = MODE + operating::STREAM,
        /// 20h 25h: send values only on request. This stops a stream and ends installation mode.
        Stop = MODE + operating::ON_REQUEST,
        /// 20h 40h, 41h, 42h, 48h: change the baud rate until power-off. The scanner replies at the old rate.
        Baud(baud: Baud) = MODE,
        /// 20h and another byte: change to any other operating mode.
        Operate(operating: Operating) = MODE,
        /// 30h: one telegram of values. The byte selects the values (Telegram listing 7-14): 1 all, 2 vertical minimum,
        /// 3 taught, 6 every second, 7 every twentieth, 8 the current partial scan.
        Values(number: u8) = VALUES,
        /// 31h: status of the scanner. The reply is [`crate::lms::reply::Reply::Status`].
        Status = STATUS,
        /// 32h: present and past errors.
        Errors = ERRORS,
        /// 35h: hours of operation and number of power-ons; LMS 211, 221 and 291 only.
        Counters = COUNTERS,
        /// 36h: mean values over this number of scans, 2 to 250.
        Means(number: u8) = MEANS,
        /// 37h: values of a sub-range. Bit 15 of the first index requests direct output of a partial scan.
        Range(span: SubRange) = RANGE,
        /// 3Ah: type and firmware.
        Type = TYPE,
        /// 3Bh: change the scan angle and the resolution until power-off.
        Variant(variant: Variant) = VARIANT,
        /// 3Eh: values of a sub-range, with the borders of the fields A, B and C; at most 100 beams.
        RangeFields(span: SubRange) = RANGE_FIELDS,
        /// 3Fh: mean values of a sub-range over this number of scans.
        RangeMeans(number: u8, span: SubRange) = RANGE_MEANS,
        /// 41h: select the set of fields. The parameters are not decoded.
        FieldSet(raw: RawParameters) = FIELD_SET,
        /// 44h: all ranges, and the reflectivity of a sub-range; version S14 only.
        Reflectivity(span: SubRange) = REFLECTIVITY,
        /// 45h: read a field. The parameters are not decoded.
        Field(raw: RawParameters) = FIELD,
        /// 4Ah: state of the field outputs.
        Outputs = OUTPUTS,
        /// 69h: ranges of the positioning aid.
        Positioning = POSITIONING,
        /// 74h: first part of the configuration, with unit and measuring mode.
        Configuration = CONFIGURATION,
        /// 75h: ranges and reflectivities of one to five sub-ranges.
        Reflectivities(spans: SubRanges) = REFLECTIVITIES,
        /// 76h: a sub-range as Cartesian coordinates, at most 200 points.
        Cartesian(span: SubRange) = CARTESIAN,
        /// 7Bh: second part of the configuration.
        Configuration2 = CONFIGURATION_2,
    }
}

impl Request {
    /// Returns the telegram that sends this request to the scanner at `address`. Address 0 reaches every scanner.
    pub fn encode(self, address: u8) -> EncodedTelegram {
        self.write_parameters(Writer::new(address, self.command())).finish()
    }

    /// Returns the request in `telegram`. Returns `None` for a reply, an unknown command, a request that writes the
    /// EEPROM, or invalid parameters.
    pub fn decode(telegram: Telegram<'_>) -> Option<Request> {
        if telegram.is_reply() {
            return None;
        }
        Request::read_parameters(telegram.command(), telegram.data())
    }

    /// Returns the request that enters installation mode with `password`. [`Request::Stop`] ends installation mode.
    pub fn install(password: Password) -> Request {
        Request::Operate(Operating::Installation(password))
    }
}

/// Command byte: restart.
pub const RESET: u8 = 0x10;
/// Command byte: change the operating mode.
pub const MODE: u8 = 0x20;
/// Command byte: request values once.
pub const VALUES: u8 = 0x30;
/// Command byte: request the status.
pub const STATUS: u8 = 0x31;
/// Command byte: request the errors.
pub const ERRORS: u8 = 0x32;
/// Command byte: request the operating data counters.
pub const COUNTERS: u8 = 0x35;
/// Command byte: request mean values.
pub const MEANS: u8 = 0x36;
/// Command byte: request the values of a sub-range.
pub const RANGE: u8 = 0x37;
/// Command byte: request type and firmware.
pub const TYPE: u8 = 0x3A;
/// Command byte: change the variant.
pub const VARIANT: u8 = 0x3B;
/// Command byte: request the values of a sub-range with field values.
pub const RANGE_FIELDS: u8 = 0x3E;
/// Command byte: request the mean values of a sub-range.
pub const RANGE_MEANS: u8 = 0x3F;
/// Command byte: select the set of fields.
pub const FIELD_SET: u8 = 0x41;
/// Command byte: request ranges, and the reflectivities of a sub-range.
pub const REFLECTIVITY: u8 = 0x44;
/// Command byte: read a field.
pub const FIELD: u8 = 0x45;
/// Command byte: request the state of the field outputs.
pub const OUTPUTS: u8 = 0x4A;
/// Command byte: request the ranges of the positioning aid.
pub const POSITIONING: u8 = 0x69;
/// Command byte: read the first part of the configuration.
pub const CONFIGURATION: u8 = 0x74;
/// Command byte: request the ranges and reflectivities of sub-ranges.
pub const REFLECTIVITIES: u8 = 0x75;
/// Command byte: request Cartesian coordinates.
pub const CARTESIAN: u8 = 0x76;
/// Command byte: read the second part of the configuration.
pub const CONFIGURATION_2: u8 = 0x7B;

/// Commands that write the scanner's EEPROM: fields, password, taught fields, permanent baud rate, and parts 1 and 2 of
/// the configuration (Telegram listing 7-1: commands that need the installation mode). Only `lms_configure` encodes
/// these commands. No [`Request`] contains them.
pub const EEPROM_WRITES: [u8; 6] = [0x40, 0x42, 0x46, 0x66, 0x77, 0x7C];

/// A sub-range of the values. Indices are counted from 1, and both ends are included.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SubRange {
    /// Index of the first value.
    pub first: u16,
    /// Index of the last value.
    pub last: u16,
}

impl Parameter for u8 {
    fn read(data: &[u8]) -> Option<(u8, &[u8])> {
        data.split_first().map(|(byte, rest)| (*byte, rest))
    }

    fn write(self, writer: Writer) -> Writer {
        writer.byte(self)
    }
}

impl Parameter for u16 {
    fn read(data: &[u8]) -> Option<(u16, &[u8])> {
        data.split_first_chunk().map(|(word, rest)| (u16::from_le_bytes(*word), rest))
    }

    fn write(self, writer: Writer) -> Writer {
        writer.word(self)
    }
}

impl Parameter for SubRange {
    fn read(data: &[u8]) -> Option<(SubRange, &[u8])> {
        let (first, data) = u16::read(data)?;
        let (last, data) = u16::read(data)?;
        Some((SubRange { first, last }, data))
    }

    fn write(self, writer: Writer) -> Writer {
        writer.word(self.first).word(self.last)
    }
}

/// One to five sub-ranges.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SubRanges {
    list: [SubRange; SubRanges::MAX],
    len: u8,
}

impl SubRanges {
    /// Maximum number of sub-ranges in a telegram (Telegram listing, 75h).
    pub const MAX: usize = 5;

    /// Creates the list. Returns `None` if `spans` is empty or has more than five sub-ranges.
    pub fn new(spans: &[SubRange]) -> Option<SubRanges> {
        if spans.is_empty() {
            return None;
        }
        let mut list = [SubRange::default(); SubRanges::MAX];
        list.get_mut(..spans.len())?.copy_from_slice(spans);
        Some(SubRanges { list, len: spans.len() as u8 })
    }

    /// Returns the sub-ranges in their order.
    pub fn as_slice(&self) -> &[SubRange] {
        &self.list[..usize::from(self.len)]
    }
}

impl Parameter for SubRanges {
    fn read(data: &[u8]) -> Option<(SubRanges, &[u8])> {
        let (count, mut data) = u16::read(data)?;
        let mut list = [SubRange::default(); SubRanges::MAX];
        for span in list.get_mut(..count.into())? {
            (*span, data) = SubRange::read(data)?;
        }
        Some((SubRanges::new(&list[..count.into()])?, data))
    }

    fn write(self, writer: Writer) -> Writer {
        let writer = writer.word(self.len.into());
        self.as_slice().iter().fold(writer, |writer, span| span.write(writer))
    }
}

/// Password of the installation mode: eight characters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Password(pub [u8; 8]);

impl Password {
    /// Password of a factory-new scanner (Telegram listing 6-4).
    pub const FACTORY: Password = Password(*b"SICK_LMS");
}

impl Parameter for Password {
    fn read(data: &[u8]) -> Option<(Password, &[u8])> {
        data.split_first_chunk().map(|(password, rest)| (Password(*password), rest))
    }

    fn write(self, writer: Writer) -> Writer {
        writer.slice(&self.0)
    }
}

impl Parameter for Variant {
    fn read(data: &[u8]) -> Option<(Variant, &[u8])> {
        let (angle_deg, data) = u16::read(data)?;
        let (resolution_cdeg, data) = u16::read(data)?;
        Some((Variant::new(angle_deg, resolution_cdeg)?, data))
    }

    fn write(self, writer: Writer) -> Writer {
        writer.word(self.angle_deg).word(self.resolution_cdeg)
    }
}

/// Parameters without a known layout: at most sixteen bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RawParameters {
    bytes: [u8; RawParameters::MAX],
    len: u8,
}

impl RawParameters {
    /// Maximum length in bytes.
    pub const MAX: usize = 16;

    /// Copies `bytes`. Returns `None` if `bytes` is longer than [`RawParameters::MAX`].
    pub fn new(bytes: &[u8]) -> Option<RawParameters> {
        let mut kept = [0; RawParameters::MAX];
        kept.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(RawParameters { bytes: kept, len: bytes.len() as u8 })
    }

    /// Returns the bytes.
    pub fn as_slice(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

impl Parameter for RawParameters {
    fn read(data: &[u8]) -> Option<(RawParameters, &[u8])> {
        RawParameters::new(data).map(|raw| (raw, &[][..]))
    }

    fn write(self, writer: Writer) -> Writer {
        writer.slice(self.as_slice())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn variant(angle_deg: u16, resolution_cdeg: u16) -> Request {
        Request::Variant(Variant { angle_deg, resolution_cdeg })
    }

    #[test]
    fn printed_requests_encode_and_decode() {
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
                Request::Operate(Operating::Range(SubRange { first: 27, last: 299 })),
                &[0x02, 0, 6, 0, 0x20, 0x27, 0x1B, 0, 0x2B, 0x01, 0xFF, 0xFE],
            ),
            (
                Request::Range(SubRange { first: 1, last: 361 }),
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
    fn unprinted_requests_encode_and_decode() {
        let span = SubRange { first: 1, last: 181 };
        let spans = SubRanges::new(&[span, SubRange { first: 200, last: 201 }]).unwrap();
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
            Request::FieldSet(RawParameters::new(&[1]).unwrap()),
            Request::Field(RawParameters::new(&[1, 2]).unwrap()),
            Request::Field(RawParameters::new(&[]).unwrap()),
        ] {
            let encoded = request.encode(3);
            assert_eq!(encoded.telegram().address(), 3);
            assert_eq!(Request::decode(encoded.telegram()), Some(request));
        }
    }

    #[test]
    fn invalid_and_eeprom_telegrams_are_not_requests() {
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
    fn subranges_have_one_to_five_spans() {
        let span = SubRange { first: 1, last: 2 };
        assert_eq!(SubRanges::new(&[]), None);
        assert_eq!(SubRanges::new(&[span; 6]), None);
        assert_eq!(SubRanges::new(&[span; 5]).unwrap().as_slice(), [span; 5]);
        assert_eq!(
            SubRanges::read(&[1, 0, 1, 0, 2, 0, 9]),
            SubRanges::new(&[span]).map(|spans| (spans, &[9][..]))
        );
        assert_eq!(SubRanges::read(&[2, 0, 1, 0, 2, 0]), None);
        assert_eq!(SubRanges::read(&[0, 0]), None);
        assert_eq!(SubRanges::read(&[0]), None);
    }

    #[test]
    fn raw_parameters_have_at_most_16_bytes() {
        assert_eq!(RawParameters::new(&[7; 16]).unwrap().as_slice(), [7; 16]);
        assert_eq!(RawParameters::new(&[7; 17]), None);
    }
}
