//! A link whose other end is a recording: its bytes take the way that a line's bytes take, at the pace of its stamps,
//! else of the scans, or as fast as they can be read. Nobody hears what the hub would say, so nothing is asked.

use std::io::{self, Read};
use std::path::Path;

use lms::measured::MEASURED;
use lms::session::Output;
use lms::variant::{Baud, Mode, Unit, Variant};
use lms::{Nanos, Session};
use recording::{Encoding, Form, Frame, Recording};
use schema::{Failure, State, Wake};

use crate::clock;
use crate::config::Link;
use crate::control::Flow;
use crate::link::{LinkThread, Woken};
use crate::scanner;

/// A recording as a line's bytes.
pub(crate) struct Recorded {
    bytes: Bytes,
    /// How its values are split; one that does not say so is read as ranges of 13 bits.
    mode: Mode,
}

enum Bytes {
    /// As they came down a line, without stamps.
    Stream(Box<dyn Read + Send>),
    /// Telegram by telegram, with stamps where the recording has them.
    Frames {
        frames: Box<dyn Iterator<Item = Frame> + Send>,
        /// Of the telegram that was begun.
        rest: Vec<u8>,
    },
}

impl Recorded {
    /// Opens the recording at `path`; metres become units of `link`'s.
    ///
    /// [`schema::Kind::Configuration`] if it cannot be read. A file without a telegram is a line that only brings noise.
    pub(crate) fn open(path: &Path, link: &Link) -> Result<Recorded, Failure> {
        let recording = Recording::open(path)?;
        let mode = recording.contents().mode.unwrap_or(Mode(0));
        let encoding = Encoding { unit: link.unit.unwrap_or(Unit::Mm), mode };
        let bytes = match recording.contents().form {
            Form::Telegrams => Bytes::Stream(recording.bytes()?),
            Form::Carmen => Bytes::Frames { frames: recording.telegrams(encoding)?, rest: Vec::new() },
        };
        Ok(Recorded { bytes, mode })
    }

    /// Writes the next bytes into `room`: how many, none at the end, and the stamp of a telegram that begins with them,
    /// if it has one.
    fn read(&mut self, room: &mut [u8]) -> (usize, Option<u64>) {
        match &mut self.bytes {
            Bytes::Stream(stream) => loop {
                let piece = room.len().min(PIECE);
                match stream.read(&mut room[..piece]) {
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(error) => {
                        tracing::warn!(%error, "the recording became unreadable");
                        return (0, None);
                    }
                    Ok(len) => return (len, None),
                }
            },
            Bytes::Frames { frames, rest } => {
                let mut stamp = None;
                if rest.is_empty()
                    && let Some(frame) = frames.next()
                {
                    (*rest, stamp) = (frame.telegram, frame.wall_ns);
                }
                let len = rest.len().min(room.len());
                room[..len].copy_from_slice(&rest[..len]);
                rest.drain(..len);
                (len, stamp)
            }
        }
    }
}

/// Plays `recorded` through `session` into the topics of `link`, then stays silent until the hub ends.
pub(crate) fn play(link: &mut LinkThread<'_>, session: &mut Session, mut recorded: Recorded, paced: bool) {
    let mut due = clock::now();
    let mut last_stamp = None;
    // Between the scans of the recording, as far as it is kept.
    let mut gap_ns = 0;
    loop {
        let (len, stamp) = recorded.read(session.spare());
        if let Some(stamp) = stamp {
            let gap = stamp.saturating_sub(last_stamp.unwrap_or(stamp)).min(LONGEST_GAP);
            due += gap;
            gap_ns = if paced { gap } else { 0 };
            last_stamp = Some(stamp);
        }
        // Also where nothing is waited for, the hub's end is looked for.
        if rest(link, if paced { due } else { 0 }) == Woken::Stop {
            return;
        }
        let now = clock::now();
        session.commit(now, len);
        if len == 0 {
            // Nothing will come that could refute a telegram held back.
            session.handle_timeout(now + lms::framer::VETO_HOLD);
        }
        while let Output::Telegram(received) = session.poll_output() {
            let is_scan = received.telegram.command() == MEASURED;
            link.publish(&received, Some(recorded.mode), (gap_ns / 1000) as u32);
            link.wake(Wake::Telegram);
            if is_scan && paced && last_stamp.is_none() {
                due += period(session);
                if rest(link, due) == Woken::Stop {
                    return;
                }
            }
        }
        link.show(Some(session), State::Streaming, "");
        if len == 0 {
            break;
        }
    }
    while rest(link, clock::now() + IDLE) != Woken::Stop {
        link.show(Some(session), State::Silent, "the recording is at its end");
    }
}

/// Waits until `until` or the hub's end.
fn rest(link: &mut LinkThread<'_>, until: Nanos) -> Woken {
    loop {
        match link.wait(None, until) {
            Woken::Order => link.obey(Flow::Recording),
            woken => return woken,
        }
    }
}

fn period(session: &Session) -> Nanos {
    let variant = session.sensor().variant.or(Some(Variant::HALF));
    Nanos::from(scanner::period_us(variant, Baud::B500000.rate())) * 1000
}

/// Bytes of a stream given to the session at a time: less than a telegram, so that stamps stay near.
const PIECE: usize = 128;
/// Between two statuses of a recording that is at its end.
const IDLE: Nanos = 100 * lms::MILLIS;
/// A recording that was interrupted does not keep its listeners waiting for longer.
const LONGEST_GAP: Nanos = 10_000 * lms::MILLIS;
