//! A recording as a link plays it: opens it, checks that it belongs to the link, and computes the media time of its
//! telegrams.

use std::io::{self, Read};
use std::path::Path;

use scanhub_config::Link;
use scanhub_drivers::{Settings, features};
use scanhub_recording::{Contents, Encoding, Form, Frame, Recording};
use scanhub_schema::{Failure, Family, Header, Kind, Nanos};

use super::MAX_GAP;

/// Recording of one sensor.
pub(crate) enum RecordedSensor {
    /// Bytes of a line, without stamps.
    Stream(Stream),
    /// Telegrams, or packets of a rotating scanner.
    Frames(Frames),
}

/// Stream of telegrams, with all bytes between them.
pub(crate) struct Stream {
    recording: Recording,
    pub(super) family: Family,
    /// Number of the measuring mode.
    pub(super) mode: Option<u8>,
}

/// Complete telegrams or packets, with their stamps.
pub(crate) struct Frames {
    recording: Recording,
    pub(super) family: Family,
    /// Whether each frame is a telegram, which is a scan or a reply by itself, and not a group of packets.
    pub(super) is_whole: bool,
    /// Encoding of the ranges of a log.
    encoding: Encoding,
    /// Number of the measuring mode.
    mode: Option<u8>,
    origin: Option<Origin>,
    /// Whether the measuring mode is unknown at the start: the hub that recorded it received the mode in a later
    /// telegram.
    receives_mode: bool,
}

/// Media time 0: the time of the earliest telegram of all sensors in a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Origin {
    /// Wall clock, in ns since 1970.
    pub(crate) wall_ns: u64,
    /// Run of the hub, and its monotonic clock at media time 0. Within the run, this clock is used, because a wall
    /// clock may be set.
    pub(crate) run: Option<(u64, Nanos)>,
}

impl RecordedSensor {
    /// Opens the recording at `path`. If the recording has several sensors, the link plays the sensor that has the
    /// link's name. A file without a telegram is played as a line that carries only noise.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] if the recording cannot be read, and [`Kind::Configuration`] if it has several sensors
    /// but none with the link's name.
    pub(crate) fn open(path: &Path, link: &Link) -> Result<RecordedSensor, Failure> {
        let recording = Recording::open_stream(path, link.family())?;
        log_damage(&recording);
        if recording.contents().sensors.len() > 1 {
            // The name of the sensor comes from the configuration and not from an argument, so the failure has this
            // kind.
            let part = recording.of(&link.name);
            let part = part.map_err(|failure| Failure { kind: Kind::Configuration, ..failure })?;
            return RecordedSensor::new(part, link);
        }
        RecordedSensor::new(recording, link)
    }

    /// Creates the recording that `link` plays from `recording` of one sensor, and logs how the ranges of a log are
    /// read.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] if this version does not have the family of the scanner, and [`Kind::Configuration`] if
    /// the family differs from the family of the link.
    pub(crate) fn new(recording: Recording, link: &Link) -> Result<RecordedSensor, Failure> {
        let family = check_family(&recording, link)?;
        if !features(family).has_whole_telegrams {
            let mut frames = Frames {
                recording,
                family,
                is_whole: false,
                encoding: Encoding::default(),
                mode: None,
                origin: None,
                receives_mode: false,
            };
            frames.origin = frames.read()?.next().as_ref().and_then(Origin::of);
            return Ok(RecordedSensor::Frames(frames));
        }
        log_encoding(&recording, &link.name);
        let mode = recording.contents().mode_or(configured_mode(link));
        log_mode(&recording, link);
        if recording.contents().form == Form::Telegrams {
            return Ok(RecordedSensor::Stream(Stream { recording, family, mode }));
        }
        let encoding = recording.contents().encoding(mode);
        let mut frames =
            Frames { recording, family, is_whole: true, encoding, mode, origin: None, receives_mode: false };
        let mut first = frames.read()?.take(MAX_TELEGRAMS_TO_MODE).peekable();
        frames.origin = first.peek().and_then(Origin::of);
        let begin = first.peek().and_then(|frame| frame.header).filter(is_first);
        let is_open = begin.is_some_and(|header| frames.recording.first_understood(header.boot).is_none());
        frames.receives_mode = is_open && first.any(|frame| frame.has_mode());
        Ok(RecordedSensor::Frames(frames))
    }

