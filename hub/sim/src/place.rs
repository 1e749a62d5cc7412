//! Where a simulated port is found: a symlink from the path that the user names to the pty, which has a number that
//! nobody can know. Refuses to touch anything but such a symlink.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use schema::{Failure, Kind};

/// A symlink to a pty that is gone when this is.
#[derive(Debug)]
pub(crate) struct Place {
    path: PathBuf,
    target: PathBuf,
}

impl Place {
    /// Makes `path` lead to `target`. A symlink to a terminal, or to nothing, is what a simulator that was killed
    /// left behind, and is replaced.
    pub(crate) fn new(path: &Path, target: &Path) -> Result<Place, Failure> {
        match fs::symlink_metadata(path) {
            Ok(there) if there.is_symlink() && is_left_behind(path) => {
                fs::remove_file(path).map_err(|error| failure(path, &error))?;
            }
            Ok(there) => {
                let kind = if there.is_symlink() { "a symlink to something else" } else { "no symlink" };
                return Err(Failure::new(
                    Kind::PortNotTty,
                    format!("port {} exists and is {kind}", path.display()),
                    "name a path that is free, or remove what is there",
                ));
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(failure(path, &error)),
        }
        std::os::unix::fs::symlink(target, path).map_err(|error| failure(path, &error))?;
        Ok(Place { path: path.to_owned(), target: target.to_owned() })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        // Another simulator may have taken the path in the meantime; then it is not ours to remove.
        if fs::read_link(&self.path).is_ok_and(|target| target == self.target) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

fn is_left_behind(path: &Path) -> bool {
    fs::read_link(path).is_ok_and(|target| target.starts_with("/dev/pts")) || !path.exists()
}

fn failure(path: &Path, error: &io::Error) -> Failure {
    let (kind, hint) = match error.kind() {
        io::ErrorKind::NotFound => (Kind::PortMissing, "its directory must exist"),
        io::ErrorKind::PermissionDenied => {
            (Kind::PortPermission, "name a path in a directory that this user may write to")
        }
        _ => (Kind::Failed, ""),
    };
    Failure::new(kind, format!("cannot make the symlink {}: {error}", path.display()), hint)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_a_simulator_left_behind_is_replaced() {
        let directory = std::env::temp_dir().join(format!("scanhub-place-{}", std::process::id()));
        fs::create_dir_all(&directory).unwrap();
        let path = directory.join("port");
        let link = || fs::read_link(&path).unwrap();

        drop(Place::new(&path, Path::new("/dev/pts/ptmx")).unwrap());
        assert!(fs::symlink_metadata(&path).is_err(), "not removed at the end");

        std::os::unix::fs::symlink("/nonexistent/tty", &path).unwrap();
        let place = Place::new(&path, Path::new("/dev/pts/ptmx")).unwrap();
        let second = Place::new(&path, Path::new("/dev/pts/0")).unwrap();
        drop(place);
        assert_eq!(link(), Path::new("/dev/pts/0"), "the second one's was removed");
        drop(second);

        std::os::unix::fs::symlink("/dev/null", &path).unwrap();
        let failure = Place::new(&path, Path::new("/dev/pts/0")).unwrap_err();
        assert_eq!(failure.kind, Kind::PortNotTty);
        fs::remove_file(&path).unwrap();
        fs::write(&path, "mine").unwrap();
        assert_eq!(Place::new(&path, Path::new("/dev/pts/0")).unwrap_err().kind.exit_code(), 4);
        assert_eq!(fs::read(&path).unwrap(), b"mine");
        let deep = directory.join("no/port");
        assert_eq!(Place::new(&deep, Path::new("/dev/pts/0")).unwrap_err().kind, Kind::PortMissing);
        fs::remove_dir_all(&directory).unwrap();
    }
}
