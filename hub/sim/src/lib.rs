//! The sensor at the other end of the wire: a simulated SICK LMS 2xx on a pty, for tests, demonstrations and
//! measurements without hardware.
//!
//! [`machine`] is the sensor itself, without I/O and clock; [`world`] is what it sees, [`room`] how that is measured,
//! [`labeled_scan`] the true values; [`wire`], [`fault`] and [`noise`] are what happens on the line; [`pty`] is the
//! only file that knows real time and ports; [`simulate()`] is the verb. It uses the protocol crate's other direction and
//! knows nothing of the hub.

mod answer;
pub mod device;
mod eeprom;
pub mod fault;
pub mod labeled_scan;
pub mod layers;
pub mod ld;
mod line;
pub mod machine;
pub mod noise;
pub mod operating;
pub mod options;
mod people;
mod place;
pub mod pty;
mod request_decoder;
pub mod room;
mod scene;
pub mod series;
mod settings;
mod shape;
mod simulate;
pub mod source;
mod spot;
mod transmission;
pub mod truth;
mod view;
pub mod wire;
pub mod world;
mod world_view;

pub use line::Event;
pub use request_decoder::{Arrival, Dropped};
pub use simulate::{Ready, simulate, simulate_with};
pub use transmission::ChunkSize;
