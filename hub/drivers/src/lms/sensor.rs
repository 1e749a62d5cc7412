//! State of a scanner according to its telegrams, for messages and for the next session. The session discards the
//! identity when the next telegram may come from another scanner.

use core::fmt;

use crate::line;
use crate::lms::command::Request;
use crate::lms::header::StreamHeader;
use crate::lms::lms_model::LmsModel;
use crate::lms::reply::{POWER_ON, Reply};
use crate::lms::status::{DIRTY_BELOW_PERCENT, Severity, StatusByte, StatusReport};
use crate::lms::telegram::Telegram;
use crate::lms::variant::{Baud, Mode, Unit, Variant};

/// Reason why a session does not stream as requested.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Problem {
    /// The scanner does not reply at any rate.
    NoReply {
        /// Only baud rate that the session tried. `None` if it tried all rates.
        baud: Option<Baud>,
        /// Seconds without a reply, rounded down to steps of increasing length.
        seconds: u32,
    },
    /// The scanner did not reply to this request in all its tries.
    Unanswered(Request),
    /// The scanner refused a request.
    Refused(Request),
    /// The scanner keeps an angle or a resolution that the session did not request, and streams with this setting.
    VariantRefused,
    /// No measured data arrived for one second.
    Silence,
    /// The line cannot carry 500,000 baud, because it was silent after two switches to this rate.
    NeedsRs422 {
        /// Baud rate that the session uses instead. `None` if the settings require 500,000 baud.
        fallback: Option<Baud>,
    },
    /// The port does not support 500,000 baud.
    PortLacksRate {
        /// Rate that the session uses instead.
        fallback: Baud,
    },
    /// The session is paused, but bytes arrive, and the scanner has not confirmed the stop.
    NotStopped,
    /// The scanner is a version S14. It scans 90 degrees with as many values as other scanners use for 180 degrees.
    AnglesUnknown,
    /// The scanner's measuring mode has values that are not ranges, or whose layout is not documented.
    NoRanges(Mode),
    /// The scanner does not report its measuring mode, so the session does not know how many of the 16 bits of a value
    /// are the range.
    ModeUnknown,
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Problem::NoReply { baud: None, seconds } => write!(
                f,
                "no reply at 9600, 19200, 38400 or 500000 baud for {seconds} s: power, cable, RS-422 jumper?"
            ),
            Problem::NoReply { baud: Some(baud), .. } => write!(
                f,
                "no reply at {} baud, the rate set in the serial server: power, cable, rate?",
                baud.rate()
            ),
            Problem::Unanswered(request) => write!(f, "no reply to {request:?} in several tries"),
            Problem::Refused(request) => write!(f, "the sensor refused {request:?}"),
            Problem::VariantRefused => f.write_str("the sensor keeps its own angle and resolution"),
            Problem::ModeUnknown => f.write_str("the sensor does not report its measuring mode: no scans"),
            Problem::AnglesUnknown => {
                f.write_str("the scanner is a version S14, whose angles are not supported: no scans")
            }
            Problem::NoRanges(Mode(mode)) => {
                write!(f, "the sensor measures in mode {mode:02x}h, which has no ranges: no scans")
            }
            Problem::NotStopped => f.write_str("paused, but the sensor does not stop: cable to the sensor?"),
            Problem::Silence => f.write_str("no measured data for one second"),
            Problem::NeedsRs422 { fallback: Some(baud) } => write!(
                f,
                "500000 baud needs RS-422: the scanner was lost in two switches to it, so the hub uses {} baud. If no \
                 scans arrive, cycle the scanner's power",
                baud.rate()
            ),
            Problem::PortLacksRate { fallback: instead } => write!(
                f,
                "the port does not support 500000 baud, so the hub uses {} baud, with a tenth of the scans. An adapter \
                 with an FTDI chip supports it",
                instead.rate()
            ),
            Problem::NeedsRs422 { fallback: None } => f.write_str(
                "500000 baud needs RS-422: the scanner was lost in two switches to it. On RS-232, set baud = 38400 and \
                 cycle the scanner's power",
            ),
        }
    }
}

