//! Streams of bytes as they arrived on a line. They contain the telegrams of an LMS or the packets of a rotating scanner, and
//! other bytes, which are skipped and counted. A stream has no stamps. If the scanner has a clock, packets have times of that
//! clock.

use std::io::{self, Read};
use std::path::Path;

use scanhub_drivers::line::{Event, Output, Protocol as _, Session as _};
use scanhub_drivers::lms::framer::{Found, Framer, VETO_HOLD};
use scanhub_drivers::{Session, Settings, features};
use schema::{Failure, Family, MILLIS, Nanos, line_time};

use crate::open::{is_end, reader, unreadable};
use crate::{Contents, Form, Frame};

/// Reads telegrams of an LMS; ends with the stream.
pub(crate) struct Telegrams<R> {
    reader: R,
    framer: Framer,
    /// Whether the reader is at its end.
    ended: bool,
}

impl<R: Read> Telegrams<R> {
    pub(crate) fn new(reader: R) -> Self {
        Telegrams { reader, framer: Framer::default(), ended: false }
    }

    /// Returns the number of bytes so far outside telegrams. It is complete at the end.
    pub(crate) fn discarded(&self) -> u64 {
        let open = if self.ended { self.framer.buffered() as u64 } else { 0 };
        self.framer.tally().discarded + open
    }

    /// Returns the next whole telegram; `None` at the end.
    pub(crate) fn next(&mut self) -> io::Result<Option<Vec<u8>>> {
        loop {
            while let Some(found) = self.framer.poll() {
                if let Found::Telegram(framed) = found {
                    return Ok(Some(framed.telegram.bytes().to_vec()));
                }
            }
            if self.ended {
                return Ok(None);
            }
            match self.reader.read(self.framer.spare()) {
                Ok(0) => {
                    self.ended = true;
                    self.framer.release(VETO_HOLD);
                }
                Ok(len) => self.framer.commit(len),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
    }
}

/// Reads packets of a rotating scanner; ends with the stream.
pub(crate) struct Packets<R> {
    reader: R,
    session: Session,
    family: Family,
    /// The scanner's clock at the last packets.
    last: Option<Nanos>,
    /// Time since the first packets.
    passed: Nanos,
    ended: bool,
}

impl<R: Read> Packets<R> {
    /// Reads packets of `family`, which are split as those of `mode`, if that is given. `None` if the family sends no packets.
    pub(crate) fn of(family: Family, mode: Option<&'static str>, reader: R) -> Option<Packets<R>> {
        if features(family).has_whole_telegrams {
            return None;
        }
        let settings = Settings { mode, fixed_rate: true, listen_only: true, ..Settings::default() };
        let session = Session::begin(family, &settings, 0);
        Some(Packets { reader, session, family, last: None, passed: 0, ended: false })
    }

    /// Returns the number of bytes so far outside packets. It is complete at the end.
    pub(crate) fn discarded(&self) -> u64 {
        let account = self.session.account();
        account.discarded + if self.ended { account.buffered } else { 0 }
    }

    /// Returns the next packets; `None` at the end.
    pub(crate) fn next(&mut self) -> io::Result<Option<Frame>> {
        loop {
            if let Some(frame) = self.heard() {
                return Ok(Some(frame));
            }
            if self.ended {
                return Ok(None);
            }
            match self.reader.read(self.session.spare()) {
                Ok(0) => {
                    self.ended = true;
                    self.session.commit(0, 0);
                    // No more bytes can refute packets that are held back.
                    self.session.handle_timeout(IDLE);
                }
                Ok(len) => self.session.commit(0, len),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
    }

    fn heard(&mut self) -> Option<Frame> {
        let (telegram, reasons) = loop {
            match self.session.poll_output() {
                Output::Event(Event::Telegram(received)) => {
                    break (received.bytes.to_vec(), received.reasons);
                }
                Output::Transmit { .. } => self.session.transmitted(0),
                Output::Event(Event::Scan(_)) | Output::SetRate(_) | Output::SetDtr(_) => {}
                Output::Rest(_) | Output::Wait { .. } => return None,
            }
        };
        let took = line_time(telegram.len(), self.session.rate());
        let scanner_ns = Some(self.pass(took));
        Some(Frame { telegram, family: self.family as u8, scanner_ns, reasons, ..Frame::default() })
    }

    /// Returns the time of the last packets, which took this long on the line, since the first ones. It never goes back.
    fn pass(&mut self, took: Nanos) -> Nanos {
        let Some(at) = self.session.scanner_time() else {
            self.passed += took;
            return self.passed;
        };
        self.passed += match self.last {
            None => 0,
            // A clock that went back belongs to a scanner that restarted.
            Some(last) => at.checked_sub(last).unwrap_or(took),
        };
        self.last = Some(at);
        self.passed
    }
}

/// Reads the stream at `path` for telegrams of an LMS.
///
/// # Errors
///
/// Returns [`Kind::Input`](schema::Kind::Input) if it cannot be read.
pub(crate) fn survey_telegrams(path: &Path) -> Result<Contents, Failure> {
    let mut telegrams = Telegrams::new(reader(path)?);
    let mut contents = survey(path, Family::Lms, || {
        Ok(telegrams.next()?.map(|telegram| Frame { telegram, ..Frame::default() }))
    })?;
    contents.damage.bytes = telegrams.discarded();
    Ok(contents)
}

/// Reads the stream at `path` for packets of `family`, which is not that of an LMS. They are split as those of `mode`, if that is
/// given.
///
/// # Errors
///
/// Returns [`Kind::Input`](schema::Kind::Input) if it cannot be read.
pub(crate) fn survey_packets(
    path: &Path,
    family: Family,
    mode: Option<&'static str>,
) -> Result<Contents, Failure> {
    let Some(mut packets) = Packets::of(family, mode, reader(path)?) else {
        return Ok(Contents::new(Form::Telegrams));
    };
    let mut contents = survey(path, family, || packets.next())?;
    contents.damage.bytes = packets.discarded();
    Ok(contents)
}

/// Returns the contents of the telegrams or packets that `next` reads from the stream at `path`.
fn survey(
    path: &Path,
    family: Family,
    mut next: impl FnMut() -> io::Result<Option<Frame>>,
) -> Result<Contents, Failure> {
    let mut contents = Contents { family: family as u8, ..Contents::new(Form::Telegrams) };
    loop {
        match next() {
            Ok(Some(frame)) => {
                contents.note(frame.family, &frame.telegram, None);
                contents.scanner_ns = frame.scanner_ns;
            }
            Ok(None) => return Ok(contents),
            Err(error) if is_end(&error) && contents.telegrams > 0 => {
                contents.damage.is_cut = true;
                return Ok(contents);
            }
            Err(error) => return Err(unreadable(path, &error)),
        }
    }
}

/// Time after which a session no longer holds packets back.
const IDLE: Nanos = 100 * MILLIS;
