//! Many topics in one thread: a session in a domain, what follows topics in it, and whether a hub is there. For programs
//! for which one [`Subscription`](crate::Subscription) is too little.

pub use crate::follower::Follower;
pub use crate::freshness::Freshness;
pub use crate::presence::{Change, GRACE, Who, find};
pub use crate::robot::{RobotHeard, RobotSource};
pub use crate::sample::{Sample, Source};
pub use crate::session::Session;
pub use crate::zones::ZonesSource;
