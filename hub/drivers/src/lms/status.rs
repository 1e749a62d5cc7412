//! Health of a scanner: the status byte that ends every reply, the status report B1h, and the errors of B2h (Telegram
//! listing 7-5, 7-18, 8 and 9).
//!
//! The status byte of the same scanner may be 10h on one day and 11h on the next. Only the single bits of the status
//! byte therefore have a meaning, and not the whole byte. The offsets in the status report were checked against a real
//! scanner.

use core::fmt;

use crate::lms::telegram::{EncodedTelegram, REPLY, Writer};
use crate::lms::variant::{Baud, Mode, Unit, Variant};

/// Status byte of a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StatusByte(pub u8);

impl StatusByte {
    /// Status byte of a healthy LMS type 6.
    pub const OK: StatusByte = StatusByte(0x10);

    /// Returns the severity. Returns `None` for an undefined code.
    pub fn severity(self) -> Option<Severity> {
        Severity::of_code(self.0 & 7)
    }

    /// Returns whether the window is dirty.
    pub fn is_polluted(self) -> bool {
        self.0 & 0x80 != 0
    }
}

impl fmt::Display for StatusByte {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.severity() {
            Some(severity) => f.write_str(severity.name())?,
            None => write!(f, "severity {}", self.0 & 7)?,
        }
        let flags = [
            (self.0 >> 3 & 3 != 0b10, "not an LMS of type 6"),
            (self.0 & 0x20 != 0, "restart input high"),
            (self.0 & 0x40 != 0, "implausible values"),
            (self.is_polluted(), "window polluted"),
        ];
        for (_, text) in flags.iter().filter(|(is_set, _)| *is_set) {
            write!(f, ", {text}")?;
        }
        Ok(())
    }
}

/// Severity of a condition or an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// No error.
    Ok,
    /// The report is only for information.
    Info,
    /// The scanner still works.
    Warning,
    /// The scanner does not work correctly.
    Error,
    /// The scanner does not work.
    Fatal,
}

impl Severity {
    /// Returns the severity with this code, 0 to 4.
    pub fn of_code(code: u8) -> Option<Severity> {
        [Severity::Ok, Severity::Info, Severity::Warning, Severity::Error, Severity::Fatal]
            .get(usize::from(code))
            .copied()
    }

    /// Returns the code of the severity.
    pub fn code(self) -> u8 {
        self as u8
    }

    /// Returns the name of the severity.
    pub fn name(self) -> &'static str {
        match self {
            Severity::Ok => "ok",
            Severity::Info => "info",
            Severity::Warning => "warning",
            Severity::Error => "error",
            Severity::Fatal => "fatal",
        }
    }
}

/// View of the data of a status reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StatusReport<'a>(&'a [u8; REPORT_LEN]);

impl<'a> StatusReport<'a> {
    /// Returns the view of `bytes`. Returns `None` if `bytes` does not have exactly 152 bytes.
    pub fn new(bytes: &'a [u8]) -> Option<StatusReport<'a>> {
        bytes.try_into().ok().map(StatusReport)
    }

    /// Returns the bytes as received.
    pub fn bytes(&self) -> &'a [u8; REPORT_LEN] {
        self.0
    }

    /// Returns the firmware version as ASCII, such as `V02.19`.
    pub fn software(&self) -> &'a [u8] {
        self.0[..7].trim_ascii()
    }

    /// Returns the operating mode. The values are those of the byte after command 20h (24h: streaming, 25h: on
    /// request).
    pub fn operating_mode(&self) -> u8 {
        self.0[7]
    }

    /// Returns whether the scanner reports that it is defective.
    pub fn is_defective(&self) -> bool {
        self.0[8] != 0
    }

    /// Returns the transmission of the dirtiest channel of the window, in percent of a clean window. Returns `None` if
    /// the clean window was never measured.
    pub fn window_percent(&self) -> Option<u16> {
        let percent = |channel| {
            let (measured, clean) = (self.word(18 + 2 * channel), self.word(42 + 2 * channel));
            (u32::from(measured) * 100).checked_div(u32::from(clean))
        };
        (0..WINDOW_CHANNELS).filter_map(percent).min().and_then(|percent| percent.try_into().ok())
    }

    /// Returns the laser power in percent of the nominal power. A real scanner reported 156 to 161.
    pub fn laser_power_percent(&self) -> u16 {
        self.word(82)
    }

    /// Returns the measuring mode, which determines the range bits and the upper bits of a value.
    pub fn mode(&self) -> Mode {
        Mode(self.0[101])
    }

    /// Returns the current angle and resolution, or `None` if they are not a [`Variant`].
    pub fn variant(&self) -> Option<Variant> {
        Variant::new(self.word(106), self.word(108))
    }

    /// Returns the baud rate of the line, or `None` for an unknown divisor.
    pub fn baud(&self) -> Option<Baud> {
        baud_of_divisor(self.word(115))
    }

    /// Returns whether the baud rate after power-on differs from the factory setting of 9600 baud (byte 119, which the
    /// factory sets to 0).
    pub fn has_permanent_baud(&self) -> bool {
        self.0[118] != 0
    }

    /// Returns the scanner's address.
    pub fn address(&self) -> u8 {
        self.0[119]
    }

    /// Returns the unit of the ranges, or `None` for an unknown code.
    pub fn unit(&self) -> Option<Unit> {
        Unit::of_code(self.0[121])
    }

    /// Returns whether the laser is on.
    pub fn is_laser_on(&self) -> bool {
        self.0[122] != 0
    }

    fn word(&self, at: usize) -> u16 {
        u16::from_le_bytes([self.0[at], self.0[at + 1]])
    }
}

