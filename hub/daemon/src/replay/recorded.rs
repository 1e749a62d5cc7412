//! A recording as a link plays it: what it is made of, and at which media time each of its telegrams stands. Refuses to
//! know when that is played.

use std::io::{self, Read};
use std::path::Path;

use config::Link;
use recording::{Encoding, Form, Frame, Recording};
use scanhub_drivers::{Settings, features};
use schema::{Failure, Family, Header, Kind, Nanos};

use super::MAX_GAP;

/// A recording of one sensor.
pub(crate) enum Recorded {
    /// Bytes as they came down a line, without stamps.
    Stream(Stream),
    /// Telegrams, or packets of a rotating scanner.
    Frames(Frames),
}

/// A stream of telegrams, with whatever came between them.
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
    /// Whether they are telegrams that are a scan or a reply by themselves, and no packets.
    pub(super) is_whole: bool,
    /// Of a log the metres, of others nothing.
    encoding: Encoding,
    /// Number of the measuring mode.
    mode: Option<u8>,
    origin: Option<Origin>,
    /// At its beginning it is not known how values are split: the hub that recorded it learned that from a telegram.
    is_told_later: bool,
}

/// The first telegram of a recording of all its sensors: media time 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Origin {
    /// By the wall clock, ns since 1970.
    pub(crate) wall_ns: u64,
    /// By the monotonic clock of a life of a hub: wall clocks are set now and then.
    life: Option<(u64, Nanos)>,
}

impl Recorded {
    /// Opens the recording at `path`: of several sensors the one that has the name of `link`.
    ///
    /// [`Kind::Input`] if it cannot be read, [`Kind::Configuration`] if it has other sensors. A file without a telegram
    /// is a line that only brings noise.
    pub(crate) fn open(path: &Path, link: &Link) -> Result<Recorded, Failure> {
        let recording = Recording::open_line(path, link.family())?;
        tell_of_damage(&recording);
        if recording.contents().sensors.len() > 1 {
            // Its name is configured, and not a word of somebody who asks.
            let part = recording.of(&link.name);
            let part = part.map_err(|failure| Failure { kind: Kind::Configuration, ..failure })?;
            return Recorded::new(part, link);
        }
        Recorded::new(recording, link)
    }

    /// `recording`, which is of one sensor, as the link of `link`; says how the ranges of a log are read.
    ///
    /// [`Kind::Input`] if it is of a family that this version does not know, [`Kind::Configuration`] if it is not of
    /// the link's.
    pub(crate) fn new(recording: Recording, link: &Link) -> Result<Recorded, Failure> {
        let family = check_family(&recording, link)?;
        if !features(family).has_whole_telegrams {
            let mut frames = Frames {
                recording,
                family,
                is_whole: false,
                encoding: Encoding::default(),
                mode: None,
                origin: None,
                is_told_later: false,
            };
            frames.origin = frames.read()?.next().as_ref().and_then(Origin::of);
            return Ok(Recorded::Frames(frames));
        }
        tell_of_log(&recording, &link.name);
        let mode = recording.contents().mode_or(configured_mode(link));
        tell_of_mode(&recording, link);
        if recording.contents().form == Form::Telegrams {
            return Ok(Recorded::Stream(Stream { recording, family, mode }));
        }
        let encoding = recording.contents().encoding(mode);
        let mut frames =
            Frames { recording, family, is_whole: true, encoding, mode, origin: None, is_told_later: false };
        let mut first = frames.read()?.take(ASKED_WITHIN).peekable();
        frames.origin = first.peek().and_then(Origin::of);
        let begin = first.peek().and_then(|frame| frame.header).filter(is_first);
        let is_open = begin.is_some_and(|header| frames.recording.understood(header.boot).is_none());
        frames.is_told_later = is_open && first.any(|frame| frame.tells_mode());
        Ok(Recorded::Frames(frames))
    }

    /// Returns the family of the scanner.
    pub(super) fn family(&self) -> Family {
        match self {
            Recorded::Stream(stream) => stream.family,
            Recorded::Frames(frames) => frames.family,
        }
    }

