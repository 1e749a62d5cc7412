//! Queue between the thread that receives from the hub and the thread that sends over Zenoh. A slow network therefore
//! delays only the sending thread. There is a queue of datagrams (`sending.rs`), and a queue of ROS 2 messages
//! (`ros2.rs`).

use std::num::NonZeroU64;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use scanhub_network::lan::WallTimestamp;
use scanhub_network::lan::outgoing::Sample;
use scanhub_network::{Forwarder, SampleSink, Selection, now};
use scanhub_schema::{Failure, Topic};
use scanhub_shm::Domain;
use scanhub_verbs::follow::Notice;
use scanhub_verbs::output::ExitReason;

use crate::session::{Connection, ZenohSession};

/// Queue of messages to send. A newer message of a topic replaces an older one if the queue has no room for both.
pub(crate) trait Queue: SampleSink {
    /// Returns whether a message waits.
    fn is_waiting(&self) -> bool;

    /// Tells the queue whether the hub is available. [`QueueFiller::forward`] calls this function after each poll of
    /// the hub.
    fn set_hub_available(&mut self, hub_is_available: bool, now: WallTimestamp);

    /// Settles the message that was taken last. If `is_sent` is false, the message counts as not sent.
    fn settle(&mut self, is_sent: bool);
}

/// Queue that two threads share.
pub(crate) struct SharedQueue<Q>(Arc<(Mutex<Q>, Condvar)>);

/// Receives the samples of a hub, and adds them to a queue.
pub(crate) struct QueueFiller<Q> {
    forwarder: Forwarder,
    queue: SharedQueue<Q>,
}

/// Sends the messages of a queue through a session. Each message belongs to a topic. Topics are identified by an index.
pub(crate) trait Sender {
    /// Queue that holds the messages.
    type Queue: Queue;

    /// Declares tokens, and publishers of new topics.
    fn declare(&mut self, queue: &SharedQueue<Self::Queue>) -> Result<(), Failure>;

    /// Writes the message that has waited longest to `message`, and returns the index of its topic. The message counts
    /// as sent until it is [settled](Queue::settle).
    fn take(&mut self, queue: &mut Self::Queue, now: WallTimestamp, message: &mut Vec<u8>) -> Option<usize>;

    /// Sends `message`. Returns whether the links had room for the message.
    fn send(&mut self, topic: usize, message: &[u8]) -> Result<bool, Failure>;

    /// Adds the last messages of a run, after all others have been sent. Returns whether any message was added.
    fn finish(&mut self, queue: &mut Self::Queue) -> bool;
}

/// Interval between checks of the hub's tokens while no message waits.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);
/// Interval between checks of the links while there is no connection.
const LINK_INTERVAL: Duration = Duration::from_millis(5);
/// Maximum time at the end of a run for sending messages that still wait.
const FLUSH_TIME: Duration = Duration::from_secs(1);

impl<Q: Queue> QueueFiller<Q> {
    /// Creates a filler that subscribes to the selected topics of the first running hub in `locations`.
    pub(crate) fn new(selection: Selection, locations: &[Domain], queue: Q) -> QueueFiller<Q> {
        let mut queue = SharedQueue(Arc::new((Mutex::new(queue), Condvar::new())));
        let forwarder = Forwarder::new(selection, locations, &mut queue);
        QueueFiller { forwarder, queue }
    }

    /// Requires that the hub has `sensor`, even if no topic of this sensor is selected.
    pub(crate) fn require(&mut self, sensor: &str) {
        self.forwarder.require(sensor);
    }

    /// Adds new samples of the hub to the queue, and checks whether the hub runs. Returns whether more samples may be
    /// available.
    pub(crate) fn forward(
        &mut self,
        report: &mut impl FnMut(Notice) -> Result<(), ExitReason>,
    ) -> Result<bool, ExitReason> {
        let more = self.forwarder.forward(&mut self.queue)?;
        self.queue.ring();
        self.forwarder.check_hub(Instant::now(), &mut self.queue, report)?;
        let is_waiting = {
            let mut queue = self.queue.lock();
            queue.set_hub_available(self.forwarder.is_hub_running(), now());
            queue.is_waiting()
        };
        if is_waiting {
            self.queue.ring();
        }
        Ok(more)
    }

