//! Files that a user names as output. Other users of the machine may write to the same directory, so every verb creates
//! its files with this module.
//!
//! A file that is written as a whole is complete or absent: [`OutputFile`] has a random name until it is complete. A
//! file that grows has its final name from the start, see [`Target::create`], so that the file survives if the process
//! is killed.
//!
//! - The last component of a path must not be a link, a device, a pipe or a socket.
//! - A link among the other components is followed, unless it belongs to another user and lies in a sticky directory,
//!   such as /tmp.
//! - An existing file is replaced only if `force` is set.

use std::ffi::OsString;
use std::fs::{self, File, Permissions};
use std::io::{self, ErrorKind, Write};
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::{MetadataExt, PermissionsExt, fchown};
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, FileType, Mode, OFlags, Stat, openat, readlinkat, statat, unlinkat};
use rustix::io::Errno;
use tempfile::NamedTempFile;

use crate::path_walk::{LinkPolicy, PathWalk, WalkError, components_of, describe_user, effective_uid};
use scanhub_schema::{Failure, Kind};

/// Writes `content` to the file at `path`. With `force`, an existing file is replaced.
///
/// # Errors
///
/// Returns the errors of [`OutputFile::create`] and [`OutputFile::commit`].
pub fn write(path: &Path, content: &[u8], force: bool) -> Result<(), Failure> {
    let mut file = OutputFile::create(path, force)?;
    file.write_all(content).map_err(|error| unwritable(path, &error))?;
    file.commit()
}

/// Creates the directory `path` and its missing parents, with the permissions that the umask leaves. An existing
/// directory is not changed.
///
/// # Errors
///
/// Returns [`Kind::Output`] if the directory cannot be created, is not a directory, or is reached by a link that
/// another user has put into a sticky directory.
pub fn create_directory(path: &Path) -> Result<(), Failure> {
    open_directory(path, path, Some(Mode::RWXU | Mode::RWXG | Mode::RWXO)).map(drop)
}

/// A file that is written as a whole. Until [`commit`](Self::commit), it has mode 0600 and a random name in the
/// directory of its target. If it is dropped before `commit`, the file is removed.
#[derive(Debug)]
pub struct OutputFile {
    // Dropping this field removes the file, which needs the open directory in `target`. Fields are dropped in this
    // order.
    file: NamedTempFile,
    target: Target,
    force: bool,
}

impl OutputFile {
    /// Creates the temporary file for the output `path`. With `force`, [`commit`](Self::commit) may replace a regular
    /// file.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Target::open`] and [`Target::check`], and [`Kind::Output`] if the file cannot be created
    /// in the directory.
    pub fn create(path: &Path, force: bool) -> Result<OutputFile, Failure> {
        let target = Target::open(path)?;
        target.check(force)?;
        let mut prefix = OsString::from(".");
        prefix.push(&target.name);
        prefix.push(".");
        let file = tempfile::Builder::new().prefix(&prefix).tempfile_in(target.directory_path());
        let file = file.map_err(|error| unwritable(path, &error))?;
        Ok(OutputFile { target, file, force })
    }

    /// Gives the complete file its name. A new file gets the permissions that the umask leaves. A file that replaces
    /// another one gets the owner and the permissions of that file.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Output`] if the file cannot be written, or if another file got the name in the meantime.
    pub fn commit(self) -> Result<(), Failure> {
        let OutputFile { target, file, force } = self;
        let old = target.check(force)?;
        let persist = || {
            let permissions = match old {
                // Only root may change the owner of a file. The change clears some permissions, so they are set
                // afterwards.
                Some(old) => match fchown(file.as_file(), Some(old.st_uid), Some(old.st_gid)) {
                    Ok(()) => old.st_mode & 0o777,
                    // The permissions of group and others were meant for the old owner and group, so they are not kept.
                    Err(_) => old.st_mode & 0o600,
                },
                None => PUBLIC_MODE & !umask(),
            };
            file.as_file().set_permissions(Permissions::from_mode(permissions))?;
            file.as_file().sync_all()?;
            let path = target.directory_path().join(&target.name);
            let persisted = if force { file.persist(path) } else { file.persist_noclobber(path) };
            persisted.map(drop).map_err(|failed| failed.error)
        };
        persist().map_err(|error| match error.kind() {
            ErrorKind::AlreadyExists => already_exists(&target.path),
            _ => unwritable(&target.path, &error),
        })
    }
}