    /// Returns the family of the scanner.
    pub(crate) fn family(&self) -> Family {
        match self {
            RecordedSensor::Stream(stream) => stream.family,
            RecordedSensor::Frames(frames) => frames.family,
        }
    }

    /// Returns the sensor's type, if a status of the recording has it. The type of a scanner of another family is
    /// ignored, because that scanner is not played.
    pub(super) fn sensor_type(&self) -> Option<&str> {
        let (RecordedSensor::Stream(Stream { recording, family, .. })
        | RecordedSensor::Frames(Frames { recording, family, .. })) = self;
        let (number, name) = recording.contents().sensor_type.as_ref()?;
        (*number == *family as u8).then_some(name.as_str())
    }

    /// Returns the start of the recording's media time; `None` if the recording has no stamps.
    pub(crate) fn origin(&self) -> Option<Origin> {
        match self {
            RecordedSensor::Stream(_) => None,
            RecordedSensor::Frames(frames) => frames.origin,
        }
    }

    /// Sets the start of the recording's media time to `origin`, which all recordings of one replay share.
    pub(crate) fn set_origin(&mut self, origin: Origin) {
        if let RecordedSensor::Frames(frames) = self {
            frames.origin = Some(origin);
        }
    }

    /// Returns the wall clock at the start of the recording, in ns since 1970; `None` if the recording has no stamps.
    pub(super) fn begin_ns(&self) -> Option<u64> {
        self.origin().map(|origin| origin.wall_ns)
    }

    /// Returns a message if no scan of the recording can be read; otherwise an empty string.
    pub(crate) fn problem(&self, name: &str) -> String {
        let (RecordedSensor::Stream(Stream { mode, recording, .. })
        | RecordedSensor::Frames(Frames { mode, recording, .. })) = self;
        if recording.contents().telegrams == 0 {
            return "there is no telegram in the recording".to_owned();
        }
        if mode.is_some() || recording.contents().scans == 0 {
            return String::new();
        }
        format!("the recording does not contain its measuring mode: no scans; set link.{name}.mode")
    }

    /// Returns messages about data that a replay drops or changes.
    pub(crate) fn losses(&self, name: &str) -> Vec<String> {
        let (RecordedSensor::Stream(Stream { recording, .. })
        | RecordedSensor::Frames(Frames { recording, .. })) = self;
        let Contents { other_family, unencodable, .. } = recording.contents();
        let foreign = other_family.map(|_| {
            let family = self.family().name();
            format!("{name}: telegrams are dropped, because their scanner is not of family {family}")
        });
        let unencodable = (!unencodable.is_none()).then(|| format!("{name}: {unencodable}"));
        foreign.into_iter().chain(unencodable).collect()
    }

    /// Returns the media time of the recording's end, if it is known without reading the recording.
    pub(crate) fn length(&self) -> Option<Nanos> {
        let (RecordedSensor::Stream(Stream { recording, .. })
        | RecordedSensor::Frames(Frames { recording, .. })) = self;
        let contents = recording.contents();
        match (contents.span, self.begin_ns()) {
            (Some((_, last_ns)), Some(begin_ns)) => Some(last_ns.saturating_sub(begin_ns)),
            _ if contents.scanner_ns.is_some() => contents.scanner_ns,
            _ => Some(contents.scans.saturating_sub(1) * contents.period(0)),
        }
    }

    /// Returns the media time of the recording's last telegram. A recording with stamps is read to its end for this.
    pub(crate) fn end(&self) -> Result<Nanos, Failure> {
        match self {
            RecordedSensor::Frames(frames) if frames.has_stamps() => {
                let mut timeline = frames.timeline();
                Ok(frames.read()?.map(|frame| timeline.media(&frame)).last().unwrap_or(0))
            }
            _ => Ok(self.length().unwrap_or(0)),
        }
    }
}

impl Stream {
    /// Returns whether the stream has any telegram.
    pub(super) fn has_telegrams(&self) -> bool {
        self.recording.contents().telegrams > 0
    }