    /// Waits for samples of the hub, at most for `at_most`.
    pub(crate) fn wait(&mut self, at_most: Duration) -> Result<(), Failure> {
        self.forwarder.wait(at_most)
    }

    /// Returns the queue.
    pub(crate) fn queue(&self) -> &SharedQueue<Q> {
        &self.queue
    }
}

impl<Q> SharedQueue<Q> {
    /// Locks the queue.
    pub(crate) fn lock(&self) -> MutexGuard<'_, Q> {
        // No code panics while it holds the lock. Even after a panic, the messages would be valid.
        self.0.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Wakes the sending thread.
    pub(crate) fn ring(&self) {
        self.0.1.notify_one();
    }
}

impl<Q> Clone for SharedQueue<Q> {
    fn clone(&self) -> Self {
        SharedQueue(self.0.clone())
    }
}

impl<Q: Queue> SampleSink for SharedQueue<Q> {
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize {
        self.lock().follow(name, every)
    }

    fn needs(&self, sensor: usize, topic: Topic) -> bool {
        self.lock().needs(sensor, topic)
    }

    fn sample(&mut self, sensor: usize, sample: &Sample<'_>) {
        self.lock().sample(sensor, sample);
    }
}

/// Waits for the end of a thread that [sends](send) the messages of `queue`. If the thread still waits for room on a
/// link after [`FLUSH_TIME`], it runs on until the process exits, and its message counts as not sent.
///
/// # Errors
///
/// The error of the thread, or [`Kind::Failed`](scanhub_schema::Kind) if it panicked.
pub(crate) fn join<Q: Queue>(
    thread: JoinHandle<Result<(), Failure>>,
    queue: &SharedQueue<Q>,
) -> Result<(), Failure> {
    let end_at = Instant::now() + FLUSH_TIME + CHECK_INTERVAL;
    while !thread.is_finished() {
        if Instant::now() >= end_at {
            queue.lock().settle(false);
            return Ok(());
        }
        thread::sleep(LINK_INTERVAL);
    }
    thread.join().unwrap_or_else(|_| Err(crate::thread_panicked()))
}

/// Sends the messages of `queue` until `is_over` is set, and then the messages that still wait, for at most
/// [`FLUSH_TIME`]. When the session is open, calls `open` to create the sender.
pub(crate) fn send<'a, S: Sender>(
    queue: &SharedQueue<S::Queue>,
    connection: &'a Connection,
    is_over: &AtomicBool,
    open: impl FnOnce(&'a ZenohSession) -> Result<S, Failure>,
) -> Result<(), Failure> {
    let Some(session) = connection.session(is_over) else { return Ok(()) };
    let mut sender = open(session)?;
    let (mut message, mut end_at) = (Vec::new(), None);
    loop {
        if is_over.load(Ordering::Relaxed) {
            let end_at = *end_at.get_or_insert_with(|| Instant::now() + FLUSH_TIME);
            let mut queue = queue.lock();
            if Instant::now() >= end_at || !queue.is_waiting() && !sender.finish(&mut queue) {
                return Ok(());
            }
        }
        sender.declare(queue)?;
        // Without a link, keep the newest messages in the queue until there is a link.
        if !session.is_linked() {
            thread::sleep(LINK_INTERVAL);
            continue;
        }
        let mut waiting = queue.lock();
        if !waiting.is_waiting() {
            let woken = queue.0.1.wait_timeout(waiting, CHECK_INTERVAL);
            waiting = woken.unwrap_or_else(PoisonError::into_inner).0;
        }
        let Some(topic) = sender.take(&mut waiting, now(), &mut message) else { continue };
        drop(waiting);
        let is_sent = sender.send(topic, &message)?;
        queue.lock().settle(is_sent);
    }
}
