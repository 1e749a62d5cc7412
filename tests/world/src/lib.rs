//! Simulation of a whole hub in one thread and in virtual time: simulated scanners, lines with faults, ttys, the hub's
//! core, topics in memory, and subscribers. It includes another machine with a gateway, a network, a listener and a
//! robot. A seed determines the faults and their times, and invariants check every event. A failure can be repeated
//! with its seed, and shrinks to the few actions that cause it.
//!
//! A [`Scenario`] is the list of a world's actions, [`run`] runs it, and [`Outcome`] is the result with its violations.

mod actions;
mod event;
mod family;
mod hash;
mod hub;
mod injected_defects;
mod invariants;
mod line;
mod network;
mod remote;
mod runner;
mod scenario;
mod sensor;
mod setup;
mod shared;
mod sim_platform;
mod subscriber;
mod topics;
mod tty;
mod world;

pub use event::{Detail, RevolutionFigures, Violation};
pub use injected_defects::Defect;
pub use runner::{Runner, Totals};
pub use scenario::{Action, Scenario, corpus, shrink};
pub use world::{Outcome, is_found, run};
