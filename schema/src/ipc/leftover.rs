//! What a hub leaves if it is killed while it creates a service: an unfinished description. The library waits for it
//! forever and cleans up only finished ones, so no later hub could create that service again.

use std::path::Path;

use crate::Directory;

/// Removes unfinished descriptions of the domain in `root`. Only for who holds the [`MakingLock`](crate::lock::MakingLock): then
/// nobody makes services, and one that is unfinished nobody has opened. Finished ones are read-only.
pub(super) fn sweep(root: &Path) {
    let Ok(Some(directory)) = Directory::open(root) else { return };
    let Some(services) = directory.below(SERVICES) else { return };
    for (name, stat) in services.entries() {
        let finished = stat.st_mode & 0o200 == 0;
        if !finished && name.to_string_lossy().ends_with(SUFFIX) {
            services.remove(&name);
        }
    }
}

/// Where the library puts them, below the root.
const SERVICES: &str = "services";

const SUFFIX: &str = ".service";
