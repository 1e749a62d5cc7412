//! CLOCK_MONOTONIC, which is the clock of all stamps in the benches and in the hub, and functions that wait until a
//! given time.

use std::os::fd::AsFd;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::time::{ClockId, clock_gettime};

/// Returns the time of CLOCK_MONOTONIC in nanoseconds.
pub(crate) fn now() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Sleeps until the time `until`.
pub(crate) fn sleep_until(until: u64) {
    let _ = poll(&mut [], Some(&span(until)));
}

/// Waits until `file` is readable, or until the time `until` if it is given. Returns whether `file` is readable.
pub(crate) fn readable(file: impl AsFd, until: Option<u64>) -> Result<bool, Errno> {
    let mut fds = [PollFd::new(&file, PollFlags::IN)];
    match poll(&mut fds, until.map(span).as_ref()) {
        Ok(count) => Ok(count > 0),
        Err(Errno::INTR) => Ok(false),
        Err(error) => Err(error),
    }
}

fn span(until: u64) -> Timespec {
    let left = until.saturating_sub(now());
    Timespec { tv_sec: (left / 1_000_000_000) as _, tv_nsec: (left % 1_000_000_000) as _ }
}
