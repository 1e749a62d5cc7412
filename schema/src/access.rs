//! Why shared memory cannot be used, in the words of its users: whose directory it is, with which mode, and what to
//! do. The shared-memory library itself says no more than "internal error".

use std::os::unix::fs::MetadataExt;
use std::path::Path;

use crate::{Failure, Kind, shortage};

/// A failure at the domain in `root`: as denied access with owner, mode and remedy if the directory is another
/// user's, as a shortage if there is one, else `what` happened.
pub(crate) fn failure(root: &Path, what: impl Into<String>) -> Failure {
    match foreign(root).or_else(|| shortage::found(root)) {
        Some(failure) => failure,
        None => Failure::new(Kind::Failed, what, "IOX2_LOG_LEVEL=debug shows what the shared memory says"),
    }
}

/// The failure to speak of if `root`, or the nearest directory above that exists, may not be used by this user.
pub(crate) fn foreign(root: &Path) -> Option<Failure> {
    foreign_to(rustix::process::getuid().as_raw(), root)
}

fn foreign_to(uid: u32, root: &Path) -> Option<Failure> {
    let (path, metadata) = root.ancestors().find_map(|path| Some((path, path.metadata().ok()?)))?;
    let (owner, mode) = (metadata.uid(), metadata.mode() & 0o7777);
    let other_may_enter = path != root && mode & 0o001 != 0;
    if owner == uid || other_may_enter {
        return None;
    }
    Some(Failure::new(
        Kind::Failed,
        format!("{} belongs to user {owner} with mode {mode:04o}, this is user {uid}", path.display()),
        "shared memory is for one user: run as that user, choose another --root, or take a pipe from that user's `scanhub echo --json`",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_of_another_user_is_named_with_owner_and_mode() {
        let base = std::env::temp_dir().join(format!("sha{}", std::process::id()));
        std::fs::create_dir(&base).unwrap();
        std::fs::set_permissions(&base, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
        let own = rustix::process::getuid().as_raw();
        let (root, domain) = (foreign_to(own + 1, &base), foreign_to(own + 1, &base.join("domain")));
        let (mine, shared) =
            (foreign_to(own, &base), foreign_to(own + 1, Path::new("/tmp/there-is-no-such-place")));
        std::fs::remove_dir(&base).unwrap();
        for failure in [root.unwrap(), domain.unwrap()] {
            let said =
                format!("{} belongs to user {own} with mode 0700, this is user {}", base.display(), own + 1);
            assert_eq!(failure.message, said);
            assert!(failure.hint.contains("a pipe from that user's `scanhub echo --json`"), "{failure}");
        }
        assert_eq!((mine, shared), (None, None));
    }
}
