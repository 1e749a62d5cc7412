//! The prefix of the names of a domain's shared memory: `sh_DOMAIN_`, then a random word that nobody can guess. /dev/shm
//! is open to all users; without the word, another user could occupy the names before the hub starts. The word is stored
//! in the file `prefix` of the domain's directory, which only this user can read, and stays as long as anybody uses it.

use std::hash::{BuildHasher, RandomState};
use std::io::Read;
use std::path::Path;

use crate::lock::MakingLock;
use crate::shortage::SHARED_MEMORY;
use crate::{Directory, Failure, Kind};

/// How names of the domain in `root` begin, or nothing if it has none: nobody has published there, or all have gone.
///
/// # Errors
///
/// As [`Directory::open`] and [`Directory::file`].
pub(crate) fn of(root: &Path) -> Result<Option<String>, Failure> {
    match Directory::open(root)? {
        Some(directory) => read(&directory, root),
        None => Ok(None),
    }
}

/// Makes sure that the domain in `root` has one.
///
/// # Errors
///
/// As [`of`], and if the file cannot be written.
pub(crate) fn settle(root: &Path, _making: &MakingLock) -> Result<String, Failure> {
    let directory = Directory::make(root)?;
    if let Some(prefix) = read(&directory, root)? {
        return Ok(prefix);
    }
    // Keyed by the system's random numbers. Nobody can make files of all names; those of some may be there.
    let mut words = (0..).map(|number: u32| word(RandomState::new().hash_one(number)));
    let prefixes = words.by_ref().map(|word| format!("{}{word}_", start(root)));
    let prefix = prefixes.take(TRIES).find(|prefix| is_free(prefix)).ok_or_else(|| {
        let what = format!("{SHARED_MEMORY} is full of files that start with {}", start(root));
        Failure::new(Kind::Failed, what, "have them removed, or choose another --domain")
    })?;
    directory.replace(FILE, format!("{prefix}\n").as_bytes())?;
    Ok(prefix)
}

fn word(mut random: u64) -> String {
    let letters = std::iter::repeat_with(|| {
        let letter = LETTERS[(random % LETTERS.len() as u64) as usize];
        random /= LETTERS.len() as u64;
        letter as char
    });
    letters.take(RANDOM).collect()
}

fn is_free(prefix: &str) -> bool {
    let mut entries = std::fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
    !entries.any(|entry| entry.file_name().to_string_lossy().starts_with(prefix))
}

/// The same, of the open `directory` of `root`. One that is not of this form was not written here, and counts as none.
///
/// # Errors
///
/// As [`Directory::file`].
pub(crate) fn read(directory: &Directory, root: &Path) -> Result<Option<String>, Failure> {
    let Some(file) = directory.file(FILE)? else { return Ok(None) };
    let mut text = String::new();
    let read = file.take(LONGEST).read_to_string(&mut text);
    let is_one = |prefix: &str| {
        let random = prefix.strip_prefix(&start(root)).and_then(|rest| rest.strip_suffix('_'));
        random.is_some_and(|it| it.len() == RANDOM && it.bytes().all(|byte| LETTERS.contains(&byte)))
    };
    Ok(read.ok().and_then(|_| text.strip_suffix('\n')).filter(|prefix| is_one(prefix)).map(str::to_owned))
}

fn start(root: &Path) -> String {
    format!("sh_{}_", root.file_name().unwrap_or_default().to_string_lossy())
}

/// The file in the domain's directory.
pub(crate) const FILE: &str = "prefix";
/// Letters of the word: 60 million words.
const RANDOM: usize = 5;
const LETTERS: &[u8] = b"0123456789abcdefghijklmnopqrstuvwxyz";
const LONGEST: u64 = 64;
/// Words that are tried: that all are taken does not happen by chance.
const TRIES: usize = 16;

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_word_is_kept_and_never_the_same_twice() {
        let base = tempfile::tempdir().unwrap();
        let root = base.path().join("a-1");
        assert_eq!(of(&root), Ok(None), "there is no such directory");
        let settle = |root: &Path| settle(root, &MakingLock::wait(root).unwrap());
        let first = settle(&root).unwrap();
        assert!(first.starts_with("sh_a-1_") && first.len() == 13, "{first}");
        assert_eq!((settle(&root), of(&root)), (Ok(first.clone()), Ok(Some(first.clone()))));
        for written in ["", "sh_a-1_four_\n", "sh_b_12345_\n", "sh_a-1_12/45_\n"] {
            fs::write(root.join(FILE), written).unwrap();
            assert_eq!(of(&root), Ok(None), "{written:?}");
        }
        assert_ne!(settle(&root).unwrap(), first);
    }
}
