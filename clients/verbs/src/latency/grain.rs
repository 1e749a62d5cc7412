//! The resolution of the clock of this machine: no latency can be measured more finely.

use rustix::time::{ClockId, Timespec, clock_getres};
use scanhub_client::clock::now_ns;

/// What [`now_ns`](scanhub_client::clock::now_ns) costs, and how fine it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Grain {
    /// Of reading it once, in ns.
    pub(super) read_ns: f64,
    /// Between two times that it can tell apart, in ns, as the system says.
    pub(super) resolution_ns: u64,
}

/// Measured now: the best of a few runs, which nothing came between.
pub(super) fn grain() -> Grain {
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
