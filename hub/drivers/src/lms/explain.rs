//! Explanation of a telegram as a list of fields that covers every byte. A field has a name, a value and, if needed,
//! its meaning as text.
//!
//! [`explain`] passes each field to a callback and allocates nothing. [`Headline`] displays a telegram in one line. The
//! layouts are from the Telegram listing, chapter 7. Requests that write the EEPROM are explained here but encoded in
//! `lms_configure`.

use core::fmt::{self, Display};

use crate::lms::command::{
    CARTESIAN, EEPROM_WRITES, MEANS, MODE, RANGE, RANGE_FIELDS, RANGE_MEANS, REFLECTIVITIES, REFLECTIVITY,
    Request, VALUES, VARIANT,
};
use crate::lms::configuration::{self, availability_text};
use crate::lms::measured::{COUNT_MASK, MEASURED, MeasuredValues, PARTIAL_FLAG};
use crate::lms::operating;
use crate::lms::reply::{POWER_ON, REFUSED, RESET, Reply};
use crate::lms::status::{self, Fault, StatusByte, ValueFormat};
use crate::lms::telegram::{REPLY, Telegram};
use crate::lms::variant::{Baud, Mode, Unit, Variant};

/// A field of a telegram.
pub struct Field<'a> {
    /// Index of the field's first byte, counted from STX.
    pub offset: usize,
    /// Bytes of the field.
    pub bytes: &'a [u8],
    /// Name of the field.
    pub name: &'static str,
    /// Decoded value.
    pub value: Value<'a>,
    /// Meaning of the value as text. `None` if the value needs no explanation.
    pub meaning: Option<&'a dyn Display>,
}

/// Value of a field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Value<'a> {
    /// A number, low byte first.
    Number(u32),
    /// Characters.
    Text(&'a [u8]),
    /// Bytes without a layout.
    Bytes(&'a [u8]),
    /// Rows of words, with one word per column.
    Rows {
        /// Bytes of all rows.
        bytes: &'a [u8],
        /// Names of the columns.
        columns: &'static [&'static str],
    },
    /// Measured values.
    Ranges(Ranges<'a>),
}

/// Measured values with the settings that are needed to decode them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ranges<'a> {
    bytes: &'a [u8],
    /// Measuring mode, which determines the range bits and the upper bits of a value.
    pub mode: Mode,
    /// Whether the measuring mode is known. If not, the lower 13 bits of a value are assumed to be the range.
    pub mode_known: bool,
    /// Unit of the ranges.
    pub unit: Unit,
}

impl<'a> Ranges<'a> {
    /// Returns the words of the values as sent.
    pub fn raw(&self) -> impl ExactSizeIterator<Item = u16> + 'a {
        self.bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]))
    }

    /// Returns the range of each value in millimeters. If a value has no range, returns the code with the reason.
    pub fn millimeters(&self) -> impl ExactSizeIterator<Item = Result<u32, crate::lms::variant::Code>> + 'a {
        let (mode, mm) = (self.mode, u32::from(self.unit.mm()));
        self.raw().map(move |word| mode.split(word).range.map(|range| u32::from(range) * mm))
    }

    /// Returns the bits above the range bits of each value.
    pub fn upper(&self) -> impl ExactSizeIterator<Item = u8> + 'a {
        let mode = self.mode;
        self.raw().map(move |word| mode.split(word).upper)
    }
}

impl fmt::Display for Ranges<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.mode_known && !self.mode.has_ranges() {
            return write!(f, "mode {:02X}h: {}", self.mode.0, self.mode.name());
        }
        let all = self.millimeters().len();
        let ranges = || self.millimeters().flatten();
        let none = all - ranges().count();
        match (ranges().min(), ranges().max()) {
            (Some(nearest), Some(farthest)) => write!(f, "{nearest} to {farthest} mm")?,
            _ => f.write_str("no range")?,
        }
        if none > 0 {
            write!(f, ", {none} of {all} without")?;
        }
        let bits = self.mode.range_bits();
        match (self.mode_known, self.mode.intensity_bits()) {
            (false, _) => write!(f, "; measuring mode unknown, {bits} bits taken for the range"),
            (true, 0) => write!(f, "; {bits} bits"),
            (true, levels) => write!(f, "; {bits} bits and {levels} of reflector level"),
        }
    }
}

