//! The two methods that learn a background beam by beam, for a sensor that does not move: that of the paper with one
//! range per beam ([`Paper`]), and one with several surfaces per beam ([`Multi`]).
//!
//! All beams take the same steps, whatever they hit, so that the compiler can vectorize them. The loops of [`Multi`]
//! are not inlined into one function, where they would execute more instructions on more code lines. Its constants were
//! found on seeds 0 to 9 of the simulated scenes, by `benches/perception`.

use super::{Class, INVALID, Limits, Runs, position};
use scanhub_schema::Background;

/// State of the paper's method: one range per beam, which is replaced by a new range once that was read a number of
/// times in a row. A beam that flips between two surfaces never learns either of them.
#[derive(Clone)]
pub(super) struct Paper {
    /// Ranges in device units, [`Background::UNTAUGHT`] or [`Background::FAR`].
    background: Box<[u16]>,
    /// Candidates for the background, where `run` is not 0.
    candidate: Box<[u16]>,
    /// Number of consecutive readings of the candidate.
    run: Box<[u16]>,
}

impl Paper {
    /// Creates the state for at most `beams` beams.
    pub(super) fn new(beams: usize) -> Paper {
        let none = || vec![0; beams].into_boxed_slice();
        Paper { background: vec![Background::UNTAUGHT; beams].into(), candidate: none(), run: none() }
    }

    /// Restores the initial state.
    pub(super) fn forget(&mut self) {
        self.background.fill(Background::UNTAUGHT);
        self.run.fill(0);
    }

    /// Compares and learns (paper III.B.3). Readings without a range neither count nor end a run. Farther ones count,
    /// but are never foreground. The scan that completes a run is compared with the old background.
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

    /// Uses `range` as the background of beam `i`.
    pub(super) fn adopt(&mut self, i: usize, range: u16) {
        self.background[i] = range;
        self.run[i] = 0;
    }

    pub(super) fn background(&self, i: usize) -> u16 {
        self.background[i]
    }
}

/// State of the method with several surfaces per beam. At edges, a beam flips between two surfaces, and both are
/// learned. [`Runs`] decides how many neighboring beams make an object.
#[derive(Clone)]
pub(super) struct Multi {
    slots: [Slots; SLOTS],
    /// Weight that the next surface of the beam gains: more if previous scans had no return.
    gain: Box<[i16]>,
    runs: Runs,
    /// The nearest background of each beam, and the weight that its surface gains, while a scan is processed.
    nearest: Box<[u16]>,
    gains: Box<[i16]>,
}

/// A surface of each beam, if it has one.
#[derive(Clone)]
struct Slots {
    /// In device units.
    range: Box<[u16]>,
    /// How well the surface is known. It grows with each scan in which the beam met it, and decreases in others.
    /// [`NONE`]: there is no surface.
    weight: Box<[i16]>,
}

/// Limits of the steps, as numbers that compare like signed ranges and weights.
#[derive(Clone, Copy)]
struct Bounds {
    threshold: i16,
    returned: i16,
    full: i16,
    known: i16,
    replaced: i16,
}

impl Multi {
    /// Creates the state for at most `beams` beams.
    pub(super) fn new(beams: usize) -> Multi {
        let all = |value: u16| vec![value; beams].into_boxed_slice();
        Multi {
            slots: std::array::from_fn(|_| Slots { range: all(0), weight: vec![NONE; beams].into() }),
            gain: vec![MET; beams].into(),
            runs: Runs::new(beams),
            nearest: all(INVALID),
            gains: vec![MET; beams].into(),
        }
    }

    /// Restores the initial state.
    pub(super) fn forget(&mut self) {
        self.slots.iter_mut().for_each(|slots| {
            slots.range.fill(0);
            slots.weight.fill(NONE);
        });
        self.gain.fill(MET);
        self.runs.forget();
    }

    /// Compares all beams with the state before this scan, then learns from them.
    pub(super) fn update(&mut self, readings: &[u16], limits: &Limits, learn: bool, classes: &mut [Class]) {
        let bounds = Bounds::of(limits);
        self.compare(readings, bounds, classes);
        let nearest = &self.nearest[..readings.len()];
        let mut left = 0;
        while let Some(unknown) = position(nearest, left, |range| range == INVALID) {
            let Some(known) = position(nearest, unknown, |range| range != INVALID) else { break };
            left = known;
            if let Some(right) = unknown.checked_sub(1) {
                self.compare_with_neighbors(right, left, readings, limits, classes);
            }
        }
        self.runs.keep(readings, limits, classes);
        if learn {
            self.learn(readings, bounds);
        }
    }