/// State of a scanner according to its telegrams. A field is `None` before its first report.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sensor {
    /// Address byte of the scanner's telegrams: the scanner's own address + 80h.
    pub address: Option<u8>,
    /// Measuring mode, which determines the range bits and the upper bits of a value.
    pub mode: Option<Mode>,
    /// Unit of the ranges.
    pub unit: Option<Unit>,
    /// Angle and resolution.
    pub variant: Option<Variant>,
    /// Whether the scanner sends scans without a request, or is in a mode in which it does not measure.
    pub streams: bool,
    /// Status byte of the telegrams. The session accepts a worse status byte at once, unless the line damages
    /// telegrams. It accepts a better status byte only after some hundred telegrams with better status bytes, because
    /// the status byte may change with every scan.
    pub status_byte: Option<StatusByte>,
    /// Whether the scanner reports that it is defective.
    pub defective: Option<bool>,
    /// Whether the EEPROM contains a baud rate for power-on other than the factory's 9,600 baud.
    pub permanent_baud: Option<bool>,
    /// Laser power in percent of the nominal power. Real scanners report 156 to 161.
    pub laser_power_percent: Option<u16>,
    /// Transmission of the dirtiest channel of the window, in percent of a clean window. The scanner warns below 75,
    /// and reports an error below 30.
    pub window_percent: Option<u16>,
    software: [u8; SOFTWARE_NAME_LEN],
    kind: [u8; MAX_TYPE_LEN],
    kind_len: usize,
    /// Model in the type reply.
    family: Option<LmsModel>,
    /// Number of consecutive telegrams with a better status byte.
    better_telegrams: u16,
    /// Whether the line damages telegrams. A single telegram then does not prove a worse status.
    is_line_damaged: bool,
    /// Number of reports of a worse status on a line that damages telegrams, and number of telegrams since the first
    /// report.
    worse_reports: u8,
    worse_since: u16,
    /// Number of reports of a fatal status.
    fatal_reports: u8,
    /// Issues of the last status report. `is_confirmed` is whether the previous report had the same issues.
    issues: Option<HealthIssues>,
    is_confirmed: bool,
}

/// Issues in a status report. The first value is whether the scanner is defective, and the second is whether the window
/// is dirty.
type HealthIssues = (bool, bool);

impl Sensor {
    /// Returns model, number and firmware as ASCII, such as `LMS200;S18063;V02.19`. Returns an empty slice if the
    /// scanner has not reported them yet.
    pub fn kind(&self) -> &[u8] {
        &self.kind[..self.kind_len]
    }

    /// Returns whether the scans have angles that no [`Variant`] has, although their number of values is that of a
    /// variant.
    pub fn has_other_angles(&self) -> bool {
        self.family == Some(LmsModel::Fast)
    }

    /// Returns the measuring mode if the values are ranges at known angles. Returns `None` if the session cannot return
    /// scans.
    pub(crate) fn mode_of_scans(&self) -> Option<Mode> {
        self.mode.filter(|mode| mode.has_ranges() && !self.has_other_angles())
    }

    /// Returns the firmware as ASCII, such as `V02.19`. Returns an empty slice if the scanner has not reported it yet.
    pub fn software(&self) -> &[u8] {
        self.software.trim_ascii()
    }

    /// Returns the notices for the user, the worst notice first. Faults come before all other notices.
    pub fn notices(&self) -> impl Iterator<Item = Notice> {
        let severity = self.status_byte.and_then(StatusByte::severity);
        let dirty = self.status_byte.is_some_and(StatusByte::is_polluted);
        let (defective, dim) = self.issues.filter(|_| self.is_confirmed).unwrap_or_default();
        [
            (defective, Notice::Defective),
            (severity == Some(Severity::Fatal), Notice::Fatal),
            (severity == Some(Severity::Error), Notice::Error),
            (dirty || dim, Notice::Dirty),
            (self.permanent_baud == Some(true), Notice::PermanentBaud),
        ]
        .into_iter()
        .filter_map(|(is_so, notice)| is_so.then_some(notice))
    }

    /// Discards the identity and the layout of values. The next telegram may come from another scanner, or from the
    /// same scanner with another configuration. Keeps the state that every scan contains.
    pub(crate) fn reset_identity(&mut self) {
        self.mode = None;
        self.set_kind(&[]);
        self.defective = None;
        self.issues = None;
        self.is_confirmed = false;
    }

