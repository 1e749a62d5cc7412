//! Warnings by the part of a telegram that is there, while the rest of it is on the line: a telegram of 361 values takes
//! 14.6 ms at 500 kBd, and what is near stands in it long before its checksum. Says slow or stop, never clear; what it said of
//! a telegram that does not become a scan it takes back. Refuses to know topics, and whether anybody listens.

use lms::session::Begun;
use preprocess::zones::{Check, Warning};
use schema::{Early, Verdict};

/// What was said of the telegram that is arriving.
pub(crate) struct EarlyWarner {
    /// The ranges of that telegram so far.
    ranges: Box<[u16]>,
    said: Option<Said>,
}

/// A warning that nothing has confirmed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Said {
    /// Of the telegram's first byte.
    offset: u64,
    early: Early,
}

impl EarlyWarner {
    /// For scans of at most `beams` beams.
    pub(crate) fn new(beams: usize) -> EarlyWarner {
        EarlyWarner { ranges: vec![0; beams].into(), said: None }
    }

    /// What `check` makes of the scan that is arriving, if that is worse than what was said of it.
    pub(crate) fn warn(&mut self, begun: &Begun<'_>, check: &mut Check) -> Option<Early> {
        let values = &begun.values;
        let seen = scanner::decode_first(values, begun.mode, &mut self.ranges);
        let warning = check.early(values.count(), scanner::unit_um(values), &self.ranges[..seen])?;
        let Warning { verdict, beam, distance_mm } = warning;
        if self.said.is_some_and(|said| said.early.verdict >= verdict as u8) {
            return None;
        }
        let (bytes_seen, beams_seen) = (begun.bytes as u16, seen as u16);
        let early = Early { verdict: verdict as u8, flags: 0, beam, distance_mm, bytes_seen, beams_seen };
        self.said = Some(Said { offset: begun.offset, early });
        Some(early)
    }

    /// Whether there is a warning that nothing has confirmed.
    pub(crate) fn has_said(&self) -> bool {
        self.said.is_some()
    }

    /// The scan of the telegram at `offset` was published, and what was said of it holds.
    pub(crate) fn confirm(&mut self, offset: u64) {
        self.said = self.said.filter(|said| said.offset != offset);
    }

    /// What has to be taken back, now that the telegram that is arriving begins at `offset`, if one is.
    pub(crate) fn withdraw(&mut self, offset: Option<u64>) -> Option<Early> {
        let said = self.said.take_if(|said| Some(said.offset) != offset)?;
        Some(Early { flags: Early::WITHDRAWN, ..said.early })
    }
}

// A worse verdict is a greater number.
const _: () = assert!((Verdict::Slow as u8) < Verdict::Stop as u8);
