//! The verbs that open a port or explain telegrams, without a hub: `probe`, `doctor`, `configure` and `telegram`. Each does
//! its work once and ends, and reports progress to the person at the terminal.

pub mod bridge_program;
pub mod configure;
pub mod doctor;
mod drive;
mod listen;
pub mod probe;
pub mod telegram;
