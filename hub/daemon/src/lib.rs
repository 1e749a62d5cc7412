//! The hub: all the I/O there is. It owns the serial links, one thread each, and publishes what they say into shared
//! memory; who listens is not its business.

mod attend;
mod bell;
pub mod bus_error;
mod complaint;
mod control;
mod in_memory;
mod last_rate;
mod learned;
mod link;
mod memory;
mod pipeline;
mod preflight;
mod publish;
mod recent;
mod reload;
mod replay;
mod service;
mod signals;
mod status;
mod supervise;
mod topics;

pub use in_memory::{DrivenLink, in_memory};
pub use replay::{Pace, Play, Player, Progress, Replay, replay};
pub use scanner;
pub use supervise::{Ready, run};
