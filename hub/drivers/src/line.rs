//! What all families share: the session as its driver sees it, what arrived and when, and why it is suspect. For scanners
//! with a rotating head also packets, revolutions, and the grid that a revolution is put on. This module names no family.

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
