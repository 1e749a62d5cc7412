//! Small text files that a domain keeps across restarts, only for this user. Each is replaced as a whole: a crash leaves the
//! old file or the new one. The reader checks the content, which may come from another version or be missing. Losing a
//! file only costs time.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::{self, Read};
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

use scanhub_schema::{Failure, Kind};

use crate::directory::Directory;
use crate::domain::first_path;

/// The directory of a domain's files: `$STATE_DIRECTORY/DOMAIN`, else `$XDG_STATE_HOME/scanhub/DOMAIN`, else
/// `~/.local/state/scanhub/DOMAIN`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StateDirectory {
    path: PathBuf,
}

impl StateDirectory {
    /// Returns where the directories of all domains are, as the environment of this process says: what systemd made for the
    /// service, else the user's own. `None` if it names no place.
    pub fn base() -> Option<PathBuf> {
        base_in(|name| std::env::var_os(name))
    }

    /// Returns the directory of `domain`; `None` as for [`base`](Self::base). It need not be there.
    pub fn of_domain(domain: &str) -> Option<StateDirectory> {
        Some(StateDirectory::at(StateDirectory::base()?.join(domain)))
    }

    /// Returns the directory `path`, which need not be there.
    pub fn at(path: impl Into<PathBuf>) -> StateDirectory {
        StateDirectory { path: path.into() }
    }