    /// Returns the sensor's type, if a status of the recording has it. The recording may also contain a scanner of another
    /// family, which is not played.
    pub(super) fn sensor_type(&self) -> Option<&str> {
        let (Recorded::Stream(Stream { recording, family, .. })
        | Recorded::Frames(Frames { recording, family, .. })) = self;
        let (number, name) = recording.contents().sensor_type.as_ref()?;
        (*number == *family as u8).then_some(name.as_str())
    }

    /// Where its media time begins, of what has stamps.
    pub(crate) fn origin(&self) -> Option<Origin> {
        match self {
            Recorded::Stream(_) => None,
            Recorded::Frames(frames) => frames.origin,
        }
    }

    /// Lets its media time begin at `origin`, at which that of others begins.
    pub(crate) fn set_origin(&mut self, origin: Origin) {
        if let Recorded::Frames(frames) = self {
            frames.origin = Some(origin);
        }
    }

    /// Wall clock of its beginning.
    pub(super) fn begin_ns(&self) -> Option<u64> {
        self.origin().map(|origin| origin.wall_ns)
    }

    /// Returns the message why no scan can be read; an empty string if they can.
    pub(super) fn problem(&self, name: &str) -> String {
        let (Recorded::Stream(Stream { mode, recording, .. })
        | Recorded::Frames(Frames { mode, recording, .. })) = self;
        if recording.contents().telegrams == 0 {
            return "there is no telegram in the recording".to_owned();
        }
        if mode.is_some() || recording.contents().scans == 0 {
            return String::new();
        }
        format!("the recording does not contain its measuring mode: no scans; set link.{name}.mode")
    }

    /// Media time of its end, as far as that is known.
    pub(crate) fn length(&self) -> Option<Nanos> {
        let (Recorded::Stream(Stream { recording, .. }) | Recorded::Frames(Frames { recording, .. })) = self;
        let contents = recording.contents();
        match (contents.span, self.begin_ns()) {
            (Some((_, last_ns)), Some(begin_ns)) => Some(last_ns.saturating_sub(begin_ns)),
            _ if contents.scanner_ns.is_some() => contents.scanner_ns,
            _ => Some(contents.scans.saturating_sub(1) * contents.period(0)),
        }
    }

    /// Media time of its last telegram, for which all of it is read where it has stamps.
    pub(crate) fn end(&self) -> Result<Nanos, Failure> {
        match self {
            Recorded::Frames(frames) if frames.has_stamps() => {
                let mut timeline = frames.timeline();
                Ok(frames.read()?.map(|frame| timeline.media(&frame)).last().unwrap_or(0))
            }
            _ => Ok(self.length().unwrap_or(0)),
        }
    }
}

impl Stream {
    /// Whether there is any telegram in it.
    pub(super) fn has_telegrams(&self) -> bool {
        self.recording.contents().telegrams > 0
    }

    /// Its bytes from the beginning.
    pub(super) fn bytes(&self) -> Result<Box<dyn Read + Send>, Failure> {
        self.recording.bytes()
    }

    /// Returns the time from a scan of `beams` to the next one.
    pub(super) fn period(&self, beams: usize) -> Nanos {
        self.recording.contents().period(beams)
    }
}

/// Reads into `room`; none at the end, which is also where the file has become unreadable.
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
    /// Its telegrams from the beginning.
    pub(super) fn read(&self) -> Result<Box<dyn Iterator<Item = Frame> + Send>, Failure> {
        self.recording.telegrams(self.encoding)
    }

    /// Returns the settings of a session that reads it for `link`. Settings that are not configured come from the recording.
    pub(super) fn settings(&self, link: &Link) -> Settings {
        let mode_number = self.mode.filter(|_| !self.is_told_later);
        let mut settings = Settings { mode_number, ..link.settings() };
        if !self.is_whole && link.scanner.is_auto() {
            let model = self.recording.model().ok().flatten();
            settings.model = settings.model.or(model.map(|model| model.name));
            settings.mode = settings.mode.or(self.recording.contents().way);
            settings.beams = settings.beams.or(self.recording.beams());
        }
        settings
    }

    /// Number of the first telegram whose values the hub could read, in the life that begins with that of `header`.
    pub(super) fn understood_from(&self, header: &Header) -> u64 {
        let understood = is_first(header).then(|| self.recording.understood(header.boot));
        understood.flatten().unwrap_or(0)
    }

    /// Media time, from the beginning.
    pub(super) fn timeline(&self) -> Timeline {
        Timeline::new(self.origin)
    }

    /// Returns the time from a scan of `beams` to the next one, where there are no stamps.
    pub(super) fn period(&self, beams: usize) -> Nanos {
        self.recording.contents().period(beams)
    }

    /// Whether it has stamps at all.
    pub(super) fn has_stamps(&self) -> bool {
        self.origin.is_some()
    }
}

