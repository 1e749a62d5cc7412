//! Why shared memory cannot be used, in the words of its users: whose directory or file it is, with which mode, and what
//! to do. The shared-memory library itself says no more than "internal error".

use std::path::Path;

use crate::ipc::{in_the_way, strangers};
use crate::{Directory, Failure, Kind, shortage};

/// A failure at the domain in `root`: another user's directory or file that is in the way, with owner, mode and remedy;
/// else a shortage if there is one; else `what` happened.
pub(crate) fn failure(root: &Path, what: impl Into<String>) -> Failure {
    let directory = Directory::open(root).err();
    directory
        .or_else(|| shortage::found(root))
        .or_else(|| strangers(root).first().map(in_the_way))
        .unwrap_or_else(|| {
            Failure::new(
                Kind::Failed,
                what,
                "IOX2_LOG_LEVEL=debug shows the messages of the shared-memory library",
            )
        })
}
