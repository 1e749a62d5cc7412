//! A background with several surfaces a beam: at edges a beam flips between two of them, and both are learned. Refuses
//! to know how many neighbouring beams make an object: `runs` decides that.
//!
//! All beams take the same steps, whatever they hit, so that the compiler can vectorise them. The constants were found
//! on seeds 0 to 9 of the simulated scenes, by `benches/perception`.

use super::runs::Runs;
use super::settings::Limits;
use super::{Class, INVALID};
use schema::Background;

/// State of the method with several surfaces.
#[derive(Clone)]
pub(super) struct Multi {
    slots: [Slots; SLOTS],
    /// What a surface weighs that the beam meets next: more where nothing came back from it before.
    gain: Box<[u16]>,
    runs: Runs,
    /// The nearest background of each beam, and what the surface that it meets gains, while a scan is looked at.
    nearest: Box<[u16]>,
    gains: Box<[u16]>,
}

/// A surface of each beam, if it has one.
#[derive(Clone)]
struct Slots {
    /// In device units.
    range: Box<[u16]>,
    /// How well it is known: grows with each scan in which it was met, and leaks in others. 0: there is none.
    weight: Box<[u16]>,
}

/// What the steps are about, in units of ranges and of weights.
#[derive(Clone, Copy)]
struct Bounds {
    threshold: u16,
    returned: u16,
    full: u16,
    known: u16,
    replaced: u16,
}

impl Multi {
    /// For so many beams at most.
    pub(super) fn new(beams: usize) -> Multi {
        let all = |value: u16| vec![value; beams].into_boxed_slice();
        Multi {
            slots: std::array::from_fn(|_| Slots { range: all(0), weight: all(0) }),
            gain: all(MET),
            runs: Runs::new(beams),
            nearest: all(INVALID),
            gains: all(MET),
        }
    }

    /// As it was when it was new.
    pub(super) fn forget(&mut self) {
        self.slots.iter_mut().for_each(|slots| {
            slots.range.fill(0);
            slots.weight.fill(0);
        });
        self.gain.fill(MET);
        self.runs.forget();
    }

    /// Compares all beams with the state before this scan, then learns from them.
    pub(super) fn update(&mut self, readings: &[u16], limits: &Limits, learn: bool, classes: &mut [Class]) {
        let bounds = Bounds::of(limits);
        self.compare(readings, bounds, classes);
        for i in (0..readings.len()).filter(|&i| self.nearest[i] == INVALID) {
            let nearest = &self.nearest[..readings.len()];
            if readings[i] != INVALID && self.is_before_its_neighbours(i, readings[i], nearest, bounds) {
                classes[i] = Class::Foreground;
            }
        }
        self.runs.keep(readings, limits, classes);
        if learn {
            self.learn(readings, bounds);
        }
    }

    /// What each beam is beside its own background, and the nearest one of these; [`INVALID`] if there is none.
    fn compare(&mut self, readings: &[u16], bounds: Bounds, classes: &mut [Class]) {
        let n = readings.len();
        // Of one length, so that the loop needs no look at it.
        let slots = self.slots.each_ref().map(|slots| (&slots.range[..n], &slots.weight[..n]));
        let (classes, nearest) = (&mut classes[..n], &mut self.nearest[..n]);
        for (i, ((&reading, class), nearest)) in readings.iter().zip(classes).zip(nearest).enumerate() {
            let (mut ends, mut known, mut range) = (false, false, Background::FAR);
            for (ranges, weights) in &slots {
                let is_known = weights[i] >= bounds.known;
                known |= is_known;
                ends |= is_known & (ranges[i].abs_diff(reading) <= bounds.threshold);
                range = if is_known & (ranges[i] < range) { ranges[i] } else { range };
            }
            *nearest = if known { range } else { INVALID };
            let aside = if reading < range { Class::Foreground } else { Class::Behind };
            let with_background = if ends { Class::Background } else { aside };
            let valid = if known { with_background } else { Class::Unknown };
            *class = if reading == INVALID { Class::Invalid } else { valid };
        }
    }

    /// Beam `i`, whose own background is not known, is nearer than what its neighbours to both sides end on, and meets
    /// nothing that it has met for a while.
    fn is_before_its_neighbours(&self, i: usize, reading: u16, nearest: &[u16], bounds: Bounds) -> bool {
        let known = |range: &&u16| **range != INVALID;
        let right = nearest[i.saturating_sub(ASIDE)..i].iter().rev().find(known);
        let left = nearest[i + 1..(i + 1 + ASIDE).min(nearest.len())].iter().find(known);
        let (Some(&right), Some(&left)) = (right, left) else { return false };
        let met = |slots: &Slots| {
            slots.weight[i] >= bounds.replaced && slots.range[i].abs_diff(reading) <= bounds.threshold
        };
        reading < right.min(left).saturating_sub(bounds.threshold) && !self.slots.iter().any(met)
    }

    /// The surface nearest to a reading, within the threshold, was met; the others leak, those through which the beam
    /// went more than those that may be hidden. What is none of them takes the place of the least known one, unless all
    /// are known too well.
    fn learn(&mut self, readings: &[u16], bounds: Bounds) {
        self.gain(readings, bounds);
        let n = readings.len();
        let gains = &self.gains[..n];
        let mut slots = self.slots.each_mut().map(|slots| (&mut slots.range[..n], &mut slots.weight[..n]));
        for (i, &reading) in readings.iter().enumerate() {
            let range = slots.each_ref().map(|(ranges, _)| ranges[i]);
            let weight = slots.each_ref().map(|(_, weights)| weights[i]);
            let (new_range, new_weight) = learned(range, weight, reading, gains[i], bounds);
            let valid = reading != INVALID;
            for (k, (ranges, weights)) in slots.iter_mut().enumerate() {
                ranges[i] = if valid { new_range[k] } else { range[k] };
                weights[i] = if valid { new_weight[k] } else { weight[k] };
            }
        }
    }