/// Display of a telegram in one line: its direction, its command and the most important contents.
#[derive(Clone, Copy, Debug)]
pub struct Headline<'a>(pub Telegram<'a>);

impl fmt::Display for Headline<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let telegram = self.0;
        let (command, is_reply) = (telegram.command(), telegram.is_reply());
        write!(f, "{command:02X}h {}", name(command, is_reply).unwrap_or("unknown command"))?;
        match (is_reply, telegram.address() & !REPLY) {
            (true, address) => write!(f, ", from sensor {address}")?,
            (false, 0) => f.write_str(", to all sensors")?,
            (false, address) => write!(f, ", to sensor {address}")?,
        }
        if is_reply {
            write_reply(f, telegram)?;
        } else {
            write_request(f, telegram)?;
        }
        match telegram.status() {
            Some(status) => write!(f, "; {}", StatusByte(status)),
            None => Ok(()),
        }
    }
}

fn write_request(f: &mut fmt::Formatter<'_>, telegram: Telegram<'_>) -> fmt::Result {
    match Request::decode(telegram) {
        Some(Request::Variant(Variant { angle_deg, resolution_cdeg })) => {
            write!(f, ": {angle_deg} degrees at {}", Degrees(resolution_cdeg))
        }
        Some(Request::Stream | Request::Stop | Request::Baud(_) | Request::Operate(_)) => {
            write!(f, ": {}", operating::name(telegram.data()[0]))
        }
        Some(_) => Ok(()),
        None if EEPROM_WRITES.contains(&telegram.command()) => f.write_str(" (EEPROM)"),
        None => f.write_str(", malformed"),
    }
}

fn write_reply(f: &mut fmt::Formatter<'_>, telegram: Telegram<'_>) -> fmt::Result {
    match Reply::decode(telegram) {
        Some(Reply::PowerOn(name) | Reply::Type(name)) => write!(f, ": {}", name.escape_ascii()),
        Some(Reply::Mode { done }) => f.write_str(if done { ": done" } else { ": not done" }),
        Some(Reply::Measured(values)) => write_measured(f, values),
        Some(
            Reply::Means { values, .. } | Reply::Range { values, .. } | Reply::RangeMeans { values, .. },
        ) => {
            write!(f, ": {} in {}", values.count(), unit_name(values.unit()))
        }
        Some(Reply::Status(report)) => {
            write!(
                f,
                ": {}, {}",
                report.software().escape_ascii(),
                operating::name(report.operating_mode())
            )?;
            f.write_str(if report.is_defective() { ", DEFECTIVE" } else { "" })
        }
        Some(Reply::Errors(errors)) => match errors.iter().len() {
            0 => f.write_str(": none"),
            count => {
                let past = errors.iter().filter(|fault| fault.is_past()).count();
                write!(f, ": {} present, {past} past", count - past)
            }
        },
        Some(Reply::Variant { done, angle_deg, resolution_cdeg }) => {
            let degrees = Degrees(resolution_cdeg);
            let outcome = if done { "done" } else { "not done" };
            write!(f, ": {outcome}, {angle_deg} degrees at {degrees} in effect")
        }
        Some(Reply::Configuration(configuration)) => write!(f, ": {}", configuration.mode().name()),
        Some(Reply::ConfigurationWritten { done, .. } | Reply::Configuration2Written { done, .. }) => {
            f.write_str(if done { ": done" } else { ": not done" })
        }
        Some(_) => Ok(()),
        None => f.write_str(", malformed"),
    }
}

fn write_measured(f: &mut fmt::Formatter<'_>, values: MeasuredValues<'_>) -> fmt::Result {
    write!(f, ": {} in {}", values.count(), unit_name(values.unit()))?;
    match (values.partial(), Variant::of_beams(values.count())) {
        (Some(quarter), _) => write!(f, ", partial scan from {}", Degrees(25 * u16::from(quarter))),
        (None, Some(Variant { angle_deg, resolution_cdeg })) => {
            write!(f, ", {angle_deg} degrees at {}", Degrees(resolution_cdeg))
        }
        (None, None) => Ok(()),
    }
}

