//! A private directory, such as that of a domain. It is opened component by component from the root of the file system, and
//! every file in it relative to the open directory. No other user can put another directory in its place.
//!
//! The last components (base and domain) must belong to this user and be writable by no other user, and a link is never
//! followed there. Above them, a link is followed if root or this user made it in a directory that no other user can write to:
//! `/home` or `/var/run` may be links. The owners of the directories above the base are not checked.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::{self, Write};
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, Dir, FileType, Mode, OFlags, Stat, fstat, openat, renameat, statat, unlinkat};
use rustix::io::Errno;

use scanhub_files::path_walk::{LinkPolicy, PathWalk, STICKY, WalkError, components_of, named, user};
use scanhub_schema::{Failure, Kind};

use crate::shortage;

/// An open directory that this user owns and nobody else can write to.
#[derive(Debug)]
pub struct Directory {
    fd: OwnedFd,
    path: PathBuf,
    purpose: Purpose,
}

/// Purpose of a directory, which decides about remedies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Purpose {
    /// The files of a domain.
    Domain,
    /// Files that programs keep across restarts.
    State,
}

impl Directory {
    /// Returns the directory `root` of a domain, or nothing if there is none.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] with the path, its owner and the remedy if base or domain is another user's, can be written to
    /// by others, or is reached by a link that another user could have made; [`Kind::Short`] if descriptors are.
    pub fn open(root: &Path) -> Result<Option<Directory>, Failure> {
        Directory::walk(root, 2, Purpose::Domain, user(), false)
    }

    /// Opens it as [`open`](Self::open) does; what is missing is made for this user alone.
    ///
    /// # Errors
    ///
    /// As [`open`](Self::open), and [`Kind::Failed`] if it cannot be created.
    pub fn make(root: &Path) -> Result<Directory, Failure> {
        let made = Directory::walk(root, 2, Purpose::Domain, user(), true)?;
        made.ok_or_else(|| Purpose::Domain.unusable(root, Errno::NOENT))
    }

    /// Opens `path`, where programs keep files across restarts, as [`open`](Self::open) does. This user must own the last
    /// `own` components.
    ///
    /// # Errors
    ///
    /// Those of [`open`](Self::open).
    pub fn open_state(path: &Path, own: usize) -> Result<Option<Directory>, Failure> {
        Directory::walk(path, own, Purpose::State, user(), false)
    }

    /// Opens it as [`open_state`](Self::open_state) does. Missing directories are created for this user alone.
    ///
    /// # Errors
    ///
    /// Those of [`make`](Self::make).
    pub fn make_state(path: &Path, own: usize) -> Result<Directory, Failure> {
        let made = Directory::walk(path, own, Purpose::State, user(), true)?;
        made.ok_or_else(|| Purpose::State.unusable(path, Errno::NOENT))
    }

    /// Returns the file `name`, or nothing if there is none.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if it is a link, no regular file or another user's; it is not opened then.
    pub fn file(&self, name: &str) -> Result<Option<File>, Failure> {
        match self.open_file(name, OFlags::RDONLY) {
            Err(Errno::NOENT) => Ok(None),
            opened => self.checked(name, opened).map(Some),
        }
    }

    /// Returns the file `name` to read and write, made with mode 0600 if there is none.
    ///
    /// # Errors
    ///
    /// As [`file`](Self::file), and if it cannot be created.
    pub fn file_or_new(&self, name: &str) -> Result<File, Failure> {
        let opened = self.open_file(name, OFlags::RDWR | OFlags::CREATE);
        self.checked(name, opened)
    }

