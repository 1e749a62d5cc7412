//! Removes what dead processes left in a domain, without a hub: their places in it, and the directory itself once nobody
//! uses it. Files in shared memory that did not belong to a known dead process are not touched.

use std::path::Path;
use std::time::Duration;

use rustix::fs::FileType;

use super::{forget, hub_node, nodes};
use crate::{Directory, Domain, Failure, HubLock, ListenLock};

/// What was removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cleaned {
    /// Processes that had ended without leaving.
    pub dead: usize,
    /// Processes that still run; nothing of theirs was removed.
    pub alive: usize,
    /// The domain's directory.
    pub root: bool,
}

/// Removes what dead processes left in `domain`. What running ones share with them stays, and so does the directory as
/// long as one of them runs.
///
/// # Errors
///
/// [`Kind::DomainHeld`](crate::Kind) if a hub or a listener publishes there, which tidies up by itself;
/// [`Kind::Failed`](crate::Kind) if the directory is another user's.
pub fn clean(domain: &Domain) -> Result<Cleaned, Failure> {
    let root = domain.root();
    let Some(directory) = Directory::open(root)? else { return Ok(Cleaned::default()) };
    // Nobody begins to publish meanwhile.
    let _hub = HubLock::acquire(root)?;
    let _listener = ListenLock::acquire(root)?;
    let before = nodes(domain)?;
    let node = hub_node(domain)?;
    node.blocking_cleanup_dead_nodes(PATIENCE);
    drop(node);
    let after = nodes(domain)?;
    let root = after.alive == 0 && after.dead == 0 && take_away(&directory, root);
    Ok(Cleaned { dead: before.dead.saturating_sub(after.dead), alive: after.alive, root })
}

/// Removes the domain's `directory` at `root` with what nobody needs who is not there: empty directories, locks, names, and
/// what a hub noted of its sensors for the next one. Whether all of it is gone; anything else in it stays.
fn take_away(directory: &Directory, root: &Path) -> bool {
    forget(directory, root);
    for (name, stat) in directory.entries() {
        let extension = Path::new(&name).extension();
        match FileType::from_raw_mode(stat.st_mode) {
            FileType::Directory => directory.remove_empty(&name),
            FileType::RegularFile if extension.is_some_and(|kind| kind == "lock" || kind == "sensor") => {
                directory.remove(&name);
            }
            _ => {}
        }
    }
    directory.remove_itself()
}

/// Of a dead process whose remains another one is just taking away.
const PATIENCE: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn what_is_not_a_domains_stays() {
        let base = tempfile::tempdir().unwrap();
        let root = base.path().join("a");
        let directory = Directory::make(&root).unwrap();
        fs::create_dir(root.join("nodes")).unwrap();
        symlink(root.join("full"), root.join("link.lock")).unwrap();
        fs::create_dir(root.join("full")).unwrap();
        for file in ["hub.lock", "front.sensor", "prefix", "full/something.lock", "letter"] {
            fs::write(root.join(file), "").unwrap();
        }
        assert!(!take_away(&directory, &root));
        let mut left: Vec<_> = fs::read_dir(&root).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["full", "letter", "link.lock"]);
        assert!(root.join("full/something.lock").exists());
        for file in ["link.lock", "letter", "full/something.lock"] {
            fs::remove_file(root.join(file)).unwrap();
        }
        assert!(take_away(&directory, &root) && !root.exists());
        assert!(take_away(&directory, &root), "it is gone already");
    }
}