/// Passes each field of `telegram` to `visit`, from STX to the checksum, without gaps.
///
/// `mode` determines the range bits and the upper bits of a value. A telegram of values does not contain the mode. If
/// `mode` is `None`, the lower 13 bits are assumed to be the range.
pub fn explain(telegram: Telegram<'_>, mode: Option<Mode>, visit: &mut dyn FnMut(&Field<'_>)) {
    let mut reader = FieldReader::new(telegram.bytes(), visit);
    // A telegram that is shorter than its layout has fewer fields. Bytes that do not fill a field are shown as they
    // are.
    let _ = fields(&mut reader, telegram, mode);
    reader.show_to_tail(2 + usize::from(telegram.status().is_some()));
    if telegram.status().is_some() {
        reader.byte_as("status", StatusByte);
    }
    reader.word("checksum");
}

fn fields(reader: &mut FieldReader<'_, '_>, telegram: Telegram<'_>, mode: Option<Mode>) -> Option<()> {
    reader.set_end(5);
    reader.byte("STX")?;
    reader.byte_as("address", |byte| {
        lazy_text(move |f| match byte {
            0 => f.write_str("to all sensors"),
            1..REPLY => write!(f, "to sensor {byte}"),
            _ => write!(f, "from sensor {}", byte & !REPLY),
        })
    })?;
    reader.word_as("length", |length| {
        lazy_text(move |f| write!(f, "{length} bytes from command to checksum"))
    })?;
    reader.byte_as("command", |command| name(command, telegram.is_reply()).unwrap_or("unknown"))?;
    reader.set_end(5 + telegram.data().len());
    if telegram.is_reply() { reply_fields(reader, telegram, mode) } else { request_fields(reader, telegram) }
}

/// Returns the name of `command` (Telegram listing, table 7-1). Returns `None` if the command is unknown. Most replies
/// have the same name as their requests.
pub fn name(command: u8, is_reply: bool) -> Option<&'static str> {
    if !is_reply {
        return request_name(command);
    }
    match command {
        0x90 => Some("power on"),
        0x91 => Some("reset begins"),
        0x92 => Some("command refused"),
        0xB0 => Some("measured values"),
        _ => request_name(command.checked_sub(REPLY)?),
    }
}

fn request_name(command: u8) -> Option<&'static str> {
    Some(match command {
        0x10 => "reset",
        0x20 => "change of operating mode",
        0x30 => "measured values, once",
        0x31 => "status",
        0x32 => "errors",
        0x35 => "operating data counters",
        0x36 => "mean values",
        0x37 => "values of a sub-range",
        0x3A => "type and firmware",
        0x3B => "switch of angle and resolution",
        0x3E => "values of a sub-range with field values",
        0x3F => "mean values of a sub-range",
        0x40 => "write of a field",
        0x41 => "switch of the field set",
        0x42 => "change of the password",
        0x44 => "ranges and reflectivity (S14)",
        0x45 => "field",
        0x46 => "teaching of a field",
        0x4A => "state of the field outputs",
        0x66 => "write of the rate after power-on",
        0x69 => "positioning aid",
        0x74 => "configuration, part 1",
        0x75 => "ranges and reflectivities",
        0x76 => "Cartesian coordinates",
        0x77 => "write of the configuration, part 1",
        0x7B => "configuration, part 2",
        0x7C => "write of the configuration, part 2",
        0x0B
        | 0x0C
        | 0x33
        | 0x34
        | 0x38
        | 0x39
        | 0x3C
        | 0x3D
        | 0x48
        | 0x4B..=0x52
        | 0x67
        | 0x68
        | 0x70
        | 0x72
        | 0x78..=0x7A => "reserved",
        _ => return None,
    })
}

/// Reports the parameters of a request. Parameters without a known layout become one field.
fn request_fields(reader: &mut FieldReader<'_, '_>, telegram: Telegram<'_>) -> Option<()> {
    match telegram.command() {
        MODE => mode_fields(reader),
        VALUES => reader.byte_as("selection", selection).map(drop),
        MEANS => show_scan_count(reader),
        RANGE => {
            reader.word_as("first value", |first| {
                lazy_text(move |f| match first & DIRECT_OUTPUT {
                    0 => Ok(()),
                    _ => write!(f, "{}, direct output of a partial scan", first & !DIRECT_OUTPUT),
                })
            })?;
            reader.word("last value").map(drop)
        }
        RANGE_FIELDS | REFLECTIVITY | CARTESIAN => span(reader),
        RANGE_MEANS => show_scan_count(reader).and_then(|()| span(reader)),
        REFLECTIVITIES => spans(reader),
        VARIANT => {
            reader.word_as("angle", |angle| lazy_text(move |f| write!(f, "{angle} degrees")))?;
            reader
                .word_as("resolution", |step| lazy_text(move |f| write!(f, "{} degrees", Degrees(step))))
                .map(drop)
        }
        WRITE_CONFIGURATION => configuration_fields(reader),
        POWER_ON_RATE => reader.byte_as("rate after power-on", power_on).map(drop),
        _ => reader.show_rest("parameters"),
    }
}

