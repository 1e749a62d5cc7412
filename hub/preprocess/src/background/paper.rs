//! The paper's background, value for value: one range per beam, replaced by a new range once that was read a number of
//! times in a row. A beam that flips between two surfaces never learns either.
//!
//! All beams take the same steps, whatever they hit, so that the compiler can vectorise them.

use super::settings::Limits;
use super::{Class, INVALID};
use schema::Background;

/// State of the paper's method.
#[derive(Clone)]
pub(super) struct Paper {
    /// Ranges in device units, [`Background::UNTAUGHT`] or [`Background::FAR`].
    background: Box<[u16]>,
    /// What may become the background, where `run` is not 0.
    candidate: Box<[u16]>,
    /// Readings in a row that were the candidate's.
    run: Box<[u16]>,
}

impl Paper {
    /// For so many beams at most.
    pub(super) fn new(beams: usize) -> Paper {
        let none = || vec![0; beams].into_boxed_slice();
        Paper { background: vec![Background::UNTAUGHT; beams].into(), candidate: none(), run: none() }
    }

    /// As it was when it was new.
    pub(super) fn forget(&mut self) {
        self.background.fill(Background::UNTAUGHT);
        self.run.fill(0);
    }

    /// Compares and learns (paper III.B.3). Readings without a range neither count nor end a run; farther ones count,
    /// but are never foreground; the scan that completes a run is compared with the old background.
    pub(super) fn update(&mut self, readings: &[u16], limits: &Limits, learn: bool, classes: &mut [Class]) {
        for ((&reading, &background), class) in readings.iter().zip(&self.background).zip(classes) {
            let aside = if reading < background { Class::Foreground } else { Class::Behind };
            let ends = reading.abs_diff(background) <= limits.threshold;
            let known = if ends { Class::Background } else { aside };
            let valid = if background == Background::UNTAUGHT { Class::Unknown } else { known };
            *class = if reading == INVALID { Class::Invalid } else { valid };
        }
        if learn {
            self.learn(readings, limits);
        }
    }

    fn learn(&mut self, readings: &[u16], limits: &Limits) {
        let beams = readings.len();
        let background = &mut self.background[..beams];
        let candidate = &mut self.candidate[..beams];
        let run = &mut self.run[..beams];
        for (i, &reading) in readings.iter().enumerate() {
            let valid = reading != INVALID;
            let known = background[i] != Background::UNTAUGHT;
            let ends = known & (reading.abs_diff(background[i]) <= limits.threshold);
            let goes_on = (run[i] > 0) & (reading.abs_diff(candidate[i]) <= limits.candidate);
            let longer = if goes_on { run[i] + 1 } else { 1 };
            let adopted = valid & !ends & (longer >= limits.scans);
            let anew = valid & !ends & (!goes_on | limits.latest);
            let new_run = if ends | adopted { 0 } else { longer };
            background[i] = if adopted { reading } else { background[i] };
            candidate[i] = if anew { reading } else { candidate[i] };
            run[i] = if valid { new_run } else { run[i] };
        }
    }

    /// Takes `range` for the background of beam `i`.
    pub(super) fn adopt(&mut self, i: usize, range: u16) {
        self.background[i] = range;
        self.run[i] = 0;
    }

    pub(super) fn background(&self, i: usize) -> u16 {
        self.background[i]
    }
}