impl Write for OutputFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// An output file: its open directory, and its name there.
#[derive(Debug)]
pub struct Target {
    directory: OwnedFd,
    name: OsString,
    /// Path as the user wrote it.
    path: PathBuf,
}

impl Target {
    /// Opens the directory of `path`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Output`] if the directory does not exist, cannot be opened, or is reached by a link that another
    /// user has put into a sticky directory, and if `path` does not name a file.
    pub fn open(path: &Path) -> Result<Target, Failure> {
        let Some(name) = path.file_name() else {
            // The path ends with the root or with "..".
            let message = format!("cannot write {}: it is a directory", path.display());
            return Err(Failure::new(Kind::Output, message, "name a file in it"));
        };
        let parent = path.parent().unwrap_or(Path::new(""));
        let directory = open_directory(path, parent, None)?;
        Ok(Target { directory, name: name.to_owned(), path: path.to_owned() })
    }

    /// Returns the metadata of an existing file that may be replaced, or `None` if there is no file.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Output`] if the file exists and `force` is not set. Returns it even with `force` if the file is
    /// not a regular file.
    pub fn check(&self, force: bool) -> Result<Option<Stat>, Failure> {
        let stat = match statat(&self.directory, &self.name, AtFlags::SYMLINK_NOFOLLOW) {
            Ok(stat) => stat,
            Err(Errno::NOENT) => return Ok(None),
            Err(error) => return Err(unwritable(&self.path, &error.into())),
        };
        let (what, hint) = match FileType::from_raw_mode(stat.st_mode) {
            FileType::RegularFile if force => return Ok(Some(stat)),
            FileType::RegularFile => return Err(already_exists(&self.path)),
            FileType::Symlink => {
                let target = readlinkat(&self.directory, &self.name, Vec::new()).unwrap_or_default();
                let target = PathBuf::from(OsString::from_vec(target.into_bytes()));
                (
                    format!("a link to {}", target.display()),
                    "name that file itself, or remove the link".to_owned(),
                )
            }
            FileType::Directory => ("a directory".to_owned(), "name a file in it".to_owned()),
            kind => {
                let what = match kind {
                    FileType::Fifo => "a pipe",
                    FileType::Socket => "a socket",
                    _ => "a device",
                };
                // With `- > PATH`, the shell opens the pipe or the device, without these checks.
                (
                    what.to_owned(),
                    format!("name a file; or stdout, if this verb has it: - > {}", self.path.display()),
                )
            }
        };
        let message = format!("cannot write {}: it is {what}", self.path.display());
        Err(Failure::new(Kind::Output, message, hint))
    }

    /// Creates an empty file with the permissions that the umask leaves. With `reuse`, an existing file is opened and
    /// keeps its content.
    ///
    /// # Errors
    ///
    /// Returns the system's error, such as [`ErrorKind::AlreadyExists`] if the file exists and `reuse` is not set. A
    /// link is always an error. Returns [`ErrorKind::InvalidInput`] if the existing file is not a regular file, or has
    /// several names.
    pub fn create(&self, reuse: bool) -> io::Result<File> {
        self.open_file(reuse, PUBLIC_MODE)
    }

