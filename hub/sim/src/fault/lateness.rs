//! What arrives late but arrives: a line that is stuck for a while, and pieces that are each late by a random time. The
//! order never changes.

use schema::Nanos;

use super::schedule::Window;
use super::{Faults, random};

/// How late each piece is.
#[derive(Clone, Debug)]
pub(crate) struct Lateness {
    stall: Window,
    /// Greatest random lateness.
    delay_ns: Nanos,
    random: fastrand::Rng,
    /// When the last piece arrives.
    last_ns: Nanos,
}

impl Lateness {
    pub(crate) fn new(faults: &Faults, seed: u64) -> Lateness {
        Lateness {
            stall: Window::new(faults.stall, faults.stall_at, faults.stall_every, random(seed, 10)),
            delay_ns: (faults.delay * 1e9) as Nanos,
            random: random(seed, 11),
            last_ns: 0,
        }
    }

    /// The same, but behind what `other` holds back.
    pub(crate) fn behind(self, other: &Lateness) -> Lateness {
        Lateness { last_ns: other.last_ns, ..self }
    }

    /// When a piece arrives that is through at `now`.
    pub(crate) fn release_ns(&mut self, now: Nanos) -> Nanos {
        let delay_ns = if self.delay_ns > 0 { self.random.u64(..=self.delay_ns) } else { 0 };
        self.last_ns = self.last_ns.max(self.stall.end_ns(now) + delay_ns);
        self.last_ns
    }
}
