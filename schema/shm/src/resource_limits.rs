//! Checks of this machine's limits before something is created: shared memory, descriptors, and room for the files of a
//! domain.
//!
//! The shared-memory library reserves segments without allocating them. With a full /dev/shm, the first access would
//! end the process with SIGBUS, so a publisher calls [`allocate`](crate::allocate). For any other shortage, the library
//! only reports "internal error".

use std::io;
use std::path::Path;

use rustix::fs::{StatVfs, statvfs};
use rustix::io::Errno;
use rustix::param::page_size;
use rustix::process::{Resource, getrlimit, setrlimit};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Header, Kind, Topic, limits};

/// Directory of POSIX shared memory on Linux.
pub const SHARED_MEMORY_DIRECTORY: &str = "/dev/shm";

/// Bytes of shared memory for the segments of a subscriber or control client, with a reserve for other clients that
/// start at the same time. Each segment has a few pages.
const CLIENT_BYTES: u64 = 64 * 1024;

/// Number of descriptors that each further topic or event needs, with a reserve.
const PORT_DESCRIPTORS: u64 = 8;

/// Number of descriptors that a client of the control service needs.
pub(crate) const CONTROL_DESCRIPTORS: u64 = 24;

/// Fails if fewer than `needed` bytes of shared memory are free, or if the limits of this process do not allow these
/// bytes in segments of up to `max_segment` bytes.
///
/// # Errors
///
/// Returns [`Kind::ResourceExhausted`] with the free and the needed bytes.
pub fn check_memory(needed: u64, max_segment: u64) -> Result<(), Failure> {
    check_free_space(Path::new(SHARED_MEMORY_DIRECTORY), needed).map_err(|what| memory_failure(&what))?;
    check_file_size(max_segment)?;
    check_address_space(needed)
}

/// Fails with [`Kind::ResourceExhausted`] if this process may not create files of `needed` bytes. Segments are files.
fn check_file_size(needed: u64) -> Result<(), Failure> {
    let limit = getrlimit(Resource::Fsize).current.unwrap_or(u64::MAX);
    if limit >= needed {
        return Ok(());
    }
    let what = format!(
        "the limit on file sizes is too low: it is {} kB, and a segment of shared memory needs {} kB",
        limit / 1024,
        needed.div_ceil(1024)
    );
    Err(Failure::new(
        Kind::ResourceExhausted,
        what,
        "raise the limit: `ulimit -f unlimited`, for a service LimitFSIZE",
    ))
}