    /// Classifies each beam by its own background, and finds the nearest background of each beam; [`INVALID`] if there
    /// is none.
    #[inline(never)]
    fn compare(&mut self, readings: &[u16], bounds: Bounds, classes: &mut [Class]) {
        let n = readings.len();
        // All slices have one length, so the loop needs no bounds checks.
        let slots = self.slots.each_ref().map(|slots| (&slots.range[..n], &slots.weight[..n]));
        let (classes, nearest) = (&mut classes[..n], &mut self.nearest[..n]);
        for (i, ((&reading, class), nearest)) in readings.iter().zip(classes).zip(nearest).enumerate() {
            let (mut ends, mut known, mut range) = (false, false, Background::FAR);
            for (ranges, weights) in &slots {
                let is_known = weights[i] >= bounds.known;
                known |= is_known;
                ends |= is_known & (signed(ranges[i].abs_diff(reading)) <= bounds.threshold);
                range = if is_known & (ranges[i] < range) { ranges[i] } else { range };
            }
            *nearest = if known { range } else { INVALID };
            let aside = if reading < range { Class::Foreground } else { Class::Behind };
            let with_background = if ends { Class::Background } else { aside };
            let valid = if known { with_background } else { Class::Unknown };
            *class = if reading == INVALID { Class::Invalid } else { valid };
        }
    }

    /// Classifies the beams between `right` and `left`, which are the only ones of them with a known background. A beam
    /// that is near both is foreground if it ends nearer than both, and meets nothing that it has met for a while.
    fn compare_with_neighbors(
        &self,
        right: usize,
        left: usize,
        readings: &[u16],
        limits: &Limits,
        classes: &mut [Class],
    ) {
        let bounds = Bounds::of(limits);
        let limit = self.nearest[right].min(self.nearest[left]).saturating_sub(limits.threshold);
        for i in left.saturating_sub(ASIDE).max(right + 1)..left.min(right + ASIDE + 1) {
            let reading = readings[i];
            let met = |slots: &Slots| {
                slots.weight[i] >= bounds.replaced
                    && signed(slots.range[i].abs_diff(reading)) <= bounds.threshold
            };
            if reading < limit && reading != INVALID && !self.slots.iter().any(met) {
                classes[i] = Class::Foreground;
            }
        }
    }

    /// Updates the surfaces. The one nearest to a reading, within the threshold, was met. The others lose weight: those
    /// that the beam passed through more than those that may be hidden. A reading of no surface replaces the least
    /// known one, unless all are known too well.
    #[inline(never)]
    fn learn(&mut self, readings: &[u16], bounds: Bounds) {
        self.gain(readings, bounds);
        let n = readings.len();
        let gains = &self.gains[..n];
        let mut slots = self.slots.each_mut().map(|slots| (&mut slots.range[..n], &mut slots.weight[..n]));
        for (i, &reading) in readings.iter().enumerate() {
            let range = slots.each_ref().map(|(ranges, _)| ranges[i]);
            let weight = slots.each_ref().map(|(_, weights)| weights[i]);
            let (new_range, new_weight) = learned(range, weight, reading, gains[i], bounds);
            for (k, (ranges, weights)) in slots.iter_mut().enumerate() {
                ranges[i] = new_range[k];
                weights[i] = new_weight[k];
            }
        }
    }

    /// Computes the weights that the surfaces gain in this scan. A separate loop, because the processor does not do all
    /// of this at once in the loop over the surfaces.
    #[inline(never)]
    fn gain(&mut self, readings: &[u16], bounds: Bounds) {
        for ((gain, next), &reading) in self.gains.iter_mut().zip(&mut self.gain).zip(readings) {
            let is_far = reading == Background::FAR;
            *gain = if is_far { MET } else { *next };
            let more = (*next + MET).min(bounds.returned);
            let after = if is_far { more } else { MET };
            *next = if reading == INVALID { *next } else { after };
        }
    }

    /// Uses `range` as the only background of beam `i`, as well known as possible.
    pub(super) fn adopt(&mut self, i: usize, range: u16) {
        self.slots.iter_mut().for_each(|slots| slots.weight[i] = NONE);
        self.slots[0].range[i] = range;
        self.slots[0].weight[i] = i16::MAX;
    }

