//! What is short on this machine: shared memory, descriptors, room for a domain's files. The shared-memory library
//! reserves segments without allocating them, so with a full /dev/shm the first access ends the process with SIGBUS; for
//! any other shortage it only says "internal error". Refuses to know what something is needed for.

mod segments;

use std::io;
use std::path::Path;

use rustix::fs::{StatVfs, statvfs};
use rustix::io::Errno;
use rustix::param::page_size;
use rustix::process::{Resource, getrlimit, setrlimit};

use crate::{Failure, Kind};

pub use segments::{allocate, longest_segment, sensor_bytes};

/// Where POSIX shared memory lives on Linux.
pub const SHARED_MEMORY: &str = "/dev/shm";

/// What the segments of a consumer or of a client of the control service take, and some for others that come at the
/// same time: each has a few pages.
const CLIENT_BYTES: u64 = 64 * 1024;

/// Descriptors that one more topic or event takes, with some to spare.
const PORT_DESCRIPTORS: u64 = 8;

/// Descriptors that a client of the control service takes.
pub(crate) const CONTROL_DESCRIPTORS: u64 = 24;

/// Fails if fewer than `needed` bytes of shared memory, in segments of at most `longest`, are free or allowed for this process.
///
/// # Errors
///
/// [`Kind::Short`] with what is free and what is needed.
pub fn check_memory(needed: u64, longest: u64) -> Result<(), Failure> {
    check_place(Path::new(SHARED_MEMORY), needed).map_err(|what| memory(&what))?;
    check_file_size(longest)?;
    check_address_space(needed)
}

/// Fails if this process may not create files of `needed` bytes, because segments are files.
///
/// [`Kind::Short`] with the limit and what is needed.
fn check_file_size(needed: u64) -> Result<(), Failure> {
    let limit = getrlimit(Resource::Fsize).current.unwrap_or(u64::MAX);
    if limit >= needed {
        return Ok(());
    }
    let what = format!(
        "files are too short: {} kB at most, a segment of shared memory needs {} kB",
        limit / 1024,
        needed.div_ceil(1024)
    );
    Err(Failure::new(Kind::Short, what, "raise the limit: `ulimit -f unlimited`, for a service LimitFSIZE"))
}

/// Fails if this process may not map `needed` more bytes and what creating them takes: the library would leave behind a
/// segment that it cannot map.
///
/// # Errors
///
/// [`Kind::Short`] with the limit and what is needed.
pub fn check_address_space(needed: u64) -> Result<(), Failure> {
    let Some(limit) = getrlimit(Resource::As).current else { return Ok(()) };
    let taken = std::fs::read_to_string(MAPPED).ok().and_then(|text| text.split(' ').next()?.parse().ok());
    let free = limit.saturating_sub(taken.unwrap_or(0) * page_size() as u64);
    let needed = needed + MAKING_BYTES;
    if free >= needed {
        return Ok(());
    }
    let (free, needed, limit) = (free / 1024, needed.div_ceil(1024), limit / 1024);
    Err(Failure::new(
        Kind::Short,
        format!(
            "address space is short: {free} kB are free, {needed} kB more needed, the limit is {limit} kB"
        ),
        "raise the limit: `ulimit -v`, for a service LimitAS",
    ))
}

/// Fails if fewer than `needed` more descriptors can be opened.
///
/// # Errors
///
/// [`Kind::Short`] with the limit and what is needed.
pub fn check_descriptors(needed: u64) -> Result<(), Failure> {
    let limit = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    let open = match std::fs::read_dir(OPEN) {
        // To list them needs one too.
        Ok(entries) => entries.count() as u64 - 1,
        Err(error) => without_list(&error, limit),
    };
    if limit.saturating_sub(open) >= needed {
        return Ok(());
    }
    Err(Failure::new(
        Kind::Short,
        format!("descriptors are short: {open} are open, {needed} more needed, the limit is {limit}"),
        "raise the limit: `ulimit -n`, for a service LimitNOFILE",
    ))
}

/// Raises the limit of descriptors to the hard limit: a publisher needs about four for each consumer of a topic.
///
/// # Errors
///
/// The system's error if it does not let it.
pub fn raise_descriptor_limit() -> io::Result<()> {
    let mut limit = getrlimit(Resource::Nofile);
    limit.current = limit.maximum;
    Ok(setrlimit(Resource::Nofile, limit)?)
}

