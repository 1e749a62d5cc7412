//! Two methods that learn a background beam by beam, for a sensor that does not move: the method of the paper with one
//! range per beam ([`SingleSurface`]), and a method with several surfaces per beam ([`MultiSurface`]).
//!
//! The code executes the same steps for every beam, whatever the beam hits, so that the compiler can vectorize the
//! steps. The constants of [`MultiSurface`] were found with `benches/perception`, on seeds 0 to 9 of the simulated
//! scenes.

use super::{Class, INVALID, Limits, RunFilter};
use crate::search::position;
use scanhub_schema::Background;

/// State of the paper's method: one range per beam. Another range replaces it when the other range was read in enough
/// consecutive scans. If the readings of a beam flip between two surfaces, neither of them becomes background.
#[derive(Clone)]
pub(super) struct SingleSurface {
    /// Ranges in device units, [`Background::UNKNOWN`] or [`Background::FAR`].
    background: Box<[u16]>,
    /// Candidates for the background. The candidate of a beam is valid only if the beam's `run` is not 0.
    candidate: Box<[u16]>,
    /// Number of consecutive readings that agree with the candidate.
    run: Box<[u16]>,
}

impl SingleSurface {
    /// Creates the state for at most `beams` beams.
    pub(super) fn new(beams: usize) -> SingleSurface {
        let none = || vec![0; beams].into_boxed_slice();
        SingleSurface { background: vec![Background::UNKNOWN; beams].into(), candidate: none(), run: none() }
    }

    /// Restores the initial state.
    pub(super) fn reset(&mut self) {
        self.background.fill(Background::UNKNOWN);
        self.run.fill(0);
    }

    /// Classifies the beams and learns from them (paper III.B.3). A beam without a reading neither continues nor ends a
    /// run. A reading behind the background can be part of a run, but is never foreground. A scan that completes a run
    /// is still compared with the old background.
    pub(super) fn update(&mut self, readings: &[u16], limits: &Limits, learn: bool, classes: &mut [Class]) {
        for ((&reading, &background), class) in readings.iter().zip(&self.background).zip(classes) {
            let other = if reading < background { Class::Foreground } else { Class::Behind };
            let ends = reading.abs_diff(background) <= limits.threshold;
            let known = if ends { Class::Background } else { other };
            let valid = if background == Background::UNKNOWN { Class::Unknown } else { known };
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
            let known = background[i] != Background::UNKNOWN;
            let ends = known & (reading.abs_diff(background[i]) <= limits.threshold);
            let goes_on = (run[i] > 0) & (reading.abs_diff(candidate[i]) <= limits.candidate);
            let longer = if goes_on { run[i] + 1 } else { 1 };
            let adopted = valid & !ends & (longer >= limits.scans);
            let is_new = valid & !ends & (!goes_on | limits.latest);
            let new_run = if ends | adopted { 0 } else { longer };
            background[i] = if adopted { reading } else { background[i] };
            candidate[i] = if is_new { reading } else { candidate[i] };
            run[i] = if valid { new_run } else { run[i] };
        }
    }

    /// Uses `range` as the background of beam `i`.
    pub(super) fn adopt(&mut self, i: usize, range: u16) {
        self.background[i] = range;
        self.run[i] = 0;
    }

    pub(super) fn background(&self, i: usize) -> u16 {
        self.background[i]
    }
}

/// State of the method with several surfaces per beam. At an edge, the readings of a beam flip between two surfaces,
/// and this method learns both. [`RunFilter`] decides how many neighboring foreground beams are an object.
#[derive(Clone)]
pub(super) struct MultiSurface {
    blocks: Box<[BeamBlock]>,
    run_filter: RunFilter,
    /// Buffer for the nearest background of each beam while a scan is processed; [`INVALID`] if it is unknown.
    nearest: Box<[u16]>,
}

