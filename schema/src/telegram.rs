//! The payload of topic `telegram`: one telegram's bytes, of an LMS STX to CRC, and the positions of its fields. Refuses to
//! check or interpret them: every published telegram had a correct checksum.

/// A telegram's bytes with names for its fields.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Telegram<'a>(pub &'a [u8]);

impl<'a> Telegram<'a> {
    /// The longest telegram there is, in bytes: STX to CRC (Telegram listing: 812 and its two bytes of CRC).
    pub const MAX: usize = 814;

    /// Returns whether they are a telegram of an LMS, which has the fields below. Of other families they are whole packets, as
    /// many as arrived together.
    pub fn is_lms(self) -> bool {
        self.0.first() == Some(&STX)
    }

    /// Returns the address byte (to the sensor, or its answer's 80h + address); 0 if the bytes end before.
    pub fn address(self) -> u8 {
        self.0.get(1).copied().unwrap_or_default()
    }

    /// Returns the length field: bytes from the command to the status, both included.
    pub fn length(self) -> u16 {
        match self.0.get(2..4) {
            Some(bytes) => u16::from_le_bytes([bytes[0], bytes[1]]),
            None => 0,
        }
    }

    /// Returns the command or answer byte; 0 if the bytes end before.
    pub fn command(self) -> u8 {
        self.0.get(4).copied().unwrap_or_default()
    }

    /// Returns what lies between command and CRC: the data and, last, the status byte.
    pub fn data(self) -> &'a [u8] {
        self.0.get(5..self.0.len().saturating_sub(2)).unwrap_or_default()
    }
}

/// Begins every telegram of an LMS (Telegram listing 4), and no packet of another family.
pub(crate) const STX: u8 = 0x02;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_of_an_answer() {
        let telegram = Telegram(&[0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A]);
        assert_eq!((telegram.address(), telegram.length(), telegram.command()), (0x80, 3, 0xA0));
        assert_eq!(telegram.data(), [0x00, 0x10]);
        assert!(Telegram(&[0x02]).data().is_empty());
    }
}
