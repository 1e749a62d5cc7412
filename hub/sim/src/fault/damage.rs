//! Damage to bytes and telegrams. A byte is lost, flipped or doubled, or has random bytes before it. A telegram is
//! truncated, broken off or sent twice, or has another length field.
//!
//! The random numbers of each byte are drawn in any case, so that the same seed damages the same bytes in every run.
//! Those of a telegram are drawn at its start.

use scanhub_drivers::lms;

use super::{Fault, Faults, random};

/// Loses bytes in bursts, the same ones in every run with the same seed.
#[derive(Clone, Debug)]
pub struct Loss {
    /// Probability that a burst begins after a byte that arrived.
    begin: f64,
    /// Probability that a burst continues.
    go_on: f64,
    inside: bool,
    random: fastrand::Rng,
}

impl Loss {
    /// Creates the losses of `faults` with `seed`.
    pub fn new(faults: Faults, seed: u64) -> Self {
        Loss {
            // Bursts of mean b and, between them, runs of mean 1/begin: their share is b / (b + 1/begin).
            begin: faults.loss / (faults.burst * (1.0 - faults.loss)),
            go_on: 1.0 - 1.0 / faults.burst,
            inside: false,
            random: fastrand::Rng::with_seed(seed),
        }
    }

    /// Removes the lost bytes from `bytes`. Returns whether any byte was lost.
    pub fn apply(&mut self, bytes: &mut Vec<u8>) -> bool {
        let before = bytes.len();
        bytes.retain(|_| !self.next());
        bytes.len() < before
    }

    /// Returns whether the next byte is lost.
    fn next(&mut self) -> bool {
        if self.begin == 0.0 {
            return false;
        }
        let chance = if self.inside { self.go_on } else { self.begin };
        self.inside = self.random.f64() < chance;
        self.inside
    }
}

/// Damage to one byte.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Fate {
    /// Inserted bytes before this one.
    pub(crate) before: Vec<u8>,
    pub(crate) lost: bool,
    /// Mask of the flipped bits.
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

    /// Returns the damage to the next byte.
    pub(crate) fn next(&mut self) -> Fate {
        Fate {
            before: self.inserted(),
            lost: self.loss.next(),
            flipped: self.flipped(),
            doubled: happens(&mut self.doubles, self.double),
        }
    }

    /// Returns the mask of flipped bits. The lowest bit is sent first, so a run continues in the low bits of the next
    /// byte.
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

/// Returns whether an event with the probability `share` happens. Draws no number if `share` is 0.
pub(super) fn happens(random: &mut fastrand::Rng, share: f64) -> bool {
    share > 0.0 && random.f64() < share
}

/// Returns a number from a geometric distribution: 1 or more, `mean` on average.
fn geometric(random: &mut fastrand::Rng, mean: f64) -> u32 {
    let mut count = 1;
    while happens(random, 1.0 - 1.0 / mean) {
        count += 1;
    }
    count
}

/// The faults of the telegram on the line.
#[derive(Clone, Debug)]
pub(crate) struct TelegramFaults {
    truncate: f64,
    length: f64,
    repeat: f64,
    abort: f64,
    random: fastrand::Rng,
    /// Share of the bytes that arrive, if the telegram is truncated.
    arrives: Option<f64>,
    /// Mask of the flipped bits of the length field; 0 if there are none.
    mask: u16,
    repeats: bool,
    /// Share of the bytes after which the scanner breaks off the telegram.
    breaks: Option<f64>,
    /// Length of the telegram, as far as its bytes have announced it.
    len: usize,
    announces: bool,
}

impl TelegramFaults {
    pub(crate) fn new(faults: &Faults, seed: u64) -> TelegramFaults {
        TelegramFaults {
            truncate: faults.truncate,
            length: faults.length,
            repeat: faults.repeat,
            abort: faults.abort,
            random: random(seed, 4),
            arrives: None,
            mask: 0,
            repeats: false,
            breaks: None,
            len: 0,
            announces: true,
        }
    }

    /// Starts a telegram. It has `len` bytes, or announces its length.
    pub(crate) fn begin(&mut self, len: Option<usize>) {
        let shares = [self.random.f64(), self.random.f64()];
        // Half of the changed lengths are valid.
        let masks = [self.random.u16(1..0x0400), self.random.u16(1..)];
        let mask = masks[usize::from(self.random.bool())];
        self.arrives = happens(&mut self.random, self.truncate).then_some(shares[0]);
        self.mask = if happens(&mut self.random, self.length) { mask } else { 0 };
        self.repeats = happens(&mut self.random, self.repeat);
        self.breaks = happens(&mut self.random, self.abort).then_some(shares[1]);
        self.len = len.unwrap_or(lms::telegram::FRAME);
        self.announces = len.is_none();
    }

    /// Returns the byte that arrives for `byte` at `position`, or `None` if it is lost, and the fault.
    pub(crate) fn apply(&mut self, position: usize, byte: u8) -> (Option<u8>, Option<Fault>) {
        let [low, high] = self.mask.to_le_bytes();
        // Telegrams of a fixed length have it in the byte after the first one.
        let flipped = match (self.announces, position) {
            (true, 2) | (false, 1) => low,
            (true, 3) => high,
            _ => 0,
        };
        match position {
            2 if self.announces => self.len += usize::from(byte),
            3 if self.announces => self.len += usize::from(byte) << 8,
            _ => {}
        }
        if position > 3 && self.arrives.is_some_and(|share| position >= self.place(share)) {
            return (None, Some(Fault::Truncated));
        }
        (Some(byte ^ flipped), (flipped != 0).then_some(Fault::Length))
    }

    /// Returns whether the scanner breaks off the telegram after `position` bytes.
    pub(crate) fn breaks_at(&self, position: usize) -> bool {
        position > 4 && self.breaks.is_some_and(|share| position >= self.place(share))
    }

    /// Returns whether the telegram is sent twice.
    pub(crate) fn repeats(&self) -> bool {
        self.repeats
    }

    /// Returns the position at `share` of the length, after the first byte and within the telegram.
    fn place(&self, share: f64) -> usize {
        1 + (share * (self.len - 1) as f64) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damages_share_of_telegrams_as_measured() {
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
    fn loses_same_bytes_for_any_chunk_size() {
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
    fn faults_have_configured_shares_and_are_independent() {
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

    #[test]
    fn truncates_telegrams_and_changes_lengths() {
        let telegram = lms::reply::mode(0, true, 0x10).bytes().to_vec();
        let mut cuts = std::collections::HashSet::new();
        let mut telegram_faults = TelegramFaults::new(&Faults { truncate: 1.0, ..Faults::default() }, 3);
        for _ in 0..200 {
            telegram_faults.begin(None);
            let arrived: Vec<u8> = telegram
                .iter()
                .enumerate()
                .filter_map(|(at, &byte)| telegram_faults.apply(at, byte).0)
                .collect();
            assert!(arrived.len() < telegram.len() && telegram.starts_with(&arrived));
            cuts.insert(arrived.len());
        }
        assert_eq!(cuts.len(), 5, "{cuts:?}");
        let mut telegram_faults = TelegramFaults::new(&Faults { length: 1.0, ..Faults::default() }, 3);
        for _ in 0..200 {
            telegram_faults.begin(None);
            let arrived: Vec<u8> = telegram
                .iter()
                .enumerate()
                .filter_map(|(at, &byte)| telegram_faults.apply(at, byte).0)
                .collect();
            assert!(arrived[2..4] != telegram[2..4] && arrived[4..] == telegram[4..]);
        }
    }
}
