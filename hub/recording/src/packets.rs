//! Packets from a stream of bytes as they arrived on a line, of a scanner whose head turns. A stream has no stamps; where the
//! scanner has a clock of its own, that says when they were measured. Refuses to know turns.

use std::io::{self, Read};

use line::family::Wanted;
use line::{Heard, MILLIS, Nanos, Output, Session as _, line_time};
use schema::Family;

use crate::Frame;

/// Reads packets; ends with the stream.
pub(crate) struct Packets<R> {
    reader: R,
    session: scanner::Session,
    family: Family,
    /// The scanner's clock at the last packets; nothing before the first ones.
    last: Option<Nanos>,
    /// What passed since the first ones.
    passed: Nanos,
    ended: bool,
}

impl<R: Read> Packets<R> {
    /// Of a scanner of `family`; nothing if that sends no packets.
    pub(crate) fn of(family: Family, reader: R) -> Option<Packets<R>> {
        let wanted = Wanted { fixed_rate: true, listen_only: true, ..Wanted::default() };
        let session = scanner::Session::begin(family, wanted, 0)?;
        Some(Packets { reader, session, family, last: None, passed: 0, ended: false })
    }

    /// Bytes so far that were in no packet; at the end all of them.
    pub(crate) fn discarded(&self) -> u64 {
        let account = self.session.account();
        account.discarded + if self.ended { account.buffered } else { 0 }
    }

    /// The next packets, or `None` at the end.
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
                    // Nothing will come that could refute packets that are held back.
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
                Output::Heard(Heard::Packets(received)) => break (received.bytes.to_vec(), received.reasons),
                Output::Transmit { .. } => self.session.transmitted(0),
                Output::Heard(Heard::Turn(_)) | Output::SetRate(_) | Output::SetDtr(_) => {}
                Output::Rest(_) | Output::Wait { .. } => return None,
            }
        };
        let took = line_time(telegram.len(), self.session.rate());
        let scanner_ns = Some(self.pass(took));
        Some(Frame { telegram, family: self.family as u8, scanner_ns, reasons, ..Frame::default() })
    }

    /// The time of the packets that came last, which took so long on the line: from the first ones on, it never goes back.
    fn pass(&mut self, took: Nanos) -> Nanos {
        let Some(at) = self.session.scanner_time() else {
            self.passed += took;
            return self.passed;
        };
        self.passed += match self.last {
            None => 0,
            // Else the scanner began again.
            Some(last) => at.checked_sub(last).unwrap_or(took),
        };
        self.last = Some(at);
        self.passed
    }
}

/// Longer than a session holds packets back.
const IDLE: Nanos = 100 * MILLIS;
