//! Clocks of the hub. No other module reads a clock.

#![expect(clippy::disallowed_methods, reason = "the clock of the hub")]

use rustix::event::Timespec;
use rustix::time::{ClockId, clock_gettime};
use scanhub_schema::Nanos;

/// Returns the time of CLOCK_MONOTONIC, which is the clock of every stamp and deadline.
pub fn now() -> Nanos {
    nanos(clock_gettime(ClockId::Monotonic))
}

/// Returns the wall-clock time, in nanoseconds since 1970.
pub fn wall_ns() -> u64 {
    nanos(clock_gettime(ClockId::Realtime))
}

/// Converts a `stamp` of CLOCK_MONOTONIC to wall-clock time, in nanoseconds since 1970. `now` is the present time of
/// CLOCK_MONOTONIC.
pub fn to_wall_ns(stamp: Nanos, now: Nanos) -> u64 {
    wall_ns().saturating_sub(now.saturating_sub(stamp))
}

/// Returns the time from `now` to `until` in the format of `poll`. The result is 0 if `until` has passed.
pub fn poll_timeout(now: Nanos, until: Nanos) -> Timespec {
    let remaining = until.saturating_sub(now);
    Timespec { tv_sec: (remaining / 1_000_000_000) as i64, tv_nsec: (remaining % 1_000_000_000) as i64 }
}

fn nanos(time: Timespec) -> Nanos {
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}
