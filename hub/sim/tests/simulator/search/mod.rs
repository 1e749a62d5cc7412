//! A scanner of unknown family is found, whatever its model and state, and nothing else is.

mod bench;
mod finding;
mod garbage;
mod memory;
mod port;
mod power;
mod wrong_rates;
