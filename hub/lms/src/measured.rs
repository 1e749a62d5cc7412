//! The measured-value telegram B0h: a count word and one word a beam. What the words mean in millimetres depends on
//! the measuring mode, which the telegram does not carry.

use crate::telegram::{Encoded, REPLY, Telegram, Writer};
use crate::variant::{MAX_BEAMS, Unit};

/// Command byte of a measured-value telegram.
pub const MEASURED: u8 = 0xB0;

/// View of a measured-value telegram's data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Measured<'a> {
    count_word: u16,
    values: &'a [u8],
    indices: Option<(u8, u8)>,
}

impl<'a> Measured<'a> {
    /// The view, if `telegram` is one: command B0h, a known unit, as many words as it says, nothing else but the two
    /// real-time indices.
    pub fn decode(telegram: Telegram<'a>) -> Option<Self> {
        if telegram.command() != MEASURED || !telegram.is_reply() {
            return None;
        }
        let [low, high, rest @ ..] = telegram.data() else { return None };
        let count_word = u16::from_le_bytes([*low, *high]);
        Unit::of_code((count_word >> 14) as u8)?;
        let count = usize::from(count_word & COUNT);
        if count == 0 || count > MAX_BEAMS {
            return None;
        }
        let (values, after) = rest.split_at_checked(2 * count)?;
        let indices = match *after {
            [] => None,
            [scan, telegram] => Some((scan, telegram)),
            _ => return None,
        };
        Some(Measured { count_word, values, indices })
    }

    /// Number of beams: 1 to 401.
    pub fn count(&self) -> usize {
        self.values.len() / 2
    }

    /// Unit of the ranges.
    pub fn unit(&self) -> Unit {
        // decode() refused code 3.
        Unit::of_code((self.count_word >> 14) as u8).unwrap_or(Unit::Mm)
    }

    /// Of a partial scan, its start in quarters of a degree (0 to 3); `None` for a whole scan.
    pub fn partial(&self) -> Option<u8> {
        (self.count_word & PARTIAL != 0).then_some((self.count_word >> 11) as u8 & 3)
    }

    /// Scan index and telegram index, both modulo 256, where the sensor is set to send them.
    pub fn indices(&self) -> Option<(u8, u8)> {
        self.indices
    }

    /// The values as sent: range in the low bits, reflector level or field bits above (see [`crate::variant::Mode`]).
    pub fn words(&self) -> impl ExactSizeIterator<Item = u16> + use<'a> {
        self.values.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]))
    }
}

/// A measured-value telegram of a whole scan from the sensor at `address` (0 to 127): at most 401 `words` as they
/// are, then `status`.
pub fn encode(address: u8, unit: Unit, words: &[u16], status: u8) -> Encoded {
    let count_word = words.len() as u16 | u16::from(unit.code()) << 14;
    let mut writer = Writer::new(address | REPLY, MEASURED).word(count_word);
    for &word in words {
        writer = writer.word(word);
    }
    writer.byte(status).finish()
}

/// Bits of the count word that are the count.
const COUNT: u16 = 0x03FF;
/// Bit of the count word that marks a partial scan.
const PARTIAL: u16 = 1 << 13;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_synthetic_scan_of_the_reference() {
        let words: [u16; 361] = core::array::from_fn(|i| 1000 + i as u16);
        let encoded = encode(0, Unit::Mm, &words, 0x10);
        assert_eq!(encoded.bytes().len(), 732);
        assert_eq!(encoded.bytes()[..9], [0x02, 0x80, 0xD6, 0x02, 0xB0, 0x69, 0x41, 0xE8, 0x03]);
        assert_eq!(encoded.bytes()[727..], [0x50, 0x05, 0x10, 0x86, 0x0C]);
        let measured = Measured::decode(encoded.telegram()).unwrap();
        assert_eq!((measured.count(), measured.unit(), measured.partial()), (361, Unit::Mm, None));
        assert!(measured.words().eq(words));
    }

    #[test]
    fn a_count_that_lies_is_refused() {
        for (word, values) in [(361, 360), (361, 363), (0, 0), (402, 402), (0xC001, 1)] {
            let mut writer = Writer::new(0x80, MEASURED).word(word);
            for _ in 0..values {
                writer = writer.word(0);
            }
            assert_eq!(Measured::decode(writer.byte(0x10).finish().telegram()), None, "{word} {values}");
        }
        let with_indices = Writer::new(0x80, MEASURED).word(1).word(7).byte(3).byte(4).byte(0x10).finish();
        assert_eq!(Measured::decode(with_indices.telegram()).unwrap().indices(), Some((3, 4)));
    }
}
