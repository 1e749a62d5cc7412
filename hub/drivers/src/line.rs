//! What all families share: the session as its driver sees it, what arrived and when, and why it is suspect. For
//! scanners with a rotating head also packets, revolutions, and the grid that a revolution is put on. This module names
//! no family.

mod arrival;
pub mod family;
pub mod framing;
pub mod grid;
pub mod probe;
mod reads;
mod scan;
mod sensor_clock;
mod session;
mod stream;
mod turns;

pub use arrival::{Arrivals, Flow};
pub use framing::{Buffer, Tally};
pub use reads::Reads;
pub use scan::{RawScan, Values, revolution_head};
pub use sensor_clock::SensorClock;
pub use session::{
    Account, Condition, Control, Event, Identity, Introduction, KnownRate, Notice, Output, Protocol,
    Received, Session, State, Whole,
};
pub use stream::{StreamCounters, Watchdog};
pub use turns::{Closed, Pace, TurnCounts, Turns};

/// Reasons why a telegram or packet is suspect: bits of `reasons`. A family sets those that it can detect.
pub mod suspect {
    /// The error counters of the line have increased.
    pub const LINE_ERROR: u8 = 1;
    /// The bytes before it belonged to nothing: its neighbor was damaged.
    pub const NEIGHBOUR: u8 = 2;
    /// It took longer than usual.
    pub const SLOW: u8 = 4;
    /// Bits are set that no scanner sets.
    pub const FORBIDDEN_BITS: u8 = 8;
    /// Another acceptable header began inside it.
    pub const HEADER_INSIDE: u8 = 16;
}
