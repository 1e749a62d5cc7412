//! How much of a stream the line damages: bytes that are in no telegram although neither side broke off a
//! transmission. Bytes of another rate, or of a stream that is being stopped, do not count: they say nothing about the
//! line.

use crate::lms::framer::Tally;
use schema::{MILLIS, Nanos};

/// The account of all streams of a session.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Damage {
    /// Bytes damaged, up to `seen`.
    damaged: u64,
    /// The account of bytes as it was when the stream was last looked at; nothing while there is none.
    seen: Option<u64>,
    /// When bytes were last found damaged.
    last: Option<Nanos>,
}

impl Damage {
    /// The stream goes on, or begins, with this account of its bytes.
    pub(crate) fn note(&mut self, tally: &Tally, now: Nanos) {
        let in_nothing = in_nothing(tally);
        if let Some(seen) = self.seen.replace(in_nothing)
            && in_nothing > seen
        {
            self.damaged += in_nothing - seen;
            self.last = Some(now);
        }
    }

    /// There is no stream.
    pub(crate) fn end(&mut self) {
        self.seen = None;
    }

    /// Bytes of streams that were damaged, with those since the last look.
    pub(crate) fn damaged(&self, tally: &Tally) -> u64 {
        self.damaged + self.seen.map_or(0, |seen| in_nothing(tally) - seen)
    }

    /// Whether what comes at `now` may be damaged where its checksum did not notice.
    pub(crate) fn is_recent(&self, now: Nanos) -> bool {
        self.last.is_some_and(|last| now.saturating_sub(last) < RECENT)
    }
}

fn in_nothing(tally: &Tally) -> u64 {
    tally.discarded - tally.broken_off
}

/// A line that damaged something a while ago is well now.
const RECENT: Nanos = 10_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_a_stream_loses_counts() {
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
