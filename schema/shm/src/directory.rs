//! Private directories of this user: the directory of a domain, and the state directory, which survives restarts. Both
//! contain small files and locks.
//!
//! A directory is opened component by component from the root of the file system, and every file in it is opened
//! relative to the open directory. No other user can therefore substitute another directory. The last components (base
//! and domain) must belong to this user, no other user may be able to write to them, and they must not be links. In the
//! components above them, a link is followed if root or this user made it in a directory that no other user can write
//! to: `/home` or `/var/run` may be links. The owners of the directories above the base are not checked.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};

use nix::fcntl::{FcntlArg, fcntl};
use nix::libc::{self, flock};
use rustix::fs::{AtFlags, Dir, FileType, Mode, OFlags, Stat, fstat, openat, renameat, statat, unlinkat};
use rustix::io::Errno;

use scanhub_files::path_walk::{
    LinkPolicy, PathWalk, STICKY, WalkError, components_of, describe_user, effective_uid,
};
use scanhub_schema::{Failure, Kind};

use crate::domain::first_path;
use crate::resource_limits;

/// An open directory that belongs to this user and that no other user can write to.
#[derive(Debug)]
pub struct Directory {
    fd: OwnedFd,
    path: PathBuf,
    purpose: Purpose,
}

/// Purpose of a directory. The remedy in a message depends on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Purpose {
    /// Files of a domain.
    Domain,
    /// Files that programs keep across restarts.
    State,
}

impl Directory {
    /// Returns the directory `root` of a domain, or `None` if it does not exist.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::OtherUser`] with the path, its owner and the remedy if base or domain belongs to another user.
    /// Returns [`Kind::Failed`] if base or domain can be written to by others, or is reached by a link that another
    /// user could have made. Returns [`Kind::ResourceExhausted`] if descriptors run out.
    pub fn open(root: &Path) -> Result<Option<Directory>, Failure> {
        Directory::walk(root, 2, Purpose::Domain, effective_uid(), false)
    }

    /// Returns the directory `root` of a domain. Missing directories are created for this user only.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`open`](Self::open), and [`Kind::Failed`] if the directory cannot be created.
    pub fn create(root: &Path) -> Result<Directory, Failure> {
        Directory::create_directory(root, 2, Purpose::Domain)
    }

    /// Returns the directory `path`, in which programs keep files across restarts. This user must own the last
    /// `owned_components` components of the path. Missing directories are created for this user only.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`create`](Self::create).
    pub fn create_state(path: &Path, owned_components: usize) -> Result<Directory, Failure> {
        Directory::create_directory(path, owned_components, Purpose::State)
    }

    /// Returns the file `name`, or `None` if it does not exist.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::OtherUser`] if the file belongs to another user, and [`Kind::Failed`] if it is a link or not a
    /// regular file.
    pub fn file(&self, name: &str) -> Result<Option<File>, Failure> {
        match self.open_file(name, OFlags::RDONLY) {
            Err(Errno::NOENT) => Ok(None),
            opened => self.check_file(name, opened).map(Some),
        }
    }

    /// Returns the file `name` for reading and writing. A file that does not exist is created with mode 0600.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`file`](Self::file), and [`Kind::Failed`] if the file cannot be created.
    pub fn open_or_create(&self, name: &str) -> Result<File, Failure> {
        let opened = self.open_file(name, OFlags::RDWR | OFlags::CREATE);
        self.check_file(name, opened)
    }

    /// Replaces the content of the file `name` in one step. A reader, or the next process after a crash, finds either
    /// the old or the new content. Waits for the disk.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`open_or_create`](Self::open_or_create), and [`Kind::Failed`] if the file cannot be
    /// written.
    pub(crate) fn replace(&self, name: &str, content: &[u8]) -> Result<(), Failure> {
        let temporary = format!("{name}.new");
        // A crash may have left a file with this name.
        self.remove(OsStr::new(&temporary));
        let opened = self.open_file(&temporary, OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL);
        let mut file = self.check_file(&temporary, opened)?;
        let written = file.write_all(content).and_then(|()| file.sync_data());
        let renamed = written.and_then(|()| Ok(renameat(&self.fd, &temporary, &self.fd, name)?));
        renamed.map_err(|error| {
            self.remove(OsStr::new(&temporary));
            self.purpose.unusable(&self.path.join(name), error)
        })
    }

