//! What the links of a configuration need: shared memory and descriptors. Refuses to know what the machine has.

use schema::Topic;
use schema::limits::TopicLimits;
use shm::shortage::{self, sensor_bytes};

/// Bytes of shared memory for links with topics made as `limits` say of each, and the first consumers.
pub fn memory(limits: &[TopicLimits]) -> u64 {
    limits.iter().map(|limits| sensor_bytes(&Topic::OF_LINKS, limits)).sum::<u64>() + REST
}

/// Bytes of the longest segment of any of them.
pub fn longest_segment(limits: &[TopicLimits]) -> u64 {
    limits.iter().map(|limits| shortage::longest_segment(&Topic::OF_LINKS, limits)).max().unwrap_or_default()
}

/// Descriptors for `links` links and a first consumer of each, besides those open from the start.
pub fn descriptors(links: usize) -> u64 {
    BASE_DESCRIPTORS + links as u64 * LINK_DESCRIPTORS
}

/// Descriptors of what belongs to no link, beside those open from the start: 16 are left open, making them takes more.
const BASE_DESCRIPTORS: u64 = 24;
/// Descriptors of a link: four for each of its services, which are a topic or the event, its port, the lock of its name, and a
/// first subscriber.
const LINK_DESCRIPTORS: u64 = 4 * (Topic::OF_LINKS.len() as u64 + 1) + 7;
/// The control service, what belongs to no link, and the first consumers.
const REST: u64 = 512 * 1024;
