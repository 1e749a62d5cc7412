//! What must be there before the hub takes its first sensor: descriptors for all consumers, and memory for every
//! segment of its own. A sparse segment that finds /dev/shm full would kill the hub later.

use config::needs;
use schema::limits::TopicLimits;
use schema::{Failure, Kind};
use shm::shortage;

/// Lets the process have as many descriptors as its hard limit allows.
pub(crate) fn raise_descriptor_limit() {
    if let Err(error) = shortage::raise_descriptor_limit() {
        tracing::warn!(%error, "cannot raise the limit of open descriptors: fewer consumers can attach");
    }
}

/// Whether /dev/shm has room for links with topics made as `limits` say of each and the first consumers, and the process may
/// map it beside its threads.
///
/// [`Kind::Short`](schema::Kind) with what is free and what is needed.
pub(crate) fn check_memory(limits: &[TopicLimits]) -> Result<(), Failure> {
    let needed = needs::memory(limits);
    shortage::check_address_space(needed + limits.len() as u64 * THREAD)?;
    shortage::check_memory(needed, needs::longest_segment(limits))
}

/// Whether `links` links, and a first consumer of each, have descriptors enough.
///
/// [`Kind::Short`](schema::Kind) with the limit and what is needed.
pub(crate) fn check_descriptors(links: usize) -> Result<(), Failure> {
    shortage::check_descriptors(needs::descriptors(links))
}

/// `what` is not available now.
pub(crate) fn no_resource(what: &str, error: &dyn std::fmt::Display) -> Failure {
    Failure::new(Kind::Short, format!("cannot get {what}: {error}"), "try again later")
}

/// Address space of a link's thread: its stack, its heap, and what it maps beside its segments.
const THREAD: u64 = 4 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_links_than_memory_are_refused() {
        assert!(check_memory(&[TopicLimits::default(); 2]).is_ok());
        let huge = TopicLimits { telegram: 1 << 50, ..TopicLimits::default() };
        let failure = check_memory(&[huge]).unwrap_err();
        assert_eq!(failure.kind, Kind::Short);
        assert!(failure.message.contains("kB needed"), "{failure}");
    }
}
