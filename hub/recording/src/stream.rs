//! Readers of recorded bytes, with the sessions and framers of the hub. [`StreamReader`] reads a stream file: bytes as
//! they arrived on a line, without stamps. [`VirtualTime`] passes telegrams to a session at the times at which the hub
//! received them.

use std::io::{self, Read};
use std::path::Path;

use scanhub_drivers::line::{Action, Event, Protocol, ScannerSession as _};
use scanhub_drivers::lms::framer::{Framer, FramerEvent, VETO_HOLD_TIME};
use scanhub_drivers::recognize::framing_mode;
use scanhub_drivers::{Session, Settings, features};
use scanhub_schema::{Failure, Family, MILLIS, Nanos, line_time};

use crate::open::{is_truncation, reader, unreadable};
use crate::{Contents, Form, Frame};

/// Reader of the telegrams of an LMS or the packets of a rotating scanner from a stream. The reader counts the bytes
/// outside telegrams and packets.
pub(crate) struct StreamReader<R> {
    reader: R,
    framing: Framing,
    /// Number of bytes that were read.
    read_len: u64,
    /// Whether the end of the stream was reached.
    is_ended: bool,
}

enum Framing {
    Telegrams(Box<Framer>),
    Packets(Box<PacketReader>),
}

struct PacketReader {
    session: Session,
    family: Family,
    /// Time on the scanner's clock at the last packets.
    last: Option<Nanos>,
    /// Time since the first packets.
    elapsed: Nanos,
}

impl<R: Read> StreamReader<R> {
    /// Creates a reader of a stream of `family`. `head` has the first bytes of the stream, from which the framing mode
    /// of its packets is detected.
    pub(crate) fn new(family: Family, head: &[u8], reader: R) -> StreamReader<R> {
        let framing = if features(family).has_whole_telegrams {
            Framing::Telegrams(Box::default())
        } else {
            let mode = framing_mode(family, head);
            let settings = Settings { mode, fixed_rate: true, listen_only: true, ..Settings::default() };
            let session = Session::begin(family, &settings, 0);
            Framing::Packets(Box::new(PacketReader { session, family, last: None, elapsed: 0 }))
        };
        StreamReader { reader, framing, read_len: 0, is_ended: false }
    }

    /// Returns the number of bytes so far that are outside telegrams and packets. At the end of the stream, the number
    /// is complete.
    fn discarded(&self) -> u64 {
        let (discarded, buffered) = match &self.framing {
            Framing::Telegrams(framer) => (framer.counters().discarded, framer.buffered() as u64),
            Framing::Packets(packets) => {
                let stats = packets.session.stats();
                (stats.discarded, stats.buffered)
            }
        };
        discarded + if self.is_ended { buffered } else { 0 }
    }

    /// Returns the next telegram or the next packets; `None` at the end.
    ///
    /// # Errors
    ///
    /// Returns the error of the reader.
    pub(crate) fn next(&mut self) -> io::Result<Option<Frame>> {
        loop {
            let frame = match &mut self.framing {
                Framing::Telegrams(framer) => next_telegram(framer),
                Framing::Packets(packets) => packets.next(),
            };
            if frame.is_some() || self.is_ended {
                return Ok(frame);
            }
            let buffer = match &mut self.framing {
                Framing::Telegrams(framer) => framer.read_buffer(),
                Framing::Packets(packets) => packets.session.read_buffer(),
            };
            let len = match self.reader.read(buffer) {
                Ok(len) => len,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(error),
            };
            self.read_len += len as u64;
            self.is_ended = len == 0;
            match &mut self.framing {
                Framing::Telegrams(framer) if self.is_ended => framer.release(VETO_HOLD_TIME),
                Framing::Telegrams(framer) => framer.commit(len),
                Framing::Packets(packets) => {
                    packets.session.commit(0, len);
                    if self.is_ended {
                        // The session holds packets back until the following bytes confirm them. No bytes follow any
                        // more, so let the session release the packets.
                        packets.session.handle_timeout(IDLE_TIME);
                    }
                }
            }
        }
    }
}

fn next_telegram(framer: &mut Framer) -> Option<Frame> {
    loop {
        if let FramerEvent::Telegram(framed) = framer.poll()? {
            return Some(Frame { telegram: framed.telegram.bytes().to_vec(), ..Frame::default() });
        }
    }
}

impl PacketReader {
    fn next(&mut self) -> Option<Frame> {
        let (telegram, reasons) = loop {
            match self.session.poll_action() {
                Action::Event(Event::Telegram(received)) => {
                    break (received.bytes.to_vec(), received.reasons);
                }
                Action::Transmit { .. } => self.session.handle_transmitted(0),
                Action::Event(Event::Scan(_)) | Action::SetRate(_) | Action::SetDtr(_) => {}
                Action::SleepUntil(_) | Action::Wait { .. } => return None,
            }
        };
        let duration = line_time(telegram.len(), self.session.rate());
        let scanner_ns = Some(self.advance_clock(duration));
        Some(Frame { telegram, family: self.family as u8, scanner_ns, reasons, ..Frame::default() })
    }

