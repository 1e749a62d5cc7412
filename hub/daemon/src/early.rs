//! Warnings by the part of a scan that is there, while the rest of it is on the line or not even measured: a telegram of 361
//! values takes 14.6 ms at 500 kBd, a turn of a head 100 ms, and what is near stands in it long before its end. Says slow or
//! stop, never clear; what it said of a scan that is not published, or that looks better as it goes on, it takes back. Refuses
//! to know topics, and whether anybody listens.

use preprocess::zones::{Check, Warning};
use scanhub_drivers::line::RawScan;
use schema::{Contents, Early, Scan, Verdict};

/// What was said of the scan that is arriving.
pub(crate) struct EarlyWarner {
    /// The scan so far.
    scan: Box<Scan>,
    said: Option<Said>,
}

/// A warning that nothing has confirmed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Said {
    /// Of which scan of its session.
    number: u64,
    word: Word,
}

/// A warning, or what takes it back, and its number in the topics: the zones of its scan have no lesser one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Word {
    pub(crate) seq: u64,
    pub(crate) early: Early,
}

impl EarlyWarner {
    /// For scans of at most `beams` beams.
    pub(crate) fn new(beams: usize) -> EarlyWarner {
        EarlyWarner { scan: Scan::zeroed(Scan::len(beams, Contents::TURNING)), said: None }
    }

    /// What has to be said now that `check` knows as much of a scan as has `partial`: what was said of it is taken back if it does
    /// not hold any more, and a warning is said if it is worse than what was. `next_seq` is the number of the next telegram.
    pub(crate) fn look(
        &mut self,
        partial: &RawScan<'_>,
        check: &mut Check,
        next_seq: u64,
    ) -> [Option<Word>; 2] {
        let early = self.judge(partial, check);
        let told = early.map_or(Verdict::Clear as u8, |early| early.verdict);
        // Packets of the turn that came since may have the numbers of its zones, so what is said anew keeps its number.
        let seq = self.said.map_or(next_seq, |said| said.word.seq);
        let withdrawn = if self.verdict() > told { self.withdraw(None) } else { None };
        let worse = early.filter(|_| told > self.verdict()).map(|early| {
            let word = Word { seq, early };
            self.said = Some(Said { number: partial.number, word });
            word
        });
        [withdrawn, worse]
    }

    /// What `check` makes of the part of a scan that is there, if it is a warning.
    fn judge(&mut self, partial: &RawScan<'_>, check: &mut Check) -> Option<Early> {
        let scan = &mut self.scan;
        partial.write(scan);
        let warning = check.early(scan.beams(), scan.unit_um, scan.ranges(), scan.exact_angles())?;
        let beams_seen = scan.ranges().iter().filter(|range| **range != Scan::NOT_MEASURED).count();
        let Warning { verdict, beam, distance_mm } = warning;
        let (bytes_seen, beams_seen) = (partial.bytes as u16, beams_seen as u16);
        Some(Early { verdict: verdict as u8, flags: 0, beam, distance_mm, bytes_seen, beams_seen })
    }

    /// Whether there is a warning that nothing has confirmed.
    pub(crate) fn has_said(&self) -> bool {
        self.said.is_some()
    }

    /// The scan `number` was published, and what was said of it holds.
    pub(crate) fn confirm(&mut self, number: u64) {
        self.said = self.said.filter(|said| said.number != number);
    }

    /// What has to be taken back now that the scan that is arriving is `number`, if one is.
    pub(crate) fn withdraw(&mut self, number: Option<u64>) -> Option<Word> {
        let Word { seq, early } = self.said.take_if(|said| Some(said.number) != number)?.word;
        Some(Word { seq, early: Early { flags: Early::WITHDRAWN, ..early } })
    }

    fn verdict(&self) -> u8 {
        self.said.map_or(Verdict::Clear as u8, |said| said.word.early.verdict)
    }
}

// A worse verdict is a greater number.
const _: () = assert!((Verdict::Clear as u8) < Verdict::Slow as u8);
const _: () = assert!((Verdict::Slow as u8) < Verdict::Stop as u8);

#[cfg(test)]
mod tests;
