//! Opens a directory component by component, so that no other user can put another directory in its place.

use std::ffi::{OsStr, OsString};
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStringExt;
use std::path::{Component, Path, PathBuf};

use rustix::fs::{AtFlags, CWD, FileType, Mode, OFlags, fstat, mkdirat, openat, readlinkat, statat};
use rustix::io::Errno;

/// A directory that was reached by its path.
pub struct PathWalk {
    /// The user who has to own directories and may make links.
    user: u32,
    policy: LinkPolicy,
    /// The last component that was opened.
    at: OwnedFd,
    path: PathBuf,
    /// Number of links that were followed.
    links: usize,
}

/// Which links on the way are followed. Links of root and of this user always are, in directories that no other user can write
/// to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkPolicy {
    /// No others.
    Own,
    /// All but those of other users in a sticky directory, such as /tmp.
    NotPlanted,
}

/// Reason for not opening a directory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WalkError {
    /// The system refuses it.
    System(PathBuf, Errno),
    /// Another user may have put something at this path. The text continues a sentence that begins with the path.
    Planted(PathBuf, String),
    /// Owner and mode of a directory that belongs to another user.
    Foreign(PathBuf, u32, u32),
    /// Mode of a directory that other users can write to.
    Writable(PathBuf, u32),
}

impl PathWalk {
    /// Starts at the root of the file system if `path` is absolute, otherwise at the working directory. `user` is the one
    /// who has to own directories.
    ///
    /// # Errors
    ///
    /// [`WalkError::System`] if that cannot be opened.
    pub fn begin(path: &Path, policy: LinkPolicy, user: u32) -> Result<PathWalk, WalkError> {
        let start = Path::new(if path.is_absolute() { "/" } else { "." });
        let at = openat(CWD, start, OPEN_DIRECTORY | OFlags::PATH, Mode::empty());
        let at = at.map_err(|error| WalkError::System(start.to_owned(), error))?;
        let path = if path.is_absolute() { start.to_owned() } else { PathBuf::new() };
        Ok(PathWalk { user, policy, at, path, links: 0 })
    }

    /// Opens the `components` in this order, and follows links as the policy permits. With `make`, a missing directory is
    /// created with these permissions, without those that the umask takes away. Returns `false` if one is missing.
    ///
    /// # Errors
    ///
    /// [`WalkError`] if a component cannot be opened or is not to be trusted.
    pub fn enter(&mut self, mut components: Vec<OsString>, make: Option<Mode>) -> Result<bool, WalkError> {
        components.reverse();
        while let Some(component) = components.pop() {
            match self.step(&component, make, OFlags::PATH)? {
                Step::Made => {}
                Step::Absent => return Ok(false),
                Step::NoDirectory => components.extend(self.follow(&component)?.into_iter().rev()),
            }
        }
        Ok(true)
    }

    /// Opens one component, which must be a directory of this user that no other user can write to.
    /// A link is not followed. `how` has flags for opening it.
    ///
    /// # Errors
    ///
    /// Those of [`enter`](Self::enter), [`WalkError::Foreign`] and [`WalkError::Writable`].
    pub fn enter_own(
        &mut self,
        component: &OsStr,
        make: Option<Mode>,
        how: OFlags,
    ) -> Result<bool, WalkError> {
        match self.step(component, make, how)? {
            Step::Made => {}
            Step::Absent => return Ok(false),
            Step::NoDirectory => {
                let stat = statat(&self.at, component, AtFlags::SYMLINK_NOFOLLOW)
                    .map_err(|error| self.system(error))?;
                let is_link = FileType::from_raw_mode(stat.st_mode) == FileType::Symlink;
                let kind = if is_link { "a link" } else { "no directory, but a file" };
                let what = format!("is {kind} of user {}", named(stat.st_uid));
                return Err(WalkError::Planted(self.path.join(component), what));
            }
        }
        let stat = fstat(&self.at).map_err(|error| self.system(error))?;
        if stat.st_uid != self.user {
            return Err(WalkError::Foreign(self.path.clone(), stat.st_uid, stat.st_mode));
        }
        if stat.st_mode & OTHERS_WRITE != 0 {
            return Err(WalkError::Writable(self.path.clone(), stat.st_mode));
        }
        Ok(true)
    }

