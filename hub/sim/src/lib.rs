//! Simulated scanners on ptys or TCP servers, for tests, demonstrations and measurements without hardware.
//!
//! - [`machine`] is a SICK LMS 2xx, [`ld`] a scanner of LDROBOT, and [`rplidar`] one of Slamtec. They do no I/O, and
//!   time is an argument.
//! - [`world`] describes their surroundings, [`room`] measures them, [`mount`] tilts a scanner, and [`labeled_scan`]
//!   has the true values.
//! - [`wire`], [`fault`] and [`noise`] simulate the line.
//! - [`pty`] is the only file that reads a clock.
//! - [`simulate()`] is the command.

pub mod device;
pub mod fault;
pub mod labeled_scan;
pub mod layers;
pub mod ld;
mod line;
pub mod machine;
pub mod mount;
pub mod noise;
pub mod operating;
pub mod options;
pub mod pty;
mod request_decoder;
pub mod room;
mod rotating;
pub mod rplidar;
mod scene;
pub mod series;
mod shape;
mod simulate;
mod socket;
pub mod source;
mod spot;
mod transmission;
pub mod truth;
mod view;
pub mod wire;
pub mod world;

pub use line::Event;
pub use request_decoder::{Arrival, Dropped};
pub use shape::{Point, Shape};
pub use simulate::{Ready, simulate, simulate_with};
pub use transmission::ChunkSize;