    fn open_file(&self, reuse: bool, mode: u32) -> io::Result<File> {
        let exclusive = if reuse { OFlags::empty() } else { OFlags::EXCL };
        // Without NONBLOCK, opening a pipe would wait for its reader.
        let flags = OFlags::WRONLY
            | OFlags::CREATE
            | OFlags::NOFOLLOW
            | OFlags::NONBLOCK
            | OFlags::CLOEXEC
            | exclusive;
        let file = File::from(openat(&self.directory, &self.name, flags, Mode::from_raw_mode(mode))?);
        let metadata = file.metadata()?;
        if !metadata.is_file() {
            return Err(io::Error::new(ErrorKind::InvalidInput, "it is not a regular file"));
        }
        if metadata.nlink() > 1 {
            let what =
                format!("it has {} names (hard links), and would change under all of them", metadata.nlink());
            return Err(io::Error::new(ErrorKind::InvalidInput, what));
        }
        Ok(file)
    }

    /// Creates an empty file with the permissions `mode`, without those that the umask removes. With `force`, an
    /// existing regular file is replaced.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`check`](Self::check), and [`Kind::Output`] if the file cannot be created.
    pub fn create_new(&self, force: bool, mode: u32) -> Result<File, Failure> {
        if self.check(force)?.is_some() {
            let removed = unlinkat(&self.directory, &self.name, AtFlags::empty());
            removed.map_err(|error| unwritable(&self.path, &error.into()))?;
        }
        self.open_file(false, mode).map_err(|error| match error.kind() {
            ErrorKind::AlreadyExists => already_exists(&self.path),
            _ => unwritable(&self.path, &error),
        })
    }

    /// Returns a path of the open directory that stays valid even if the directory is moved.
    fn directory_path(&self) -> PathBuf {
        format!("/proc/self/fd/{}", self.directory.as_raw_fd()).into()
    }
}

/// Opens `directory`, which is `path` or its parent. `path` is the output that messages name. With `make`, missing
/// directories are created with these permissions.
fn open_directory(path: &Path, directory: &Path, make: Option<Mode>) -> Result<OwnedFd, Failure> {
    let reached = PathWalk::begin(path, LinkPolicy::AllButSticky, effective_uid()).and_then(|mut walk| {
        let exists = walk.enter(components_of(directory), make)?;
        if exists { Ok(walk) } else { Err(WalkError::System(directory.to_owned(), Errno::NOENT)) }
    });
    let error = match reached {
        Ok(walk) => return Ok(walk.into_parts().0),
        // Usually the directory itself cannot be opened. The message then names only the output.
        Err(WalkError::System(failed_at, error)) if failed_at == directory => error.into(),
        Err(WalkError::System(failed_at, error)) => {
            io::Error::other(format!("{}: {}", failed_at.display(), io::Error::from(error)))
        }
        Err(WalkError::Foreign(failed_at, owner, mode)) => {
            let mode = mode & 0o7777;
            let what = format!(
                "{} belongs to user {} with mode {mode:04o}",
                failed_at.display(),
                describe_user(owner)
            );
            io::Error::other(what)
        }
        // `PathWalk::enter` never returns this error; only `enter_own` does.
        Err(WalkError::Writable(failed_at, _)) => return Err(unwritable(&failed_at, &Errno::PERM.into())),
        Err(WalkError::Untrusted(failed_at, what)) => {
            let message = format!("cannot write {}: {} {what}", path.display(), failed_at.display());
            return Err(Failure::new(
                Kind::Output,
                message,
                "name a path without that link, or another file",
            ));
        }
    };
    let failure = unwritable(path, &error);
    // With `make`, a missing directory cannot be the reason.
    let hint =
        if make.is_some() { "name a directory that can be written to" } else { &failure.hint }.to_owned();
    Err(Failure { hint, ..failure })
}

/// Permissions of a new file. The umask removes some of them.
pub const PUBLIC_MODE: u32 = 0o666;
/// Permissions of a new file that only this user may read.
pub const PRIVATE_MODE: u32 = 0o600;

