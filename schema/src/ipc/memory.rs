//! Whether there is room in shared memory for what is to be made next. The library makes segments that are promised,
//! not allocated: at a full /dev/shm the first touch of one ends the process by SIGBUS.

use rustix::fs::statvfs;

use crate::{Failure, Kind};

/// Where POSIX shared memory lives on Linux.
pub const SHARED_MEMORY: &str = "/dev/shm";

/// What the segments of a consumer or of a client of the control service take, and some for others that come at the
/// same time: each has a few pages.
pub(super) const CLIENT_BYTES: u64 = 64 * 1024;

/// Refuses to go on where fewer than `needed` bytes of shared memory are free.
///
/// [`Kind::Short`] with what is free and what is needed.
pub fn check_room(needed: u64) -> Result<(), Failure> {
    let Ok(stat) = statvfs(SHARED_MEMORY) else { return Ok(()) };
    let free = stat.f_bavail * stat.f_frsize;
    if free >= needed {
        return Ok(());
    }
    Err(short(&format!("{} kB free, {} kB needed", free / 1024, needed.div_ceil(1024))))
}

/// Shared memory is short, in the words of `what`.
pub fn short(what: &str) -> Failure {
    Failure::new(
        Kind::Short,
        format!("shared memory is short: {SHARED_MEMORY}: {what}"),
        format!("free some of {SHARED_MEMORY}, then start again"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_more_than_there_is_is_refused() {
        assert_eq!(check_room(0), Ok(()));
        let failure = check_room(1 << 60).unwrap_err();
        assert_eq!(failure.kind, Kind::Short);
        assert!(failure.message.contains(&format!("{} kB needed", 1_u64 << 50)), "{failure}");
    }
}
