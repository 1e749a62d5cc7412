//! The simulated sensor: one binary with a module for each thing that is held, so that what they all link is linked once.

mod faults;
mod inquiry;
mod machine;
mod port;
mod session;
mod worlds;