/// Returns the failure of a write to the file at `path`.
pub fn unwritable(path: &Path, error: &io::Error) -> Failure {
    let hint = match error.kind() {
        ErrorKind::InvalidInput => "name another file",
        _ => "the directory must exist, be writable and have free space",
    };
    Failure::new(Kind::Output, format!("cannot write {}: {error}", path.display()), hint)
}

fn already_exists(path: &Path) -> Failure {
    Failure::new(Kind::Output, format!("{} exists", path.display()), "--force replaces it")
}

/// Returns the permissions that new files of this process do not get. If the kernel does not report them (before Linux
/// 4.7), returns the permissions of group and others.
fn umask() -> u32 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let umask = status.lines().find_map(|line| line.strip_prefix("Umask:"));
    umask.and_then(|umask| u32::from_str_radix(umask.trim(), 8).ok()).unwrap_or(0o077)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use rustix::fs::{CWD, mknodat};
    use tempfile::TempDir;

    use super::*;

    fn file_names(directory: &Path) -> Vec<String> {
        let entries = fs::read_dir(directory).unwrap();
        let mut names: Vec<_> = entries.map(|it| it.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn file_is_complete_or_absent() {
        let directory = TempDir::new().unwrap();
        let path = directory.path().join("a.json");
        let mut file = OutputFile::create(&path, false).unwrap();
        file.write_all(b"half").unwrap();
        assert_eq!(file_names(directory.path()).len(), 1);
        assert!(!path.exists());
        let temporary = fs::metadata(directory.path().join(&file_names(directory.path())[0])).unwrap();
        assert_eq!(temporary.mode() & 0o7777, 0o600);
        drop(file);
        assert_eq!(file_names(directory.path()), [""; 0]);
        write(&path, b"whole", false).unwrap();
        assert_eq!(
            (file_names(directory.path()), fs::read(&path).unwrap()),
            (vec!["a.json".into()], b"whole".into())
        );
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o7777, 0o666 & !umask());
    }

    #[test]
    fn only_force_replaces_a_file_and_permissions_stay() {
        let directory = TempDir::new().unwrap();
        let path = directory.path().join("a");
        let file = OutputFile::create(&path, false).unwrap();
        fs::write(&path, "old").unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o640)).unwrap();
        // Another file was created at `path` after `create` had checked the path.
        let failure = file.commit().unwrap_err();
        assert_eq!((failure.kind, failure.message.ends_with("/a exists")), (Kind::Output, true), "{failure}");
        assert!(failure.hint.contains("--force"), "{failure}");
        assert_eq!(write(&path, b"new", false).unwrap_err().message, failure.message);
        assert_eq!(fs::read(&path).unwrap(), b"old");
        write(&path, b"new", true).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o7777, 0o640);
        assert_eq!(file_names(directory.path()), ["a"]);
    }

    #[test]
    fn links_and_special_files_are_refused_even_by_force() {
        let directory = TempDir::new().unwrap();
        let at = |name: &str| directory.path().join(name);
        fs::write(at("victim"), "whole").unwrap();
        symlink("victim", at("link")).unwrap();
        symlink("absent", at("dangling")).unwrap();
        mknodat(CWD, at("pipe"), FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        fs::create_dir(at("directory")).unwrap();
        for (path, what) in [
            (at("link"), "it is a link to victim"),
            (at("dangling"), "it is a link to absent"),
            (at("pipe"), "it is a pipe"),
            (at("directory"), "it is a directory"),
            ("/dev/null".into(), "it is a device"),
        ] {
            for force in [false, true] {
                let create = |target: Target| target.create_new(force, PUBLIC_MODE);
                let growing = Target::open(&path).and_then(create).unwrap_err();
                let failure = write(&path, b"new", force).unwrap_err();
                assert!(failure.message.ends_with(what) && !failure.hint.is_empty(), "{failure}");
                assert_eq!((failure.kind, &failure.message), (Kind::Output, &growing.message));
            }
        }
        for name in ["link", "dangling", "pipe"] {
            let target = Target::open(&at(name)).unwrap();
            assert!(target.create(true).is_err() && target.create(false).is_err(), "{name}");
        }
        assert_eq!(fs::read(at("victim")).unwrap(), b"whole");
        assert!(!at("absent").exists());
    }

    #[test]
    fn file_with_another_name_is_not_emptied() {
        let directory = TempDir::new().unwrap();
        let [path, backup] = ["a", "backup"].map(|name| directory.path().join(name));
        fs::write(&path, "old").unwrap();
        fs::hard_link(&path, &backup).unwrap();
        let target = Target::open(&path).unwrap();
        assert!(target.create(true).unwrap_err().to_string().contains("2 names"));
        target.create_new(true, PUBLIC_MODE).unwrap().write_all(b"new").unwrap();
        assert_eq!((fs::read(&path).unwrap(), fs::read(&backup).unwrap()), (b"new".into(), b"old".into()));
    }

    #[test]
    fn directory_is_created_with_those_above_it() {
        let directory = TempDir::new().unwrap();
        let at = |name: &str| directory.path().join(name);
        for _ in 0..2 {
            create_directory(&at("a/b/../c")).unwrap();
            assert_eq!(
                (file_names(directory.path()), file_names(&at("a"))),
                (vec!["a".into()], vec!["b".into(), "c".into()])
            );
        }
        for name in ["a", "a/b", "a/c"] {
            assert_eq!(fs::metadata(at(name)).unwrap().mode() & 0o777, 0o777 & !umask(), "{name}");
        }
        create_directory(Path::new("src")).unwrap();
        create_directory(Path::new(".")).unwrap();
        fs::write(at("file"), "").unwrap();
        symlink("a", at("link")).unwrap();
        create_directory(&at("link/d")).unwrap();
        assert_eq!(file_names(&at("a")), ["b", "c", "d"]);
        for name in ["file", "file/below"] {
            let failure = create_directory(&at(name)).unwrap_err();
            assert!(failure.kind == Kind::Output && failure.message.contains("Not a directory"), "{failure}");
            assert_eq!(failure.hint, "name a directory that can be written to");
        }
    }

    #[test]
    fn follows_links_except_foreign_ones_in_sticky_dirs() {
        let directory = TempDir::new().unwrap();
        let at = |name: &str| directory.path().join(name);
        fs::create_dir_all(at("real/below")).unwrap();
        fs::create_dir(at("shared")).unwrap();
        symlink(at("real"), at("shared/link")).unwrap();
        symlink("real/below", at("relative")).unwrap();
        for mode in [0o700, 0o777, 0o1777] {
            fs::set_permissions(at("shared"), Permissions::from_mode(mode)).unwrap();
            write(&at("shared/link/below/../a"), b"x", true).unwrap();
            assert_eq!(file_names(&at("real")), ["a", "below"]);
            write(&at("relative/a"), b"x", true).unwrap();
            assert_eq!(file_names(&at("real/below")), ["a"]);
        }
        if effective_uid() == 0 {
            std::os::unix::fs::lchown(at("shared/link"), Some(12_345), None).unwrap();
            let failure = write(&at("shared/link/b"), b"x", true).unwrap_err();
            assert!(failure.message.contains("link is a link of user 12345"), "{failure}");
            fs::set_permissions(at("shared"), Permissions::from_mode(0o777)).unwrap();
            write(&at("shared/link/b"), b"x", true).unwrap();
        }
        for absent in ["absent/a", "real/a/b"] {
            let failure = write(&at(absent), b"x", true).unwrap_err();
            assert!(
                failure.kind == Kind::Output && failure.hint.contains("directory must exist"),
                "{failure}"
            );
        }
        assert_eq!(
            write(Path::new("/"), b"x", true).unwrap_err().message,
            "cannot write /: it is a directory"
        );
    }
}
