//! Reads of files that a user names: only regular files, and only up to a maximum length. Pipes and devices are
//! rejected, because a read of a pipe may wait for a writer forever, and a device may have no end.

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::OFlags;

use scanhub_schema::{Failure, Kind};

/// Maximum length in bytes of a file with a configuration, a simulated world or a background model. The limit is many
/// times the length of real files. It bounds the memory for the parsed form, which needs a hundred times the length of
/// the file.
pub const MAX_FILE_BYTES: u64 = 512 << 10;

/// Opens the regular file at `path`, without waiting.
///
/// # Errors
///
/// Returns [`ErrorKind::InvalidInput`] with the kind of the file if it is not a regular file, otherwise the system's
/// error.
pub fn open(path: &Path) -> io::Result<File> {
    let flags = OFlags::NONBLOCK | OFlags::NOCTTY;
    let file = OpenOptions::new().read(true).custom_flags(flags.bits() as i32).open(path)?;
    let kind = file.metadata()?.file_type();
    let what = match () {
        () if kind.is_file() => return Ok(file),
        () if kind.is_dir() => "a directory",
        () if kind.is_fifo() => "a pipe",
        () => "a device",
    };
    Err(io::Error::new(ErrorKind::InvalidInput, format!("it is {what}, not a regular file")))
}

/// Returns the content of the regular file at `path`.
///
/// # Errors
///
/// Returns the errors of [`open`], and [`ErrorKind::FileTooLarge`] if the file has more than `max_bytes` bytes.
pub fn read(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    read_all(&mut open(path)?, max_bytes)
}

/// Returns the content of the regular file at `path` as text.
///
/// # Errors
///
/// Returns the errors of [`read`], and [`ErrorKind::InvalidData`] if the content is not UTF-8.
pub fn read_text(path: &Path, max_bytes: u64) -> io::Result<String> {
    String::from_utf8(read(path, max_bytes)?)
        .map_err(|_| io::Error::new(ErrorKind::InvalidData, "it is not UTF-8 text"))
}

/// Returns the bytes of `input` up to its end.
///
/// # Errors
///
/// Returns [`ErrorKind::FileTooLarge`] if `input` has more than `max_bytes` bytes, otherwise the system's error.
pub fn read_all(input: &mut dyn Read, max_bytes: u64) -> io::Result<Vec<u8>> {
    let mut content = Vec::new();
    input.take(max_bytes + 1).read_to_end(&mut content)?;
    if content.len() as u64 > max_bytes {
        let what = format!("it is longer than {max_bytes} bytes");
        return Err(io::Error::new(ErrorKind::FileTooLarge, what));
    }
    Ok(content)
}

/// Returns the failure to read the input file `name`.
pub fn unreadable(name: &str, error: &io::Error) -> Failure {
    let hint = match error.kind() {
        ErrorKind::InvalidInput => "name a regular file",
        ErrorKind::InvalidData | ErrorKind::FileTooLarge => "name a file of the right kind",
        _ => "it must exist and be readable for this user",
    };
    Failure::new(Kind::Input, format!("cannot read {name}: {error}"), hint)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use rustix::fs::{CWD, FileType, Mode, mknodat};

    use super::*;

    #[test]
    fn special_and_oversized_files_are_refused_at_once() {
        let directory = tempfile::tempdir().unwrap();
        let [pipe, file, link] = ["pipe", "file", "link"].map(|name| directory.path().join(name));
        mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        fs::write(&file, "1234567").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        let refused = |path: &Path| read(path, 7).map_err(|error| (error.kind(), error.to_string()));
        let is = |what: &str| Err((ErrorKind::InvalidInput, format!("it is {what}, not a regular file")));
        assert_eq!(refused(&pipe), is("a pipe"));
        assert_eq!(refused(directory.path()), is("a directory"));
        assert_eq!(refused(Path::new("/dev/zero")), is("a device"));
        assert_eq!(refused(&file).as_deref(), Ok(&b"1234567"[..]));
        assert_eq!(refused(&link).as_deref(), Ok(&b"1234567"[..]));
        assert_eq!(read(&file, 6).unwrap_err().kind(), ErrorKind::FileTooLarge);
        // The kernel reports a size of 0 for this file.
        assert!(read(Path::new("/proc/self/status"), 1 << 16).unwrap().len() > 100);
        fs::write(&file, b"\xFF").unwrap();
        assert_eq!(read_text(&file, 6).unwrap_err().kind(), ErrorKind::InvalidData);
        fs::remove_file(&file).unwrap();
        assert_eq!(read(&file, 6).unwrap_err().kind(), ErrorKind::NotFound);
    }
}
