//! What all families share: the session as its driver sees it, what arrived and when, and why it is suspect. For
//! scanners with a rotating head also packets, revolutions, and the grid that a revolution is put on. This module names
//! no family.

mod arrival_time;
pub mod family;
pub mod framing;
mod revolutions;
mod scan;
mod sensor_clock;
mod session;
mod stream;

use scanhub_schema::Reasons;

pub use arrival_time::{ReadLog, StreamTiming};
pub use framing::{Buffer, ByteCounters};
pub use revolutions::{ClosedRevolution, RevolutionAssembler, RevolutionCounts, RotationRate};
pub use scan::{BEAM_RANGE, Grid, NO_RETURN, NOT_MEASURED, Point, RawScan, Values, revolution_head};
pub use sensor_clock::SensorClock;
pub use session::{
    Action, Control, DeviceInfo, Event, HealthStatus, Identity, KnownRate, Notice, Protocol,
    ReceivedTelegram, ScannerSession, SessionStats, State, TelegramContents,
};
pub use stream::{ReadScheduler, StreamCounters, Watchdog};

/// Reasons why a telegram or packet is suspect: bits of `reasons`. A family sets those that it can detect.
pub mod suspect {
    use super::Reasons;

    /// The error counters of the line have increased.
    pub const LINE_ERROR: u8 = Reasons::LINE_ERROR;
    /// The bytes before it belonged to nothing: its neighbor was damaged.
    pub const NEIGHBOUR: u8 = Reasons::NEIGHBOUR;
    /// It took longer than usual.
    pub const SLOW: u8 = Reasons::SLOW;
    /// Bits are set that no scanner sets.
    pub const FORBIDDEN_BITS: u8 = Reasons::FORBIDDEN_BITS;
    /// Another acceptable header began inside it.
    pub const HEADER_INSIDE: u8 = Reasons::HEADER_INSIDE;
}
