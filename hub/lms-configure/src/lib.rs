//! What a sensor keeps without power, and how it is changed. All requests that write the EEPROM are here, and so is the
//! [`Consent`] without which none is sent. A crate of its own, so that Cargo keeps it from everything that talks to a
//! sensor by itself: the hub is built without it.
//!
//! Sans-I/O like the drivers: no port and no clock.
#![forbid(unsafe_code)]

mod change;
pub mod eeprom;
mod plan;

pub use change::{Change, ChangeError, Outcome, Step};
pub use plan::{Consent, OwnedConfiguration, Plan};
