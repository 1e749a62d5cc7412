//! Checks the files of a domain in shared memory, and removes those that dead processes left. The next hub also removes
//! such files, if they are certainly its own. If no hub starts at this location again, only this module removes the
//! files.
//!
//! The names of the files contain the name of the domain but not its location. A hub at another location may use the
//! same name. Files that a process still holds are therefore never counted as left. Files of other users under these
//! names are never opened, but they can prevent the start of the hub.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

use scanhub_schema::{Failure, Kind};
use scanhub_shm::Domain;
use scanhub_shm::resource_limits::SHARED_MEMORY_DIRECTORY;
use scanhub_shm::{CleanupReport, Segment, is_unused};

use super::Finding;
use super::machine::{MachineState, plural};

/// A file in shared memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SharedFile {
    pub(crate) path: PathBuf,
    /// Length in bytes.
    pub(crate) bytes: u64,
}

/// Checks whether dead processes left anything.
pub(crate) fn leftovers(state: &MachineState) -> Finding {
    const NAME: &str = "leftovers";
    let nodes = match &state.nodes {
        Ok(nodes) => nodes,
        Err(failure) => return Finding::failed(NAME, failure.message.clone(), failure.hint.clone()),
    };
    let files = describe(&state.segments);
    match (state.hub_pid(), nodes.dead, nodes.alive) {
        (Some(_), 0, _) => Finding::ok(NAME, "none"),
        (Some(_), dead, _) => {
            Finding::ok(NAME, format!("{} died; the hub is cleaning up", plural(dead as u64, "process")))
        }
        (None, 0, 0) if state.segments.is_empty() => match &state.lock {
            None => Finding::ok(NAME, "none"),
            Some(lock) => {
                let text = format!("none but {}, a lock of 16 bytes that the next hub takes", lock.display());
                Finding::ok(NAME, text)
            }
        },
        (None, 0, alive) if alive > 0 => {
            Finding::ok(NAME, format!("none; {} waiting for a hub", plural(alive as u64, "subscriber")))
        }
        (None, 0, _) => {
            Finding::warning(NAME, format!("no process holds {files}"), "scanhub doctor --clean removes them")
        }
        (None, dead, _) => Finding::warning(
            NAME,
            format!("{} died without a hub to clean up; {files}", plural(dead as u64, "process")),
            format!(
                "scanhub doctor --clean removes it; so does the next `scanhub run` at {}",
                state.root.display()
            ),
        ),
    }
}

/// Removes everything that dead processes of `user` left in this domain, at all of its `locations`, and reports it. Has
/// no effect while a hub or a listener runs at one of these locations.
pub(crate) fn clean(locations: &[&Domain], user: u32) -> Finding {
    const NAME: &str = "clean";
    let Some(prefix) = locations.first().map(|location| location.prefix()) else {
        return Finding::ok(NAME, "no domain");
    };
    for location in locations {
        if let Ok(Some(pid)) = scanhub_shm::publisher_pid(location.root()) {
            let why =
                format!("{}: process {pid} publishes there, and cleans up itself", location.root().display());
            return Finding::skipped(NAME, why);
        }
    }
    let before = files(&prefix, user);
    let (mut dead, mut alive) = (0, 0);
    let mut roots = Vec::new();
    for location in
        locations.iter().filter(|location| location.root().metadata().is_ok_and(|it| it.uid() == user))
    {
        match scanhub_shm::clean_up(location) {
            Ok(CleanupReport { dead: here, alive: others, root }) => {
                dead += here;
                alive += others;
                roots.extend(root.then(|| location.root().display().to_string()));
            }
            // A hub has started since the check above.
            Err(Failure { kind: Kind::DomainHeld, message, .. }) => return Finding::skipped(NAME, message),
            Err(failure) => return Finding::failed(NAME, failure.message, failure.hint),
        }
    }
    // Clients that wait for the next hub may be opening the files.
    let unheld = if alive == 0 { unused_files(&prefix, user) } else { Vec::new() };
    for file in unheld {
        // A file that cannot be removed is in the list below, so it is not reported as removed.
        let _ = fs::remove_file(&file.path);
    }
    let remaining = files(&prefix, user);
    let removed_files: Vec<SharedFile> =
        before.into_iter().filter(|file| !remaining.contains(file)).collect();
    let removed =
        removed_files.iter().map(|file| file.path.display().to_string()).chain(roots.iter().cloned());
    removed.for_each(|path| tracing::info!("removed {path}"));
    clean_finding(dead, &removed_files, &roots)
}