fn mode_fields(reader: &mut FieldReader<'_, '_>) -> Option<()> {
    match reader.byte_as("operating mode", operating::name)? {
        operating::INSTALLATION | 0x30 => reader.text("password", 8),
        0x26 => show_scan_count(reader),
        0x27 | 0x29 | 0x50 => span(reader),
        0x28 => show_scan_count(reader).and_then(|()| span(reader)),
        0x2B => spans(reader),
        _ => reader.show_rest("parameters"),
    }
}

fn show_scan_count(reader: &mut FieldReader<'_, '_>) -> Option<()> {
    reader.byte_as("scans", |count| lazy_text(move |f| write!(f, "mean of {count}"))).map(drop)
}

fn span(reader: &mut FieldReader<'_, '_>) -> Option<()> {
    reader.word("first value")?;
    reader.word("last value").map(drop)
}

fn spans(reader: &mut FieldReader<'_, '_>) -> Option<()> {
    for _ in 0..reader.word("sub-ranges")? {
        span(reader)?;
    }
    Some(())
}

/// Returns the meaning of the parameter of request 66h, which sets the baud rate after power-on.
fn power_on(byte: u8) -> &'static str {
    match byte {
        0 => "9600",
        1 => "the present rate is kept",
        2 => "the type is kept",
        _ => "unknown",
    }
}

fn selection(byte: u8) -> &'static str {
    match byte {
        1 => "all values",
        2 => "shortest vertical distance",
        3 => "taught values",
        6 => "every 2nd value",
        7 => "every 20th value",
        8 => "the current partial scan",
        _ => "unknown",
    }
}

/// Command byte of a request that writes the EEPROM. This module explains the request, and only `lms_configure` encodes
/// it.
const POWER_ON_RATE: u8 = 0x66;
/// Command byte of a request that writes the EEPROM. This module explains the request, and only `lms_configure` encodes
/// it.
const WRITE_CONFIGURATION: u8 = 0x77;
/// Bit of the first index of a sub-range that requests direct output of a partial scan.
const DIRECT_OUTPUT: u16 = 1 << 15;

/// Reports the data of a reply. Data without a known layout become one field.
fn reply_fields(reader: &mut FieldReader<'_, '_>, telegram: Telegram<'_>, mode: Option<Mode>) -> Option<()> {
    match telegram.command() {
        RESET | REFUSED => Some(()),
        POWER_ON | 0xBA => reader.text("type, number, firmware", reader.remaining()),
        0xA0 => reader.byte_as("outcome", done_if_zero).map(drop),
        MEASURED => values(reader, mode),
        0xB1 => status_fields(reader),
        0xB2 => error_fields(reader),
        0xB5 => {
            reader.word_as("hours", |hours| lazy_text(move |f| write!(f, "{} h", 2 * u32::from(hours))))?;
            reader.word("power-ons").map(drop)
        }
        0xB6 => reader.byte("scans").and_then(|_| values(reader, mode)),
        0xB7 => span(reader).and_then(|()| values(reader, mode)),
        0xBB => {
            reader.byte_as("outcome", done_if_one)?;
            reader.word_as("angle", |angle| lazy_text(move |f| write!(f, "{angle} degrees")))?;
            reader
                .word_as("resolution", |step| lazy_text(move |f| write!(f, "{} degrees", Degrees(step))))
                .map(drop)
        }
        0xBE => {
            span(reader)?;
            let count = count_word(reader)?;
            reader.rows("values", count, &["value", "field A", "field B", "field C"])?;
            indices(reader)
        }
        0xBF => {
            reader.byte("scans")?;
            span(reader).and_then(|()| values(reader, mode))
        }
        0xC4 => {
            let (count, unit) = counted(reader)?;
            ranges(reader, count, unit, mode)?;
            let levels = usize::from(reader.word("reflectivities")? & COUNT_MASK);
            span(reader)?;
            reader.raw("reflectivity", levels)?;
            indices(reader)
        }
        0xE6 => {
            reader.byte("outcome")?;
            reader.byte_as("rate after power-on", power_on).map(drop)
        }
        0xF4 => configuration_fields(reader),
        0xF5 => {
            for _ in 0..reader.word("sub-ranges")? {
                span(reader)?;
                let count = count_word(reader)?;
                reader.rows("values", count, &["distance", "reflectivity"])?;
            }
            indices(reader)
        }
        0xF7 => reader.byte_as("outcome", done_if_one).and_then(|_| configuration_fields(reader)),
        0xFC => reader.byte_as("outcome", done_if_one).and_then(|_| reader.show_rest("parameters")),
        _ => reader.show_rest("data"),
    }
}