    /// Returns the number of bytes that the stream had when it was opened.
    pub(super) fn len(&self) -> u64 {
        self.recording.contents().bytes
    }

    /// Returns the bytes of the stream from its start.
    pub(super) fn bytes(&self) -> Result<Box<dyn Read + Send>, Failure> {
        self.recording.bytes()
    }

    /// Returns the time from a scan of `beams` beams to the next scan.
    pub(super) fn period(&self, beams: usize) -> Nanos {
        self.recording.contents().period(beams)
    }
}

/// Reads into `room`. Returns the number of bytes that were read: 0 at the end, and if the file has become unreadable.
pub(super) fn read(bytes: &mut dyn Read, room: &mut [u8]) -> usize {
    loop {
        match bytes.read(room) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => {
                tracing::warn!(%error, "the recording became unreadable");
                return 0;
            }
            Ok(len) => return len,
        }
    }
}

impl Frames {
    /// Returns the number of telegrams that the recording had when it was opened.
    pub(super) fn count(&self) -> u64 {
        self.recording.contents().telegrams
    }

    /// Returns the telegrams of the recording from its start.
    pub(super) fn read(&self) -> Result<Box<dyn Iterator<Item = Frame> + Send>, Failure> {
        self.recording.telegrams(self.encoding)
    }

    /// Returns the settings of a session that reads this recording for `link`. Settings that are not configured come
    /// from the recording.
    pub(super) fn settings(&self, link: &Link) -> Settings {
        let mode_number = self.mode.filter(|_| !self.receives_mode);
        let mut settings = Settings { mode_number, ..link.settings() };
        if !self.is_whole && link.scanner.is_auto() {
            let model = self.recording.model().ok().flatten();
            settings.model = settings.model.or(model.map(|model| model.name));
            settings.mode = settings.mode.or(self.recording.contents().mode_name);
            settings.beams = settings.beams.or(self.recording.beams());
        }
        settings
    }

    /// Returns the number of the first telegram whose values the hub could read, in the run that starts with `header`.
    pub(super) fn first_understood(&self, header: &Header) -> u64 {
        let understood = is_first(header).then(|| self.recording.first_understood(header.boot));
        understood.flatten().unwrap_or(0)
    }

    /// Returns the timeline from the start.
    pub(super) fn timeline(&self) -> Timeline {
        Timeline::new(self.origin)
    }

    /// Returns the time from a scan of `beams` beams to the next scan, for a recording without stamps.
    pub(super) fn period(&self, beams: usize) -> Nanos {
        self.recording.contents().period(beams)
    }

    /// Returns whether the recording has stamps.
    pub(super) fn has_stamps(&self) -> bool {
        self.origin.is_some()
    }
}

/// Media time of consecutive telegrams, which never decreases. Within a run of the hub, media time follows the
/// monotonic clock. If the wall clock was set back between two runs, the media time of the second run continues at the
/// time of the last telegram.
pub(super) struct Timeline {
    /// The wall clock at media time 0.
    wall_zero_ns: i128,
    /// Run of the hub, and its monotonic clock at media time 0.
    run: Option<(u64, i128)>,
    last: Nanos,
}

impl Timeline {
    /// Creates the timeline of a recording whose media time begins at `origin`.
    pub(super) fn new(origin: Option<Origin>) -> Timeline {
        let run = origin.and_then(|origin| origin.run);
        Timeline {
            wall_zero_ns: i128::from(origin.map_or(0, |origin| origin.wall_ns)),
            run: run.map(|(boot, stamp_ns)| (boot, i128::from(stamp_ns))),
            last: 0,
        }
    }

    /// Returns the media time of a sample with this `header`, which another program than the hub published. The stamp
    /// of the sample is by the same clock as the stamps of the preceding telegrams in the recording. Returns `None` if
    /// the sample is before the first telegram. Also returns `None` if the machine was restarted between the preceding
    /// telegram and the sample, because the new clock is known only from the next telegram on.
    pub(super) fn media_of_sample(&self, header: &Header) -> Option<Nanos> {
        let by_wall = i128::from(header.wall_ns) - self.wall_zero_ns;
        let by_stamp = self.run.map(|(_, zero_ns)| i128::from(header.stamp_first_ns) - zero_ns);
        let media = Nanos::try_from(by_stamp.unwrap_or(by_wall)).ok()?;
        (media.saturating_add(MAX_GAP) >= self.last).then_some(media)
    }

