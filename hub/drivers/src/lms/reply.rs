//! Replies of a scanner. A scanner also sends some of these replies without a request, in a stream and after power-on.
//! Every reply ends with a status byte, see [`crate::lms::status::StatusByte`].

use crate::lms::command as request;
use crate::lms::command::{Parameter as _, SubRange};
use crate::lms::configuration::factory_configuration;
use crate::lms::measured::{MEASURED, MeasuredValues, Rows};
use crate::lms::status::Errors;
use crate::lms::telegram::{EncodedTelegram, REPLY, Telegram, Writer};
use crate::lms::variant::{Mode, Unit, Variant};

pub use crate::lms::configuration::Configuration;
pub use crate::lms::status::{SimulatedStatus, StatusReport, status_reply};

/// Contents of a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reply<'a> {
    /// 90h: boot message after power-on or a reset, with model, number and firmware.
    PowerOn(&'a [u8]),
    /// 91h: the reset begins. 90h follows within 60 s.
    Reset,
    /// 92h: the command is well-formed, but the scanner cannot execute it at all, or cannot execute it now.
    Refused,
    /// A0h: result of a change of the operating mode or of the baud rate.
    Mode {
        /// Whether the scanner changed the mode or the rate.
        done: bool,
    },
    /// B0h: a scan, on request or in a stream.
    Measured(MeasuredValues<'a>),
    /// B1h: status of the scanner.
    Status(StatusReport<'a>),
    /// B2h: present and past errors; empty if there are none.
    Errors(Errors<'a>),
    /// B5h: operating data counters.
    Counters {
        /// Time of operation, in units of two hours.
        hours_by_2: u16,
        /// Number of power-ons.
        power_ons: u16,
    },
    /// B6h: mean values.
    Means {
        /// Number of scans over which the values are averaged.
        scans: u8,
        /// The values.
        values: MeasuredValues<'a>,
    },
    /// B7h: a sub-range.
    Range {
        /// Indices of the values.
        span: SubRange,
        /// The values.
        values: MeasuredValues<'a>,
    },
    /// BAh: type, number and firmware as ASCII, such as `LMS200;S18063;V02.19`.
    Type(&'a [u8]),
    /// BBh: result of a change of the variant, with the variant in effect.
    Variant {
        /// Whether the scanner changed the variant.
        done: bool,
        /// Angle in degrees, as reported.
        angle_deg: u16,
        /// Resolution in 1/100 degree, as reported.
        resolution_cdeg: u16,
    },
    /// BEh: a sub-range with field values.
    RangeFields(Rows<'a>),
    /// BFh: mean values of a sub-range.
    RangeMeans {
        /// Number of scans over which the values are averaged.
        scans: u8,
        /// Indices of the values.
        span: SubRange,
        /// The values.
        values: MeasuredValues<'a>,
    },
    /// C4h: ranges, and reflectivities of a sub-range; version S14 only.
    Reflectivity(Rows<'a>),
    /// E6h: result of a request that sets the baud rate after power-on.
    PowerOnSet {
        /// Result code. [`StatusReport::has_permanent_baud`] returns the present state.
        outcome: u8,
        /// The byte that was set.
        set: u8,
    },
    /// F4h: first part of the configuration.
    Configuration(Configuration<'a>),
    /// F5h: ranges and reflectivities.
    Reflectivities(Rows<'a>),
    /// F7h: result of writing the first part of the configuration.
    ConfigurationWritten {
        /// Whether the scanner changed the configuration.
        done: bool,
        /// The configuration in effect.
        configuration: Configuration<'a>,
    },
    /// FBh: second part of the configuration, 84 bytes.
    Configuration2(&'a [u8]),
    /// FCh: result of writing the second part of the configuration.
    Configuration2Written {
        /// Whether the scanner changed the configuration.
        done: bool,
        /// The bytes in effect.
        parameters: &'a [u8],
    },
    /// C0h, C1h, C2h, C5h, C6h, CAh, E9h and F6h. This module does not decode them.
    Undecoded {
        /// The command byte.
        command: u8,
        /// Data without the status byte.
        data: &'a [u8],
    },
}

impl<'a> Reply<'a> {
    /// Returns the measuring mode in the reply. Returns `Some(None)` for the boot message, because the mode in earlier
    /// replies is no longer valid, and `None` for a reply without a mode.
    pub fn mode(&self) -> Option<Option<Mode>> {
        match self {
            Reply::Configuration(configuration) => Some(Some(configuration.mode())),
            Reply::Status(report) => Some(Some(report.mode())),
            Reply::PowerOn(_) => Some(None),
            _ => None,
        }
    }

    /// Decodes `telegram`. Returns `None` if it is a request, if its command is unknown, or if its data do not match
    /// the command's layout.
    pub fn decode(telegram: Telegram<'a>) -> Option<Reply<'a>> {
        if !telegram.is_reply() || telegram.status().is_none() {
            return None;
        }
        let data = telegram.data();
        Some(match (telegram.command(), data) {
            (POWER_ON, name) => Reply::PowerOn(name.trim_ascii()),
            (RESET, []) => Reply::Reset,
            (REFUSED, _) => Reply::Refused,
            (MODE, &[outcome, ..]) => Reply::Mode { done: outcome == 0 },
            (MEASURED, data) => Reply::Measured(MeasuredValues::read(data)?),
            (STATUS, data) => Reply::Status(StatusReport::new(data)?),
            (ERRORS, data) => Reply::Errors(Errors::new(data)?),
            (COUNTERS, &[a, b, c, d]) => Reply::Counters {
                hours_by_2: u16::from_le_bytes([a, b]),
                power_ons: u16::from_le_bytes([c, d]),
            },
            (MEANS, &[shots, ref rest @ ..]) => {
                Reply::Means { scans: shots, values: MeasuredValues::read(rest)? }
            }
            (RANGE, data) => {
                let (span, rest) = SubRange::read(data)?;
                Reply::Range { span, values: MeasuredValues::read(rest)? }
            }
            (TYPE, name) => Reply::Type(name.trim_ascii()),
            (VARIANT, &[done, a, b, c, d]) => Reply::Variant {
                done: done == 1,
                angle_deg: u16::from_le_bytes([a, b]),
                resolution_cdeg: u16::from_le_bytes([c, d]),
            },
            (RANGE_FIELDS, data) => Reply::RangeFields(Rows::of_fields(data)?),
            (RANGE_MEANS, &[shots, ref rest @ ..]) => {
                let (span, rest) = SubRange::read(rest)?;
                Reply::RangeMeans { scans: shots, span, values: MeasuredValues::read(rest)? }
            }
            (REFLECTIVITY, data) => Reply::Reflectivity(Rows::of_reflectivity(data)?),
            (POWER_ON_SET, &[outcome, set]) => Reply::PowerOnSet { outcome, set },
            (CONFIGURATION, data) => Reply::Configuration(Configuration::new(data)?),
            (REFLECTIVITIES, data) => Reply::Reflectivities(Rows::of_reflectivities(data)?),
            (CONFIGURATION_WRITTEN, &[outcome, ref rest @ ..]) => {
                Reply::ConfigurationWritten { done: outcome == 1, configuration: Configuration::new(rest)? }
            }
            (CONFIGURATION_2, parameters) => Reply::Configuration2(parameters),
            (CONFIGURATION_2_WRITTEN, &[outcome, ref parameters @ ..]) => {
                Reply::Configuration2Written { done: outcome == 1, parameters }
            }
            (command, data) if UNDECODED_COMMANDS.contains(&command) => Reply::Undecoded { command, data },
            _ => return None,
        })
    }

    /// Encodes the reply of the scanner at `address`, with `status` as the status byte. Returns `None` if the reply
    /// exceeds the maximum length of a telegram. Names are padded with spaces to 21 characters.
    pub fn encode(&self, address: u8, status: u8) -> Option<EncodedTelegram> {
        let writer = Writer::new(address | REPLY, self.command());
        let writer = match *self {
            Reply::PowerOn(name) | Reply::Type(name) => {
                let spaces = &[b' '; NAME_LEN][..NAME_LEN.saturating_sub(name.len())];
                writer.reply_slice(name)?.slice(spaces)
            }
            Reply::Reset | Reply::Refused => writer,
            Reply::Mode { done } => writer.byte(u8::from(!done)),
            Reply::Measured(values) => values.write(writer)?,
            Reply::Status(report) => writer.slice(report.bytes()),
            Reply::Errors(errors) => writer.reply_slice(errors.bytes())?,
            Reply::Counters { hours_by_2, power_ons } => writer.word(hours_by_2).word(power_ons),
            Reply::Means { scans: shots, values } => values.write(writer.byte(shots))?,
            Reply::Range { span, values } => values.write(span.write(writer))?,
            Reply::Variant { done, angle_deg, resolution_cdeg } => {
                writer.byte(u8::from(done)).word(angle_deg).word(resolution_cdeg)
            }
            Reply::RangeMeans { scans: shots, span, values } => {
                values.write(span.write(writer.byte(shots)))?
            }
            Reply::PowerOnSet { outcome, set } => writer.byte(outcome).byte(set),
            Reply::Configuration(configuration) => writer.reply_slice(configuration.bytes())?,
            Reply::RangeFields(rows) | Reply::Reflectivity(rows) | Reply::Reflectivities(rows) => {
                writer.reply_slice(rows.bytes())?
            }
            Reply::ConfigurationWritten { done, configuration } => {
                writer.byte(u8::from(done)).reply_slice(configuration.bytes())?
            }
            Reply::Configuration2(parameters) => writer.reply_slice(parameters)?,
            Reply::Configuration2Written { done, parameters } => {
                writer.byte(u8::from(done)).reply_slice(parameters)?
            }
            Reply::Undecoded { data, .. } => writer.reply_slice(data)?,
        };
        Some(writer.byte(status).finish())
    }

    /// Returns the command byte.
    pub fn command(&self) -> u8 {
        match self {
            Reply::PowerOn(_) => POWER_ON,
            Reply::Reset => RESET,
            Reply::Refused => REFUSED,
            Reply::Mode { .. } => MODE,
            Reply::Measured(_) => MEASURED,
            Reply::Status(_) => STATUS,
            Reply::Errors(_) => ERRORS,
            Reply::Counters { .. } => COUNTERS,
            Reply::Means { .. } => MEANS,
            Reply::Range { .. } => RANGE,
            Reply::Type(_) => TYPE,
            Reply::Variant { .. } => VARIANT,
            Reply::RangeFields(_) => RANGE_FIELDS,
            Reply::RangeMeans { .. } => RANGE_MEANS,
            Reply::Reflectivity(_) => REFLECTIVITY,
            Reply::PowerOnSet { .. } => POWER_ON_SET,
            Reply::Configuration(_) => CONFIGURATION,
            Reply::Reflectivities(_) => REFLECTIVITIES,
            Reply::ConfigurationWritten { .. } => CONFIGURATION_WRITTEN,
            Reply::Configuration2(_) => CONFIGURATION_2,
            Reply::Configuration2Written { .. } => CONFIGURATION_2_WRITTEN,
            Reply::Undecoded { command, .. } => *command,
        }
    }
}

/// Encodes A0h, the result of a change of mode or rate, from the scanner at `address`.
pub fn mode_reply(address: u8, done: bool, status: u8) -> EncodedTelegram {
    Writer::new(address | REPLY, MODE).byte(u8::from(!done)).byte(status).finish()
}

/// Encodes 92h, the refusal of a command, from the scanner at `address`.
pub fn refusal(address: u8, status: u8) -> EncodedTelegram {
    Writer::new(address | REPLY, REFUSED).byte(status).finish()
}

/// Encodes BAh. `name` has model, number and firmware, usually 20 or 21 ASCII characters.
pub fn type_reply(address: u8, name: &[u8], status: u8) -> EncodedTelegram {
    Writer::new(address | REPLY, TYPE).slice(name).byte(status).finish()
}

/// Encodes BBh, the result of a change of the variant, with the variant in effect.
pub fn variant_reply(address: u8, done: bool, variant: Variant, status: u8) -> EncodedTelegram {
    Writer::new(address | REPLY, VARIANT)
        .byte(u8::from(done))
        .word(variant.angle_deg)
        .word(variant.resolution_cdeg)
        .byte(status)
        .finish()
}

/// Encodes F4h, the 34 bytes of a factory-new configuration with this measuring mode and unit.
pub fn configuration_reply(address: u8, mode: Mode, unit: Unit, status: u8) -> EncodedTelegram {
    Writer::new(address | REPLY, CONFIGURATION)
        .slice(&factory_configuration(mode, unit))
        .byte(status)
        .finish()
}

/// Command byte of the boot message.
pub const POWER_ON: u8 = 0x90;
/// Command byte of the beginning of a reset.
pub const RESET: u8 = 0x91;
/// Command byte of a refusal.
pub const REFUSED: u8 = 0x92;

const MODE: u8 = request::MODE | REPLY;
const STATUS: u8 = request::STATUS | REPLY;
const ERRORS: u8 = request::ERRORS | REPLY;
const COUNTERS: u8 = request::COUNTERS | REPLY;
const MEANS: u8 = request::MEANS | REPLY;
const RANGE: u8 = request::RANGE | REPLY;
const TYPE: u8 = request::TYPE | REPLY;
const VARIANT: u8 = request::VARIANT | REPLY;
const RANGE_FIELDS: u8 = request::RANGE_FIELDS | REPLY;
const RANGE_MEANS: u8 = request::RANGE_MEANS | REPLY;
const REFLECTIVITY: u8 = request::REFLECTIVITY | REPLY;
const POWER_ON_SET: u8 = 0xE6;
const CONFIGURATION: u8 = request::CONFIGURATION | REPLY;
const REFLECTIVITIES: u8 = request::REFLECTIVITIES | REPLY;
const CONFIGURATION_WRITTEN: u8 = 0xF7;
const CONFIGURATION_2: u8 = request::CONFIGURATION_2 | REPLY;
const CONFIGURATION_2_WRITTEN: u8 = 0xFC;
/// Command bytes of replies that this module does not decode.
const UNDECODED_COMMANDS: [u8; 8] = [0xC0, 0xC1, 0xC2, 0xC5, 0xC6, 0xCA, 0xE9, 0xF6];
/// Number of characters of the text with model, number and firmware.
const NAME_LEN: usize = 21;
