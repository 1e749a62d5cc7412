//! Hash of all events of a world. If two runs have the same hash, they had the same events. The hash is the same in
//! debug and release builds and on every machine.

/// A hash of a sequence of bytes and numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct HistoryHash(u64);

impl HistoryHash {
    pub(crate) fn new() -> HistoryHash {
        HistoryHash(0x9E37_79B9_7F4A_7C15)
    }

    /// Adds a number.
    pub(crate) fn add_number(&mut self, value: u64) {
        let mixed = (self.0 ^ value).wrapping_mul(0xFF51_AFD7_ED55_8CCD);
        self.0 = mixed ^ (mixed >> 32);
    }

    /// Adds bytes and their count.
    pub(crate) fn add_bytes(&mut self, bytes: &[u8]) {
        let (words, rest) = bytes.as_chunks::<8>();
        words.iter().for_each(|word| self.add_number(u64::from_le_bytes(*word)));
        let mut last = [0; 8];
        last[..rest.len()].copy_from_slice(rest);
        self.add_number(u64::from_le_bytes(last));
        self.add_number(bytes.len() as u64);
    }

    /// Returns the hash of these bytes alone.
    pub(crate) fn hash_bytes(bytes: &[u8]) -> u64 {
        let mut history = HistoryHash::new();
        history.add_bytes(bytes);
        history.value()
    }

    pub(crate) fn value(self) -> u64 {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hash_depends_on_order_length_and_every_bit() {
        let of = |parts: &[&[u8]]| {
            let mut history = HistoryHash::new();
            parts.iter().for_each(|part| history.add_bytes(part));
            history.value()
        };
        let all = [of(&[b"ab"]), of(&[b"ba"]), of(&[b"a", b"b"]), of(&[b"ab\0"]), of(&[]), of(&[b""])];
        let different: std::collections::HashSet<_> = all.iter().collect();
        assert_eq!(different.len(), all.len());
        assert_eq!(of(&[b"123456789"]), of(&[b"123456789"]));
    }
}
