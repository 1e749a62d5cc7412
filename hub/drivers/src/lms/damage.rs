//! Damage on the line: bytes of a stream that are in no telegram although neither side aborted a transmission. Bytes of
//! another rate, or of a stream that is being stopped, do not count, because they do not indicate the quality of the
//! line.

use crate::lms::framer::Tally;
use scanhub_schema::{MILLIS, Nanos};

/// Damage of all streams of a session.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Damage {
    /// Number of damaged bytes, up to `seen`.
    damaged: u64,
    /// Number of bytes in no telegram when the stream was last checked. `None` without a stream.
    seen: Option<u64>,
    /// Time at which bytes were last found damaged.
    last: Option<Nanos>,
}

impl Damage {
    /// Handles the counters of a stream that begins or continues.
    pub(crate) fn note(&mut self, tally: &Tally, now: Nanos) {
        let in_nothing = in_nothing(tally);
        if let Some(seen) = self.seen.replace(in_nothing)
            && in_nothing > seen
        {
            self.damaged += in_nothing - seen;
            self.last = Some(now);
        }
    }

    /// Ends the stream.
    pub(crate) fn end(&mut self) {
        self.seen = None;
    }

    /// Returns the number of damaged bytes, including those since the last check.
    pub(crate) fn damaged(&self, tally: &Tally) -> u64 {
        self.damaged + self.seen.map_or(0, |seen| in_nothing(tally) - seen)
    }

    /// Returns whether a telegram that arrives at `now` may be damaged although its checksum is right.
    pub(crate) fn is_recent(&self, now: Nanos) -> bool {
        self.last.is_some_and(|last| now.saturating_sub(last) < RECENT)
    }
}

fn in_nothing(tally: &Tally) -> u64 {
    tally.discarded - tally.broken_off
}

/// Time for which a line counts as damaging after the last damage.
const RECENT: Nanos = 10_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_only_bytes_of_streams() {
        let tally = |discarded, broken_off| Tally { discarded, broken_off, ..Tally::default() };
        let mut damage = Damage::default();
        damage.note(&tally(500, 0), 1);
        assert_eq!((damage.damaged(&tally(500, 0)), damage.is_recent(1)), (0, false));
        damage.note(&tally(700, 150), 2);
        assert_eq!((damage.damaged(&tally(700, 150)), damage.damaged(&tally(720, 150))), (50, 70));
        assert!(damage.is_recent(2) && damage.is_recent(RECENT + 1) && !damage.is_recent(RECENT + 2));
        damage.end();
        assert_eq!(damage.damaged(&tally(900, 150)), 50);
        damage.note(&tally(900, 150), 3);
        damage.note(&tally(901, 150), 4);
        assert_eq!(damage.damaged(&tally(901, 150)), 51);
    }
}
