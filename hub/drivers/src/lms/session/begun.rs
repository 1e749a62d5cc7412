//! A scan of which a part is there, for who wants to be warned before the rest of it came. Refuses to judge it.

use super::Session;
use crate::lms::measured::FirstValues;
use crate::lms::variant::Mode;
use schema::Nanos;

/// Measured values of a telegram that is not complete, and that may turn out to be damaged.
#[derive(Clone, Copy, Debug)]
pub struct Begun<'a> {
    /// The values so far.
    pub values: FirstValues<'a>,
    /// How they are split.
    pub mode: Mode,
    /// Number of its first byte among all bytes of the session, from 0.
    pub offset: u64,
    /// Bytes of it that arrived.
    pub bytes: usize,
    /// When the first one arrived.
    pub first: Nanos,
    /// When the last one of these arrived.
    pub last: Nanos,
    /// Why it is suspect already, bits of [`crate::line::suspect`].
    pub reasons: u8,
}

impl Session {
    /// From now on a telegram is looked at `pieces` times while it arrives, so that [`begun`](Self::begun) has news; 0 and 1:
    /// only when it is complete.
    pub fn look_in(&mut self, pieces: u8) {
        self.rhythm.look_in(pieces);
    }

    /// The scan of a stream that is arriving, once [`crate::line::Session::poll_output`] wants to wait; nothing between scans, and
    /// where it is not known how to read one.
    pub fn begun(&self) -> Option<Begun<'_>> {
        if !self.is_live() || !self.is_at_rate() {
            return None;
        }
        let begun = self.framer.begun()?;
        let values = FirstValues::of(begun.bytes)?;
        let mode = self.dialogue.sensor.mode_of_scans()?;
        let (baud, bytes) = (self.dialogue.baud.rate(), begun.bytes.len());
        let first = self.arrivals.stamp(begun.offset, baud);
        let last = self.arrivals.stamp(begun.offset + bytes as u64 - 1, baud);
        Some(Begun {
            values,
            mode,
            offset: begun.offset,
            bytes,
            first: first.at.max(self.last_stamp),
            last: last.at.max(first.at).max(self.last_stamp),
            reasons: begun.reasons,
        })
    }
}
