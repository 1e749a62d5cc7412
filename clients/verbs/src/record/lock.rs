//! Allows one writer per file: two would overwrite each other, and neither would notice. Refuses to know what is
//! written.

use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind};
use std::os::unix::fs::MetadataExt;

use rustix::fs::{major, minor};

/// Takes `file` for this process, until it is closed.
///
/// [`ErrorKind::ResourceBusy`] if another one has it. A file system without locks is no error.
pub(super) fn take(file: &File) -> io::Result<()> {
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => {
            let who = holder(file).map_or(String::new(), |pid| format!(" (process {pid})"));
            Err(io::Error::new(ErrorKind::ResourceBusy, format!("another recorder writes it{who}")))
        }
        Ok(()) | Err(TryLockError::Error(_)) => Ok(()),
    }
}

/// Returns whether a process has taken `file`, or `None` if the file system has no locks.
pub(super) fn is_taken(file: &File) -> Option<bool> {
    // A shared lock needs no write permission. It is released when `file` is closed.
    match file.try_lock_shared() {
        Ok(()) => Some(false),
        Err(TryLockError::WouldBlock) => Some(true),
        Err(TryLockError::Error(_)) => None,
    }
}

/// The process that has `file`, where the kernel tells it.
fn holder(file: &File) -> Option<u32> {
    let place = file.metadata().ok()?;
    let id = format!("{:02x}:{:02x}:{}", major(place.dev()), minor(place.dev()), place.ino());
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let words = locks.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    let words = words.into_iter().find(|words| words.get(PLACE) == Some(&id.as_str()))?;
    words[PROCESS].parse().ok().filter(|pid| *pid > 0)
}

/// Words of a line of /proc/locks: `1: FLOCK ADVISORY WRITE 4711 08:01:131 0 EOF`.
const PROCESS: usize = 4;
const PLACE: usize = 5;
