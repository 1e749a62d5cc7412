//! The only place in the hub that reads the clock.

#![expect(clippy::disallowed_methods, reason = "the clock of the hub")]

use rustix::event::Timespec;
use rustix::time::{ClockId, clock_gettime};
use scanhub_schema::Nanos;

/// CLOCK_MONOTONIC, the clock of every stamp and deadline.
pub fn now() -> Nanos {
    nanos(clock_gettime(ClockId::Monotonic))
}

/// The wall clock, in nanoseconds since 1970.
pub fn wall_ns() -> u64 {
    nanos(clock_gettime(ClockId::Realtime))
}

/// Nanoseconds since 1970 of the moment that CLOCK_MONOTONIC called `stamp`; `now` was read just now.
pub fn to_wall_ns(stamp: Nanos, now: Nanos) -> u64 {
    wall_ns().saturating_sub(now.saturating_sub(stamp))
}

/// The time from `now` to `until` as poll wants it; nothing if `until` is past, at least a nanosecond otherwise.
pub fn poll_timeout(now: Nanos, until: Nanos) -> Timespec {
    let remaining = until.saturating_sub(now);
    Timespec { tv_sec: (remaining / 1_000_000_000) as i64, tv_nsec: (remaining % 1_000_000_000) as i64 }
}

fn nanos(time: Timespec) -> Nanos {
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}