/// Media time of one telegram after the other: it never goes back. A wall clock that is set while a hub lives does not
/// matter; one that was set back since goes on where the telegram before was.
pub(super) struct Timeline {
    /// The wall clock at media time 0.
    wall_zero_ns: i128,
    /// A life of a hub, and its monotonic clock at media time 0.
    life: Option<(u64, i128)>,
    last: Nanos,
}

impl Timeline {
    /// Creates one for a recording whose media time begins at `origin`.
    pub(super) fn new(origin: Option<Origin>) -> Timeline {
        let life = origin.and_then(|origin| origin.life);
        Timeline {
            wall_zero_ns: i128::from(origin.map_or(0, |origin| origin.wall_ns)),
            life: life.map(|(boot, stamp_ns)| (boot, i128::from(stamp_ns))),
            last: 0,
        }
    }

    /// Returns the media time of a sample of another program with this `header`. Its stamp and those of the telegrams before it
    /// in the recording are from the same clock. Returns `None` if it is before the first telegram, or if the machine was
    /// restarted after the last one: scans follow only when the hub of the new start has sent a telegram.
    pub(super) fn media_beside(&self, header: &Header) -> Option<Nanos> {
        let by_wall = i128::from(header.wall_ns) - self.wall_zero_ns;
        let by_stamp = self.life.map(|(_, zero_ns)| i128::from(header.stamp_first_ns) - zero_ns);
        let media = Nanos::try_from(by_stamp.unwrap_or(by_wall)).ok()?;
        (media.saturating_add(MAX_GAP) >= self.last).then_some(media)
    }

    /// The media time of `frame`, which comes next.
    pub(super) fn media(&mut self, frame: &Frame) -> Nanos {
        if let Some(scanner_ns) = frame.scanner_ns {
            self.last = self.last.max(scanner_ns);
            return self.last;
        }
        let media = match (frame.header, self.life) {
            (Some(header), Some((boot, zero_ns))) if boot == header.boot => {
                i128::from(header.stamp_first_ns) - zero_ns
            }
            (header, _) => {
                let media = self.by_wall_clock(frame);
                self.life = header.map(|header| (header.boot, i128::from(header.stamp_first_ns) - media));
                media
            }
        };
        self.last = self.last.max(Nanos::try_from(media).unwrap_or(self.last));
        self.last
    }

    /// Something that took so long has no time of its own.
    pub(super) fn pass(&mut self, period: Nanos) {
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
        let life = frame.header.map(|header| (header.boot, header.stamp_first_ns));
        Some(Origin { wall_ns: frame.wall_ns?, life })
    }

    /// The earlier one of both.
    pub(crate) fn earlier(self, other: Origin) -> Origin {
        let is_earlier = match (self.life, other.life) {
            (Some((boot, stamp_ns)), Some((same, other_ns))) if boot == same => stamp_ns <= other_ns,
            _ => self.wall_ns <= other.wall_ns,
        };
        if is_earlier { self } else { other }
    }
}

