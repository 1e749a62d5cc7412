//! The machine's own files, as the doctor reads them: below a directory that need not be the root of this machine, so that
//! tests can provide what an administrator may have written. Refuses to know what is in them.

use std::fs;
use std::path::{Path, PathBuf};

use rustix::process::getuid;
use schema::regular;

/// The files of a machine, and the user that reads them.
#[derive(Clone, Debug)]
pub struct System {
    root: PathBuf,
    user: u32,
}

impl System {
    /// This machine, and the user of this process.
    pub fn this() -> System {
        System::at("/", getuid().as_raw())
    }

    /// A machine whose files are below `root`, for the user with this number.
    pub fn at(root: impl Into<PathBuf>, user: u32) -> System {
        System { root: root.into(), user }
    }

    /// The user's number.
    pub(crate) fn user(&self) -> u32 {
        self.user
    }

    /// Where `path` of that machine is.
    pub(crate) fn path(&self, path: impl AsRef<Path>) -> PathBuf {
        let path = path.as_ref();
        self.root.join(path.strip_prefix("/").unwrap_or(path))
    }

    /// What stands in a file, if it can be read.
    pub(crate) fn text(&self, path: &str) -> Option<String> {
        regular::read_text(&self.path(path), regular::LONGEST).ok()
    }

    /// `name` in the first of `directories` that has it, be it a symlink to nothing.
    pub(crate) fn first(&self, directories: &[&str], name: &str) -> Option<PathBuf> {
        let paths = directories.iter().map(|directory| self.path(directory).join(name));
        paths.into_iter().find(|path| path.symlink_metadata().is_ok())
    }

    /// The files of `directories` whose names end with `.conf`, in the order of their names; of one name the first
    /// directory has the only one that counts (systemd, for all that it reads so).
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

    /// The name of the user with this number, else the number.
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
    pub(crate) struct Laid {
        root: PathBuf,
        _directory: tempfile::TempDir,
        pub(crate) system: System,
    }

    impl Laid {
        /// `files` by path and content, looked at by `user`.
        pub(crate) fn out(user: u32, files: &[(&str, &str)]) -> Laid {
            let directory = tempfile::tempdir().unwrap();
            let root = directory.path().canonicalize().unwrap();
            let laid = Laid { system: System::at(&root, user), root, _directory: directory };
            for (path, content) in files {
                laid.put(path, content);
            }
            laid
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
    fn of_two_files_of_one_name_the_first_directorys_counts() {
        let files =
            [("etc/x.d/b.conf", "1"), ("usr/x.d/b.conf", "2"), ("usr/x.d/a.conf", "3"), ("etc/x.d/c", "4")];
        let laid = Laid::out(7, &files);
        let found = laid.system.drop_ins(&["etc/x.d".to_owned(), "usr/x.d".to_owned()]);
        assert_eq!(found, [laid.path("usr/x.d/a.conf"), laid.path("etc/x.d/b.conf")]);
    }

    #[test]
    fn users_have_names() {
        let laid = Laid::out(7, &[("etc/passwd", "root:x:0:0::/:\nrobot:x:7:7::/:\n")]);
        assert_eq!([7, 8].map(|user| laid.system.name_of(user)), ["robot", "8"]);
    }
}
