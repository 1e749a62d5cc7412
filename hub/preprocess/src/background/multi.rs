//! A background with several surfaces a beam: at edges a beam flips between two of them and both are learned; and what
//! is nearer counts only where neighbouring beams agree.

use super::settings::Limits;
use super::{Class, INVALID};
use schema::{BEAMS, Background};

/// State of the method with several surfaces.
#[derive(Clone)]
pub(super) struct Multi {
    slots: [[Slot; SLOTS]; BEAMS],
}

/// A surface that a beam meets, now and then.
#[derive(Clone, Copy)]
struct Slot {
    /// Its range in 1/16 device units; [`EMPTY`] if there is none.
    range: u32,
    /// How well it is known: 8 for each scan in which it was met, less what leaked.
    weight: u32,
    is_background: bool,
}

impl Multi {
    pub(super) fn new() -> Multi {
        Multi { slots: [[Slot::NONE; SLOTS]; BEAMS] }
    }

    /// Compares all beams with the state before this scan, then learns from them.
    pub(super) fn update(&mut self, readings: &[u16], limits: &Limits, learn: bool, classes: &mut [Class]) {
        self.compare(readings, limits, classes);
        keep_runs(readings, limits, classes);
        if learn {
            let threshold = FINE * u32::from(limits.threshold);
            let full = MET * limits.scans.min(MOST_SCANS);
            for (slots, &reading) in self.slots.iter_mut().zip(readings) {
                if reading != INVALID {
                    learn_beam(slots, FINE * u32::from(reading), threshold, full);
                }
            }
        }
    }

    /// A beam is in the foreground if it meets none of its own backgrounds and is nearer than those of its neighbours,
    /// too: at an edge it may meet theirs.
    fn compare(&self, readings: &[u16], limits: &Limits, classes: &mut [Class]) {
        let threshold = FINE * u32::from(limits.threshold);
        let mut nearest = [u32::MAX; BEAMS + 2];
        for (nearest, slots) in nearest[1..=readings.len()].iter_mut().zip(&self.slots) {
            for slot in slots.iter().filter(|slot| slot.is_background) {
                *nearest = slot.range.min(*nearest);
            }
        }
        for (i, (&reading, class)) in readings.iter().zip(classes).enumerate() {
            let range = FINE * u32::from(reading);
            let around = nearest[i].min(nearest[i + 1]).min(nearest[i + 2]);
            *class = if reading == INVALID {
                Class::Invalid
            } else if nearest[i + 1] == u32::MAX {
                Class::Unknown
            } else if self.slots[i].iter().any(|slot| slot.is_background && slot.meets(range, threshold)) {
                Class::Background
            } else if range + threshold < around {
                Class::Foreground
            } else if range > nearest[i + 1] {
                Class::Behind
            } else {
                Class::Background
            };
        }
    }

    /// Takes `range` for the only background of beam `i`, as well known as can be.
    pub(super) fn adopt(&mut self, i: usize, range: u16, limits: &Limits) {
        let weight = MET * limits.scans.min(MOST_SCANS);
        let known = Slot { range: FINE * u32::from(range), weight, is_background: true };
        self.slots[i] = [Slot::NONE; SLOTS];
        self.slots[i][0] = known;
    }

    /// The best known background of beam `i`, of equals the nearer one.
    pub(super) fn background(&self, i: usize) -> u16 {
        let known = self.slots[i].iter().filter(|slot| slot.is_background);
        let best = known.max_by_key(|slot| (slot.weight, u32::MAX - slot.range));
        best.map_or(Background::UNTAUGHT, |slot| ((slot.range + FINE / 2) / FINE) as u16)
    }
}

impl Slot {
    const NONE: Slot = Slot { range: EMPTY, weight: 0, is_background: false };

    fn meets(&self, range: u32, threshold: u32) -> bool {
        self.range.abs_diff(range) <= threshold
    }
}

/// One beam's surfaces after it has met something at `range`.
fn learn_beam(slots: &mut [Slot; SLOTS], range: u32, threshold: u32, full: u32) {
    let mut met = None;
    let mut nearest = threshold;
    for (number, slot) in slots.iter().enumerate() {
        let apart = slot.range.abs_diff(range);
        if apart <= threshold && (met.is_none() || apart < nearest) {
            (met, nearest) = (Some(number), apart);
        }
    }
    for (number, slot) in slots.iter_mut().enumerate() {
        if Some(number) == met {
            slot.weight = (slot.weight + MET).min(full);
            slot.is_background |= slot.weight >= full;
            slot.range = slot.range + range / DRAWN - slot.range / DRAWN;
        } else {
            slot.weight = slot.weight.saturating_sub(LEAK);
            slot.is_background &= slot.weight >= full / 4;
        }
    }
    if met.is_none() {
        let weakest = if slots[1].weight < slots[0].weight { 1 } else { 0 };
        let weakest = if slots[2].weight < slots[weakest].weight { 2 } else { weakest };
        if slots[weakest].weight < full / 4 {
            slots[weakest] = Slot { range, weight: MET, is_background: MET >= full };
        }
    }
}

/// Leaves only those runs of foreground beams that are long enough for their range.
fn keep_runs(readings: &[u16], limits: &Limits, classes: &mut [Class]) {
    let mut begin = 0;
    while begin < classes.len() {
        if classes[begin] != Class::Foreground {
            begin += 1;
            continue;
        }
        let length = classes[begin..].iter().take_while(|&&class| class == Class::Foreground).count();
        let end = begin + length;
        let nearest = readings[begin..end].iter().min().map_or(0, |&nearest| u64::from(nearest));
        let beam_um = nearest * u64::from(limits.unit_mm) * u64::from(limits.step_mdeg) * 1000 / 57_296;
        let enough = OBJECT_UM.checked_div(beam_um).map_or(3, |beams| beams.clamp(1, 3) as usize);
        if length < enough {
            classes[begin..end].fill(Class::Unknown);
        }
        begin = end;
    }
}

/// Surfaces a beam remembers.
const SLOTS: usize = 3;
/// Steps of a slot's range in a device unit.
const FINE: u32 = 16;
/// Range of an empty slot: nothing is near it.
const EMPTY: u32 = 1 << 30;
/// Weight of a scan in which the surface was met.
const MET: u32 = 8;
/// Weight lost in a scan in which something else was met.
const LEAK: u32 = 3;
/// A slot's range moves by this part of its distance to the reading.
const DRAWN: u32 = 16;
/// Keeps weights in their integers.
const MOST_SCANS: u32 = u32::MAX / 16;
/// Width of the narrowest thing that is looked for: a leg.
const OBJECT_UM: u64 = 120_000;