    /// Removes the file `name`. Ignores a file that does not exist or cannot be removed.
    pub(crate) fn remove(&self, name: &OsStr) {
        let _ = self.try_remove(name);
    }

    /// Removes the file `name`, if it exists.
    ///
    /// # Errors
    ///
    /// Returns the system's error if it cannot be removed.
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

    /// Returns the names and the metadata of the directory's entries. The metadata of a link is that of the link
    /// itself.
    pub(crate) fn entries(&self) -> Vec<(OsString, Stat)> {
        let Ok(entries) = Dir::read_from(&self.fd) else { return Vec::new() };
        let names = entries.flatten().map(|entry| OsStr::from_bytes(entry.file_name().to_bytes()).to_owned());
        let with_metadata = |name| Some((statat(&self.fd, &name, AtFlags::SYMLINK_NOFOLLOW).ok()?, name));
        let entries = names.filter(|name| name != "." && name != "..").filter_map(with_metadata);
        entries.map(|(stat, name)| (name, stat)).collect()
    }

    /// Returns the directory `name` in this directory. Returns `None` if it does not exist, is a link, or belongs to
    /// another user.
    pub(crate) fn subdirectory(&self, name: &str) -> Option<Directory> {
        let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC | OFlags::RDONLY;
        let fd = openat(&self.fd, name, flags, Mode::empty()).ok()?;
        let is_own = fstat(&fd).is_ok_and(|stat| stat.st_uid == effective_uid());
        is_own.then(|| Directory { fd, path: self.path.join(name), purpose: self.purpose })
    }

    /// Removes the directory if it is empty and is still at its path. Returns whether the directory is removed.
    pub(crate) fn remove_itself(&self) -> bool {
        let at_path = self.path.symlink_metadata().map(|it| (it.dev(), it.ino()));
        let is_at_path =
            fstat(&self.fd).is_ok_and(|stat| at_path.is_ok_and(|there| there == (stat.st_dev, stat.st_ino)));
        if is_at_path {
            let _ = unlinkat(rustix::fs::CWD, &self.path, AtFlags::REMOVEDIR);
        }
        fstat(&self.fd).is_ok_and(|stat| stat.st_nlink == 0)
    }

    fn open_file(&self, name: &str, flags: OFlags) -> Result<OwnedFd, Errno> {
        let mode = Mode::RUSR | Mode::WUSR;
        openat(&self.fd, name, flags | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC, mode)
    }

    fn check_file(&self, name: &str, opened: Result<OwnedFd, Errno>) -> Result<File, Failure> {
        let path = self.path.join(name);
        let fd = opened.map_err(|error| match error {
            Errno::LOOP => self.purpose.untrusted(&path, "is a link"),
            error => self.purpose.unusable(&path, error),
        })?;
        let stat = fstat(&fd).map_err(|error| self.purpose.unusable(&path, error))?;
        if FileType::from_raw_mode(stat.st_mode) != FileType::RegularFile {
            return Err(self.purpose.untrusted(&path, "is not a regular file"));
        }
        if stat.st_uid != effective_uid() {
            let what = format!("belongs to user {}", describe_user(stat.st_uid));
            return Err(Failure { kind: Kind::OtherUser, ..self.purpose.untrusted(&path, &what) });
        }
        Ok(File::from(fd))
    }

    fn create_directory(
        path: &Path,
        owned_components: usize,
        purpose: Purpose,
    ) -> Result<Directory, Failure> {
        let created = Directory::walk(path, owned_components, purpose, effective_uid(), true)?;
        created.ok_or_else(|| purpose.unusable(path, Errno::NOENT))
    }

