//! How much every service holds. Explicit, because the defaults of the shared-memory library (8 subscribers, 20 nodes,
//! 2 samples) are too small, and because a subscriber that asks for more than was created is refused.

use std::ops::RangeInclusive;

use crate::{Contents, Failure, Family, Kind, Topic};

/// Publishers of a topic: the hub's link.
pub const PUBLISHERS: usize = 1;
/// What is said of the topics of a sensor when they are made. All else is the same for all sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicLimits {
    /// Subscribers of each topic at a time, one of [`TopicLimits::SUBSCRIBERS`]. For each sample the shared-memory library looks at
    /// all places three times, and they are far apart in memory; each has memory for the samples that it may hold. So if few
    /// programs follow, many places cost more than the sample.
    pub subscribers: usize,
    /// The most beams of a scan.
    pub beams: usize,
    /// The arrays that its scans may have, bits of [`Contents`].
    pub contents: u8,
    /// The most bytes of a telegram.
    pub telegram: usize,
}

impl TopicLimits {
    /// Numbers of subscribers that a topic can be created for. The event that wakes them has no more places.
    pub const SUBSCRIBERS: RangeInclusive<usize> = 1..=LISTENERS;

    /// Refuses what cannot be.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`] with the value and what can be.
    pub fn check(&self) -> Result<(), Failure> {
        let (TopicLimits { subscribers, .. }, all) = (self, Self::SUBSCRIBERS);
        if all.contains(subscribers) {
            return Ok(());
        }
        let hint = format!("{} to {}", all.start(), all.end());
        Err(Failure::new(Kind::Configuration, format!("topics for {subscribers} subscribers"), hint))
    }
}

impl Default for TopicLimits {
    /// For an LMS: 100 degrees in quarters.
    fn default() -> Self {
        TopicLimits {
            subscribers: 32,
            beams: 401,
            contents: Contents::UPPER,
            telegram: Family::Lms.max_telegram(),
        }
    }
}

/// Processes that have a service open.
pub const NODES: usize = 260;
/// Samples that a subscriber may hold at a time.
pub const BORROWED: usize = 4;
/// Samples that the publisher may have in work at a time.
pub const LOANED: usize = 2;
/// Subscribers that sleep on a wake service: those of all topics of a sensor.
pub const LISTENERS: usize = 250;
/// Notifiers of a wake service: the hub's link, and those of dead hubs that are not cleaned up yet.
pub const NOTIFIERS: usize = 4;
/// The greatest event id of a wake service.
pub const EVENT_ID: usize = 7;

/// Clients that send requests to the hub at the same time.
pub const CONTROL_CLIENTS: usize = 16;
/// Processes that have the control service open, dead ones that are not cleaned up yet among them.
pub const CONTROL_NODES: usize = 32;

/// Returns the number of samples that wait for a subscriber of `topic`.
pub const fn buffer(topic: Topic) -> usize {
    topic.row().waiting
}

/// Returns the number of samples of `topic` that a late joiner receives.
pub const fn history(topic: Topic) -> usize {
    topic.row().kept
}

/// Returns the number of samples to reserve memory for where `subscribers` have places. All queues hold the same latest
/// samples, so that their number does not count.
pub const fn samples(topic: Topic, subscribers: usize) -> usize {
    buffer(topic) + subscribers * BORROWED + history(topic) + LOANED
}
