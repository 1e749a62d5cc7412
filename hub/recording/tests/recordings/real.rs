//! Recordings of real sensors, which are no part of the project: where they are, if they are there.

use std::path::PathBuf;

use crate::skip::skip;

/// Their folder, as SCANHUB_DATA names it; without one the test that asks is skipped, which is said.
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
