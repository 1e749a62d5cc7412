//! What time it is, on the clocks that matter here.

use rustix::time::{ClockId, Timespec, clock_getres, clock_gettime};

/// One moment on two clocks, in ns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Moment {
    /// CLOCK_MONOTONIC, the clock of all stamps; it stands still while the machine is suspended.
    pub(crate) monotonic_ns: u64,
    /// CLOCK_BOOTTIME: the same, and it goes on.
    pub(crate) boottime_ns: u64,
}

/// This moment.
pub(crate) fn now() -> Moment {
    Moment { monotonic_ns: read(ClockId::Monotonic), boottime_ns: read(ClockId::Boottime) }
}

/// CLOCK_MONOTONIC alone, in ns.
pub(crate) fn now_ns() -> u64 {
    read(ClockId::Monotonic)
}

/// The wall clock, ns since 1970.
pub(crate) fn wall_ns() -> u64 {
    read(ClockId::Realtime)
}

/// What [`now_ns`] costs, and how fine it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Grain {
    /// Of reading it once, in ns.
    pub(crate) read_ns: f64,
    /// Between two times that it can tell apart, in ns, as the system says.
    pub(crate) resolution_ns: u64,
}

/// Measured now: the best of a few runs, which nothing came between.
pub(crate) fn grain() -> Grain {
    const RUNS: usize = 8;
    const READS: u32 = 256;
    let run = || {
        let begin = now_ns();
        for _ in 1..READS {
            std::hint::black_box(now_ns());
        }
        (now_ns() - begin) as f64 / f64::from(READS)
    };
    let Timespec { tv_sec, tv_nsec } = clock_getres(ClockId::Monotonic);
    Grain {
        read_ns: (0..RUNS).map(|_| run()).fold(f64::INFINITY, f64::min),
        resolution_ns: tv_sec as u64 * 1_000_000_000 + tv_nsec as u64,
    }
}

fn read(clock: ClockId) -> u64 {
    let Timespec { tv_sec, tv_nsec } = clock_gettime(clock);
    tv_sec as u64 * 1_000_000_000 + tv_nsec as u64
}
