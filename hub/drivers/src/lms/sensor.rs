//! What a session knows of its sensor, in plain values: learned from its replies, and forgotten where it may be another
//! sensor that speaks next.

use crate::lms::command::Request;
use crate::lms::condition::{Condition, Severity};
use crate::lms::family::Family;
use crate::lms::header::StreamHeader;
use crate::lms::identity::Identity;
use crate::lms::notice::Notice;
use crate::lms::reply::{POWER_ON, Reply};
use crate::lms::status_report::{DIRTY, StatusReport};
use crate::lms::telegram::Telegram;
use crate::lms::variant::{Baud, Mode, Unit, Variant};
use core::fmt;

/// Why a session is not where it should be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trouble {
    /// No rate got an answer.
    NoAnswer {
        /// The only rate at which was asked; `None`: at all of them.
        baud: Option<Baud>,
        /// For how long already, in steps that grow.
        seconds: u32,
    },
    /// A request was not answered in all its tries.
    Unanswered(Request),
    /// The sensor said no.
    Refused(Request),
    /// The sensor keeps another angle or resolution than asked for, and streams that.
    VariantRefused,
    /// One second without measured data.
    Silence,
    /// The line cannot carry 500,000 baud: it was silent after two switches to that rate.
    NeedsRs422 {
        /// Rate that the session uses instead; `None` if it has to keep to 500,000 baud.
        instead: Option<Baud>,
    },
    /// A pause is wanted, but bytes come, and no answer says that they will end.
    NotStopped,
    /// The sensor calls itself a version S14, which scans 90 degrees with as many values as others 180.
    AnglesUnknown,
    /// The sensor is set to a measuring mode whose values are not ranges, or whose layout is not documented.
    NoRanges(Mode),
    /// The sensor does not report its measuring mode, so it is not known how many of the 16 bits are the range.
    ModeUnknown,
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Trouble::NoAnswer { baud: None, seconds } => write!(
                f,
                "no answer at 9600, 19200, 38400 or 500000 baud for {seconds} s: power, cable, RS-422 jumper?"
            ),
            Trouble::NoAnswer { baud: Some(baud), .. } => write!(
                f,
                "no answer at {} baud, the rate set in the serial server: power, cable, rate?",
                baud.rate()
            ),
            Trouble::Unanswered(request) => write!(f, "no reply to {request:?} in several tries"),
            Trouble::Refused(request) => write!(f, "the sensor refused {request:?}"),
            Trouble::VariantRefused => f.write_str("the sensor keeps its own angle and resolution"),
            Trouble::ModeUnknown => f.write_str("the sensor does not report its measuring mode: no scans"),
            Trouble::AnglesUnknown => {
                f.write_str("the sensor is a version S14, whose angles are not known here: no scans")
            }
            Trouble::NoRanges(Mode(mode)) => {
                write!(f, "the sensor measures in mode {mode:02x}h, which has no ranges: no scans")
            }
            Trouble::NotStopped => f.write_str("paused, but the sensor does not stop: cable to the sensor?"),
            Trouble::Silence => f.write_str("no measured data for one second"),
            Trouble::NeedsRs422 { instead: Some(baud) } => write!(
                f,
                "500000 baud needs RS-422: the scanner was lost in two switches to it, so the hub uses {} baud. If no \
                 scans arrive, cycle the scanner's power",
                baud.rate()
            ),
            Trouble::NeedsRs422 { instead: None } => f.write_str(
                "500000 baud needs RS-422: the scanner was lost in two switches to it. On RS-232, set baud = 38400 and \
                 cycle the scanner's power",
            ),
        }
    }
}

/// What the sensor said of itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sensor {
    /// The address byte of its telegrams: its own address + 80h.
    pub address: Option<u8>,
    /// How its values are split.
    pub mode: Option<Mode>,
    /// Unit of its ranges.
    pub unit: Option<Unit>,
    /// Angle and resolution.
    pub variant: Option<Variant>,
    /// Whether it does something unasked: sends scans, or is in a mode in which it does not measure.
    pub streams: bool,
    /// The status byte of its telegrams. A worse one counts at once, a better one after some hundred telegrams: it may
    /// change with each scan.
    pub condition: Option<Condition>,
    /// Whether it calls itself defective.
    pub defective: Option<bool>,
    /// Whether its EEPROM holds a rate for power-on that is not the factory's 9600.
    pub permanent_baud: Option<bool>,
    /// Laser power in percent of what it should be; real ones tell 156 to 161.
    pub laser_power_percent: Option<u16>,
    /// What the dirtiest channel of the window lets through, in percent of when it was clean (a warning comes below 75, an
    /// error below 30).
    pub window_percent: Option<u16>,
    software: [u8; SOFTWARE_LEN],
    kind: [u8; KIND_LEN],
    kind_len: usize,
    /// Telegrams in a row whose condition was better.
    calm: u16,
    /// The line damages what it carries, so that one telegram alone proves nothing bad.
    is_doubted: bool,
    /// How often a worse condition was told on such a line, and telegrams since the first time.
    sightings: u8,
    sighted_since: u16,
    /// How often a fatal one was.
    fatal_sightings: u8,
    /// The last status report complained, and whether the one before it did so likewise.
    complaint: Option<Complaint>,
    is_confirmed: bool,
}