/// Returns the failure that shared memory is short, in the words of `what`.
pub fn memory(what: &str) -> Failure {
    Failure::new(
        Kind::Short,
        format!("shared memory is short: {SHARED_MEMORY}: {what}"),
        format!("free some of {SHARED_MEMORY}, then start again"),
    )
}

/// Refuses to make one more of a consumer's ports where there is no room for it: the library would make one that gets
/// nothing, or end the process.
pub(crate) fn check_client() -> Result<(), Failure> {
    check_descriptors(PORT_DESCRIPTORS).and_then(|()| check_memory(CLIENT_BYTES, CLIENT_BYTES))
}

/// What is so short that it may be why something failed in the domain at `root`.
pub(crate) fn found(root: &Path) -> Option<Failure> {
    let files = || {
        let place = root.ancestors().find(|path| path.exists()).unwrap_or(root);
        let hint = "free some of it, or choose another place with --root";
        check_place(place, CLIENT_BYTES)
            .map_err(|what| Failure::new(Kind::Short, format!("{}: {what}", root.display()), hint))
    };
    check_descriptors(2 * PORT_DESCRIPTORS)
        .and_then(|()| check_memory(CLIENT_BYTES, CLIENT_BYTES))
        .and_then(|()| files())
        .err()
}

/// How many descriptors are open, of at most `limit`, where `error` came instead of their list. None that would be in
/// the way if only the list is not there: not every container has /proc.
fn without_list(error: &io::Error, limit: u64) -> u64 {
    match Errno::from_io_error(error) {
        Some(Errno::MFILE | Errno::NFILE) => limit,
        _ => 0,
    }
}

/// What is free at `place` and what is needed, if that is more.
fn check_place(place: &Path, needed: u64) -> Result<(), String> {
    let Ok(stat) = statvfs(place) else { return Ok(()) };
    let free = free(&stat);
    if free >= needed {
        return Ok(());
    }
    Err(format!("{} kB free, {} kB needed", free / 1024, needed.div_ceil(1024)))
}

/// Bytes that are free in a file system; one that counts no blocks, as a tmpfs without a size, has no limit.
fn free(stat: &StatVfs) -> u64 {
    if stat.f_blocks == 0 { u64::MAX } else { stat.f_bavail * stat.f_frsize }
}

/// Address space that making a few segments takes beside them: a heap for a thread, tables, a message about a failure.
const MAKING_BYTES: u64 = 8 << 20;

/// How many pages the own process has, first of all that are mapped.
const MAPPED: &str = "/proc/self/statm";

/// The list of the own open descriptors.
const OPEN: &str = "/proc/self/fd";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_more_than_there_is_is_refused() {
        assert_eq!((check_memory(0, 0), check_descriptors(0)), (Ok(()), Ok(())));
        let memory = check_memory(1 << 60, 0).unwrap_err();
        assert_eq!(memory.kind, Kind::Short);
        assert!(memory.message.contains(&format!("{} kB needed", 1_u64 << 50)), "{memory}");
        let descriptors = check_descriptors(1 << 60).unwrap_err();
        assert_eq!(descriptors.kind, Kind::Short);
        assert!(descriptors.message.contains(&format!("{} more needed", 1_u64 << 60)), "{descriptors}");
    }

    #[test]
    fn a_file_system_without_a_size_is_not_full() {
        let mut stat = statvfs(SHARED_MEMORY).unwrap();
        (stat.f_frsize, stat.f_blocks, stat.f_bavail) = (4096, 100, 0);
        assert_eq!(free(&stat), 0);
        stat.f_bavail = 10;
        assert_eq!(free(&stat), 40_960);
        (stat.f_blocks, stat.f_bavail) = (0, 0);
        assert_eq!(free(&stat), u64::MAX);
    }

    #[test]
    fn a_machine_without_proc_is_not_short() {
        for (error, open) in
            [(Errno::MFILE, 1000), (Errno::NFILE, 1000), (Errno::NOENT, 0), (Errno::ACCESS, 0)]
        {
            assert_eq!(without_list(&error.into(), 1000), open, "{error}");
        }
    }
}
