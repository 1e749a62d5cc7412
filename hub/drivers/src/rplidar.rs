//! Slamtec RPLIDAR A1, A2, A3, S1, S2, S3 and C1: requests and responses, the framer, packets, revolutions, and the
//! session with a scanner. No request changes a setting that the scanner keeps without power.

mod device_info;
mod framer;
mod handshake;
mod model;
pub mod packet;
mod probe;
mod rate_search;
mod request;
mod sequence;
mod session;
mod stream;
mod stream_head;

pub use crate::line::{Tally, TurnCounts};
pub use device_info::{Health, Info};
pub use model::{Mode, Model};
pub use probe::Probe;
pub use session::{FEATURES, Session, Trouble};
pub(crate) use session::{check, scan_heads};
