//! How the content of a file is found: record by record if it is intact, else by a search. Refuses to know what it is.

use std::io::{self, Read};

use mcap::McapError;

use super::records::Records;
use super::salvage::{Account, Found, Salvage};

/// A file, from its beginning to its end.
pub(crate) enum Source<R> {
    /// Read as it says itself; an error where it is not sound.
    Sound(Records<R>),
    /// Searched.
    Harmed(Salvage<R>),
}

impl<R: Read> Source<R> {
    pub(crate) fn of(input: R, is_sound: bool) -> Self {
        if is_sound { Source::Sound(Records::new(input)) } else { Source::Harmed(Salvage::new(input)) }
    }

    /// What comes next. Of a file that is not sound an error of kind `InvalidData` or `UnexpectedEof`; `Unsupported` of
    /// one whose chunks are packed in a way that is not read here.
    pub(crate) fn next(&mut self) -> io::Result<Option<Found>> {
        match self {
            Source::Sound(records) => match records.next() {
                Ok(record) => Ok(record.map(Found::Proven)),
                Err(error) => Err(unsound(error)),
            },
            Source::Harmed(salvage) => salvage.next(),
        }
    }

    /// What belongs to nothing, of a file that is searched.
    pub(crate) fn account(&self) -> Option<Account> {
        match self {
            Source::Sound(_) => None,
            Source::Harmed(salvage) => Some(salvage.account()),
        }
    }
}

fn unsound(error: McapError) -> io::Error {
    match error {
        // What LZ4 says of a chunk that it cannot unpack; the system's errors have a number, gzip's another kind.
        McapError::Io(error) if error.kind() == io::ErrorKind::Other && error.raw_os_error().is_none() => {
            io::Error::new(io::ErrorKind::InvalidData, error)
        }
        McapError::Io(error) => error,
        McapError::UnexpectedEof => io::ErrorKind::UnexpectedEof.into(),
        McapError::UnsupportedCompression(name) if matches!(&name[..], "lz4" | "zstd") => {
            io::Error::new(io::ErrorKind::Unsupported, format!("its chunks are packed by {name}"))
        }
        other => io::Error::new(io::ErrorKind::InvalidData, other),
    }
}
