//! Status of a link: its state, the properties of the scanner, its pose on the robot, and counters, most of which only
//! increase.

use std::ops::{Index, IndexMut};

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::family::{REFLECTOR_MODE, has_reflector_bits};
use crate::payload::FixedPayload;
use crate::text::named;
use crate::{Family, text};

/// Maximum number of counters in a [`Status`]. New counters are appended to those that have names.
pub const MAX_COUNTERS: usize = 28;

/// The payload of topic `status`, 592 bytes: published every second and on every change.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Status.v2"))]
#[repr(C)]
pub struct Status {
    /// State of the link: [`State`].
    pub state: u8,
    /// Measuring mode of an LMS; 255 if unknown.
    pub mode: u8,
    /// Millimeters per device unit: 1, 10 or 100; 0 if unknown.
    pub unit_mm: u8,
    /// Family of the scanner: [`Family`]; 255 while the hub searches for it.
    pub family: u8,
    /// Baud rate of the line; 0 if unknown.
    pub baud: u32,
    /// Stamp of the start of the state, in ns.
    pub since_ns: u64,
    /// Scans per second, in units of 1/1000; 0 while the rate is not measured. See [`Status::rate_hz`].
    pub rate_mhz: u32,
    /// Field of view in degrees: 100 or 180; 0 if unknown.
    pub angle_deg: u16,
    /// Angle between two beams in 1/100 degree; 0 if unknown.
    pub resolution_cdeg: u16,
    /// Type that the scanner reports; empty if unknown. See [`Status::sensor_type`].
    pub type_text: [u8; 24],
    /// Port that the link is configured for. See [`Status::port`].
    pub port_text: [u8; 128],
    /// Last error; empty if there was none. See [`Status::last_error`].
    pub last_error_text: [u8; Status::MAX_ERROR_LEN],
    /// Counters: [`Counter`].
    pub counters: Counters,
    /// Pose of the sensor, as configured. The first of its reserved bytes belongs to the status, see
    /// [`Status::has_mark_level`].
    pub pose: Pose,
}

impl Default for Status {
    fn default() -> Self {
        Status { mode: Status::MODE_UNKNOWN, ..Zeroable::zeroed() }
    }
}

impl FixedPayload for Status {}

impl Status {
    /// Value of `mode` while the sensor has not reported its measuring mode.
    pub const MODE_UNKNOWN: u8 = 0xFF;

    /// Returns the state, or `None` if this version does not know the state, for example because the hub is newer.
    pub fn state(&self) -> Option<State> {
        State::ALL.get(usize::from(self.state)).copied()
    }

    /// Returns whether the measuring mode has reflector bits, without which topic `marks` is unavailable. `None` while
    /// the mode is unknown.
    pub fn has_reflector_bits(&self) -> Option<bool> {
        (self.mode != Status::MODE_UNKNOWN).then(|| has_reflector_bits(self.mode))
    }

    /// Returns the measuring mode in which the scanner would send reflector bits. Returns `None` if the scanner already
    /// sends them, if its mode is unknown, or if the sensor is a recording. The mode is in the scanner's EEPROM, which
    /// only a person changes.
    pub fn missing_reflector_mode(&self) -> Option<u8> {
        let is_missing = self.has_reflector_bits() == Some(false) && !self.is_replayed();
        is_missing.then_some(REFLECTOR_MODE)
    }

    /// Returns whether a threshold for reflectors (`marks.level`) is configured. Only scanners without
    /// [reflector levels](Family::has_reflector_levels) need one.
    pub fn has_mark_level(&self) -> bool {
        self.pose.reserved[0] & MARK_LEVEL != 0
    }

    /// Sets the sensor's pose, and whether a threshold for reflectors is configured.
    pub fn set_processing(&mut self, pose: Pose, has_mark_level: bool) {
        self.pose = pose;
        self.pose.reserved[0] = if has_mark_level { MARK_LEVEL } else { 0 };
    }

    /// Returns whether topic `marks` is available. An LMS must send reflector bits. For every other scanner, a
    /// threshold for reflectors must be configured. `None` while the family or the measuring mode is unknown.
    pub fn has_marks(&self) -> Option<bool> {
        if self.family()?.has_reflector_levels() {
            self.has_reflector_bits()
        } else {
            Some(self.has_mark_level())
        }
    }