    /// Stores whether the line damages telegrams now. Some damaged telegrams pass their weak checksum.
    pub(crate) fn set_line_damaged(&mut self, is_line_damaged: bool) {
        self.is_line_damaged = is_line_damaged;
        if !is_line_damaged {
            (self.worse_reports, self.fatal_reports) = (0, 0);
        }
    }

    /// Returns whether the session must request the status again, because a single report of an issue may be damaged.
    pub(crate) fn needs_confirmation(&self) -> bool {
        self.issues.is_some() && !self.is_confirmed
    }

    /// Accepts the last status report without a second report, because the session will not request another one.
    pub(crate) fn accept_unconfirmed(&mut self) {
        self.is_confirmed = true;
    }

    /// Returns the identity of the scanner, for a session that continues the same stream. `header` is the start of
    /// every scan. Returns `None` if the identity is incomplete.
    pub(crate) fn identity(&self, header: StreamHeader) -> Option<Identity> {
        let mode = self.mode.filter(|_| self.kind_len > 0)?;
        Some(Identity { header, mode, kind: self.kind })
    }

    /// Restores the identity of a scanner that still streams.
    pub(crate) fn restore_identity(&mut self, known: Identity) {
        self.mode = Some(known.mode);
        let kind_len = known.kind.iter().position(|&byte| byte == 0).unwrap_or(MAX_TYPE_LEN);
        self.set_kind(&known.kind[..kind_len]);
    }

    /// Stores the first [`MAX_TYPE_LEN`] bytes of the type reply.
    fn set_kind(&mut self, kind: &[u8]) {
        self.kind_len = kind.len().min(MAX_TYPE_LEN);
        self.kind = [0; MAX_TYPE_LEN];
        self.kind[..self.kind_len].copy_from_slice(&kind[..self.kind_len]);
        self.family = LmsModel::of_type(self.kind());
    }

    /// Stores the state in `telegram`, which decodes to `reply`.
    pub(crate) fn update(&mut self, reply: Option<&Reply<'_>>, telegram: Telegram<'_>) {
        self.address = Some(telegram.address());
        self.note_status_byte(telegram.status().map(StatusByte));
        if telegram.command() == POWER_ON {
            self.reset_identity();
            self.streams = false;
            self.variant = None;
        }
        let Some(reply) = reply else { return };
        match reply {
            Reply::Status(report) => self.read_status(report),
            Reply::Configuration(configuration) => {
                self.mode = Some(configuration.mode());
                self.unit = configuration.unit().or(self.unit);
            }
            Reply::Variant { angle_deg, resolution_cdeg, .. } => {
                self.variant = Variant::new(*angle_deg, *resolution_cdeg).or(self.variant);
            }
            Reply::Measured(measured) if measured.partial().is_none() => {
                self.unit = Some(measured.unit());
                self.variant = Variant::of_beams(measured.count()).or(self.variant);
            }
            Reply::Type(name) => self.set_kind(name),
            _ => {}
        }
    }

    fn read_status(&mut self, report: &StatusReport<'_>) {
        self.mode = Some(report.mode());
        self.unit = report.unit().or(self.unit);
        self.variant = report.variant().or(self.variant);
        self.streams = report.operating_mode() != ON_REQUEST;
        self.defective = Some(report.is_defective());
        self.permanent_baud = Some(report.has_permanent_baud());
        self.laser_power_percent = Some(report.laser_power_percent());
        self.window_percent = report.window_percent();
        let is_dim = self.window_percent.is_some_and(|percent| percent < DIRTY_BELOW_PERCENT);
        let issues = Some((report.is_defective(), is_dim)).filter(|&issues| issues != (false, false));
        self.is_confirmed = issues.is_some() && issues == self.issues;
        self.issues = issues;
        self.software = *report.bytes().first_chunk().unwrap_or(&[0; SOFTWARE_NAME_LEN]);
    }

    /// Counts a report of a worse status on a line that damages telegrams. Returns whether enough reports have arrived.
    /// For a fatal status, two reports with any time between them are sufficient, because a scanner may report a fatal
    /// status only from time to time.
    fn count_worse_report(&mut self, is_fatal: bool) -> bool {
        if is_fatal {
            self.fatal_reports += 1;
            return self.fatal_reports == FATAL_CONFIRMATIONS;
        }
        if self.worse_reports == 0 || self.worse_since > RECOVERY_TELEGRAMS {
            (self.worse_reports, self.worse_since) = (0, 0);
        }
        self.worse_reports += 1;
        self.worse_reports == CONFIRMATIONS
    }