/// State of a simulated scanner, for its status reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SimulatedStatus {
    /// Firmware version, 7 ASCII characters.
    pub software: [u8; 7],
    /// Operating mode. The values are those of the byte after command 20h.
    pub operating_mode: u8,
    /// Measuring mode, which determines the range bits and the upper bits of a value.
    pub mode: Mode,
    /// Current angle and resolution.
    pub variant: Variant,
    /// Unit of the ranges.
    pub unit: Unit,
    /// Baud rate of the line.
    pub baud: Baud,
}

impl SimulatedStatus {
    /// Returns a status report with these settings. The motor has its nominal speed, and the laser is on. All other
    /// values are 0.
    pub fn report(&self) -> [u8; REPORT_LEN] {
        let mut data = [0; REPORT_LEN];
        data[..7].copy_from_slice(&self.software);
        data[7] = self.operating_mode;
        data[66..68].copy_from_slice(&148u16.to_le_bytes());
        data[101] = self.mode.0;
        data[106..108].copy_from_slice(&self.variant.angle_deg.to_le_bytes());
        data[108..110].copy_from_slice(&self.variant.resolution_cdeg.to_le_bytes());
        data[115..117].copy_from_slice(&divisor_of(self.baud).to_le_bytes());
        data[121] = self.unit.code();
        data[122] = 1;
        data
    }
}

/// Encodes the status reply B1h with the settings in `health`, see [`SimulatedStatus::report`].
pub fn status_reply(address: u8, health: &SimulatedStatus, status: u8) -> EncodedTelegram {
    Writer::new(address | REPLY, crate::lms::command::STATUS | REPLY)
        .slice(&health.report())
        .byte(status)
        .finish()
}

/// Returns the divisor word of a baud rate. The upper bit of the word is set, and the other bits are n in the equation
/// rate = 16 MHz / (16 (n + 1)).
fn divisor_of(baud: Baud) -> u16 {
    match baud {
        Baud::B500000 => 0x8001,
        Baud::B38400 => 0x8019,
        Baud::B19200 => 0x8033,
        Baud::B9600 => 0x8067,
    }
}

/// Returns the baud rate of a divisor word. Returns `None` if the word is unknown.
pub(crate) fn baud_of_divisor(divisor: u16) -> Option<Baud> {
    Baud::ALL.into_iter().find(|&baud| divisor_of(baud) == divisor)
}

/// Format of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ValueFormat {
    /// ASCII.
    Text,
    /// One number of 1, 2 or 4 bytes.
    Number,
    /// Several words.
    Words,
    /// Bytes without a known meaning.
    Bytes,
}

/// Position, format and name of a value in the report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Item {
    /// Offset of the value's first byte.
    pub at: usize,
    /// Length in bytes.
    pub len: usize,
    /// Name of the value.
    pub name: &'static str,
    /// Format of the value.
    pub kind: ValueFormat,
}

const fn item(at: usize, len: usize, name: &'static str, kind: ValueFormat) -> Item {
    Item { at, len, name, kind }
}

