//! Channels that viewers can subscribe to, each with a short queue of its last messages. All viewers share the queues,
//! so memory does not depend on their number.
//!
//! A queue covers 250 ms, so a server that was delayed by less still sends every message. A viewer that is delayed by
//! more gets the newest message next, so that it never shows old data.

use std::collections::VecDeque;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rustix::event::{EventfdFlags, eventfd};
use scanhub_schema::{Failure, Kind};

/// Description of a channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Name of the channel, such as `/front/scan`.
    pub topic: String,
    /// Encoding of the messages: `cdr` or `json`.
    pub encoding: &'static str,
    /// Type of the messages.
    pub schema_name: &'static str,
    /// Language of `schema`.
    pub schema_encoding: &'static str,
    /// Definition of the type.
    pub schema: &'static str,
    /// Whether a message is a state that is valid until the next message. A later subscriber then gets the last
    /// message, and older messages are never sent.
    pub is_kept: bool,
}

/// A message in the queue of a channel.
#[derive(Clone, Debug)]
pub(crate) struct QueuedMessage {
    /// Number of the message in its channel, from 1 on.
    pub(crate) number: u64,
    /// Time of the message, in nanoseconds since 1970.
    pub(crate) wall_ns: u64,
    pub(crate) payload: Arc<[u8]>,
    /// See [`Channel::is_kept`].
    pub(crate) is_kept: bool,
}

/// Store of all channels, shared by the thread that fills them and the thread that serves the viewers.
#[derive(Debug)]
pub struct ChannelStore {
    channels: Mutex<Vec<ChannelQueue>>,
    /// Whether messages were queued since the server was last woken.
    is_new: AtomicBool,
    /// Wakes the server.
    wake: OwnedFd,
}

#[derive(Debug)]
struct ChannelQueue {
    channel: Arc<Channel>,
    /// The last messages, oldest first.
    queue: VecDeque<QueuedMessage>,
    /// Number of the last message.
    number: u64,
    subscribers: u32,
}

impl ChannelStore {
    /// Creates a store without channels.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if no descriptors are left.
    pub fn new() -> Result<ChannelStore, Failure> {
        let wake = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK);
        let wake = wake.map_err(|error| {
            Failure::new(
                Kind::ResourceExhausted,
                format!("no eventfd: {error}"),
                "raise the limit: ulimit -n",
            )
        })?;
        Ok(ChannelStore { channels: Mutex::default(), is_new: AtomicBool::new(false), wake })
    }

    /// Returns the channel with this topic, and creates it if there is none.
    pub fn open(&self, channel: Channel) -> ChannelPublisher<'_> {
        let mut channels = self.channels();
        let id = channels.iter().position(|one| one.channel.topic == channel.topic).unwrap_or_else(|| {
            let (channel, queue) = (Arc::new(channel), VecDeque::with_capacity(MAX_LEN));
            channels.push(ChannelQueue { channel, queue, number: 0, subscribers: 0 });
            channels.len() - 1
        });
        drop(channels);
        self.wake();
        ChannelPublisher { store: self, id }
    }

    /// Wakes the server if messages were queued since the last call.
    pub fn wake_if_new(&self) {
        if self.is_new.swap(false, Ordering::Relaxed) {
            self.wake();
        }
    }

    /// Wakes the server.
    pub fn wake(&self) {
        // The write fails only if the counter is full. The descriptor is readable in this case too.
        let _ = rustix::io::write(&self.wake, &1_u64.to_ne_bytes());
    }

    /// Returns the descriptor that becomes readable when the server is woken.
    pub(crate) fn wake_fd(&self) -> BorrowedFd<'_> {
        self.wake.as_fd()
    }

    /// Resets the descriptor, so that it becomes readable only at the next call of [`wake`](Self::wake).
    pub(crate) fn clear_wake(&self) {
        let _ = rustix::io::read(&self.wake, &mut [0; 8]);
    }

    /// Returns the channels from index `from` on.
    pub(crate) fn channels_from(&self, from: usize) -> Vec<(usize, Arc<Channel>)> {
        self.channels().iter().enumerate().skip(from).map(|(at, one)| (at, one.channel.clone())).collect()
    }

    /// Adds a subscriber to channel `id`. Returns the number of the last message that the subscriber does not get, or
    /// `None` if the channel does not exist.
    pub(crate) fn subscribe(&self, id: usize) -> Option<u64> {
        let mut channels = self.channels();
        let one = channels.get_mut(id)?;
        one.subscribers += 1;
        let kept = one.queue.back().filter(|last| last.is_kept);
        Some(kept.map_or(one.number, |last| last.number - 1))
    }

    pub(crate) fn unsubscribe(&self, id: usize) {
        if let Some(one) = self.channels().get_mut(id) {
            one.subscribers = one.subscribers.saturating_sub(1);
        }
    }

    /// Returns the message after message `number`, or the newest message if the message after `number` is no longer
    /// queued. Returns `None` if there is no newer message.
    pub(crate) fn next(&self, id: usize, number: u64) -> Option<QueuedMessage> {
        let channels = self.channels();
        let queue = &channels.get(id)?.queue;
        let following = queue.iter().find(|queued| queued.number == number + 1);
        following.or(queue.back()).filter(|queued| queued.number > number).cloned()
    }

    fn channels(&self) -> MutexGuard<'_, Vec<ChannelQueue>> {
        self.channels.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Publisher of the messages of one channel.