/// Surfaces that a block of neighboring beams has met.
///
/// In a room where nothing moves, each beam of most blocks meets the same fully known surface in every scan. Such a
/// block is *settled*. A scan changes only the ranges of its surfaces, so a short path handles it. The result is the
/// same.
#[derive(Clone)]
#[cfg_attr(test, derive(Debug, PartialEq))]
struct BeamBlock {
    slots: [Slots; SLOT_COUNT],
    /// Weight that the next surface that the beam meets will gain. It is higher if the previous scans had no return.
    gain: [i16; BLOCK_LEN],
    /// Ranges of the surfaces of a settled block; `None` if the block is not settled. While the block is settled, the
    /// ranges in the slots are out of date.
    single_surfaces: Option<[u16; BLOCK_LEN]>,
}

/// One slot of each beam of a block. A slot may contain a surface.
#[derive(Clone)]
#[cfg_attr(test, derive(Debug, PartialEq))]
struct Slots {
    /// Range of the surface, in device units.
    range: [u16; BLOCK_LEN],
    /// Weight of the surface, a measure of how well it is known. The weight grows with each scan in which the beam met
    /// the surface, and decreases with other scans. [`NO_WEIGHT`] means that the slot has no surface.
    weight: [i16; BLOCK_LEN],
}

/// Bounds of ranges and weights, converted by [`signed`], so that signed comparisons can be used.
#[derive(Clone, Copy)]
struct WeightBounds {
    threshold: i16,
    max_gain: i16,
    full: i16,
    known: i16,
    replaced: i16,
}

impl MultiSurface {
    /// Creates the state for at most `beams` beams.
    pub(super) fn new(beams: usize) -> MultiSurface {
        MultiSurface {
            blocks: vec![BeamBlock::NEW; beams.div_ceil(BLOCK_LEN)].into(),
            run_filter: RunFilter::new(beams),
            nearest: vec![INVALID; beams.next_multiple_of(BLOCK_LEN)].into(),
        }
    }

    /// Restores the initial state.
    pub(super) fn reset(&mut self) {
        self.blocks.fill(BeamBlock::NEW);
        self.run_filter.reset();
    }

    /// Compares all beams with the state before this scan, and then learns from the beams. `readings` and `classes` are
    /// padded to whole blocks.
    pub(super) fn update(&mut self, readings: &[u16], limits: &Limits, learn: bool, classes: &mut [Class]) {
        let bounds = WeightBounds::of(limits);
        let (read, _) = readings.as_chunks::<BLOCK_LEN>();
        let nearest = &mut self.nearest[..readings.len()];
        let results =
            classes.as_chunks_mut::<BLOCK_LEN>().0.iter_mut().zip(nearest.as_chunks_mut::<BLOCK_LEN>().0);
        for ((block, readings), (classes, nearest)) in self.blocks.iter_mut().zip(read).zip(results) {
            block.compare(readings, bounds, classes, nearest);
        }
        let nearest = &self.nearest[..readings.len()];
        let mut begin = 0;
        while let Some(first) = position(nearest, begin, |range| range == INVALID) {
            let Some(end) = position(nearest, first, |range| range != INVALID) else { break };
            begin = end;
            if let Some(right) = first.checked_sub(1) {
                self.compare_with_neighbors(right, begin, readings, limits, classes);
            }
        }
        self.run_filter.retain_objects(readings, limits, classes);
        if learn {
            self.blocks.iter_mut().zip(read).for_each(|(block, readings)| block.learn(readings, bounds));
        }
    }

    /// Classifies the beams between `right` and `left`. Their own background is unknown, but `right` and `left` are the
    /// nearest beams on both sides with a known background. A beam that is at most [`MAX_NEIGHBORS`] beams away from
    /// both is foreground if it ends nearer than both backgrounds, and if it does not meet a surface that it has
    /// already met for some time.
    fn compare_with_neighbors(
        &self,
        right: usize,
        left: usize,
        readings: &[u16],
        limits: &Limits,
        classes: &mut [Class],
    ) {
        let bounds = WeightBounds::of(limits);
        let limit = self.nearest[right].min(self.nearest[left]).saturating_sub(limits.threshold);
        for i in left.saturating_sub(MAX_NEIGHBORS).max(right + 1)..left.min(right + MAX_NEIGHBORS + 1) {
            let reading = readings[i];
            let is_met = |(range, weight): (u16, i16)| {
                weight >= bounds.replaced && signed(range.abs_diff(reading)) <= bounds.threshold
            };
            if reading < limit && reading != INVALID && !self.surfaces(i).any(is_met) {
                classes[i] = Class::Foreground;
            }
        }
    }

