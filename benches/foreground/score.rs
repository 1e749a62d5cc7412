//! How often a method was right.

use std::ops::AddAssign;

use super::method::Method;
use super::play::{Due, Frame};

/// Beams by what was due and what was told.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Score {
    scans: u64,
    found: u64,
    missed: u64,
    wrong: u64,
}

impl Score {
    /// Lets `method` see `frames` from the first to the last.
    pub(crate) fn of(method: &mut dyn Method, frames: &[Frame]) -> Score {
        let mut score = Score { scans: frames.len() as u64, ..Score::default() };
        let mut foreground = vec![false; frames.first().map_or(0, |frame| frame.due.len())];
        for frame in frames {
            method.update(&frame.scan, &mut foreground);
            for (due, &told) in frame.due.iter().zip(&foreground) {
                match (due, told) {
                    (Due::Foreground, true) => score.found += 1,
                    (Due::Foreground, false) => score.missed += 1,
                    (Due::Other, true) => score.wrong += 1,
                    _ => {}
                }
            }
        }
        score
    }

    /// Share of the beams due that were told.
    pub(crate) fn recall(&self) -> f64 {
        self.found as f64 / (self.found + self.missed) as f64
    }

    /// Share of the beams told that were due.
    pub(crate) fn precision(&self) -> f64 {
        self.found as f64 / (self.found + self.wrong) as f64
    }

    /// Beams told that were not due, per scan.
    pub(crate) fn wrong_per_scan(&self) -> f64 {
        self.wrong as f64 / self.scans as f64
    }
}

impl AddAssign for Score {
    fn add_assign(&mut self, other: Score) {
        self.scans += other.scans;
        self.found += other.found;
        self.missed += other.missed;
        self.wrong += other.wrong;
    }
}
