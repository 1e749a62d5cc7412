//! Scans of a recording for other programs, and the poses of their sensors.
//!
//! The scans of an LMS are decoded from its telegrams, as in the hub. If its telegrams were not recorded, its published scans are
//! used. For a rotating scanner, published scans are preferred, and otherwise its packets are turned into scans by the session
//! that the hub uses.

use std::collections::BTreeMap;

use scanhub_drivers::line::{Event, RawScan, Session as _, suspect};
use scanhub_drivers::lms::measured::Measured;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Baud, Mode, Variant};
use scanhub_drivers::{Session, Settings, features};
use schema::datagram::Packed;
use schema::{Failure, Family, Flags, Header, Kind, Nanos, Pose, Quality, Scan, Status, Topic};

use super::is_made_up;
use crate::mcap::Item;
use crate::{Encoding, Form, Frame, Recording, VirtualTime};

/// A part of a recording.
pub(super) enum Sight<'a> {
    /// A scan of a sensor.
    Scan(&'a str, Header, &'a Scan),
    /// Pose of a sensor from this time on, in ns since 1970.
    Pose(&'a str, u64, Pose),
    /// A telegram that is not a scan.
    Other,
}

/// State of a sensor.
struct Sensor {
    mode: Option<Mode>,
    /// Whether its scans are decoded from telegrams.
    is_decoded: bool,
    /// For a rotating scanner: its revolutions.
    turns: Option<Turns>,
    /// Whether none of its telegrams has been read.
    is_first: bool,
}

