//! What every conversation with a scanner on a line says, and nothing of any family of scanners: time, what a session
//! wants next, how far it is, what arrived and when, and why it is suspect; and what scanners share whose head turns:
//! packets, turns, and the grid that a turn is put on.
//!
//! Sans-I/O: no port, no clock, no thread and no heap. Time comes in as an argument ([`Nanos`]), deadlines go out as
//! return values.
#![no_std]
#![forbid(unsafe_code)]

mod arrival;
mod buffer;
pub mod family;
pub mod framing;
pub mod grid;
mod reads;
mod sensor_clock;
mod session;
pub mod suspect;
mod turning;
mod turns;

pub use arrival::{Arrivals, Flow};
pub use buffer::{Buffer, Tally};
pub use reads::Reads;
pub use sensor_clock::SensorClock;
pub use session::{Account, Control, Output, Received, Session, State};
pub use turning::{Heard, Packets, Turn, TurnCounts};
pub use turns::{Closed, Pace, Turns};

/// A point in time or a span, in nanoseconds of one monotonic clock that the caller chooses.
pub type Nanos = u64;

/// One millisecond in [`Nanos`].
pub const MILLIS: Nanos = 1_000_000;
/// One microsecond in [`Nanos`].
pub const MICROS: Nanos = 1_000;

/// Time of `bytes` bytes on a line of `baud` bits per second: 8N1 is 10 bits a byte.
pub const fn line_time(bytes: usize, baud: u32) -> Nanos {
    bytes as u64 * 10 * 1_000_000_000 / baud as u64
}
