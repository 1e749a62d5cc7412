//! What must be there before the hub takes its first sensor: descriptors for all consumers, and memory for every
//! segment of its own. A sparse segment that finds /dev/shm full would kill the hub later.

use schema::shortage::{self, sensor_bytes};
use schema::{Failure, Topic};

/// Lets the process have as many descriptors as its hard limit allows.
pub(crate) fn raise_descriptor_limit() {
    if let Err(error) = shortage::raise_descriptor_limit() {
        tracing::warn!(%error, "cannot raise the limit of open descriptors: fewer consumers can attach");
    }
}

/// Whether /dev/shm has room for `links` links and the first consumers, and the process may map it beside its threads.
///
/// [`Kind::Short`](schema::Kind) with what is free and what is needed.
pub(crate) fn check_memory(links: usize) -> Result<(), Failure> {
    shortage::check_address_space(needed(links) + links as u64 * THREAD)?;
    shortage::check_memory(needed(links))
}

/// Bytes of shared memory for `links` links and the first consumers.
pub(crate) fn needed(links: usize) -> u64 {
    links as u64 * sensor_bytes(&Topic::ALL) + REST
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

/// Descriptors of what belongs to no link, beside those open from the start: 16 are left open, making them takes more.
const BASE_DESCRIPTORS: u64 = 24;
/// Descriptors of a link: four for each of its eight services, its port, and a first consumer.
const LINK_DESCRIPTORS: u64 = 38;
/// Address space of a link's thread: its stack, its heap, and what it maps beside its segments.
const THREAD: u64 = 4 << 20;
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
