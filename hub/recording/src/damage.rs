//! What is missing in a recording, as counts and as text.

use std::fmt;

/// Parts of a recording that could not be read; all zero if the file is intact.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Damage {
    /// Telegrams whose numbers are missing between others. Either the file or the recorder lost them.
    pub telegrams: u64,
    /// Bytes that were not read: those of damaged chunks and records, those after a place where the structure of the file is
    /// lost, and those outside the telegrams of a stream.
    pub bytes: u64,
    /// Chunks that were skipped because they are damaged.
    pub chunks: u64,
    /// Whether the file ends without its index, as after a kill.
    pub is_cut: bool,
    /// Whether the file differs from what was written: a checksum or a length is wrong.
    pub is_harmed: bool,
}

impl Damage {
    /// Returns whether nothing is missing.
    pub fn is_none(&self) -> bool {
        *self == Damage::default()
    }
}

/// In one line, `nothing` if nothing is missing.
impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counted = |count: u64, one: &str, more: &str| match count {
            0 => None,
            1 => Some(format!("1 {one}")),
            count => Some(format!("{count} {more}")),
        };
        let parts = [
            counted(self.telegrams, "telegram", "telegrams"),
            counted(self.chunks, "chunk", "chunks"),
            counted(self.bytes, "byte outside any telegram", "bytes outside any telegram"),
            self.is_cut.then(|| "the end of the file, with its index".to_owned()),
        ];
        let parts: Vec<_> = parts.into_iter().flatten().collect();
        match (&parts[..], self.is_harmed) {
            ([], true) => f.write_str("no telegram, but a checksum is wrong"),
            ([], false) => f.write_str("nothing"),
            _ => f.write_str(&parts.join(", ")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_what_is_missing() {
        assert_eq!(Damage::default().to_string(), "nothing");
        let damage = Damage { telegrams: 2, chunks: 1, is_cut: true, ..Damage::default() };
        let words = "2 telegrams, 1 chunk, the end of the file, with its index";
        assert_eq!(damage.to_string(), words);
        let damage = Damage { is_harmed: true, ..Damage::default() };
        assert_eq!(damage.to_string(), "no telegram, but a checksum is wrong");
    }
}