/// Reports that everything of `dead` processes, the files `removed_files`, and the directories `roots` were removed.
fn clean_finding(dead: usize, removed_files: &[SharedFile], roots: &[String]) -> Finding {
    const NAME: &str = "clean";
    let mut removed = Vec::new();
    if dead > 0 {
        removed.push(format!("what {} left", plural(dead as u64, "process")));
    }
    if !removed_files.is_empty() {
        removed.push(describe(removed_files));
    }
    if !roots.is_empty() {
        removed.push(format!(
            "{} {}",
            if roots.len() == 1 { "directory" } else { "directories" },
            roots.join(", ")
        ));
    }
    match &removed[..] {
        [] => Finding::ok(NAME, "nothing to remove"),
        removed => Finding::ok(NAME, format!("removed {}", removed.join(", "))),
    }
}

/// Returns number and length of `files`, as text.
fn describe(files: &[SharedFile]) -> String {
    let bytes = files.iter().map(|file| file.bytes).sum::<u64>();
    format!(
        "{} ({} kB) in {SHARED_MEMORY_DIRECTORY}",
        plural(files.len() as u64, "file"),
        bytes.div_ceil(1024)
    )
}

/// Returns the files of `user` in shared memory whose names begin with `prefix`.
fn files(prefix: &str, user: u32) -> Vec<SharedFile> {
    let entries = fs::read_dir(SHARED_MEMORY_DIRECTORY).into_iter().flatten().flatten();
    let named = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix));
    let mut files: Vec<SharedFile> = named
        .filter_map(|entry| Some((entry.path(), entry.metadata().ok()?)))
        .filter(|(_, metadata)| metadata.uid() == user)
        .map(|(path, metadata)| SharedFile { path, bytes: metadata.len() })
        .collect();
    files.sort_by(|a, b| a.path.cmp(&b.path));
    files
}

/// Returns those of the [`files`] that no process has open or mapped. The lock file of iceoryx2 is an exception,
/// because no process keeps it open. It counts as held if a process holds another file whose name begins in the same
/// way: then a domain of this name at another location uses the lock file.
fn unused_files(prefix: &str, user: u32) -> Vec<SharedFile> {
    let files = files(prefix, user);
    let (free, held_files): (Vec<_>, Vec<_>) = files.into_iter().partition(|file| is_unused(&file.path));
    let domain = |file: &SharedFile| {
        let name = file.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        name.get(..prefix.len() + SUFFIX_LEN).map(str::to_owned)
    };
    let is_used = |file: &SharedFile| held_files.iter().any(|other| domain(other) == domain(file));
    free.into_iter().filter(|file| file.bytes > LOCK_LEN || !is_used(file)).collect()
}

/// Returns those of the [`files`] that no process holds, without the lock file of iceoryx2, a very short file that each
/// hub leaves at its exit.
pub(crate) fn abandoned_files(prefix: &str, user: u32) -> Vec<SharedFile> {
    let mut files = files(prefix, user);
    files.retain(|file| file.bytes > LOCK_LEN && is_unused(&file.path));
    files
}

/// Returns the lock file of iceoryx2, if no other file has this `prefix`. No process keeps the lock file open, so it
/// may belong to a running hub if other files exist.
pub(crate) fn lock(prefix: &str, user: u32) -> Option<PathBuf> {
    let files = files(prefix, user);
    let is_alone = files.iter().all(|file| file.bytes <= LOCK_LEN);
    files.into_iter().map(|file| file.path).find(|path| is_alone && is_unused(path))
}

/// Number of letters that follow the name of a domain in its file names (docs/topics.md, "Domain").
const SUFFIX_LEN: usize = 6;
/// Length of the lock file of iceoryx2 in bytes. The library never removes this file.
const LOCK_LEN: u64 = 16;
/// Maximum number of files that a finding names.
const MAX_NAMED: usize = 4;

