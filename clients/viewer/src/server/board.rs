//! The channels that viewers can subscribe to, each with a short queue of its last messages. All viewers share the queues, so
//! memory does not depend on their number.
//!
//! A queue covers 250 ms: a server that was late for less still sends every message. A viewer that falls behind further skips
//! to the newest message, so that it never shows old data.

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
    /// Whether a message is the state until the next one: a later subscriber gets the last message, and older ones
    /// are never sent.
    pub is_kept: bool,
}

/// A channel of a [`Board`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ChannelId(pub(crate) usize);

/// A message in the queue of a channel.
#[derive(Clone, Debug)]
pub(crate) struct Queued {
    /// Number in the channel, from 1 on.
    pub(crate) number: u64,
    /// Time of the message, in nanoseconds since 1970.
    pub(crate) wall_ns: u64,
    pub(crate) payload: Arc<[u8]>,
    /// See [`Channel::is_kept`].
    pub(crate) is_kept: bool,
}

/// All channels, shared by the thread that fills them and the thread that serves the viewers.
#[derive(Debug)]
pub struct Board {
    posts: Mutex<Vec<Post>>,
    /// Whether there are messages for which the server was not woken yet.
    is_new: AtomicBool,
    bell: OwnedFd,
}

#[derive(Debug)]
struct Post {
    channel: Arc<Channel>,
    /// The last messages, oldest first.
    queue: VecDeque<Queued>,
    /// Number of the last message.
    number: u64,
    subscribers: u32,
}

impl Board {
    /// Creates a board without channels.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if no descriptors are left.
    pub fn new() -> Result<Board, Failure> {
        let bell = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK);
        let bell = bell.map_err(|error| {
            Failure::new(Kind::Short, format!("no eventfd: {error}"), "raise the limit: ulimit -n")
        })?;
        Ok(Board { posts: Mutex::default(), is_new: AtomicBool::new(false), bell })
    }

    /// Returns the channel with this topic, and creates it if there is none.
    pub fn channel(&self, channel: Channel) -> ChannelId {
        let mut posts = self.posts();
        let at = posts.iter().position(|post| post.channel.topic == channel.topic).unwrap_or_else(|| {
            let (channel, queue) = (Arc::new(channel), VecDeque::with_capacity(MOST));
            posts.push(Post { channel, queue, number: 0, subscribers: 0 });
            posts.len() - 1
        });
        drop(posts);
        self.ring();
        ChannelId(at)
    }

    /// Returns whether a present or a later subscriber would get a message.
    pub fn is_wanted(&self, id: ChannelId) -> bool {
        let posts = self.posts();
        posts.get(id.0).is_some_and(|post| post.channel.is_kept || post.subscribers > 0)
    }

    /// Returns whether the channel has a subscriber.
    pub fn is_watched(&self, id: ChannelId) -> bool {
        self.posts().get(id.0).is_some_and(|post| post.subscribers > 0)
    }

    /// Queues a message of the time `wall_ns`, in nanoseconds since 1970. [`tell`](Self::tell) wakes the server once for all
    /// messages that were queued together.
    pub fn put(&self, id: ChannelId, wall_ns: u64, payload: &[u8]) {
        if let Some(post) = self.posts().get_mut(id.0) {
            post.number += 1;
            let (number, is_kept) = (post.number, post.channel.is_kept);
            post.queue.push_back(Queued { number, wall_ns, payload: payload.into(), is_kept });
            let is_old = |queue: &VecDeque<Queued>| {
                let span = queue.front().map_or(0, |oldest| wall_ns.saturating_sub(oldest.wall_ns));
                is_kept || queue.len() > MOST || (queue.len() > LEAST && span > SPAN_NS)
            };
            while post.queue.len() > 1 && is_old(&post.queue) {
                post.queue.pop_front();
            }
            self.is_new.store(true, Ordering::Relaxed);
        }
    }

    /// Removes the messages of a channel that are no longer true.
    pub fn clear(&self, id: ChannelId) {
        if let Some(post) = self.posts().get_mut(id.0) {
            post.queue.clear();
        }
    }

    /// Wakes the server if messages were queued since the last call.
    pub fn tell(&self) {
        if self.is_new.swap(false, Ordering::Relaxed) {
            self.ring();
        }
    }

    /// Wakes the server.
    pub fn ring(&self) {
        // Fails if the counter is full, and then it is readable anyway.
        let _ = rustix::io::write(&self.bell, &1_u64.to_ne_bytes());
    }

    pub(crate) fn bell(&self) -> BorrowedFd<'_> {
        self.bell.as_fd()
    }

    pub(crate) fn rang(&self) {
        let _ = rustix::io::read(&self.bell, &mut [0; 8]);
    }

    /// Returns the channels from number `from` on.
    pub(crate) fn channels_from(&self, from: usize) -> Vec<(usize, Arc<Channel>)> {
        self.posts().iter().enumerate().skip(from).map(|(at, post)| (at, post.channel.clone())).collect()
    }

    /// Adds a subscriber. Returns the number of the last message that it does not get, or `None` if there is no such channel.
    pub(crate) fn subscribe(&self, id: usize) -> Option<u64> {
        let mut posts = self.posts();
        let post = posts.get_mut(id)?;
        post.subscribers += 1;
        let kept = post.queue.back().filter(|last| last.is_kept);
        Some(kept.map_or(post.number, |last| last.number - 1))
    }

    pub(crate) fn unsubscribe(&self, id: usize) {
        if let Some(post) = self.posts().get_mut(id) {
            post.subscribers = post.subscribers.saturating_sub(1);
        }
    }

    /// Returns the message after message `number`, or the newest one if that is no longer queued. `None` if there is none.
    pub(crate) fn next(&self, id: usize, number: u64) -> Option<Queued> {
        let posts = self.posts();
        let queue = &posts.get(id)?.queue;
        let following = queue.iter().find(|queued| queued.number == number + 1);
        following.or(queue.back()).filter(|queued| queued.number > number).cloned()
    }

    fn posts(&self) -> MutexGuard<'_, Vec<Post>> {
        self.posts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Minimum length of a queue.
