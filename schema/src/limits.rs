//! How much every service holds. Explicit, because the defaults of the shared-memory library (8 subscribers, 20 nodes,
//! 2 samples) are too small, and because a subscriber that asks for more than was created is refused.

use std::ops::RangeInclusive;

use crate::{ArrayFlags, Failure, Family, Kind, Topic};

/// Publishers of a topic: the hub's link.
pub const MAX_PUBLISHERS: usize = 1;
/// What is said of the topics of a sensor when they are made. All else is the same for all sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicLimits {
    /// Subscribers of each topic at a time, one of [`TopicLimits::SUBSCRIBERS`]. For each sample the shared-memory library looks at
    /// all places three times, and they are far apart in memory; each has memory for the samples that it may hold. So if few
    /// programs follow, many places cost more than the sample.
    pub subscribers: usize,
    /// The most beams of a scan.
    pub beams: usize,
    /// The arrays that its scans may have, bits of [`ArrayFlags`].
    pub contents: u8,
    /// The most bytes of a telegram.
    pub telegram: usize,
}

impl TopicLimits {
    /// Numbers of subscribers that a topic can be created for. The event that wakes them has no more places.
    pub const SUBSCRIBERS: RangeInclusive<usize> = 1..=MAX_LISTENERS;

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
            contents: ArrayFlags::UPPER,
            telegram: Family::Lms.max_telegram(),
        }
    }
}

/// Processes that have a service open.
pub const MAX_NODES: usize = 260;
/// Samples that a subscriber may hold at a time.
pub const MAX_BORROWED_SAMPLES: usize = 4;
/// Samples that the publisher may have in work at a time.
pub const MAX_LOANED_SAMPLES: usize = 2;
/// Subscribers that sleep on a wake service: those of all topics of a sensor.
pub const MAX_LISTENERS: usize = 250;
/// Notifiers of a wake service: the hub's link, and those of dead hubs that are not cleaned up yet.
pub const MAX_NOTIFIERS: usize = 4;
/// The greatest event id of a wake service.
pub const MAX_EVENT_ID: usize = 7;

/// Clients that send requests to the hub at the same time.
pub const MAX_CONTROL_CLIENTS: usize = 16;
/// Processes that have the control service open, dead ones that are not cleaned up yet among them.
pub const MAX_CONTROL_NODES: usize = 32;

/// Returns the number of samples that wait for a subscriber of `topic`.
pub const fn queue_len(topic: Topic) -> usize {
    topic.spec().queue_len
}

/// Returns the number of samples of `topic` that a late joiner receives.
pub const fn history_len(topic: Topic) -> usize {
    topic.spec().history_len
}

/// Returns the number of samples to reserve memory for where `subscribers` have places. All queues hold the same latest
/// samples, so that their number does not count.
pub const fn sample_count(topic: Topic, subscribers: usize) -> usize {
    queue_len(topic) + subscribers * MAX_BORROWED_SAMPLES + history_len(topic) + MAX_LOANED_SAMPLES
}
