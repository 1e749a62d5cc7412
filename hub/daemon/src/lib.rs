//! The hub: all the I/O there is. It owns the serial links, one thread each, and publishes what they say into shared
//! memory; who listens is not its business.

pub mod bus_error;
mod control;
mod diagnosis;
mod drive;
mod event_fd;
mod identity_cache;
mod in_memory;
mod last_rate;
mod learned;
mod link;
mod link_stats;
mod pipeline;
mod player;
mod preflight;
mod process_telegram;
mod recent;
mod reconnect;
mod reload;
mod replay;
mod replay_hub;
mod service;
mod signals;
mod supervise;
mod topics;

pub use in_memory::{DrivenLink, in_memory};
pub use player::{Pace, Play, Player, Progress};
pub use replay_hub::{Replay, replay};
pub use scanner;
pub use supervise::{Ready, run};
