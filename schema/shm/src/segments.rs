//! Files in shared memory, which lie in one directory for all users of the machine. Their names start with the prefix
//! of their domain:
//!
//! - The prefix is `sh_DOMAIN_WORD_`. WORD is random: without it, another user could occupy the names before the hub
//!   starts. The prefix is stored in the file `prefix` of the domain's directory, which only this user can read. The
//!   prefix stays the same as long as any process uses it.
//! - Segments of other users are found by name, owner and mode, without opening them. The owner is reported, because
//!   the library only reports "internal error".
//! - The node counter is the only segment that the shared-memory library opens to all users. A user who can write to
//!   the counter can prevent every later process from joining. This module therefore creates the counter, for this user
//!   only, before the library searches for it. The library uses the file that it finds.
//! - A publisher's segments are allocated, because the first access to a full /dev/shm would end the process.

use std::fs::{self, File, Metadata, OpenOptions};
use std::hash::{BuildHasher, RandomState};
use std::io::{Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

use rustix::fs::{CWD, FallocateFlags, OFlags, RenameFlags, fallocate, renameat_with};
use rustix::io::Errno;
use scanhub_files::path_walk::describe_user;
use scanhub_schema::{Failure, Kind};

use crate::directory::{Directory, ServiceCreationLock};
use crate::domain::Domain;
use crate::resource_limits::{self, SHARED_MEMORY_DIRECTORY, memory_failure};

/// Returns the failure for `message` in the domain in `root`. If a directory or file of another user is the reason, the
/// failure reports its path, owner and mode, and the remedy. If a resource is short, the failure reports the shortage.
/// Otherwise it reports `message`.
pub(crate) fn access_failure(root: &Path, message: impl Into<String>) -> Failure {
    let directory = Directory::open(root).err();
    directory
        .or_else(|| resource_limits::find_shortage(root))
        .or_else(|| foreign_segments(root).first().map(name_conflict))
        .unwrap_or_else(|| {
            Failure::new(
                Kind::Failed,
                message,
                "IOX2_LOG_LEVEL=debug shows the messages of the shared-memory library",
            )
        })
}

/// A file in shared memory. Links are not followed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Path.
    pub path: PathBuf,
    /// User ID of the owner.
    pub owner: u32,
    /// Permission bits.
    pub mode: u32,
    /// Length in bytes.
    pub bytes: u64,
    is_file: bool,
}

impl Segment {
    /// Returns a regular file at `path` with these properties.
    pub fn new(path: impl Into<PathBuf>, owner: u32, mode: u32, bytes: u64) -> Segment {
        Segment { path: path.into(), owner, mode, bytes, is_file: true }
    }

    pub(crate) fn at(path: &Path) -> Option<Segment> {
        Some(Segment::of(path, &path.symlink_metadata().ok()?))
    }

    pub(crate) fn of(path: &Path, metadata: &Metadata) -> Segment {
        Segment {
            path: path.to_owned(),
            owner: metadata.uid(),
            mode: metadata.mode() & 0o7777,
            bytes: metadata.len(),
            is_file: metadata.is_file(),
        }
    }

    /// Returns whether the segment is a regular file of this user.
    pub(crate) fn is_own(&self) -> bool {
        self.owner == rustix::process::geteuid().as_raw() && self.is_file
    }

    /// Returns whether the segment is not a regular file of this user, or other users can write to it.
    pub(crate) fn is_foreign(&self) -> bool {
        !self.is_own() || self.mode & 0o022 != 0
    }
}

