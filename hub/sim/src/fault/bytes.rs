//! Faults of single bytes: lost, flipped, doubled, or with random bytes before them. The random numbers of each byte are
//! drawn whatever else happens to it, so that the same seed hits the same bytes in every run.

use super::{Faults, random};

/// Loses bytes in bursts, the same ones in every run with the same seed.
#[derive(Clone, Debug)]
pub struct Loss {
    /// Chance that a burst begins with a byte that follows one that got through.
    begin: f64,
    /// Chance that a burst goes on.
    go_on: f64,
    inside: bool,
    random: fastrand::Rng,
}

impl Loss {
    /// The losses of `faults` with `seed`.
    pub fn new(faults: Faults, seed: u64) -> Self {
        Loss {
            // Bursts of mean b and, between them, runs of mean 1/begin: their share is b / (b + 1/begin).
            begin: faults.loss / (faults.burst * (1.0 - faults.loss)),
            go_on: 1.0 - 1.0 / faults.burst,
            inside: false,
            random: fastrand::Rng::with_seed(seed),
        }
    }

    /// Removes what is lost from `bytes`; returns whether anything was.
    pub fn apply(&mut self, bytes: &mut Vec<u8>) -> bool {
        let before = bytes.len();
        bytes.retain(|_| !self.next());
        bytes.len() < before
    }

    /// Whether the next byte is lost.
    fn next(&mut self) -> bool {
        if self.begin == 0.0 {
            return false;
        }
        let chance = if self.inside { self.go_on } else { self.begin };
        self.inside = self.random.f64() < chance;
        self.inside
    }
}

/// What becomes of a byte, and what comes before it.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Fate {
    /// Foreign bytes.
    pub(crate) before: Vec<u8>,
    pub(crate) lost: bool,
    /// Bits to turn over.
    pub(crate) flipped: u8,
    pub(crate) doubled: bool,
}

/// The faults of single bytes.
#[derive(Clone, Debug)]
pub(crate) struct Noise {
    loss: Loss,
    flip: f64,
    flip_bits: f64,
    /// Bits of a run that reach into the next byte.
    bits_left: u32,
    flips: fastrand::Rng,
    insert: f64,
    insert_burst: f64,
    inserts: fastrand::Rng,
    double: f64,
    doubles: fastrand::Rng,
}

impl Noise {
    pub(crate) fn new(faults: &Faults, seed: u64) -> Noise {
        Noise {
            loss: Loss::new(*faults, seed),
            flip: faults.flip,
            flip_bits: faults.flip_bits,
            bits_left: 0,
            flips: random(seed, 1),
            insert: faults.insert,
            insert_burst: faults.insert_burst,
            inserts: random(seed, 2),
            double: faults.double,
            doubles: random(seed, 3),
        }
    }

    /// The fate of the next byte.
    pub(crate) fn next(&mut self) -> Fate {
        Fate {
            before: self.inserted(),
            lost: self.loss.next(),
            flipped: self.flipped(),
            doubled: happens(&mut self.doubles, self.double),
        }
    }

    /// Bits leave the sensor lowest first, so a run goes on in the low bits of the next byte.
    fn flipped(&mut self) -> u8 {
        let mut first = 0;
        if self.bits_left == 0 {
            if !happens(&mut self.flips, self.flip) {
                return 0;
            }
            first = self.flips.u32(..8);
            self.bits_left = geometric(&mut self.flips, self.flip_bits);
        }
        let here = self.bits_left.min(8 - first);
        self.bits_left -= here;
        (((1u16 << here) - 1) << first) as u8
    }

    fn inserted(&mut self) -> Vec<u8> {
        if !happens(&mut self.inserts, self.insert) {
            return Vec::new();
        }
        let count = geometric(&mut self.inserts, self.insert_burst);
        (0..count).map(|_| self.inserts.u8(..)).collect()
    }
}

/// Draws only where something can happen at all.
pub(super) fn happens(random: &mut fastrand::Rng, share: f64) -> bool {
    share > 0.0 && random.f64() < share
}

/// 1 or more, `mean` on average.
fn geometric(random: &mut fastrand::Rng, mean: f64) -> u32 {
    let mut count = 1;
    while happens(random, 1.0 - 1.0 / mean) {
        count += 1;
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_the_bursts_and_the_damage_of_the_paper() {
        // 0.135 % of the bytes in bursts of 1.89 damage 40.8 % of 732-byte telegrams.
        let mut loss = Loss::new(Faults { loss: 0.00135, burst: 1.89, ..Faults::default() }, 1);
        let (telegrams, mut damaged, mut lost) = (20_000, 0, 0);
        for _ in 0..telegrams {
            let mut bytes = vec![0; 732];
            damaged += u32::from(loss.apply(&mut bytes));
            lost += 732 - bytes.len();
        }
        let share = lost as f64 / (732.0 * f64::from(telegrams));
        assert!((share - 0.00135).abs() < 0.00005, "{share}");
        let damaged = f64::from(damaged) / f64::from(telegrams);
        assert!((damaged - 0.408).abs() < 0.01, "{damaged}");
    }

    #[test]
    fn the_same_seed_loses_the_same_bytes_however_they_are_cut() {
        let faults = Faults { loss: 0.05, burst: 3.0, ..Faults::default() };
        let bytes: Vec<u8> = (0..5000).map(|i| i as u8).collect();
        let mut whole = bytes.clone();
        assert!(Loss::new(faults, 9).apply(&mut whole));
        let mut loss = Loss::new(faults, 9);
        let mut cut = Vec::new();
        for chunk in bytes.chunks(62) {
            let mut chunk = chunk.to_vec();
            loss.apply(&mut chunk);
            cut.append(&mut chunk);
        }
        assert_eq!(cut, whole);
        assert!(!Loss::new(Faults::default(), 9).apply(&mut whole));
    }

    #[test]
    fn shares_and_means_are_as_asked_for_and_each_fault_is_alone() {
        let faults =
            Faults { flip: 0.01, flip_bits: 3.0, insert: 0.02, insert_burst: 4.0, ..Faults::default() };
        let faults = Faults { double: 0.03, ..faults };
        let mut noise = Noise::new(&faults, 1);
        let fates: Vec<Fate> = (0..100_000).map(|_| noise.next()).collect();
        let bits: u32 = fates.iter().map(|fate| fate.flipped.count_ones()).sum();
        let inserted: usize = fates.iter().map(|fate| fate.before.len()).sum();
        let doubled = fates.iter().filter(|fate| fate.doubled).count();
        assert!((2_700..3_300).contains(&bits), "{bits}");
        assert!((7_300..8_700).contains(&inserted), "{inserted}");
        assert!((2_800..3_200).contains(&doubled), "{doubled}");
        let mut alone = Noise::new(&Faults { double: 0.03, ..Faults::default() }, 1);
        assert!(fates.iter().all(|fate| alone.next().doubled == fate.doubled));
        let mut nothing = Noise::new(&Faults::default(), 1);
        assert_eq!(nothing.next(), Fate::default());
    }
}
