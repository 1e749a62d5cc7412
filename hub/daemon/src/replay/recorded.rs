//! A recording as a link plays it: what it is made of, and at which media time each of its telegrams stands. Refuses to
//! know when that is played.

use std::io::{self, Read};
use std::path::Path;

use lms::Nanos;
use lms::reply::Reply;
use lms::telegram::Telegram;
use lms::variant::{Mode, Unit, Variant};
use recording::{Encoding, Form, Frame, Recording};
use schema::Failure;

use super::period;
use crate::config::Link;

/// A recording of one sensor.
pub(crate) enum Recorded {
    /// Bytes as they came down a line, without stamps.
    Stream(Stream),
    /// Telegram by telegram.
    Frames(Frames),
}

/// A stream of telegrams, with whatever came between them.
pub(crate) struct Stream {
    recording: Recording,
    pub(super) mode: Mode,
}

/// Telegrams that are known to be whole.
pub(crate) struct Frames {
    recording: Recording,
    encoding: Encoding,
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
    /// [`schema::Kind::Configuration`] if it cannot be read, or has other sensors. A file without a telegram is a line
    /// that only brings noise.
    pub(crate) fn open(path: &Path, link: &Link) -> Result<Recorded, Failure> {
        let recording = Recording::open(path)?;
        if recording.contents().sensors.len() > 1 {
            return Recorded::new(recording.of(&link.name)?, link);
        }
        Recorded::new(recording, link)
    }

    /// `recording`, which is of one sensor; metres become units of `link`'s.
    pub(crate) fn new(recording: Recording, link: &Link) -> Result<Recorded, Failure> {
        let mode = recording.contents().mode.or(link.mode).unwrap_or(Mode(0));
        if recording.contents().form == Form::Telegrams {
            return Ok(Recorded::Stream(Stream { recording, mode }));
        }
        let encoding = Encoding { unit: link.unit.unwrap_or(Unit::Mm), mode };
        let mut frames = Frames { recording, encoding, origin: None, is_told_later: false };
        let mut first = frames.read()?.take(ASKED_WITHIN).peekable();
        frames.origin = first.peek().and_then(Origin::of);
        let is_first_of_life =
            first.peek().is_some_and(|frame| frame.header.is_some_and(|header| header.seq == 0));
        frames.is_told_later = is_first_of_life && first.any(|frame| told(&frame).is_some());
        Ok(Recorded::Frames(frames))
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

    /// Media time of its end, as far as that is known.
    pub(crate) fn length(&self) -> Option<Nanos> {
        let (Recorded::Stream(Stream { recording, .. }) | Recorded::Frames(Frames { recording, .. })) = self;
        let contents = recording.contents();
        match (contents.span, self.begin_ns()) {
            (Some((_, last_ns)), Some(begin_ns)) => Some(last_ns.saturating_sub(begin_ns)),
            _ => Some(contents.scans.saturating_sub(1) * period(contents.variant)),
        }
    }
}

impl Stream {
    /// Its bytes from the beginning.
    pub(super) fn bytes(&self) -> Result<Box<dyn Read + Send>, Failure> {
        self.recording.bytes()
    }

    pub(super) fn period(&self, variant: Option<Variant>) -> Nanos {
        period(variant.or(self.recording.contents().variant))
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

    /// How values are split, as it is known at the beginning.
    pub(super) fn first_mode(&self) -> Option<Mode> {
        (!self.is_told_later).then_some(self.encoding.mode)
    }

    /// The media time of `frame`, which comes after one of `last`, which was a scan or not.
    pub(super) fn media(&self, frame: &Frame, last: Nanos) -> Nanos {
        let Some(origin) = self.origin else { return last };
        let life = frame.header.map(|header| (header.boot, header.stamp_first_ns));
        let media = match (life, origin.life) {
            (Some((boot, stamp_ns)), Some((same, begin_ns))) if boot == same => {
                stamp_ns.checked_sub(begin_ns)
            }
            _ => frame.wall_ns.and_then(|wall_ns| wall_ns.checked_sub(origin.wall_ns)),
        };
        media.unwrap_or(last).max(last)
    }

    /// Whether it has stamps at all.
    pub(super) fn has_stamps(&self) -> bool {
        self.origin.is_some()
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

/// What `frame` tells of how values are split: of a sensor that gets its power, that this is not known any more.
pub(super) fn told(frame: &Frame) -> Option<Option<Mode>> {
    if frame.is_scan() {
        return None;
    }
    match Reply::decode(Telegram::check(&frame.telegram)?)? {
        Reply::Configuration(configuration) => Some(Some(configuration.mode())),
        Reply::Status(report) => Some(Some(report.mode())),
        Reply::PowerOn(_) => Some(None),
        _ => None,
    }
}

/// A hub that found a sensor streaming has asked it within so many telegrams.
const ASKED_WITHIN: usize = 500;
