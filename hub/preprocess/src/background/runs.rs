//! Decides how many neighbouring beams, in how many scans, count as an object. Noise and mixed readings at edges are
//! single beams; people cover several, unless they are far away. Refuses to know backgrounds.

use super::settings::Limits;
use super::{Class, INVALID};

/// What the last scan had in the foreground, believed or not.
#[derive(Clone)]
pub(super) struct Runs {
    /// Readings of the beams that were nearer than their background; [`INVALID`] for the others.
    seen: Box<[u16]>,
    /// Those of them that were believed.
    told: Box<[u16]>,
    /// Those of the scan that is looked at.
    next: [Box<[u16]>; 2],
}

impl Runs {
    /// For so many beams at most.
    pub(super) fn new(beams: usize) -> Runs {
        let none = || vec![INVALID; beams].into_boxed_slice();
        Runs { seen: none(), told: none(), next: [none(), none()] }
    }

    /// As it was when it was new.
    pub(super) fn forget(&mut self) {
        self.seen.fill(INVALID);
        self.told.fill(INVALID);
    }

    /// Leaves those runs of foreground beams in `classes` that are believed; the beams of others become unknown. Beams
    /// without a reading do not end a run and do not count.
    ///
    /// A run of three beams is believed at once. A shorter one is if the last scan told a foreground beam there; or if
    /// it is as long as a leg is wide at its range, and the last scan had such a beam there, believed or not. There:
    /// among its own beams or beside them, within 200 mm of its nearest range.
    pub(super) fn keep(&mut self, readings: &[u16], limits: &Limits, classes: &mut [Class]) {
        let most = self.seen.len();
        let [seen, told] = &mut self.next;
        seen.fill(INVALID);
        told.fill(INVALID);
        let mut begin = 0;
        while let Some(ahead) = classes[begin..].iter().position(|&class| class == Class::Foreground) {
            let first = begin + ahead;
            let (mut behind, mut beams, mut nearest) = (first, 0, INVALID);
            for (i, class) in classes.iter().enumerate().skip(first) {
                match class {
                    Class::Foreground => {
                        (behind, beams, nearest) = (i + 1, beams + 1, nearest.min(readings[i]));
                        seen[i] = readings[i];
                    }
                    Class::Invalid => {}
                    _ => break,
                }
            }
            let around = first.saturating_sub(1)..(behind + 1).min(most);
            let reach = (1000 * REACH_MM / limits.unit_um).min(u16::MAX.into()) as u16;
            let there = |before: &[u16]| {
                let mut before = before[around.clone()].iter();
                before.any(|&range| range != INVALID && range.abs_diff(nearest) <= reach)
            };
            let run = &mut classes[first..behind];
            if beams >= ENOUGH || there(&self.told) || beams >= leg(nearest, limits) && there(&self.seen) {
                told[first..behind].copy_from_slice(&seen[first..behind]);
            } else {
                run.iter_mut().filter(|class| **class == Class::Foreground).for_each(|c| *c = Class::Unknown);
            }
            begin = behind;
        }
        std::mem::swap(&mut self.seen, seen);
        std::mem::swap(&mut self.told, told);
    }
}

/// Beams that a leg covers at `range`, at most [`ENOUGH`] and at least one.
fn leg(range: u16, limits: &Limits) -> u64 {
    let apart_um = u64::from(range) * u64::from(limits.unit_um);
    let apart = apart_um.saturating_mul(limits.step_mdeg.into());
    (1000 * LEG_MM * MDEG_PER_RADIAN).checked_div(apart).map_or(ENOUGH, |beams| beams.clamp(1, ENOUGH))
}

/// Beams that are never noise: no more are asked for, however near.
const ENOUGH: u64 = 3;
/// Width of a leg with its trousers, and a beam's own: of 120, 135 and 150 mm the one with the best recall that costs
/// no precision in the room of Fig. 8.
const LEG_MM: u64 = 135;
const MDEG_PER_RADIAN: u64 = 57_296;
/// How far something gets from scan to scan at most, and how deep it is: 5 m/s at 37.5 Hz is 133 mm.
const REACH_MM: u32 = 200;
