//! Bytes to telegrams and back, and the conversation with a SICK LMS 2xx laser scanner.
//!
//! Sans-I/O: this crate has no port, no clock, no thread and no heap. Time comes in as an argument ([`Nanos`]),
//! deadlines go out as return values. The wire never yields an error: what is not a telegram becomes a bigger counter.
//! Both directions are here, because the simulator is the protocol's second user.
#![no_std]
#![forbid(unsafe_code)]

mod arrival;
mod cadence;
mod candidates;
pub mod command;
pub mod condition;
pub mod configuration;
pub mod crc;
mod damage;
mod dialogue;
pub mod errors;
pub mod exchange;
pub mod explain;
pub mod family;
pub mod framer;
pub mod header;
mod identity;
pub mod inquiry;
pub mod measured;
mod notice;
pub mod operating;
mod outgoing;
pub mod parameters;
mod pause;
mod phase;
pub mod reflectivity;
pub mod reply;
mod search;
mod sensor;
pub mod session;
mod start;
pub mod status_report;
pub mod telegram;
pub mod value;
pub mod variant;

pub use identity::Identity;
pub use inquiry::Inquiry;
pub use notice::Notice;
pub use phase::{Control, Reason, SILENCE, Settings};
pub use sensor::{Sensor, State, Trouble};
pub use session::Session;

/// A point in time or a span, in nanoseconds of one monotonic clock that the caller chooses.
pub type Nanos = u64;

/// One millisecond in [`Nanos`].
pub const MILLIS: Nanos = 1_000_000;
/// One microsecond in [`Nanos`].
pub const MICROS: Nanos = 1_000;

/// Time of `bytes` bytes on a line of `baud` bits per second: 8N1 is 10 bits a byte (Telegram listing 4).
pub const fn line_time(bytes: usize, baud: u32) -> Nanos {
    bytes as u64 * 10 * 1_000_000_000 / baud as u64
}