/// Fails if this process may not map `needed` more bytes, plus the memory that is needed to create the segments.
/// Without this check, the library would leave behind a segment that it cannot map.
///
/// # Errors
///
/// Returns [`Kind::ResourceExhausted`] with the limit and the needed bytes.
pub fn check_address_space(needed: u64) -> Result<(), Failure> {
    let Some(limit) = getrlimit(Resource::As).current else { return Ok(()) };
    let mapped_pages =
        std::fs::read_to_string(PAGE_COUNTS_FILE).ok().and_then(|text| text.split(' ').next()?.parse().ok());
    let free = limit.saturating_sub(mapped_pages.unwrap_or(0) * page_size() as u64);
    let needed = needed + CREATION_BYTES;
    if free >= needed {
        return Ok(());
    }
    let (free, needed, limit) = (free / 1024, needed.div_ceil(1024), limit / 1024);
    Err(Failure::new(
        Kind::ResourceExhausted,
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
/// Returns [`Kind::ResourceExhausted`] with the limit and the needed number.
pub fn check_descriptors(needed: u64) -> Result<(), Failure> {
    let limit = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    let open = match std::fs::read_dir(OPEN_DESCRIPTORS_DIRECTORY) {
        // Listing the open descriptors needs a descriptor too, which is not counted.
        Ok(entries) => entries.count() as u64 - 1,
        Err(error) => assumed_descriptors(&error, limit),
    };
    if limit.saturating_sub(open) >= needed {
        return Ok(());
    }
    Err(Failure::new(
        Kind::ResourceExhausted,
        format!("descriptors are short: {open} are open, {needed} more needed, the limit is {limit}"),
        "raise the limit: `ulimit -n`, for a service LimitNOFILE",
    ))
}

/// Raises the limit of descriptors to the hard limit. A publisher needs about four descriptors for each subscriber of a
/// topic.
///
/// # Errors
///
/// Returns the system's error if it refuses the new limit.
pub fn raise_descriptor_limit() -> io::Result<()> {
    let mut limit = getrlimit(Resource::Nofile);
    limit.current = limit.maximum;
    Ok(setrlimit(Resource::Nofile, limit)?)
}

/// Returns the failure that shared memory is short, with the message `what`.
pub fn memory_failure(what: &str) -> Failure {
    Failure::new(
        Kind::ResourceExhausted,
        format!("shared memory is short: {SHARED_MEMORY_DIRECTORY}: {what}"),
        format!("free some of {SHARED_MEMORY_DIRECTORY}, then start again"),
    )
}

/// Fails if memory or descriptors do not suffice for another port of a client. Without this check, the library would
/// create a port that receives nothing, or end the process.
pub(crate) fn check_client() -> Result<(), Failure> {
    check_descriptors(PORT_DESCRIPTORS).and_then(|()| check_memory(CLIENT_BYTES, CLIENT_BYTES))
}

/// Returns a shortage that may be the reason why something failed in the domain at `root`, or `None` if nothing is
/// short.
pub(crate) fn find_shortage(root: &Path) -> Option<Failure> {
    let files = || {
        let directory = root.ancestors().find(|path| path.exists()).unwrap_or(root);
        let hint = "free some of it, or choose another location with --root";
        check_free_space(directory, CLIENT_BYTES).map_err(|what| {
            Failure::new(Kind::ResourceExhausted, format!("{}: {what}", root.display()), hint)
        })
    };
    check_descriptors(2 * PORT_DESCRIPTORS)
        .and_then(|()| check_memory(CLIENT_BYTES, CLIENT_BYTES))
        .and_then(|()| files())
        .err()
}

/// Returns the number of open descriptors to assume if listing them failed with `error`. Returns `limit` if no
/// descriptor was left for the list. Otherwise returns 0, because only the list may be unavailable: not every container
/// has /proc.
fn assumed_descriptors(error: &io::Error, limit: u64) -> u64 {
    match Errno::from_io_error(error) {
        Some(Errno::MFILE | Errno::NFILE) => limit,
        _ => 0,
    }
}

/// Fails with a message if fewer than `needed` bytes are free in the file system of `path`.
fn check_free_space(path: &Path, needed: u64) -> Result<(), String> {
    let Ok(stat) = statvfs(path) else { return Ok(()) };
    let free = free(&stat);
    if free >= needed {
        return Ok(());
    }
    Err(format!("{} kB free, {} kB needed", free / 1024, needed.div_ceil(1024)))
}

/// Returns the free bytes of a file system. A file system without blocks, such as a tmpfs without a size, has no limit.
fn free(stat: &StatVfs) -> u64 {
    if stat.f_blocks == 0 { u64::MAX } else { stat.f_bavail * stat.f_frsize }
}

/// Address space in bytes that is needed while segments are created: the heap of a thread, tables, and a message about
/// a failure.
const CREATION_BYTES: u64 = 8 << 20;

/// File with the number of pages of this process. The first number counts all mapped pages.
const PAGE_COUNTS_FILE: &str = "/proc/self/statm";

/// Directory of this process's open descriptors.
const OPEN_DESCRIPTORS_DIRECTORY: &str = "/proc/self/fd";

/// Returns the bytes of all segments of one sensor's `topics` if they are created with `limits`: payloads with their
/// headers, and the lists of each service.
pub fn sensor_bytes(topics: &[Topic], limits: &TopicLimits) -> u64 {
    let chunk = |&topic: &Topic| {
        limits::sample_count(topic, limits.subscribers) * (topic.max_payload_len(limits) + CHUNK_HEADER_LEN)
    };
    let services = (topics.len() + 1) as u64 * SERVICE_BYTES;
    topics.iter().map(chunk).sum::<usize>() as u64 + services
}

/// Returns the bytes of the longest segment of one sensor's `topics` if they are created with `limits`.
pub fn longest_segment(topics: &[Topic], limits: &TopicLimits) -> u64 {
    topics.iter().map(|&topic| sensor_bytes(&[topic], limits)).max().unwrap_or_default()
}

/// Bytes before each sample, rounded up: the header, and the data of the shared-memory library.
const CHUNK_HEADER_LEN: usize = size_of::<Header>() + 64;
/// Bytes of the list of ports and processes of one service, rounded up.
const SERVICE_BYTES: u64 = 48 * 1024;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_beyond_available_resources_are_refused() {
        assert_eq!((check_memory(0, 0), check_descriptors(0)), (Ok(()), Ok(())));
        let memory = check_memory(1 << 60, 0).unwrap_err();
        assert_eq!(memory.kind, Kind::ResourceExhausted);
        assert!(memory.message.contains(&format!("{} kB needed", 1_u64 << 50)), "{memory}");
        let descriptors = check_descriptors(1 << 60).unwrap_err();
        assert_eq!(descriptors.kind, Kind::ResourceExhausted);
        assert!(descriptors.message.contains(&format!("{} more needed", 1_u64 << 60)), "{descriptors}");
    }

    #[test]
    fn file_system_without_a_size_is_not_full() {
        let mut stat = statvfs(SHARED_MEMORY_DIRECTORY).unwrap();
        (stat.f_frsize, stat.f_blocks, stat.f_bavail) = (4096, 100, 0);
        assert_eq!(free(&stat), 0);
        stat.f_bavail = 10;
        assert_eq!(free(&stat), 40_960);
        (stat.f_blocks, stat.f_bavail) = (0, 0);
        assert_eq!(free(&stat), u64::MAX);
    }

    #[test]
    fn missing_proc_does_not_count_as_a_shortage() {
        for (error, open) in
            [(Errno::MFILE, 1000), (Errno::NFILE, 1000), (Errno::NOENT, 0), (Errno::ACCESS, 0)]
        {
            assert_eq!(assumed_descriptors(&error.into(), 1000), open, "{error}");
        }
    }
}