    /// What the surface that each beam meets gains in this scan. By themselves: the processor does not do so many things at
    /// once in the loop over the surfaces.
    fn gain(&mut self, readings: &[u16], bounds: Bounds) {
        for ((gain, next), &reading) in self.gains.iter_mut().zip(&mut self.gain).zip(readings) {
            let is_far = reading == Background::FAR;
            *gain = if is_far { MET } else { *next };
            let more = (*next + MET).min(bounds.returned);
            let after = if is_far { more } else { MET };
            *next = if reading == INVALID { *next } else { after };
        }
    }

    /// Takes `range` for the only background of beam `i`, as well known as can be.
    pub(super) fn adopt(&mut self, i: usize, range: u16) {
        self.slots.iter_mut().for_each(|slots| slots.weight[i] = 0);
        self.slots[0].range[i] = range;
        self.slots[0].weight[i] = u16::MAX;
    }

    /// The best known background of beam `i`, of equals the nearer one; a surface before nothing, however often
    /// nothing comes back from it: a model that starts with that range alone would report the surface as foreground.
    pub(super) fn background(&self, i: usize, limits: &Limits) -> u16 {
        let known = |slots: &&Slots| slots.weight[i] >= Bounds::of(limits).known;
        let rank = |s: &&Slots| (s.range[i] != Background::FAR, s.weight[i], u16::MAX - s.range[i]);
        let best = self.slots.iter().filter(known).max_by_key(rank);
        best.map_or(Background::UNTAUGHT, |slots| slots.range[i])
    }
}

/// The surfaces of one beam after `reading`; the one that was met gains so much.
#[inline]
fn learned(
    range: [u16; SLOTS],
    weight: [u16; SLOTS],
    reading: u16,
    gain: u16,
    bounds: Bounds,
) -> ([u16; SLOTS], [u16; SLOTS]) {
    const NOT_MET: u16 = u16::MAX;
    let mut apart = [NOT_MET; SLOTS];
    let mut least_apart = NOT_MET;
    for k in 0..SLOTS {
        let away = range[k].abs_diff(reading);
        apart[k] = if (weight[k] > 0) & (away <= bounds.threshold) { away } else { NOT_MET };
        least_apart = least_apart.min(apart[k]);
    }
    let (mut new_range, mut new_weight) = (range, weight);
    let mut open = least_apart != NOT_MET;
    let mut least = u16::MAX;
    for k in 0..SLOTS {
        let met = open & (apart[k] == least_apart);
        open &= !met;
        let step = (reading.wrapping_sub(range[k]) as i16) / DRAWN;
        new_range[k] = if met { range[k].wrapping_add_signed(step) } else { range[k] };
        let before = weight[k].min(bounds.full);
        let leak = if reading > range[k] { PASSED } else { HIDDEN };
        let more = before.saturating_add(gain).min(bounds.full);
        new_weight[k] = if met { more } else { before.saturating_sub(leak) };
        least = least.min(new_weight[k]);
    }
    let mut homeless = (least_apart == NOT_MET) & (least < bounds.replaced);
    for k in 0..SLOTS {
        let replaced = homeless & (new_weight[k] == least);
        homeless &= !replaced;
        new_range[k] = if replaced { reading } else { new_range[k] };
        new_weight[k] = if replaced { gain } else { new_weight[k] };
    }
    (new_range, new_weight)
}

impl Bounds {
    fn of(limits: &Limits) -> Bounds {
        let scans = limits.scans;
        Bounds {
            threshold: limits.threshold,
            returned: MET * (scans / RETURNED_OF).clamp(1, RETURNED),
            full: MET * scans,
            known: KNOWN * scans,
            replaced: REPLACED * scans,
        }
    }
}

/// Surfaces a beam remembers: two at an edge, and one that may take the place of either.
const SLOTS: usize = 3;
/// A surface's range moves by this part of its distance to the reading, in whole units: too slowly to follow somebody
/// who walks.
const DRAWN: i16 = 16;

/// Weight of a scan in which the surface was met; it is fully known after as many scans as are set.
const MET: u16 = 8;
/// A surface counts as met also in the scans just before from which nothing came back, at most so many with the one in
/// which it was met, and at most one for so many that are set. So a wall from which 15 % of the beams come back is
/// background after 5/4 of the scans that are set, and somebody who stands there no sooner for a beam that is lost.
const RETURNED: u16 = 16;
const RETURNED_OF: u16 = 16;
/// Weight lost in a scan that saw what is behind the surface: what was taken away is no background any more after 3/4
/// of the scans that are set, and what is met in more than a third of the scans becomes one in the end.
const PASSED: u16 = 4;
/// Weight lost in a scan that saw something before the surface, which may still be there. Not 0: else all slots could
/// be taken by a surface that stays hidden.
const HIDDEN: u16 = 1;
/// Weight per scan that is set, from which on a surface is background: 5/8 of the full weight, so that readings may be
/// missing.
const KNOWN: u16 = 5;
/// Weight per scan that is set, below which a surface can be replaced.
const REPLACED: u16 = 2;
/// Beams to either side among which one has to be known, to stand in for a beam that is not.
const ASIDE: usize = 8;
