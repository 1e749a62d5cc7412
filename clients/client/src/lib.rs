//! The library of every program that follows a hub, or publishes its own topics beside it. A program depends only on this
//! crate. Knows only `schema`: to it, a hub is a lock that is held and topics that exist. Prints nothing; refuses to know
//! verbs.

pub mod clock;
mod control;
mod follower;
mod freshness;
mod live;
mod presence;
mod publish;
mod readiness;
mod robot;
mod sample;
mod session;
pub mod streams;
mod subscribe;
mod wait;
mod zones;

pub use control::request;
pub use follower::Received;
pub use live::{live_sensors, live_topics};
pub use publish::{Publication, PublishSession, SensorPublisher, publish};
pub use robot::{Robot, RobotFollower, robot};
pub use subscribe::{Subscription, places, subscribe};
pub use wait::Wait;
pub use zones::{Heard, ZonesFollower, zones};

/// The types of topics and payloads: a program needs no second dependency.
pub use schema::{
    Age, BEAMS, Background, Code, Counter, Counters, DEFAULT_DOMAIN, Domain, Environment, Failure, Flags,
    Foreground, Header, Kind, MARKS, Mark, Marks, Pose, Quality, ROBOT, Reasons, Request, SEGMENTS, Scan,
    Segment, Shown, State, Status, Telegram, Topic, Verb, Verdict, Wake, ZONES, Zone, Zones, ipc::Payload,
};
