//! The whole hub in one thread and in made-up time: simulated sensors, lines with faults, ttys, the hub's own core, topics in
//! memory, consumers; behind them a gateway, a network, a listener and a robot on another machine. A seed says what goes wrong and when; judges watch everything that happens; a failure is a number that
//! can be played again, and shrinks to the few actions that matter.
//!
//! [`Plan`] is what shall happen, as data; [`run`] lets it happen; [`Outcome`] is what the judges say.

mod actions;
mod consumer;
pub mod corpus;
mod event;
mod family;
mod hash;
mod hub;
mod judges;
mod line;
mod network;
mod plan;
mod planted;
mod remote;
mod runner;
mod sensor;
mod setup;
mod shared;
pub mod shrink;
mod sim_platform;
mod topics;
mod tty;
mod world;

pub use event::{Detail, Figures, Violation};
pub use plan::{Action, Plan};
pub use planted::Defect;
pub use runner::{Runner, Totals};
pub use world::{Outcome, is_found, run};
