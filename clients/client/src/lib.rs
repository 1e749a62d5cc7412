//! Client library for programs that subscribe to the topics of a hub, and that publish topics next to those of the hub.
//! A program needs no other crate.
//!
//! - [`subscribe`] subscribes to one topic of one sensor in shared memory. The subscriber makes no copy, and continues
//!   after restarts of the hub.
//! - [`joined`] subscribes to two topics, and returns the samples of one telegram in pairs.
//! - [`zones`] and [`robot`] subscribe to the verdict of one sensor, or to the combined verdict. After a silence, the
//!   verdict is [`Verdict::Unknown`].
//! - [`SubscriberBuilder::open_pollable`] returns a subscriber with a descriptor for `poll` or an executor. With the
//!   feature `tokio`, this subscriber is a stream.
//! - [`publish`] creates a topic for other programs.
//! - [`request`] sends a request to the hub, and [`live_sensors`] returns the hub's sensors.
//! - [`streams`] is for programs that follow many topics in one thread.
//!
//! Hub and programs share memory, so they must have the same version. The library prints nothing.
//!
//! # Examples
//!
//! ```no_run
//! use scanhub_client::{Error, Scan, subscribe};
//!
//! fn main() -> Result<(), Error> {
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

mod builder;
pub mod clock;
mod control;
mod error;
mod hub_finder;
mod hub_monitor;
mod join;
mod joined;
mod pollable;
mod publish;
mod robot;
mod sample;
mod session;
mod silence;
#[cfg(feature = "tokio")]
mod stream;
mod subscribe;
mod topic_reader;
mod wait;
mod zones;

pub use builder::{SubscriberBuilder, domain_candidates};
pub use control::request;
pub use error::{Cause, Error, ErrorKind};
pub use hub_finder::{live_sensors, live_topics};
pub use joined::{Joined, JoinedSubscriber, joined};
pub use pollable::PollableSubscriber;
pub use publish::{Publication, PublishSession, SensorPublisher, publish, publish_domain};
pub use robot::{Robot, RobotSubscriber, robot};
pub use silence::Silence;
pub use subscribe::{Iter, Subscribe, Subscriber, WithTimeout, subscribe};
pub use topic_reader::Received;
pub use wait::Wait;
pub use zones::{ZonesSubscriber, ZonesUpdate, zones};

/// Payload of the topic `telegram`: the bytes of a telegram.
pub use scanhub_schema::TelegramBytes as Telegram;
/// Types of topics and payloads, so that a program needs no other dependency.
pub use scanhub_schema::{
    Age, Flags, Header, Pose, Quality, ROBOT, Reasons, Request, ResponseModel, Topic, Verb, WakeEvent,
    payloads::*,
};
pub use scanhub_shm::{DEFAULT_DOMAIN, Domain, Environment};

/// Payload of a topic: a type of this crate such as [`Scan`]. Other crates cannot implement this trait.
///
/// ```compile_fail,E0277
/// #[derive(Debug)]
/// struct Mine;
/// impl scanhub_client::Payload for Mine {
///     const TOPIC: scanhub_client::Topic = scanhub_client::Topic::Scan;
/// }
/// ```
///
/// ```
/// use scanhub_client::{Payload, Scan, Topic};
///
/// assert_eq!(Scan::TOPIC, Topic::Scan);
/// ```
pub trait Payload: scanhub_shm::Payload {
    /// Topic of this payload.
    const TOPIC: Topic;
}

impl<P: scanhub_shm::Payload + ?Sized> Payload for P {
    const TOPIC: Topic = <P as scanhub_shm::Payload>::TOPIC;
}

/// Parts for programs that follow many topics in one thread: a session in a domain, sources of topics in it, and the
/// state of the hub. Most programs only need a [`Subscriber`].
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::streams::{Session, Source};
/// use scanhub_client::{Error, Topic, domain_candidates};
///
/// fn main() -> Result<(), Error> {
///     let mut session = Session::new(domain_candidates(None, None)?);
///     let mut sources = [Source::new("front", Topic::Scan), Source::new("rear", Topic::Scan)];
///     loop {
///         session.check_hub()?;
///         for source in &mut sources {
///             while let Some(sample) = source.receive(&mut session)? {
///                 println!("{} bytes", sample.bytes().len());
///             }
///         }
///         session.wait(None)?;
///     }
/// }
/// ```
pub mod streams {
    pub use crate::hub_finder::{Change, DomainHolder, STARTUP_GRACE, find};
    pub use crate::join::Join;
    pub use crate::robot::{RobotSource, RobotUpdate};
    pub use crate::sample::{Sample, Source};
    pub use crate::session::Session;
    pub use crate::topic_reader::{SequenceGap, SequenceTracker, TopicReader};
    pub use crate::zones::{StalenessTimer, ZonesSource, ZonesState};
}

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
