//! The line behind a head: what goes wrong on it, and what was sent.

use scanhub_schema::Nanos;

/// What goes wrong with bytes of packets; shares of all bytes.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Damage {
    /// Begins of bursts that are lost, four bytes long on the mean.
    pub(crate) lost: f64,
    /// Bytes before which a foreign one comes.
    pub(crate) inserted: f64,
    /// Bytes with bits that are turned over.
    pub(crate) flipped: f64,
}

/// A packet as it was sent.
pub(crate) struct Sent {
    pub(crate) bytes: Vec<u8>,
    pub(crate) intact: bool,
    /// When its last byte was through, if all of them were.
    pub(crate) at: Nanos,
}
