//! What must be there before the hub takes its first sensor: descriptors for all consumers, and memory for every
//! segment of its own, really allocated. A sparse segment that finds /dev/shm full would kill the hub later.

use std::fs::{self, OpenOptions};

use rustix::fs::{FallocateFlags, fallocate, statvfs};
use rustix::io::Errno;
use rustix::process::{Resource, getrlimit, setrlimit};
use schema::{Domain, Failure, Header, Kind, Scan, Status, Telegram, Topic, limits};

/// Lets the process have as many descriptors as its hard limit allows: about four for each consumer of a topic.
pub(crate) fn raise_descriptor_limit() {
    let mut limit = getrlimit(Resource::Nofile);
    limit.current = limit.maximum;
    if let Err(error) = setrlimit(Resource::Nofile, limit) {
        tracing::warn!(%error, "cannot raise the limit of open descriptors: fewer consumers can attach");
    }
}

/// Whether /dev/shm has room for `links` links.
///
/// [`Kind::Short`] with what is free and what is needed.
pub(crate) fn check_memory(links: usize) -> Result<(), Failure> {
    let needed = links as u64 * link_bytes();
    let Ok(stat) = statvfs(SHARED_MEMORY) else { return Ok(()) };
    let free = stat.f_bavail * stat.f_frsize;
    if free >= needed {
        Ok(())
    } else {
        Err(short(format!("{} kB free, {} kB needed", free / 1024, needed / 1024)))
    }
}

/// Allocates what the segments of `domain` have promised so far.
///
/// [`Kind::Short`] if it cannot be had.
pub(crate) fn allocate(domain: &Domain) -> Result<(), Failure> {
    let prefix = domain.prefix();
    let entries = fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
    for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix)) {
        // What is another process's, or gone again, is not ours to allocate.
        let Ok(segment) = OpenOptions::new().write(true).open(entry.path()) else { continue };
        let Ok(metadata) = segment.metadata() else { continue };
        if metadata.len() == 0 {
            continue;
        }
        match fallocate(&segment, FallocateFlags::empty(), 0, metadata.len()) {
            Err(Errno::NOSPC) => {
                let name = entry.file_name().to_string_lossy().into_owned();
                return Err(short(format!("{} kB for {name} cannot be had", metadata.len() / 1024)));
            }
            Err(error) => tracing::debug!(%error, "a segment cannot be allocated"),
            Ok(()) => {}
        }
    }
    Ok(())
}

fn short(what: String) -> Failure {
    let place = SHARED_MEMORY;
    Failure::new(
        Kind::Short,
        format!("shared memory is short: {place}: {what}"),
        "free some, then start again",
    )
}

/// Bytes of the segments of one link: the payloads with their headers, and as much again for the rest.
pub(crate) fn link_bytes() -> u64 {
    let payload = |topic| match topic {
        Topic::Telegram => Telegram::MAX,
        Topic::Scan => size_of::<Scan>(),
        Topic::Status => size_of::<Status>(),
    };
    let chunk = |topic| limits::samples(topic) * (payload(topic) + size_of::<Header>() + CHUNK_HEADER);
    2 * Topic::ALL.into_iter().map(chunk).sum::<usize>() as u64
}

/// Where POSIX shared memory lives on Linux.
pub(crate) const SHARED_MEMORY: &str = "/dev/shm";
/// What the shared-memory library puts before each sample, rounded up.
const CHUNK_HEADER: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_links_than_memory_are_refused() {
        assert!(check_memory(2).is_ok());
        let failure = check_memory(1 << 40).unwrap_err();
        assert_eq!(failure.kind, Kind::Short);
        assert!(failure.message.contains("kB needed"), "{failure}");
    }
}
