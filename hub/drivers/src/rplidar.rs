//! Family `rplidar`: the Slamtec scanners RPLIDAR A1, A2, A3, S1, S2, S3 and C1. No request changes a setting that the
//! scanner keeps without power.
//!
//! This file has the models, the scan modes, the settings and the recognizer of the family.

mod framer;
mod handshake;
pub mod packet;
mod request;
mod sequence;
mod session;
mod stream;

use scanhub_schema::{ArrayFlags, Family, MILLIS};

use crate::line::family::{self, Evidence, Features, RequestSteps, SearchSteps, StopRequest, named, table};
use crate::line::framing::fill;
use crate::rplidar::framer::{ExpectedBytes, Framer, FramerEvent};
use crate::rplidar::packet::PacketFormat;
use crate::rplidar::request::{ResponseDescriptor, ResponseType};
use crate::settings::{Key, Settings};

pub use crate::line::{ByteCounters, RevolutionCounts};
pub use request::{Health, Info};
pub use session::{Problem, RplidarSession};

/// Models and settings of the family.
pub const FEATURES: Features = Features {
    models: &MODELS,
    // This number of beams is sufficient for every model except the S2 and the S3.
    defaults: family::Model { name: "auto", baud: Model::A1.baud(), beams: 2_048 },
    modes: &MODES,
    keys: &[Key::ModeName, Key::Idle],
    can_stop_motor: true,
    streams_unrequested: false,
    has_whole_telegrams: false,
    has_identity_probe: false,
    array_flags: ArrayFlags::REVOLUTION,
    max_telegram: stream::MAX_SAMPLE_LEN,
};

/// Returns the description of a model for configurations.
const fn describe(model: Model) -> family::Model {
    family::Model { name: model.name(), baud: model.baud(), beams: model.beams() }
}

/// Descriptions of all models for configurations.
const MODELS: [family::Model; Model::ALL.len()] = table!(Model::ALL, describe);

/// Names of all scan modes.
const MODES: [&str; Mode::ALL.len()] = table!(Mode::ALL, Mode::name);

named! {
    /// Model of an RPLIDAR.
    Model {
        /// A1M8.
        A1 "a1",
        /// A2M8, and older models of the A2 series.
        A2m8 "a2m8",
        /// A2M12.
        A2m12 "a2m12",
        /// A3M1.
        A3 "a3",
        /// S1.
        S1 "s1",
        /// S2.
        S2 "s2",
        /// S3.
        S3 "s3",
        /// C1.
        C1 "c1",
    }
}

/// Control of the motor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Motor {
    /// Only the line DTR controls the motor. The motor runs while DTR is not asserted.
    Dtr,
    /// A request with a duty cycle controls the motor, if the scanner has an accessory board. Otherwise, the line DTR
    /// controls the motor.
    Board,
    /// A request with a speed controls the motor.
    Speed,
}

impl Model {
    /// Returns the model whose name is `name`.
    pub fn from_name(name: &str) -> Option<Model> {
        Model::ALL.into_iter().find(|model| model.name() == name)
    }

    /// Returns the model of `settings`.
    pub(crate) fn of(settings: &Settings) -> Option<Model> {
        settings.model.and_then(Model::from_name)
    }

    /// Returns the model that reports the number `id`. The upper four bits are the series.
    pub(crate) fn of_id(id: u8) -> Option<Model> {
        match (id >> 4, id & 15) {
            (1, _) => Some(Model::A1),
            (2, 12) => Some(Model::A2m12),
            (2, _) => Some(Model::A2m8),
            (3, _) => Some(Model::A3),
            (4, _) => Some(Model::C1),
            (6, _) => Some(Model::S1),
            (7, _) => Some(Model::S2),
            (8, _) => Some(Model::S3),
            _ => None,
        }
    }