/// Checks whether files of other users exist; `name_of` returns the name of their owner.
pub(crate) fn foreign_files(found: &[Segment], name_of: impl Fn(u32) -> String) -> Finding {
    const NAME: &str = "foreign-files";
    if found.is_empty() {
        return Finding::ok(NAME, "no file of another user under the domain's names");
    }
    let each = |segment: &Segment| {
        let (path, owner, mode) = (segment.path.display(), segment.owner, segment.mode);
        format!("{path} of user {owner} ({}), mode {mode:04o}", name_of(owner))
    };
    let paths: Vec<_> = found.iter().map(|segment| segment.path.display().to_string()).collect();
    let named: Vec<_> = found.iter().take(MAX_NAMED).map(each).collect();
    let more = match found.len().saturating_sub(MAX_NAMED) {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    Finding::warning(
        NAME,
        format!(
            "{}{more}: never opened, and may keep hub and clients from creating theirs",
            named.join(", ")
        ),
        format!(
            "let their owner or an administrator remove them: sudo rm {}",
            paths[..named.len()].join(" ")
        ),
    )
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::time::{Duration, Instant};

    use scanhub_shm::NodeCounts;

    use super::*;
    use crate::doctor::State;
    use crate::doctor::machine::{facts, says};

    fn two_files() -> Vec<SharedFile> {
        ["/dev/shm/sh_a_1", "/dev/shm/sh_a_2"]
            .map(|path| SharedFile { path: path.into(), bytes: 1024 })
            .into()
    }

    #[test]
    fn reports_files_of_dead_processes() {
        says(&leftovers(&facts()), State::Ok, &["none"]);
        let lock = MachineState { lock: Some("/dev/shm/sh_a_lock".into()), ..facts() };
        says(&leftovers(&lock), State::Ok, &["none but /dev/shm/sh_a_lock", "16 bytes"]);
        let nodes = |alive, dead| MachineState {
            nodes: Ok(NodeCounts { alive, dead }),
            segments: two_files(),
            ..facts()
        };
        says(&leftovers(&nodes(3, 0)), State::Ok, &["3 subscribers waiting"]);
        let words = [
            "1 process died",
            "2 files (2 kB)",
            "doctor --clean",
            "`scanhub run` at /run/user/7/scanhub/scanhub",
        ];
        says(&leftovers(&nodes(0, 1)), State::Warning, &words);
        says(&leftovers(&nodes(0, 0)), State::Warning, &["no process", "2 files", "doctor --clean"]);
        says(
            &leftovers(&MachineState { hub: Ok(Some(5)), ..nodes(3, 2) }),
            State::Ok,
            &["2 processes", "cleaning"],
        );
    }

    #[test]
    fn reports_removed_files_and_directories() {
        says(&clean_finding(0, &[], &[]), State::Ok, &["nothing"]);
        let roots = ["/tmp/a".to_owned()];
        says(
            &clean_finding(2, &two_files(), &roots),
            State::Ok,
            &["what 2 processes left, 2 files (2 kB)", "directory /tmp/a"],
        );
    }

    /// Waits until no process has `path` open. A child that another test starts has a copy of all descriptors for a
    /// moment.
    #[expect(clippy::disallowed_methods, reason = "a limit of real time")]
    fn await_unheld(prefix: &str, user: u32, path: &Path) {
        let give_up_at = Instant::now() + Duration::from_secs(60);
        while !unused_files(prefix, user).iter().any(|file| file.path == path) {
            assert!(Instant::now() < give_up_at, "{} is still open", path.display());
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn counts_files_that_no_process_holds() {
        let prefix = format!("sh_segments-{}_", std::process::id());
        let path = PathBuf::from(format!("{SHARED_MEMORY_DIRECTORY}/{prefix}a"));
        let file = fs::File::create_new(&path).unwrap();
        file.set_len(64).unwrap();
        let user = file.metadata().unwrap().uid();
        let open = abandoned_files(&prefix, user);
        drop(file);
        await_unheld(&prefix, user, &path);
        let short = PathBuf::from(format!("{SHARED_MEMORY_DIRECTORY}/{prefix}b"));
        fs::write(&short, "16 bytes are few").unwrap();
        let lock_file = lock(&prefix, user);
        let of_one_that_lives = {
            let other = [format!("{prefix}abcde_data"), format!("{prefix}abcde_lock")];
            let [data, counter] =
                other.map(|name| PathBuf::from(format!("{SHARED_MEMORY_DIRECTORY}/{name}")));
            let held = fs::File::create_new(&data).unwrap();
            held.set_len(64).unwrap();
            fs::write(&counter, "16 bytes are few").unwrap();
            let is_spared = !unused_files(&prefix, user).iter().any(|file| file.path == counter);
            drop(held);
            await_unheld(&prefix, user, &data);
            let is_left = unused_files(&prefix, user).iter().any(|file| file.path == counter);
            [data, counter].iter().for_each(|path| fs::remove_file(path).unwrap());
            (is_spared, is_left)
        };
        let (closed, other) = (abandoned_files(&prefix, user), abandoned_files(&prefix, user + 1));
        let all = (files(&prefix, user).len(), unused_files(&prefix, user).len());
        fs::remove_file(&path).unwrap();
        assert_eq!((lock_file, lock(&prefix, user)), (None, Some(short.clone())));
        fs::remove_file(&short).unwrap();
        assert_eq!((open, other), (Vec::new(), Vec::new()));
        assert_eq!(closed, [SharedFile { path, bytes: 64 }]);
        assert_eq!(all, (2, 2));
        assert_eq!(of_one_that_lives, (true, true));
    }

    #[test]
    fn reports_files_of_other_users() {
        let name_of = |user| format!("u{user}");
        says(&foreign_files(&[], name_of), State::Ok, &["no file of another user"]);
        let file = |name: &str| Segment::new(name, 7, 0o666, 16);
        let words = ["/dev/shm/sh_a_x", "user 7 (u7), mode 0666", "sudo rm /dev/shm/sh_a_x"];
        says(&foreign_files(&[file("/dev/shm/sh_a_x")], name_of), State::Warning, &words);
        let many = [file("/a"), file("/b"), file("/c"), file("/d"), file("/e"), file("/f")];
        says(&foreign_files(&many, name_of), State::Warning, &["/d of", "and 2 more", "sudo rm /a /b /c /d"]);
    }
}