    /// Returns the time from the first packets to the last packets. `duration` is the time that the last packets spent
    /// on the line. The result never decreases.
    fn advance_clock(&mut self, duration: Nanos) -> Nanos {
        let Some(at) = self.session.scanner_time() else {
            self.elapsed += duration;
            return self.elapsed;
        };
        self.elapsed += match self.last {
            None => 0,
            // If the scanner has restarted, its clock has gone back.
            Some(last) => at.checked_sub(last).unwrap_or(duration),
        };
        self.last = Some(at);
        self.elapsed
    }
}

/// Reads the stream of `family` at `path` to its end, and returns the contents. `head` has the first bytes of the
/// stream.
///
/// # Errors
///
/// Returns [`Kind::Input`](scanhub_schema::Kind::Input) if the stream cannot be read.
pub(crate) fn contents(path: &Path, family: Family, head: &[u8]) -> Result<Contents, Failure> {
    let mut stream = StreamReader::new(family, head, reader(path)?);
    let mut contents = Contents { form: Form::Telegrams, family: family as u8, ..Contents::default() };
    loop {
        match stream.next() {
            Ok(Some(frame)) => {
                contents.note(frame.family, &frame.telegram, None);
                contents.scanner_ns = frame.scanner_ns;
            }
            Ok(None) => break,
            Err(error) if is_truncation(&error) && contents.telegrams > 0 => {
                contents.damage.is_truncated = true;
                break;
            }
            Err(error) => return Err(unreadable(path, &error)),
        }
    }
    contents.bytes = stream.read_len;
    contents.damage.bytes = stream.discarded();
    Ok(contents)
}

/// Session in the time of a recording. The session receives each packet at the time at which the recorded hub received
/// it, and the timers of the session expire in between. The session therefore returns the same results as in that hub.
pub struct VirtualTime<S> {
    session: S,
    now: Nanos,
    /// Time of the session's next timeout.
    until: Nanos,
}

impl<S: Protocol> VirtualTime<S> {
    /// Creates the virtual time for `session`, which started at `now`.
    pub fn new(session: S, now: Nanos) -> VirtualTime<S> {
        VirtualTime { session, now, until: now }
    }

    /// Returns the session.
    pub fn session(&self) -> &S {
        &self.session
    }

    /// Returns the session, to change it.
    pub fn session_mut(&mut self) -> &mut S {
        &mut self.session
    }

    /// Advances the time to `now`, and then passes `bytes` to the session. `handle` receives the events. Time never
    /// goes back: if `now` is earlier than in the last call, the time stays the same. In a silence of more than an
    /// hour, timers expire only during the last hour.
    pub fn take(&mut self, now: Nanos, bytes: &[u8], mut handle: impl FnMut(Event<'_>)) {
        let now = now.max(self.now);
        // A wrong stamp in a file may be centuries ahead.
        self.until = self.until.max(now.saturating_sub(MAX_SILENCE));
        while self.until < now {
            self.now = self.until.max(self.now);
            self.session.read_buffer();
            self.session.commit(self.now, 0);
            self.session.handle_timeout(self.now);
            self.drain(&mut handle);
            // The next timeout must be later than the current time, because otherwise this loop would never end.
            self.until = self.until.max(self.now + 1);
        }
        self.now = now;
        let mut bytes = bytes;
        while !bytes.is_empty() {
            let room = self.session.read_buffer();
            let (taken, rest) = bytes.split_at(bytes.len().min(room.len()));
            room[..taken.len()].copy_from_slice(taken);
            self.session.commit(now, taken.len());
            self.drain(&mut handle);
            bytes = rest;
        }
    }

    fn drain(&mut self, handle: &mut impl FnMut(Event<'_>)) {
        self.until = loop {
            let is_sent = match self.session.poll_action() {
                Action::Transmit { .. } => true,
                Action::Event(event) => {
                    handle(event);
                    false
                }
                Action::SetRate(_) | Action::SetDtr(_) => false,
                Action::SleepUntil(until) | Action::Wait { until, .. } => break until,
            };
            // A recording cannot receive a request, so only report the request as sent.
            if is_sent {
                self.session.handle_transmitted(self.now);
            }
        };
    }
}

/// Maximum duration of a silence in which the timers of a session expire. During a longer silence, the session only
/// repeats what it did before.
const MAX_SILENCE: Nanos = 3_600_000 * MILLIS;
/// Time without bytes after which a session no longer holds packets back.
const IDLE_TIME: Nanos = 100 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn virtual_time_skips_centuries_of_silence() {
        for family in Family::ALL {
            let settings = Settings { fixed_rate: true, listen_only: true, ..Settings::default() };
            let mut time = VirtualTime::new(Session::begin(family, &settings, 0), 0);
            for now in [0, 1 << 62, i64::MAX as Nanos] {
                time.take(now, &[], |_| {});
            }
        }
    }
}
