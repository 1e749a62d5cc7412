//! Many topics in one thread: a session in a domain, the followers of its topics, and whether a hub runs. For programs
//! that need more than one [`Subscription`](crate::Subscription).

pub use crate::follower::Follower;
pub use crate::freshness::Freshness;
pub use crate::presence::{Change, GRACE, Who, find};
pub use crate::robot::{RobotHeard, RobotSource};
pub use crate::sample::{Sample, Source};
pub use crate::session::Session;
pub use crate::zones::ZonesSource;
