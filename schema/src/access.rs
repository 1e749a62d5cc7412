//! Why shared memory cannot be used, in the words of its users: whose directory it is, with which mode, and what to
//! do. The shared-memory library itself says no more than "internal error".

use std::os::unix::fs::MetadataExt;
use std::path::Path;

use crate::{Failure, Kind};

/// A failure at the domain in `root`: as denied access with owner, mode and remedy if the directory is another
/// user's, else `what` happened.
pub(crate) fn failure(root: &Path, what: impl Into<String>) -> Failure {
    match foreign(root) {
        Some(failure) => failure,
        None => Failure::new(Kind::Failed, what, "IOX2_LOG_LEVEL=debug shows what the shared memory says"),
    }
}

/// The failure to speak of if `root`, or the nearest directory above that exists, may not be used by this user.
pub(crate) fn foreign(root: &Path) -> Option<Failure> {
    let uid = rustix::process::getuid().as_raw();
    let (path, metadata) = root.ancestors().find_map(|path| Some((path, path.metadata().ok()?)))?;
    let (owner, mode) = (metadata.uid(), metadata.mode() & 0o7777);
    let other_may_enter = path != root && mode & 0o001 != 0;
    if owner == uid || other_may_enter {
        return None;
    }
    Some(Failure::new(
        Kind::Failed,
        format!("{} belongs to user {owner} with mode {mode:04o}, this is user {uid}", path.display()),
        "shared memory is for one user: run as that user, choose another --root, or take `scanhub listen` or a pipe",
    ))
}
