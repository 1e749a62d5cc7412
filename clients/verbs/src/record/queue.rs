//! Samples that were received and are in no file yet. The queue is bounded, so that a stalled disk costs samples and
//! not memory; the writer takes all of it at once, so that the receiver never waits. Refuses to know disks and file
//! formats.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use scanhub_schema::Header;

use crate::names::TopicName;

/// Between the thread that receives and the one that writes.
pub(super) struct Queue {
    waiting: Mutex<Waiting>,
    over: Condvar,
}

struct Waiting {
    batch: Batch,
    is_over: bool,
}

/// What waits, in its order. Used again and again.
pub(super) struct Batch {
    pub(super) entries: Vec<Entry>,
    /// The payloads of the samples, one behind the other, packed as for a network.
    pub(super) bytes: Vec<u8>,
}

/// One thing to be kept.
pub(super) enum Entry {
    /// From here on a topic is kept: a track; they are numbered from 0.
    Track(TopicName),
    /// A sample of a track, whose payload is the next `len` bytes.
    Sample { track: usize, header: Header, len: usize },
    /// Here samples were left out.
    Gap(Gap),
}

/// A time in which samples were left out, because there was no room for them.
#[derive(Clone, Debug)]
pub(super) struct Gap {
    /// The wall clock at its begin and its end, ns since 1970.
    pub(super) from_ns: u64,
    pub(super) to_ns: u64,
    /// How many, by topic.
    pub(super) left_out: Vec<(TopicName, u64)>,
}

impl Queue {
    /// With room for what two sensors say in many seconds; memory is taken as it is used.
    pub(super) fn new() -> Queue {
        Queue { waiting: Mutex::new(Waiting { batch: Batch::new(), is_over: false }), over: Condvar::new() }
    }

    /// Something that always has room, because there is little of it.
    pub(super) fn note(&self, entry: Entry) {
        self.lock().batch.entries.push(entry);
    }

    /// Adds a sample of `track`, whose payload of at most `longest` bytes `pack` writes; false if there is no room.
    pub(super) fn push(
        &self,
        track: usize,
        header: &Header,
        longest: usize,
        pack: impl FnOnce(&mut [u8]) -> Option<usize>,
    ) -> bool {
        let Batch { entries, bytes } = &mut self.lock().batch;
        let begin = bytes.len();
        if entries.len() >= MOST_ENTRIES || begin + longest > MOST_BYTES {
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

    /// Nothing waits.
    pub(super) fn is_empty(&self) -> bool {
        self.lock().batch.entries.is_empty()
    }

    /// At least half of the room is free.
    pub(super) fn is_roomy(&self) -> bool {
        let Batch { entries, bytes } = &self.lock().batch;
        entries.len() < MOST_ENTRIES / 2 && bytes.len() < MOST_BYTES / 2
    }

    /// Nothing more comes.
    pub(super) fn end(&self) {
        self.lock().is_over = true;
        self.over.notify_all();
    }

    /// Waits until `until`, or that nothing more comes, which it answers.
    pub(super) fn wait(&self, until: Instant) -> bool {
        let left = until.saturating_duration_since(Instant::now());
        let waiting = self.over.wait_timeout_while(self.lock(), left, |waiting| !waiting.is_over);
        waiting.unwrap_or_else(PoisonError::into_inner).0.is_over
    }

    /// Exchanges all that waits for `empty`, which gets it.
    pub(super) fn take(&self, empty: &mut Batch) {
        empty.clear();
        std::mem::swap(&mut self.lock().batch, empty);
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Batch {
    pub(super) fn new() -> Batch {
        Batch { entries: Vec::with_capacity(MOST_ENTRIES), bytes: Vec::with_capacity(MOST_BYTES) }
    }

    pub(super) fn clear(&mut self) {
        self.entries.clear();
        self.bytes.clear();
    }

    /// How many samples there are.
    pub(super) fn count(&self) -> u64 {
        self.samples().count() as u64
    }

    /// Each sample's track, header and payload.
    pub(super) fn samples(&self) -> impl Iterator<Item = (usize, &Header, &[u8])> {
        let mut begin = 0;
        self.entries.iter().filter_map(move |entry| {
            let Entry::Sample { track, header, len } = entry else { return None };
            begin += len;
            Some((*track, header, &self.bytes[begin - len..begin]))
        })
    }
}

/// Of payloads, in bytes: 20 seconds of all topics of two sensors at their fastest.
const MOST_BYTES: usize = 8 << 20;
const MOST_ENTRIES: usize = 1 << 15;
/// So often what waits is written and a chunk is closed: what a kill costs is not older.
pub(super) const EVERY: Duration = Duration::from_millis(100);

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
    fn what_waits_is_bounded_and_comes_in_its_order() {
        let queue = Queue::new();
        let pushed = (0..).take_while(|&i| push(&queue, i as u8, 1000)).count();
        assert_eq!(pushed, (MOST_BYTES - 2000) / 1000 + 1);
        assert!(!queue.is_roomy());
        let mut batch = Batch::new();
        queue.take(&mut batch);
        assert!(queue.is_roomy() && push(&queue, 9, 10));
        assert_eq!((batch.count(), batch.bytes.len()), (pushed as u64, 1000 * pushed));
        assert_eq!((batch.bytes[999], batch.bytes[1000]), (0, 1));
        queue.take(&mut batch);
        assert_eq!((batch.count(), &batch.bytes[..]), (1, &[9; 10][..]));
        let mut small = (0..).take_while(|_| push(&queue, 0, 10)).count();
        assert_eq!(small, MOST_ENTRIES);
        queue.take(&mut batch);
        small = batch.count() as usize;
        assert_eq!(small, MOST_ENTRIES);
    }

    #[test]
    fn the_end_ends_a_wait() {
        let queue = Queue::new();
        assert!(!queue.wait(Instant::now()));
        queue.end();
        assert!(queue.wait(Instant::now() + Duration::from_secs(3600)));
    }
}
