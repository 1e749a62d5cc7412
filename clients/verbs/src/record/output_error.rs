//! Why a path cannot hold a recording, and what helps. Refuses to open anything.

use std::fs;
use std::io::{self, ErrorKind};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;

use schema::{Failure, Kind};

/// The file at `path` cannot hold a recording, whatever its permissions; `force` accepts a device all the same.
///
/// [`Kind::Output`] with what would be one.
pub(super) fn check(path: &Path, force: bool) -> Result<(), Failure> {
    let Ok(place) = fs::metadata(path).map(|place| place.file_type()) else { return Ok(()) };
    let shown = path.display();
    let (what, hint) = if place.is_dir() {
        ("directory", format!("name a file in it: -o {}", path.join("walk.mcap").display()))
    } else if place.is_fifo() {
        // Opening one waits for its reader, and nobody could end that.
        ("pipe", format!("the shell opens it: scanhub record -o - > {shown}"))
    } else if place.is_socket() {
        ("socket", "-o FILE names a file".to_owned())
    } else if (place.is_char_device() || place.is_block_device()) && !force {
        ("device", "-o FILE names a file; --force overwrites the content of the device".to_owned())
    } else {
        return Ok(());
    };
    Err(Failure::new(Kind::Output, format!("cannot record into {shown}: it is a {what}"), hint))
}

/// What kind of failure it is that `error` comes of a write: of a disk that is full, or may not be filled any further,
/// there may be more later.
pub(super) fn kind(error: &io::Error) -> Kind {
    match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => Kind::Short,
        _ => Kind::Failed,
    }
}

/// No file could be made at `path`, of a run that `is_split`.
pub(super) fn failed(path: &Path, is_split: bool, error: &io::Error) -> Failure {
    let hint = match error.kind() {
        ErrorKind::AlreadyExists if is_split => {
            "--force continues after the last number; -o FILE names others"
        }
        ErrorKind::AlreadyExists => "--force overwrites it; -o FILE names another",
        ErrorKind::ResourceBusy => "stop it first, or name another file: -o FILE",
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            "free some space, or name another place: -o FILE"
        }
        ErrorKind::FileTooLarge => "raise the limit: `ulimit -f unlimited`, for a service LimitFSIZE",
        _ => "the directory must exist and be writable; -o FILE names another place",
    };
    let kind = match kind(error) {
        Kind::Failed => Kind::Output,
        other => other,
    };
    Failure::new(kind, format!("cannot record into {}: {error}", path.display()), hint)
}

/// Who read the recording went away after `samples`. That it goes through a pipe makes it no less a recording: what was to
/// come is missing.
pub(super) fn reader_gone(samples: u64) -> Failure {
    let what = format!("the reader of the recording is gone: it has at most {samples} samples");
    let hint = "see why the program or the connection behind the pipe ended; `scanhub convert` writes a copy with an index";
    Failure::new(Kind::Failed, what, hint)
}
