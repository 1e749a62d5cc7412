//! `scanhub key`: creates the file with the key that gateways and listeners share. Gateways and listeners read the file
//! only if no other user can read it.

use std::fs::File;
use std::io::Write;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use rustix::rand::{GetRandomFlags, getrandom};
use scanhub_files::output::{PRIVATE_MODE, Target, unwritable};
use scanhub_files::regular_file;
use scanhub_schema::{Failure, Kind};
use scanhub_verbs::output::{Output, verb_result};
use serde_json::json;

use crate::lan::Key;
use scanhub_verbs::context::Context;

/// Create the key that gateways and listeners share
#[derive(Args, Debug)]
#[command(after_help = "Example:\n  scanhub key new lan.key")]
pub struct KeyArgs {
    #[command(subcommand)]
    command: KeyCommand,
}

#[derive(Debug, Subcommand)]
enum KeyCommand {
    /// Create a file with a new key, which only this user can read
    #[command(after_help = "Example:\n  scanhub key new lan.key")]
    New {
        /// File to create; it must not exist yet
        file: PathBuf,
    },
}

impl KeyArgs {
    /// Creates a key file, and prints the name of its key.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Output`] if the file exists or cannot be written.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let KeyCommand::New { file } = &self.command;
        new_key(file, context.json, &mut context.out)
    }
}

/// Creates the file at `path` with a new random key, for this user only, and prints the key's name to `out`.
///
/// # Errors
///
/// Returns [`Kind::Output`] if the file exists or cannot be written.
fn new_key(path: &Path, json: bool, out: &mut dyn Write) -> Result<(), Failure> {
    let mut bytes = [0; Key::LEN];
    let filled = getrandom(&mut bytes, GetRandomFlags::empty());
    if filled != Ok(Key::LEN) {
        return Err(Failure::new(Kind::Failed, "the system gives no random bytes", "try again"));
    }
    let text: String = bytes.iter().map(|byte| format!("{byte:02x}")).chain(["\n".into()]).collect();
    let target = Target::open(path)?;
    // No option replaces an existing key, because other machines may use that key.
    if target.check(true)?.is_some() {
        return Err(Failure::new(Kind::Output, format!("{} exists", path.display()), KEY_EXISTS));
    }
    let mut file = target.create_new(false, PRIVATE_MODE)?;
    let written = file.write_all(text.as_bytes()).and_then(|()| file.sync_all());
    written.map_err(|error| unwritable(path, &error))?;
    let (path, name) = (path.display().to_string(), Key::new(&bytes).name());
    let mut out = Output::new(out);
    verb_result(match json {
        true => out.json(&json!({ "class": "key", "file": path, "key": name })),
        false => out.line(|line| {
            write!(
                line,
                "{path}: key {name}; copy the file to the other machines, and name it there by --key-file"
            )
        }),
    })
}

/// Returns the key in the file at `path`: 32 bytes, or 64 hex digits.
///
/// # Errors
///
/// Returns [`Kind::Input`] if the file cannot be read or is not a regular file. Returns [`Kind::Configuration`] if the
/// file belongs to another user, can be read or written by others, or contains no key.
pub(crate) fn read(path: &Path) -> Result<Key, Failure> {
    let refuse = |what: String, hint: &str| {
        Failure::new(Kind::Configuration, format!("key file {}: {what}", path.display()), hint)
    };
    let unreadable = |error: std::io::Error| {
        let hint = "`scanhub key new FILE` makes one; this user must be able to read it";
        Failure::new(Kind::Input, format!("key file {}: {error}", path.display()), hint)
    };
    let mut file: File = regular_file::open(path).map_err(unreadable)?;
    let about = file.metadata().map_err(unreadable)?;
    let (mode, owner, user) = (about.mode() & 0o777, about.uid(), rustix::process::geteuid().as_raw());
    if owner != user {
        let what = format!("it is user {owner}'s, and this is user {user}");
        return Err(refuse(what, "copy it as this user, and `chmod 600` the copy"));
    }
    if mode & 0o077 != 0 {
        let what = format!("its mode is {mode:04o}, so others can use the key");
        return Err(refuse(what, "`chmod 600` it; if others may have read it, make a new one"));
    }
    let bytes = regular_file::read_all(&mut file, MAX_FILE_LEN).map_err(unreadable)?;
    let key = parse(&bytes).ok_or_else(|| {
        refuse(
            format!("its {} bytes are not a key", about.len()),
            "32 bytes, or 64 hex digits; `scanhub key new FILE` makes one",
        )
    })?;
    Ok(Key::new(&key))
}

/// Returns the key in `bytes`, the content of a key file. `None` if the content is not a key.
fn parse(bytes: &[u8]) -> Option<[u8; Key::LEN]> {
    if let Ok(raw) = bytes.try_into() {
        return Some(raw);
    }
    let (pairs, []) = bytes.trim_ascii_end().as_chunks::<2>() else { return None };
    let byte = |pair: &[u8; 2]| u8::from_str_radix(str::from_utf8(pair).ok()?, 16).ok();
    let is_hex = pairs.as_flattened().iter().all(u8::is_ascii_hexdigit);
    pairs.iter().map(byte).collect::<Option<Vec<u8>>>().filter(|_| is_hex)?.try_into().ok()
}

/// Hint of the error that a key file already exists.
const KEY_EXISTS: &str = "name another file, or remove this one if no gateway uses its key any more";
/// Maximum number of bytes that are read from a key file. It is more than any form of a key has.
const MAX_FILE_LEN: u64 = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_32_bytes_or_64_digits() {
        let hex = "00ff".repeat(16);
        let bytes = std::array::from_fn(|at| if at % 2 == 0 { 0 } else { 0xff });
        assert_eq!(parse(hex.as_bytes()), Some(bytes));
        assert_eq!(parse(format!("{}\r\n", hex.to_uppercase()).as_bytes()), Some(bytes));
        assert_eq!(parse(&[10; 32]), Some([10; 32]), "raw, whatever the bytes are");
        let signed = format!("+1{}", &hex[2..]);
        for text in ["", "00", &hex[..62], &hex[..63], &format!("{hex}00"), &signed, &"g".repeat(64)] {
            assert_eq!(parse(text.as_bytes()), None, "{text}");
        }
    }
}
