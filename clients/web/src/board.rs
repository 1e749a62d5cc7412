//! What there is to see: channels, and of each the newest message alone. Who is slower than the sensors gets the newest when
//! he is ready, and however many viewers there are, this is all that is kept. Refuses to know sockets and what messages mean.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rustix::event::{EventfdFlags, eventfd};
use schema::{Failure, Kind};

/// What a channel carries.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Its name, as `/front/scan`.
    pub topic: String,
    /// How its messages are encoded: `cdr` or `json`.
    pub encoding: &'static str,
    /// The type of its messages.
    pub schema_name: &'static str,
    /// The language in which `schema` says what they are.
    pub schema_encoding: &'static str,
    /// That text.
    pub schema: &'static str,
    /// The newest message says how things are, until the next one does: whoever comes later gets it, too.
    pub is_kept: bool,
}

/// A channel of a [`Board`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ChannelId(pub(crate) usize);

/// A message and its number in its channel, from 1 on.
#[derive(Clone, Debug)]
pub(crate) struct Newest {
    pub(crate) number: u64,
    pub(crate) wall_ns: u64,
    pub(crate) payload: Arc<[u8]>,
    /// See [`Channel::is_kept`].
    pub(crate) is_kept: bool,
}

/// The channels, shared by who fills them and who sends them.
#[derive(Debug)]
pub struct Board {
    posts: Mutex<Vec<Post>>,
    /// Something was put up that who sends was not told of.
    is_new: AtomicBool,
    bell: OwnedFd,
}

#[derive(Debug)]
struct Post {
    channel: Arc<Channel>,
    newest: Option<Newest>,
    number: u64,
    subscribers: u32,
}

impl Board {
    /// Makes one without channels.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if descriptors are short.
    pub fn new() -> Result<Board, Failure> {
        let bell = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK);
        let bell = bell.map_err(|error| {
            Failure::new(Kind::Short, format!("no eventfd: {error}"), "raise the limit: ulimit -n")
        })?;
        Ok(Board { posts: Mutex::default(), is_new: AtomicBool::new(false), bell })
    }

    /// Returns the channel with this topic; it is made if there is none.
    pub fn channel(&self, channel: Channel) -> ChannelId {
        let mut posts = self.posts();
        let at = posts.iter().position(|post| post.channel.topic == channel.topic).unwrap_or_else(|| {
            posts.push(Post { channel: Arc::new(channel), newest: None, number: 0, subscribers: 0 });
            posts.len() - 1
        });
        drop(posts);
        self.ring();
        ChannelId(at)
    }

    /// Returns whether anybody would get a message now, or later.
    pub fn is_wanted(&self, id: ChannelId) -> bool {
        let posts = self.posts();
        posts.get(id.0).is_some_and(|post| post.channel.is_kept || post.subscribers > 0)
    }

    /// Returns whether anybody would get a message now.
    pub fn is_watched(&self, id: ChannelId) -> bool {
        self.posts().get(id.0).is_some_and(|post| post.subscribers > 0)
    }

    /// Puts up a message of a moment in ns since 1970, in place of the one before. Who sends hears of it by
    /// [`tell`](Self::tell), once for all that came together.
    pub fn put(&self, id: ChannelId, wall_ns: u64, payload: &[u8]) {
        if let Some(post) = self.posts().get_mut(id.0) {
            post.number += 1;
            let (number, is_kept) = (post.number, post.channel.is_kept);
            post.newest = Some(Newest { number, wall_ns, payload: payload.into(), is_kept });
            self.is_new.store(true, Ordering::Relaxed);
        }
    }

    /// Takes down what is there: it is not true any more.
    pub fn clear(&self, id: ChannelId) {
        if let Some(post) = self.posts().get_mut(id.0) {
            post.newest = None;
        }
    }

    /// Wakes who sends, if something was put up since the last time.
    pub fn tell(&self) {
        if self.is_new.swap(false, Ordering::Relaxed) {
            self.ring();
        }
    }

    /// Wakes who sends.
    pub fn ring(&self) {
        // A full counter is readable, too.
        let _ = rustix::io::write(&self.bell, &1_u64.to_ne_bytes());
    }

    pub(crate) fn bell(&self) -> BorrowedFd<'_> {
        self.bell.as_fd()
    }

    pub(crate) fn rang(&self) {
        let _ = rustix::io::read(&self.bell, &mut [0; 8]);
    }

    /// The channels from number `from` on.
    pub(crate) fn channels_from(&self, from: usize) -> Vec<(usize, Arc<Channel>)> {
        self.posts().iter().enumerate().skip(from).map(|(at, post)| (at, post.channel.clone())).collect()
    }

    /// Takes note of a subscriber; the number of the last message that he does not get, if there is such a channel.
    pub(crate) fn subscribe(&self, id: usize) -> Option<u64> {
        let mut posts = self.posts();
        let post = posts.get_mut(id)?;
        post.subscribers += 1;
        let kept = post.newest.as_ref().filter(|newest| newest.is_kept);
        Some(kept.map_or(post.number, |newest| newest.number - 1))
    }

    pub(crate) fn unsubscribe(&self, id: usize) {
        if let Some(post) = self.posts().get_mut(id) {
            post.subscribers = post.subscribers.saturating_sub(1);
        }
    }

    /// The newest message of a channel, if it is newer than message `number`.
    pub(crate) fn newer(&self, id: usize, number: u64) -> Option<Newest> {
        self.posts().get(id)?.newest.clone().filter(|newest| newest.number > number)
    }

    fn posts(&self) -> MutexGuard<'_, Vec<Post>> {
        self.posts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

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
    fn the_newest_alone_is_kept_and_late_comers_get_what_still_holds() {
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
        assert!(board.newer(scan.0, of_scan).is_none(), "that was before");
        assert_eq!(board.newer(status.0, of_status).unwrap().payload[..], [3]);
        board.put(scan, 4, &[4]);
        board.put(scan, 5, &[5]);
        let newest = board.newer(scan.0, of_scan).unwrap();
        assert_eq!((newest.number, newest.payload[0]), (5, 5), "one was skipped");
        board.clear(scan);
        assert!(board.newer(scan.0, of_scan).is_none());
        board.clear(status);
        let late = board.subscribe(status.0).unwrap();
        board.put(status, 4, &[4]);
        assert_eq!(
            board.newer(status.0, late).unwrap().number,
            late + 1,
            "what was taken down was not missed"
        );
        assert!(board.is_wanted(scan) && board.is_watched(status));
        board.unsubscribe(scan.0);
        assert!(!board.is_wanted(scan));
        assert_eq!(board.subscribe(7), None);
    }
}
