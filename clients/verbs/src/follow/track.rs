//! One topic of one sensor that a verb follows: where its samples come from, and what was counted of them. Refuses to know
//! who else is followed.

use scanhub_client::streams::Source;
use scanhub_schema::Topic;

use crate::names::TopicName;
use crate::receive_stats::ReceiveStats;

/// A topic that is followed.
pub(super) struct Track {
    pub(super) name: TopicName,
    pub(super) source: Source,
    pub(super) stats: ReceiveStats,
    /// CLOCK_MONOTONIC since when samples are received as they are sent, in ns.
    pub(super) since_ns: u64,
}

impl Track {
    pub(super) fn new(name: TopicName) -> Track {
        Track {
            source: Source::new(&name.sensor, name.topic),
            stats: ReceiveStats::new(name.topic),
            name,
            since_ns: u64::MAX,
        }
    }

    /// Takes early warnings too, if it is zones that are followed. To be said before anything was received.
    pub(super) fn take_early(&mut self) {
        if self.name.topic == Topic::Zones {
            self.source = Source::zones_with_early(&self.name.sensor);
        }
    }

    /// Is no subscriber any more, until it is wanted again.
    pub(super) fn let_go(&mut self) {
        if self.source.subscribed() {
            *self = Track::new(self.name.clone());
        }
    }
}
