//! Files that are complete or absent: read up to a maximum size, written under a temporary name and then renamed.
//! Refuses to know what is in them.

use std::ffi::OsString;
use std::fs::{self, File, Metadata};
use std::io::{self, Read, Write};
use std::os::unix::fs::{MetadataExt, fchown};
use std::path::{Path, PathBuf};

use schema::{Failure, Kind, regular};

/// All of the file at `path`, at most `longest` bytes.
///
/// [`Kind::Input`] if it cannot be read or is longer: another one was meant.
pub(crate) fn read(path: &Path, longest: u64) -> Result<Vec<u8>, Failure> {
    let place = path.display().to_string();
    regular::read(path, longest).map_err(|error| unreadable(&place, &error))
}

/// All of `input`, which is at `place`; failures as [`read`].
pub(crate) fn read_all(input: &mut dyn Read, place: &str, longest: u64) -> Result<Vec<u8>, Failure> {
    regular::read_all(input, longest).map_err(|error| unreadable(place, &error))
}

/// Puts a file of `content` at `path`. A reader always finds the old one or the new one, whatever happens, whole; who
/// may read it stays as it was. What is there and no file, a device or a pipe, is written to.
///
/// [`Kind::Output`] if it cannot be written; nothing is left then.
pub(crate) fn replace(path: &Path, content: &[u8]) -> Result<(), Failure> {
    // A link stays, and what it points to is replaced.
    let path = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let old = fs::metadata(&path).ok();
    let written = match &old {
        Some(old) if !old.is_file() => {
            File::options().write(true).open(&path).and_then(|mut file| file.write_all(content))
        }
        old => beside(&path).and_then(|beside| exchange(&path, &beside, old.as_ref(), content)),
    };
    written.map_err(|error| {
        let hint = "the directory must exist, be writable and have free space";
        Failure::new(Kind::Output, format!("cannot write {}: {error}", path.display()), hint)
    })
}

fn exchange(path: &Path, beside: &Path, old: Option<&Metadata>, content: &[u8]) -> io::Result<()> {
    let write = || {
        let mut file = File::create(beside)?;
        if let Some(old) = old {
            // Not everybody may give a file away. Before its permissions, of which this clears some.
            let _ = fchown(&file, Some(old.uid()), Some(old.gid()));
            file.set_permissions(old.permissions())?;
        }
        file.write_all(content)?;
        file.sync_all()?;
        fs::rename(beside, path)
    };
    write().inspect_err(|_| {
        let _ = fs::remove_file(beside);
    })
}

/// A name in the same directory that no other process takes.
fn beside(path: &Path) -> io::Result<PathBuf> {
    let name = path.file_name().ok_or(io::ErrorKind::IsADirectory)?;
    let mut hidden = OsString::from(".");
    hidden.push(name);
    hidden.push(format!(".{}", std::process::id()));
    Ok(path.with_file_name(hidden))
}

fn unreadable(place: &str, error: &io::Error) -> Failure {
    let hint = "it must exist and be readable for this user";
    Failure::new(Kind::Input, format!("cannot read {place}: {error}"), hint)
}