    /// Returns the scans per second. Returns `None` while the rate of a stream that just started has not been measured.
    pub fn rate_hz(&self) -> Option<f64> {
        let is_measured = self.rate_mhz != 0 || self.state() != Some(State::Streaming);
        is_measured.then(|| f64::from(self.rate_mhz) / 1000.0)
    }

    /// Returns the fraction of the line's bytes that were damaged in the last 10 s, 0 to 1. Damaged bytes are the bytes
    /// outside telegrams that arrived during a stream. Bytes of scans that the scanner broke off to send a reply are
    /// not included.
    pub fn damaged_share(&self) -> f64 {
        self.counters[Counter::DamagedPpm] as f64 / 1e6
    }

    /// Returns the number of scans of an LMS, or of packets of another scanner, that must have been sent but did not
    /// arrive. Returns `None` if this number is unknown.
    pub fn lost_on_line(&self) -> Option<u64> {
        (self.counters[Counter::DueOnLine] > 0).then_some(self.counters[Counter::LostOnLine])
    }

    /// Returns the fraction of the scans or packets due in the last 10 s that were lost, 0 to 1. Returns `None` if this
    /// fraction is unknown.
    pub fn lost_share(&self) -> Option<f64> {
        self.lost_on_line().map(|_| self.counters[Counter::LostPpm] as f64 / 1e6)
    }

    /// Returns the share of lost scans or packets as text, such as `41 % lost on the line`, if this share exceeded a
    /// thousandth in the last 10 s. Otherwise, returns the share of damaged bytes in the same way, or `None` if this
    /// share did not exceed a thousandth either.
    pub fn line_loss(&self) -> Option<String> {
        let lost = self.lost_share().filter(|&share| share > LOSS_REPORT_THRESHOLD);
        let damaged = Some(self.damaged_share()).filter(|&share| share > LOSS_REPORT_THRESHOLD);
        let (share, word) = lost.map(|share| (share, "lost")).or(damaged.map(|share| (share, "damaged")))?;
        let (percent, digits) = (100.0 * share, usize::from(share < 0.0995));
        Some(format!("{percent:.digits$} % {word} on the line"))
    }

    /// Returns the number of discarded bytes and of all bytes since the hub's start. Returns them only if most bytes
    /// were in no telegram, telegrams have arrived before, and the hub searches for the scanner again; otherwise
    /// `None`. Before the first telegram, these numbers mean nothing, because the bytes may come from another scanner.
    pub fn discarded_and_read(&self) -> Option<(u64, u64)> {
        let (discarded, read) = (self.counters[Counter::BytesDiscarded], self.counters[Counter::BytesRead]);
        let has_replied = self.counters[Counter::Telegrams] > 0;
        let is_finding = self.state() == Some(State::Probing) && has_replied && discarded > read / 2;
        is_finding.then_some((discarded, read))
    }

    /// Returns whether `model` is the number of a model that scanhub does not know, such as `0x95`, instead of a name.
    pub fn is_model_number(model: &str) -> bool {
        model.starts_with("0x")
    }

    /// Returns `model` as shown to a user. A model that scanhub does not know is a number, and is shown as unknown.
    pub fn display_model(model: &str) -> String {
        if Status::is_model_number(model) { format!("{model} (unknown)") } else { model.to_owned() }
    }

    /// Returns whether the sensor is a recording, which cannot receive requests.
    pub fn is_replayed(&self) -> bool {
        self.port().starts_with("file:")
    }

    /// Returns the family of the scanner; `None` while the hub searches for it, or if this program does not know the
    /// family.
    pub fn family(&self) -> Option<Family> {
        Family::of_number(self.family)
    }

    /// Returns the scanner's model in lower case, or `None` if the model is unknown.
    pub fn model(&self) -> Option<String> {
        self.reported_model().map(str::to_lowercase)
    }

    /// Returns the scanner's model as the scanner reports it: the first word of its type. Returns `None` if the model
    /// is unknown.
    pub fn reported_model(&self) -> Option<&str> {
        let word = self.sensor_type().split(|c: char| c == ';' || c.is_whitespace()).next();
        word.filter(|word| !word.is_empty())
    }

