//! Faults of whole telegrams: cut off, with another length field, sent again, broken off. The random numbers for all of
//! them are drawn when a telegram starts.

use super::bytes::happens;
use super::{Fault, Faults, random};
use scanhub_drivers::lms;

/// What is wrong with the telegram on the line.
#[derive(Clone, Debug)]
pub(crate) struct Blemishes {
    truncate: f64,
    length: f64,
    repeat: f64,
    abort: f64,
    random: fastrand::Rng,
    /// Share of this one's bytes that arrive.
    arrives: Option<f64>,
    /// Bits of its length field that are turned over; 0: none.
    mask: u16,
    repeats: bool,
    /// Share of its bytes after which the sensor breaks it off.
    breaks: Option<f64>,
    /// Its length, as far as it is known: all have as many bytes, or it announces it.
    len: usize,
    announces: bool,
}

impl Blemishes {
    pub(crate) fn new(faults: &Faults, seed: u64) -> Blemishes {
        Blemishes {
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

    /// A telegram begins; `len` if it does not announce its length.
    pub(crate) fn begin(&mut self, len: Option<usize>) {
        let shares = [self.random.f64(), self.random.f64()];
        // Half of the lengths are such that a telegram could have them.
        let masks = [self.random.u16(1..0x0400), self.random.u16(1..)];
        let mask = masks[usize::from(self.random.bool())];
        self.arrives = happens(&mut self.random, self.truncate).then_some(shares[0]);
        self.mask = if happens(&mut self.random, self.length) { mask } else { 0 };
        self.repeats = happens(&mut self.random, self.repeat);
        self.breaks = happens(&mut self.random, self.abort).then_some(shares[1]);
        self.len = len.unwrap_or(lms::telegram::FRAME);
        self.announces = len.is_none();
    }

    /// What becomes of `byte` at `position`: another one, or nothing.
    pub(crate) fn apply(&mut self, position: usize, byte: u8) -> (Option<u8>, Option<Fault>) {
        let [low, high] = self.mask.to_le_bytes();
        // Where all are of one length, a byte behind the first one says it.
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

    /// Whether the sensor breaks it off now that `position` bytes are through.
    pub(crate) fn breaks_at(&self, position: usize) -> bool {
        position > 4 && self.breaks.is_some_and(|share| position >= self.place(share))
    }

    /// Whether it comes again.
    pub(crate) fn repeats(&self) -> bool {
        self.repeats
    }

    /// The byte at `share` of its length, neither the first nor one behind the last.
    fn place(&self, share: f64) -> usize {
        1 + (share * (self.len - 1) as f64) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_truncated_telegram_loses_its_end_and_a_changed_length_is_another() {
        let telegram = lms::reply::mode(0, true, 0x10).bytes().to_vec();
        let mut cuts = std::collections::HashSet::new();
        let mut blemishes = Blemishes::new(&Faults { truncate: 1.0, ..Faults::default() }, 3);
        for _ in 0..200 {
            blemishes.begin(None);
            let arrived: Vec<u8> =
                telegram.iter().enumerate().filter_map(|(at, &byte)| blemishes.apply(at, byte).0).collect();
            assert!(arrived.len() < telegram.len() && telegram.starts_with(&arrived));
            cuts.insert(arrived.len());
        }
        assert_eq!(cuts.len(), 5, "{cuts:?}");
        let mut blemishes = Blemishes::new(&Faults { length: 1.0, ..Faults::default() }, 3);
        for _ in 0..200 {
            blemishes.begin(None);
            let arrived: Vec<u8> =
                telegram.iter().enumerate().filter_map(|(at, &byte)| blemishes.apply(at, byte).0).collect();
            assert!(arrived[2..4] != telegram[2..4] && arrived[4..] == telegram[4..]);
        }
    }
}
