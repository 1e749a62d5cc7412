//! Decoded scans of a recording, and the poses of their sensors.
//!
//! The scans of an LMS are decoded from its telegrams, as in the hub. If its telegrams were not recorded, its published
//! scans are used. For a rotating scanner, published scans are used first. If they were not recorded, the same session
//! as in the hub builds scans from the packets.
//!
//! A recording may begin after a rotating scanner has sent the responses that define how to read its packets.
//! [`stream_heads`] returns these responses, with the positions at which a stream file needs them.

use std::collections::BTreeMap;

use scanhub_drivers::line::{Event, RawScan, ScannerSession as _, suspect};
use scanhub_drivers::lms::measured::MeasuredValues;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Baud, Mode, Variant};
use scanhub_drivers::{Session, Settings, features};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::{
    Failure, Family, Flags, Header, Kind, MILLIS, Nanos, Pose, Quality, Scan, Status, Topic,
};

use crate::convert::ConversionError;
use crate::convert::writers::is_synthetic;
use crate::mcap::Item;
use crate::{Encoding, Form, Frame, Recording, VirtualTime};

/// An item of a recording.
pub(super) enum DecodedItem<'a> {
    /// A scan of a sensor.
    Scan(&'a str, Header, &'a Scan),
    /// Pose of a sensor, and the time from which the pose is valid, in ns since 1970.
    Pose(&'a str, u64, Pose),
    /// A telegram that is not a scan.
    Other,
}

/// State of a sensor.
struct Sensor {
    mode: Option<Mode>,
    /// Whether the sensor's scans are decoded from its telegrams.
    is_decoded: bool,
    /// Builder of scans from packets; `None` for an LMS, and if published scans are used.
    revolutions: Option<Revolutions>,
    /// Whether no telegram of the sensor has been read yet.
    is_first: bool,
}

