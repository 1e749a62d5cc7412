//! Permanent settings of an LMS, and the protocol that changes them. This crate has all requests that write the EEPROM,
//! and the [`Consent`] that is required to send one. It is a separate crate, and the hub is built without it. No code
//! that contacts a scanner without a user can therefore write the EEPROM.
//!
//! Like the drivers, the crate does no I/O and reads no clock.
#![forbid(unsafe_code)]

mod change;
pub mod eeprom;
mod plan;

pub use change::{Change, ChangeError, Outcome, Step};
pub use plan::{Consent, OwnedConfiguration, Plan};
