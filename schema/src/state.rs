//! What a domain keeps across restarts: small text files that are replaced as a whole, only for this user. A crash leaves
//! the old file or the new one. The reader checks the content: it may come from another version, or be missing. Refuses to
//! know what the files contain; losing them only costs time.

use std::ffi::OsString;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;

use crate::domain::first_path;
use crate::{Failure, Kind};

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

    /// Returns what file `name` holds; `None` if there is none.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if it cannot be read, is not a plain file of this user that nobody else can write, has more than
    /// `most` bytes, or is not UTF-8.
    pub fn read(&self, name: &str, most: u64) -> Result<Option<String>, Failure> {
        let path = self.path(name);
        match read(&path, most) {
            Ok(text) => Ok(Some(text)),
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(None),
            Err(error) => Err(Failure::new(
                Kind::Failed,
                format!("cannot use {}: {error}", path.display()),
                "delete it; its content is learned again",
            )),
        }
    }

    /// Replaces the content of file `name`, mode 0600, by `text`; creates the directory, mode 0700, if it does not exist.
    /// It waits for the disk, so do not call it in a thread that reads a line.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if that is not possible; then what the file held is still there.
    pub fn write(&self, name: &str, text: &str) -> Result<(), Failure> {
        self.replace(name, text).map_err(|error| self.unusable(name, &error))
    }

    /// Waits until no other process is between reading and writing file `name`; they wait for us until what is returned is
    /// dropped. Creates the directory as [`write`](Self::write) does, and beside the file one that is locked.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if that is not possible.
    pub fn lock(&self, name: &str) -> Result<File, Failure> {
        let lock = || {
            self.make()?;
            let mut options = OpenOptions::new();
            let options = options.write(true).create(true).truncate(false).mode(0o600);
            let file = options
                .custom_flags((OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32)
                .open(self.path(&format!("{name}.lock")))?;
            file.lock().map(|()| file)
        };
        lock().map_err(|error| self.unusable(name, &error))
    }

    /// Removes file `name`, if it is there.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if it stays.
    pub fn remove(&self, name: &str) -> Result<(), Failure> {
        let path = self.path(name);
        match fs::remove_file(&path) {
            Err(error) if !matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
                let message = format!("{}: an old file stays: {error}", path.display());
                Err(Failure::new(Kind::Failed, message, "remove the file"))
            }
            _ => Ok(()),
        }
    }

    fn make(&self) -> io::Result<()> {
        DirBuilder::new().recursive(true).mode(0o700).create(&self.path)
    }

    fn unusable(&self, name: &str, error: &io::Error) -> Failure {
        let what = format!("cannot keep {}: {error}", self.path(name).display());
        Failure::new(Kind::Failed, what, "set STATE_DIRECTORY or XDG_STATE_HOME to a directory of this user")
    }

    fn replace(&self, name: &str, text: &str) -> io::Result<()> {
        self.make()?;
        let beside = self.path(&format!("{name}.new"));
        // One that a crash left may have another mode, or lead elsewhere.
        match fs::remove_file(&beside) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&beside)?;
        let written = file.write_all(text.as_bytes()).and_then(|()| file.sync_data());
        let renamed = written.and_then(|()| fs::rename(&beside, self.path(name)));
        if renamed.is_err() {
            let _ = fs::remove_file(&beside);
        }
        renamed
    }
}

fn base_in(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let path = |name| variable(name).and_then(first_path);
    let user = || path("XDG_STATE_HOME").or_else(|| Some(path("HOME")?.join(".local/state")));
    path("STATE_DIRECTORY").or_else(|| Some(user()?.join("scanhub")))
}

fn read(path: &Path, most: u64) -> io::Result<String> {
    // A FIFO would be waited for.
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
    let file = OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    check(&file)?;
    let mut text = String::new();
    let len = file.take(most + 1).read_to_string(&mut text)?;
    if len as u64 > most { Err(refused(format!("it has more than {most} bytes"))) } else { Ok(text) }
}

fn check(file: &File) -> io::Result<()> {
    let metadata = file.metadata()?;
    let (owner, mode) = (metadata.uid(), metadata.mode() & 0o7777);
    if !metadata.is_file() {
        return Err(refused("it is no file".into()));
    }
    if owner != rustix::process::geteuid().as_raw() || mode & 0o022 != 0 {
        return Err(refused(format!("others can write it: owner {owner}, mode {mode:04o}")));
    }
    Ok(())
}

fn refused(what: String) -> io::Error {
    io::Error::new(ErrorKind::InvalidData, what)
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;

    use super::*;
    use std::os::unix::fs::{PermissionsExt, symlink};

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
            assert!(failure.hint.contains("delete it"), "{failure}");
        };
        fs::write(state.path("long"), "123456").unwrap();
        refused(&state, "long", "more than 5 bytes");
        fs::write(state.path("binary"), [0xff]).unwrap();
        refused(&state, "binary", "UTF-8");
        symlink(state.path("f"), state.path("link")).unwrap();
        refused(&state, "link", "");
        fs::create_dir(state.path("directory")).unwrap();
        refused(&state, "directory", "no file");
        fs::set_permissions(state.path("f"), fs::Permissions::from_mode(0o620)).unwrap();
        refused(&state, "f", "mode 0620");
        drop(place);
    }

    #[test]
    fn where_nothing_can_be_written_the_remedy_is_told() {
        let state = StateDirectory::at("/dev/null/x");
        assert_eq!(state.read("f", 9), Ok(None));
        let failure = state.write("f", "text").unwrap_err();
        assert!(failure.message.contains("/dev/null/x/f"), "{failure}");
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