    /// Opens `path`, whose last `owned_components` components must belong to `user`.
    fn walk(
        path: &Path,
        owned_components: usize,
        purpose: Purpose,
        user: u32,
        create: bool,
    ) -> Result<Option<Directory>, Failure> {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let mut components = components_of(&path);
        if components.len() < owned_components {
            return Err(purpose.unusable(&path, Errno::INVAL));
        }
        let components_to_own = components.split_off(components.len() - owned_components);
        let make = create.then_some(Mode::RWXU);
        let reached = PathWalk::begin(&path, LinkPolicy::Own, user).and_then(|mut walk| {
            if !walk.enter(components, make)? {
                return Ok(None);
            }
            for (number, component) in components_to_own.iter().enumerate() {
                // Only the last directory is read. The directories above it are only passed through.
                let flags = if number + 1 == owned_components { OFlags::RDONLY } else { OFlags::PATH };
                if !walk.enter_own(component, make, flags)? {
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
    /// Returns the failure to report to `user` for `error`.
    fn failure(self, error: WalkError, user: u32) -> Failure {
        match error {
            WalkError::System(path, error) => self.unusable(&path, error),
            WalkError::Untrusted(path, what) => self.untrusted(&path, &what),
            WalkError::Foreign(path, owner, mode) => {
                let (path, owner, user) = (path.display(), describe_user(owner), describe_user(user));
                let mode = mode & 0o7777;
                let what =
                    format!("{path} belongs to user {owner} with mode {mode:04o}, this is user {user}");
                let hint = match self {
                    Purpose::Domain => format!(
                        "shared memory is for one user: run as user {owner}, or choose another --root; for data of a \
                         hub of user {owner}: `scanhub gateway --interface lo` as that user, `scanhub listen --publish \
                         --interface lo` as this one"
                    ),
                    Purpose::State => format!("run as user {owner}, with sudo without -E, or {STATE_REMEDY}"),
                };
                Failure::new(Kind::OtherUser, what, hint)
            }
            WalkError::Writable(path, mode) => {
                let (path, mode) = (path.display(), mode & 0o7777);
                let hint = match self {
                    // A sticky directory, such as /tmp, is for all users and must keep its mode.
                    Purpose::Domain if mode & STICKY != 0 => {
                        format!("choose your own directory, for example --root {path}/NAME")
                    }
                    Purpose::State if mode & STICKY != 0 => STATE_REMEDY.to_owned(),
                    _ => format!("chmod go-w {path}, or {}", self.alternative()),
                };
                let what = format!("{path} has mode {mode:04o}: others can put files there");
                Failure::new(Kind::Failed, what, hint)
            }
        }
    }

    /// Returns the failure of a `path` that another user may have put there.
    fn untrusted(self, path: &Path, what: &str) -> Failure {
        let path = path.display();
        Failure::new(
            Kind::Failed,
            format!("{path} {what}: scanhub opens nothing in it"),
            format!("examine it with `ls -ld {path}` and remove it, or {}", self.alternative()),
        )
    }

    fn unusable(self, path: &Path, error: impl Into<io::Error>) -> Failure {
        let error = error.into();
        resource_limits::find_shortage(path).unwrap_or_else(|| {
            Failure::new(Kind::Failed, format!("{}: {error}", path.display()), self.alternative())
        })
    }

    /// Returns the remedy, which is to use another directory.
    fn alternative(self) -> &'static str {
        match self {
            Purpose::Domain => "choose another --root",
            Purpose::State => STATE_REMEDY,
        }
    }
}

const STATE_REMEDY: &str = "set STATE_DIRECTORY or XDG_STATE_HOME to a directory of this user";

/// A lock on a file of a domain's directory. The lock ends when its process ends. The file contains the ID of the
/// process that holds the lock, because the kernel does not report this ID.
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
    /// Returns the failure of `on_held` if another process has the lock. The argument of `on_held` is the ID of that
    /// process, or 0 if the process has not written it yet. Returns [`Kind::Failed`] if the file cannot be locked.
    pub(crate) fn acquire(
        root: &Path,
        name: &str,
        on_held: impl Fn(u32) -> Failure,
    ) -> Result<FileLock, Failure> {
        let file = loop {
            let file = Directory::create(root)?.open_or_create(name)?;
            match fcntl(file.as_raw_fd(), FcntlArg::F_OFD_SETLK(&whole_file(libc::F_WRLCK))) {
                // The previous holder may have removed the file with its domain. The next process would then create and
                // lock another file, so try again.
                Ok(_) if file.metadata().is_ok_and(|metadata| metadata.nlink() == 0) => {}
                Ok(_) => break file,
                Err(nix::Error::EAGAIN | nix::Error::EACCES) => return Err(on_held(pid_in(&file))),
                Err(error) => return Err(Purpose::Domain.unusable(root, error)),
            }
        };
        file.set_len(0).map_err(|error| Purpose::Domain.unusable(root, error))?;
        Ok(FileLock { file })
    }

    /// Writes `lines` at the start of the file, which is in `root`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the file cannot be written.
    pub(crate) fn write(&self, root: &Path, lines: &str) -> Result<(), Failure> {
        self.file.write_all_at(lines.as_bytes(), 0).map_err(|error| Purpose::Domain.unusable(root, error))
    }
}

impl Drop for FileLock {
    /// Releases the lock. Closing the file is not enough: a child process that is just being started has a copy of the
    /// descriptor for a moment, and the copy would keep the lock.
    fn drop(&mut self) {
        let _ = fcntl(self.file.as_raw_fd(), FcntlArg::F_OFD_SETLK(&whole_file(libc::F_UNLCK)));
    }
}

/// Lock of a process that creates services in a domain, or that removes unfinished services.
pub(crate) struct ServiceCreationLock {
    _lock: FileLock,
}

impl ServiceCreationLock {
    /// Waits for the lock. A process holds the lock only while it creates one service.
    pub(crate) fn wait(root: &Path) -> Result<ServiceCreationLock, Failure> {
        let file = Directory::create(root)?.open_or_create(CREATION_LOCK_FILE)?;
        loop {
            match fcntl(file.as_raw_fd(), FcntlArg::F_OFD_SETLKW(&whole_file(libc::F_WRLCK))) {
                Ok(_) => return Ok(ServiceCreationLock { _lock: FileLock { file } }),
                Err(nix::Error::EINTR) => {}
                Err(error) => return Err(Purpose::Domain.unusable(root, error)),
            }
        }
    }
}

/// Returns the file of the lock `name` and its directory if a process holds the lock.
///
/// # Errors
///
/// Returns the errors of [`Directory::open`] and [`Directory::file`].
pub(crate) fn locked_file(root: &Path, name: &str) -> Result<Option<(Directory, File)>, Failure> {
    let Some(directory) = Directory::open(root)? else { return Ok(None) };
    let Some(file) = directory.file(name)? else { return Ok(None) };
    let mut lock = whole_file(libc::F_RDLCK);
    fcntl(file.as_raw_fd(), FcntlArg::F_OFD_GETLK(&mut lock))
        .map_err(|error| Purpose::Domain.unusable(root, error))?;
    Ok((lock.l_type != libc::F_UNLCK as libc::c_short).then_some((directory, file)))
}

/// Returns the process ID in the file of a lock. Returns 0 if the file has no ID.
pub(crate) fn pid_in(file: &File) -> u32 {
    lock_text(file).lines().next().and_then(|pid| pid.parse().ok()).unwrap_or_default()
}

/// Returns the text in the file of a lock.
pub(crate) fn lock_text(file: &File) -> String {
    let mut bytes = [0; 32];
    let length = file.read_at(&mut bytes, 0).unwrap_or_default();
    String::from_utf8_lossy(&bytes[..length]).into_owned()
}

/// Returns a lock of the whole file. `l_pid` must be 0 in locks of open file descriptions.
fn whole_file(kind: libc::c_int) -> flock {
    flock {
        l_type: kind as libc::c_short,
        l_whence: libc::SEEK_SET as libc::c_short,
        l_start: 0,
        l_len: 0,
        l_pid: 0,
    }
}

const CREATION_LOCK_FILE: &str = "making.lock";

/// Directory of the small text files that a domain keeps across restarts: `$STATE_DIRECTORY/DOMAIN`, otherwise
/// `$XDG_STATE_HOME/scanhub/DOMAIN`, otherwise `~/.local/state/scanhub/DOMAIN`.
///
/// The reader of a file checks its content, which may come from another version or be missing. If a file is lost, its
/// content is learned again, which only takes time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StateDirectory {
    path: PathBuf,
}

impl StateDirectory {
    /// Returns the directory that contains the state directories of all domains. The environment of this process names
    /// it: it is the directory that systemd created for the service, otherwise the user's own directory. Returns `None`
    /// if the environment names no directory.
    pub fn base() -> Option<PathBuf> {
        base_in(|name| std::env::var_os(name))
    }

    /// Returns the directory of `domain`, which need not exist. Returns `None` if the environment names no directory,
    /// as for [`base`](Self::base).
    pub fn of_domain(domain: &str) -> Option<StateDirectory> {
        Some(StateDirectory::at(StateDirectory::base()?.join(domain)))
    }

    /// Returns the directory `path`, which need not exist.
    pub fn at(path: impl Into<PathBuf>) -> StateDirectory {
        StateDirectory { path: path.into() }
    }

    /// Returns the path of the file `name`, which need not exist.
    pub fn path(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// Checks that the directory can be used, if it exists.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::OtherUser`] with owner and remedy if the directory, or the directory above it, belongs to
    /// another user. Returns [`Kind::Failed`] if one of them can be written to by others, or is reached by a link that
    /// another user could have made.
    pub fn check(&self) -> Result<(), Failure> {
        self.open().map(drop)
    }

    /// Returns the content of the file `name`, or `None` if it does not exist.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`check`](Self::check). Returns [`Kind::Failed`] if the file cannot be read, is not a
    /// regular file of this user that no other user can write, has more than `max_bytes` bytes, or is not UTF-8.
    pub fn read(&self, name: &str, max_bytes: u64) -> Result<Option<String>, Failure> {
        let Some(directory) = self.open()? else { return Ok(None) };
        let Some(file) = directory.file(name)? else { return Ok(None) };
        read(&file, max_bytes).map(Some).map_err(|error| {
            let what = format!("cannot use {}: {error}", self.path(name).display());
            Failure::new(Kind::Failed, what, "delete it; its content is learned again")
        })
    }

    /// Replaces the content of the file `name`, which gets mode 0600. Creates the directory with mode 0700 if it does
    /// not exist. Waits for the disk, so do not call it in a thread that reads a line.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`check`](Self::check), and [`Kind::Failed`] if the file cannot be written. The file then
    /// keeps its content.
    pub fn write(&self, name: &str, text: &str) -> Result<(), Failure> {
        self.create()?.replace(name, text.as_bytes()).map_err(not_saved)
    }

    /// Waits for the lock that a process holds between reading and writing the file `name`. Returns the locked file,
    /// and the lock ends when this file is dropped. Creates the directory as [`write`](Self::write) does, and a file
    /// for the lock.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`write`](Self::write).
    pub fn lock(&self, name: &str) -> Result<File, Failure> {
        let name = format!("{name}.lock");
        let file = self.create()?.open_or_create(&name).map_err(not_saved)?;
        let locked = file.lock().map(|()| file);
        locked.map_err(|error| {
            let what = format!("cannot lock {}: {error}", self.path(&name).display());
            Failure::new(Kind::Failed, what, "the file system must have locks")
        })
    }

    /// Removes the file `name`, if it exists.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`check`](Self::check), and [`Kind::Failed`] if the file cannot be removed.
    pub fn remove(&self, name: &str) -> Result<(), Failure> {
        let Some(directory) = self.open()? else { return Ok(()) };
        directory.try_remove(OsStr::new(name)).map_err(|error| {
            let message = format!("cannot remove {}: {error}", self.path(name).display());
            Failure::new(Kind::Failed, message, "remove the file")
        })
    }

    fn open(&self) -> Result<Option<Directory>, Failure> {
        Directory::walk(&self.path, OWNED_COMPONENTS, Purpose::State, effective_uid(), false)
    }

    fn create(&self) -> Result<Directory, Failure> {
        Directory::create_state(&self.path, OWNED_COMPONENTS).map_err(not_saved)
    }
}

/// Number of components of the path that this user must own: the directory of the domain, and above it the directory of
/// all domains.
const OWNED_COMPONENTS: usize = 2;

/// Adds to the message that no state can be saved.
fn not_saved(failure: Failure) -> Failure {
    Failure { message: format!("no state can be saved: {}", failure.message), ..failure }
}

fn base_in(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let path = |name| variable(name).and_then(first_path);
    let user = || path("XDG_STATE_HOME").or_else(|| Some(path("HOME")?.join(".local/state")));
    path("STATE_DIRECTORY").or_else(|| Some(user()?.join("scanhub")))
}

fn read(file: &File, max_bytes: u64) -> io::Result<String> {
    let refused = |what| io::Error::new(io::ErrorKind::InvalidData, what);
    let metadata = file.metadata()?;
    let (owner, mode) = (metadata.uid(), metadata.mode() & 0o7777);
    if mode & 0o022 != 0 {
        return Err(refused(format!("others can write it: owner {owner}, mode {mode:04o}")));
    }
    let mut text = String::new();
    let len = file.take(max_bytes + 1).read_to_string(&mut text)?;
    if len as u64 > max_bytes {
        Err(refused(format!("it has more than {max_bytes} bytes")))
    } else {
        Ok(text)
    }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, Permissions};
    use std::os::unix::fs::{PermissionsExt, symlink};

    use tempfile::TempDir;

    use super::*;

    /// Directory `HERE/base/domain`, with mode 0700 on each component below HERE.
    struct TestDirectory(TempDir);

    impl TestDirectory {
        fn new() -> TestDirectory {
            let here = TestDirectory(TempDir::new().unwrap());
            Directory::create(&here.at("base/domain")).unwrap();
            here
        }

        fn at(&self, path: &str) -> PathBuf {
            self.0.path().join(path)
        }

        fn mode(&self, path: &str, mode: u32) {
            fs::set_permissions(self.at(path), Permissions::from_mode(mode)).unwrap();
        }
    }

    fn refusal(opened: Result<Option<Directory>, Failure>) -> String {
        let failure = opened.expect_err("it is refused");
        assert!(!failure.hint.is_empty());
        failure.message
    }

    #[test]
    fn missing_directory_is_none_or_created_private() {
        let here = TestDirectory::new();
        assert!(Directory::open(&here.at("base/domain")).unwrap().is_some());
        for absent in ["base/other", "other/domain", "a/b/c"] {
            assert!(Directory::open(&here.at(absent)).unwrap().is_none(), "{absent}");
        }
        Directory::create(&here.at("a/b/c")).unwrap();
        for made in ["a", "a/b", "a/b/c"] {
            assert_eq!(fs::metadata(here.at(made)).unwrap().permissions().mode() & 0o7777, 0o700, "{made}");
        }
    }

    #[test]
    fn base_and_domain_must_belong_to_this_user() {
        let here = TestDirectory::new();
        let path = here.at("base/domain");
        let own = effective_uid();
        let message = refusal(Directory::walk(&path, 2, Purpose::Domain, own + 1, false));
        assert!(
            message.starts_with(&format!("{} belongs to user {own}", here.at("base").display())),
            "{message}"
        );
        assert!(message.contains("with mode 0700, this is user"), "{message}");
        for open in ["base", "base/domain"] {
            for mode in [0o720, 0o702, 0o1777] {
                here.mode(open, mode);
                let message = refusal(Directory::open(&path));
                assert!(
                    message.starts_with(&format!("{} has mode {mode:04o}", here.at(open).display())),
                    "{message}"
                );
                let hint = Directory::open(&path).unwrap_err().hint;
                assert_eq!(hint.contains("chmod go-w"), mode & STICKY == 0, "{hint}");
            }
            here.mode(open, 0o755);
        }
        assert!(Directory::open(&path).unwrap().is_some(), "others may look");
    }

    #[test]
    fn links_above_the_base_need_a_trusted_owner() {
        let here = TestDirectory::new();
        symlink(here.at("base"), here.at("link")).unwrap();
        symlink("domain", here.at("base/alias")).unwrap();
        for (path, link) in [("link/domain", "link"), ("base/alias", "base/alias")] {
            let message = refusal(Directory::open(&here.at(path)));
            assert!(message.starts_with(&format!("{} is a link", here.at(link).display())), "{message}");
        }
        Directory::create(&here.at("base/x/domain")).unwrap();
        assert!(Directory::open(&here.at("link/x/domain")).unwrap().is_some());
        here.mode("", 0o1777);
        let message = refusal(Directory::open(&here.at("link/x/domain")));
        assert!(message.contains("is a link of user") && message.contains("mode 1777"), "{message}");
        here.mode("", 0o700);
        // In a walk for another user, only links of root are followed.
        if effective_uid() != 0 {
            let message = refusal(Directory::walk(
                &here.at("link/x/domain"),
                2,
                Purpose::Domain,
                effective_uid() + 1,
                false,
            ));
            assert!(message.contains("is a link of user"), "{message}");
        }
        symlink("circle", here.at("circle")).unwrap();
        assert!(Directory::open(&here.at("circle/x/domain")).is_err());
        fs::write(here.at("file"), "").unwrap();
        assert!(Directory::open(&here.at("file/x/domain")).is_err());
    }

    #[test]
    fn special_files_and_links_are_refused() {
        let here = TestDirectory::new();
        let directory = Directory::create(&here.at("base/domain")).unwrap();
        assert!(directory.file("hub.lock").unwrap().is_none());
        directory.open_or_create("hub.lock").unwrap();
        let mode = fs::metadata(here.at("base/domain/hub.lock")).unwrap().permissions().mode();
        assert_eq!(mode & 0o7777, 0o600);
        assert!(directory.file("hub.lock").unwrap().is_some());
        fs::write(here.at("victim"), "whole").unwrap();
        symlink(here.at("victim"), here.at("base/domain/link")).unwrap();
        symlink(here.at("victim"), here.at("base/domain/prefix.new")).unwrap();
        let fifo = here.at("base/domain/fifo");
        rustix::fs::mknodat(rustix::fs::CWD, &fifo, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        for (name, word) in [("link", "is a link"), ("fifo", "is not a regular file")] {
            for failure in [directory.file(name).unwrap_err(), directory.open_or_create(name).unwrap_err()] {
                assert!(failure.message.contains(word), "{name}: {failure}");
            }
        }
        directory.replace("prefix", b"x").unwrap();
        assert_eq!(fs::read_to_string(here.at("base/domain/prefix")).unwrap(), "x");
        assert_eq!(fs::read_to_string(here.at("victim")).unwrap(), "whole");
    }

    /// Path of a directory that does not exist yet, below a temporary one.
    struct TempStateDirectory(
        PathBuf,
        #[expect(dead_code, reason = "it is removed when it is dropped")] TempDir,
    );

    impl TempStateDirectory {
        fn new() -> (TempStateDirectory, StateDirectory) {
            let parent = TempDir::new().unwrap();
            let path = parent.path().join("a");
            (TempStateDirectory(path.clone(), parent), StateDirectory::at(path))
        }
    }

    fn mode(path: &Path) -> u32 {
        fs::metadata(path).unwrap().mode() & 0o7777
    }

    #[test]
    fn environment_determines_the_state_directory() {
        let base = |set: &[(&str, &str)]| {
            base_in(|name| set.iter().find(|(key, _)| *key == name).map(|(_, value)| value.into()))
        };
        let [service, user, home] =
            [("STATE_DIRECTORY", "/s/a:/s/b"), ("XDG_STATE_HOME", "/x"), ("HOME", "/h")];
        assert_eq!(base(&[service, user, home]), Some("/s/a".into()));
        assert_eq!(base(&[user, home]), Some("/x/scanhub".into()));
        assert_eq!(base(&[home]), Some("/h/.local/state/scanhub".into()));
        assert_eq!(base(&[("XDG_STATE_HOME", "relative"), home]), Some("/h/.local/state/scanhub".into()));
        assert_eq!(base(&[]), None);
    }

    #[test]
    fn state_file_round_trips_with_private_permissions() {
        let (place, state) = TempStateDirectory::new();
        assert_eq!(state.read("f", 9), Ok(None));
        for text in ["first", "second", ""] {
            state.write("f", text).unwrap();
            assert_eq!(state.read("f", 6), Ok(Some(text.to_owned())));
            assert_eq!((mode(&place.0), mode(&state.path("f"))), (0o700, 0o600));
        }
        assert_eq!(fs::read_dir(&place.0).unwrap().count(), 1, "nothing is left beside it");
    }

    #[test]
    fn temporary_file_left_by_a_crash_is_replaced() {
        let (place, state) = TempStateDirectory::new();
        fs::create_dir_all(&place.0).unwrap();
        let other = place.0.join("other");
        fs::write(&other, "untouched").unwrap();
        symlink(&other, state.path("f.new")).unwrap();
        state.write("f", "text").unwrap();
        assert_eq!(state.read("f", 9), Ok(Some("text".to_owned())));
        assert_eq!(fs::read_to_string(&other).unwrap(), "untouched");
        assert_eq!(mode(&state.path("f")), 0o600);
    }

    #[test]
    fn untrusted_or_invalid_state_files_are_refused() {
        let (place, state) = TempStateDirectory::new();
        state.write("f", "12345").unwrap();
        let refused = |state: &StateDirectory, name, says: &str| {
            let failure = state.read(name, 5).unwrap_err();
            assert!(failure.message.contains(says) && failure.message.contains("/a/"), "{failure}");
            assert!(failure.hint.contains("delete it") || failure.hint.contains("remove it"), "{failure}");
        };
        fs::write(state.path("long"), "123456").unwrap();
        refused(&state, "long", "more than 5 bytes");
        fs::write(state.path("binary"), [0xff]).unwrap();
        refused(&state, "binary", "UTF-8");
        symlink(state.path("f"), state.path("link")).unwrap();
        refused(&state, "link", "is a link");
        fs::create_dir(state.path("directory")).unwrap();
        refused(&state, "directory", "is not a regular file");
        fs::set_permissions(state.path("f"), fs::Permissions::from_mode(0o620)).unwrap();
        refused(&state, "f", "mode 0620");
        drop(place);
    }

    #[test]
    fn unwritable_state_directory_has_a_remedy() {
        let state = StateDirectory::at("/dev/null/x");
        let failures = [state.read("f", 9).map(drop).unwrap_err(), state.write("f", "text").unwrap_err()];
        let [_, failure] = failures;
        assert!(failure.message.contains("no state can be saved: /dev/null"), "{failure}");
        assert!(failure.hint.contains("STATE_DIRECTORY"), "{failure}");
    }

    #[test]
    fn write_over_a_directory_leaves_no_temporary_file() {
        let (place, state) = TempStateDirectory::new();
        fs::create_dir_all(state.path("f").join("full")).unwrap();
        state.write("f", "text").unwrap_err();
        assert_eq!(fs::read_dir(&place.0).unwrap().count(), 1, "nothing is left beside it");
    }
}
