//! Configuration of the hub: its links with their ports, and the settings of their scanners. A value from a later
//! source takes precedence over a value from an earlier source.

mod effective;
mod gateway;
mod link;
mod load;
mod processing;
mod scanner;
mod section;
mod sources;

pub use effective::{Value, keys, values};
pub use gateway::Gateway;
pub use link::{Config, Link, resource_estimate};
pub use processing::{Background, Processing};
pub use scanner::Scanner;
pub use section::Key;
pub use sources::{SourceMap, Sources};

/// Configuration file to start from, with the default values.
pub const DEFAULT: &str = include_str!("default.toml");
