//! Both ends of a network, without one: what a gateway makes of a hub's samples, and what a listener makes of datagrams.
//! Bytes and time are arguments, so that sockets, a bridge and a simulation run the same code. Refuses to know sockets,
//! shared memory and clocks.
#![forbid(unsafe_code)]

pub mod address;
pub mod incoming;
mod key;
pub mod outgoing;
pub mod republish;
mod stamp;

pub use key::Key;
pub use stamp::Stamp;
