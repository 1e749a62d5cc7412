//! Telegrams from a stream of bytes as they arrived on a line: bytes outside any telegram are skipped and counted. A
//! stream has no stamps.

use std::io::Read;

use lms::framer::{Found, Framer, VETO_HOLD};

/// Reads telegrams; ends with the stream.
pub(crate) struct Telegrams<R> {
    reader: R,
    framer: Framer,
    /// Whether the reader has said that there is no more.
    ended: bool,
}

impl<R: Read> Telegrams<R> {
    pub(crate) fn new(reader: R) -> Self {
        Telegrams { reader, framer: Framer::default(), ended: false }
    }

    /// Bytes so far that were in no telegram; at the end all of them.
    pub(crate) fn discarded(&self) -> u64 {
        let open = if self.ended { self.framer.buffered() as u64 } else { 0 };
        self.framer.tally().discarded + open
    }

    /// The next whole telegram, or `None` at the end.
    pub(crate) fn next(&mut self) -> std::io::Result<Option<Vec<u8>>> {
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
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
    }
}
