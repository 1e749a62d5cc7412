//! The library of every program that follows a hub of scanhub, or publishes topics of its own beside it. A program depends on
//! this crate alone.
//!
//! - [`subscribe`] follows one topic of one sensor in shared memory, without a copy, over restarts of the hub.
//! - [`zones`] and [`robot`] follow the verdict of one sensor and of all: a silence becomes [`Verdict::Unknown`] by itself.
//! - [`publish`] makes a topic that others follow.
//! - [`request`] asks the hub for something, [`live_sensors`] says which sensors it has.
//! - [`streams`] is for programs that follow many topics in one thread.
//!
//! Hub and programs must be of the same version: they share memory.
//!
//! # Examples
//!
//! ```no_run
//! use scanhub_client::{Failure, Scan, subscribe};
//!
//! fn main() -> Result<(), Failure> {
//!     let mut scans = subscribe::<Scan>("front")?;
//!     while let Some(scan) = scans.next()? {
//!         let distances = (0..scan.beams()).filter_map(|i| Some((scan.distance_mm(i)?, i)));
//!         if let Some((mm, i)) = distances.min() {
//!             println!("{mm} mm at {} degrees", scan.angle_deg(i));
//!         }
//!     }
//!     Ok(())
//! }
//! ```
//!
//! The crate knows only `schema`: a hub is a lock that is held and topics that are there. It prints nothing and refuses to
//! know verbs.

pub mod clock;
mod control;
mod follower;
mod join;
mod presence;
mod publish;
mod robot;
mod sample;
mod session;
pub mod streams;
mod subscribe;
mod wait;
mod zones;

pub use control::request;
pub use follower::Received;
pub use presence::{live_sensors, live_topics};
pub use publish::{Publication, PublishSession, SensorPublisher, home, publish};
pub use robot::{Robot, RobotFollower, robot};
pub use subscribe::{Subscription, places, subscribe};
pub use wait::Wait;
pub use zones::{Heard, ZonesFollower, zones};

/// The types of topics and payloads. A program needs no second dependency.
pub use scanhub_schema::{
    Age, Failure, Flags, Header, Kind, Pose, Quality, ROBOT, Reasons, Request, Shown, Topic, Verb, Wake,
    payloads::*,
};
pub use scanhub_shm::{DEFAULT_DOMAIN, Domain, Environment, Payload};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