#[derive(Clone, Copy, Debug)]
pub struct ChannelPublisher<'a> {
    store: &'a ChannelStore,
    /// Index of the channel. Channels are never removed.
    id: usize,
}

impl ChannelPublisher<'_> {
    /// Returns whether a message would be sent to any current or later subscriber.
    pub fn is_needed(&self) -> bool {
        let one = &self.store.channels()[self.id];
        one.channel.is_kept || one.subscribers > 0
    }

    /// Returns whether the channel has a subscriber.
    pub fn is_subscribed(&self) -> bool {
        self.store.channels()[self.id].subscribers > 0
    }

    /// Queues a message with the time `wall_ns`, in nanoseconds since 1970. [`ChannelStore::wake_if_new`] wakes the
    /// server once for all messages that were queued together.
    pub fn publish(&self, wall_ns: u64, payload: &[u8]) {
        let one = &mut self.store.channels()[self.id];
        one.number += 1;
        let (number, is_kept) = (one.number, one.channel.is_kept);
        one.queue.push_back(QueuedMessage { number, wall_ns, payload: payload.into(), is_kept });
        let is_old = |queue: &VecDeque<QueuedMessage>| {
            let span = queue.front().map_or(0, |oldest| wall_ns.saturating_sub(oldest.wall_ns));
            is_kept || queue.len() > MAX_LEN || (queue.len() > MIN_LEN && span > QUEUE_SPAN_NS)
        };
        while one.queue.len() > 1 && is_old(&one.queue) {
            one.queue.pop_front();
        }
        self.store.is_new.store(true, Ordering::Relaxed);
    }

    /// Removes all queued messages, because they are no longer valid.
    pub fn clear(&self) {
        self.store.channels()[self.id].queue.clear();
    }
}

/// Minimum number of messages in a queue.
const MIN_LEN: usize = 2;
/// Maximum number of messages in a queue.
const MAX_LEN: usize = 16;
/// Time that a queue covers, in ns, if the number of its messages is between [`MIN_LEN`] and [`MAX_LEN`].
const QUEUE_SPAN_NS: u64 = 250_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    fn channel(topic: &str, is_kept: bool) -> Channel {
        let topic = topic.to_owned();
        Channel {
            topic,
            encoding: "json",
            schema_name: "S",
            schema_encoding: "jsonschema",
            schema: "{}",
            is_kept,
        }
    }

    #[test]
    fn late_subscribers_get_the_last_state() {
        let store = ChannelStore::new().unwrap();
        let (scan, status) = (store.open(channel("/scan", false)), store.open(channel("/status", true)));
        assert_eq!(store.open(channel("/scan", false)).id, scan.id);
        assert!(!scan.is_needed() && status.is_needed());
        for n in 1..=3 {
            scan.publish(n, &[n as u8]);
            status.publish(n, &[n as u8]);
        }
        let (of_scan, of_status) = (store.subscribe(scan.id).unwrap(), store.subscribe(status.id).unwrap());
        assert!(store.next(scan.id, of_scan).is_none(), "earlier messages are not sent");
        assert_eq!(store.next(status.id, of_status).unwrap().payload[..], [3]);
        scan.publish(4, &[4]);
        scan.publish(5, &[5]);
        assert_eq!(store.next(scan.id, of_scan).unwrap().number, of_scan + 1, "every scan is sent");
        scan.clear();
        assert!(store.next(scan.id, of_scan).is_none());
        status.clear();
        let late = store.subscribe(status.id).unwrap();
        status.publish(4, &[4]);
        assert_eq!(store.next(status.id, late).unwrap().number, late + 1, "a removed message counts as sent");
        assert!(scan.is_needed() && status.is_subscribed());
        store.unsubscribe(scan.id);
        assert!(!scan.is_needed());
        assert_eq!(store.subscribe(7), None);
    }

    #[test]
    fn queue_covers_a_quarter_of_a_second() {
        let store = ChannelStore::new().unwrap();
        // Interval of the messages in milliseconds, and number of messages that the queue holds.
        for (interval, queued) in [(1000, 2), (100, 3), (27, 10), (5, 16), (0, 16)] {
            let scan = store.open(channel(&format!("/scan{interval}"), false));
            let before = store.subscribe(scan.id).unwrap();
            let put = |n: u64| scan.publish(n * interval * 1_000_000, &[]);
            (0..queued).for_each(put);
            assert_eq!(store.next(scan.id, before).unwrap().number, before + 1, "{interval} ms");
            put(queued);
            let newest = store.next(scan.id, before).unwrap();
            assert_eq!(
                newest.number,
                before + queued + 1,
                "{interval} ms: the newest one replaces the others"
            );
            assert_eq!(store.next(scan.id, before + 1).unwrap().number, before + 2, "{interval} ms");
        }
    }
}
