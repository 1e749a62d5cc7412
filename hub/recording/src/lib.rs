//! Reads what was recorded: streams of telegrams as they came down a line, and CARMEN logs, each plain or gzipped.
//!
//! Both come out as whole telegrams, so that the simulator can send them and a hub can read them. Which sensor it was
//! and what its words mean is told as far as the file says it ([`Contents`]); nothing here keeps time or opens a port.

mod carmen;
mod open;
mod stream;

pub use carmen::BEYOND;
pub use open::{Contents, Encoding, Form, Recording};

/// One telegram of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// The whole telegram, STX to checksum; of a telegram stream bit for bit as it was received.
    pub telegram: Vec<u8>,
    /// When it was measured, in nanoseconds since 1970, where the recording says so.
    pub wall_ns: Option<u64>,
}