/// What a status report says of the sensor's health: that it is defective, that its window is dirty.
type Complaint = (bool, bool);

impl Sensor {
    /// Type, number and firmware as ASCII, such as `LMS200;S18063;V02.19`; empty if it was not asked yet.
    pub fn kind(&self) -> &[u8] {
        &self.kind[..self.kind_len]
    }

    /// Whether its scans have none of the angles of [`Variant`], although they look so.
    pub fn has_other_angles(&self) -> bool {
        Family::of_type(self.kind()) == Some(Family::Fast)
    }

    /// How its values are split, if they are ranges at angles that are known: else there are no scans.
    pub(crate) fn mode_of_scans(&self) -> Option<Mode> {
        self.mode.filter(|mode| mode.has_ranges() && !self.has_other_angles())
    }

    /// Firmware as ASCII, such as `V02.19`; empty if it was not asked yet.
    pub fn software(&self) -> &[u8] {
        self.software.trim_ascii()
    }

    /// Returns the notices for the owner, the worst first. Faults come before all others.
    pub fn notices(&self) -> impl Iterator<Item = Notice> {
        let severity = self.condition.and_then(Condition::severity);
        let dirty = self.condition.is_some_and(Condition::is_polluted);
        let (defective, dim) = self.complaint.filter(|_| self.is_confirmed).unwrap_or_default();
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

    /// The next sensor at this port may be another one, or the same with another configuration: its identity and the
    /// layout of its values are unknown again. What each scan repeats may stay.
    pub(crate) fn forget(&mut self) {
        self.mode = None;
        self.kind_len = 0;
        self.defective = None;
        self.complaint = None;
        self.is_confirmed = false;
    }

    /// Whether the line that it speaks on damages telegrams now: some of them pass their weak checksum all the same.
    pub(crate) fn doubt(&mut self, is_doubted: bool) {
        self.is_doubted = is_doubted;
        if !is_doubted {
            (self.sightings, self.fatal_sightings) = (0, 0);
        }
    }

    /// Whether its health has to be asked again: one report that complains may be a damaged one.
    pub(crate) fn is_complaint_open(&self) -> bool {
        self.complaint.is_some() && !self.is_confirmed
    }

    /// No second report is to be had: the one that there is counts.
    pub(crate) fn believe(&mut self) {
        self.is_confirmed = true;
    }

    /// What a session that goes on with its stream, whose scans begin with `header`, would have to ask; nothing if that is not
    /// known.
    pub(crate) fn identity(&self, header: StreamHeader) -> Option<Identity> {
        let mode = self.mode.filter(|_| self.kind_len > 0)?;
        Some(Identity { header, mode, kind: self.kind })
    }

    /// It streams as it did when this was known of it.
    pub(crate) fn recall(&mut self, known: Identity) {
        self.mode = Some(known.mode);
        self.kind = known.kind;
        self.kind_len = known.kind.iter().position(|&byte| byte == 0).unwrap_or(KIND_LEN);
    }

    /// Takes over what `telegram` tells, which is `reply`, if it can be read.
    pub(crate) fn learn(&mut self, reply: Option<&Reply<'_>>, telegram: Telegram<'_>) {
        self.address = Some(telegram.address());
        self.feel(telegram.status().map(Condition));
        if telegram.command() == POWER_ON {
            self.forget();
            self.streams = false;
            self.variant = None;
        }
        let Some(reply) = reply else { return };
        match reply {
            Reply::Status(report) => self.read(report),
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
            Reply::Type(name) => {
                self.kind = [0; KIND_LEN];
                self.kind_len = name.len().min(KIND_LEN);
                self.kind[..self.kind_len].copy_from_slice(&name[..self.kind_len]);
            }
            _ => {}
        }
    }

    fn read(&mut self, report: &StatusReport<'_>) {
        self.mode = Some(report.mode());
        self.unit = report.unit().or(self.unit);
        self.variant = report.variant().or(self.variant);
        self.streams = report.operating_mode() != ON_REQUEST;
        self.defective = Some(report.is_defective());
        self.permanent_baud = Some(report.has_permanent_baud());
        self.laser_power_percent = Some(report.laser_power_percent());
        self.window_percent = report.window_percent();
        let is_dim = self.window_percent.is_some_and(|percent| percent < DIRTY);
        let complaint = Some((report.is_defective(), is_dim)).filter(|&it| it != (false, false));
        self.is_confirmed = complaint.is_some() && complaint == self.complaint;
        self.complaint = complaint;
        self.software = *report.bytes().first_chunk().unwrap_or(&[0; SOFTWARE_LEN]);
    }

    /// A worse condition was told once more on a line that damages telegrams; whether that is often enough. A sensor that
    /// calls itself fatal may do so now and then only: two of its scans tell, however far apart.
    fn is_sighted(&mut self, is_fatal: bool) -> bool {
        if is_fatal {
            self.fatal_sightings += 1;
            return self.fatal_sightings == FATAL_SIGHTINGS;
        }
        if self.sightings == 0 || self.sighted_since > CALM {
            (self.sightings, self.sighted_since) = (0, 0);
        }
        self.sightings += 1;
        self.sightings == SIGHTINGS
    }

    fn feel(&mut self, condition: Option<Condition>) {
        self.sighted_since = self.sighted_since.saturating_add(1);
        let is_fatal = condition.and_then(Condition::severity) == Some(Severity::Fatal);
        if self.is_doubted && badness(condition) > badness(self.condition) && !self.is_sighted(is_fatal) {
            return;
        }
        self.fatal_sightings = if is_fatal { 0 } else { self.fatal_sightings };
        self.sightings = if badness(condition) > 0 { 0 } else { self.sightings };
        let is_better = badness(condition) < badness(self.condition);
        self.calm = if is_better { self.calm + 1 } else { 0 };
        if !is_better || self.calm > CALM {
            self.condition = condition;
            self.calm = 0;
        }
    }
}

/// An order of conditions by what is told of them.
fn badness(condition: Option<Condition>) -> u8 {
    let severity = condition.and_then(Condition::severity).unwrap_or(Severity::Ok);
    let polluted = condition.is_some_and(Condition::is_polluted);
    if severity >= Severity::Error { 2 * severity.code() + u8::from(polluted) } else { u8::from(polluted) }
}

/// Better telegrams in a row before a bad one is forgotten: some seconds of scans.
const CALM: u16 = 200;
/// Telegrams among so many that tell a worse condition before it is believed, on a line that damages some of them.
const SIGHTINGS: u8 = 3;
/// The same for a fatal one, among however many.
const FATAL_SIGHTINGS: u8 = 2;
/// Bytes of the firmware's name.
const SOFTWARE_LEN: usize = 7;
/// A type reply has 20 or 21 characters.
pub(crate) const KIND_LEN: usize = 24;
/// Operating mode: values on request.
const ON_REQUEST: u8 = 0x25;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::STATUS;
    use crate::lms::status_report::Health;
    use crate::lms::telegram::{REPLY, Writer};