/// Reads the count word, the values, and the two real-time indices if they are present.
fn values(reader: &mut FieldReader<'_, '_>, mode: Option<Mode>) -> Option<()> {
    let (count, unit) = counted(reader)?;
    ranges(reader, count, unit, mode)?;
    indices(reader)
}

fn ranges(reader: &mut FieldReader<'_, '_>, count: usize, unit: Unit, mode: Option<Mode>) -> Option<()> {
    reader.ranges("values", count, |bytes| Ranges {
        bytes,
        mode: mode.unwrap_or(Mode(0)),
        mode_known: mode.is_some(),
        unit,
    })
}

fn counted(reader: &mut FieldReader<'_, '_>) -> Option<(usize, Unit)> {
    let word = reader.word_as("count and unit", |word| {
        lazy_text(move |f| {
            write!(f, "{} values in {}", word & COUNT_MASK, unit_text((word >> 14) as u8))?;
            match word & PARTIAL_FLAG {
                0 => Ok(()),
                _ => write!(f, ", partial scan from x.{:02}", 25 * (word >> 11 & 3)),
            }
        })
    })?;
    Some((usize::from(word & COUNT_MASK), Unit::of_code((word >> 14) as u8).unwrap_or(Unit::Mm)))
}

fn count_word(reader: &mut FieldReader<'_, '_>) -> Option<usize> {
    counted(reader).map(|(count, _)| count)
}

fn indices(reader: &mut FieldReader<'_, '_>) -> Option<()> {
    if reader.remaining() == 2 {
        reader.byte("scan index")?;
        reader.byte("telegram index")?;
    }
    Some(())
}

fn error_fields(reader: &mut FieldReader<'_, '_>) -> Option<()> {
    while reader.remaining() >= 2 {
        // The two bytes form one error.
        reader.word_as("error", |word| {
            let [kind, number] = word.to_le_bytes();
            Fault { kind, number }
        })?;
    }
    Some(())
}

fn status_fields(reader: &mut FieldReader<'_, '_>) -> Option<()> {
    for item in status::ITEMS {
        match item.kind {
            ValueFormat::Text => reader.text(item.name, item.len)?,
            ValueFormat::Words => reader.rows(item.name, item.len / 2, &["channel"])?,
            ValueFormat::Bytes => reader.raw(item.name, item.len)?,
            ValueFormat::Number => {
                let name = item.name;
                let text = move |value: u32| {
                    lazy_text(move |f| match name {
                        "operating mode" => f.write_str(operating::name(value as u8)),
                        "measuring mode" => f.write_str(Mode(value as u8).name()),
                        "unit" => f.write_str(unit_text(value as u8)),
                        "defective" => f.write_str(if value == 0 { "no" } else { "yes" }),
                        "laser" => f.write_str(if value == 0 { "off" } else { "on" }),
                        "motor" => write!(f, "{} us per revolution", 90 * value),
                        "laser power" => write!(f, "{value} %"),
                        "scan angle" => write!(f, "{value} degrees"),
                        "resolution" => write!(f, "{} degrees", Degrees(value as u16)),
                        "permanent rate" => f.write_str(if value == 0 { "9600" } else { "another" }),
                        "rate of the line" => match status::baud_of_divisor(value as u16) {
                            Some(baud) => write!(f, "{} baud", Baud::rate(baud)),
                            None => f.write_str("unknown"),
                        },
                        "calibration interval" => write!(f, "{value} ns"),
                        _ => Ok(()),
                    })
                };
                reader.number(item.name, item.len, Some(text)).map(drop)?;
            }
        }
    }
    Some(())
}