    /// Returns range and weight of each slot of beam `i`. The block of the beam must not be settled.
    fn surfaces(&self, i: usize) -> impl Iterator<Item = (u16, i16)> {
        let beam = i % BLOCK_LEN;
        self.blocks[i / BLOCK_LEN].slots.iter().map(move |slots| (slots.range[beam], slots.weight[beam]))
    }

    /// Uses `range` as the only background of beam `i`, with the maximum weight.
    pub(super) fn adopt(&mut self, i: usize, range: u16) {
        let (block, beam) = (&mut self.blocks[i / BLOCK_LEN], i % BLOCK_LEN);
        block.clear_single_surfaces();
        block.slots.iter_mut().for_each(|slots| slots.weight[beam] = NO_WEIGHT);
        block.slots[0].range[beam] = range;
        block.slots[0].weight[beam] = i16::MAX;
    }

    /// Returns the background of beam `i`: the known surface with the greatest weight. If two weights are equal,
    /// returns the nearer surface. A surface takes precedence over no return, however frequent no return is. Otherwise,
    /// a model that loads the result would report the surface as foreground.
    pub(super) fn background(&self, i: usize, limits: &Limits) -> u16 {
        if let Some(ranges) = &self.blocks[i / BLOCK_LEN].single_surfaces {
            return ranges[i % BLOCK_LEN];
        }
        let known = |&(_, weight): &(u16, i16)| weight >= WeightBounds::of(limits).known;
        let rank = |&(range, weight): &(u16, i16)| (range != Background::FAR, weight, u16::MAX - range);
        let best = self.surfaces(i).filter(known).max_by_key(rank);
        best.map_or(Background::UNKNOWN, |(range, _)| range)
    }
}

impl BeamBlock {
    const NEW: BeamBlock = BeamBlock {
        slots: [const { Slots { range: [0; BLOCK_LEN], weight: [NO_WEIGHT; BLOCK_LEN] } }; SLOT_COUNT],
        gain: [MET_WEIGHT; BLOCK_LEN],
        single_surfaces: None,
    };

    /// Classifies each beam by its own background. Writes the nearest background of each beam to `nearest`, or
    /// [`INVALID`] if the beam has no known background.
    #[inline]
    fn compare(
        &mut self,
        readings: &[u16; BLOCK_LEN],
        bounds: WeightBounds,
        classes: &mut [Class; BLOCK_LEN],
        nearest: &mut [u16; BLOCK_LEN],
    ) {
        match &self.single_surfaces {
            Some(ranges) if all_meet(ranges, readings, bounds) => {
                *nearest = *ranges;
                for (class, &reading) in classes.iter_mut().zip(readings) {
                    *class = if reading == INVALID { Class::Invalid } else { Class::Background };
                }
            }
            _ => {
                self.clear_single_surfaces();
                self.compare_surfaces(readings, bounds, classes, nearest);
            }
        }
    }

    /// Ends the short path: writes the ranges of a settled block back into its slots. Does nothing for other blocks.
    fn clear_single_surfaces(&mut self) {
        if let Some(ranges) = self.single_surfaces.take() {
            for slots in &mut self.slots {
                for ((range, weight), new) in slots.range.iter_mut().zip(slots.weight).zip(ranges) {
                    *range = if weight == NO_WEIGHT { *range } else { new };
                }
            }
        }
    }

    /// Classifies each beam by comparison with all of its surfaces.
    #[inline]
    fn compare_surfaces(
        &self,
        readings: &[u16; BLOCK_LEN],
        bounds: WeightBounds,
        classes: &mut [Class; BLOCK_LEN],
        nearest: &mut [u16; BLOCK_LEN],
    ) {
        for (i, &reading) in readings.iter().enumerate() {
            let (mut ends, mut known, mut range) = (false, false, Background::FAR);
            for slots in &self.slots {
                let is_known = slots.weight[i] >= bounds.known;
                known |= is_known;
                ends |= is_known & (signed(slots.range[i].abs_diff(reading)) <= bounds.threshold);
                range = if is_known & (slots.range[i] < range) { slots.range[i] } else { range };
            }
            nearest[i] = if known { range } else { INVALID };
            let other = if reading < range { Class::Foreground } else { Class::Behind };
            let with_background = if ends { Class::Background } else { other };
            let valid = if known { with_background } else { Class::Unknown };
            classes[i] = if reading == INVALID { Class::Invalid } else { valid };
        }
    }

