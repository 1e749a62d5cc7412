//! The paper's background, value for value: one range a beam, replaced by what was read so many times in a row. A beam
//! that flips between two surfaces never learns either.

use super::settings::Limits;
use super::{Class, INVALID};
use schema::{BEAMS, Background};

/// State of the paper's method.
#[derive(Clone)]
pub(super) struct Paper {
    /// Ranges in device units, [`Background::UNTAUGHT`] or [`Background::FAR`].
    background: [u16; BEAMS],
    /// What may become the background, where `run` is not 0.
    candidate: [u16; BEAMS],
    /// Readings in a row that were the candidate's.
    run: [u32; BEAMS],
}

impl Paper {
    pub(super) fn new() -> Paper {
        Paper { background: [Background::UNTAUGHT; BEAMS], candidate: [0; BEAMS], run: [0; BEAMS] }
    }

    /// Compares and learns (paper III.B.3). Readings without a range neither count nor end a run; farther ones count,
    /// but are never foreground; the scan that completes a run is compared with the old background.
    pub(super) fn update(&mut self, readings: &[u16], limits: &Limits, learn: bool, classes: &mut [Class]) {
        let state = self.background.iter_mut().zip(&mut self.candidate).zip(&mut self.run);
        for ((&reading, class), ((background, candidate), run)) in readings.iter().zip(classes).zip(state) {
            if reading == INVALID {
                *class = Class::Invalid;
                continue;
            }
            let known = *background != Background::UNTAUGHT;
            if known && reading.abs_diff(*background) <= limits.threshold {
                *class = Class::Background;
                if learn {
                    *run = 0;
                }
                continue;
            }
            *class = match known {
                false => Class::Unknown,
                true if reading < *background => Class::Foreground,
                true => Class::Behind,
            };
            if !learn {
                continue;
            }
            if *run > 0 && reading.abs_diff(*candidate) <= limits.candidate {
                *run += 1;
                if limits.latest {
                    *candidate = reading;
                }
            } else {
                *candidate = reading;
                *run = 1;
            }
            if *run >= limits.scans {
                *background = reading;
                *run = 0;
            }
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
