//! The file with the key that gateways and listeners share: made here, and read only if nobody else can read it. Refuses to
//! know what the key is for.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use lan::Key;
use rustix::rand::{GetRandomFlags, getrandom};
use schema::{Failure, Kind, regular};
use serde_json::json;

use crate::output::{Output, quiet};

/// Makes the file at `path` with a new random key, for this user only, and tells its name to `out`.
///
/// [`Kind::Output`] if there is a file already, or none can be made.
pub fn new_key(path: &Path, json: bool, out: &mut dyn Write) -> Result<(), Failure> {
    let mut bytes = [0; Key::LEN];
    let filled = getrandom(&mut bytes, GetRandomFlags::empty());
    if filled != Ok(Key::LEN) {
        return Err(Failure::new(Kind::Failed, "the system gives no random bytes", "try again"));
    }
    let text: String = bytes.iter().map(|byte| format!("{byte:02x}")).chain(["\n".into()]).collect();
    let write = || {
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()
    };
    write().map_err(|error: std::io::Error| {
        let hint = match error.kind() {
            ErrorKind::AlreadyExists => {
                "give another name, or remove the file if nobody uses its key any more"
            }
            _ => "the directory must exist and be writable",
        };
        Failure::new(Kind::Output, format!("cannot make {}: {error}", path.display()), hint)
    })?;
    let (path, name) = (path.display().to_string(), Key::new(&bytes).name());
    let mut out = Output::new(out);
    quiet(match json {
        true => out.json(&json!({ "class": "key", "file": path, "key": name })),
        false => out.line(|line| {
            write!(
                line,
                "{path}: key {name}; copy the file to the other machines, and name it there by --key-file"
            )
        }),
    })
}

/// The key in the file at `path`: 32 bytes, or 64 hex digits.
///
/// [`Kind::Configuration`] if it cannot be read, is another user's, can be read or written by anybody else, or holds no key.
pub(crate) fn read(path: &Path) -> Result<Key, Failure> {
    let refuse = |what: String, hint: &str| {
        Failure::new(Kind::Configuration, format!("key file {}: {what}", path.display()), hint)
    };
    let unreadable = |error: std::io::Error| {
        refuse(error.to_string(), "`scanhub key new FILE` makes one; this user must be able to read it")
    };
    let mut file: File = regular::open(path).map_err(unreadable)?;
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
    let mut bytes = Vec::new();
    (&mut file).take(LONGEST).read_to_end(&mut bytes).map_err(unreadable)?;
    let key = parse(&bytes).ok_or_else(|| {
        refuse(
            format!("its {} bytes are no key", about.len()),
            "32 bytes, or 64 hex digits; `scanhub key new FILE` makes one",
        )
    })?;
    Ok(Key::new(&key))
}

fn parse(bytes: &[u8]) -> Option<[u8; Key::LEN]> {
    if let Ok(raw) = bytes.try_into() {
        return Some(raw);
    }
    let (pairs, []) = bytes.trim_ascii_end().as_chunks::<2>() else { return None };
    let byte = |pair: &[u8; 2]| u8::from_str_radix(str::from_utf8(pair).ok()?, 16).ok();
    let is_hex = pairs.as_flattened().iter().all(u8::is_ascii_hexdigit);
    pairs.iter().map(byte).collect::<Option<Vec<u8>>>().filter(|_| is_hex)?.try_into().ok()
}

/// More than any form of a key has.
const LONGEST: u64 = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_32_bytes_or_64_digits() {
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
