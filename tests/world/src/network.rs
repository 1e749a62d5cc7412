//! A network in virtual time that loses, duplicates, damages, delays and reorders datagrams, and has partitions. A seed
//! determines all faults.

use std::collections::BTreeMap;

use fastrand::Rng;

/// Nanoseconds since the start of the run.
pub(crate) type Nanos = u64;

/// Faults of a network. Rates are shares of all datagrams, from 0 to 1.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Faults {
    /// Rate of lost datagrams.
    pub(crate) loss: f64,
    /// Rate of datagrams that arrive twice.
    pub(crate) duplicate: f64,
    /// Rate of datagrams in which one to three bits are flipped.
    pub(crate) damage: f64,
    /// Minimum delay.
    pub(crate) delay_ns: Nanos,
    /// Maximum additional delay. The additional delay is drawn for each datagram, so datagrams overtake each other.
    pub(crate) jitter_ns: Nanos,
    /// Maximum duration of a partition. Partitions start every few seconds. With 0, there are no partitions.
    pub(crate) partition_ns: Nanos,
}

/// A network with the datagrams in transit.
pub(crate) struct Network {
    rng: Rng,
    faults: Faults,
    /// Datagrams in transit. The key is the time of arrival, with a number that makes the key unique.
    queue: BTreeMap<(Nanos, u64), Vec<u8>>,
    number: u64,
    /// Start and end of the current or next partition.
    partition: (Nanos, Nanos),
}

/// Maximum time between two partitions.
const MAX_PARTITION_INTERVAL_NS: Nanos = 6_000_000_000;

impl Network {
    pub(crate) fn new(seed: u64, faults: Faults) -> Network {
        let mut network = Network {
            rng: Rng::with_seed(seed),
            faults,
            queue: BTreeMap::new(),
            number: 0,
            partition: (Nanos::MAX, Nanos::MAX),
        };
        network.partition = network.next_partition(0);
        network
    }

    /// Replaces the faults at `now`.
    pub(crate) fn set_faults(&mut self, faults: Faults, now: Nanos) {
        self.faults = faults;
        self.partition = self.next_partition(now);
    }

    /// Accepts a datagram at `now`.
    pub(crate) fn send(&mut self, now: Nanos, bytes: &[u8]) {
        while now >= self.partition.1 {
            self.partition = self.next_partition(self.partition.1);
        }
        if now >= self.partition.0 || self.rng.f64() < self.faults.loss {
            return;
        }
        let copies = if self.rng.f64() < self.faults.duplicate { 2 } else { 1 };
        for _ in 0..copies {
            let mut bytes = bytes.to_vec();
            if self.rng.f64() < self.faults.damage {
                self.damage(&mut bytes);
            }
            let way_ns = self.faults.delay_ns + self.rng.u64(0..=self.faults.jitter_ns);
            self.number += 1;
            self.queue.insert((now + way_ns, self.number), bytes);
        }
    }

    /// Returns the earliest datagram that has arrived by `now`.
    pub(crate) fn poll(&mut self, now: Nanos) -> Option<Vec<u8>> {
        self.queue.first_entry().filter(|first| first.key().0 <= now).map(|first| first.remove())
    }

    /// Returns the time at which the next datagram arrives.
    pub(crate) fn next_delivery(&self) -> Option<Nanos> {
        self.queue.first_key_value().map(|((at, _), _)| *at)
    }

    fn damage(&mut self, bytes: &mut [u8]) {
        let bits = 8 * bytes.len();
        let mut flipped = Vec::new();
        for _ in 0..self.rng.usize(1..=3) {
            let bit = self.rng.usize(0..bits);
            if !flipped.contains(&bit) {
                flipped.push(bit);
                bytes[bit / 8] ^= 1 << (bit % 8);
            }
        }
    }

    fn next_partition(&mut self, now: Nanos) -> (Nanos, Nanos) {
        if self.faults.partition_ns == 0 {
            return (Nanos::MAX, Nanos::MAX);
        }
        let begin = now + self.rng.u64(1..=MAX_PARTITION_INTERVAL_NS);
        (begin, begin + self.rng.u64(1..=self.faults.partition_ns))
    }
}
