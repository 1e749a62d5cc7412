//! One telegram: a view that exists only if its length and checksum are right, and a writer.
//!
//! `02 | ADR | LENGTH, 2 bytes | COMMAND | DATA .. | [STATUS, replies only] | CRC, 2 bytes` (Telegram listing 4).
//! LENGTH counts the bytes from command to status. [`crate::lms::command`] and [`crate::lms::reply`] decode the data.

use core::fmt;

/// First byte of every telegram.
pub const STX: u8 = 0x02;
/// Byte before a reply. It states that the address and the checksum of the request were right.
pub const ACK: u8 = 0x06;
/// Byte instead of a reply. It states that the address of the request was right, but its checksum was wrong.
pub const NAK: u8 = 0x15;
/// Bit that a scanner adds to its address in its telegrams, and to the command of a request in the reply.
pub const REPLY: u8 = 0x80;
/// Number of bytes that LENGTH does not count: STX, address, two length bytes, two checksum bytes.
pub const FRAME_LEN: usize = 6;
/// Maximum LENGTH, which a telegram with 401 values and real-time indices has.
pub const MAX_LENGTH: usize = 808;
/// Length of the longest telegram in bytes.
pub const MAX_TELEGRAM: usize = MAX_LENGTH + FRAME_LEN;

/// View of a complete telegram whose length and checksum are right. The bytes are in the caller's buffer.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Telegram<'a>(&'a [u8]);

impl<'a> Telegram<'a> {
    /// Returns the telegram in `bytes`, from STX to the second checksum byte. Returns `None` if `bytes` is not exactly
    /// one telegram.
    pub fn check(bytes: &'a [u8]) -> Option<Self> {
        Telegram::check_with(bytes, Checksum::default())
    }

    /// Checks `bytes` like [`Telegram::check`]. `checksum` may already include the first bytes of the telegram.
    pub(crate) fn check_with(bytes: &'a [u8], checksum: Checksum) -> Option<Self> {
        let [STX, _, low, high, _, .., crc_low, crc_high] = *bytes else { return None };
        let length = usize::from(u16::from_le_bytes([low, high]));
        let is_len_valid = (1..=MAX_LENGTH).contains(&length) && bytes.len() == length + FRAME_LEN;
        let (covered, _) = bytes.split_at(bytes.len() - 2);
        (is_len_valid && checksum.of(covered) == u16::from_le_bytes([crc_low, crc_high]))
            .then_some(Telegram(bytes))
    }

    /// Returns the telegram in bytes that [`Telegram::check`] has already accepted.
    pub(crate) fn assume_valid(bytes: &'a [u8]) -> Self {
        debug_assert!(Telegram::check(bytes).is_some());
        Telegram(bytes)
    }

    /// Returns all bytes, from STX to the checksum.
    pub fn bytes(&self) -> &'a [u8] {
        self.0
    }

    /// Returns the address byte. A scanner sends its own address + 80h.
    pub fn address(&self) -> u8 {
        self.0[1]
    }

    /// Returns whether a scanner sent the telegram, so that its data end with a status byte.
    pub fn is_reply(&self) -> bool {
        self.address() & REPLY != 0
    }

    /// Returns LENGTH, the number of bytes from command to status.
    pub fn length(&self) -> usize {
        self.0.len() - FRAME_LEN
    }

    /// Returns the command byte. In a reply, it is the command byte of the request + 80h.
    pub fn command(&self) -> u8 {
        self.0[4]
    }

    /// Returns the bytes between command and checksum, without the status byte of a reply.
    pub fn data(&self) -> &'a [u8] {
        let end = self.0.len() - 2 - usize::from(self.is_reply() && self.length() > 1);
        &self.0[5..end]
    }

    /// Returns the status byte of a reply (Telegram listing 8): bits 0 to 2 are the severity, bit 6 means implausible
    /// values, bit 7 a dirty window. Returns `None` for a request.
    pub fn status(&self) -> Option<u8> {
        (self.is_reply() && self.length() > 1).then(|| self.0[self.0.len() - 3])
    }
}

impl fmt::Debug for Telegram<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "Telegram({:02X} of {} bytes, address {:02X})",
            self.command(),
            self.0.len(),
            self.address()
        )
    }
}

/// Writer of a telegram. Its buffer has room for a telegram of the maximum length.
#[derive(Clone)]
pub struct Writer {
    bytes: [u8; MAX_TELEGRAM],
    len: usize,
}

