//! Walk to a directory. The walk opens the path component by component, so that no other user can substitute another
//! directory.

use std::ffi::{OsStr, OsString};
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStringExt;
use std::path::{Component, Path, PathBuf};

use rustix::fs::{AtFlags, CWD, FileType, Mode, OFlags, fstat, mkdirat, openat, readlinkat, statat};
use rustix::io::Errno;

/// An open directory, and the path by which it was reached.
pub struct PathWalk {
    /// User who must own the directories that `enter_own` opens. Links of this user are trusted.
    user: u32,
    policy: LinkPolicy,
    /// Last component that was opened.
    directory: OwnedFd,
    path: PathBuf,
    /// Number of links that were followed.
    links: usize,
}

/// Policy for links among the components of a path. Links of root and of this user are always followed if they are in
/// directories that no other user can write to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkPolicy {
    /// No other links are followed.
    Own,
    /// All other links are followed, except links of other users in a sticky directory such as /tmp.
    AllButSticky,
}

/// Reason why a directory was not opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WalkError {
    /// The system's error for this path.
    System(PathBuf, Errno),
    /// Another user may have put this path there. The text is the rest of a sentence that begins with the path.
    Untrusted(PathBuf, String),
    /// The directory belongs to another user. The values are its path, its owner and its mode.
    Foreign(PathBuf, u32, u32),
    /// Other users can write to the directory. The values are its path and its mode.
    Writable(PathBuf, u32),
}

impl PathWalk {
    /// Starts at the root of the file system if `path` is absolute, otherwise at the working directory. `user` must own
    /// the directories of [`enter_own`](Self::enter_own).
    ///
    /// # Errors
    ///
    /// Returns [`WalkError::System`] if this directory cannot be opened.
    pub fn begin(path: &Path, policy: LinkPolicy, user: u32) -> Result<PathWalk, WalkError> {
        let start = Path::new(if path.is_absolute() { "/" } else { "." });
        let directory = openat(CWD, start, OPEN_DIRECTORY | OFlags::PATH, Mode::empty());
        let at = directory.map_err(|error| WalkError::System(start.to_owned(), error))?;
        let path = if path.is_absolute() { start.to_owned() } else { PathBuf::new() };
        Ok(PathWalk { user, policy, directory: at, path, links: 0 })
    }

    /// Opens the `components` in this order, and follows links as the policy permits. With `create_mode`, a missing
    /// directory is created with these permissions, without those that the umask removes. Returns `false` if a
    /// component is missing.
    ///
    /// # Errors
    ///
    /// Returns [`WalkError`] if a component cannot be opened or is not trusted.
    pub fn enter(
        &mut self,
        mut components: Vec<OsString>,
        create_mode: Option<Mode>,
    ) -> Result<bool, WalkError> {
        components.reverse();
        while let Some(component) = components.pop() {
            match self.open_component(&component, create_mode, OFlags::PATH)? {
                ComponentResult::Entered => {}
                ComponentResult::Absent => return Ok(false),
                ComponentResult::NotDirectory => {
                    components.extend(self.read_link(&component)?.into_iter().rev())
                }
            }
        }
        Ok(true)
    }

    /// Opens one component, which must be a directory of this user that no other user can write to. A link is not
    /// followed. `flags` are additional flags for opening it.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`enter`](Self::enter), [`WalkError::Foreign`] and [`WalkError::Writable`].
    pub fn enter_own(
        &mut self,
        component: &OsStr,
        create_mode: Option<Mode>,
        flags: OFlags,
    ) -> Result<bool, WalkError> {
        match self.open_component(component, create_mode, flags)? {
            ComponentResult::Entered => {}
            ComponentResult::Absent => return Ok(false),
            ComponentResult::NotDirectory => {
                let stat = statat(&self.directory, component, AtFlags::SYMLINK_NOFOLLOW)
                    .map_err(|error| self.system(error))?;
                let is_link = FileType::from_raw_mode(stat.st_mode) == FileType::Symlink;
                let kind = if is_link { "a link" } else { "not a directory, but a file" };
                let what = format!("is {kind} of user {}", describe_user(stat.st_uid));
                return Err(WalkError::Untrusted(self.path.join(component), what));
            }
        }
        let stat = fstat(&self.directory).map_err(|error| self.system(error))?;
        if stat.st_uid != self.user {
            return Err(WalkError::Foreign(self.path.clone(), stat.st_uid, stat.st_mode));
        }
        if stat.st_mode & OTHERS_WRITE != 0 {
            return Err(WalkError::Writable(self.path.clone(), stat.st_mode));
        }
        Ok(true)
    }

