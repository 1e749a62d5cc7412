//! Removal of files that dead processes of a domain left. Files in shared memory that did not belong to a known dead
//! process are not touched.

use std::fs::OpenOptions;
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Duration;

use nix::libc::{self, c_int};
use rustix::fs::{FileType, OFlags};
use scanhub_schema::Failure;

use crate::directory::Directory;
use crate::domain::Domain;
use crate::lock::{HubLock, ListenLock};
use crate::node::{hub_node, nodes};
use crate::segments::forget;

/// Result of a cleanup.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cleaned {
    /// Processes that had ended without cleaning up.
    pub dead: usize,
    /// Processes that still run. Nothing that belongs to them was removed.
    pub alive: usize,
    /// Whether the domain's directory was removed.
    pub root: bool,
}

/// Removes files that dead processes left in `domain`. Everything that a running process uses stays, and so does the
/// directory while any process runs.
///
/// # Errors
///
/// Returns [`Kind::DomainHeld`](scanhub_schema::Kind) if a hub or a listener publishes there, because it cleans up by itself.
/// Returns [`Kind::Failed`](scanhub_schema::Kind) if the directory belongs to another user.
pub fn clean(domain: &Domain) -> Result<Cleaned, Failure> {
    let root = domain.root();
    let Some(directory) = Directory::open(root)? else { return Ok(Cleaned::default()) };
    // No process can start to publish while these locks are held.
    let _hub = HubLock::acquire(root)?;
    let _listener = ListenLock::acquire(root)?;
    let before = nodes(domain)?;
    let node = hub_node(domain)?;
    node.blocking_cleanup_dead_nodes(CLEANUP_TIMEOUT);
    drop(node);
    let after = nodes(domain)?;
    let root = after.alive == 0 && after.dead == 0 && remove_domain(&directory, root);
    Ok(Cleaned { dead: before.dead.saturating_sub(after.dead), alive: after.alive, root })
}

/// Removes the domain's `directory` at `root` with everything that only running processes need: empty directories,
/// locks, names, and the saved state of sensors. Returns whether the directory was removed. It stays if it contains
/// anything else.
fn remove_domain(directory: &Directory, root: &Path) -> bool {
    forget(directory, root);
    for (name, stat) in directory.entries() {
        let extension = Path::new(&name).extension();
        match FileType::from_raw_mode(stat.st_mode) {
            FileType::Directory => directory.remove_empty(&name),
            FileType::RegularFile if extension.is_some_and(|kind| kind == "lock" || kind == "sensor") => {
                directory.remove(&name);
            }
            _ => {}
        }
    }
    directory.remove_itself()
}

/// Maximum wait for another process that is cleaning up after the same dead process.
const CLEANUP_TIMEOUT: Duration = Duration::from_secs(1);

/// Returns whether no process has the file at `path` open or mapped. Only then does the kernel grant a lease for
/// writing (fcntl(2)). Only the kernel knows this: processes that this one cannot see, or in a container that shares
/// the memory, count too.
///
/// Returns false if the answer is unknown, for example for a file of another user. A process that opens the file during
/// this call waits until the call returns.
#[allow(unsafe_code)]
pub fn is_unheld(path: &Path) -> bool {
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let opened = OpenOptions::new().read(true).custom_flags(flags.bits() as i32).open(path);
    let Ok(file) = opened else { return false };
    let control = |command: c_int, argument: c_int| {
        // SAFETY: these commands take a number and touch no memory of this process, and the descriptor is open.
        unsafe { libc::fcntl(file.as_raw_fd(), command, argument) == 0 }
    };
    // The default signal to the holder of a lease that another process waits for would end this process.
    control(F_SETSIG, libc::SIGURG)
        && control(libc::F_SETLEASE, libc::F_WRLCK)
        && control(libc::F_SETLEASE, libc::F_UNLCK)
}

/// asm-generic/fcntl.h.
const F_SETSIG: c_int = 10;

#[cfg(test)]
mod tests {
    use std::fs::{self, File};
    use std::os::unix::fs::symlink;

    use memmap2::MmapOptions;

    use super::*;

    #[test]
    fn what_is_not_a_domains_stays() {
        let base = tempfile::tempdir().unwrap();
        let root = base.path().join("a");
        let directory = Directory::make(&root).unwrap();
        fs::create_dir(root.join("nodes")).unwrap();
        symlink(root.join("full"), root.join("link.lock")).unwrap();
        fs::create_dir(root.join("full")).unwrap();
        for file in ["hub.lock", "front.sensor", "prefix", "full/something.lock", "letter"] {
            fs::write(root.join(file), "").unwrap();
        }
        assert!(!remove_domain(&directory, &root));
        let mut left: Vec<_> = fs::read_dir(&root).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["full", "letter", "link.lock"]);
        assert!(root.join("full/something.lock").exists());
        for file in ["link.lock", "letter", "full/something.lock"] {
            fs::remove_file(root.join(file)).unwrap();
        }
        assert!(remove_domain(&directory, &root) && !root.exists());
        assert!(remove_domain(&directory, &root), "it is gone already");
    }

    #[test]
    fn whoever_has_it_open_or_mapped_holds_it() {
        let path = Path::new(crate::shortage::SHARED_MEMORY).join(format!("shu{}", std::process::id()));
        assert!(!is_unheld(&path), "it is not there");
        let made = File::create_new(&path).unwrap();
        made.set_len(4096).unwrap();
        let is_unheld = || is_unheld(&path);
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
        // A system without leases does not know.
        assert_eq!(free, free_again);
        assert!(free || fs::read_to_string("/proc/sys/fs/leases-enable").is_ok_and(|it| it.trim() == "0"));
    }
}
