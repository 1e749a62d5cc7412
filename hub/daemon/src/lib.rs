//! The hub: all the I/O there is. It owns the serial links, one thread each, and publishes what they say into shared
//! memory; who listens is not its business.

mod control;
mod diagnosis;
mod early;
mod link;
mod link_output;
mod link_stats;
mod pipeline;
pub mod platform;
mod player;
mod process;
mod publisher;
mod reconnect;
mod reload;
mod replay;
mod replay_hub;
mod saved_state;
mod service;
mod session_driver;
mod supervise;
mod system;
mod topics;

pub use control::{ControlQueue, Orders, Outcome};
pub use player::{PlaybackOptions, PlaybackRate, Player, Progress};
pub use process::explain_bus_error;
pub use reconnect::LiveLink;
pub use reload::{Read, Reload};
pub use replay::{RecordedAngle, RecordedMount};
pub use replay_hub::{Replay, replay};
pub use saved_state::{KnownRate, KnownScanner, SaveQueue, SaveSlot, StateSaver, StateStore};
pub use service::Service;
pub use supervise::{Ready, run};