    /// Updates the surfaces of each beam. The beam met the surface that is nearest to its reading, if this surface is
    /// within the threshold. All other surfaces of the beam lose weight. A surface in front of the reading loses more
    /// weight than a surface behind the reading, which may be hidden. If the reading meets no surface, it replaces the
    /// surface with the lowest weight, unless even the lowest weight is too high.
    #[inline]
    fn learn(&mut self, readings: &[u16; BLOCK_LEN], bounds: WeightBounds) {
        match &mut self.single_surfaces {
            Some(ranges) => {
                let (readings, mut drawn) = (*readings, *ranges);
                for (range, reading) in drawn.iter_mut().zip(readings) {
                    *range = range.wrapping_add_signed(step(*range, reading) & mask(reading != INVALID));
                }
                *ranges = drawn;
                self.gain(readings, bounds);
            }
            None => self.learn_surfaces(readings, bounds),
        }
    }

    /// Updates all surfaces, without the short path.
    #[inline]
    fn learn_surfaces(&mut self, readings: &[u16; BLOCK_LEN], bounds: WeightBounds) {
        let gains = self.gain(*readings, bounds);
        for (i, &reading) in readings.iter().enumerate() {
            let range = self.slots.each_ref().map(|slots| slots.range[i]);
            let weight = self.slots.each_ref().map(|slots| slots.weight[i]);
            let (range, weight) = learned(range, weight, reading, gains[i], bounds);
            for (k, slots) in self.slots.iter_mut().enumerate() {
                slots.range[i] = range[k];
                slots.weight[i] = weight[k];
            }
        }
        self.single_surfaces = self.single_surfaces(bounds.full);
    }

    /// Returns the ranges of the surfaces if the block is settled: each beam has only one surface, with the weight
    /// `full`. Otherwise returns `None`.
    #[inline]
    fn single_surfaces(&self, full: i16) -> Option<[u16; BLOCK_LEN]> {
        let (mut ranges, mut known, mut empty) = ([0; BLOCK_LEN], [0; BLOCK_LEN], [0; BLOCK_LEN]);
        for slots in &self.slots {
            for i in 0..BLOCK_LEN {
                let is_full = mask(slots.weight[i] == full);
                ranges[i] |= slots.range[i] & is_full as u16;
                known[i] += is_full;
                empty[i] += mask(slots.weight[i] == NO_WEIGHT);
            }
        }
        (known == [-1; BLOCK_LEN] && empty == [1 - SLOT_COUNT as i16; BLOCK_LEN]).then_some(ranges)
    }

    /// Returns the weight that a surface gains if its beam meets it in this scan, and updates the gains for the next
    /// scan.
    #[inline]
    fn gain(&mut self, readings: [u16; BLOCK_LEN], bounds: WeightBounds) -> [i16; BLOCK_LEN] {
        let (mut gains, mut next_gains) = (self.gain, self.gain);
        for ((gain, next), reading) in gains.iter_mut().zip(&mut next_gains).zip(readings) {
            let (far, valid) = (mask(reading == Background::FAR), mask(reading != INVALID));
            let after = ((*next + MET_WEIGHT).min(bounds.max_gain) & far) | (MET_WEIGHT & !far);
            *gain = (MET_WEIGHT & far) | (*next & !far);
            *next = (after & valid) | (*next & !valid);
        }
        self.gain = next_gains;
        gains
    }
}

/// Returns whether each beam meets its surface at `range`, or has no reading.
#[inline]
fn all_meet(range: &[u16; BLOCK_LEN], readings: &[u16; BLOCK_LEN], bounds: WeightBounds) -> bool {
    let beams = range.iter().zip(readings);
    beams.fold(true, |all, (&range, &reading)| {
        all & ((signed(range.abs_diff(reading)) <= bounds.threshold) | (reading == INVALID))
    })
}

