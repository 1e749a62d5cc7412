//! Faults that happen at a time: [`Schedule`] has points in time, [`Window`] spans of time, [`Extra`] garbage that
//! arrives now and then, and [`Lateness`] the delays of chunks. Times are those of the scanner, from 0 on.

use schema::{MILLIS, Nanos};

use super::{Fault, Faults, random};

/// Points in time at which a fault happens.
#[derive(Clone, Debug)]
pub(crate) struct Schedule {
    every_s: f64,
    next_ns: Nanos,
    random: fastrand::Rng,
}

impl Schedule {
    /// Creates a schedule. The first time is `at_s`, and each next time is `every_s` later on average, in seconds. If
    /// `every_s` is 0, there is only the first time. If `at_s` is 0, the first time is drawn like the others, or is
    /// [`ONCE_S`] if there are no others.
    pub(crate) fn new(at_s: f64, every_s: f64, random: fastrand::Rng) -> Schedule {
        let mut schedule = Schedule { every_s, next_ns: 0, random };
        schedule.next_ns = match (at_s > 0.0, every_s > 0.0) {
            (true, _) => nanos(at_s),
            (false, true) => schedule.interval_ns(),
            (false, false) => nanos(ONCE_S),
        };
        schedule
    }

    /// Returns the times of the scanner's power cycles.
    pub(crate) fn power_cycles(faults: &Faults, seed: u64) -> Schedule {
        Schedule::wanted(faults.power_at, faults.power_every, random(seed, 7))
    }

    /// Returns the times at which the scanner's voltage dips.
    pub(crate) fn brownouts(faults: &Faults, seed: u64) -> Schedule {
        Schedule::wanted(faults.brownout_at, faults.brownout_every, random(seed, 12))
    }

    /// Creates a schedule as [`Schedule::new`] does, or an empty one if both times are 0.
    fn wanted(at_s: f64, every_s: f64, random: fastrand::Rng) -> Schedule {
        if at_s + every_s > 0.0 { Schedule::new(at_s, every_s, random) } else { Schedule::never() }
    }

    /// Returns an empty schedule.
    pub(crate) fn never() -> Schedule {
        Schedule { every_s: 0.0, next_ns: Nanos::MAX, random: fastrand::Rng::with_seed(0) }
    }

    pub(crate) fn next_ns(&self) -> Nanos {
        self.next_ns
    }

    /// Removes and returns the next time, unless it is after `now`.
    pub(crate) fn take(&mut self, now: Nanos) -> Option<Nanos> {
        let at_ns = Some(self.next_ns).filter(|&at| at <= now)?;
        let interval_ns = if self.every_s > 0.0 { self.interval_ns() } else { Nanos::MAX };
        self.next_ns = at_ns.saturating_add(interval_ns);
        Some(at_ns)
    }

    fn interval_ns(&mut self) -> Nanos {
        nanos(self.every_s * (0.5 + self.random.f64())).max(MILLIS)
    }
}

/// Spans of time in which a fault is present.
#[derive(Clone, Debug)]
pub(crate) struct Window {
    begins: Schedule,
    span_ns: Nanos,
    /// End of the span that has begun last.
    until_ns: Nanos,
}

impl Window {
    /// Creates spans of `span_s` seconds that begin at the times of [`Schedule::new`]. There are none if `span_s` is 0.
    pub(crate) fn new(span_s: f64, at_s: f64, every_s: f64, random: fastrand::Rng) -> Window {
        let begins = if span_s > 0.0 { Schedule::new(at_s, every_s, random) } else { Schedule::never() };
        Window { begins, span_ns: nanos(span_s), until_ns: 0 }
    }

    /// Creates a single span, which begins at `begin_ns`.
    pub(crate) fn once(begin_ns: Nanos, span_ns: Nanos) -> Window {
        let begins = Schedule { next_ns: begin_ns, ..Schedule::never() };
        Window { begins, span_ns, until_ns: 0 }
    }

    /// Returns the times at which no byte arrives.
    pub(crate) fn silences(faults: &Faults, seed: u64) -> Window {
        Window::new(faults.silence, faults.silence_at, faults.silence_every, random(seed, 8))
    }

    /// Returns the times at which the port is unplugged.
    pub(crate) fn unplugs(faults: &Faults, seed: u64) -> Window {
        Window::new(faults.unplug, faults.unplug_at, faults.unplug_every, random(seed, 9))
    }

    /// Returns the times at which something holds the head of the scanner.
    pub(crate) fn held(faults: &Faults, seed: u64) -> Window {
        Window::new(faults.hold, faults.hold_at, faults.hold_every, random(seed, 13))
    }

    /// Returns whether the fault is present at `now`. Time must not go backwards.
    pub(crate) fn holds(&mut self, now: Nanos) -> bool {
        while let Some(begin_ns) = self.begins.take(now) {
            self.until_ns = begin_ns + self.span_ns;
        }
        now < self.until_ns
    }

    /// Returns the end of the span at `now`, or `now` if there is none.
    pub(crate) fn end_ns(&mut self, now: Nanos) -> Nanos {
        if self.holds(now) { self.until_ns } else { now }
    }

