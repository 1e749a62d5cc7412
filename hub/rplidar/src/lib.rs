//! Slamtec RPLIDAR A1, A2, A3, S1, S2, S3 and C1: requests and answers, bytes to packets, packets to turns, and the session
//! with a scanner that is asked what it is and told to measure. Nothing is ever sent that changes what a scanner keeps.
//!
//! Sans-I/O: this crate has no port, no clock, no thread and no heap. Time comes in as an argument, deadlines go out as
//! return values. The wire never yields an error: what is not a packet becomes a bigger counter.
#![no_std]
#![forbid(unsafe_code)]

mod family;
mod framer;
mod model;
mod offers;
pub mod packet;
mod request;
mod sequence;
mod session;
mod told;

pub use line::{Heard, Packets, Tally, Turn, TurnCounts};
pub use model::{Mode, Model};
pub use session::{Session, Settings};
pub use told::{Health, Info, Trouble};