    /// Replaces the file `name` by `content` in one step: a reader or a crash finds the old or the new one. Waits for the
    /// disk.
    ///
    /// # Errors
    ///
    /// As [`file_or_new`](Self::file_or_new), and if it cannot be written.
    pub(crate) fn replace(&self, name: &str, content: &[u8]) -> Result<(), Failure> {
        let beside = format!("{name}.new");
        // A crash may have left one.
        self.remove(OsStr::new(&beside));
        let opened = self.open_file(&beside, OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL);
        let mut file = self.checked(&beside, opened)?;
        let written = file.write_all(content).and_then(|()| file.sync_data());
        let renamed = written.and_then(|()| Ok(renameat(&self.fd, &beside, &self.fd, name)?));
        renamed.map_err(|error| {
            self.remove(OsStr::new(&beside));
            self.purpose.unusable(&self.path.join(name), error)
        })
    }

    /// Removes the file `name`; does nothing if it does not exist or cannot be removed.
    pub(crate) fn remove(&self, name: &OsStr) {
        let _ = self.try_remove(name);
    }

    /// Removes the file `name`, if it exists.
    ///
    /// # Errors
    ///
    /// The system's error if it stays.
    pub(crate) fn try_remove(&self, name: &OsStr) -> io::Result<()> {
        match unlinkat(&self.fd, name, AtFlags::empty()) {
            Ok(()) | Err(Errno::NOENT) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes the directory `name` if it is empty.
    pub(crate) fn remove_empty(&self, name: &OsStr) {
        let _ = unlinkat(&self.fd, name, AtFlags::REMOVEDIR);
    }

    /// Its entries: names and types, links as links.
    pub(crate) fn entries(&self) -> Vec<(OsString, Stat)> {
        let Ok(entries) = Dir::read_from(&self.fd) else { return Vec::new() };
        let names = entries.filter_map(|entry| {
            let name = OsStr::from_bytes(entry.ok()?.file_name().to_bytes()).to_owned();
            (name != "." && name != "..").then_some(name)
        });
        names
            .filter_map(|name| Some((statat(&self.fd, &name, AtFlags::SYMLINK_NOFOLLOW).ok()?, name)))
            .map(|(stat, name)| (name, stat))
            .collect()
    }

    /// The directory `name` in it, unless that is a link or another user's.
    pub(crate) fn below(&self, name: &str) -> Option<Directory> {
        let how = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC | OFlags::RDONLY;
        let fd = openat(&self.fd, name, how, Mode::empty()).ok()?;
        let is_own = fstat(&fd).is_ok_and(|stat| stat.st_uid == user());
        is_own.then(|| Directory { fd, path: self.path.join(name), purpose: self.purpose })
    }

    /// Removes it, if it is empty and still at its place; returns whether it is gone.
    pub(crate) fn remove_itself(&self) -> bool {
        let there = self.path.symlink_metadata().map(|it| (it.dev(), it.ino()));
        let is_here =
            fstat(&self.fd).is_ok_and(|stat| there.is_ok_and(|there| there == (stat.st_dev, stat.st_ino)));
        if is_here {
            let _ = unlinkat(rustix::fs::CWD, &self.path, AtFlags::REMOVEDIR);
        }
        fstat(&self.fd).is_ok_and(|stat| stat.st_nlink == 0)
    }

    fn open_file(&self, name: &str, how: OFlags) -> Result<OwnedFd, Errno> {
        let mode = Mode::RUSR | Mode::WUSR;
        openat(&self.fd, name, how | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC, mode)
    }

    fn checked(&self, name: &str, opened: Result<OwnedFd, Errno>) -> Result<File, Failure> {
        let path = self.path.join(name);
        let fd = opened.map_err(|error| match error {
            Errno::LOOP => self.purpose.planted(&path, "is a link"),
            error => self.purpose.unusable(&path, error),
        })?;
        let stat = fstat(&fd).map_err(|error| self.purpose.unusable(&path, error))?;
        if FileType::from_raw_mode(stat.st_mode) != FileType::RegularFile {
            return Err(self.purpose.planted(&path, "is no regular file"));
        }
        if stat.st_uid != user() {
            let what = format!("belongs to user {}", named(stat.st_uid));
            return Err(self.purpose.planted(&path, &what));
        }
        Ok(File::from(fd))
    }

    /// Opens `path`. `user` must own its last `own` components.
    fn walk(
        path: &Path,
        own: usize,
        purpose: Purpose,
        user: u32,
        make: bool,
    ) -> Result<Option<Directory>, Failure> {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let mut components = components_of(&path);
        if components.len() < own {
            return Err(purpose.unusable(&path, Errno::INVAL));
        }
        let owned = components.split_off(components.len() - own);
        let make = make.then_some(Mode::RWXU);
        let reached = PathWalk::begin(&path, LinkPolicy::Own, user).and_then(|mut walk| {
            if !walk.enter(components, make)? {
                return Ok(None);
            }
            for (number, component) in owned.iter().enumerate() {
                // The domain's own directory is read, the others are only passed.
                let how = if number + 1 == own { OFlags::RDONLY } else { OFlags::PATH };
                if !walk.enter_own(component, make, how)? {
                    return Ok(None);
                }
            }
            Ok(Some(walk.into_parts()))
        });
        let reached = reached.map_err(|error| purpose.failure(error, user))?;
        Ok(reached.map(|(fd, path)| Directory { fd, path, purpose }))
    }
}

impl Purpose {
    /// Returns what to tell `user` of `error`.
    fn failure(self, error: WalkError, user: u32) -> Failure {
        match error {
            WalkError::System(path, error) => self.unusable(&path, error),
            WalkError::Planted(path, what) => self.planted(&path, &what),
            WalkError::Foreign(path, owner, mode) => {
                let (path, owner, user) = (path.display(), named(owner), named(user));
                let mode = mode & 0o7777;
                let what =
                    format!("{path} belongs to user {owner} with mode {mode:04o}, this is user {user}");
                let hint = match self {
                    Purpose::Domain => format!(
                        "shared memory is for one user: run as user {owner}, or choose another --root; for data of a \
                         hub of user {owner}: `scanhub gateway --interface lo` as that user, `scanhub listen --publish \
                         --interface lo` as this one"
                    ),
                    Purpose::State => format!("run as user {owner}, with sudo without -E, or {SET_STATE}"),
                };
                Failure::new(Kind::Failed, what, hint)
            }
            WalkError::Writable(path, mode) => {
                let (path, mode) = (path.display(), mode & 0o7777);
                let hint = match self {
                    // A directory for all users, such as /tmp, keeps its mode.
                    Purpose::Domain if mode & STICKY != 0 => {
                        format!("choose your own directory, for example --root {path}/NAME")
                    }
                    Purpose::State if mode & STICKY != 0 => SET_STATE.to_owned(),
                    _ => format!("chmod go-w {path}, or {}", self.other()),
                };
                let what = format!("{path} has mode {mode:04o}: others can put files there");
                Failure::new(Kind::Failed, what, hint)
            }
        }
    }

    /// Returns the failure of a `path` that another user may have put there.
    fn planted(self, path: &Path, what: &str) -> Failure {
        let path = path.display();
        Failure::new(
            Kind::Failed,
            format!("{path} {what}: scanhub opens nothing in it"),
            format!("look at it with `ls -ld {path}` and remove it, or {}", self.other()),
        )
    }

    fn unusable(self, path: &Path, error: impl Into<io::Error>) -> Failure {
        let error = error.into();
        shortage::found(path).unwrap_or_else(|| {
            Failure::new(Kind::Failed, format!("{}: {error}", path.display()), self.other())
        })
    }

    /// Returns how to use another directory.
    fn other(self) -> &'static str {
        match self {
            Purpose::Domain => "choose another --root",
            Purpose::State => SET_STATE,
        }
    }
}

const SET_STATE: &str = "set STATE_DIRECTORY or XDG_STATE_HOME to a directory of this user";

#[cfg(test)]
mod tests;