/// Calls `tell` for each part of `recording`, in its order. A recording that does not name its sensor belongs to `name`; `mode`
/// is used if the recording does not contain the measuring mode.
///
/// # Errors
///
/// Returns [`Kind::Configuration`] if the measuring mode is unknown, without which values are not ranges. Otherwise returns the
/// error of `tell`.
pub(super) fn each(
    recording: &Recording,
    name: &str,
    encoding: Encoding,
    mode: Option<Mode>,
    tell: &mut impl FnMut(Sight<'_>) -> Result<(), Failure>,
) -> Result<(), Failure> {
    match recording.contents().form {
        Form::Mcap => each_of_mcap(recording, mode, tell),
        form => {
            let told = (form == Form::Carmen).then_some(encoding.mode);
            let contents = recording.contents();
            let mode = contents.mode.or(told).or(mode).or(contents.readable());
            let mut sensor = Sensor { mode, is_decoded: true, turns: Turns::of(recording)?, is_first: true };
            sensor.check(recording, name)?;
            let mut times = Times::of(recording);
            let mut scan = Box::<Scan>::default();
            let mut frames = recording.telegrams(encoding)?.enumerate().peekable();
            while let Some((number, frame)) = frames.next() {
                let next_ns = frames.peek().and_then(|(_, next)| next.wall_ns);
                let header = times.header(&frame, number as u64, next_ns);
                if let Some(turns) = &mut sensor.turns {
                    turns.each(&header, &frame.telegram, |header, scan| {
                        tell(Sight::Scan(name, header, scan))
                    })?;
                    continue;
                }
                match sensor.decode(&frame.telegram, &mut scan) {
                    true => tell(Sight::Scan(name, header, &scan))?,
                    false if number == 0 && is_made_up(&frame.telegram, None) => {}
                    false => tell(Sight::Other)?,
                }
            }
            Ok(())
        }
    }
}

fn each_of_mcap(
    recording: &Recording,
    mode: Option<Mode>,
    tell: &mut impl FnMut(Sight<'_>) -> Result<(), Failure>,
) -> Result<(), Failure> {
    let (mut reader, catalog) = recording.reader()?;
    let mut sensors = BTreeMap::new();
    for name in &recording.contents().sensors {
        let contents = recording.of(name)?.contents().clone();
        let mode = contents.mode.or(mode).or(contents.readable());
        let has_scans = catalog.has_scans(name);
        let turns = if has_scans { None } else { Turns::of(&recording.of(name)?)? };
        let is_decoded = contents.scans > 0 && (mode.is_some() || !has_scans);
        let sensor = Sensor { mode, is_decoded, turns, is_first: true };
        sensor.check(recording, name)?;
        sensors.insert(name.clone(), sensor);
    }
    let mut scan = Box::<Scan>::default();
    while let Some(item) = reader.next().map_err(|error| recording.broken(&error))? {
        match item {
            Item::Telegram(sample) => {
                let Some(sensor) = sensors.get_mut(&sample.sensor) else { continue };
                if sample.header.family != Family::Lms as u8 {
                    let Some(turns) = &mut sensor.turns else { continue };
                    let name = &sample.sensor;
                    turns.each(&sample.header, &sample.telegram, |header, scan| {
                        tell(Sight::Scan(name, header, scan))
                    })?;
                    continue;
                }
                let is_first = std::mem::replace(&mut sensor.is_first, false);
                match sensor.decode(&sample.telegram, &mut scan) && sensor.is_decoded {
                    true => tell(Sight::Scan(&sample.sensor, sample.header, &scan))?,
                    false if is_first && is_made_up(&sample.telegram, Some(&sample.header)) => {}
                    false => tell(Sight::Other)?,
                }
            }
            Item::Record(record) => {
                let Some((place, header, payload)) = catalog.message(&record) else { continue };
                let Some(sensor) = sensors.get_mut(&place.sensor) else { continue };
                if place.has_scans() && !sensor.is_decoded && Scan::unpack_into(&mut scan, payload) {
                    tell(Sight::Scan(&place.sensor, header, &scan))?;
                }
                let mut status = Status::default();
                if place.topic == Topic::Status && status.unpack(payload) {
                    let told = Some(Mode(status.mode)).filter(|mode| mode.0 != Status::MODE_UNKNOWN);
                    sensor.mode = told.or(sensor.mode);
                    tell(Sight::Pose(&place.sensor, header.wall_ns, status.pose))?;
                }
            }
        }
    }
    Ok(())
}

impl Sensor {
    /// Checks that values can become ranges.
    fn check(&self, recording: &Recording, name: &str) -> Result<(), Failure> {
        if self.mode.is_some() || !self.is_decoded {
            return Ok(());
        }
        let message = format!("{} does not contain the measuring mode of {name}", recording.path().display());
        let hint = "set it with --mode, such as --mode 0x01; `scanhub doctor PORT` asks the sensor for it";
        Err(Failure::new(Kind::Configuration, message, hint))
    }

    /// Decodes a telegram into `scan`; `false` if it is not a scan, or if its measuring mode is unknown.
    fn decode(&mut self, telegram: &[u8], scan: &mut Box<Scan>) -> bool {
        let Some(telegram) = Telegram::check(telegram) else { return false };
        if let Some(Reply::Configuration(configuration)) = Reply::decode(telegram) {
            self.mode = Some(configuration.mode());
        }
        match (Measured::decode(telegram), self.mode) {
            (Some(measured), Some(mode)) => {
                let raw = measured.scan(mode);
                Scan::grow(scan, raw.payload_len());
                raw.write(scan);
            }
            _ => return false,
        }
        true
    }
}

/// Turns the packets of a rotating scanner into scans, as the hub does.
pub(super) struct Turns {
    family: Family,
    settings: Settings,
    /// The session, and the run of the hub that it belongs to.
    session: Option<(u64, VirtualTime<Session>)>,
    scan: Box<Scan>,
}

impl Turns {
    /// Starts with the only sensor of `recording`; `None` if it is not a rotating scanner.
    pub(super) fn of(recording: &Recording) -> Result<Option<Turns>, Failure> {
        let Some(family) = recording.family().filter(|family| !features(*family).has_whole_telegrams) else {
            return Ok(None);
        };
        let settings = recording.session_settings()?;
        Ok(Some(Turns { family, settings, session: None, scan: Box::default() }))
    }

    /// Takes the packets of a sample with this `header`, and calls `tell` for each scan that they complete, with its header.
    pub(super) fn each(
        &mut self,
        header: &Header,
        packets: &[u8],
        mut tell: impl FnMut(Header, &Scan) -> Result<(), Failure>,
    ) -> Result<(), Failure> {
        let Turns { family, settings, session, scan } = self;
        // Another run of the hub has another clock.
        if session.as_ref().is_none_or(|(boot, _)| *boot != header.boot) {
            let begun = Session::begin(*family, settings, header.stamp_first_ns);
            *session = Some((header.boot, VirtualTime::new(begun, header.stamp_first_ns)));
        }
        let Some((_, session)) = session else { return Ok(()) };
        session.session_mut().mark_suspect(header.reasons & !suspect::LINE_ERROR);
        let mut told = Ok(());
        session.take(header.stamp_last_ns, packets, |event| {
            let Event::Scan(raw) = event else { return };
            Scan::grow(scan, raw.payload_len());
            raw.write(scan);
            let RawScan { first, last, period, reasons, .. } = raw;
            let quality = if reasons == 0 { Quality::Clean } else { Quality::Suspect };
            let wall_ns = |stamp: Nanos| (header.wall_ns + stamp).saturating_sub(header.stamp_first_ns);
            let header = Header {
                stamp_first_ns: first,
                stamp_last_ns: last,
                wall_ns: wall_ns(first),
                period_us: u32::try_from(period / schema::MICROS).unwrap_or(u32::MAX),
                quality: quality as u8,
                reasons,
                hub_time: [0; 3],
                ..*header
            };
            if told.is_ok() {
                told = tell(header, scan);
            }
        });
        told
    }
}

/// Times for telegrams that have none: they are one scan period apart, and the last one ends when the file was last written.
pub(super) struct Times {
    wall_ns: u64,
    begin_ns: u64,
    boot: u64,
    variant: Variant,
}

impl Times {
    /// Starts at the beginning of `recording`.
    pub(super) fn of(recording: &Recording) -> Times {
        let contents = recording.contents();
        let variant = contents.variant.unwrap_or(Variant::HALF);
        let took_ns = contents.scanner_ns.unwrap_or(contents.scans * scan_ns(variant));
        let begin_ns = match contents.span {
            Some((first_ns, _)) => first_ns,
            None => recording.written_ns().saturating_sub(took_ns),
        };
        // Any number that differs between recordings.
        let boot = begin_ns.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        Times { wall_ns: begin_ns, begin_ns, boot, variant }
    }

    /// Returns the time at which `frame`, the next one, was measured.
    pub(super) fn wall_ns(&mut self, frame: &Frame) -> u64 {
        let of_scanner = frame.scanner_ns.map(|ns| self.begin_ns.saturating_add(ns));
        let at_ns = frame.wall_ns.or(of_scanner).unwrap_or(self.wall_ns);
        let step_ns = if frame.is_scan() { scan_ns(self.variant) } else { line_ns(frame) };
        self.wall_ns = at_ns.saturating_add(step_ns);
        at_ns
    }

    /// Returns the header that a hub might have published with `frame`, the next one, which has this `number`. The period lasts
    /// until the frame at `next_ns`, because logs leave scans out, and nothing newer can be known until then.
    pub(super) fn header(&mut self, frame: &Frame, number: u64, next_ns: Option<u64>) -> Header {
        let wall_ns = self.wall_ns(frame);
        let first_ns = wall_ns.saturating_add(UPTIME_NS).saturating_sub(self.begin_ns);
        let gap_ns = next_ns.map_or(0, |next_ns| next_ns.saturating_sub(wall_ns));
        let period_ns = scan_ns(self.variant).max(gap_ns).min(LONGEST_PERIOD_NS);
        Header {
            seq: number,
            topic_seq: number,
            stamp_first_ns: first_ns,
            stamp_last_ns: first_ns.saturating_add(line_ns(frame)),
            wall_ns,
            boot: self.boot,
            flags: Flags::STAMP_ESTIMATED,
            family: frame.family,
            quality: u8::from(frame.reasons != 0),
            reasons: frame.reasons,
            // Packets are not scans.
            period_us: if frame.scanner_ns.is_some() { 0 } else { (period_ns / 1000) as u32 },
            ..Header::default()
        }
    }
}

/// Returns the time between two scans at 500 kBd.
fn scan_ns(variant: Variant) -> u64 {
    variant.period(2 * variant.beams() + 10, Baud::B500000.rate())
}

fn line_ns(frame: &Frame) -> u64 {
    schema::line_time(frame.telegram.len(), Baud::B500000.rate())
}

/// Maximum period, which fits into a header.
const LONGEST_PERIOD_NS: u64 = 3_600_000_000_000;
/// Monotonic clock at the first telegram, as on a machine that has just started.
const UPTIME_NS: u64 = 10_000_000_000;
