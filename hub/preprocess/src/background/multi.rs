//! A background with several surfaces a beam: at edges a beam flips between two of them, and both are learned. Refuses
//! to know how many beams something has to cover until it is believed: that is for the runs.
//!
//! The constants were found on seeds 0 to 9 of the simulated scenes, by `benches/foreground`.

use super::runs::Runs;
use super::settings::Limits;
use super::{Class, INVALID};
use schema::{BEAMS, Background};

/// State of the method with several surfaces.
#[derive(Clone)]
pub(super) struct Multi {
    beams: [Beam; BEAMS],
    runs: Runs,
}

/// The surfaces that a beam meets, now and then, in no order.
#[derive(Clone, Copy)]
struct Beam {
    slots: [Slot; SLOTS],
    /// Range of the nearest background; [`NONE`] if there is none.
    nearest: u32,
}

/// One of these surfaces.
#[derive(Clone, Copy)]
struct Slot {
    /// In 1/16 device units; [`NONE`] if the slot is empty.
    range: u32,
    /// How well it is known: grows with each scan in which it was met, and leaks in others.
    weight: u32,
    is_background: bool,
}

impl Multi {
    pub(super) fn new() -> Multi {
        Multi { beams: [Beam { slots: [Slot::EMPTY; SLOTS], nearest: NONE }; BEAMS], runs: Runs::new() }
    }

    /// Compares all beams with the state before this scan, then learns from them.
    pub(super) fn update(&mut self, readings: &[u16], limits: &Limits, learn: bool, classes: &mut [Class]) {
        let threshold = FINE * u32::from(limits.threshold);
        let full = MET * limits.scans.min(MOST_SCANS);
        for (i, (&reading, class)) in readings.iter().zip(classes.iter_mut()).enumerate() {
            let range = FINE * u32::from(reading);
            *class = match &self.beams[i] {
                _ if reading == INVALID => Class::Invalid,
                beam if beam.nearest == NONE => self.beside(i, readings.len(), range, threshold, full),
                beam if beam.slots.iter().any(|slot| slot.is_background && slot.meets(range, threshold)) => {
                    Class::Background
                }
                beam if range < beam.nearest => Class::Foreground,
                _ => Class::Behind,
            };
        }
        self.runs.keep(readings, limits, classes);
        if learn {
            for (beam, &reading) in self.beams.iter_mut().zip(readings) {
                if reading != INVALID {
                    beam.learn(FINE * u32::from(reading), threshold, full);
                }
            }
        }
    }

    /// What beam `i` of `count` is, whose own background is not known: foreground if it is nearer than what its
    /// neighbours to both sides end on, and meets nothing that it has met for a while.
    fn beside(&self, i: usize, count: usize, range: u32, threshold: u32, full: u32) -> Class {
        let known = |beam: &&Beam| beam.nearest != NONE;
        let right = self.beams[i.saturating_sub(ASIDE)..i].iter().rev().find(known);
        let left = self.beams[i + 1..(i + 1 + ASIDE).min(count)].iter().find(known);
        let (Some(right), Some(left)) = (right, left) else { return Class::Unknown };
        let met = |slot: &Slot| slot.weight >= full / FORGOTTEN && slot.meets(range, threshold);
        if range + threshold < right.nearest.min(left.nearest) && !self.beams[i].slots.iter().any(met) {
            Class::Foreground
        } else {
            Class::Unknown
        }
    }

    /// Takes `range` for the only background of beam `i`, as well known as can be.
    pub(super) fn adopt(&mut self, i: usize, range: u16) {
        let known = Slot { range: FINE * u32::from(range), weight: u32::MAX, is_background: true };
        self.beams[i] = Beam { slots: [Slot::EMPTY; SLOTS], nearest: known.range };
        self.beams[i].slots[0] = known;
    }

    /// The best known background of beam `i`, of equals the nearer one.
    pub(super) fn background(&self, i: usize) -> u16 {
        let known = self.beams[i].slots.iter().filter(|slot| slot.is_background);
        let best = known.max_by_key(|slot| (slot.weight, NONE - slot.range));
        best.map_or(Background::UNTAUGHT, |slot| ((slot.range + FINE / 2) / FINE) as u16)
    }
}

impl Beam {
    /// After something was met at `range`: the nearest surface within `threshold` is it, the others leak, those
    /// through which the beam went more than those that may be hidden. What is none of them takes the place of the
    /// least known one, unless all are known too well.
    fn learn(&mut self, range: u32, threshold: u32, full: u32) {
        let mut met = None;
        let mut nearest = threshold;
        for (number, slot) in self.slots.iter().enumerate() {
            let apart = slot.range.abs_diff(range);
            if apart < nearest || apart == nearest && met.is_none() {
                (met, nearest) = (Some(number), apart);
            }
        }
        for (number, slot) in self.slots.iter_mut().enumerate() {
            let weight = slot.weight.min(full);
            if met == Some(number) {
                slot.weight = (weight + MET).min(full);
                slot.is_background |= slot.weight >= full / 8 * KNOWN_EIGHTHS;
                slot.range = slot.range + range / DRAWN - slot.range / DRAWN;
            } else {
                slot.weight = weight.saturating_sub(if range > slot.range { PASSED } else { HIDDEN });
                slot.is_background &= slot.weight >= full / FORGOTTEN;
            }
        }
        if met.is_none()
            && let Some(least) = self.slots.iter_mut().min_by_key(|slot| slot.weight)
            && least.weight < full / FORGOTTEN
        {
            *least = Slot { range, weight: MET, is_background: MET >= full };
        }
        let ranges = self.slots.iter().map(|slot| if slot.is_background { slot.range } else { NONE });
        self.nearest = ranges.fold(NONE, u32::min);
    }
}

impl Slot {
    const EMPTY: Slot = Slot { range: NONE, weight: 0, is_background: false };

    fn meets(&self, range: u32, threshold: u32) -> bool {
        self.range.abs_diff(range) <= threshold
    }
}

/// Surfaces a beam remembers: two at an edge, and one that may take the place of either.
const SLOTS: usize = 3;
/// Steps of a slot's range in a device unit.
const FINE: u32 = 16;
/// A range that nothing is near, not even what is beyond the sensor's.
const NONE: u32 = 1 << 30;
/// A slot's range moves by this part of its distance to the reading: too slowly to follow somebody who walks.
const DRAWN: u32 = 16;

/// Weight of a scan in which the surface was met; it is fully known after as many scans as are set.
const MET: u32 = 8;
/// Weight lost in a scan that saw what is behind the surface: what was taken away is forgotten after 1.5 times the
/// scans that are set, and what is met in a third of the scans is learned in the end.
const PASSED: u32 = 4;
/// Weight lost in a scan that saw something before the surface, which may still be there. Not 0: else all slots could
/// be taken by what is hidden for ever.
const HIDDEN: u32 = 1;
/// A surface is background from 5/8 of the full weight on: sooner than a run of the paper's method, whose readings
/// must all be the same; so readings may be missing.
const KNOWN_EIGHTHS: u32 = 5;
/// Below a quarter of the full weight it is forgotten.
const FORGOTTEN: u32 = 4;
/// Beams to either side among which one has to be known, to stand in for a beam that is not.
const ASIDE: usize = 4;
/// Keeps weights in their integers: 26 months.
const MOST_SCANS: u32 = u32::MAX / 16;
