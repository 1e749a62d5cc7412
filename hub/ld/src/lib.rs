//! LDROBOT LD06, LD19, STL19P, STL27L and LD14P: bytes to packets and back, packets to turns, and the session with a scanner
//! that speaks unasked. Nothing is ever sent to it.
//!
//! Sans-I/O: this crate has no port, no clock, no thread and no heap. Time comes in as an argument, deadlines go out as
//! return values. The wire never yields an error: what is not a packet becomes a bigger counter.
#![no_std]
#![forbid(unsafe_code)]

mod family;
pub mod framer;
mod heard;
mod model;
pub mod packet;
mod restarts;
mod sequence;
mod session;

pub use heard::Trouble;
pub use line::{Heard, Packets, Tally, Turn, TurnCounts};
pub use model::Model;
pub use session::{Session, Settings};