    /// Returns the best known background of beam `i`, and of equal ones the nearer one. A surface takes precedence over
    /// no return, however frequent: a model that starts with that range alone would report the surface as foreground.
    pub(super) fn background(&self, i: usize, limits: &Limits) -> u16 {
        let known = |slots: &&Slots| slots.weight[i] >= Bounds::of(limits).known;
        let rank = |s: &&Slots| (s.range[i] != Background::FAR, s.weight[i], u16::MAX - s.range[i]);
        let best = self.slots.iter().filter(known).max_by_key(rank);
        best.map_or(Background::UNTAUGHT, |slots| slots.range[i])
    }
}

/// Returns the surfaces of one beam after `reading`. The one that was met gains this weight.
#[inline]
fn learned(
    range: [u16; SLOTS],
    weight: [i16; SLOTS],
    reading: u16,
    gain: i16,
    bounds: Bounds,
) -> ([u16; SLOTS], [i16; SLOTS]) {
    const NOT_MET: i16 = i16::MAX;
    let mut apart = [NOT_MET; SLOTS];
    let mut least_apart = NOT_MET;
    for k in 0..SLOTS {
        let away = signed(range[k].abs_diff(reading));
        apart[k] = if (weight[k] > NONE) & (away <= bounds.threshold) { away } else { NOT_MET };
        least_apart = least_apart.min(apart[k]);
    }
    let (mut new_range, mut new_weight) = (range, weight);
    let valid = reading != INVALID;
    let mut open = valid & (least_apart != NOT_MET);
    let mut least = i16::MAX;
    for k in 0..SLOTS {
        let met = open & (apart[k] == least_apart);
        open &= !met;
        let step = (reading.wrapping_sub(range[k]) as i16) / DRAWN;
        new_range[k] = range[k].wrapping_add_signed(if met { step } else { 0 });
        let leak = if signed(reading) > signed(range[k]) { -PASSED } else { -HIDDEN };
        let change = if met { gain } else { leak };
        let change = if valid { change } else { 0 };
        new_weight[k] = weight[k].min(bounds.full).saturating_add(change).min(bounds.full);
        least = least.min(new_weight[k]);
    }
    let mut homeless = valid & (least_apart == NOT_MET) & (least < bounds.replaced);
    for k in 0..SLOTS {
        let replaced = homeless & (new_weight[k] == least);
        homeless &= !replaced;
        new_range[k] = if replaced { reading } else { new_range[k] };
        new_weight[k] = if replaced { NONE.wrapping_add(gain) } else { new_weight[k] };
    }
    (new_range, new_weight)
}

/// Maps unsigned to signed numbers in the same order. For 16 bits, SSE2 compares only signed ones in one instruction.
fn signed(value: u16) -> i16 {
    (value ^ 0x8000) as i16
}

impl Bounds {
    fn of(limits: &Limits) -> Bounds {
        let scans = limits.scans;
        Bounds {
            threshold: signed(limits.threshold),
            returned: MET * ((scans / RETURNED_OF).clamp(1, RETURNED) as i16),
            full: signed(MET as u16 * scans),
            known: signed(KNOWN * scans),
            replaced: signed(REPLACED * scans),
        }
    }
}

/// Number of surfaces per beam: two at an edge, and one that may replace either.
const SLOTS: usize = 3;
/// Divisor of the distance between a surface and a reading by which the surface moves, in whole units. Too slow to
/// follow a person who walks.
const DRAWN: i16 = 16;

/// Weight of a surface that does not exist.
const NONE: i16 = i16::MIN;
/// Weight of a scan in which the surface was met. It is fully known after the configured number of scans.
const MET: i16 = 8;
/// A surface also counts as met in the scans just before that had no return: at most this number, including the one in
/// which it was met, and at most one per this number of configured scans. So a wall that returns 15 % of the beams is
/// background after 5/4 of the configured scans, and a person who stands there no sooner because of a lost beam.
const RETURNED: u16 = 16;
const RETURNED_OF: u16 = 16;
/// Weight lost in a scan that saw something behind the surface. An object that was removed is no longer background
/// after 3/4 of the configured scans, and a surface that is met in more than a third of the scans finally becomes
/// background.
const PASSED: i16 = 4;
/// Weight lost in a scan that saw something in front of the surface, which may still exist. Not 0, because otherwise
/// all slots could be taken by hidden surfaces.
const HIDDEN: i16 = 1;
/// Weight per configured scan from which on a surface is background: 5/8 of the full weight, so that readings may be
/// missing.
const KNOWN: u16 = 5;
/// Weight per configured scan below which a surface can be replaced.
const REPLACED: u16 = 2;
/// Number of beams on either side among which one must be known, to replace an unknown one.
const ASIDE: usize = 8;
