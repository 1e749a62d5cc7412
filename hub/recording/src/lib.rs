//! Reads recordings: MCAP files of the hub (feature `mcap`), streams of telegrams as they arrived on a line, and CARMEN
//! logs, each plain or gzipped.
//!
//! All of them yield whole telegrams, so that the simulator can send them and a hub can read them. [`Contents`] says which
//! sensor it was and what its values mean, as far as the file contains that; nothing here reads a clock or opens a port.

mod carmen;
mod contents;
#[cfg(feature = "mcap")]
pub mod convert;
mod damage;
#[cfg(feature = "mcap")]
mod mcap;
mod open;
mod packed;
mod stream;

pub use carmen::{BEYOND, Unfit};
pub use contents::{Contents, Form};
pub use damage::Damage;
pub use open::{Encoding, Recording};

use lms::measured::MEASURED;

/// One telegram of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// The whole telegram, STX to checksum; of a telegram stream bit for bit as it was received.
    pub telegram: Vec<u8>,
    /// When it was measured, in nanoseconds since 1970, if the recording contains that.
    pub wall_ns: Option<u64>,
    /// What the hub knew of it when it was recorded: numbers, stamps, quality. Streams and logs have none.
    pub header: Option<schema::Header>,
}

impl Frame {
    /// Whether it is a telegram of measured values (B0h), which is what a sensor streams.
    pub fn is_scan(&self) -> bool {
        self.telegram.get(4) == Some(&MEASURED)
    }
}
