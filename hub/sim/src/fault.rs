//! What goes wrong on purpose. Faults are data: a table of keys, a seed, and the same damage in every run, however the
//! bytes are cut into chunks. [`crate::wire`] applies them between the sensor and the port; the sensor does not know
//! them, except for its own bad habits.

mod bytes;
mod lateness;
mod schedule;
mod table;
mod telegrams;

pub use bytes::Loss;
pub use table::Faults;

pub(crate) use bytes::{Fate, Noise};
pub(crate) use lateness::Lateness;
pub(crate) use schedule::{Extra, Schedule, Window};
pub(crate) use telegrams::Blemishes;

/// Why a telegram did not reach the host intact, as the truth names it: the first cause, and only if one of its own bytes
/// did not arrive as sent and next to its neighbours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The sensor broke it off, for a request or of itself.
    Aborted,
    /// Bytes of it were lost on the line.
    Loss,
    /// Bits of it were flipped.
    Flip,
    /// Bytes came between its own.
    Insert,
    /// A byte of it came twice.
    Double,
    /// Its end was lost.
    Truncated,
    /// Its length field was changed.
    Length,
    /// Garbage came between its bytes.
    Flood,
    /// A wall of start bytes came between its bytes.
    Wall,
    /// The line was cut for a while.
    Silence,
    /// The host's adapter was unplugged.
    Unplug,
    /// The sensor's power was cycled.
    Power,
    /// The host's port had another rate.
    Baud,
    /// Nobody had the port open.
    Unread,
    /// The host did not read, and its buffer was full.
    Overrun,
}

impl Fault {
    /// Its name in the truth.
    pub fn name(self) -> &'static str {
        match self {
            Fault::Aborted => "aborted",
            Fault::Loss => "loss",
            Fault::Flip => "flip",
            Fault::Insert => "insert",
            Fault::Double => "double",
            Fault::Truncated => "truncated",
            Fault::Length => "length",
            Fault::Flood => "flood",
            Fault::Wall => "wall",
            Fault::Silence => "silence",
            Fault::Unplug => "unplug",
            Fault::Power => "power",
            Fault::Baud => "baud",
            Fault::Unread => "unread",
            Fault::Overrun => "overrun",
        }
    }
}

/// A stream of random numbers of its own for each kind of fault, so that one does not change the others.
fn random(seed: u64, kind: u64) -> fastrand::Rng {
    fastrand::Rng::with_seed(seed ^ kind.wrapping_mul(0x9E37_79B9_7F4A_7C15))
}
