//! Both ends of a network as pure computation: a gateway turns samples of a hub into datagrams, and a listener turns
//! datagrams into samples.
//!
//! Bytes and time are arguments, so that sockets, the bridge and simulations run the same code. `tests/it/tidy` keeps
//! clocks, sockets, files and threads out of this folder.

pub mod address;
mod gateways;
pub mod incoming;
mod key;
pub mod outgoing;
mod reassembly;
pub mod republish;
mod senders;
mod sequence;

pub use gateways::{Arrival, EvictedTotals, GatewayTable, MAX_EPOCHS, MAX_ROWS, MAX_RUNS, Standing};
pub use key::Key;
pub use sequence::{Fresh, Row, WINDOW};

/// A moment on two clocks, in ns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stamp {
    /// A clock that is never set, such as CLOCK_MONOTONIC.
    pub monotonic_ns: u64,
    /// The wall clock, since 1970.
    pub wall_ns: u64,
}
