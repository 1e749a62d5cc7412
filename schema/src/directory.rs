//! The directory of a domain, opened so that no other user can put another one in its place: step by step from the root
//! of the file system, then every file relative to the open directory. Refuses to know what the files are for.
//!
//! The last two steps, base and domain, must belong to this user and be writable by nobody else; a link is never
//! followed there. Above them a link is followed if root or this user made it where nobody else can make one: `/home` or
//! `/var/run` may be links. The owners of the directories above the base are not checked.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::os::unix::fs::MetadataExt;
use std::path::{Component, Path, PathBuf};

use rustix::fs::{
    AtFlags, Dir, FileType, Mode, OFlags, Stat, fstat, mkdirat, openat, readlinkat, renameat, statat,
    unlinkat,
};
use rustix::io::Errno;

use crate::{Failure, Kind, shortage};

/// An open directory that this user owns and nobody else can write to.
#[derive(Debug)]
pub struct Directory {
    fd: OwnedFd,
    path: PathBuf,
}

impl Directory {
    /// Returns the directory `root` of a domain, or nothing if there is none.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] with the path, its owner and the remedy if base or domain is another user's, can be written to
    /// by others, or is reached by a link that another user could have made; [`Kind::Short`] if descriptors are.
    pub fn open(root: &Path) -> Result<Option<Directory>, Failure> {
        Walk::to(root, user(), false)
    }

    /// Opens it as [`open`](Self::open) does; what is missing is made for this user alone.
    ///
    /// # Errors
    ///
    /// As [`open`](Self::open), and [`Kind::Failed`] if it cannot be created.
    pub fn make(root: &Path) -> Result<Directory, Failure> {
        let made = Walk::to(root, user(), true)?;
        made.ok_or_else(|| unusable(root, Errno::NOENT))
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

    /// Replaces the file `name` by `content` in one step: a reader sees the old or the new one.
    ///
    /// # Errors
    ///
    /// As [`file_or_new`](Self::file_or_new), and if it cannot be written.
    pub(crate) fn replace(&self, name: &str, content: &[u8]) -> Result<(), Failure> {
        let beside = format!("{name}.new");
        let file = self.file_or_new(&beside)?;
        let written =
            file.set_len(0).and_then(|()| std::os::unix::fs::FileExt::write_all_at(&file, content, 0));
        written.map_err(|error| unusable(&self.path.join(&beside), error))?;
        renameat(&self.fd, &beside, &self.fd, name).map_err(|error| unusable(&self.path.join(name), error))
    }

    /// Removes the file `name`; does nothing if it does not exist or cannot be removed.
    pub(crate) fn remove(&self, name: &OsStr) {
        let _ = unlinkat(&self.fd, name, AtFlags::empty());
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
        let fd = openat(&self.fd, name, OPEN_DIRECTORY | OFlags::RDONLY, Mode::empty()).ok()?;
        let is_own = fstat(&fd).is_ok_and(|stat| stat.st_uid == user());
        is_own.then(|| Directory { fd, path: self.path.join(name) })
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
            Errno::LOOP => planted(&path, "is a link"),
            error => unusable(&path, error),
        })?;
        let stat = fstat(&fd).map_err(|error| unusable(&path, error))?;
        if FileType::from_raw_mode(stat.st_mode) != FileType::RegularFile {
            return Err(planted(&path, "is no regular file"));
        }
        if stat.st_uid != user() {
            return Err(planted(&path, &format!("belongs to user {}", named(stat.st_uid))));
        }
        Ok(File::from(fd))
    }
}

/// The way to a directory.
struct Walk {
    user: u32,
    /// The last step that was made.
    at: OwnedFd,
    path: PathBuf,
    links: usize,
}

impl Walk {
    fn to(root: &Path, user: u32, make: bool) -> Result<Option<Directory>, Failure> {
        let root = std::path::absolute(root).unwrap_or_else(|_| root.to_owned());
        let mut steps = steps_of(&root);
        let (base, domain) = match (steps.pop(), steps.pop()) {
            (Some(domain), Some(base)) => (base, domain),
            _ => return Err(unusable(&root, Errno::INVAL)),
        };
        let slash = openat(rustix::fs::CWD, "/", OPEN_DIRECTORY | OFlags::PATH, Mode::empty());
        let at = slash.map_err(|error| unusable(Path::new("/"), error))?;
        let mut walk = Walk { user, at, path: PathBuf::from("/"), links: 0 };
        // The next step is the last of them.
        steps.reverse();
        while let Some(step) = steps.pop() {
            match walk.step(&step, make, OFlags::PATH)? {
                Step::Made => {}
                Step::Absent => return Ok(None),
                Step::NoDirectory => steps.extend(walk.follow(&step)?.into_iter().rev()),
            }
        }
        for (step, how) in [(base, OFlags::PATH), (domain, OFlags::RDONLY)] {
            match walk.step(&step, make, how)? {
                Step::Made => walk.check_own()?,
                Step::Absent => return Ok(None),
                Step::NoDirectory => {
                    let path = walk.path.join(step);
                    return Err(planted(&path, "is a link, or no directory"));
                }
            }
        }
        Ok(Some(Directory { fd: walk.at, path: walk.path }))
    }