/// Reads the fields of the configuration. If the data are shorter than a configuration, stops at the end of the data.
fn configuration_fields(reader: &mut FieldReader<'_, '_>) -> Option<()> {
    for item in configuration::ITEMS {
        if reader.remaining() < item.len {
            break;
        }
        let name = item.name;
        let text = move |value: u32| {
            lazy_text(move |f| match name {
                "blanking" => write!(f, "{value} cm"),
                "stop threshold" => write!(f, "{value} mV"),
                "availability" => f.write_str(availability_text(value as u8)),
                "measuring mode" => f.write_str(Mode(value as u8).name()),
                "unit" => f.write_str(Unit::of_code(value as u8).map_or("unknown", unit_name)),
                _ => Ok(()),
            })
        };
        reader.number(item.name, item.len, Some(text)).map(drop)?;
    }
    Some(())
}

fn done_if_zero(outcome: u8) -> &'static str {
    if outcome == 0 { "done" } else { "not done: wrong password, or a fault" }
}

fn done_if_one(outcome: u8) -> &'static str {
    if outcome == 1 { "done" } else { "not done: the present settings follow" }
}

/// Hundredths of a degree, shown without trailing zeros: 0.25, 0.5, 1.
struct Degrees(u16);

impl fmt::Display for Degrees {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.0 / 100, self.0 % 100) {
            (whole, 0) => write!(f, "{whole}"),
            (whole, part) if part % 10 == 0 => write!(f, "{whole}.{}", part / 10),
            (whole, part) => write!(f, "{whole}.{part:02}"),
        }
    }
}

fn unit_name(unit: Unit) -> &'static str {
    match unit {
        Unit::Cm => "cm",
        Unit::Mm => "mm",
        Unit::Dm => "10 cm",
    }
}

fn unit_text(code: u8) -> &'static str {
    Unit::of_code(code).map_or("unknown", unit_name)
}

/// Reader that divides the bytes of a telegram into fields. It never reads past the end of the layout, and never skips
/// a byte.
struct FieldReader<'t, 'v> {
    bytes: &'t [u8],
    at: usize,
    end: usize,
    visit: &'v mut dyn FnMut(&Field<'_>),
}

