//! SICK LMS 2xx: the framer, telegrams in both directions, and the session with a scanner. The simulator is the second
//! user of the protocol, so requests are decoded and replies are encoded here, too.

mod arrival;
mod cadence;
pub mod command;
pub mod configuration;
mod dialogue;
pub mod exchange;
pub mod explain;
pub mod family;
pub mod framer;
pub mod header;
pub mod inquiry;
pub mod measured;
pub mod operating;
mod probe;
mod rate;
pub mod reply;
mod sensor;
pub mod session;
mod start;
pub mod status;
pub mod telegram;
pub mod variant;

pub use dialogue::SILENCE;
pub use inquiry::Inquiry;
pub use probe::Probe;
pub use sensor::{Notice, Sensor, Trouble};
pub(crate) use session::scan_heads;
pub use session::{FEATURES, Session, Settings};
pub(crate) use session::{check, set};