const LEAST: usize = 2;
/// Maximum length of a queue.
const MOST: usize = 16;
/// Time that a queue covers between these lengths.
const SPAN_NS: u64 = 250_000_000;

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
    fn late_subscribers_get_the_last_message_that_is_a_state() {
        let board = Board::new().unwrap();
        let (scan, status) =
            (board.channel(channel("/scan", false)), board.channel(channel("/status", true)));
        assert_eq!(board.channel(channel("/scan", false)), scan);
        assert!(!board.is_wanted(scan) && board.is_wanted(status));
        for n in 1..=3 {
            board.put(scan, n, &[n as u8]);
            board.put(status, n, &[n as u8]);
        }
        let (of_scan, of_status) = (board.subscribe(scan.0).unwrap(), board.subscribe(status.0).unwrap());
        assert!(board.next(scan.0, of_scan).is_none(), "earlier messages are not sent");
        assert_eq!(board.next(status.0, of_status).unwrap().payload[..], [3]);
        board.put(scan, 4, &[4]);
        board.put(scan, 5, &[5]);
        assert_eq!(board.next(scan.0, of_scan).unwrap().number, of_scan + 1, "every scan is sent");
        board.clear(scan);
        assert!(board.next(scan.0, of_scan).is_none());
        board.clear(status);
        let late = board.subscribe(status.0).unwrap();
        board.put(status, 4, &[4]);
        assert_eq!(board.next(status.0, late).unwrap().number, late + 1, "a removed message counts as sent");
        assert!(board.is_wanted(scan) && board.is_watched(status));
        board.unsubscribe(scan.0);
        assert!(!board.is_wanted(scan));
        assert_eq!(board.subscribe(7), None);
    }

    #[test]
    fn a_queue_covers_a_quarter_of_a_second() {
        let board = Board::new().unwrap();
        // Interval of the messages in milliseconds, and how many of them are queued.
        for (interval, queued) in [(1000, 2), (100, 3), (27, 10), (5, 16), (0, 16)] {
            let scan = board.channel(channel(&format!("/scan{interval}"), false));
            let before = board.subscribe(scan.0).unwrap();
            let put = |n: u64| board.put(scan, n * interval * 1_000_000, &[]);
            (0..queued).for_each(put);
            assert_eq!(board.next(scan.0, before).unwrap().number, before + 1, "{interval} ms");
            put(queued);
            let newest = board.next(scan.0, before).unwrap();
            assert_eq!(
                newest.number,
                before + queued + 1,
                "{interval} ms: the newest one replaces the others"
            );
            assert_eq!(board.next(scan.0, before + 1).unwrap().number, before + 2, "{interval} ms");
        }
    }
}
