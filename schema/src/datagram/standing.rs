//! The rank of a sender when there is no room for another one. Anybody who can send can invent senders: so a sender that
//! is known to deliver is never replaced by one that only announces itself, and the one silent for longest goes first.
//! Refuses to know who it is. Time is an argument.

use super::voices::SILENT_NS;

/// What arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// It is a sample, not an announcement.
    pub delivers: bool,
    /// When, in ns of a clock that is never set.
    pub now_ns: u64,
}

/// What arrived from one sender, as far as it matters for making room.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Standing {
    heard_ns: u64,
    /// When the first and the last sample came.
    delivered_ns: Option<(u64, u64)>,
}

/// Samples that came over so long a time are known to be delivered.
const PROVEN_NS: u64 = 1_000_000_000;
/// Who is known to deliver counts as heard for so long after the last sample.
const KEPT_NS: u64 = 60_000_000_000;

impl Standing {
    /// Nothing arrived.
    pub const NONE: Standing = Standing { heard_ns: 0, delivered_ns: None };

    /// Takes note that something of it was taken.
    pub fn take(&mut self, arrival: Arrival) {
        let now_ns = arrival.now_ns;
        self.heard_ns = now_ns;
        if arrival.delivers {
            self.delivered_ns = Some((self.delivered_ns.map_or(now_ns, |(first_ns, _)| first_ns), now_ns));
        }
    }

    /// Returns whether it may be put out for another of which this came: it did not deliver for 3 s, or for a sample, it
    /// has not done so for a second yet.
    pub fn may_go(&self, arrival: Arrival) -> bool {
        let silent_ns = |(_, last_ns): (u64, u64)| arrival.now_ns.saturating_sub(last_ns);
        let is_busy = self.delivered_ns.is_some_and(|delivered_ns| silent_ns(delivered_ns) < SILENT_NS);
        !is_busy || arrival.delivers && !self.is_proven()
    }

    /// Returns until when it counts as heard: of those that may go, the least goes first.
    pub fn worth_ns(&self) -> u64 {
        match self.delivered_ns {
            None => self.heard_ns,
            Some((_, last_ns)) => last_ns + if self.is_proven() { KEPT_NS } else { SILENT_NS },
        }
    }

    fn is_proven(&self) -> bool {
        self.delivered_ns.is_some_and(|(first_ns, last_ns)| last_ns.saturating_sub(first_ns) >= PROVEN_NS)
    }
}
