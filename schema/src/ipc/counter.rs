//! The one segment that the shared-memory library opens to all users of the machine: its counter of nodes. Anybody who can
//! write to it can keep every later process out. So it is created here, for this user only, before the library looks for
//! it; the library uses what it finds.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;

use super::strangers::{Segment, in_the_way};
use crate::shortage::{SHARED_MEMORY, memory};
use crate::{Failure, Kind};

/// Makes sure that the counter under `prefix` is there and this user's alone.
///
/// # Errors
///
/// [`Kind::Failed`] with file, owner and remedy if another user has put something there or could write to it;
/// [`Kind::Short`] if there is no memory for it.
pub(super) fn ensure(prefix: &str) -> Result<(), Failure> {
    let path = path(prefix);
    loop {
        match Segment::at(&path) {
            Some(segment) if !segment.is_own() => return Err(in_the_way(&segment)),
            // The library's own, or one for the rest of which it would wait for ever.
            Some(segment) if segment.is_foreign() || segment.bytes != CONTENT.len() as u64 => remove(prefix),
            Some(_) => return Ok(()),
            None => make(&path)?,
        }
    }
}

/// Removes the counter under `prefix`, which nobody needs any more.
pub(super) fn remove(prefix: &str) {
    let _ = std::fs::remove_file(path(prefix));
}

/// It appears with its content, or another process was faster.
fn make(path: &Path) -> Result<(), Failure> {
    // Threads of one process may make it at the same time.
    static MADE: AtomicU32 = AtomicU32::new(0);
    let number = MADE.fetch_add(1, Ordering::Relaxed);
    let beside = path.with_extension(format!("new-{}-{number}", std::process::id()));
    let written = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&beside);
    let written = written.and_then(|mut file: File| file.write_all(&CONTENT));
    let placed =
        written.and_then(|()| match renameat_with(CWD, &beside, CWD, path, RenameFlags::NOREPLACE) {
            Err(Errno::EXIST) => Ok(()),
            placed => Ok(placed?),
        });
    let _ = std::fs::remove_file(&beside);
    placed.map_err(|error| match Errno::from_io_error(&error) {
        Some(Errno::NOSPC) => memory(&format!("no room for {}: 16 bytes", path.display())),
        _ => Failure::new(Kind::Failed, format!("{}: {error}", path.display()), "scanhub doctor --clean"),
    })
}

fn path(prefix: &str) -> PathBuf {
    Path::new(SHARED_MEMORY).join(format!("{prefix}{NAME}"))
}

/// A name with the hash of a type, as iceoryx2 0.10.0 makes it (`DynamicStorageConfiguration::path_for_with_type`); the
/// test below compares.
const NAME: &str = "9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt";

/// What the library writes (`posix_shared_memory::Data`): its version as it packs it, then the counter, from 0.
const CONTENT: [u8; 16] = {
    let (version, mut content) = ((10_u64 << 16).to_ne_bytes(), [0; 16]);
    let mut i = 0;
    while i < version.len() {
        content[i] = version[i];
        i += 1;
    }
    content
};

#[cfg(test)]
mod tests {
    use std::fs;

    use iceoryx2::config::Config;
    use iceoryx2::prelude::{FileName, NodeBuilder, SemanticString, SignalHandlingMode};

    use super::super::Service;
    use super::*;

    #[test]
    fn it_is_the_one_that_the_library_would_make() {
        let base = tempfile::tempdir().unwrap();
        let prefix = format!("sh_k{}_", std::process::id());
        let join = || {
            let mut config = Config::default();
            config.global.prefix = FileName::new(prefix.as_bytes()).unwrap();
            config.global.set_root_path(
                &iceoryx2::prelude::Path::new(base.path().as_os_str().as_encoded_bytes()).unwrap(),
            );
            let builder = NodeBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled);
            builder.config(&config).create::<Service>().unwrap()
        };
        let files = || {
            let entries = fs::read_dir(SHARED_MEMORY).unwrap().flatten();
            let own = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix));
            own.map(|entry| (entry.path(), fs::read(entry.path()).unwrap())).collect::<Vec<_>>()
        };
        drop(join());
        let theirs = files();
        let mode = Segment::at(&path(&prefix)).map(|it| it.mode);
        remove(&prefix);
        let removed = files();
        ensure(&prefix).unwrap();
        let ours = files();
        drop(join());
        let counted = files();
        ensure(&prefix).unwrap();
        let kept = (files(), Segment::at(&path(&prefix)).map(|it| it.mode));
        remove(&prefix);
        drop(join());
        ensure(&prefix).unwrap();
        let closed = Segment::at(&path(&prefix)).map(|it| it.mode);
        fs::write(path(&prefix), "cut").unwrap();
        ensure(&prefix).unwrap();
        let mended = files();
        remove(&prefix);

        let content = |count: u32| {
            let mut content = CONTENT;
            content[8..12].copy_from_slice(&count.to_ne_bytes());
            vec![(path(&prefix), content.to_vec())]
        };
        assert_eq!((theirs, mode), (content(1), Some(0o666)), "another version of the library");
        assert_eq!((removed, ours, &counted), (vec![], content(0), &content(1)));
        assert_eq!((kept, mended), ((counted, Some(0o600)), content(0)));
        assert_eq!(closed, Some(0o600), "the library's own, which is open to all, does not stay");
    }
}