impl<'t, 'v> FieldReader<'t, 'v> {
    fn new(bytes: &'t [u8], visit: &'v mut dyn FnMut(&Field<'_>)) -> Self {
        FieldReader { bytes, at: 0, end: 0, visit }
    }

    /// Sets the index at which the following fields end.
    fn set_end(&mut self, end: usize) {
        self.end = end;
    }

    /// Reports all bytes before the last `len` bytes of the telegram as one field. The last `len` bytes have their own
    /// fields.
    fn show_to_tail(&mut self, len: usize) {
        self.end = self.bytes.len() - len;
        self.show_rest("data");
        self.end = self.bytes.len();
    }

    /// Returns the number of bytes before the end of the layout.
    fn remaining(&self) -> usize {
        self.end - self.at
    }

    fn byte(&mut self, name: &'static str) -> Option<u8> {
        self.number(name, 1, None::<fn(u32) -> &'static str>).map(|value| value as u8)
    }

    fn byte_as<D: Display>(&mut self, name: &'static str, meaning: impl FnOnce(u8) -> D) -> Option<u8> {
        self.number(name, 1, Some(|value| meaning(value as u8))).map(|value| value as u8)
    }

    fn word(&mut self, name: &'static str) -> Option<u16> {
        self.number(name, 2, None::<fn(u32) -> &'static str>).map(|value| value as u16)
    }

    fn word_as<D: Display>(&mut self, name: &'static str, meaning: impl FnOnce(u16) -> D) -> Option<u16> {
        self.number(name, 2, Some(|value| meaning(value as u16))).map(|value| value as u16)
    }

    /// Reports a number of one to four bytes, low byte first.
    fn number<D: Display>(
        &mut self,
        name: &'static str,
        len: usize,
        meaning: Option<impl FnOnce(u32) -> D>,
    ) -> Option<u32> {
        let (offset, bytes) = self.take(len)?;
        let value = bytes.iter().rev().fold(0, |value, &byte| value << 8 | u32::from(byte));
        let meaning = meaning.map(|words| words(value));
        let meaning = meaning.as_ref().map(|words| words as &dyn Display);
        self.show(&Field { offset, bytes, name, value: Value::Number(value), meaning });
        Some(value)
    }

    fn text(&mut self, name: &'static str, len: usize) -> Option<()> {
        let (offset, bytes) = self.take(len)?;
        self.show(&Field { offset, bytes, name, value: Value::Text(bytes), meaning: None });
        Some(())
    }

    fn raw(&mut self, name: &'static str, len: usize) -> Option<()> {
        let (offset, bytes) = self.take(len)?;
        self.show(&Field { offset, bytes, name, value: Value::Bytes(bytes), meaning: None });
        Some(())
    }

    /// Reports all bytes before the end of the layout as one field.
    fn show_rest(&mut self, name: &'static str) -> Option<()> {
        self.raw(name, self.remaining())
    }

    fn rows(&mut self, name: &'static str, rows: usize, columns: &'static [&'static str]) -> Option<()> {
        let (offset, bytes) = self.take(rows * 2 * columns.len())?;
        self.show(&Field { offset, bytes, name, value: Value::Rows { bytes, columns }, meaning: None });
        Some(())
    }

    /// Reports `count` measured values. `make` adds the settings that are needed to decode their bytes.
    fn ranges(
        &mut self,
        name: &'static str,
        count: usize,
        make: impl FnOnce(&'t [u8]) -> Ranges<'t>,
    ) -> Option<()> {
        let (offset, bytes) = self.take(2 * count)?;
        let ranges = make(bytes);
        self.show(&Field { offset, bytes, name, value: Value::Ranges(ranges), meaning: Some(&ranges) });
        Some(())
    }

    /// Passes a field to the callback, unless the field is empty.
    fn show(&mut self, field: &Field<'_>) {
        if !field.bytes.is_empty() {
            (self.visit)(field);
        }
    }

    fn take(&mut self, len: usize) -> Option<(usize, &'t [u8])> {
        let bytes = self.bytes.get(self.at..self.at + len).filter(|_| self.at + len <= self.end)?;
        let offset = self.at;
        self.at += len;
        Some((offset, bytes))
    }
}

/// Text that is created only when it is displayed.
struct LazyText<F>(F);

/// Returns text that calls `write` when it is displayed.
fn lazy_text<F: Fn(&mut fmt::Formatter<'_>) -> fmt::Result>(write: F) -> LazyText<F> {
    LazyText(write)
}

impl<F: Fn(&mut fmt::Formatter<'_>) -> fmt::Result> Display for LazyText<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        (self.0)(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::Request;
    use crate::lms::measured;
    use std::string::{String, ToString};
    use std::vec::Vec;
    use std::{format, vec};

    fn explained(telegram: Telegram<'_>, mode: Option<Mode>) -> Vec<(usize, String)> {
        let mut lines = vec![];
        explain(telegram, mode, &mut |field| {
            let words = field.meaning.map(|words| words.to_string()).unwrap_or_default();
            lines.push((field.offset, format!("{}: {words}", field.name)));
        });
        lines
    }

    #[test]
    fn explains_each_field_of_a_request() {
        let request = Request::Variant(crate::lms::variant::Variant::HALF).encode(0);
        let lines = explained(request.telegram(), None);
        let expected = [
            (0, "STX: "),
            (1, "address: to all sensors"),
            (2, "length: 5 bytes from command to checksum"),
            (4, "command: switch of angle and resolution"),
            (5, "angle: 180 degrees"),
            (7, "resolution: 0.5 degrees"),
            (9, "checksum: "),
        ];
        assert_eq!(lines, expected.map(|(at, line)| (at, line.to_string())));
    }

    #[test]
    fn explains_scan_with_known_and_unknown_mode() {
        let encoded = measured::encode(1, Unit::Cm, &[0xA3E8, 0x3FFF, 200], 0x92);
        let words =
            |mode| explained(encoded.telegram(), mode).into_iter().map(|(_, line)| line).collect::<Vec<_>>();
        let lines = words(None);
        assert_eq!(lines[1], "address: from sensor 1");
        assert_eq!(lines[4], "count and unit: 3 values in cm");
        assert!(lines[5].ends_with(
            "2000 to 10000 mm, 1 of 3 without; measuring mode unknown, 13 bits taken for the range"
        ));
        assert!(words(Some(Mode(1)))[5].ends_with("13 bits and 3 of reflector level"));
        assert!(words(Some(Mode(0x3F)))[5].contains("energy"));
        assert_eq!(lines[6], "status: warning, window polluted");
    }
}
