//! The library of every program that follows a hub, or publishes topics of its own beside it. A program depends on this
//! crate alone. Knows only `schema`: a hub is a lock that is held and topics that are there. Prints nothing; refuses to know
//! verbs.

mod attach;
pub mod clock;
mod control;
mod follower;
mod freshness;
mod live;
mod presence;
mod readiness;
mod robot;
mod sample;
mod session;
pub mod streams;
mod wait;
mod zones;

pub use attach::{Attachment, attach, places};
pub use control::request;
pub use follower::Received;
pub use live::{live_sensors, live_topics};
pub use robot::{Robot, RobotFollower, robot};
pub use wait::Wait;
pub use zones::{Heard, ZonesFollower, zones};