/// Returns the files under the names of the domain in `root` that do not belong to this user alone, sorted by path. The
/// list is empty if the domain has no names.
pub fn foreign_segments(root: &Path) -> Vec<Segment> {
    let Ok(Some(prefix)) = prefix_of(root) else { return Vec::new() };
    let segments = entries(&prefix).filter_map(|path| Segment::at(&path));
    let mut found: Vec<_> = segments.filter(Segment::is_foreign).collect();
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

/// Returns the failure to report if `segment` has a name that this process needs.
pub(crate) fn name_conflict(segment: &Segment) -> Failure {
    let (path, owner, mode) = (segment.path.display(), describe_user(segment.owner), segment.mode);
    let is_file = if segment.is_file { "" } else { " and is not a regular file" };
    let own = rustix::process::geteuid().as_raw();
    Failure::new(
        if segment.owner == own { Kind::Failed } else { Kind::OtherUser },
        format!(
            "{path} belongs to user {owner} with mode {mode:04o}{is_file}: scanhub needs its name and does not open it"
        ),
        format!(
            "let user {owner} or an administrator remove it (sudo rm {path}), or choose another --domain"
        ),
    )
}

/// Returns the files in shared memory whose names start with `prefix`.
fn entries(prefix: &str) -> impl Iterator<Item = PathBuf> {
    let entries = fs::read_dir(SHARED_MEMORY_DIRECTORY).into_iter().flatten().flatten();
    let named = entries.filter(move |entry| entry.file_name().to_string_lossy().starts_with(prefix));
    named.map(|entry| entry.path())
}

/// Allocates the memory of all segments that `domain` has reserved so far.
///
/// # Errors
///
/// Returns [`Kind::ResourceExhausted`] if there is not enough memory.
pub fn allocate(domain: &Domain) -> Result<(), Failure> {
    let Some(prefix) = prefix_of(domain.root())? else { return Ok(()) };
    for path in entries(&prefix) {
        // Skip segments of other users, and segments that were removed in between.
        if !Segment::at(&path).is_some_and(|segment| segment.is_own()) {
            continue;
        }
        let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
        let segment = OpenOptions::new().write(true).custom_flags(flags).open(&path);
        let Ok((bytes, segment)) = segment.and_then(|it| Ok((it.metadata()?.len(), it))) else { continue };
        // Ignore all other errors: the allocation may succeed later, and an empty segment has nothing to allocate.
        if fallocate(&segment, FallocateFlags::empty(), 0, bytes) == Err(Errno::NOSPC) {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            return Err(memory_failure(&format!("no room for {name}: {} kB", bytes / 1024)));
        }
    }
    Ok(())
}

/// Returns the prefix of the domain in `root`. `None` if no process has published there, or if all processes have
/// ended.
///
/// # Errors
///
/// Returns the errors of [`Directory::open`] and [`Directory::file`].
pub(crate) fn prefix_of(root: &Path) -> Result<Option<String>, Failure> {
    match Directory::open(root)? {
        Some(directory) => read_prefix(&directory, root),
        None => Ok(None),
    }
}

/// Returns the prefix of the domain in `root`, and chooses one if the domain has none.
///
/// # Errors
///
/// Returns the errors of [`prefix_of`], and an error if the file cannot be written.
pub(crate) fn ensure_prefix(root: &Path, _lock: &ServiceCreationLock) -> Result<String, Failure> {
    let directory = Directory::create(root)?;
    if let Some(prefix) = read_prefix(&directory, root)? {
        return Ok(prefix);
    }
    // The hash is keyed with random numbers of the system. Another user cannot occupy all names, but possibly some of
    // them, so try several words.
    let mut words = (0..).map(|number: u32| random_word(RandomState::new().hash_one(number)));
    let prefixes = words.by_ref().map(|word| format!("{}{word}_", prefix_start(root)));
    let prefix =
        prefixes.take(MAX_ATTEMPTS).find(|prefix| entries(prefix).next().is_none()).ok_or_else(|| {
            let what =
                format!("{SHARED_MEMORY_DIRECTORY} is full of files that start with {}", prefix_start(root));
            Failure::new(Kind::Failed, what, "have them removed, or choose another --domain")
        })?;
    directory.replace(PREFIX_FILE, format!("{prefix}\n").as_bytes())?;
    Ok(prefix)
}

fn random_word(mut random: u64) -> String {
    let letters = std::iter::repeat_with(|| {
        let letter = ALPHABET[(random % ALPHABET.len() as u64) as usize];
        random /= ALPHABET.len() as u64;
        letter as char
    });
    letters.take(RANDOM_WORD_LEN).collect()
}

/// Returns the prefix in the open `directory` of `root`. A prefix of another form was not written by this module, and
/// is ignored.
///
/// # Errors
///
/// Returns the errors of [`Directory::file`].
pub(crate) fn read_prefix(directory: &Directory, root: &Path) -> Result<Option<String>, Failure> {
    let Some(file) = directory.file(PREFIX_FILE)? else { return Ok(None) };
    let mut text = String::new();
    let read = file.take(MAX_PREFIX_FILE_BYTES).read_to_string(&mut text);
    let is_valid = |prefix: &str| {
        let random = prefix.strip_prefix(&prefix_start(root)).and_then(|rest| rest.strip_suffix('_'));
        random
            .is_some_and(|it| it.len() == RANDOM_WORD_LEN && it.bytes().all(|byte| ALPHABET.contains(&byte)))
    };
    Ok(read.ok().and_then(|_| text.strip_suffix('\n')).filter(|prefix| is_valid(prefix)).map(str::to_owned))
}

fn prefix_start(root: &Path) -> String {
    format!("sh_{}_", root.file_name().unwrap_or_default().to_string_lossy())
}

/// Creates the node counter under `prefix`, unless a complete one exists that belongs to this user alone. A counter of
/// this user that is unfinished, or that other users can write to, is replaced.
///
/// # Errors
///
/// Returns [`Kind::OtherUser`] with file, owner and remedy if a file of another user has the counter's name, and
/// [`Kind::Failed`] if this name belongs to anything but a regular file. Returns [`Kind::ResourceExhausted`] if there
/// is no memory for the counter.
pub(crate) fn ensure_node_counter(prefix: &str) -> Result<(), Failure> {
    let path = node_counter_path(prefix);
    loop {
        match Segment::at(&path) {
            Some(segment) if !segment.is_own() => return Err(name_conflict(&segment)),
            // Either the library created the counter, and other users can write to it, or the counter is unfinished,
            // and the library would wait for it forever.
            Some(segment) if segment.is_foreign() || segment.bytes != NODE_COUNTER_CONTENT.len() as u64 => {
                remove_node_counter(prefix)
            }
            Some(_) => return Ok(()),
            None => create_node_counter(&path)?,
        }
    }
}

/// Removes the node counter under `prefix`, which no process needs any more.
fn remove_node_counter(prefix: &str) {
    let _ = fs::remove_file(node_counter_path(prefix));
}

/// Removes the node counter, and the prefix in `directory`. Only a running process needs these files.
pub(crate) fn remove_prefix(directory: &Directory, root: &Path) {
    if let Ok(Some(prefix)) = read_prefix(directory, root) {
        remove_node_counter(&prefix);
    }
    directory.remove(PREFIX_FILE.as_ref());
}

/// Creates the node counter at `path` with its content in one step. Keeps the existing counter if another process has
/// created one in the meantime.
fn create_node_counter(path: &Path) -> Result<(), Failure> {
    // Threads of one process may create it at the same time, so each temporary name has a number.
    static FILE_COUNT: AtomicU32 = AtomicU32::new(0);
    let number = FILE_COUNT.fetch_add(1, Ordering::Relaxed);
    let temporary = path.with_extension(format!("new-{}-{number}", std::process::id()));
    let written = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&temporary);
    let written = written.and_then(|mut file: File| file.write_all(&NODE_COUNTER_CONTENT));
    let renamed =
        written.and_then(|()| match renameat_with(CWD, &temporary, CWD, path, RenameFlags::NOREPLACE) {
            Err(Errno::EXIST) => Ok(()),
            placed => Ok(placed?),
        });
    let _ = fs::remove_file(&temporary);
    renamed.map_err(|error| match Errno::from_io_error(&error) {
        Some(Errno::NOSPC) => memory_failure(&format!("no room for {}: 16 bytes", path.display())),
        _ => Failure::new(Kind::Failed, format!("{}: {error}", path.display()), "scanhub doctor --clean"),
    })
}

