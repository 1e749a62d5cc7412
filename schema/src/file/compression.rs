//! How the chunks of a recording are compressed. Refuses to know what is in them.

use crate::{Failure, Kind};

/// How chunks are packed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Compression {
    /// As they are: what is found in a harmed file is found in these.
    None,
    /// Packed by LZ4.
    Lz4,
    /// Packed by Zstandard: the shortest.
    #[default]
    Zstd,
}

impl Compression {
    /// Returns what `text` names: `zstd`, `lz4` or `none`.
    ///
    /// # Errors
    ///
    /// [`Kind::Usage`] if it is none of them.
    pub fn parse(text: &str) -> Result<Compression, Failure> {
        match text {
            "zstd" => Ok(Compression::Zstd),
            "lz4" => Ok(Compression::Lz4),
            "none" => Ok(Compression::None),
            _ => Err(Failure::new(Kind::Usage, format!("no compression {text:?}"), "zstd, lz4 or none")),
        }
    }

    pub(super) fn of_library(self) -> Option<mcap::Compression> {
        match self {
            Compression::None => None,
            Compression::Lz4 => Some(mcap::Compression::Lz4),
            Compression::Zstd => Some(mcap::Compression::Zstd),
        }
    }

    /// Higher ones take many times as long for some hundredths less.
    pub(super) fn level(self) -> u32 {
        u32::from(self == Compression::Zstd)
    }
}