    /// Returns where file `name` is, or would be.
    pub fn path(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// Checks that the directory can be used, if it exists.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] with owner and remedy. It, or the directory above it, belongs to another user or can be written to by
    /// others. Or it is reached by a link that another user could have made.
    pub fn check(&self) -> Result<(), Failure> {
        self.open().map(drop)
    }

    /// Returns what file `name` holds; `None` if there is none.
    ///
    /// # Errors
    ///
    /// Those of [`check`](Self::check), and [`Kind::Failed`] if the file cannot be read, is not a regular file of this user that
    /// no other user can write, has more than `most` bytes, or is not UTF-8.
    pub fn read(&self, name: &str, most: u64) -> Result<Option<String>, Failure> {
        let Some(directory) = self.open()? else { return Ok(None) };
        let Some(file) = directory.file(name)? else { return Ok(None) };
        read(&file, most).map(Some).map_err(|error| {
            let what = format!("cannot use {}: {error}", self.path(name).display());
            Failure::new(Kind::Failed, what, "delete it; its content is learned again")
        })
    }

    /// Replaces the content of file `name`, mode 0600, by `text`; creates the directory, mode 0700, if it does not exist.
    /// It waits for the disk, so do not call it in a thread that reads a line.
    ///
    /// # Errors
    ///
    /// Those of [`check`](Self::check), and [`Kind::Failed`] if it cannot be written; then what the file held is still there.
    pub fn write(&self, name: &str, text: &str) -> Result<(), Failure> {
        self.make()?.replace(name, text.as_bytes()).map_err(unkept)
    }

    /// Waits until no other process is between reading and writing file `name`; they wait for us until what is returned is
    /// dropped. Creates the directory as [`write`](Self::write) does, and the file that is locked.
    ///
    /// # Errors
    ///
    /// Those of [`write`](Self::write).
    pub fn lock(&self, name: &str) -> Result<File, Failure> {
        let name = format!("{name}.lock");
        let file = self.make()?.file_or_new(&name).map_err(unkept)?;
        let locked = file.lock().map(|()| file);
        locked.map_err(|error| {
            let what = format!("cannot lock {}: {error}", self.path(&name).display());
            Failure::new(Kind::Failed, what, "the file system must have locks")
        })
    }

    /// Removes file `name`, if it is there.
    ///
    /// # Errors
    ///
    /// Those of [`check`](Self::check), and [`Kind::Failed`] if it stays.
    pub fn remove(&self, name: &str) -> Result<(), Failure> {
        let Some(directory) = self.open()? else { return Ok(()) };
        directory.try_remove(OsStr::new(name)).map_err(|error| {
            let message = format!("{}: an old file stays: {error}", self.path(name).display());
            Failure::new(Kind::Failed, message, "remove the file")
        })
    }

    fn open(&self) -> Result<Option<Directory>, Failure> {
        Directory::open_state(&self.path, OWN)
    }

    fn make(&self) -> Result<Directory, Failure> {
        Directory::make_state(&self.path, OWN).map_err(unkept)
    }
}

/// The directory of the domain, and the one of all domains above it.
const OWN: usize = 2;

/// Puts before the message that nothing can be kept.
fn unkept(failure: Failure) -> Failure {
    Failure { message: format!("nothing can be kept: {}", failure.message), ..failure }
}

fn base_in(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let path = |name| variable(name).and_then(first_path);
    let user = || path("XDG_STATE_HOME").or_else(|| Some(path("HOME")?.join(".local/state")));
    path("STATE_DIRECTORY").or_else(|| Some(user()?.join("scanhub")))
}

fn read(file: &File, most: u64) -> io::Result<String> {
    check(file)?;
    let mut text = String::new();
    let len = file.take(most + 1).read_to_string(&mut text)?;
    if len as u64 > most { Err(refused(format!("it has more than {most} bytes"))) } else { Ok(text) }
}

fn check(file: &File) -> io::Result<()> {
    let metadata = file.metadata()?;
    let (owner, mode) = (metadata.uid(), metadata.mode() & 0o7777);
    if mode & 0o022 != 0 {
        return Err(refused(format!("others can write it: owner {owner}, mode {mode:04o}")));
    }
    Ok(())
}

fn refused(what: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::{PermissionsExt, symlink};
    use std::path::Path;

    use tempfile::TempDir;

    use super::*;

    /// Path of a directory that does not exist yet, below a temporary one.
    struct Place(PathBuf, #[expect(dead_code, reason = "it is removed when it is dropped")] TempDir);

    impl Place {
        fn new() -> (Place, StateDirectory) {
            let parent = TempDir::new().unwrap();
            let path = parent.path().join("a");
            (Place(path.clone(), parent), StateDirectory::at(path))
        }
    }

    fn mode(path: &Path) -> u32 {
        fs::metadata(path).unwrap().mode() & 0o7777
    }

    #[test]
    fn the_environment_says_where() {
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
    fn what_was_written_is_read_by_this_user_alone() {
        let (place, state) = Place::new();
        assert_eq!(state.read("f", 9), Ok(None));
        for text in ["first", "second", ""] {
            state.write("f", text).unwrap();
            assert_eq!(state.read("f", 6), Ok(Some(text.to_owned())));
            assert_eq!((mode(&place.0), mode(&state.path("f"))), (0o700, 0o600));
        }
        assert_eq!(fs::read_dir(&place.0).unwrap().count(), 1, "nothing is left beside it");
    }

    #[test]
    fn what_a_crash_left_is_replaced() {
        let (place, state) = Place::new();
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
    fn what_is_not_ours_is_not_believed() {
        let (place, state) = Place::new();
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
        refused(&state, "directory", "no regular file");
        fs::set_permissions(state.path("f"), fs::Permissions::from_mode(0o620)).unwrap();
        refused(&state, "f", "mode 0620");
        drop(place);
    }

    #[test]
    fn where_nothing_can_be_written_the_remedy_is_told() {
        let state = StateDirectory::at("/dev/null/x");
        let failures = [state.read("f", 9).map(drop).unwrap_err(), state.write("f", "text").unwrap_err()];
        let [_, failure] = failures;
        assert!(failure.message.contains("nothing can be kept: /dev/null"), "{failure}");
        assert!(failure.hint.contains("STATE_DIRECTORY"), "{failure}");
    }

    #[test]
    fn a_name_that_is_taken_by_a_directory_stays_as_it_is() {
        let (place, state) = Place::new();
        fs::create_dir_all(state.path("f").join("full")).unwrap();
        state.write("f", "text").unwrap_err();
        assert_eq!(fs::read_dir(&place.0).unwrap().count(), 1, "nothing is left beside it");
    }
}