fn node_counter_path(prefix: &str) -> PathBuf {
    Path::new(SHARED_MEMORY_DIRECTORY).join(format!("{prefix}{NODE_COUNTER_NAME}"))
}

/// Name of the node counter without the prefix. It contains the hash of a type, as iceoryx2 0.10.0 computes it
/// (`DynamicStorageConfiguration::path_for_with_type`). The test below compares this hash with the hash of iceoryx2.
const NODE_COUNTER_NAME: &str = "9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt";

/// Content that the library writes (`posix_shared_memory::Data`): its packed version, then the counter, from 0.
const NODE_COUNTER_CONTENT: [u8; 16] = {
    let (version, mut content) = ((10_u64 << 16).to_ne_bytes(), [0; 16]);
    let mut i = 0;
    while i < version.len() {
        content[i] = version[i];
        i += 1;
    }
    content
};

/// Name of the prefix's file in the domain's directory.
const PREFIX_FILE: &str = "prefix";
/// Length of the random word in characters. There are 60 million words of this length.
const RANDOM_WORD_LEN: usize = 5;
const ALPHABET: &[u8] = b"0123456789abcdefghijklmnopqrstuvwxyz";
const MAX_PREFIX_FILE_BYTES: u64 = 64;
/// Number of random words to try. If the names of all these words are taken, this is not by chance.
const MAX_ATTEMPTS: usize = 16;

