//! The commands that open a port or explain telegrams without a hub: `probe`, `doctor`, `configure` and `telegram`.
//! Each runs once, and reports its progress to the user at the terminal.

pub mod bridge_program;
pub mod configure;
pub mod doctor;
mod driver;
pub mod probe;
pub mod telegram;
mod terminal;