    fn step(&mut self, name: &OsStr, make: bool, how: OFlags) -> Result<Step, Failure> {
        let open = |at: &OwnedFd| openat(at, name, OPEN_DIRECTORY | how, Mode::empty());
        let mut opened = open(&self.at);
        if matches!(opened, Err(Errno::NOENT)) && make {
            match mkdirat(&self.at, name, Mode::RWXU) {
                Ok(()) | Err(Errno::EXIST) => opened = open(&self.at),
                Err(error) => return Err(unusable(&self.path.join(name), error)),
            }
        }
        match opened {
            Ok(fd) => {
                self.at = fd;
                self.path.push(name);
                Ok(Step::Made)
            }
            Err(Errno::NOENT) => Ok(Step::Absent),
            Err(Errno::NOTDIR | Errno::LOOP) => Ok(Step::NoDirectory),
            // The domain's own directory can be seen where it cannot be read.
            Err(Errno::ACCESS) => {
                let seen = statat(&self.at, name, AtFlags::SYMLINK_NOFOLLOW)
                    .map(|stat| (self.path.join(name), stat));
                let (path, stat) =
                    match seen.or_else(|_| fstat(&self.at).map(|stat| (self.path.clone(), stat))) {
                        Ok(seen) => seen,
                        Err(error) => return Err(unusable(&self.path, error)),
                    };
                Err(foreign(&path, stat.st_uid, stat.st_mode, self.user))
            }
            Err(error) => Err(unusable(&self.path.join(name), error)),
        }
    }

    /// The steps that the link `name` stands for, if it can be trusted.
    fn follow(&mut self, name: &OsStr) -> Result<Vec<OsString>, Failure> {
        let path = self.path.join(name);
        let broken = |error| unusable(&path, error);
        let Ok(target) = readlinkat(&self.at, name, Vec::new()) else { return Err(broken(Errno::NOTDIR)) };
        let owner = statat(&self.at, name, AtFlags::SYMLINK_NOFOLLOW).map_err(broken)?.st_uid;
        let place = fstat(&self.at).map_err(broken)?;
        if (owner != 0 && owner != self.user) || place.st_mode & OTHERS_WRITE != 0 {
            let what = format!(
                "is a link of user {} in a directory of mode {:04o}",
                named(owner),
                place.st_mode & 0o7777
            );
            return Err(planted(&path, &what));
        }
        self.links += 1;
        if self.links > LINKS {
            return Err(broken(Errno::LOOP));
        }
        let target = PathBuf::from(OsString::from_vec(target.into_bytes()));
        if target.is_absolute() {
            self.at = openat(&self.at, "/", OPEN_DIRECTORY | OFlags::PATH, Mode::empty()).map_err(broken)?;
            self.path = PathBuf::from("/");
        }
        Ok(steps_of(&target))
    }

    /// What was reached is this user's, and nobody else's to write to.
    fn check_own(&self) -> Result<(), Failure> {
        let stat = fstat(&self.at).map_err(|error| unusable(&self.path, error))?;
        if stat.st_uid != self.user {
            return Err(foreign(&self.path, stat.st_uid, stat.st_mode, self.user));
        }
        if stat.st_mode & OTHERS_WRITE != 0 {
            let (path, mode) = (self.path.display(), stat.st_mode & 0o7777);
            // One that all are to write to, as /tmp, stays so.
            let hint = if mode & STICKY != 0 {
                format!("choose your own directory, for example --root {path}/NAME")
            } else {
                format!("chmod go-w {path}, or choose another --root")
            };
            let what = format!("{path} has mode {mode:04o}: others can put files there");
            return Err(Failure::new(Kind::Failed, what, hint));
        }
        Ok(())
    }
}

/// What came of a step.
enum Step {
    Made,
    Absent,
    /// A link, or something else that is not entered.
    NoDirectory,
}

/// What to say of the directory `path` of user `owner` to user `user`.
fn foreign(path: &Path, owner: u32, mode: u32, user: u32) -> Failure {
    let (owner, user) = (named(owner), named(user));
    Failure::new(
        Kind::Failed,
        format!(
            "{} belongs to user {owner} with mode {:04o}, this is user {user}",
            path.display(),
            mode & 0o7777
        ),
        format!(
            "shared memory is for one user: run as user {owner}, or choose another --root; for data of a hub of user \
             {owner}: `scanhub gateway --interface lo` as that user, `scanhub listen --publish --interface lo` as this \
             one"
        ),
    )
}

/// What stands at `path` may have been put there by somebody else.
fn planted(path: &Path, what: &str) -> Failure {
    let path = path.display();
    Failure::new(
        Kind::Failed,
        format!("{path} {what}: scanhub opens nothing in it"),
        format!("look at it with `ls -ld {path}` and remove it, or choose another --root"),
    )
}

fn unusable(path: &Path, error: impl Into<std::io::Error>) -> Failure {
    let error = error.into();
    shortage::found(path).unwrap_or_else(|| {
        Failure::new(Kind::Failed, format!("{}: {error}", path.display()), "choose another place with --root")
    })
}

fn steps_of(path: &Path) -> Vec<OsString> {
    path.components()
        .filter_map(|component| match component {
            Component::Normal(name) => Some(name.to_owned()),
            Component::ParentDir => Some("..".into()),
            Component::RootDir | Component::CurDir | Component::Prefix(_) => None,
        })
        .collect()
}

/// The user's number, and the name if it has one.
pub(crate) fn named(user: u32) -> String {
    let known = nix::unistd::User::from_uid(user.into()).ok().flatten();
    known.map_or_else(|| user.to_string(), |known| format!("{user} ({})", known.name))
}

fn user() -> u32 {
    rustix::process::geteuid().as_raw()
}

const OPEN_DIRECTORY: OFlags = OFlags::DIRECTORY.union(OFlags::NOFOLLOW).union(OFlags::CLOEXEC);
/// Group and others may write.
const OTHERS_WRITE: u32 = 0o022;
/// Only owners may rename and remove what is in the directory (inode(7)).
const STICKY: u32 = 0o1000;
/// As many links as the kernel follows (path_resolution(7)).
const LINKS: usize = 40;

#[cfg(test)]
mod tests;
