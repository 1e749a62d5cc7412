//! The verbs that deal with a port or with telegrams and are no hub: `probe`, `doctor`, `configure` and `telegram`. Each does
//! its work once and ends; who waits at a terminal is told of it.

pub mod configure;
pub mod doctor;
mod drive;
pub mod probe;
pub mod telegram;
