//! The conversation of a session with a simulated sensor, in virtual time: one file per situation.

mod adoption;
mod bench;
mod control;
mod loss;
mod rest;
mod start;
mod trouble;