    /// Returns the directory that was reached, and its path.
    pub fn into_parts(self) -> (OwnedFd, PathBuf) {
        (self.at, self.path)
    }

    fn step(&mut self, name: &OsStr, make: Option<Mode>, how: OFlags) -> Result<Step, WalkError> {
        let open = |at: &OwnedFd| openat(at, name, OPEN_DIRECTORY | how, Mode::empty());
        let mut opened = open(&self.at);
        if let (Err(Errno::NOENT), Some(mode)) = (&opened, make) {
            match mkdirat(&self.at, name, mode) {
                Ok(()) | Err(Errno::EXIST) => opened = open(&self.at),
                Err(error) => return Err(WalkError::System(self.path.join(name), error)),
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
            // A directory without read permission still has a visible owner.
            Err(Errno::ACCESS) => {
                let component = statat(&self.at, name, AtFlags::SYMLINK_NOFOLLOW);
                let component = component.map(|stat| (self.path.join(name), stat));
                let seen = component.or_else(|_| fstat(&self.at).map(|stat| (self.path.clone(), stat)));
                let (path, stat) = seen.map_err(|error| self.system(error))?;
                Err(WalkError::Foreign(path, stat.st_uid, stat.st_mode))
            }
            Err(error) => Err(WalkError::System(self.path.join(name), error)),
        }
    }

    /// Returns the components that the link `name` stands for.
    fn follow(&mut self, name: &OsStr) -> Result<Vec<OsString>, WalkError> {
        let path = self.path.join(name);
        let broken = |error| WalkError::System(path.clone(), error);
        let Ok(target) = readlinkat(&self.at, name, Vec::new()) else { return Err(broken(Errno::NOTDIR)) };
        let owner = statat(&self.at, name, AtFlags::SYMLINK_NOFOLLOW).map_err(broken)?.st_uid;
        let mode = fstat(&self.at).map_err(broken)?.st_mode;
        let is_trusted = owner == 0 || owner == self.user;
        let is_followed = match self.policy {
            LinkPolicy::Own => is_trusted && mode & OTHERS_WRITE == 0,
            LinkPolicy::NotPlanted => is_trusted || mode & STICKY == 0,
        };
        if !is_followed {
            let mode = mode & 0o7777;
            let what = format!("is a link of user {} in a directory of mode {mode:04o}", named(owner));
            return Err(WalkError::Planted(path, what));
        }
        self.links += 1;
        if self.links > MAX_LINKS {
            return Err(broken(Errno::LOOP));
        }
        let target = PathBuf::from(OsString::from_vec(target.into_bytes()));
        if target.is_absolute() {
            self.at = openat(&self.at, "/", OPEN_DIRECTORY | OFlags::PATH, Mode::empty()).map_err(broken)?;
            self.path = PathBuf::from("/");
        }
        Ok(components_of(&target))
    }

    fn system(&self, error: Errno) -> WalkError {
        WalkError::System(self.path.clone(), error)
    }
}

/// Result of opening a component.
enum Step {
    Made,
    Absent,
    /// A link, or something else that is not entered.
    NoDirectory,
}

/// Returns the components of `path` without its root.
pub fn components_of(path: &Path) -> Vec<OsString> {
    path.components()
        .filter_map(|component| match component {
            Component::Normal(name) => Some(name.to_owned()),
            Component::ParentDir => Some("..".into()),
            Component::RootDir | Component::CurDir | Component::Prefix(_) => None,
        })
        .collect()
}

/// Returns the number of `user`, and the name if it has one.
pub fn named(user: u32) -> String {
    let known = nix::unistd::User::from_uid(user.into()).ok().flatten();
    known.map_or_else(|| user.to_string(), |known| format!("{user} ({})", known.name))
}

/// Returns the user of this process.
pub fn user() -> u32 {
    rustix::process::geteuid().as_raw()
}

const OPEN_DIRECTORY: OFlags = OFlags::DIRECTORY.union(OFlags::NOFOLLOW).union(OFlags::CLOEXEC);
/// Group and others may write.
const OTHERS_WRITE: u32 = 0o022;
/// Only owners may rename and remove what is in the directory (inode(7)).
pub const STICKY: u32 = 0o1000;
/// As many links as the kernel follows (path_resolution(7)).
const MAX_LINKS: usize = 40;
