//! When messages are sent: the same phases for every mechanism, known to sender and receivers. Refuses to know what is
//! sent.

use super::way::Way;

/// Some messages at one rate.
pub(crate) struct Phase {
    /// Its name in tables.
    pub(crate) name: &'static str,
    /// From one message to the next, in ns; 0: at once.
    pub(crate) period_ns: u64,
    /// Messages at most.
    count: usize,
    /// It ends after so much time, whatever was sent, in ns: some mechanisms cannot keep the rate.
    most_ns: u64,
}

impl Phase {
    /// How many messages there are by `way`. Floors are paced: a wake-up that nobody waits for is none.
    pub(crate) fn count(&self, way: Way) -> usize {
        if way.is_floor() && self.period_ns == 0 { 0 } else { self.count }
    }

    /// When it ends in any case, in ns from its begin. Receivers of a floor know it by the count alone.
    pub(crate) fn most_ns(&self, way: Way) -> u64 {
        if way.is_floor() { u64::MAX } else { self.most_ns }
    }
}

/// In this order. The first one is for memory and caches and is not told.
pub(crate) const PHASES: [Phase; 4] = [
    Phase { name: "warm-up", period_ns: 1_000_000, count: 20, most_ns: 40_000_000 },
    Phase { name: "37.5 Hz", period_ns: 26_666_667, count: 28, most_ns: 900_000_000 },
    Phase { name: "1 kHz", period_ns: 1_000_000, count: 400, most_ns: 500_000_000 },
    Phase { name: "flat out", period_ns: 0, count: 2000, most_ns: 300_000_000 },
];
