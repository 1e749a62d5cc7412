//! The payload of topic `telegram`: what the scanner sent, in the unit in which its family transmits. Of an LMS that is one
//! telegram, STX to CRC; of other families whole packets that arrived together. Refuses to check or interpret more than the
//! positions of fields: what is published was checked.

use crate::{Family, PacketFacts};

/// What a scanner sent, with names for its fields.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Telegram<'a> {
    /// Of which family it is; nothing if this version does not know it.
    pub family: Option<Family>,
    /// Its bytes, as they came.
    pub bytes: &'a [u8],
}

impl<'a> Telegram<'a> {
    /// Maximum length of a telegram of any family, in bytes.
    pub const MAX: usize = {
        let (mut max, mut at) = (0, 0);
        while at < Family::ALL.len() {
            let len = Family::ALL[at].max_telegram();
            max = if len > max { len } else { max };
            at += 1;
        }
        max
    };

    /// Returns the telegram with which a payload of `family`'s begins: of an LMS its length field says how long it is, and what
    /// follows is a later revision's; of another family it is all of the payload. Nothing if there is none, or if it is longer
    /// than [`MAX`](Self::MAX).
    pub fn of(family: u8, payload: &'a [u8]) -> Option<Telegram<'a>> {
        let family = Family::of_number(family);
        let len = match (family, payload) {
            (Some(Family::Lms), [STX, _, low, high, ..]) => {
                usize::from(u16::from_le_bytes([*low, *high])) + AROUND_DATA
            }
            (Some(Family::Lms), _) | (_, []) => return None,
            _ => payload.len(),
        };
        let bytes = payload.get(..len).filter(|bytes| bytes.len() <= Telegram::MAX)?;
        Some(Telegram { family, bytes })
    }

    /// Returns whether they are a telegram of an LMS, which has the fields below.
    pub fn is_lms(self) -> bool {
        self.family == Some(Family::Lms)
    }

    /// Returns what can be said of packets; nothing of an LMS, and of a family that this version does not know.
    pub fn packets(self) -> Option<PacketFacts> {
        self.family?.packets(self.bytes)
    }

    /// Returns the address byte (to the sensor, or its answer's 80h + address); 0 if the bytes end before.
    pub fn address(self) -> u8 {
        self.bytes.get(1).copied().unwrap_or_default()
    }

    /// Returns the length field: bytes from the command to the status, both included.
    pub fn length(self) -> u16 {
        match self.bytes.get(2..4) {
            Some(bytes) => u16::from_le_bytes([bytes[0], bytes[1]]),
            None => 0,
        }
    }

    /// Returns the command or answer byte; 0 if the bytes end before.
    pub fn command(self) -> u8 {
        self.bytes.get(4).copied().unwrap_or_default()
    }

    /// Returns what lies between command and CRC: the data and, last, the status byte.
    pub fn data(self) -> &'a [u8] {
        self.bytes.get(5..self.bytes.len().saturating_sub(2)).unwrap_or_default()
    }
}

/// Begins every telegram of an LMS (Telegram listing 4).
const STX: u8 = 0x02;
/// STX, address, length and CRC (Telegram listing 4).
const AROUND_DATA: usize = 6;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_of_an_answer() {
        let bytes = [0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A];
        let longer = [&bytes[..], &[7; 5]].concat();
        let telegram = Telegram::of(Family::Lms as u8, &longer).expect("what follows is a later revision's");
        assert_eq!((telegram.bytes, telegram.packets()), (&bytes[..], None));
        assert_eq!((telegram.address(), telegram.length(), telegram.command()), (0x80, 3, 0xA0));
        assert_eq!(telegram.data(), [0x00, 0x10]);
        assert!(Telegram { bytes: &[0x02], ..telegram }.data().is_empty());
        for short in 0..bytes.len() {
            assert_eq!(Telegram::of(Family::Lms as u8, &bytes[..short]), None);
        }
    }

    #[test]
    fn packets_are_all_of_the_payload_whatever_they_begin_with() {
        let bytes = [2; 3 * 47];
        let telegram = Telegram::of(Family::Ld as u8, &bytes).expect("packets");
        let facts = telegram.packets().expect("no LMS");
        assert_eq!((facts.kind, facts.checked, facts.packets), ("data", Some(true), 3));
        let of_tomorrow = Telegram::of(99, &bytes).expect("bytes");
        assert_eq!((of_tomorrow.bytes, of_tomorrow.packets()), (&bytes[..], None));
        for family in Family::ALL.into_iter().filter(|family| *family != Family::Lms) {
            assert_eq!(Telegram::of(family as u8, &[]), None);
            assert_eq!(Telegram::of(family as u8, &[1; Telegram::MAX + 1]), None);
        }
    }
}