    /// Returns the scan mode of a scanner whose modes have names: the second word of its type. Returns `None` if the
    /// scan mode is unknown.
    pub fn mode_name(&self) -> Option<&str> {
        let is_named = self.family().is_some_and(|family| family != Family::Lms);
        let word = self.sensor_type().split_whitespace().nth(1).filter(|_| is_named)?;
        word.starts_with(|c: char| c.is_ascii_lowercase()).then_some(word)
    }

    /// Returns the unit of [`lost_on_line`](Self::lost_on_line): `scans` or `packets`.
    pub fn transmission_name(&self) -> &'static str {
        if self.family() == Some(Family::Lms) { "scans" } else { "packets" }
    }

    /// Returns the type that the scanner reports; empty if unknown.
    pub fn sensor_type(&self) -> &str {
        text::read(&self.type_text)
    }

    /// Sets the sensor's type. It is truncated to 24 bytes.
    pub fn set_sensor_type(&mut self, value: &str) {
        text::write(&mut self.type_text, value);
    }

    /// Returns the port that the link is configured for.
    pub fn port(&self) -> &str {
        text::read(&self.port_text)
    }

    /// Sets the port. It is truncated to 128 bytes.
    pub fn set_port(&mut self, value: &str) {
        text::write(&mut self.port_text, value);
    }

    /// Returns the message of the last error; empty if there was none.
    pub fn last_error(&self) -> &str {
        text::read(&self.last_error_text)
    }

    /// Maximum length of the last error, in bytes.
    pub const MAX_ERROR_LEN: usize = 160;

    /// Sets the last error. It is truncated to [`Self::MAX_ERROR_LEN`] bytes.
    pub fn set_last_error(&mut self, value: &str) {
        text::write(&mut self.last_error_text, value);
    }
}

/// Fraction of lost scans or packets, or of damaged bytes, above which [`Status::line_loss`] reports it.
const LOSS_REPORT_THRESHOLD: f64 = 0.001;

/// Flag in the first reserved byte of the pose: a threshold for reflectors is configured.
const MARK_LEVEL: u8 = 1;

/// State of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum State {
    /// The port does not exist.
    Absent = 0,
    /// The hub searches for the scanner and its baud rate.
    Probing = 1,
    /// The hub changes the baud rate.
    Switching = 2,
    /// The hub requests the scanner's properties and starts its stream.
    Starting = 3,
    /// Telegrams arrive.
    Streaming = 4,
    /// No telegrams arrive any more.
    Silent = 5,
    /// The link is paused on request.
    Paused = 6,
}

named! {
    State:
    Absent "absent",
    Probing "probing",
    Switching "switching",
    Starting "starting",
    Streaming "streaming",
    Silent "silent",
    Paused "paused",
}

/// Counters of a link. They only increase, except the gauges `bytes_buffered`, `damaged_ppm` and `lost_ppm`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Counters.v2"))]
#[repr(C)]
pub struct Counters(pub [u64; MAX_COUNTERS]);

impl Counters {
    /// Returns name and value of every counter that has a name, in the order of [`Counter::ALL`].
    pub fn named_values(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        Counter::ALL.iter().map(|&counter| (counter.name(), self[counter]))
    }
}

impl Index<Counter> for Counters {
    type Output = u64;

    fn index(&self, counter: Counter) -> &u64 {
        &self.0[counter as usize]
    }
}

impl IndexMut<Counter> for Counters {
    fn index_mut(&mut self, counter: Counter) -> &mut u64 {
        &mut self.0[counter as usize]
    }
}

