//! Files in shared memory that have a domain's names but belong to other users, or can be written by others. Looks at
//! names, owners and modes; opens nothing. The owner is reported to the user, who can have them removed.

use std::fs::Metadata;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::directory::named;
use crate::shortage::SHARED_MEMORY;
use crate::{Failure, Kind, prefix};

/// A file in shared memory as it is: links are not followed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Where it is.
    pub path: PathBuf,
    /// The number of its owner.
    pub owner: u32,
    /// Permission bits.
    pub mode: u32,
    /// Its length.
    pub bytes: u64,
    is_file: bool,
}

impl Segment {
    /// Returns a file at `path` with these properties.
    pub fn new(path: impl Into<PathBuf>, owner: u32, mode: u32, bytes: u64) -> Segment {
        Segment { path: path.into(), owner, mode, bytes, is_file: true }
    }

    pub(super) fn at(path: &Path) -> Option<Segment> {
        Some(Segment::of(path, &path.symlink_metadata().ok()?))
    }

    pub(super) fn of(path: &Path, metadata: &Metadata) -> Segment {
        Segment {
            path: path.to_owned(),
            owner: metadata.uid(),
            mode: metadata.mode() & 0o7777,
            bytes: metadata.len(),
            is_file: metadata.is_file(),
        }
    }

    /// It is a file of this user.
    pub(super) fn is_own(&self) -> bool {
        self.owner == rustix::process::geteuid().as_raw() && self.is_file
    }

    /// It is no file of this user, or others may write to it.
    pub(super) fn is_foreign(&self) -> bool {
        !self.is_own() || self.mode & 0o022 != 0
    }
}

/// Returns what stands under the names of the domain in `root` and is not this user's alone, sorted; nothing where the domain
/// has no names.
pub fn strangers(root: &Path) -> Vec<Segment> {
    let Ok(Some(prefix)) = prefix::of(root) else { return Vec::new() };
    let entries = std::fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
    let named = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix));
    let mut found: Vec<_> =
        named.filter_map(|entry| Segment::at(&entry.path())).filter(Segment::is_foreign).collect();
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

/// What to say of `segment` to who needs its name.
pub(crate) fn in_the_way(segment: &Segment) -> Failure {
    let (path, owner, mode) = (segment.path.display(), named(segment.owner), segment.mode);
    let is_file = if segment.is_file { "" } else { " and is no file" };
    Failure::new(
        Kind::Failed,
        format!(
            "{path} belongs to user {owner} with mode {mode:04o}{is_file}: it is in the way, and is not opened"
        ),
        format!(
            "let user {owner} or an administrator remove it (sudo rm {path}), or choose another --domain"
        ),
    )
}