/// All values of the report. Their order is the order of the bytes, without gaps. The listing counts from the command
/// byte, so its offsets are greater by one.
pub const ITEMS: [Item; 50] = [
    item(0, 7, "software version", ValueFormat::Text),
    item(7, 1, "operating mode", ValueFormat::Number),
    item(8, 1, "defective", ValueFormat::Number),
    item(9, 8, "reserved", ValueFormat::Text),
    item(17, 1, "variant type", ValueFormat::Number),
    item(18, 16, "pollution", ValueFormat::Words),
    item(34, 8, "pollution reference", ValueFormat::Words),
    item(42, 16, "pollution calibration", ValueFormat::Words),
    item(58, 8, "pollution reference calibration", ValueFormat::Words),
    item(66, 2, "motor", ValueFormat::Number),
    item(68, 2, "reserved", ValueFormat::Bytes),
    item(70, 2, "dark signal at 100 %", ValueFormat::Number),
    item(72, 2, "reserved", ValueFormat::Bytes),
    item(74, 2, "dark signal at 100 %", ValueFormat::Number),
    item(76, 2, "dark signal at 66 %", ValueFormat::Number),
    item(78, 2, "reserved", ValueFormat::Bytes),
    item(80, 2, "dark signal at 66 %", ValueFormat::Number),
    item(82, 2, "laser power", ValueFormat::Number),
    item(84, 2, "angle", ValueFormat::Number),
    item(86, 2, "peak threshold", ValueFormat::Number),
    item(88, 2, "angle of the reference", ValueFormat::Number),
    item(90, 2, "calibration of the reference", ValueFormat::Number),
    item(92, 2, "target stop threshold", ValueFormat::Number),
    item(94, 2, "target peak threshold", ValueFormat::Number),
    item(96, 2, "actual stop threshold", ValueFormat::Number),
    item(98, 2, "actual peak threshold", ValueFormat::Number),
    item(100, 1, "reserved", ValueFormat::Bytes),
    item(101, 1, "measuring mode", ValueFormat::Number),
    item(102, 2, "reference target filter", ValueFormat::Number),
    item(104, 2, "reference target filter", ValueFormat::Number),
    item(106, 2, "scan angle", ValueFormat::Number),
    item(108, 2, "resolution", ValueFormat::Number),
    item(110, 1, "restart", ValueFormat::Number),
    item(111, 2, "restart time", ValueFormat::Number),
    item(113, 2, "offset of field set 2", ValueFormat::Number),
    item(115, 2, "rate of the line", ValueFormat::Number),
    item(117, 1, "evaluations", ValueFormat::Number),
    item(118, 1, "permanent rate", ValueFormat::Number),
    item(119, 1, "address", ValueFormat::Number),
    item(120, 1, "field set", ValueFormat::Number),
    item(121, 1, "unit", ValueFormat::Number),
    item(122, 1, "laser", ValueFormat::Number),
    item(123, 7, "boot PROM version", ValueFormat::Text),
    item(130, 4, "calibration", ValueFormat::Number),
    item(134, 4, "calibration", ValueFormat::Number),
    item(138, 4, "calibration", ValueFormat::Number),
    item(142, 4, "calibration", ValueFormat::Number),
    item(146, 2, "M0, first", ValueFormat::Number),
    item(148, 2, "M0, second", ValueFormat::Number),
    item(150, 2, "calibration interval", ValueFormat::Number),
];

/// Transmission in percent below which the window is dirty (Telegram listing, errors 18 and 19).
pub(crate) const DIRTY_BELOW_PERCENT: u16 = 75;
/// Number of channels of the pollution measurement that measure the window. The other channels are the reference.
const WINDOW_CHANNELS: usize = 8;

/// Length of the report in bytes: LENGTH 9Ah without command and status (Telegram listing 7-5).
pub const REPORT_LEN: usize = 152;

/// View of the errors of a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Errors<'a>(&'a [u8]);

impl<'a> Errors<'a> {
    /// Returns the view of the pairs of bytes in `bytes`. Returns `None` if the last pair is incomplete.
    pub fn new(bytes: &'a [u8]) -> Option<Errors<'a>> {
        bytes.len().is_multiple_of(2).then_some(Errors(bytes))
    }

    /// Returns the bytes as received.
    pub fn bytes(&self) -> &'a [u8] {
        self.0
    }

    /// Returns the errors in the order of the reply.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Fault> + Clone + 'a {
        self.0.chunks_exact(2).map(|pair| Fault { kind: pair[0], number: pair[1] })
    }
}

/// Error in a reply to [`crate::lms::command::Request::Errors`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault {
    /// Error type: the severity, plus 80h if the error is past.
    pub kind: u8,
    /// Number of the error.
    pub number: u8,
}

impl Fault {
    /// Returns the severity, or `None` for an undefined code.
    pub fn severity(self) -> Option<Severity> {
        Severity::of_code(self.kind & !PAST_FLAG)
    }

