//! Prefix of the names of a domain's shared memory. All users can create files in /dev/shm, so the prefix contains a
//! random word. Without it, another user could occupy the names before the hub starts.
//!
//! The prefix, `sh_DOMAIN_WORD_`, is stored in the file `prefix` of the domain's directory, which only this user can
//! read. It stays as long as any process uses it.

use std::hash::{BuildHasher, RandomState};
use std::io::Read;
use std::path::Path;

use scanhub_schema::{Failure, Kind};

use crate::directory::Directory;
use crate::file_lock::MakingLock;
use crate::shortage::SHARED_MEMORY;

/// Returns the prefix of the domain in `root`. `None` if no process has published there, or all have ended.
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
pub(crate) fn ensure_prefix(root: &Path, _making: &MakingLock) -> Result<String, Failure> {
    let directory = Directory::make(root)?;
    if let Some(prefix) = read_prefix(&directory, root)? {
        return Ok(prefix);
    }
    // The hash is keyed with random numbers of the system. Another user cannot create files with all names, but
    // possibly with some.
    let mut words = (0..).map(|number: u32| random_word(RandomState::new().hash_one(number)));
    let prefixes = words.by_ref().map(|word| format!("{}{word}_", prefix_start(root)));
    let prefix = prefixes.take(MAX_ATTEMPTS).find(|prefix| is_free(prefix)).ok_or_else(|| {
        let what = format!("{SHARED_MEMORY} is full of files that start with {}", prefix_start(root));
        Failure::new(Kind::Failed, what, "have them removed, or choose another --domain")
    })?;
    directory.replace(PREFIX_FILE, format!("{prefix}\n").as_bytes())?;
    Ok(prefix)
}

fn random_word(mut random: u64) -> String {
    let letters = std::iter::repeat_with(|| {
        let letter = LETTERS[(random % LETTERS.len() as u64) as usize];
        random /= LETTERS.len() as u64;
        letter as char
    });
    letters.take(RANDOM_LETTERS).collect()
}

fn is_free(prefix: &str) -> bool {
    let mut entries = std::fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
    !entries.any(|entry| entry.file_name().to_string_lossy().starts_with(prefix))
}

/// Returns the prefix in the open `directory` of `root`. A prefix of another form was not written here, and counts as
/// none.
///
/// # Errors
///
/// Returns the errors of [`Directory::file`].
pub(crate) fn read_prefix(directory: &Directory, root: &Path) -> Result<Option<String>, Failure> {
    let Some(file) = directory.file(PREFIX_FILE)? else { return Ok(None) };
    let mut text = String::new();
    let read = file.take(MAX_PREFIX_FILE_BYTES).read_to_string(&mut text);
    let is_one = |prefix: &str| {
        let random = prefix.strip_prefix(&prefix_start(root)).and_then(|rest| rest.strip_suffix('_'));
        random.is_some_and(|it| it.len() == RANDOM_LETTERS && it.bytes().all(|byte| LETTERS.contains(&byte)))
    };
    Ok(read.ok().and_then(|_| text.strip_suffix('\n')).filter(|prefix| is_one(prefix)).map(str::to_owned))
}

fn prefix_start(root: &Path) -> String {
    format!("sh_{}_", root.file_name().unwrap_or_default().to_string_lossy())
}

/// Name of the file in the domain's directory.
pub(crate) const PREFIX_FILE: &str = "prefix";
/// Length of the random word: 60 million words.
const RANDOM_LETTERS: usize = 5;
const LETTERS: &[u8] = b"0123456789abcdefghijklmnopqrstuvwxyz";
const MAX_PREFIX_FILE_BYTES: u64 = 64;
/// Number of words to try. They are not all taken by chance.
const MAX_ATTEMPTS: usize = 16;

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_word_is_kept_and_never_the_same_twice() {
        let base = tempfile::tempdir().unwrap();
        let root = base.path().join("a-1");
        assert_eq!(prefix_of(&root), Ok(None), "there is no such directory");
        let ensure_prefix = |root: &Path| ensure_prefix(root, &MakingLock::wait(root).unwrap());
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