    fn note_status_byte(&mut self, condition: Option<StatusByte>) {
        self.worse_since = self.worse_since.saturating_add(1);
        let is_fatal = condition.and_then(StatusByte::severity) == Some(Severity::Fatal);
        if self.is_line_damaged
            && severity_rank(condition) > severity_rank(self.status_byte)
            && !self.count_worse_report(is_fatal)
        {
            return;
        }
        self.fatal_reports = if is_fatal { 0 } else { self.fatal_reports };
        self.worse_reports = if severity_rank(condition) > 0 { 0 } else { self.worse_reports };
        let is_better = severity_rank(condition) < severity_rank(self.status_byte);
        self.better_telegrams = if is_better { self.better_telegrams + 1 } else { 0 };
        if !is_better || self.better_telegrams > RECOVERY_TELEGRAMS {
            self.status_byte = condition;
            self.better_telegrams = 0;
        }
    }
}

/// Identity of a scanner that streams. The scans themselves do not contain the identity. With it, a session that
/// continues the same stream can decode values before it sends a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Identity {
    /// First bytes of each scan.
    pub(crate) header: StreamHeader,
    mode: Mode,
    /// Type reply, padded with zeros.
    kind: [u8; MAX_TYPE_LEN],
}

impl Identity {
    /// Encodes the identity: header, mode, type.
    pub(crate) fn to_bytes(self) -> line::Identity {
        let mut bytes = line::Identity::default();
        let (header, rest) = bytes.split_at_mut(self.header.len());
        header.copy_from_slice(&self.header);
        rest[0] = self.mode.0;
        rest[1..].copy_from_slice(&self.kind);
        bytes
    }

    /// Decodes the result of [`to_bytes`](Self::to_bytes).
    pub(crate) fn from_bytes(bytes: line::Identity) -> Identity {
        let mut identity = Identity { header: Default::default(), mode: Mode(0), kind: [0; MAX_TYPE_LEN] };
        let (header, rest) = bytes.split_at(identity.header.len());
        identity.header.copy_from_slice(header);
        identity.mode = Mode(rest[0]);
        identity.kind.copy_from_slice(&rest[1..]);
        identity
    }
}

const _: () = assert!(size_of::<StreamHeader>() + 1 + MAX_TYPE_LEN == size_of::<line::Identity>());

/// Condition that the user should know about although scans arrive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Notice {
    /// The scanner's status report states that the scanner is defective.
    Defective,
    /// The status byte reports a fatal error.
    Fatal,
    /// The status byte reports an error.
    Error,
    /// The window is dirty.
    Dirty,
    /// The scanner does not use 9,600 baud after power-on.
    PermanentBaud,
}

impl Notice {
    /// Returns whether scans may be wrong because of the condition.
    pub fn is_fault(self) -> bool {
        self != Notice::PermanentBaud
    }

    /// Returns the message for the user.
    pub(crate) fn text(self) -> &'static str {
        match self {
            Notice::Defective => {
                "the sensor reports that it is defective; it streams, but its scans may be wrong"
            }
            Notice::Fatal => "the sensor reports a fatal error; it streams, but its scans may be wrong",
            Notice::Error => "the sensor reports an error; it streams, but its scans may be wrong",
            Notice::Dirty => "the sensor's window is dirty: clean it",
            Notice::PermanentBaud => {
                "the rate after power-on in the sensor's EEPROM is not the factory's; the hub works with it as it is"
            }
        }
    }
}

/// Returns the rank of a status byte. A worse status byte has a higher rank. The rank depends only on the severity and
/// on whether the window is dirty.
fn severity_rank(condition: Option<StatusByte>) -> u8 {
    let severity = condition.and_then(StatusByte::severity).unwrap_or(Severity::Ok);
    let polluted = condition.is_some_and(StatusByte::is_polluted);
    if severity >= Severity::Error { 2 * severity.code() + u8::from(polluted) } else { u8::from(polluted) }
}

