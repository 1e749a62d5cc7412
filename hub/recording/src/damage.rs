//! What is missing in a recording, as counts and as text. Refuses to know how that was found.

use std::fmt;

/// What is missing; all zero if the file is intact.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Damage {
    /// Telegrams whose numbers are missing between others: the file lost them, or the recorder did.
    pub telegrams: u64,
    /// Bytes that are in nothing that could be read.
    pub bytes: u64,
    /// Packed chunks of which nothing could be read.
    pub chunks: u64,
    /// Telegrams whose header is missing: their stamps are estimated.
    pub estimated: u64,
    /// The start of the file is missing, even if only a byte: its description of itself may be gone.
    pub is_headless: bool,
    /// The file ends without its index, as after a kill.
    pub is_cut: bool,
    /// The structure of the file is wrong somewhere: a checksum, a length, an order.
    pub is_harmed: bool,
}

impl Damage {
    /// Whether nothing is missing.
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
            counted(self.bytes, "byte outside any telegram", "bytes outside any telegram"),
            counted(self.chunks, "packed chunk", "packed chunks"),
            counted(self.estimated, "stamp, which is estimated", "stamps, which are estimated"),
            self.is_headless.then(|| "the beginning of the file".to_owned()),
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
    fn what_is_missing_in_words() {
        assert_eq!(Damage::default().to_string(), "nothing");
        let damage = Damage { telegrams: 2, estimated: 1, is_cut: true, ..Damage::default() };
        let words = "2 telegrams, 1 stamp, which is estimated, the end of the file, with its index";
        assert_eq!(damage.to_string(), words);
        let damage = Damage { is_harmed: true, ..Damage::default() };
        assert_eq!(damage.to_string(), "no telegram, but a checksum is wrong");
    }
}
