//! The whole hub in one thread and in virtual time: simulated scanners, lines with faults, ttys, the hub's core, topics in
//! memory, and subscribers. A gateway, a network, a listener and a robot on another machine follow them. A seed draws the faults
//! and their times, and judges check every event. A failure is a seed that can be repeated, and shrinks to the few actions that
//! matter.
//!
//! [`Scenario`] is the course of a world as data, [`run`] runs it, and [`Outcome`] is the result of the judges.

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
