//! Locks on files of a domain's directory. A lock ends with its process. The file has the ID of the process, because
//! the kernel does not report it.

use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::Path;

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, fcntl};
use nix::libc::{self, flock};
use scanhub_schema::{Failure, Kind};

use crate::directory::Directory;
use crate::shortage;

/// A lock on a file.
#[derive(Debug)]
pub(crate) struct FileLock {
    file: File,
}

impl FileLock {
    /// Takes the lock on the file `name` in `root`, and clears the file. Creates directory and file if they do not
    /// exist.
    ///
    /// # Errors
    ///
    /// Returns the failure `held` if another process has the lock. Its argument is the ID of that process, or 0 if the
    /// process has not written it yet. Returns [`Kind::Failed`] if the file cannot be locked.
    pub(crate) fn acquire(
        root: &Path,
        name: &str,
        held: impl Fn(u32) -> Failure,
    ) -> Result<FileLock, Failure> {
        let file = loop {
            let file = open(root, name)?;
            match fcntl(file.as_raw_fd(), FcntlArg::F_OFD_SETLK(&whole_file(libc::F_WRLCK))) {
                // The previous holder may have removed the domain, and the next one would lock another file.
                Ok(_) if file.metadata().is_ok_and(|metadata| metadata.nlink() == 0) => {}
                Ok(_) => break file,
                Err(Errno::EAGAIN | Errno::EACCES) => return Err(held(pid_in(&file))),
                Err(error) => return Err(unusable(root, &error.into())),
            }
        };
        file.set_len(0).map_err(|error| unusable(root, &error))?;
        Ok(FileLock { file })
    }

    /// Writes `lines` at the start of the file, which is in `root`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the file cannot be written.
    pub(crate) fn write(&self, root: &Path, lines: &str) -> Result<(), Failure> {
        self.file.write_all_at(lines.as_bytes(), 0).map_err(|error| unusable(root, &error))
    }
}

impl Drop for FileLock {
    /// Closing is not enough: a process that is just being started has a copy of the descriptor for a moment.
    fn drop(&mut self) {
        let _ = fcntl(self.file.as_raw_fd(), FcntlArg::F_OFD_SETLK(&whole_file(libc::F_UNLCK)));
    }
}

/// Lock of a process that creates services in a domain, or removes unfinished ones.
pub(crate) struct MakingLock {
    _lock: FileLock,
}

impl MakingLock {
    /// Waits for the lock. A process holds it only while it creates one service.
    pub(crate) fn wait(root: &Path) -> Result<MakingLock, Failure> {
        let file = open(root, MAKING)?;
        loop {
            match fcntl(file.as_raw_fd(), FcntlArg::F_OFD_SETLKW(&whole_file(libc::F_WRLCK))) {
                Ok(_) => return Ok(MakingLock { _lock: FileLock { file } }),
                Err(Errno::EINTR) => {}
                Err(error) => return Err(unusable(root, &error.into())),
            }
        }
    }
}

/// Returns the file of the lock `name` and its directory if a process holds the lock.
///
/// # Errors
///
/// Returns the errors of [`Directory::open`] and [`Directory::file`].
pub(crate) fn held_file(root: &Path, name: &str) -> Result<Option<(Directory, File)>, Failure> {
    let Some(directory) = Directory::open(root)? else { return Ok(None) };
    let Some(file) = directory.file(name)? else { return Ok(None) };
    let mut lock = whole_file(libc::F_RDLCK);
    fcntl(file.as_raw_fd(), FcntlArg::F_OFD_GETLK(&mut lock))
        .map_err(|error| unusable(root, &error.into()))?;
    Ok((lock.l_type != libc::F_UNLCK as libc::c_short).then_some((directory, file)))
}

/// Returns the process ID in the file of a lock; 0 if it has none.
pub(crate) fn pid_in(file: &File) -> u32 {
    content(file).lines().next().and_then(|pid| pid.parse().ok()).unwrap_or_default()
}

/// Returns the text in the file of a lock.
pub(crate) fn content(file: &File) -> String {
    let mut bytes = [0; 32];
    let length = file.read_at(&mut bytes, 0).unwrap_or_default();
    String::from_utf8_lossy(&bytes[..length]).into_owned()
}

fn open(root: &Path, name: &str) -> Result<File, Failure> {
    Directory::make(root)?.file_or_new(name)
}

/// Returns a lock of the whole file. `l_pid` must be 0 for open file descriptions.
fn whole_file(kind: libc::c_int) -> flock {
    flock {
        l_type: kind as libc::c_short,
        l_whence: libc::SEEK_SET as libc::c_short,
        l_start: 0,
        l_len: 0,
        l_pid: 0,
    }
}

fn unusable(root: &Path, error: &io::Error) -> Failure {
    shortage::found(root).unwrap_or_else(|| {
        Failure::new(Kind::Failed, format!("{}: {error}", root.display()), "choose another place with --root")
    })
}

const MAKING: &str = "making.lock";
