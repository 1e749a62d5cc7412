//! A link whose other end is a recording: its bytes take the way that a line's bytes take, at the pace of its stamps,
//! else of the scans, or as fast as they can be read. Nobody hears what the hub would say, so nothing is asked.

use std::io::{self, Read};
use std::iter::Peekable;
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
    /// How its values are split; one of which nobody says so is read as ranges of 13 bits.
    mode: Mode,
}

enum Bytes {
    /// As they came down a line, without stamps.
    Stream(Box<dyn Read + Send>),
    /// Telegram by telegram, with stamps where the recording has them.
    Frames {
        frames: Peekable<Box<dyn Iterator<Item = Frame> + Send>>,
        /// Of the telegram that was begun.
        rest: Vec<u8>,
    },
}

/// When a telegram came, as the recording has it.
struct Stamp {
    wall_ns: u64,
    /// When the one after it came.
    next_ns: Option<u64>,
}

impl Recorded {
    /// Opens the recording at `path`; metres become units of `link`'s.
    ///
    /// [`schema::Kind::Configuration`] if it cannot be read. A file without a telegram is a line that only brings noise.
    pub(crate) fn open(path: &Path, link: &Link) -> Result<Recorded, Failure> {
        let mut recording = Recording::open(path)?;
        // Of several sensors the one whose name the link has.
        if recording.contents().sensors.len() > 1 {
            recording = recording.of(&link.name)?;
        }
        let mode = recording.contents().mode.or(link.mode).unwrap_or(Mode(0));
        let encoding = Encoding { unit: link.unit.unwrap_or(Unit::Mm), mode };
        let bytes = match recording.contents().form {
            Form::Telegrams => Bytes::Stream(recording.bytes()?),
            Form::Carmen | Form::Mcap => {
                let frames: Box<dyn Iterator<Item = Frame> + Send> = recording.telegrams(encoding)?;
                Bytes::Frames { frames: frames.peekable(), rest: Vec::new() }
            }
        };
        Ok(Recorded { bytes, mode })
    }

    /// Writes the next bytes into `room`: how many, none at the end, and the stamp of a telegram that begins with them,
    /// if it has one.
    fn read(&mut self, room: &mut [u8]) -> (usize, Option<Stamp>) {
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
                    let next_ns = frames.peek().and_then(|next| next.wall_ns);
                    stamp = frame.wall_ns.map(|wall_ns| Stamp { wall_ns, next_ns });
                    *rest = frame.telegram;
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
    let mut last_ns = None;
    // From this scan to the next, as far as it is kept: so long nothing newer can be known.
    let mut gap_ns = 0;
    link.show(Some(session), State::Streaming, "");
    loop {
        let (len, stamp) = recorded.read(session.spare());
        if let Some(Stamp { wall_ns, next_ns }) = stamp {
            due += gap(last_ns.unwrap_or(wall_ns), wall_ns);
            gap_ns = next_ns.filter(|_| paced).map_or(0, |next_ns| gap(wall_ns, next_ns));
            last_ns = Some(wall_ns);
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
            if is_scan && paced && last_ns.is_none() {
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

/// How long the listeners wait.
fn gap(from_ns: u64, to_ns: u64) -> Nanos {
    to_ns.saturating_sub(from_ns).min(LONGEST_GAP)
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
