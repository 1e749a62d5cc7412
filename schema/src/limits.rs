//! How much every service holds. Explicit, because the defaults of the shared-memory library (8 consumers, 20 nodes,
//! 2 samples) are too small, and because a consumer that asks for more than was created is refused.

use crate::Topic;

/// Publishers of a topic: the hub's link.
pub const PUBLISHERS: usize = 1;
/// Processes that have a service open.
pub const NODES: usize = 260;
/// Samples that a consumer may hold at a time.
pub const BORROWED: usize = 4;
/// Samples that the publisher may have in work at a time.
pub const LOANED: usize = 2;
/// Consumers that sleep on a wake service: those of all topics of a sensor, and others besides 200 of one topic.
pub const LISTENERS: usize = 250;
/// Notifiers of a wake service: the hub's link, and those of dead hubs that are not cleaned up yet.
pub const NOTIFIERS: usize = 4;
/// The greatest event id of a wake service.
pub const EVENT_ID: usize = 7;

/// Clients that send requests to the hub at the same time.
pub const CONTROL_CLIENTS: usize = 16;
/// Processes that have the control service open, dead ones that are not cleaned up yet among them.
pub const CONTROL_NODES: usize = 32;

/// Returns the number of consumers of `topic` at a time.
pub const fn subscribers(topic: Topic) -> usize {
    topic.row().consumers
}

/// Returns the number of samples that wait for a consumer of `topic`.
pub const fn buffer(topic: Topic) -> usize {
    topic.row().waiting
}

/// Returns the number of samples that a consumer of `topic` gets which comes later.
pub const fn history(topic: Topic) -> usize {
    topic.row().kept
}

/// Returns the number of samples to reserve memory for. All queues hold the same latest samples, so that their number does
/// not count.
pub const fn samples(topic: Topic) -> usize {
    buffer(topic) + subscribers(topic) * BORROWED + history(topic) + LOANED
}
