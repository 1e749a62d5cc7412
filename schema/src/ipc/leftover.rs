//! What a hub leaves that is killed while it makes a service: a description that was never finished. The library waits
//! for it forever and cleans up finished ones only, so that no later hub could make that service again.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Removes unfinished descriptions below `directory`. Only for who holds the [`MakingLock`](crate::lock::MakingLock): then
/// nobody makes services, and one that is unfinished nobody has opened. Finished ones are read-only.
pub(super) fn sweep(directory: &Path) {
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        let finished = entry.metadata().is_ok_and(|metadata| metadata.permissions().mode() & 0o200 == 0);
        if !finished && entry.file_name().to_string_lossy().ends_with(SUFFIX) {
            let _ = fs::remove_file(entry.path());
        }
    }
}

const SUFFIX: &str = ".service";
