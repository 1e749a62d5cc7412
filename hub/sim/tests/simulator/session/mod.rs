//! The conversation of a session with a simulated sensor, in virtual time: one file per situation.

mod adoption;
pub(crate) mod bench;
mod control;
mod figures;
mod fixed_rate;
mod installation;
mod loss;
mod lost_on_line;
mod modes;
mod notices;
mod power;
mod property;
mod quirks;
mod rest;
mod rs232;
mod start;
mod stopped;
mod trouble;
