//! The memory of a publisher: how much the topics of a sensor need, and that it is really allocated. A sparse segment
//! would end the process later if /dev/shm is full then.

use std::fs::{self, OpenOptions};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};

use rustix::fs::{FallocateFlags, OFlags, fallocate};
use rustix::io::Errno;

use super::{SHARED_MEMORY, memory};
use crate::limits::TopicLimits;
use crate::{Domain, Failure, Header, Topic, limits, prefix};

/// Allocates what the segments of `domain` have promised so far.
///
/// # Errors
///
/// [`Kind::Short`](crate::Kind) if it cannot be had.
pub fn allocate(domain: &Domain) -> Result<(), Failure> {
    let Some(prefix) = prefix::of(domain.root())? else { return Ok(()) };
    let user = rustix::process::geteuid().as_raw();
    let entries = fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
    for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix)) {
        // What is another user's, or gone again, is not ours to allocate.
        if !entry.metadata().is_ok_and(|metadata| metadata.is_file() && metadata.uid() == user) {
            continue;
        }
        let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
        let Ok(segment) = OpenOptions::new().write(true).custom_flags(flags).open(entry.path()) else {
            continue;
        };
        let Ok(metadata) = segment.metadata() else { continue };
        if metadata.len() == 0 {
            continue;
        }
        // For any other reason it may be had later all the same.
        if fallocate(&segment, FallocateFlags::empty(), 0, metadata.len()) == Err(Errno::NOSPC) {
            let name = entry.file_name().to_string_lossy().into_owned();
            return Err(memory(&format!("no room for {name}: {} kB", metadata.len() / 1024)));
        }
    }
    Ok(())
}

/// Returns the bytes of the segments of one sensor's `topics` made as `limits` say: the payloads with their headers, and who
/// is at each service.
pub fn sensor_bytes(topics: &[Topic], limits: &TopicLimits) -> u64 {
    let chunk =
        |&topic: &Topic| limits::samples(topic, limits.consumers) * (topic.longest(limits) + CHUNK_HEADER);
    let services = (topics.len() + 1) as u64 * SERVICE;
    topics.iter().map(chunk).sum::<usize>() as u64 + services
}

/// Returns the bytes of the longest segment of any of one sensor's `topics` made as `limits` say.
pub fn longest_segment(topics: &[Topic], limits: &TopicLimits) -> u64 {
    topics.iter().map(|&topic| sensor_bytes(&[topic], limits)).max().unwrap_or_default()
}

/// What stands before each sample, rounded up: the header, and what the shared-memory library puts there.
const CHUNK_HEADER: usize = size_of::<Header>() + 64;
/// The list of ports and processes of one service, rounded up.
const SERVICE: u64 = 48 * 1024;