    /// Returns the directory and its path.
    pub fn into_parts(self) -> (OwnedFd, PathBuf) {
        (self.directory, self.path)
    }

    fn open_component(
        &mut self,
        name: &OsStr,
        create_mode: Option<Mode>,
        flags: OFlags,
    ) -> Result<ComponentResult, WalkError> {
        let open = |at: &OwnedFd| openat(at, name, OPEN_DIRECTORY | flags, Mode::empty());
        let mut opened = open(&self.directory);
        if let (Err(Errno::NOENT), Some(mode)) = (&opened, create_mode) {
            match mkdirat(&self.directory, name, mode) {
                Ok(()) | Err(Errno::EXIST) => opened = open(&self.directory),
                Err(error) => return Err(WalkError::System(self.path.join(name), error)),
            }
        }
        match opened {
            Ok(fd) => {
                self.directory = fd;
                self.path.push(name);
                Ok(ComponentResult::Entered)
            }
            Err(Errno::NOENT) => Ok(ComponentResult::Absent),
            Err(Errno::NOTDIR | Errno::LOOP) => Ok(ComponentResult::NotDirectory),
            // The error states the owner. The owner of a directory can be read even if the directory cannot be opened.
            Err(Errno::ACCESS) => {
                let component = statat(&self.directory, name, AtFlags::SYMLINK_NOFOLLOW);
                let component = component.map(|stat| (self.path.join(name), stat));
                let found =
                    component.or_else(|_| fstat(&self.directory).map(|stat| (self.path.clone(), stat)));
                let (path, stat) = found.map_err(|error| self.system(error))?;
                Err(WalkError::Foreign(path, stat.st_uid, stat.st_mode))
            }
            Err(error) => Err(WalkError::System(self.path.join(name), error)),
        }
    }

    /// Returns the components of the target of the link `name`.
    fn read_link(&mut self, name: &OsStr) -> Result<Vec<OsString>, WalkError> {
        let path = self.path.join(name);
        let broken = |error| WalkError::System(path.clone(), error);
        let Ok(target) = readlinkat(&self.directory, name, Vec::new()) else {
            return Err(broken(Errno::NOTDIR));
        };
        let owner = statat(&self.directory, name, AtFlags::SYMLINK_NOFOLLOW).map_err(broken)?.st_uid;
        let mode = fstat(&self.directory).map_err(broken)?.st_mode;
        let is_trusted = owner == 0 || owner == self.user;
        let is_followed = match self.policy {
            LinkPolicy::Own => is_trusted && mode & OTHERS_WRITE == 0,
            LinkPolicy::AllButSticky => is_trusted || mode & STICKY == 0,
        };
        if !is_followed {
            let mode = mode & 0o7777;
            let what =
                format!("is a link of user {} in a directory of mode {mode:04o}", describe_user(owner));
            return Err(WalkError::Untrusted(path, what));
        }
        self.links += 1;
        if self.links > MAX_LINKS {
            return Err(broken(Errno::LOOP));
        }
        let target = PathBuf::from(OsString::from_vec(target.into_bytes()));
        if target.is_absolute() {
            self.directory =
                openat(&self.directory, "/", OPEN_DIRECTORY | OFlags::PATH, Mode::empty()).map_err(broken)?;
            self.path = PathBuf::from("/");
        }
        Ok(components_of(&target))
    }

    fn system(&self, error: Errno) -> WalkError {
        WalkError::System(self.path.clone(), error)
    }
}

/// Result of opening a component.
enum ComponentResult {
    Entered,
    Absent,
    /// A link, or a file that is not a directory.
    NotDirectory,
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

/// Returns the ID of `user` as text, with the user's name if the user has a name.
pub fn describe_user(user: u32) -> String {
    let entry = nix::unistd::User::from_uid(user.into()).ok().flatten();
    entry.map_or_else(|| user.to_string(), |known| format!("{user} ({})", known.name))
}

/// Returns the user of this process.
pub fn effective_uid() -> u32 {
    rustix::process::geteuid().as_raw()
}

const OPEN_DIRECTORY: OFlags = OFlags::DIRECTORY.union(OFlags::NOFOLLOW).union(OFlags::CLOEXEC);
/// Permission bits with which group and others may write.
const OTHERS_WRITE: u32 = 0o022;
/// Mode bit with which only owners may rename and remove the files in a directory (inode(7)).
pub const STICKY: u32 = 0o1000;
/// Maximum number of links on a path, the same as in the kernel (path_resolution(7)).
const MAX_LINKS: usize = 40;
