//! A link whose other end is a recording: its bytes take the way that a line's bytes take, at the pace of the scans or
//! as fast as they can be read. Nobody hears what the hub would say, so nothing is asked.

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
use crate::link::{LinkThread, Woken};
use crate::scanner;

/// A recording as a line's bytes.
pub(crate) struct Recorded {
    bytes: Box<dyn Read + Send>,
    /// How its values are split; one that does not say so is read as ranges of 13 bits.
    mode: Mode,
}

impl Recorded {
    /// Opens the recording at `path`; metres become units of `link`'s.
    ///
    /// [`schema::Kind::Configuration`] if it cannot be read or is none.
    pub(crate) fn open(path: &Path, link: &Link) -> Result<Recorded, Failure> {
        let recording = Recording::open(path)?;
        let mode = recording.contents().mode.unwrap_or(Mode(0));
        let encoding = Encoding { unit: link.unit.unwrap_or(Unit::Mm), mode };
        let bytes = match recording.contents().form {
            Form::Telegrams => recording.bytes()?,
            Form::Carmen => Box::new(Telegrams { frames: recording.telegrams(encoding)?, rest: Vec::new() }),
        };
        Ok(Recorded { bytes, mode })
    }
}

/// Plays `recorded` through `session` into the topics of `link`, then stays silent until the hub ends.
pub(crate) fn play(link: &mut LinkThread<'_>, session: &mut Session, mut recorded: Recorded, paced: bool) {
    let mut due = clock::now();
    loop {
        let spare = session.spare();
        let room = spare.len().min(PIECE);
        let len = match recorded.bytes.read(&mut spare[..room]) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(error) => {
                tracing::warn!(%error, "the recording became unreadable");
                0
            }
            Ok(len) => len,
        };
        let now = clock::now();
        session.commit(now, len);
        if len == 0 {
            // Nothing will come that could refute a telegram held back.
            session.handle_timeout(now + lms::framer::VETO_HOLD);
        }
        while let Output::Telegram(received) = session.poll_output() {
            let is_scan = received.telegram.command() == MEASURED;
            link.publish(&received, Some(recorded.mode));
            link.wake(Wake::Telegram);
            if is_scan && paced {
                due += period(session);
                if link.wait(None, due) == Woken::Stop {
                    return;
                }
            }
        }
        link.show(Some(session), State::Streaming, "");
        if len == 0 {
            break;
        }
        if !paced && link.wait(None, 0) == Woken::Stop {
            return;
        }
    }
    while link.wait(None, clock::now() + IDLE) != Woken::Stop {
        link.show(Some(session), State::Silent, "the recording is at its end");
    }
}

fn period(session: &Session) -> Nanos {
    let variant = session.sensor().variant.or(Some(Variant::HALF));
    Nanos::from(scanner::period_us(variant, Baud::B500000.rate())) * 1000
}

/// Frames one behind the other.
struct Telegrams {
    frames: Box<dyn Iterator<Item = Frame> + Send>,
    rest: Vec<u8>,
}

impl Read for Telegrams {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.rest.is_empty() {
            self.rest = self.frames.next().map_or(Vec::new(), |frame| frame.telegram);
        }
        let len = self.rest.len().min(buffer.len());
        buffer[..len].copy_from_slice(&self.rest[..len]);
        self.rest.drain(..len);
        Ok(len)
    }
}

/// Bytes given to the session at a time: less than a telegram, so that stamps stay near.
const PIECE: usize = 128;
/// Between two statuses of a recording that is at its end.
const IDLE: Nanos = 100 * lms::MILLIS;
