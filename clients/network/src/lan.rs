//! Both ends of a network as pure computation: a gateway turns samples of a hub into datagrams, and a listener turns
//! datagrams into samples.
//!
//! Bytes and time are arguments, so that sockets, the bridge and simulations run the same code. `tests/it/tidy` keeps
//! clocks, sockets, files and threads out of this folder.

pub mod address;
mod gateway_runs;
pub mod incoming;
mod key;
pub mod outgoing;
pub mod republish;
mod stamp;
mod stream_stats;

pub use gateway_runs::{Arrival, LIVES, Standing};
pub use key::Key;
pub use stamp::Stamp;
pub use stream_stats::{Fresh, GivenUp, ROWS, Row, StreamStats, WINDOW};
