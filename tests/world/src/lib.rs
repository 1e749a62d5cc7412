//! Simulation of a whole hub in one thread and in virtual time. The simulation includes scanners, lines with faults,
//! ttys, the hub's core, topics in memory, and subscribers. It also includes another machine with a gateway, a network,
//! a listener and a robot. A seed determines the faults and their times, and invariants check every event. A user can
//! repeat a failure with its seed. The simulation shortens the scenario to the few actions that cause the failure.
//!
//! A [`Scenario`] lists the actions of a world, [`run`] runs it, and [`Outcome`] is the result with its violations.

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
