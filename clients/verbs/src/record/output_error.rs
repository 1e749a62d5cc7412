//! Why a recording cannot be written, and what helps.

use std::io::{self, ErrorKind};
use std::path::Path;

use scanhub_schema::{Failure, Kind};

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
        ErrorKind::InvalidInput => "name another file: -o FILE",
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
