//! The machine's own files, below a directory that need not be the root of this machine, so that tests can provide
//! files of an administrator.

use std::fs;
use std::path::{Path, PathBuf};

use rustix::process::getuid;
use scanhub_files::regular;

/// The files of a machine, and the user that reads them.
#[derive(Clone, Debug)]
pub struct System {
    root: PathBuf,
    user: u32,
}

impl System {
    /// Returns this machine, and the user of this process.
    pub fn this() -> System {
        System::at("/", getuid().as_raw())
    }

    /// Creates a machine whose files are below `root`, for the user with this ID.
    pub fn at(root: impl Into<PathBuf>, user: u32) -> System {
        System { root: root.into(), user }
    }

    /// Returns the user's ID.
    pub(crate) fn user(&self) -> u32 {
        self.user
    }

    /// Returns the path at which this process finds `path` of that machine.
    pub(crate) fn path(&self, path: impl AsRef<Path>) -> PathBuf {
        let path = path.as_ref();
        self.root.join(path.strip_prefix("/").unwrap_or(path))
    }

    /// Returns the text of a file, or `None` if it cannot be read.
    pub(crate) fn text(&self, path: &str) -> Option<String> {
        regular::read_text(&self.path(path), regular::LONGEST).ok()
    }

    /// Returns the path of `name` in the first of `directories` that has it. A symlink without a target counts.
    pub(crate) fn first(&self, directories: &[&str], name: &str) -> Option<PathBuf> {
        let paths = directories.iter().map(|directory| self.path(directory).join(name));
        paths.into_iter().find(|path| path.symlink_metadata().is_ok())
    }

    /// Returns the files of `directories` whose names end with `.conf`, in the order of their names. If several files
    /// have the same name, only that of the first directory counts (as systemd reads drop-in files).
    pub(crate) fn drop_ins(&self, directories: &[String]) -> Vec<PathBuf> {
        let mut found: Vec<PathBuf> = Vec::new();
        for directory in directories {
            for entry in fs::read_dir(self.path(directory)).into_iter().flatten().flatten() {
                let path = entry.path();
                let is_known = found.iter().any(|known| known.file_name() == path.file_name());
                if !is_known && path.extension().is_some_and(|extension| extension == "conf") {
                    found.push(path);
                }
            }
        }
        found.sort_by(|a, b| a.file_name().cmp(&b.file_name()));
        found
    }

    /// Returns the name of the user with this ID, or the ID if the user has no name.
    pub(crate) fn name_of(&self, user: u32) -> String {
        let known = self.text("etc/passwd").unwrap_or_default();
        let number = user.to_string();
        let line = known.lines().find(|line| line.split(':').nth(2) == Some(&number));
        line.and_then(|line| line.split(':').next()).map_or(number, str::to_owned)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Files below a temporary directory.
    pub(crate) struct TempRoot {
        root: PathBuf,
        _directory: tempfile::TempDir,
        pub(crate) system: System,
    }

    impl TempRoot {
        /// Creates `files` from paths and contents, for `user`.
        pub(crate) fn new(user: u32, files: &[(&str, &str)]) -> TempRoot {
            let directory = tempfile::tempdir().unwrap();
            let root = directory.path().canonicalize().unwrap();
            let temp = TempRoot { system: System::at(&root, user), root, _directory: directory };
            for (path, content) in files {
                temp.put(path, content);
            }
            temp
        }

        pub(crate) fn put(&self, path: &str, content: &str) {
            let path = self.path(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, content).unwrap();
        }

        pub(crate) fn link(&self, target: &str, path: &str) {
            let path = self.path(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::os::unix::fs::symlink(target, path).unwrap();
        }

        pub(crate) fn path(&self, path: &str) -> PathBuf {
            self.root.join(path)
        }
    }

    #[test]
    fn uses_first_of_files_with_same_name() {
        let files =
            [("etc/x.d/b.conf", "1"), ("usr/x.d/b.conf", "2"), ("usr/x.d/a.conf", "3"), ("etc/x.d/c", "4")];
        let temp = TempRoot::new(7, &files);
        let found = temp.system.drop_ins(&["etc/x.d".to_owned(), "usr/x.d".to_owned()]);
        assert_eq!(found, [temp.path("usr/x.d/a.conf"), temp.path("etc/x.d/b.conf")]);
    }

    #[test]
    fn returns_name_of_user() {
        let temp = TempRoot::new(7, &[("etc/passwd", "root:x:0:0::/:\nrobot:x:7:7::/:\n")]);
        assert_eq!([7, 8].map(|user| temp.system.name_of(user)), ["robot", "8"]);
    }
}
