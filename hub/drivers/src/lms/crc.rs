//! The sensor's own checksum. No catalogue CRC computes it: it shifts one *bit* per *byte* and adds each byte
//! twice, once as it comes and once, a byte later, into the upper half.

/// Polynomial x^16 + x^15 + x^2 + 1 without its top term (Telegram listing 4, checked against 54 printed telegrams).
const POLYNOMIAL: u16 = 0x8005;

/// Checksum over `bytes`, STX up to and including the last byte before the checksum itself. It is sent low byte
/// first.
pub fn crc(bytes: &[u8]) -> u16 {
    let mut crc = 0u16;
    let mut previous = 0u8;
    for &byte in bytes {
        // All ones where the bit about to be shifted out is set: no branch that real data could mispredict.
        let carry = ((crc as i16) >> 15) as u16;
        crc = (crc << 1) ^ u16::from_le_bytes([byte, previous]) ^ (carry & POLYNOMIAL);
        previous = byte;
    }
    crc
}

#[cfg(test)]
mod tests {
    use super::crc;

    #[test]
    fn printed_telegrams() {
        assert_eq!(crc(&[0x02, 0x00, 0x01, 0x00, 0x31]), 0x1215);
        assert_eq!(crc(&[0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10]), 0x0A16);
        assert_eq!(crc(&[0x02, 0x81, 0x03, 0x00, 0xA0, 0x00, 0x10]), 0x1A36);
        assert_eq!(crc(b"\x02\x00\x0A\x00\x20\x00SICK_LMS"), 0xC5BE);
        assert_eq!(crc(&[]), 0);
    }
}
