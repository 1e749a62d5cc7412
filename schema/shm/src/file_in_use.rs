//! Check whether any process uses a file.
#![allow(unsafe_code)]

use std::fs::OpenOptions;
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use nix::libc::{self, c_int};
use rustix::fs::OFlags;

/// Returns whether no process has the file at `path` open or mapped. The kernel grants a lease for writing only in this
/// case (fcntl(2)). The check must use the kernel, because this process cannot see all other processes, for example
/// those in a container that shares the memory.
///
/// Returns false if the answer is unknown, for example for a file of another user. A process that opens the file during
/// this call waits until the call returns.
pub fn is_unused(path: &Path) -> bool {
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let opened = OpenOptions::new().read(true).custom_flags(flags.bits() as i32).open(path);
    let Ok(file) = opened else { return false };
    let control = |command: c_int, argument: c_int| {
        // SAFETY: these commands take a number and touch no memory of this process, and the descriptor is open.
        unsafe { libc::fcntl(file.as_raw_fd(), command, argument) == 0 }
    };
    // If another process waits for the lease, the kernel sends a signal to the holder. The default signal would end
    // this process, but SIGURG is ignored by default.
    control(F_SETSIG, libc::SIGURG)
        && control(libc::F_SETLEASE, libc::F_WRLCK)
        && control(libc::F_SETLEASE, libc::F_UNLCK)
}

/// Command that sets the signal that the holder of a lease receives (asm-generic/fcntl.h).
const F_SETSIG: c_int = 10;

#[cfg(test)]
mod tests {
    use std::fs::{self, File};

    use memmap2::MmapOptions;

    use super::*;

    #[test]
    fn open_or_mapped_file_is_in_use() {
        let path = Path::new(crate::resource_limits::SHARED_MEMORY_DIRECTORY)
            .join(format!("shu{}", std::process::id()));
        assert!(!is_unused(&path), "it is not there");
        let made = File::create_new(&path).unwrap();
        made.set_len(4096).unwrap();
        let is_unheld = || is_unused(&path);
        let written = is_unheld();
        drop(made);
        let free = is_unheld();
        let opened = File::open(&path).unwrap();
        let read = is_unheld();
        let mapped = MmapOptions::new().len(4096).map_raw_read_only(&opened).unwrap();
        drop(opened);
        let only_mapped = is_unheld();
        drop(mapped);
        let free_again = is_unheld();
        fs::remove_file(&path).unwrap();
        assert_eq!([written, read, only_mapped], [false; 3]);
        // On a system without leases, the result is unknown.
        assert_eq!(free, free_again);
        assert!(free || fs::read_to_string("/proc/sys/fs/leases-enable").is_ok_and(|it| it.trim() == "0"));
    }
}
