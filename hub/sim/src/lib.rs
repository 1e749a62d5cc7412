//! The sensor at the other end of the wire: simulated scanners on ptys or TCP servers, for tests, demonstrations and
//! measurements without hardware.
//!
//! [`machine`] is a SICK LMS 2xx, [`ld`] a scanner of LDROBOT, [`rplidar`] one of Slamtec, without I/O and clock;
//! [`world`] is what they see, [`room`] how that is measured, [`mount`] what may tilt the sensor, [`labeled_scan`] the true values; [`wire`], [`fault`] and
//! [`noise`] are what happens on the line; [`pty`] is the only file that knows real time; [`simulate()`] is the verb. It
//! uses the protocol crates' other direction and knows nothing of the hub.

mod answer;
pub mod device;
mod eeprom;
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
mod outlet;
mod people;
mod place;
pub mod pty;
mod request_decoder;
pub mod room;
pub mod rplidar;
mod scene;
pub mod series;
mod server;
mod settings;
mod shape;
mod simulate;
mod socket;
mod solid;
pub mod source;
mod spot;
mod transmission;
pub mod truth;
mod turning;
mod view;
pub mod wire;
pub mod world;
mod world_view;

pub use line::Event;
pub use request_decoder::{Arrival, Dropped};
pub use simulate::{Ready, simulate, simulate_with};
pub use transmission::ChunkSize;