/// Declares the counters. Each line has the variant, its name and its meaning.
macro_rules! counters {
    ($($variant:ident $name:literal $meaning:literal,)*) => {
        /// A counter. Its number is its index in [`Counters`].
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[repr(usize)]
        pub enum Counter { $(#[doc = $meaning] $variant,)* }

        impl Counter {
            /// All counters, in the order of the output.
            pub const ALL: &'static [Counter] = &[$(Counter::$variant,)*];

            /// Returns the counter's key in all output.
            pub fn name(self) -> &'static str {
                match self { $(Counter::$variant => $name,)* }
            }
        }
    };
}

counters! {
    BytesRead "bytes_read" "Bytes read from the port.",
    BytesInTelegrams "bytes_in_telegrams" "Bytes that became part of a telegram.",
    BytesAcknowledge "bytes_acknowledge" "Bytes that were ACK or NAK.",
    BytesDiscarded "bytes_discarded" "Bytes outside any telegram.",
    BytesBuffered "bytes_buffered" "Bytes read and not yet assigned: a gauge.",
    Telegrams "telegrams" "Telegrams published.",
    Suspect "suspect" "Telegrams of quality suspect.",
    Aborted "aborted" "Scans that the sensor broke off to answer a request.",
    Resyncs "resyncs" "Restarts of the session: no data for a second, power came on, or a request.",
    Reconnects "reconnects" "Number of times that the port became unavailable.",
    LostInRestart "lost_in_restart" "1 if the first telegram after the start followed a part of one.",
    Wakeups "wakeups" "Number of times that the link's thread woke up.",
    LoanFailed "loan_failed" "Samples not published because no chunk was free.",
    RejectedAddress "rejected_address" "Candidates rejected: the address does not belong to a sensor.",
    RejectedLength "rejected_length" "Candidates rejected: the length is impossible.",
    RejectedCommand "rejected_command" "Candidates rejected: the command is not possible now.",
    RejectedCount "rejected_count" "Candidates rejected: the count of values does not fit.",
    RejectedCrc "rejected_crc" "Candidates rejected: the CRC is wrong.",
    RejectedVetoed "rejected_vetoed" "Candidates rejected: a valid telegram started inside them.",
    RejectedSuperseded "rejected_superseded" "Candidates rejected: another one was complete first.",
    LineErrors "line_errors" "Framing, parity and overrun errors and breaks that the line's driver counted.",
    BytesDamaged "bytes_damaged" "Discarded bytes that the line damaged while scans arrived.",
    DamagedPpm "damaged_ppm" "Share of `bytes_damaged` in the bytes of the last 10 s, in millionths: a gauge.",
    DueOnLine "due_on_line" "Scans that the sensor must have sent, by its period; 0 while the period is not known.",
    LostOnLine "lost_on_line" "Scans of `due_on_line` that did not arrive.",
    LostPpm "lost_ppm" "Share of `lost_on_line` in the scans due in the last 10 s, in millionths: a gauge.",
    ScannerRestarts "scanner_restarts" "Restarts of the scanner that the hub did not request, such as after a brown-out.",
}

/// A sensor's pose in the robot's frame: x ahead, y left, the origin at the robot's center. 32 bytes.
///
/// The default is a sensor at the center that looks ahead.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Pose.v2"))]
#[repr(C)]
pub struct Pose {
    /// Meters ahead of the robot's center.
    pub x_m: f64,
    /// Meters to the left of the robot's center.
    pub y_m: f64,
    /// Direction in radians, counterclockwise from ahead.
    pub yaw_rad: f64,
    /// 1 if the sensor is mounted upside down, so that its first beam is the leftmost.
    pub upside_down: u8,
    /// 0. In a status, the first byte is 1 if a threshold for reflectors (`marks.level`) is configured.
    pub reserved: [u8; 7],
}

impl Pose {
    /// Returns the direction of a beam in the robot's frame, as a unit vector. `angle` is in radians, counterclockwise
    /// from ahead as seen by an upright sensor.
    pub fn direction(&self, angle: f64) -> (f64, f64) {
        let turned = if self.upside_down == 0 { angle } else { -angle };
        let (sin, cos) = (self.yaw_rad + turned).sin_cos();
        (cos, sin)
    }

    /// Returns the point at `range_mm` on the beam at `angle`, in the robot's frame in mm.
    pub fn point_mm(&self, angle: f64, range_mm: f64) -> (f64, f64) {
        let (x, y) = self.direction(angle);
        (1000.0 * self.x_m + range_mm * x, 1000.0 * self.y_m + range_mm * y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    #[test]
    fn state_numbers_match_their_order() {
        for (number, state) in State::ALL.iter().enumerate() {
            assert_eq!(*state as usize, number);
        }
        assert_eq!(Status { state: 7, ..Status::default() }.state(), None);
    }

    #[test]
    fn mode_without_reflector_bits_has_a_remedy() {
        let mut status = Status { mode: 0, ..Status::default() };
        status.set_port("/dev/ttyUSB0");
        let facts = |status: &Status| (status.has_reflector_bits(), status.missing_reflector_mode());
        assert_eq!(facts(&status), (Some(false), Some(REFLECTOR_MODE)));
        status.mode = REFLECTOR_MODE;
        assert_eq!(facts(&status), (Some(true), None));
        status.set_port("file:/tmp/walk.log");
        status.mode = 0;
        assert_eq!(facts(&status), (Some(false), None));
        assert_eq!(facts(&Status::default()), (None, None));
    }

    #[test]
    fn marks_need_reflector_bits_or_a_threshold() {
        let of = |family: u8, mode, has_mark_level| {
            let mut status = Status { family, mode, ..Status::default() };
            status.set_processing(Pose { x_m: 1.0, ..Pose::default() }, has_mark_level);
            assert_eq!(status.pose.x_m, 1.0);
            status.has_marks()
        };
        for (number, family) in Family::ALL.into_iter().enumerate() {
            let number = number as u8;
            let [without, with] = [false, true].map(|has_level| of(number, Status::MODE_UNKNOWN, has_level));
            match family {
                Family::Lms => {
                    assert_eq!((without, with), (None, None));
                    assert_eq!(of(number, 0, true), Some(false));
                    assert_eq!(of(number, REFLECTOR_MODE, false), Some(true));
                }
                _ => assert_eq!((without, with), (Some(false), Some(true))),
            }
        }
        assert_eq!(of(Family::UNKNOWN, Status::MODE_UNKNOWN, true), None, "while the hub searches");
    }

    #[test]
    fn scanner_has_a_family_and_a_model() {
        let mut status = Status::default();
        assert_eq!((status.family(), status.model()), (Some(Family::Lms), None));
        status.set_sensor_type("LMS200;301063;V02.30 ");
        assert_eq!(status.model().as_deref(), Some("lms200"));
        status.set_sensor_type("LMS291-S05 30106");
        assert_eq!(status.model().as_deref(), Some("lms291-s05"));
        status.family = 255;
        assert_eq!(status.family(), None);
    }

    #[test]
    fn line_loss_is_described_as_text() {
        let mut status = Status::default();
        assert_eq!((status.damaged_share(), status.lost_on_line(), status.line_loss()), (0.0, None, None));
        status.counters[Counter::DamagedPpm] = 430_000;
        assert_eq!(status.line_loss().as_deref(), Some("43 % damaged on the line"));
        status.counters[Counter::DueOnLine] = 1000;
        status.counters[Counter::LostOnLine] = 7;
        status.counters[Counter::LostPpm] = 7_000;
        assert_eq!((status.lost_on_line(), status.lost_share()), (Some(7), Some(0.007)));
        assert_eq!(status.line_loss().as_deref(), Some("0.7 % lost on the line"));
        (status.counters[Counter::LostPpm], status.counters[Counter::DamagedPpm]) = (1_000, 1_000);
        assert_eq!(status.line_loss(), None, "that much is well");
        status.counters[Counter::LostPpm] = 408_000;
        assert_eq!(status.line_loss().as_deref(), Some("41 % lost on the line"));
    }

    #[test]
    fn all_counters_fit_into_a_status() {
        assert!(Counter::ALL.len() <= MAX_COUNTERS);
    }

    #[test]
    fn beams_point_where_the_sensor_is_turned_and_mounted() {
        let near = |(x, y): (f64, f64), (a, b): (f64, f64)| (x - a).abs() < 1e-9 && (y - b).abs() < 1e-9;
        let ahead = Pose { x_m: 0.3, y_m: -0.1, ..Pose::default() };
        assert!(near(ahead.point_mm(0.0, 500.0), (800.0, -100.0)));
        assert!(near(ahead.point_mm(-FRAC_PI_2, 500.0), (300.0, -600.0)), "the first beam looks right");
        let rear = Pose { yaw_rad: 2.0 * FRAC_PI_2, ..Pose::default() };
        assert!(near(rear.direction(-FRAC_PI_2), (0.0, 1.0)), "behind, right is left");
        let turned_over = Pose { yaw_rad: FRAC_PI_2, upside_down: 1, ..Pose::default() };
        assert!(near(turned_over.direction(0.0), (0.0, 1.0)));
        assert!(
            near(turned_over.direction(-FRAC_PI_2), (-1.0, 0.0)),
            "upside down, the first beam looks left"
        );
    }
}