#[cfg(test)]
mod tests {
    use iceoryx2::config::Config;
    use iceoryx2::prelude::{FileName, NodeBuilder, SemanticString, SignalHandlingMode, ipc};

    use super::*;

    #[test]
    fn created_segment_equals_that_of_the_library() {
        let base = tempfile::tempdir().unwrap();
        let prefix = format!("sh_k{}_", std::process::id());
        let join = || {
            let mut config = Config::default();
            config.global.prefix = FileName::new(prefix.as_bytes()).unwrap();
            config.global.set_root_path(
                &iceoryx2::prelude::Path::new(base.path().as_os_str().as_encoded_bytes()).unwrap(),
            );
            let builder = NodeBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled);
            builder.config(&config).create::<ipc::Service>().unwrap()
        };
        let files = || {
            let content = |path: PathBuf| (path.clone(), fs::read(path).unwrap());
            entries(&prefix).map(content).collect::<Vec<_>>()
        };
        drop(join());
        let theirs = files();
        let mode = Segment::at(&node_counter_path(&prefix)).map(|it| it.mode);
        remove_node_counter(&prefix);
        let removed = files();
        ensure_node_counter(&prefix).unwrap();
        let ours = files();
        drop(join());
        let counted = files();
        ensure_node_counter(&prefix).unwrap();
        let kept = (files(), Segment::at(&node_counter_path(&prefix)).map(|it| it.mode));
        remove_node_counter(&prefix);
        drop(join());
        ensure_node_counter(&prefix).unwrap();
        let closed = Segment::at(&node_counter_path(&prefix)).map(|it| it.mode);
        fs::write(node_counter_path(&prefix), "cut").unwrap();
        ensure_node_counter(&prefix).unwrap();
        let repaired = files();
        remove_node_counter(&prefix);

        let content = |count: u32| {
            let mut content = NODE_COUNTER_CONTENT;
            content[8..12].copy_from_slice(&count.to_ne_bytes());
            vec![(node_counter_path(&prefix), content.to_vec())]
        };
        assert_eq!((theirs, mode), (content(1), Some(0o666)), "another version of the library");
        assert_eq!((removed, ours, &counted), (vec![], content(0), &content(1)));
        assert_eq!((kept, repaired), ((counted, Some(0o600)), content(0)));
        assert_eq!(closed, Some(0o600), "the library's own, which is open to all, does not stay");
    }

    #[test]
    fn prefix_is_kept_and_never_reused() {
        let base = tempfile::tempdir().unwrap();
        let root = base.path().join("a-1");
        assert_eq!(prefix_of(&root), Ok(None), "there is no such directory");
        let ensure_prefix = |root: &Path| ensure_prefix(root, &ServiceCreationLock::wait(root).unwrap());
        let first = ensure_prefix(&root).unwrap();
        assert!(first.starts_with("sh_a-1_") && first.len() == 13, "{first}");
        assert_eq!((ensure_prefix(&root), prefix_of(&root)), (Ok(first.clone()), Ok(Some(first.clone()))));
        for written in ["", "sh_a-1_four_\n", "sh_b_12345_\n", "sh_a-1_12/45_\n"] {
            fs::write(root.join(PREFIX_FILE), written).unwrap();
            assert_eq!(prefix_of(&root), Ok(None), "{written:?}");
        }
        assert_ne!(ensure_prefix(&root).unwrap(), first);
    }
}