    /// Returns the number that the usual hardware of this model reports. This method is the inverse of
    /// [`Model::of_id`].
    pub(crate) fn id(self) -> u8 {
        match self {
            Model::A1 => 0x18,
            Model::A2m8 => 0x28,
            Model::A2m12 => 0x2C,
            Model::A3 => 0x31,
            Model::C1 => 0x41,
            Model::S1 => 0x61,
            Model::S2 => 0x71,
            Model::S3 => 0x81,
        }
    }

    /// Returns the baud rate of the scanner's line, in bits per second.
    pub const fn baud(self) -> u32 {
        match self {
            Model::A1 | Model::A2m8 => 115_200,
            Model::A2m12 | Model::A3 | Model::S1 => 256_000,
            Model::C1 => 460_800,
            Model::S2 | Model::S3 => 1_000_000,
        }
    }

    /// Returns the number of points per second in the fastest scan mode.
    pub const fn points_per_second(self) -> u32 {
        match self {
            Model::A1 => 7_874,
            Model::A2m8 => 8_000,
            Model::A2m12 | Model::A3 => 16_000,
            Model::S1 => 9_200,
            Model::S2 | Model::S3 => 32_000,
            Model::C1 => 5_000,
        }
    }

    /// Returns the usual number of revolutions per second.
    pub const fn revolutions_per_second(self) -> f32 {
        match self {
            Model::A1 => 7.3,
            _ => 10.0,
        }
    }

    /// Returns the default number of beams, which is the number of points per revolution in the fastest scan mode.
    pub const fn beams(self) -> usize {
        self.beams_of(self.points_per_second() as f32)
    }

    /// Returns the number of points per revolution at `points_per_second`.
    const fn beams_of(self, points_per_second: f32) -> usize {
        (points_per_second / self.revolutions_per_second() + 0.5) as usize
    }

    /// Returns the number of beams for a scan mode with `points_per_second`. If this number is close to the number of
    /// beams of the fastest mode, returns the number of the fastest mode.
    pub(crate) fn beams_in_mode(self, points_per_second: f32) -> usize {
        let (beams, fastest) = (self.beams_of(points_per_second), self.beams());
        let is_close = (beams as f64 / fastest as f64 - 1.0).abs() <= MAX_BEAM_DEVIATION;
        if is_close { fastest } else { beams }
    }
}

/// Maximum deviation from the number of beams of the fastest mode, as a ratio.
const MAX_BEAM_DEVIATION: f64 = 0.03;

named! {
    /// Scan mode that a model may offer.
    Mode {
        /// One packet for each point, with the quality of the point. This mode is the slowest.
        Standard "standard",
        /// More points per second than the standard mode, in packets with a checksum.
        Express "express",
        /// More points per second than the standard mode, for short ranges.
        Boost "boost",
        /// More points per second than the standard mode, for dark targets.
        Sensitivity "sensitivity",
        /// Fewer points per second than modes boost and sensitivity, for sunlight.
        Stability "stability",
        /// The fastest mode of the S series and of the C1.
        DenseBoost "denseboost",
        /// The fastest mode with a quality for each point.
        UltraDense "ultradense",
    }
}

impl Mode {
    /// Returns the mode whose name is `name`.
    pub fn from_name(name: &str) -> Option<Mode> {
        Mode::from_device_name(name.as_bytes())
    }

    /// Returns the mode of `settings`.
    pub(crate) fn of(settings: &Settings) -> Option<Mode> {
        settings.mode.and_then(Mode::from_name)
    }

    /// Returns the mode for a name that a scanner reports. Ignores case, spaces and a terminating zero.
    pub(crate) fn from_device_name(name: &[u8]) -> Option<Mode> {
        Mode::ALL.into_iter().find(|mode| {
            let letters = name.iter().filter(|byte| byte.is_ascii_alphanumeric());
            letters.map(u8::to_ascii_lowercase).eq(mode.name().bytes())
        })
    }
}

/// Recognizer of RPLIDAR replies.
#[derive(Clone, Debug)]
pub struct Probe {
    framer: Framer,
    is_reply_expected: bool,
    /// Whether packets have arrived.
    is_stream: bool,
    /// Identity that the scanner has reported.
    info: Option<Info>,
}

