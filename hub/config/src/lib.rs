//! The configuration of the hub: links with their ports, and the settings of their sensors. Several sources; the last one
//! wins.

mod effective;
mod gateway;
mod layer;
mod link;
mod load;
pub mod needs;
mod origin;
mod places;
mod processing;
mod scanner;
mod sources;

pub use effective::{Value, values};
pub use gateway::Gateway;
pub use link::{Config, Link};
pub use processing::{Background, Processing, Zones};
pub use scanner::{Scanner, Turning};
pub use sources::Sources;

/// A configuration to start from, with the default values.
pub const DEFAULT: &str = include_str!("default.toml");
