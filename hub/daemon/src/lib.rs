//! The hub: it runs the links to scanners, with one thread for each, and publishes their samples in shared memory.
//!
//! - `supervise.rs` starts and ends the hub. `process.rs`, `service.rs` and `system.rs` contain its calls of the
//!   operating system. `control.rs` receives requests of users, and `reload.rs` applies a new configuration.
//! - The code of a link to a scanner is in `reconnect.rs`, `session_driver.rs`, `link.rs`, `link_output.rs` and
//!   `pipeline.rs`, from top to bottom. `platform.rs` has the interface behind which a simulation can replace this
//!   machine.
//! - `replay_hub.rs`, `replay.rs` and `player.rs` play a recording. `reader.rs` computes the same samples without a
//!   hub.

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
mod reader;
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

pub use control::{CommandSender, ControlQueue, Outcome};
pub use player::{PlaybackOptions, PlaybackRate, Player, Progress};
pub use process::{explain_bus_error, is_hangup_ignored};
pub use reader::{ReadOptions, ReadSample, RecordingReader};
pub use reconnect::LiveLink;
pub use reload::{ConfigLoader, Reload};
pub use replay::{RecordedAngle, RecordedMount};
pub use replay_hub::{Replay, replay};
pub use saved_state::{KnownRate, KnownScanner, SaveQueue, SaveSlot, StateSaver, StateStore};
pub use service::Service;
pub use supervise::{StartReport, run};
