//! What must be there before the hub takes its first sensor: descriptors for all consumers, and memory for every
//! segment of its own, really allocated. A sparse segment that finds /dev/shm full would kill the hub later.

use std::fs::{self, OpenOptions};

use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;
use rustix::process::{Resource, getrlimit, setrlimit};
use schema::shortage::{self, SHARED_MEMORY};
use schema::{
    Background, Domain, Failure, Foreground, Header, Marks, Scan, Status, Telegram, Topic, Zones, limits,
};

/// Lets the process have as many descriptors as its hard limit allows: about four for each consumer of a topic.
pub(crate) fn raise_descriptor_limit() {
    let mut limit = getrlimit(Resource::Nofile);
    limit.current = limit.maximum;
    if let Err(error) = setrlimit(Resource::Nofile, limit) {
        tracing::warn!(%error, "cannot raise the limit of open descriptors: fewer consumers can attach");
    }
}

/// Whether /dev/shm has room for `links` links and the first consumers.
///
/// [`Kind::Short`](schema::Kind) with what is free and what is needed.
pub(crate) fn check_memory(links: usize) -> Result<(), Failure> {
    shortage::check_memory(needed(links))
}

/// Bytes of shared memory for `links` links and the first consumers.
pub(crate) fn needed(links: usize) -> u64 {
    links as u64 * link_bytes() + REST
}

/// Whether `links` links, and a first consumer of each, have descriptors enough.
///
/// [`Kind::Short`](schema::Kind) with the limit and what is needed.
pub(crate) fn check_descriptors(links: usize) -> Result<(), Failure> {
    shortage::check_descriptors(needed_descriptors(links))
}

/// Descriptors for `links` links and a first consumer of each, beside those open from the start.
pub(crate) fn needed_descriptors(links: usize) -> u64 {
    BASE_DESCRIPTORS + links as u64 * LINK_DESCRIPTORS
}

/// Allocates what the segments of `domain` have promised so far.
///
/// [`Kind::Short`](schema::Kind) if it cannot be had.
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
                return Err(shortage::memory(&format!(
                    "{} kB for {name} cannot be had",
                    metadata.len() / 1024
                )));
            }
            Err(error) => tracing::debug!(%error, "a segment cannot be allocated"),
            Ok(()) => {}
        }
    }
    Ok(())
}

/// Bytes of the segments of one link: the payloads with their headers, and who is at each service.
fn link_bytes() -> u64 {
    let payload = |topic| match topic {
        Topic::Telegram => Telegram::MAX,
        Topic::Scan => size_of::<Scan>(),
        Topic::Marks => size_of::<Marks>(),
        Topic::Zones => size_of::<Zones>(),
        Topic::Foreground => size_of::<Foreground>(),
        Topic::Background => size_of::<Background>(),
        Topic::Status => size_of::<Status>(),
    };
    let chunk = |topic| limits::samples(topic) * (payload(topic) + size_of::<Header>() + CHUNK_HEADER);
    let services = (Topic::ALL.len() + 1) as u64 * SERVICE;
    Topic::ALL.into_iter().map(chunk).sum::<usize>() as u64 + services
}

/// Descriptors of what belongs to no link, beside those open from the start: 16 are left open, making them takes more.
const BASE_DESCRIPTORS: u64 = 24;
/// Descriptors of a link: four for each of its eight services, its port, and a first consumer.
const LINK_DESCRIPTORS: u64 = 38;
/// What the shared-memory library puts before each sample, rounded up.
const CHUNK_HEADER: usize = 64;
/// The list of ports and processes of one service, rounded up.
const SERVICE: u64 = 48 * 1024;
/// The control service, what belongs to no link, and the first consumers.
const REST: u64 = 512 * 1024;

#[cfg(test)]
mod tests {
    use super::*;

    use schema::Kind;

    #[test]
    fn more_links_than_memory_are_refused() {
        assert!(check_memory(2).is_ok());
        let failure = check_memory(1 << 40).unwrap_err();
        assert_eq!(failure.kind, Kind::Short);
        assert!(failure.message.contains("kB needed"), "{failure}");
    }
}