/// Returns the change of the `range` of a surface after a `reading` that met the surface: the difference of both
/// divided by 16, rounded to zero. The function uses shifts, because a division would not stay 16 bits wide.
#[inline]
fn step(range: u16, reading: u16) -> i16 {
    let difference = reading.wrapping_sub(range) as i16;
    difference.wrapping_add((difference >> 15) & ((1 << DRIFT_SHIFT) - 1)) >> DRIFT_SHIFT
}

/// Returns -1, which has all bits set, if `is_set` is true, and 0 otherwise. An `if` in a short loop would become a
/// branch for each beam.
#[inline]
fn mask(is_set: bool) -> i16 {
    -i16::from(is_set)
}

/// Returns ranges and weights of the surfaces of one beam after `reading`. The surface that the beam met gains the
/// weight `gain`.
#[inline]
fn learned(
    range: [u16; SLOT_COUNT],
    weight: [i16; SLOT_COUNT],
    reading: u16,
    gain: i16,
    bounds: WeightBounds,
) -> ([u16; SLOT_COUNT], [i16; SLOT_COUNT]) {
    const NOT_MET: i16 = i16::MAX;
    let mut distances = [NOT_MET; SLOT_COUNT];
    let mut least_apart = NOT_MET;
    for k in 0..SLOT_COUNT {
        let distance = signed(range[k].abs_diff(reading));
        distances[k] =
            if (weight[k] > NO_WEIGHT) & (distance <= bounds.threshold) { distance } else { NOT_MET };
        least_apart = least_apart.min(distances[k]);
    }
    let (mut new_range, mut new_weight) = (range, weight);
    let valid = reading != INVALID;
    let mut open = valid & (least_apart != NOT_MET);
    let mut minimum = i16::MAX;
    for k in 0..SLOT_COUNT {
        let is_met = open & (distances[k] == least_apart);
        open &= !is_met;
        new_range[k] = range[k].wrapping_add_signed(if is_met { step(range[k], reading) } else { 0 });
        let leak = if signed(reading) > signed(range[k]) { -PASSED_LOSS } else { -HIDDEN_LOSS };
        let change = if is_met { gain } else { leak };
        let change = if valid { change } else { 0 };
        new_weight[k] = weight[k].min(bounds.full).saturating_add(change).min(bounds.full);
        minimum = minimum.min(new_weight[k]);
    }
    let mut homeless = valid & (least_apart == NOT_MET) & (minimum < bounds.replaced);
    for k in 0..SLOT_COUNT {
        let replaced = homeless & (new_weight[k] == minimum);
        homeless &= !replaced;
        new_range[k] = if replaced { reading } else { new_range[k] };
        new_weight[k] = if replaced { NO_WEIGHT.wrapping_add(gain) } else { new_weight[k] };
    }
    (new_range, new_weight)
}

/// Maps unsigned numbers to signed numbers in the same order. SSE2 compares 16-bit numbers in one instruction only if
/// they are signed.
fn signed(value: u16) -> i16 {
    (value ^ 0x8000) as i16
}

impl WeightBounds {
    fn of(limits: &Limits) -> WeightBounds {
        let scans = limits.scans;
        WeightBounds {
            threshold: signed(limits.threshold),
            max_gain: MET_WEIGHT * ((scans / SCANS_PER_NO_RETURN).clamp(1, MAX_NO_RETURN_SCANS) as i16),
            full: signed(MET_WEIGHT as u16 * scans),
            known: signed(KNOWN_WEIGHT * scans),
            replaced: signed(REPLACEABLE_WEIGHT * scans),
        }
    }
}

/// Maximum number of surfaces per beam: two surfaces at an edge, and a third surface that may replace one of them.
const SLOT_COUNT: usize = 3;
/// Number of beams of a [`BeamBlock`]: as many 16-bit numbers as the processor handles in one instruction.
pub(super) const BLOCK_LEN: usize = 8;
/// Share of its distance from a reading by which a surface moves toward the reading: 1/16, as a number of bits to
/// shift. With this share, a surface is too slow to follow a person who walks.
const DRIFT_SHIFT: u32 = 4;

