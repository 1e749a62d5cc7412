//! Passes samples from the receiving thread to the disk thread, and progress from the disk thread to the receiving
//! thread.
//!
//! The queue is bounded, so a stalled disk costs samples, but no additional memory. The disk thread takes the whole
//! queue at once, so the receiving thread never waits for the disk.

use std::path::PathBuf;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use scanhub_schema::Header;

use crate::names::TopicName;

/// Samples that were received but not written yet.
pub(super) struct Queue {
    waiting: Mutex<QueueState>,
    ended: Condvar,
}

struct QueueState {
    batch: Batch,
    is_over: bool,
}

/// Entries in the order of their arrival. The memory of a batch is reused.
pub(super) struct Batch {
    pub(super) entries: Vec<Entry>,
    /// Payloads of the samples in the order of the entries, packed as for transmission over a network.
    pub(super) bytes: Vec<u8>,
}

/// An entry of the queue.
pub(super) enum Entry {
    /// A new track, which is a topic of the recording. Tracks are numbered from 0.
    Track(TopicName),
    /// A sample of a track. Its payload is the next `len` bytes.
    Sample { track: usize, header: Header, len: usize },
    /// A gap at this position of the recording.
    Gap(Gap),
}

/// Period in which samples were dropped because the queue was full.
#[derive(Clone, Debug)]
pub(super) struct Gap {
    /// Start and end as wall clock times in ns since 1970.
    pub(super) from_ns: u64,
    pub(super) to_ns: u64,
    /// Number of dropped samples by topic.
    pub(super) dropped: Vec<(TopicName, u64)>,
}

impl Queue {
    pub(super) fn new() -> Queue {
        Queue {
            waiting: Mutex::new(QueueState { batch: Batch::new(), is_over: false }),
            ended: Condvar::new(),
        }
    }

    /// Adds an entry that is not a sample, even if the queue is full. These entries are rare.
    pub(super) fn note(&self, entry: Entry) {
        self.lock().batch.entries.push(entry);
    }

    /// Adds a sample of `track`. `pack` writes its payload of at most `longest` bytes. Returns false if the queue has
    /// no room.
    pub(super) fn push(
        &self,
        track: usize,
        header: &Header,
        longest: usize,
        pack: impl FnOnce(&mut [u8]) -> Option<usize>,
    ) -> bool {
        let Batch { entries, bytes } = &mut self.lock().batch;
        let begin = bytes.len();
        if entries.len() >= MAX_ENTRIES || begin + longest > MAX_BYTES {
            return false;
        }
        bytes.resize(begin + longest, 0);
        let len = pack(&mut bytes[begin..]);
        bytes.truncate(begin + len.unwrap_or(0));
        if let Some(len) = len {
            entries.push(Entry::Sample { track, header: *header, len });
        }
        true
    }

    pub(super) fn is_empty(&self) -> bool {
        self.lock().batch.entries.is_empty()
    }

    /// Returns whether the queue is less than half full.
    pub(super) fn is_roomy(&self) -> bool {
        let Batch { entries, bytes } = &self.lock().batch;
        entries.len() < MAX_ENTRIES / 2 && bytes.len() < MAX_BYTES / 2
    }

    /// Ends the queue. No entry may be added afterward.
    pub(super) fn end(&self) {
        self.lock().is_over = true;
        self.ended.notify_all();
    }

    /// Waits until `until` or the end of the queue. Returns whether the queue has ended.
    pub(super) fn wait(&self, until: Instant) -> bool {
        let left = until.saturating_duration_since(Instant::now());
        let waiting = self.ended.wait_timeout_while(self.lock(), left, |waiting| !waiting.is_over);
        waiting.unwrap_or_else(PoisonError::into_inner).0.is_over
    }

    /// Moves all entries to `batch`.
    pub(super) fn take(&self, batch: &mut Batch) {
        batch.clear();
        std::mem::swap(&mut self.lock().batch, batch);
    }

    fn lock(&self) -> MutexGuard<'_, QueueState> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Batch {
    pub(super) fn new() -> Batch {
        Batch { entries: Vec::with_capacity(MAX_ENTRIES), bytes: Vec::with_capacity(MAX_BYTES) }
    }

