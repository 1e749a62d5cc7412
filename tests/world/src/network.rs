//! A network in virtual time that loses, doubles, damages, delays and reorders datagrams, and is cut at times: all by a seed.
//! Refuses to know what a datagram says.

use std::collections::BTreeMap;

use fastrand::Rng;

/// Nanoseconds since the begin of the run.
pub(crate) type Nanos = u64;

/// What goes wrong, and how often.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Faults {
    /// Of all datagrams so many are lost, from 0 to 1.
    pub(crate) loss: f64,
    /// So many come twice.
    pub(crate) duplicate: f64,
    /// So many come with one to three other bits.
    pub(crate) damage: f64,
    /// The shortest way.
    pub(crate) delay_ns: Nanos,
    /// What the way takes longer at most, each datagram by itself: they overtake each other.
    pub(crate) jitter_ns: Nanos,
    /// Nothing passes for this long at most, each few seconds; 0: never.
    pub(crate) partition_ns: Nanos,
}

/// The datagrams on their way.
pub(crate) struct Network {
    rng: Rng,
    faults: Faults,
    /// By the time at which they come, and by a number.
    queue: BTreeMap<(Nanos, u64), Vec<u8>>,
    number: u64,
    /// When it is cut the next time, or was, and until when.
    partition: (Nanos, Nanos),
}

/// Between two partitions, at most.
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

    /// From now on the faults are these.
    pub(crate) fn set_faults(&mut self, faults: Faults, now: Nanos) {
        self.faults = faults;
        self.partition = self.next_partition(now);
    }

    /// Takes a datagram at `now`.
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

    /// Returns a datagram that came until `now`, the earliest one.
    pub(crate) fn poll(&mut self, now: Nanos) -> Option<Vec<u8>> {
        self.queue.first_entry().filter(|first| first.key().0 <= now).map(|first| first.remove())
    }

    /// Returns when the next datagram comes.
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