impl Default for Probe {
    fn default() -> Self {
        Probe {
            framer: Framer::new(ExpectedBytes::AnyPackets(None)),
            is_reply_expected: false,
            is_stream: false,
            info: None,
        }
    }
}

impl crate::line::family::Probe for Probe {
    fn search_steps(&self) -> &'static SearchSteps {
        &SEARCH_STEPS
    }

    fn clear(&mut self) {
        *self = Probe::default();
    }

    // Discard everything, because the framer would take the next descriptor for the rest of an earlier, incomplete
    // reply.
    fn expect_reply(&mut self, is_expected: bool) {
        let expect = if is_expected { ExpectedBytes::Responses } else { ExpectedBytes::AnyPackets(None) };
        *self = Probe { framer: Framer::new(expect), is_reply_expected: is_expected, ..Probe::default() };
    }

    fn receive(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let len = fill(self.framer.buffer.read_buffer(), &mut bytes);
            self.framer.buffer.commit(len);
            while let Some(found) = self.framer.advance(1) {
                match found {
                    FramerEvent::Reply(ResponseType::Info, span) => {
                        self.info = Info::parse(&self.framer.bytes(span)[ResponseDescriptor::LEN..]);
                    }
                    FramerEvent::Packets(..) | FramerEvent::Stream(_) => self.is_stream = true,
                    FramerEvent::Reply(..) | FramerEvent::BootMessage { .. } => {}
                }
            }
            self.is_stream |= self.framer.is_ambiguous();
        }
    }

    fn evidence(&self) -> Evidence {
        match self.info {
            Some(info) => Evidence::Found(info.model().map(|model| model.name())),
            None if self.is_stream => Evidence::Stream,
            None if self.is_reply_expected && !self.framer.buffer.open_bytes().is_empty() => {
                Evidence::Partial
            }
            None => Evidence::None,
        }
    }
}

const SEARCH_STEPS: SearchSteps = SearchSteps {
    family: Family::Rplidar,
    listen_steps: &[],
    request_steps: Some(RequestSteps {
        rates: &[115_200, 256_000, 460_800, 1_000_000],
        settle_time: 0,
        stop: Some(StopRequest { request: &[0xA5, 0x25], quiet_time: 15 * MILLIS, max_wait: 60 * MILLIS }),
        requests: &[&[0xA5, 0x50]],
        gap: None,
        // A reply takes some milliseconds, and an adapter that collects bytes adds 16 ms in each direction.
        reply_timeout: 70 * MILLIS,
        extra_reply_time: 0,
        extra_partial_time: 20 * MILLIS,
        repeats: 2,
    }),
    boot_rate: None,
    max_transmission: PacketFormat::MAX_LEN,
    advice: "it needs 5 V for the scanner and its motor",
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rplidar::request::Request;

    #[test]
    fn model_id_round_trips() {
        assert!(Model::ALL.into_iter().all(|model| Model::of_id(model.id()) == Some(model)));
        assert_eq!([0x00, 0x58, 0x77, 0x91].map(Model::of_id), [None, None, Some(Model::S2), None]);
    }

    #[test]
    fn mode_close_to_the_fastest_one_has_its_beam_count() {
        // The scanner reports 127 us per point, and its data sheet states 8,000 points per second.
        assert_eq!(Model::A2m8.beams_in_mode(1e6 / 127.0), 800);
        assert_eq!(Model::A2m12.beams_in_mode(1e6 / 63.0), 1_600);
        assert_eq!(Model::A2m8.beams_in_mode(1e6 / 201.0), 498);
        assert_eq!(Model::A1.beams_in_mode(1e6 / 254.0), 539);
    }

    #[test]
    fn search_requests_stop_and_identity() {
        let steps = SEARCH_STEPS.request_steps.unwrap();
        assert_eq!(steps.stop.unwrap().request, Request::STOP.bytes());
        assert_eq!(steps.requests, [Request::INFO.bytes()]);
    }
}
