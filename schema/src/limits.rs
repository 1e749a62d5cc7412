//! Sizes of all services. The sizes are set explicitly, because the defaults of the shared-memory library (8
//! subscribers, 20 nodes, 2 samples) are too small, and because the library rejects a subscriber that requests more
//! than the service was created for.

use std::ops::RangeInclusive;

use crate::{ArrayFlags, Failure, Family, Kind, Topic};

/// Maximum number of publishers of a topic. The publisher is the hub's link, or the program that publishes under the
/// name of the sensor.
pub const MAX_PUBLISHERS: usize = 1;
/// Limits with which the topics of a sensor are created. All other limits are the same for all sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicLimits {
    /// Maximum number of subscribers of each topic at a time, one of [`TopicLimits::SUBSCRIBERS`]. For each sample, the
    /// shared-memory library reads the slots of all possible subscribers three times. The slots are far apart in
    /// memory, and each slot has memory for the samples that its subscriber may hold. If most slots are unused, reading
    /// them costs more than the sample itself.
    pub subscribers: usize,
    /// Maximum number of beams of a scan.
    pub beams: usize,
    /// Arrays that scans may have: bits of [`ArrayFlags`].
    pub contents: u8,
    /// Maximum length of a telegram in bytes.
    pub telegram: usize,
}

impl TopicLimits {
    /// Permitted values of [`subscribers`](Self::subscribers). The highest one is the number of slots of the wake
    /// service, which wakes the subscribers of all topics of a sensor.
    pub const SUBSCRIBERS: RangeInclusive<usize> = 1..=MAX_LISTENERS;

    /// Checks that topics can be created with these limits.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] with the value and the permitted range.
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
    /// Returns the limits of an LMS, with at most 401 beams: 100 degrees in steps of 0.25 degrees.
    fn default() -> Self {
        TopicLimits {
            subscribers: 32,
            beams: 401,
            contents: ArrayFlags::UPPER,
            telegram: Family::Lms.max_telegram(),
        }
    }
}

/// Maximum number of processes that have a service open.
pub const MAX_NODES: usize = 260;
/// Maximum number of samples that a subscriber may hold at a time.
pub const MAX_BORROWED_SAMPLES: usize = 4;
/// Maximum number of samples that the publisher may have loaned at a time.
pub const MAX_LOANED_SAMPLES: usize = 2;
/// Maximum number of listeners of a wake service, for the subscribers of all topics of a sensor.
pub const MAX_LISTENERS: usize = 250;
/// Maximum number of notifiers of a wake service: the hub's link, and links of dead hubs that are not cleaned up yet.
pub const MAX_NOTIFIERS: usize = 4;
/// Highest event ID of a wake service.
pub const MAX_EVENT_ID: usize = 7;

/// Maximum number of clients that send requests to the hub at the same time.
pub const MAX_CONTROL_CLIENTS: usize = 16;
/// Maximum number of processes that have the control service open, including dead ones that are not cleaned up yet.
pub const MAX_CONTROL_NODES: usize = 32;

/// Returns the maximum number of samples that are queued for a subscriber of `topic`.
pub const fn queue_len(topic: Topic) -> usize {
    topic.spec().queue_len
}

/// Returns the number of samples of `topic` that a late joiner receives.
pub const fn history_len(topic: Topic) -> usize {
    topic.spec().history_len
}

/// Returns the number of samples to reserve memory for if the topic has `subscribers` slots. The number of queues does
/// not matter, because all of them hold the same latest samples.
pub const fn sample_count(topic: Topic, subscribers: usize) -> usize {
    queue_len(topic) + subscribers * MAX_BORROWED_SAMPLES + history_len(topic) + MAX_LOANED_SAMPLES
}