    /// Returns the media time of the next `frame`.
    pub(super) fn media(&mut self, frame: &Frame) -> Nanos {
        if let Some(scanner_ns) = frame.scanner_ns {
            self.last = self.last.max(scanner_ns);
            return self.last;
        }
        let media = match (frame.header, self.run) {
            (Some(header), Some((boot, zero_ns))) if boot == header.boot => {
                i128::from(header.stamp_first_ns) - zero_ns
            }
            (header, _) => {
                let media = self.by_wall_clock(frame);
                self.run = header.map(|header| (header.boot, i128::from(header.stamp_first_ns) - media));
                media
            }
        };
        self.last = self.last.max(Nanos::try_from(media).unwrap_or(self.last));
        self.last
    }

    /// Advances by `period`, for a frame without a time.
    pub(super) fn advance(&mut self, period: Nanos) {
        self.last = self.last.saturating_add(period);
    }

    fn by_wall_clock(&mut self, frame: &Frame) -> i128 {
        let last = i128::from(self.last);
        let Some(wall_ns) = frame.wall_ns.map(i128::from) else { return last };
        if wall_ns - self.wall_zero_ns + i128::from(MAX_GAP) < last {
            self.wall_zero_ns = wall_ns - last;
        }
        last.max(wall_ns - self.wall_zero_ns)
    }
}

impl Origin {
    fn of(frame: &Frame) -> Option<Origin> {
        let run = frame.header.map(|header| (header.boot, header.stamp_first_ns));
        Some(Origin { wall_ns: frame.wall_ns?, run })
    }

    /// Returns the earlier of `self` and `other`: within one run by the monotonic clock, otherwise by the wall clock.
    pub(crate) fn earlier(self, other: Origin) -> Origin {
        let is_earlier = match (self.run, other.run) {
            (Some((boot, stamp_ns)), Some((same, other_ns))) if boot == same => stamp_ns <= other_ns,
            _ => self.wall_ns <= other.wall_ns,
        };
        if is_earlier { self } else { other }
    }
}

/// Returns the family of the scanner: the family of `link`, or the family of `recording` if the link has none. If both
/// have a family, the two must be the same.
fn check_family(recording: &Recording, link: &Link) -> Result<Family, Failure> {
    let (set, recorded) = (link.family(), recording.family());
    if let Some(family) = set.or(recorded)
        && (recording.contents().telegrams == 0 || recorded == Some(family))
    {
        return Ok(family);
    }
    let (path, number) = (recording.path().display(), recording.contents().family);
    let Some(family) = recording.family() else {
        let message = format!("recording {path} has a scanner of family number {number}");
        let hint = "a later version of scanhub recorded it: replay it with that";
        return Err(Failure::new(Kind::Input, message, hint));
    };
    let message = format!(
        "recording {path} has a scanner of family {}, and link {} is of family {}",
        family.name(),
        link.name,
        set.map_or("auto", Family::name)
    );
    let hint = format!("set link.{}.family = \"{}\"", link.name, family.name());
    Err(Failure::new(Kind::Configuration, message, hint))
}

/// Logs that neither the recording nor the configuration has the measuring mode, so that a default is used.
fn log_mode(recording: &Recording, link: &Link) {
    let contents = recording.contents();
    if contents.mode.is_none()
        && configured_mode(link).is_none()
        && contents.scans > 0
        && contents.readable_mode().is_some()
    {
        let name = &link.name;
        tracing::info!(
            "{name}: the recording does not contain a measuring mode, and no value has more than 13 bits: read as ranges of 13"
        );
    }
}

/// Logs the damage of a recording.
pub(crate) fn log_damage(recording: &Recording) {
    let damage = recording.contents().damage;
    if !damage.is_none() {
        tracing::warn!("{}: missing: {damage}", recording.path().display());
    }
}

