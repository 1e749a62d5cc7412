//! Many topics in one thread: a session in a domain, what follows topics in it, and whether a hub is there. For programs
//! for which one [`Subscription`](crate::Subscription) is too little.
//!
//! # Examples
//!
//! ```no_run
//! use scanhub_client::streams::{Session, Source};
//! use scanhub_client::{Failure, Topic, places};
//!
//! fn main() -> Result<(), Failure> {
//!     let mut session = Session::new(places(None)?);
//!     let mut sources = [Source::new("front", Topic::Scan), Source::new("rear", Topic::Scan)];
//!     loop {
//!         session.look()?;
//!         for source in &mut sources {
//!             while let Some(sample) = source.receive(&mut session)? {
//!                 println!("{} bytes", sample.bytes().len());
//!             }
//!         }
//!         session.wait(None)?;
//!     }
//! }
//! ```

pub use crate::follower::{Follower, Noted, Numbers};
pub use crate::join::Join;
pub use crate::presence::{Change, GRACE, Who, find};
pub use crate::robot::{RobotHeard, RobotSource};
pub use crate::sample::{Sample, Source};
pub use crate::session::Session;
pub use crate::zones::{Freshness, ZonesSource, ZonesState};