/// Number of consecutive telegrams with a better status byte after which the better status byte replaces the stored
/// one. These telegrams take some seconds.
const RECOVERY_TELEGRAMS: u16 = 200;
/// Number of reports of a worse status that prove this status on a line that damages telegrams. The reports must be
/// among [`RECOVERY_TELEGRAMS`] telegrams.
const CONFIRMATIONS: u8 = 3;
/// Number of reports of a fatal status that prove this status on a line that damages telegrams. Any number of telegrams
/// may be between the reports.
const FATAL_CONFIRMATIONS: u8 = 2;
/// Length of the firmware version, in bytes.
const SOFTWARE_NAME_LEN: usize = 7;
/// Maximum length of a stored type reply, in bytes. Type replies of real scanners have 20 or 21 characters.
const MAX_TYPE_LEN: usize = 24;
/// Operating mode: values on request.
const ON_REQUEST: u8 = 0x25;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::STATUS;
    use crate::lms::status::SimulatedStatus;
    use crate::lms::telegram::{REPLY, Writer};

    #[test]
    fn repeated_conditions_count_on_a_damaged_line() {
        // The lowest bits of a status byte are the severity: 0 ok, 4 fatal. The highest bit is a dirty window.
        let (ok, fatal, dirty) = (StatusByte(0x10), StatusByte(0x14), StatusByte(0x90));
        let report = |sensor: &mut Sensor, condition: StatusByte, calm: u32| {
            sensor.note_status_byte(Some(condition));
            let notice = sensor.notices().next();
            (0..calm).for_each(|_| sensor.note_status_byte(Some(ok)));
            notice
        };
        let mut sensor = Sensor::default();
        report(&mut sensor, ok, 1);
        sensor.set_line_damaged(true);
        assert_eq!(report(&mut sensor, fatal, 5_000), None, "one telegram proves nothing");
        assert_eq!(report(&mut sensor, fatal, 5_000), Some(Notice::Fatal));
        for _ in 0..5 {
            assert_eq!(report(&mut sensor, dirty, 150), None, "fewer than three of 200");
        }
        for _ in 0..2 {
            assert_eq!(report(&mut sensor, fatal, 10), None);
            sensor.set_line_damaged(false);
            sensor.note_status_byte(Some(ok));
            sensor.set_line_damaged(true);
        }
        assert_eq!([(); 3].map(|()| report(&mut sensor, dirty, 10)), [None, None, Some(Notice::Dirty)]);
    }

    #[test]
    fn defect_is_reported_once_confirmed() {
        let healthy = SimulatedStatus {
            software: *b"V02.30 ",
            operating_mode: ON_REQUEST,
            mode: Mode(1),
            variant: Variant::HALF,
            unit: Unit::Mm,
            baud: Baud::B500000,
        };
        let healthy = healthy.report();
        let mut defective = healthy;
        defective[8] = 1;
        let mut sensor = Sensor::default();
        let mut reports = |report: &[u8]| {
            let telegram = Writer::new(REPLY, STATUS | REPLY).slice(report).byte(0x10).finish();
            let reply = Reply::decode(telegram.telegram());
            assert!(matches!(reply, Some(Reply::Status(_))));
            sensor.update(reply.as_ref(), telegram.telegram());
            (sensor.notices().next(), sensor.needs_confirmation())
        };
        assert_eq!(reports(&healthy), (None, false));
        assert_eq!(reports(&defective), (None, true));
        assert_eq!(reports(&healthy), (None, false));
        assert_eq!(reports(&defective), (None, true));
        assert_eq!(reports(&defective), (Some(Notice::Defective), false));
        assert_eq!(reports(&healthy), (None, false));
        reports(&defective);
        sensor.accept_unconfirmed();
        assert_eq!(sensor.notices().next(), Some(Notice::Defective), "there will not be another one");
    }

    #[test]
    fn identity_round_trips() {
        let kind = *b"LMS200;301063;V02.30\0\0\0\0";
        let identity = Identity { header: [2, 0x80, 0xd6, 2, 0xb0, 0x69, 0x41], mode: Mode(4), kind };
        assert_eq!(Identity::from_bytes(identity.to_bytes()), identity);
        assert_eq!(identity.to_bytes()[6..9], [0x41, 4, b'L']);
    }
}
