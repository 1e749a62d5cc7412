//! Reads recordings: MCAP files of the hub (feature `mcap`), streams of telegrams as they arrived on a line, and CARMEN
//! logs, each plain or gzipped.
//!
//! All of them yield whole telegrams, so that the simulator can send them and a hub can read them. [`Contents`] says which
//! sensor it was and what its values mean, as far as the file contains that; nothing here reads a clock or opens a port.

mod carmen;
mod contents;
#[cfg(feature = "mcap")]
pub mod convert;
#[cfg(feature = "mcap")]
mod mcap;
mod open;
mod packed;
mod stream;
mod virtual_time;

pub use carmen::{BEYOND, Unfit, Unread};
pub use contents::{Contents, Damage, Form};
pub use open::{Encoding, Recording};
pub use virtual_time::VirtualTime;

use scanhub_drivers::lms::measured::MEASURED;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::Telegram;
use schema::Family;

/// One telegram of a recording, or the packets that arrived together.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Frame {
    /// The whole telegram, STX to checksum; of other families than LMS whole packets. Of a stream bit for bit as it was
    /// received.
    pub telegram: Vec<u8>,
    /// Of which family it is, a number of [`Family`].
    pub family: u8,
    /// When it was measured, in nanoseconds since 1970, if the recording contains that.
    pub wall_ns: Option<u64>,
    /// When it was measured by the scanner's own clock, in nanoseconds from the first one on, where that is all there is.
    pub scanner_ns: Option<u64>,
    /// Why it is suspect, bits of [`scanhub_drivers::line::suspect`].
    pub reasons: u8,
    /// What the hub knew of it when it was recorded: numbers, stamps, quality. Streams and logs have none.
    pub header: Option<schema::Header>,
}

/// Record of a file that matters for the angles of a mount.
#[derive(Clone, Copy, Debug)]
pub enum MountRecord {
    /// Angle of the mount.
    Angle(schema::Header, schema::Tilt),
    /// Header of a telegram from a sensor of the mount's machine. Its stamps are from the same clock as the mount's.
    Telegram(schema::Header),
}

impl Frame {
    /// Whether it is a telegram of measured values (B0h), which is what an LMS streams.
    pub fn is_scan(&self) -> bool {
        is_scan(self.family, &self.telegram)
    }

    /// Returns whether it reports the measuring mode, or that the mode is no longer known.
    pub fn tells_mode(&self) -> bool {
        let reply = Telegram::check(&self.telegram).and_then(Reply::decode);
        reply.is_some_and(|reply| reply.mode().is_some())
    }
}

pub(crate) fn is_scan(family: u8, telegram: &[u8]) -> bool {
    family == Family::Lms as u8 && telegram.get(4) == Some(&MEASURED)
}