/// Weight in a slot without a surface.
const NO_WEIGHT: i16 = i16::MIN;
/// Weight that a surface gains in a scan in which the beam met it. After the configured number of such scans, the
/// surface is fully known.
const MET_WEIGHT: i16 = 8;
/// Maximum number of scans whose weight a surface gains in one scan. If the scans before had no return, the surface
/// also counts as met in them. A wall that returns only 15 % of the beams therefore becomes background after 5/4 of the
/// configured scans.
const MAX_NO_RETURN_SCANS: u16 = 16;
/// Number of configured scans per scan of this maximum. If few scans are configured, the maximum is therefore lower, so
/// that a lost beam does not make a standing person background any sooner.
const SCANS_PER_NO_RETURN: u16 = 16;
/// Weight that a surface loses in a scan in which the beam ended behind it. An object that was removed is therefore no
/// longer background after 3/4 of the configured scans. A surface that is met in more than a third of the scans finally
/// becomes background.
const PASSED_LOSS: i16 = 4;
/// Weight that a surface loses in a scan in which the beam ended in front of it. The loss is small, because the surface
/// may still exist. It is not 0, because otherwise hidden surfaces could take all slots.
const HIDDEN_LOSS: i16 = 1;
/// Weight per configured scan with which a surface is background: 5/8 of the full weight, so that some readings may be
/// missing.
const KNOWN_WEIGHT: u16 = 5;
/// Weight per configured scan below which a new surface can replace a surface.
const REPLACEABLE_WEIGHT: u16 = 2;
/// Maximum distance in beams from a beam with an unknown background to the nearest beams with a known background, whose
/// backgrounds are used instead.
const MAX_NEIGHBORS: usize = 8;

#[cfg(test)]
mod tests {
    use super::super::{ScanHead, Settings};
    use super::*;

    /// Number of beams: two whole blocks and a part of a third one. Each beam hits one surface, or a window.
    const BEAMS: usize = 19;

    #[test]
    fn fast_path_of_a_settled_block_is_equivalent() {
        let mut random = fastrand::Rng::with_seed(1);
        let limits =
            Limits { scans: 300, ..Limits::of(&Settings::default(), &ScanHead::lms(BEAMS, 0, 500, 1, 13)) };
        let [mut short, mut long] = [MultiSurface::new(BEAMS), MultiSurface::new(BEAMS)];
        let mut settled = 0;
        for number in 0..6_000 {
            let noise = if number % 500 == 0 { 60 } else { 20 };
            let mut readings = [INVALID; 3 * BLOCK_LEN];
            for (i, reading) in readings[..BEAMS].iter_mut().enumerate() {
                *reading = match random.u16(..10_000) {
                    0..100 => INVALID,
                    100..110 => Background::FAR,
                    // Beams through windows seldom have a return.
                    110..9_990 if i % 5 == 0 => Background::FAR,
                    _ => 1_000 + 10 * i as u16 + random.u16(..noise),
                };
            }
            if number % 1_000 == 0 {
                // Load the readings as a model, so that the windows are background before the gains of their beams have
                // grown.
                for multi in [&mut short, &mut long] {
                    multi.reset();
                    let valid = readings.iter().enumerate().filter(|&(_, &reading)| reading != INVALID);
                    valid.for_each(|(i, &reading)| multi.adopt(i, reading));
                }
            }
            let [mut short_classes, mut long_classes] = [[Class::Invalid; 3 * BLOCK_LEN]; 2];
            long.blocks.iter_mut().for_each(|block| block.clear_single_surfaces());
            short.update(&readings, &limits, true, &mut short_classes);
            long.update(&readings, &limits, true, &mut long_classes);
            assert_eq!(short_classes, long_classes, "scan {number}");
            settled += short.blocks.iter().filter(|block| block.single_surfaces.is_some()).count();
            let state = |multi: &MultiSurface| {
                let mut multi = multi.clone();
                multi.blocks.iter_mut().for_each(|block| block.clear_single_surfaces());
                multi.blocks
            };
            assert_eq!(state(&short), state(&long), "scan {number}");
        }
        assert!((1_000..11_000).contains(&settled), "{settled} blocks were settled");
    }
}
