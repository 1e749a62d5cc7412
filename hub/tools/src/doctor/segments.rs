//! Files in shared memory that nobody uses any more. Their names contain only a domain's name, and a hub at another root
//! may have the same: a file that a process still holds is never counted.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

use schema::ipc::is_unheld;
use schema::shortage::SHARED_MEMORY;

/// A file in shared memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Segment {
    pub(crate) path: PathBuf,
    pub(crate) bytes: u64,
}

/// Files of `user` in shared memory whose names begin with `prefix`.
pub(crate) fn files(prefix: &str, user: u32) -> Vec<Segment> {
    let entries = fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
    let named = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix));
    let mut files: Vec<Segment> = named
        .filter_map(|entry| Some((entry.path(), entry.metadata().ok()?)))
        .filter(|(_, metadata)| metadata.uid() == user)
        .map(|(path, metadata)| Segment { path, bytes: metadata.len() })
        .collect();
    files.sort_by(|a, b| a.path.cmp(&b.path));
    files
}

/// Those of them that no process has open or mapped. The library's lock is never held open: it is that of whoever holds
/// another file whose name begins like its own, in a domain of this name at another place.
pub(crate) fn unheld(prefix: &str, user: u32) -> Vec<Segment> {
    let files = files(prefix, user);
    let (free, held): (Vec<_>, Vec<_>) = files.into_iter().partition(|file| is_unheld(&file.path));
    let domain = |file: &Segment| {
        let name = file.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        name.get(..prefix.len() + RANDOM).map(str::to_owned)
    };
    let is_used = |file: &Segment| held.iter().any(|other| domain(other) == domain(file));
    free.into_iter().filter(|file| file.bytes > ALWAYS_LEFT || !is_used(file)).collect()
}

/// Those of them that are worth a word: each end of a hub leaves a very short one.
pub(crate) fn abandoned(prefix: &str, user: u32) -> Vec<Segment> {
    let mut files = files(prefix, user);
    files.retain(|file| file.bytes > ALWAYS_LEFT && is_unheld(&file.path));
    files
}

/// The lock of the library's, if it alone is there. It is never held open: beside others it is that of a hub that lives.
pub(crate) fn lock(prefix: &str, user: u32) -> Option<PathBuf> {
    let files = files(prefix, user);
    let is_alone = files.iter().all(|file| file.bytes <= ALWAYS_LEFT);
    files.into_iter().map(|file| file.path).find(|path| is_alone && is_unheld(path))
}

/// Letters that the names of each domain have behind its own name (docs/topics.md, "Domain").
const RANDOM: usize = 6;
/// One lock of the library's is never removed, and has 16 bytes.
const ALWAYS_LEFT: u64 = 16;

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::time::{Duration, Instant};

    use super::*;

    /// Waits until no process has `path` open: a child that another test starts has a copy of all descriptors for a moment.
    fn await_unheld(prefix: &str, user: u32, path: &Path) {
        let give_up_at = Instant::now() + Duration::from_secs(60);
        while !unheld(prefix, user).iter().any(|file| file.path == path) {
            assert!(Instant::now() < give_up_at, "{} is still open", path.display());
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_file_counts_once_nobody_holds_it_and_for_its_owner_alone() {
        let prefix = format!("sh_segments-{}_", std::process::id());
        let path = PathBuf::from(format!("{SHARED_MEMORY}/{prefix}a"));
        let file = fs::File::create_new(&path).unwrap();
        file.set_len(64).unwrap();
        let user = file.metadata().unwrap().uid();
        let open = abandoned(&prefix, user);
        drop(file);
        await_unheld(&prefix, user, &path);
        let short = PathBuf::from(format!("{SHARED_MEMORY}/{prefix}b"));
        fs::write(&short, "16 bytes are few").unwrap();
        let beside = lock(&prefix, user);
        let of_one_that_lives = {
            let other = [format!("{prefix}abcde_data"), format!("{prefix}abcde_lock")];
            let [data, counter] = other.map(|name| PathBuf::from(format!("{SHARED_MEMORY}/{name}")));
            let held = fs::File::create_new(&data).unwrap();
            held.set_len(64).unwrap();
            fs::write(&counter, "16 bytes are few").unwrap();
            let is_spared = !unheld(&prefix, user).iter().any(|file| file.path == counter);
            drop(held);
            await_unheld(&prefix, user, &data);
            let is_left = unheld(&prefix, user).iter().any(|file| file.path == counter);
            [data, counter].iter().for_each(|path| fs::remove_file(path).unwrap());
            (is_spared, is_left)
        };
        let (closed, other) = (abandoned(&prefix, user), abandoned(&prefix, user + 1));
        let all = (files(&prefix, user).len(), unheld(&prefix, user).len());
        fs::remove_file(&path).unwrap();
        assert_eq!((beside, lock(&prefix, user)), (None, Some(short.clone())));
        fs::remove_file(&short).unwrap();
        assert_eq!((open, other), (Vec::new(), Vec::new()));
        assert_eq!(closed, [Segment { path, bytes: 64 }]);
        assert_eq!(all, (2, 2));
        assert_eq!(of_one_that_lives, (true, true));
    }
}