    /// Returns the time of the next change after `now`.
    pub(crate) fn next_ns(&self, now: Nanos) -> Nanos {
        if now < self.until_ns { self.until_ns.min(self.begins.next_ns()) } else { self.begins.next_ns() }
    }
}

/// Garbage that arrives now and then, between telegrams or inside one.
#[derive(Clone, Debug)]
pub(crate) struct Extra {
    pub(crate) fault: Fault,
    schedule: Schedule,
    len: usize,
    inside: f64,
    random: fastrand::Rng,
    /// Whether the next garbage arrives inside a telegram.
    wants_inside: bool,
    /// Number of bytes of the telegram before the garbage.
    passes: usize,
}

impl Extra {
    /// Creates floods of random bytes.
    pub(crate) fn floods(faults: &Faults, seed: u64) -> Extra {
        Extra::new(Fault::Flood, faults.flood, faults.flood_every, faults.inside, random(seed, 5))
    }

    /// Creates walls of start bytes.
    pub(crate) fn walls(faults: &Faults, seed: u64) -> Extra {
        Extra::new(Fault::Wall, faults.wall, faults.wall_every, faults.inside, random(seed, 6))
    }

    fn new(fault: Fault, len: f64, every_s: f64, inside: f64, mut random: fastrand::Rng) -> Extra {
        let happens = len >= 1.0;
        let schedule = if happens { Schedule::new(0.0, every_s, random.fork()) } else { Schedule::never() };
        let wants_inside = random.f64() < inside;
        Extra { fault, schedule, len: len as usize, inside, random, wants_inside, passes: 0 }
    }

    /// Returns the time of the next garbage, for a line between two telegrams, or inside one if `inside` is set.
    pub(crate) fn due_ns(&self, inside: bool) -> Nanos {
        if inside == self.wants_inside { self.schedule.next_ns() } else { Nanos::MAX }
    }

    /// Returns the garbage, if it is due before the byte that ends at `now`. `header` has the first bytes of the
    /// stream's telegrams.
    pub(crate) fn take(&mut self, now: Nanos, inside: bool, header: &[u8]) -> Option<Vec<u8>> {
        if self.due_ns(inside) > now {
            return None;
        }
        if inside && self.passes > 0 {
            self.passes -= 1;
            return None;
        }
        self.schedule.take(now)?;
        self.wants_inside = self.random.f64() < self.inside;
        self.passes = self.random.usize(..64);
        if self.fault == Fault::Flood {
            return Some((0..self.len).map(|_| self.random.u8(..)).collect());
        }
        // Before the start of the stream, use the first bytes of an LMS telegram.
        let header = if header.len() < 2 { &[0x02, 0x80] } else { header };
        let bricks: [&[u8]; 3] = [&header[..1], &header[..2], header];
        let brick = bricks[self.random.usize(..3)];
        Some(brick.iter().copied().cycle().take(self.len).collect())
    }
}

fn nanos(seconds: f64) -> Nanos {
    (seconds * 1e9) as Nanos
}

/// Time of a single fault without a configured time, in seconds. A session streams by then.
const ONCE_S: f64 = 5.0;

/// Delays of chunks: a line that is stuck for a while, and random delays. The order of the chunks never changes.
#[derive(Clone, Debug)]
pub(crate) struct Lateness {
    stall: Window,
    /// Maximum random delay.
    delay_ns: Nanos,
    random: fastrand::Rng,
    /// Arrival of the last chunk.
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

    /// Returns these delays, with every chunk after those that `other` delays.
    pub(crate) fn behind(self, other: &Lateness) -> Lateness {
        Lateness { last_ns: other.last_ns, ..self }
    }

    /// Returns the arrival of a chunk whose transmission ends at `now`.
    pub(crate) fn release_ns(&mut self, now: Nanos) -> Nanos {
        let delay_ns = if self.delay_ns > 0 { self.random.u64(..=self.delay_ns) } else { 0 };
        self.last_ns = self.last_ns.max(self.stall.end_ns(now) + delay_ns);
        self.last_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: Nanos = 1_000_000_000;

    #[test]
    fn spans_begin_and_end_when_they_were_said_to() {
        let mut window = Window::new(1.5, 3.0, 0.0, random(1, 1));
        assert_eq!((window.next_ns(0), window.holds(3 * S - 1)), (3 * S, false));
        assert!(window.holds(3 * S) && window.holds(4 * S));
        assert_eq!(window.next_ns(4 * S), 4 * S + S / 2);
        assert!(!window.holds(4 * S + S / 2) && !window.holds(100 * S));
        assert_eq!(window.next_ns(100 * S), Nanos::MAX);
        assert!(!Window::new(0.0, 3.0, 1.0, random(1, 1)).holds(50 * S));
        assert!(Window::new(1.0, 0.0, 0.0, random(1, 1)).holds(5 * S));
    }

    #[test]
    fn repeated_ones_come_as_often_as_was_said() {
        let mut schedule = Schedule::new(0.0, 2.0, random(1, 1));
        let times = (0..200 * 100).filter(|i| schedule.take(i * S / 100).is_some()).count();
        assert!((85..115).contains(&times), "{times}");
    }
}
