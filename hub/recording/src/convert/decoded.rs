//! What other programs need from a recording: its scans, and the poses of their sensors. Scans are decoded from telegrams
//! as in the hub; if a sensor's telegrams were not recorded, its published scans are used. Of a scanner whose head turns the
//! published ones go first. Refuses to know the output.

use std::collections::BTreeMap;

use lms::measured::Measured;
use lms::reply::Reply;
use lms::telegram::Telegram;
use lms::variant::Mode;
use schema::datagram::Packed;
use schema::{Failure, Family, Header, Kind, Pose, Scan, Status, Topic};

use super::is_made_up;
use super::times::Times;
use super::turns::Turns;
use crate::mcap::Item;
use crate::{Encoding, Form, Recording};

/// What comes next in a recording.
pub(super) enum Sight<'a> {
    /// A scan of a sensor.
    Scan(&'a str, Header, &'a Scan),
    /// From this time on (ns since 1970) a sensor sits there.
    Pose(&'a str, u64, Pose),
    /// A telegram that is no scan.
    Other,
}

/// What is known of a sensor.
struct Sensor {
    mode: Option<Mode>,
    /// Its scans are made of telegrams.
    is_decoded: bool,
    /// Where its head turns.
    turns: Option<Turns>,
    /// Whether none of its telegrams has been read.
    is_first: bool,
}

/// Calls `tell` with all that is in `recording`, in its order. What came without the name of a sensor is of `name`; `mode`
/// is that of a recording that does not tell it.
///
/// [`Kind::Configuration`] if a measuring mode is not told, without which values are no ranges; else the error of `tell`.
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
    /// Its values can become ranges.
    fn check(&self, recording: &Recording, name: &str) -> Result<(), Failure> {
        if self.mode.is_some() || !self.is_decoded {
            return Ok(());
        }
        let message = format!("{} does not contain the measuring mode of {name}", recording.path().display());
        let hint = "set it with --mode, such as --mode 0x01; `scanhub doctor PORT` asks the sensor for it";
        Err(Failure::new(Kind::Configuration, message, hint))
    }

    /// Makes `scan` of a telegram; `false` if it is none, or nothing says how to read it.
    fn decode(&mut self, telegram: &[u8], scan: &mut Box<Scan>) -> bool {
        let Some(telegram) = Telegram::check(telegram) else { return false };
        if let Some(Reply::Configuration(configuration)) = Reply::decode(telegram) {
            self.mode = Some(configuration.mode());
        }
        match (Measured::decode(telegram), self.mode) {
            (Some(measured), Some(mode)) => {
                Scan::grow(scan, scanner::len(&measured));
                scanner::decode(&measured, mode, scan);
            }
            _ => return false,
        }
        true
    }
}