/// Calls `take_item` for each item of `recording`, in the order of the file. If the recording does not name its sensor,
/// `name` is the name of the sensor. `mode` is used if the recording does not contain the measuring mode.
///
/// # Errors
///
/// Returns [`Kind::Configuration`] if the measuring mode is unknown, because values cannot be decoded without it.
/// Otherwise returns the error of `take_item`.
pub(super) fn for_each_item(
    recording: &Recording,
    name: &str,
    encoding: Encoding,
    mode: Option<Mode>,
    take_item: &mut impl FnMut(DecodedItem<'_>) -> Result<(), ConversionError>,
) -> Result<(), ConversionError> {
    match recording.contents().form {
        Form::Mcap => for_each_mcap_item(recording, mode, take_item),
        form => {
            let of_log = (form == Form::Carmen).then_some(encoding.mode);
            let contents = recording.contents();
            let mode = contents.mode.or(of_log).or(mode).or(contents.readable_mode());
            let mut sensor =
                Sensor { mode, is_decoded: true, revolutions: Revolutions::of(recording)?, is_first: true };
            sensor.check(recording, name)?;
            let mut clock = SyntheticClock::of(recording);
            let mut scan = Box::<Scan>::default();
            let mut frames = recording.telegrams(encoding)?.enumerate().peekable();
            while let Some((number, frame)) = frames.next() {
                let next_ns = frames.peek().and_then(|(_, next)| next.wall_ns);
                let header = clock.header(&frame, number as u64, next_ns);
                if let Some(revolutions) = &mut sensor.revolutions {
                    revolutions.for_each_revolution(&header, &frame.telegram, |header, scan| {
                        take_item(DecodedItem::Scan(name, header, scan))
                    })?;
                    continue;
                }
                match sensor.decode(&frame.telegram, &mut scan) {
                    true => take_item(DecodedItem::Scan(name, header, &scan))?,
                    false if number == 0 && is_synthetic(&frame.telegram, None) => {}
                    false => take_item(DecodedItem::Other)?,
                }
            }
            Ok(())
        }
    }
}

fn for_each_mcap_item(
    recording: &Recording,
    mode: Option<Mode>,
    take_item: &mut impl FnMut(DecodedItem<'_>) -> Result<(), ConversionError>,
) -> Result<(), ConversionError> {
    let (mut reader, catalog) = recording.reader()?;
    let mut sensors = BTreeMap::new();
    for name in &recording.contents().sensors {
        let contents = recording.of(name)?.contents().clone();
        let mode = contents.mode.or(mode).or(contents.readable_mode());
        let has_scans = catalog.has_scans(name);
        let revolutions = if has_scans { None } else { Revolutions::of(&recording.of(name)?)? };
        let is_decoded = contents.scans > 0 && (mode.is_some() || !has_scans);
        let sensor = Sensor { mode, is_decoded, revolutions, is_first: true };
        sensor.check(recording, name)?;
        sensors.insert(name.clone(), sensor);
    }
    let mut scan = Box::<Scan>::default();
    while let Some(item) = reader.next().map_err(|error| recording.read_failure(&error))? {
        match item {
            Item::Telegram(sample) => {
                let Some(sensor) = sensors.get_mut(&sample.sensor) else { continue };
                if sample.header.family != Family::Lms as u8 {
                    let Some(revolutions) = &mut sensor.revolutions else { continue };
                    let name = &sample.sensor;
                    revolutions.for_each_revolution(&sample.header, &sample.telegram, |header, scan| {
                        take_item(DecodedItem::Scan(name, header, scan))
                    })?;
                    continue;
                }
                let is_first = std::mem::replace(&mut sensor.is_first, false);
                match sensor.decode(&sample.telegram, &mut scan) && sensor.is_decoded {
                    true => take_item(DecodedItem::Scan(&sample.sensor, sample.header, &scan))?,
                    false if is_first && is_synthetic(&sample.telegram, Some(&sample.header)) => {}
                    false => take_item(DecodedItem::Other)?,
                }
            }
            Item::Record(record) => {
                let Some((channel, header, payload)) = catalog.message(&record) else { continue };
                let Some(sensor) = sensors.get_mut(&channel.sensor) else { continue };
                if channel.has_scans() && !sensor.is_decoded && Scan::unpack_into(&mut scan, payload) {
                    take_item(DecodedItem::Scan(&channel.sensor, header, &scan))?;
                }
                let mut status = Status::default();
                if channel.topic == Topic::Status && status.unpack(payload) {
                    let reported = Some(Mode(status.mode)).filter(|mode| mode.0 != Status::MODE_UNKNOWN);
                    sensor.mode = reported.or(sensor.mode);
                    take_item(DecodedItem::Pose(&channel.sensor, header.wall_ns, status.pose))?;
                }
            }
        }
    }
    Ok(())
}

impl Sensor {
    /// Checks that values can be decoded to ranges, which requires a measuring mode.
    fn check(&self, recording: &Recording, name: &str) -> Result<(), Failure> {
        if self.mode.is_some() || !self.is_decoded {
            return Ok(());
        }
        let message = format!("{} does not contain the measuring mode of {name}", recording.path().display());
        let hint =
            "set it with --mode, such as --mode 0x01; `scanhub doctor PORT` requests it from the scanner";
        Err(Failure::new(Kind::Configuration, message, hint))
    }

    /// Decodes a telegram into `scan`. Returns `false` if the telegram is not a scan, or if its measuring mode is
    /// unknown.
    fn decode(&mut self, telegram: &[u8], scan: &mut Box<Scan>) -> bool {
        let Some(telegram) = Telegram::check(telegram) else { return false };
        if let Some(Reply::Configuration(configuration)) = Reply::decode(telegram) {
            self.mode = Some(configuration.mode());
        }
        match (MeasuredValues::decode(telegram), self.mode) {
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

/// Builder of scans from the packets of a rotating scanner, as in the hub.
pub(super) struct Revolutions {
    family: Family,
    settings: Settings,
    /// The session, and the boot ID of the hub whose packets it handles.
    session: Option<(u64, VirtualTime<Session>)>,
    scan: Box<Scan>,
}

impl Revolutions {
    /// Creates the builder for the only sensor of `recording`. Returns `None` if the scanner is not a rotating one.
    pub(super) fn of(recording: &Recording) -> Result<Option<Revolutions>, Failure> {
        let Some(family) = recording.family().filter(|family| !features(*family).has_whole_telegrams) else {
            return Ok(None);
        };
        let settings = recording.session_settings()?;
        Ok(Some(Revolutions { family, settings, session: None, scan: Box::default() }))
    }

    /// Handles the packets of a sample with this `header`. Calls `take_item` for each scan that these packets complete,
    /// with the header of the scan.
    pub(super) fn for_each_revolution(
        &mut self,
        header: &Header,
        packets: &[u8],
        mut take_item: impl FnMut(Header, &Scan) -> Result<(), ConversionError>,
    ) -> Result<(), ConversionError> {
        let Revolutions { family, settings, session, scan } = self;
        // Another run of the hub may have another clock, so it needs a new session.
        if session.as_ref().is_none_or(|(boot, _)| *boot != header.boot) {
            let new_session = Session::begin(*family, settings, header.stamp_first_ns);
            *session = Some((header.boot, VirtualTime::new(new_session, header.stamp_first_ns)));
        }
        let Some((_, session)) = session else { return Ok(()) };
        session.session_mut().mark_suspect(header.reasons & !suspect::LINE_ERROR);
        let mut result = Ok(());
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
                period_us: u32::try_from(period / scanhub_schema::MICROS).unwrap_or(u32::MAX),
                quality: quality as u8,
                reasons,
                hub_time: [0; 3],
                ..*header
            };
            if result.is_ok() {
                result = take_item(header, scan);
            }
        });
        result
    }
}

/// Generator of stamps for telegrams that have no stamps. The stamps of scans are one scan period apart, and the last
/// telegram ends at the time at which the file was last written.
pub(super) struct SyntheticClock {
    wall_ns: u64,
    begin_ns: u64,
    boot: u64,
    variant: Variant,
}

impl SyntheticClock {
    /// Creates the generator at the beginning of `recording`.
    pub(super) fn of(recording: &Recording) -> SyntheticClock {
        let contents = recording.contents();
        let variant = contents.variant.unwrap_or(Variant::HALF);
        let took_ns = contents.scanner_ns.unwrap_or(contents.scans * scan_ns(variant));
        let begin_ns = match contents.span {
            Some((first_ns, _)) => first_ns,
            None => recording.modified_ns().saturating_sub(took_ns),
        };
        // The boot ID can be any number that differs between recordings.
        let boot = begin_ns.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        SyntheticClock { wall_ns: begin_ns, begin_ns, boot, variant }
    }

    /// Returns the time at which the next frame, `frame`, was measured.
    pub(super) fn wall_ns(&mut self, frame: &Frame) -> u64 {
        let of_scanner = frame.scanner_ns.map(|ns| self.begin_ns.saturating_add(ns));
        let at_ns = frame.wall_ns.or(of_scanner).unwrap_or(self.wall_ns);
        let step_ns = if frame.is_scan() { scan_ns(self.variant) } else { line_ns(frame) };
        self.wall_ns = at_ns.saturating_add(step_ns);
        at_ns
    }

    /// Returns the header that a hub might have published with the next frame, `frame`, which has the index `number`.
    /// The period lasts until the following frame at `next_ns`, because logs may omit scans, and no newer scan exists
    /// in between.
    pub(super) fn header(&mut self, frame: &Frame, number: u64, next_ns: Option<u64>) -> Header {
        let wall_ns = self.wall_ns(frame);
        let first_ns = wall_ns.saturating_add(START_NS).saturating_sub(self.begin_ns);
        let gap_ns = next_ns.map_or(0, |next_ns| next_ns.saturating_sub(wall_ns));
        let period_ns = scan_ns(self.variant).max(gap_ns).min(MAX_PERIOD_NS);
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
            // A frame of packets has no scan period.
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
    scanhub_schema::line_time(frame.telegram.len(), Baud::B500000.rate())
}

/// Returns the responses that are missing before the packets, each with the index of the frame before which it belongs.
///
/// # Errors
///
/// Returns the errors of [`Recording::telegrams`], and [`Kind::Input`] if nothing in the recording defines how its
/// packets must be read.
pub(super) fn stream_heads(recording: &Recording) -> Result<Vec<(usize, Vec<u8>)>, Failure> {
    let contents = recording.contents();
    // A stream file has no stamps, so the time per point cannot be measured.
    let family = recording.family().filter(|_| contents.form == Form::Mcap);
    let Some(family) = family.filter(|family| !features(*family).has_whole_telegrams) else {
        return Ok(Vec::new());
    };
    let settings = recording.session_settings().map_err(|_| without_status(recording))?;
    let settings = Settings { beams: None, ..settings };
    let status = contents.sensor_type.as_ref().filter(|(number, _)| *number == family as u8);
    let reported = status.map_or("", |(_, text)| text);
    let (mut heads, mut is_guess) = (Vec::new(), false);
    let mut close = |stream: Stream| {
        let session = stream.session.session();
        let head = session.stream_responses(reported, recording.beams());
        if !head.is_empty() {
            // If the model is unknown, neither a status nor the scanner has confirmed the time per point.
            is_guess |= status.is_none() && session.model_text().is_none();
            heads.push((stream.at, head));
        }
    };
    let mut open: Option<Stream> = None;
    for (number, frame) in recording.telegrams(Encoding::default())?.enumerate() {
        let Some(header) = frame.header.filter(|header| header.family == family as u8) else { continue };
        let is_reply = family.packets(&frame.telegram).is_some_and(|info| info.kind == REPLY_KIND);
        if let Some(ended) = open.take_if(|stream| !stream.continues_with(&header, is_reply)) {
            close(ended);
        }
        let stream = open.get_or_insert_with(|| Stream::begin(family, settings, number, &header, is_reply));
        stream.take(number, &header, &frame.telegram, is_reply);
    }
    open.into_iter().for_each(&mut close);
    if is_guess {
        return Err(without_status(recording));
    }
    Ok(heads)
}

/// Returns the failure for a recording whose packets can be read in several ways.
fn without_status(recording: &Recording) -> Failure {
    let message = format!(
        "recording {} has neither the topic status nor the scanner's responses, without which its packets cannot be read",
        recording.path().display()
    );
    Failure::new(Kind::Input, message, "record NAME/status too, as `record` does by default")
}

/// A stream of packets, and the responses before it.
struct Stream {
    /// Boot ID of the hub.
    boot: u64,
    /// Index of the frame before which missing responses belong: the last response before the packets, or the first
    /// frame if there is no such response.
    at: usize,
    /// Stamp of the first packets. `None` before they have arrived.
    packets_since: Option<Nanos>,
    session: VirtualTime<Session>,
}

impl Stream {
    /// Creates the stream that begins with frame `number`, which has this `header`. The mode in `settings` is that of
    /// the recording's first status. It is ignored if the stream begins with a response, because then the scanner
    /// reports its modes itself.
    fn begin(family: Family, settings: Settings, number: usize, header: &Header, is_reply: bool) -> Stream {
        let (start, mode) = (header.stamp_first_ns, settings.mode.filter(|_| !is_reply));
        let session = Session::begin(family, &Settings { mode, ..settings }, start);
        Stream {
            boot: header.boot,
            at: number,
            packets_since: None,
            session: VirtualTime::new(session, start),
        }
    }

    /// Returns whether the frame with this `header` belongs to the stream. A frame of another run of the hub does not
    /// belong to the stream, nor does a response after packets.
    fn continues_with(&self, header: &Header, is_reply: bool) -> bool {
        header.boot == self.boot && !(is_reply && self.packets_since.is_some())
    }

    /// Handles the telegram of frame `number`.
    fn take(&mut self, number: usize, header: &Header, telegram: &[u8], is_reply: bool) {
        if is_reply {
            self.at = number;
        } else {
            let since = *self.packets_since.get_or_insert(header.stamp_first_ns);
            if header.stamp_first_ns >= since.saturating_add(MEASURING_TIME) {
                return;
            }
        }
        // As in the hub, the flag for an error of the line is not passed to the session.
        self.session.session_mut().mark_suspect(header.reasons & !suspect::LINE_ERROR);
        self.session.take(header.stamp_last_ns, telegram, |_| {});
    }
}

/// Maximum period that the clock generates, in ns. It fits into a header.
const MAX_PERIOD_NS: u64 = 3_600_000_000_000;
/// Time on the monotonic clock at the first telegram, in ns, as on a machine that has just started.
const START_NS: u64 = 10_000_000_000;
/// Kind of a telegram that is a response.
const REPLY_KIND: &str = "reply";
/// Maximum time for which the session reads packets of a stream to measure the time per point.
const MEASURING_TIME: Nanos = 4_000 * MILLIS;