/// Returns the family of the scanner: that of `link`, or that of `recording` if the link has none. They must be the
/// same.
fn check_family(recording: &Recording, link: &Link) -> Result<Family, Failure> {
    let (set, recorded) = (link.family(), recording.family());
    if let Some(family) = set.or(recorded)
        && (recording.contents().telegrams == 0 || recorded == Some(family))
    {
        return Ok(family);
    }
    let (place, number) = (recording.path().display(), recording.contents().family);
    let Some(family) = recording.family() else {
        let message = format!("recording {place} is of a scanner of family number {number}");
        let hint = "a later version of scanhub recorded it: replay it with that";
        return Err(Failure::new(Kind::Input, message, hint));
    };
    let message = format!(
        "recording {place} is of a scanner of family {}, and link {} is of family {}",
        family.name(),
        link.name,
        set.map_or("auto", Family::name)
    );
    let hint = format!("set link.{}.family = \"{}\"", link.name, family.name());
    Err(Failure::new(Kind::Configuration, message, hint))
}

/// That the values are read in a way which neither the recording nor the configuration tells.
fn tell_of_mode(recording: &Recording, link: &Link) {
    let contents = recording.contents();
    if contents.mode.is_none()
        && configured_mode(link).is_none()
        && contents.scans > 0
        && contents.readable().is_some()
    {
        let name = &link.name;
        tracing::info!(
            "{name}: the recording does not contain a measuring mode, and no value has more than 13 bits: read as ranges of 13"
        );
    }
}

/// What is missing of it, if anything is.
pub(crate) fn tell_of_damage(recording: &Recording) {
    let damage = recording.contents().damage;
    if !damage.is_none() {
        tracing::warn!("{}: missing: {damage}", recording.path().display());
    }
}

/// How the ranges of a log are read, and what of them goes into no value.
fn tell_of_log(recording: &Recording, name: &str) {
    let contents = recording.contents();
    let Some(encoding) = recording.encoding().filter(|_| contents.form == Form::Carmen) else { return };
    tracing::info!("{name}: a CARMEN log, read as {encoding}");
    if !contents.unfit.is_none() {
        tracing::warn!("{name}: {}", contents.unfit);
    }
}

/// Whether it is of the first telegram that a hub had: who converts a stream is no hub.
fn is_first(header: &Header) -> bool {
    header.seq == 0 && header.hub_pid != 0
}

/// Returns the number of the configured measuring mode.
fn configured_mode(link: &Link) -> Option<u8> {
    link.scanner.settings.mode_number
}

/// A hub that found a sensor streaming has asked it within so many telegrams.
const ASKED_WITHIN: usize = 500;

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Nanos = 1_000 * schema::MILLIS;

    fn frame(wall_s: u64, header: Option<Header>) -> Frame {
        Frame { wall_ns: Some(wall_s * SECOND), header, ..Frame::default() }
    }

    /// Media times, in seconds.
    fn medias(frames: &[Frame]) -> Vec<u64> {
        let mut timeline = Timeline::new(Origin::of(&frames[0]));
        frames.iter().map(|frame| timeline.media(frame) / SECOND).collect()
    }

    #[test]
    fn where_the_wall_clock_was_set_the_monotonic_one_goes_on() {
        let header =
            |boot, stamp_s: u64| Some(Header { boot, stamp_first_ns: stamp_s * SECOND, ..Header::default() });
        let frames = [
            frame(5000, header(1, 100)),
            frame(9000, header(1, 101)),
            // Another life, and the clock is right again.
            frame(5003, header(2, 7)),
            frame(5004, header(2, 8)),
            // And is set within it.
            frame(1000, header(2, 9)),
            // A third one, before all others.
            frame(10, header(3, 50)),
            frame(11, header(3, 51)),
            frame(1, header(3, 50)),
        ];
        assert_eq!(medias(&frames), [0, 1, 3, 4, 5, 5, 6, 6]);
    }

    #[test]
    fn angles_follow_the_stamps_of_the_telegrams_before_them() {
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
            timeline.media_beside(&header(9, wall_s, stamp_s)).map(|media| media / SECOND)
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
    fn a_log_whose_clock_was_set_back_goes_on() {
        let walls = [5000, 5001, 5000, 5002, 10, 11, 12, 5000];
        let frames = walls.map(|wall_s| frame(wall_s, None));
        assert_eq!(medias(&frames), [0, 1, 1, 2, 2, 3, 4, 4992]);
    }
}