    pub(super) fn clear(&mut self) {
        self.entries.clear();
        self.bytes.clear();
    }

    /// Returns the number of samples.
    pub(super) fn count(&self) -> u64 {
        self.samples().count() as u64
    }

    /// Returns track, header and payload of each sample.
    pub(super) fn samples(&self) -> impl Iterator<Item = (usize, &Header, &[u8])> {
        let mut begin = 0;
        self.entries.iter().filter_map(move |entry| {
            let Entry::Sample { track, header, len } = entry else { return None };
            begin += len;
            Some((*track, header, &self.bytes[begin - len..begin]))
        })
    }
}

/// Progress of the disk thread, for the receiving thread.
#[derive(Default)]
pub(super) struct WriterProgress(Mutex<RecordStats>);

/// Progress and events of the disk thread.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct RecordStats {
    /// Length of all files that still exist, in bytes.
    pub(super) bytes: u64,
    /// Number of samples in all files that still exist.
    pub(super) samples: u64,
    /// Events since the last [`take_stats`](WriterProgress::take_stats).
    pub(super) events: Vec<WriterEvent>,
}

/// Event of the disk thread.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum WriterEvent {
    /// The recording continues in this file.
    File(PathBuf),
    /// The file at this path cannot be written, for this reason.
    WriteFailed(PathBuf, String),
    /// The file at this path can be written again. The failure lasted for this time.
    WriteResumed(PathBuf, Duration),
    /// The file at this path was removed or truncated. It had this number of samples, which are lost.
    Removed(PathBuf, u64),
    /// The reader of stdout has closed it.
    ReaderClosed,
}

impl WriterProgress {
    /// Returns the progress, and removes the events.
    pub(super) fn take_stats(&self) -> RecordStats {
        let mut stats = self.stats();
        let events = std::mem::take(&mut stats.events);
        RecordStats { events, ..stats.clone() }
    }

    /// Locks the progress, for the disk thread.
    pub(super) fn stats(&self) -> MutexGuard<'_, RecordStats> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Maximum length of all payloads in the queue, in bytes. It is enough for all topics of two sensors at
/// their highest rate: for 20 seconds of two LMS, or 14 seconds of two RPLIDAR S2.
const MAX_BYTES: usize = 8 << 20;
const MAX_ENTRIES: usize = 1 << 15;
/// Interval at which the queue is written and a chunk is closed. If the process is killed, at most the samples of this
/// interval are lost.
pub(super) const WRITE_INTERVAL: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use super::*;

    fn push(queue: &Queue, byte: u8, len: usize) -> bool {
        queue.push(0, &Header::default(), 2 * len, |room| {
            room[..len].fill(byte);
            Some(len)
        })
    }

    #[test]
    fn queue_is_bounded_and_keeps_the_order() {
        let queue = Queue::new();
        let pushed = (0..).take_while(|&i| push(&queue, i as u8, 1000)).count();
        assert_eq!(pushed, (MAX_BYTES - 2000) / 1000 + 1);
        assert!(!queue.is_roomy());
        let mut batch = Batch::new();
        queue.take(&mut batch);
        assert!(queue.is_roomy() && push(&queue, 9, 10));
        assert_eq!((batch.count(), batch.bytes.len()), (pushed as u64, 1000 * pushed));
        assert_eq!((batch.bytes[999], batch.bytes[1000]), (0, 1));
        queue.take(&mut batch);
        assert_eq!((batch.count(), &batch.bytes[..]), (1, &[9; 10][..]));
        let mut small = (0..).take_while(|_| push(&queue, 0, 10)).count();
        assert_eq!(small, MAX_ENTRIES);
        queue.take(&mut batch);
        small = batch.count() as usize;
        assert_eq!(small, MAX_ENTRIES);
    }

    #[test]
    fn end_of_the_queue_ends_a_wait() {
        let queue = Queue::new();
        assert!(!queue.wait(Instant::now()));
        queue.end();
        assert!(queue.wait(Instant::now() + Duration::from_secs(3600)));
    }
}
