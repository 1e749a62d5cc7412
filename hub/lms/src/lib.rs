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
pub use phase::{SILENCE, Settings};
pub use sensor::{Sensor, Trouble};
pub use session::Session;

// Everything here speaks of time.
pub use line::{MICROS, MILLIS, Nanos, line_time};
