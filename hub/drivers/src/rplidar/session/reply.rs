//! What an answer says, kept while the bytes that it came in go. Refuses to know what was asked.

/// What an answer says, apart from the framer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reply {
    bytes: [u8; 64],
    len: usize,
}

impl Reply {
    pub(super) fn new(data: &[u8]) -> Reply {
        let len = data.len().min(64);
        let mut bytes = [0; 64];
        bytes[..len].copy_from_slice(&data[..len]);
        Reply { bytes, len }
    }

    pub(super) fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// A number of one to four bytes.
pub(super) fn number(data: &[u8]) -> u32 {
    data.iter().take(4).rev().fold(0, |number, byte| number << 8 | u32::from(*byte))
}
