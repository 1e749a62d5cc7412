//! Asking a simulated sensor what it is, in virtual time: one file per situation.

mod anything;
mod bench;
mod change;
mod faults;
mod finding;
mod trouble;
