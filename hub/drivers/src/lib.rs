//! Drivers of all scanner families: the protocol of each family, the session with a scanner, and the scans that a
//! session returns.
//!
//! The drivers do no I/O. The caller passes received bytes and the time to a session, and the session returns bytes to
//! send, events and deadlines. No driver opens a port, reads a clock or starts a thread. Bytes that are not part of a
//! telegram or packet are counted and never cause an error.
#![forbid(unsafe_code)]

mod families;
pub mod ld;
pub mod line;
pub mod lms;
mod port_session;
pub mod recognize;
pub mod rplidar;
pub mod search;
mod settings;

pub use families::{ANY_FAMILY, Problem, Session, features, identity_probe, scan_heads};
pub use line::family::{Features, Model};
pub use lms::identity_probe::{IdentityProbe, Report};
pub use port_session::PortSession;
pub use settings::{AUTO, Key, Refusal, Settings, SettingsRequest, Value, auto_or, family_of};
