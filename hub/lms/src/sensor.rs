//! What a session knows of its sensor, in plain values: learned from its replies, forgotten never but overwritten.

use crate::command::Request;
use crate::header::POWER_ON;
use crate::reply::Reply;
use crate::telegram::Telegram;
use crate::variant::{Mode, Unit, Variant};
use core::fmt;

/// How far a session is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Listening for a stream, or looking for the rate.
    Probing,
    /// Changing the rate.
    Switching,
    /// Changing settings and starting the stream.
    Starting,
    /// Measured data come.
    Streaming,
    /// They stopped coming.
    Silent,
    /// Nothing is wanted of the sensor.
    Paused,
}

/// Why a session is not where it should be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trouble {
    /// No rate got an answer.
    NoAnswer {
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
    /// The sensor does not tell its measuring mode, so nobody knows where a range ends in its 16 bits.
    ModeUnknown,
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Trouble::NoAnswer { seconds } => write!(
                f,
                "no answer at 9600, 19200, 38400 or 500000 baud for {seconds} s: power, cable, RS-422 jumper?"
            ),
            Trouble::Unanswered(request) => write!(f, "no reply to {request:?} in several tries"),
            Trouble::Refused(request) => write!(f, "the sensor refused {request:?}"),
            Trouble::VariantRefused => f.write_str("the sensor keeps its own angle and resolution"),
            Trouble::ModeUnknown => f.write_str("the sensor does not tell its measuring mode: no scans"),
            Trouble::Silence => f.write_str("no measured data for one second"),
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
    /// Whether it sends scans unasked.
    pub streams: bool,
    kind: [u8; KIND_LEN],
    kind_len: usize,
}

impl Sensor {
    /// Type, number and firmware as ASCII, such as `LMS200;S18063;V02.19`; empty if it was not asked yet.
    pub fn kind(&self) -> &[u8] {
        &self.kind[..self.kind_len]
    }

    /// Takes over what `telegram` tells, which is `reply`, if it can be read.
    pub(crate) fn learn(&mut self, reply: Option<&Reply<'_>>, telegram: Telegram<'_>) {
        self.address = Some(telegram.address());
        if telegram.command() == POWER_ON {
            self.streams = false;
            self.variant = None;
        }
        let Some(reply) = reply else { return };
        match reply {
            Reply::Status(report) => {
                self.mode = Some(report.mode());
                self.unit = report.unit().or(self.unit);
                self.variant = report.variant().or(self.variant);
                self.streams = report.operating_mode() != ON_REQUEST;
            }
            Reply::Configuration(configuration) => {
                self.mode = Some(configuration.mode());
                self.unit = configuration.unit().or(self.unit);
            }
            Reply::Variant { angle_deg, resolution_cdeg, .. } => {
                self.variant = Variant::new(*angle_deg, *resolution_cdeg).or(self.variant);
            }
            Reply::Measured(measured) => {
                self.unit = Some(measured.unit());
                self.variant = Variant::of_beams(measured.count()).or(self.variant);
            }
            Reply::Type(name) => {
                self.kind_len = name.len().min(KIND_LEN);
                self.kind[..self.kind_len].copy_from_slice(&name[..self.kind_len]);
            }
            _ => {}
        }
    }
}

/// A type reply has 20 or 21 characters.
const KIND_LEN: usize = 24;
/// Operating mode: values on request.
const ON_REQUEST: u8 = 0x25;