impl Writer {
    /// Starts a telegram with `command` to the scanner at `address`. If `address` includes [`REPLY`], the telegram is
    /// from this scanner.
    pub fn new(address: u8, command: u8) -> Self {
        let mut bytes = [0; MAX_TELEGRAM];
        bytes[..5].copy_from_slice(&[STX, address, 0, 0, command]);
        Writer { bytes, len: 5 }
    }

    /// Appends one byte.
    ///
    /// # Panics
    ///
    /// Panics if the telegram is longer than [`MAX_TELEGRAM`].
    pub fn byte(mut self, byte: u8) -> Self {
        self.bytes[self.len] = byte;
        self.len += 1;
        self
    }

    /// Appends a word, low byte first.
    pub fn word(self, word: u16) -> Self {
        let [low, high] = word.to_le_bytes();
        self.byte(low).byte(high)
    }

    /// Appends bytes.
    pub fn slice(mut self, bytes: &[u8]) -> Self {
        self.bytes[self.len..self.len + bytes.len()].copy_from_slice(bytes);
        self.len += bytes.len();
        self
    }

    /// Appends bytes. Returns `None` if no space is left for the status byte at the end of a reply.
    pub(crate) fn reply_slice(self, bytes: &[u8]) -> Option<Self> {
        (self.length() + bytes.len() < MAX_LENGTH).then(|| self.slice(bytes))
    }

    /// Returns the LENGTH so far. It counts the command and all appended bytes.
    pub fn length(&self) -> usize {
        self.len - 4
    }

    /// Writes the length and the checksum. Append the status byte of a reply before this call.
    pub fn finish(mut self) -> EncodedTelegram {
        let [low, high] = (self.length() as u16).to_le_bytes();
        self.bytes[2] = low;
        self.bytes[3] = high;
        let sum = crc(&self.bytes[..self.len]);
        EncodedTelegram(self.word(sum))
    }
}

/// An encoded telegram in its own buffer.
#[derive(Clone)]
pub struct EncodedTelegram(Writer);

impl EncodedTelegram {
    /// Copies `telegram`.
    pub fn of(telegram: Telegram<'_>) -> EncodedTelegram {
        let mut bytes = [0; MAX_TELEGRAM];
        bytes[..telegram.0.len()].copy_from_slice(telegram.0);
        EncodedTelegram(Writer { bytes, len: telegram.0.len() })
    }

    /// Returns all bytes, from STX to the checksum.
    pub fn bytes(&self) -> &[u8] {
        &self.0.bytes[..self.0.len]
    }

    /// Returns a view of the telegram.
    pub fn telegram(&self) -> Telegram<'_> {
        Telegram(self.bytes())
    }
}

impl fmt::Debug for EncodedTelegram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.telegram().fmt(f)
    }
}

/// Returns the checksum of `bytes`, from STX to the last byte before the checksum. A telegram contains the checksum
/// with its low byte first.
pub fn crc(bytes: &[u8]) -> u16 {
    Checksum::default().of(bytes)
}

/// Incremental checksum of a telegram.
///
/// The manual defines the checksum byte by byte: `crc = crc * x + previous * x^8 + byte`, modulo x^16 + x^15 + x^2 + 1
/// over GF(2) (Telegram listing 4, checked against 54 printed telegrams). The checksum also follows from a sum S, in
/// which each byte is multiplied by x once for every byte after it: `crc = S + (S + last byte) * x^7`. Each step adds
/// eight bytes to S.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Checksum {
    /// Number of bytes in the sum, a multiple of 8.
    len: usize,
    sum: u16,
}

impl Checksum {
    /// Adds the bytes of the telegram that the sum does not include yet. `bytes` starts with the first byte of the
    /// telegram. Up to seven bytes stay for the next call.
    pub(crate) fn extend(&mut self, bytes: &[u8]) {
        let (words, _) = bytes[self.len..].as_chunks();
        let add = |(sum, carry), &word| {
            let (sum, high) = shift(sum, 8);
            (sum ^ polynomial(word), carry ^ high)
        };
        let (sum, carry) = words.iter().fold((self.sum, 0), add);
        self.sum = sum ^ residue(carry);
        self.len += 8 * words.len();
    }

    /// Returns the checksum of `bytes`. `bytes` starts with the bytes that the sum already includes.
    fn of(mut self, bytes: &[u8]) -> u16 {
        self.extend(bytes);
        let rest = &bytes[self.len..];
        let sum = rest.iter().fold(self.sum, |sum, &byte| times_x(sum, 1) ^ u16::from(byte));
        sum ^ times_x(sum ^ bytes.last().map_or(0, |&byte| byte.into()), 7)
    }
}