    /// Returns whether the error has ended. It is then only in the error memory, which command 10h clears.
    pub fn is_past(self) -> bool {
        self.kind & PAST_FLAG != 0
    }

    /// Returns the meaning of the number, or `None` if it is unknown.
    pub fn meaning(self) -> Option<&'static str> {
        Some(match self.number {
            5 => "dazzled",
            6 | 7 => "comparator",
            15 => "time measurement (TDC)",
            17 | 20 => "oil on the window",
            18 | 19 => "dirt on the window",
            21 | 22 => "reference of the pollution measurement",
            27 | 28 => "switching outputs",
            29 => "motor revolutions",
            37 => "calibration of the pollution measurement",
            45 => "a value is missing",
            46 => "a scan is missing",
            47 => "reference target",
            48 | 49 => "laser power",
            53 => "FLASH written",
            56 => "watchdog",
            57 => "no zero index",
            58..=61 => "synchronization of two scanners",
            62 => "DIP switches",
            86..=92 => "reference target",
            124..=126 => "memory",
            _ => return None,
        })
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.is_past() { "past " } else { "" })?;
        match self.severity() {
            Some(severity) => f.write_str(severity.name())?,
            None => write!(f, "type {:02X}", self.kind & !PAST_FLAG)?,
        }
        write!(f, " {}", self.number)?;
        match self.meaning() {
            Some(meaning) => write!(f, ": {meaning}"),
            None => Ok(()),
        }
    }
}

/// Bit of an error's type which states that the error has ended.
const PAST_FLAG: u8 = 0x80;

#[cfg(test)]
mod tests {
    use std::string::ToString;
    use std::vec::Vec;

    use super::*;
    use crate::lms::telegram::Telegram;

    #[test]
    fn prints_every_bit_of_status_byte() {
        for (byte, words) in [
            (0x10, "ok"),
            (0x11, "info"),
            (0x92, "warning, window polluted"),
            (0x53, "error, implausible values"),
            (0x34, "fatal, restart input high"),
            (0x18, "ok, not an LMS of type 6"),
            (0x15, "severity 5"),
        ] {
            assert_eq!(StatusByte(byte).to_string(), words);
        }
        assert!((0..5).all(|code| Severity::of_code(code).unwrap().code() == code));
    }

    #[test]
    fn status_items_are_contiguous() {
        let end = ITEMS.iter().fold(0, |at, item| {
            assert_eq!(item.at, at, "{}", item.name);
            at + item.len
        });
        assert_eq!(end, REPORT_LEN);
    }

    #[test]
    fn encodes_and_reads_status() {
        for baud in Baud::ALL {
            let health = SimulatedStatus {
                software: *b"V02.19 ",
                operating_mode: 0x24,
                mode: Mode(1),
                variant: Variant::HALF,
                unit: Unit::Cm,
                baud,
            };
            let encoded = status_reply(0, &health, 0x10);
            assert_eq!((encoded.bytes().len(), encoded.telegram().length()), (160, 0x9A));
            let telegram = Telegram::check(encoded.bytes()).unwrap();
            let report = StatusReport::new(telegram.data()).unwrap();
            assert_eq!((report.software(), report.operating_mode()), (&b"V02.19"[..], 0x24));
            assert_eq!((report.is_defective(), report.is_laser_on()), (false, true));
            assert_eq!((report.mode(), report.variant()), (Mode(1), Some(Variant::HALF)));
            assert_eq!((report.unit(), report.baud()), (Some(Unit::Cm), Some(baud)));
            assert_eq!((report.word(66), report.has_permanent_baud(), report.address()), (148, false, 0));
            assert_eq!((&report.bytes()[18..42], report.laser_power_percent()), (&[0; 24][..], 0));
        }
        assert_eq!(StatusReport::new(&[0; 151]), None);
    }

    #[test]
    fn reads_captured_errors() {
        // Captured: B2 84 16 (84 31)x8 84 16 01 31. This test omits repeated pairs.
        let errors = Errors::new(&[0x84, 0x16, 0x84, 0x31, 1, 0x31]).unwrap();
        let words: Vec<_> = errors.iter().map(|fault| fault.to_string()).collect();
        assert_eq!(
            words,
            [
                "past fatal 22: reference of the pollution measurement",
                "past fatal 49: laser power",
                "info 49: laser power"
            ]
        );
        assert_eq!(Errors::new(&[1]), None);
        assert_eq!(Fault { kind: 0x7F, number: 1 }.to_string(), "type 7F 1");
    }
}