/// Logs how the ranges of a CARMEN log are read, and which ranges cannot be encoded.
fn log_encoding(recording: &Recording, name: &str) {
    let contents = recording.contents();
    let Some(encoding) = recording.encoding().filter(|_| contents.form == Form::Carmen) else { return };
    tracing::info!("{name}: a CARMEN log, read as {encoding}");
    if !contents.unencodable.is_none() {
        tracing::warn!("{name}: {}", contents.unencodable);
    }
}

/// Returns whether `header` belongs to the first telegram of a hub. A converted stream does not come from a hub, so it
/// has no such telegram.
fn is_first(header: &Header) -> bool {
    header.seq == 0 && header.hub_pid != 0
}

/// Returns the number of the configured measuring mode.
fn configured_mode(link: &Link) -> Option<u8> {
    link.scanner.settings.mode_number
}

/// Number of telegrams within which a hub that found a streaming scanner has requested its mode.
const MAX_TELEGRAMS_TO_MODE: usize = 500;

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Nanos = 1_000 * scanhub_schema::MILLIS;

    fn frame(wall_s: u64, header: Option<Header>) -> Frame {
        Frame { wall_ns: Some(wall_s * SECOND), header, ..Frame::default() }
    }

    /// Media times, in seconds.
    fn medias(frames: &[Frame]) -> Vec<u64> {
        let mut timeline = Timeline::new(Origin::of(&frames[0]));
        frames.iter().map(|frame| timeline.media(frame) / SECOND).collect()
    }

    #[test]
    fn monotonic_clock_counts_when_the_wall_clock_was_set() {
        let header =
            |boot, stamp_s: u64| Some(Header { boot, stamp_first_ns: stamp_s * SECOND, ..Header::default() });
        let frames = [
            frame(5000, header(1, 100)),
            frame(9000, header(1, 101)),
            // In the second run, the wall clock is right again.
            frame(5003, header(2, 7)),
            frame(5004, header(2, 8)),
            // Within the second run, the wall clock is set back.
            frame(1000, header(2, 9)),
            // The third run is before all others by its wall clock.
            frame(10, header(3, 50)),
            frame(11, header(3, 51)),
            frame(1, header(3, 50)),
        ];
        assert_eq!(medias(&frames), [0, 1, 3, 4, 5, 5, 6, 6]);
    }

    #[test]
    fn mount_angles_are_timed_by_preceding_telegrams() {
        let header = |boot, wall_s: u64, stamp_s: u64| Header {
            boot,
            wall_ns: wall_s * SECOND,
            stamp_first_ns: stamp_s * SECOND,
            ..Header::default()
        };
        let telegram = |boot, wall_s, stamp_s| frame(wall_s, Some(header(boot, wall_s, stamp_s)));
        let first = telegram(1, 5000, 100);
        let mut timeline = Timeline::new(Origin::of(&first));
        let angle = |timeline: &Timeline, wall_s, stamp_s| {
            timeline.media_of_sample(&header(9, wall_s, stamp_s)).map(|media| media / SECOND)
        };
        assert_eq!(angle(&timeline, 4999, 99), None, "before the first telegram");
        timeline.media(&first);
        assert_eq!(angle(&timeline, 5003, 103), Some(3));
        assert_eq!(angle(&timeline, 9003, 103), Some(3), "the wall clock was set");
        timeline.media(&telegram(1, 9020, 120));
        assert_eq!(angle(&timeline, 9021, 121), Some(21));
        assert_eq!(
            angle(&timeline, 9060, 7),
            None,
            "the machine was restarted, and its hub has no scans yet"
        );
        timeline.media(&telegram(2, 9061, 8));
        assert_eq!(angle(&timeline, 9062, 9), Some(4062), "by the wall clock of the next hub");
    }

    #[test]
    fn log_continues_after_its_clock_was_set_back() {
        let walls = [5000, 5001, 5000, 5002, 10, 11, 12, 5000];
        let frames = walls.map(|wall_s| frame(wall_s, None));
        assert_eq!(medias(&frames), [0, 1, 1, 2, 2, 3, 4, 4992]);
    }
}
