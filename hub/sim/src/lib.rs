//! Simulated scanners on ptys or TCP servers, for tests, demonstrations and measurements without hardware.
//!
//! - [`machine`] is a SICK LMS 2xx, [`ld`] an LDROBOT, and [`rplidar`] an RPLIDAR of Slamtec. These modules do no I/O,
//!   and time is an argument of their functions.
//! - [`world`] describes the surroundings of a scanner, [`room`] computes scans of these surroundings together with the
//!   true targets, and [`mount`] tilts a scanner.
//! - [`line_model`] simulates the line, and [`fault`] defines the faults of the line and of the scanner.
//! - [`port`] creates the ptys and TCP servers. It is the only module that reads a clock.
//! - [`simulate()`] runs the simulated scanners for the verb `simulate`.

pub mod beam;
pub mod device;
pub mod fault;
pub mod ld;
pub mod line_model;
pub mod machine;
pub mod mount;
pub mod operating;
pub mod options;
pub mod port;
mod request_decoder;
pub mod room;
mod rotating;
pub mod rplidar;
mod scene;
mod shape;
pub mod simulate;
mod view;
pub mod world;

pub use device::ChunkSize;
pub use request_decoder::{Arrival, DroppedRequest};
pub use shape::{Point, Shape};
pub use simulate::{Event, SimulatedPort, simulate, simulate_with};