    #[test]
    fn a_doubted_line_is_believed_what_a_sensor_repeats() {
        // Severity in the lowest bits: 0 ok, 4 fatal; the highest one is a dirty window.
        let (ok, fatal, dirty) = (Condition(0x10), Condition(0x14), Condition(0x90));
        let tell = |sensor: &mut Sensor, condition: Condition, calm: u32| {
            sensor.feel(Some(condition));
            let notice = sensor.notices().next();
            (0..calm).for_each(|_| sensor.feel(Some(ok)));
            notice
        };
        let mut sensor = Sensor::default();
        tell(&mut sensor, ok, 1);
        sensor.doubt(true);
        assert_eq!(tell(&mut sensor, fatal, 5_000), None, "one telegram proves nothing");
        assert_eq!(tell(&mut sensor, fatal, 5_000), Some(Notice::Fatal));
        for _ in 0..5 {
            assert_eq!(tell(&mut sensor, dirty, 150), None, "fewer than three of 200");
        }
        for _ in 0..2 {
            assert_eq!(tell(&mut sensor, fatal, 10), None);
            sensor.doubt(false);
            sensor.feel(Some(ok));
            sensor.doubt(true);
        }
        assert_eq!([(); 3].map(|()| tell(&mut sensor, dirty, 10)), [None, None, Some(Notice::Dirty)]);
    }

    #[test]
    fn a_report_that_complains_counts_once_another_one_does() {
        let healthy = Health {
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
        let mut told = |report: &[u8]| {
            let telegram = Writer::new(REPLY, STATUS | REPLY).slice(report).byte(0x10).finish();
            let reply = Reply::decode(telegram.telegram());
            assert!(matches!(reply, Some(Reply::Status(_))));
            sensor.learn(reply.as_ref(), telegram.telegram());
            (sensor.notices().next(), sensor.is_complaint_open())
        };
        assert_eq!(told(&healthy), (None, false));
        assert_eq!(told(&defective), (None, true));
        assert_eq!(told(&healthy), (None, false));
        assert_eq!(told(&defective), (None, true));
        assert_eq!(told(&defective), (Some(Notice::Defective), false));
        assert_eq!(told(&healthy), (None, false));
        told(&defective);
        sensor.believe();
        assert_eq!(sensor.notices().next(), Some(Notice::Defective), "no other one is to be had");
    }
}
