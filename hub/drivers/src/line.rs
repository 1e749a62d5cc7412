//! Code that all scanner families share: the interface between session and driver, arrival times of bytes, and the
//! reasons why a telegram or packet is suspect. For rotating scanners, this code also frames packets, assembles their
//! points into revolutions, and assigns the points of a revolution to the beams of a grid.

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

/// Bits of `reasons`. Each bit is a reason why a telegram or packet is suspect. Each family sets the bits that it can
/// detect.
pub mod suspect {
    use super::Reasons;

    /// The kernel's error counters of the line have increased.
    pub const LINE_ERROR: u8 = Reasons::LINE_ERROR;
    /// Bytes before the packet did not belong to another packet, so the neighboring packet was damaged.
    pub const NEIGHBOUR: u8 = Reasons::NEIGHBOUR;
    /// The bytes took longer than usual to arrive.
    pub const SLOW: u8 = Reasons::SLOW;
    /// The bytes have bits set that no scanner sets.
    pub const FORBIDDEN_BITS: u8 = Reasons::FORBIDDEN_BITS;
    /// The bytes contain another valid header.
    pub const HEADER_INSIDE: u8 = Reasons::HEADER_INSIDE;
}
