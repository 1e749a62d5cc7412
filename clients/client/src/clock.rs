//! Clocks that the client library uses.

use rustix::time::{ClockId, Timespec, clock_gettime};

/// Point in time on two clocks, in ns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timestamp {
    /// CLOCK_MONOTONIC, the clock of all stamps. It stops while the machine is suspended.
    pub monotonic_ns: u64,
    /// CLOCK_BOOTTIME, which continues while the machine is suspended.
    pub boottime_ns: u64,
}

/// Returns the current time on both clocks.
pub fn now() -> Timestamp {
    Timestamp { monotonic_ns: read(ClockId::Monotonic), boottime_ns: read(ClockId::Boottime) }
}

/// Returns CLOCK_MONOTONIC alone, in ns.
pub fn now_ns() -> u64 {
    read(ClockId::Monotonic)
}

/// Returns CLOCK_BOOTTIME alone, in ns.
pub(crate) fn boottime_ns() -> u64 {
    read(ClockId::Boottime)
}

/// Returns the wall clock, ns since 1970.
pub fn wall_ns() -> u64 {
    read(ClockId::Realtime)
}

fn read(clock: ClockId) -> u64 {
    let Timespec { tv_sec, tv_nsec } = clock_gettime(clock);
    tv_sec as u64 * 1_000_000_000 + tv_nsec as u64
}