/// Returns `sum * x^power`; `power` is at most 8.
#[inline]
fn times_x(sum: u16, power: u32) -> u16 {
    let (product, high) = shift(sum, power);
    product ^ residue(high)
}

/// Multiplies `sum` by `x^power`. Returns a partly reduced product, and h, which is the part of the unreduced product
/// from x^16 on. The caller must add the [`residue`] of h to the product, because `h * x^16` is `h * (x^2 + x)` plus
/// this residue.
#[inline]
fn shift(sum: u16, power: u32) -> (u16, u16) {
    let high = sum >> (16 - power);
    ((sum << power) ^ (high << 2) ^ (high << 1), high)
}

/// Returns x^15 + x + 1 if `polynomial` has an odd number of terms, otherwise 0. The product of a polynomial and x has
/// the same residue as the polynomial, so the residues of many steps can be added at once.
#[inline]
fn residue(polynomial: u16) -> u16 {
    let odd = (polynomial.count_ones() as u16 & 1).wrapping_neg();
    odd & 0x8003
}

/// Returns the sum of eight bytes. The first byte is multiplied by x^7, and the last byte by 1.
#[inline]
fn polynomial(bytes: [u8; 8]) -> u16 {
    const LOW: u64 = 0x00FF_00FF_00FF_00FF;
    let word = u64::from_be_bytes(bytes);
    let pairs = ((word >> 8 & LOW) << 1) ^ (word & LOW);
    let fours = (pairs >> 14) ^ pairs;
    ((fours >> 28) ^ fours) as u16
}

#[cfg(test)]
mod tests {
    use super::{crc, *};

    #[test]
    fn view_exists_only_if_the_checksum_is_right() {
        let good = [0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A];
        let telegram = Telegram::check(&good).unwrap();
        assert_eq!((telegram.address(), telegram.command(), telegram.length()), (0x80, 0xA0, 3));
        assert_eq!((telegram.data(), telegram.status()), (&[0u8][..], Some(0x10)));
        for at in 0..good.len() {
            for bit in 0..8 {
                let mut bad = good;
                bad[at] ^= 1 << bit;
                assert_eq!(Telegram::check(&bad), None, "byte {at} bit {bit}");
            }
            assert_eq!(Telegram::check(&good[..at]), None);
        }
    }

    #[test]
    fn written_telegram_passes_the_check() {
        let encoded = Writer::new(0x00, 0x20).byte(0x24).finish();
        assert_eq!(encoded.bytes(), [0x02, 0x00, 0x02, 0x00, 0x20, 0x24, 0x34, 0x08]);
        assert_eq!(Telegram::check(encoded.bytes()), Some(encoded.telegram()));
        assert_eq!(encoded.telegram().data(), [0x24]);
        assert_eq!(encoded.telegram().status(), None);
    }

    #[test]
    fn crc_matches_printed_telegrams() {
        assert_eq!(crc(&[0x02, 0x00, 0x01, 0x00, 0x31]), 0x1215);
        assert_eq!(crc(&[0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10]), 0x0A16);
        assert_eq!(crc(&[0x02, 0x81, 0x03, 0x00, 0xA0, 0x00, 0x10]), 0x1A36);
        assert_eq!(crc(b"\x02\x00\x0A\x00\x20\x00SICK_LMS"), 0xC5BE);
        assert_eq!(crc(&[]), 0);
    }

    /// Returns the checksum as the manual defines it.
    fn manual_crc(bytes: &[u8]) -> u16 {
        let step = |(crc, previous): (u16, u8), &byte: &u8| {
            let carry = if crc & 0x8000 == 0 { 0 } else { 0x8005 };
            ((crc << 1) ^ carry ^ u16::from_le_bytes([byte, previous]), byte)
        };
        bytes.iter().fold((0, 0), step).0
    }

    #[test]
    fn checksum_matches_the_manual_for_any_chunking() {
        let mut random = fastrand::Rng::with_seed(1);
        for len in 0..MAX_TELEGRAM {
            let bytes: Vec<u8> = core::iter::repeat_with(|| random.u8(..)).take(len).collect();
            let mut checksum = Checksum::default();
            let mut arrived = 0;
            while arrived < len {
                arrived = len.min(arrived + random.usize(1..100));
                checksum.extend(&bytes[..arrived]);
            }
            assert_eq!([crc(&bytes), checksum.of(&bytes)], [manual_crc(&bytes); 2], "{len} bytes");
        }
    }
}
