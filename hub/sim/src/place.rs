//! Where a simulated port is found: a symlink from the path that the user names to the pty, whose number is not known
//! before. Refuses to touch anything but such a symlink.

use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use schema::{Failure, Kind};

/// A symlink to a pty that is gone when this is.
#[derive(Debug)]
pub(crate) struct Place {
    path: PathBuf,
    target: PathBuf,
}

impl Place {
    /// Makes `path` lead to `target`. A symlink to nothing, or to a terminal that is younger than it, is what a simulator
    /// that was killed left behind, and is replaced.
    pub(crate) fn new(path: &Path, target: &Path) -> Result<Place, Failure> {
        match fs::symlink_metadata(path) {
            Ok(there) if there.is_symlink() && is_left_behind(path) => {
                fs::remove_file(path).map_err(|error| failure(path, &error))?;
            }
            Ok(there) if there.is_symlink() && is_terminal(path) => {
                return Err(Failure::new(
                    Kind::PortBusy,
                    format!("port {} belongs to another simulator, which still runs", path.display()),
                    "name another path, or end that one first",
                ));
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

/// A terminal that is there longer than the symlink is still that of who made it; else another one has its number now.
fn is_left_behind(path: &Path) -> bool {
    let (Ok(terminal), Ok(link)) = (fs::metadata(path), fs::symlink_metadata(path)) else { return true };
    let since = |metadata: &Metadata| (metadata.ctime(), metadata.ctime_nsec());
    is_terminal(path) && since(&terminal) > since(&link)
}

fn is_terminal(path: &Path) -> bool {
    fs::read_link(path).is_ok_and(|target| target.starts_with("/dev/pts"))
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
    use crate::pty::Pty;

    #[test]
    fn only_what_a_simulator_left_behind_is_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("port");
        let link = || fs::read_link(&path).unwrap();

        drop(Place::new(&path, Path::new("/dev/pts/ptmx")).unwrap());
        assert!(fs::symlink_metadata(&path).is_err(), "not removed at the end");

        std::os::unix::fs::symlink("/nonexistent/tty", &path).unwrap();
        let place = Place::new(&path, Path::new("/dev/pts/999998")).unwrap();
        let second = Place::new(&path, Path::new("/dev/pts/999999")).unwrap();
        drop(place);
        assert_eq!(link(), Path::new("/dev/pts/999999"), "the second one's was removed");
        drop(second);

        let [one, other] = [(); 2].map(|()| Pty::open().unwrap());
        let place = Place::new(&path, one.name()).unwrap();
        assert_eq!(Place::new(&path, other.name()).unwrap_err().kind, Kind::PortBusy);
        assert_eq!(link(), one.name(), "it was taken away from who has it");
        drop(place);

        // The simulator was killed, and a younger terminal has its number: one whose change is later.
        std::os::unix::fs::symlink(one.name(), &path).unwrap();
        let since = |metadata: Metadata| (metadata.ctime(), metadata.ctime_nsec());
        let made = since(fs::symlink_metadata(&path).unwrap());
        while since(fs::metadata(one.name()).unwrap()) <= made {
            fs::set_permissions(one.name(), fs::metadata(one.name()).unwrap().permissions()).unwrap();
        }
        drop(Place::new(&path, other.name()).unwrap());

        std::os::unix::fs::symlink("/dev/null", &path).unwrap();
        let failure = Place::new(&path, Path::new("/dev/pts/0")).unwrap_err();
        assert_eq!(failure.kind, Kind::PortNotTty);
        fs::remove_file(&path).unwrap();
        fs::write(&path, "mine").unwrap();
        assert_eq!(Place::new(&path, Path::new("/dev/pts/0")).unwrap_err().kind.exit_code(), 4);
        assert_eq!(fs::read(&path).unwrap(), b"mine");
        let deep = directory.path().join("no/port");
        assert_eq!(Place::new(&deep, Path::new("/dev/pts/0")).unwrap_err().kind, Kind::PortMissing);
    }
}
