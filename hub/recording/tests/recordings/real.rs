//! Folder with recordings of real sensors, which are not part of the project.

use std::path::PathBuf;

use crate::skip::skip;

/// Returns the folder that SCANHUB_DATA names, or the default folder. If the folder does not exist, reports that the
/// calling test is skipped, and returns `None`.
pub(crate) fn recordings() -> Option<PathBuf> {
    let data = std::env::var_os("SCANHUB_DATA").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data")),
        PathBuf::from,
    );
    if !data.is_dir() {
        skip("recordings", format!("none at {}", data.display()));
        return None;
    }
    Some(data)
}
