//! Subscriber with a descriptor for `poll`, `epoll` or an executor, for programs that also wait for other events.

use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::error::Error;
use crate::silence::Silence;
#[cfg(feature = "tokio")]
use crate::stream::Registration;
use crate::subscribe::{Subscribe, Subscriber};

/// [`Subscriber`] with a descriptor that is readable while an item may be waiting. Poll the descriptor, but never read
/// it. It stays readable, so that `poll` returns at once, until [`try_next`](Self::try_next) returns `None`.
/// [`SubscriberBuilder::open_pollable`](crate::SubscriberBuilder::open_pollable) creates it.
///
/// The descriptor can be readable although nothing has arrived: once a second while a hub runs, when another topic of
/// the sensor has a sample, and when a hub starts or ends. Without a hub, it is readable only if something changes in
/// the directories of hubs. For zones and robots, it also becomes readable when a verdict becomes too old. The
/// descriptor stays the same as long as the subscriber exists, even if the hub restarts. Programs that the process
/// starts do not inherit it. With the feature `tokio`, the subscriber is a `Stream`.
///
/// # Examples
///
/// ```no_run
/// use rustix::event::{PollFd, PollFlags, poll};
/// use scanhub_client::{Scan, Subscriber};
///
/// let scans = Subscriber::<Scan>::builder("front").open_pollable()?;
/// let stdin = std::io::stdin();
/// loop {
///     let mut fds = [PollFd::new(&scans, PollFlags::IN), PollFd::new(&stdin, PollFlags::IN)];
///     poll(&mut fds, None)?;
///     while let Some(scan) = scans.try_next()? {
///         println!("{} beams", scan.beams());
///     }
///     if !fds[1].revents().is_empty() {
///         return Ok(());
///     }
/// }
/// # #[allow(unreachable_code)]
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct PollableSubscriber<T: Subscribe + ?Sized> {
    descriptor: Arc<OwnedFd>,
    // The lock lets `try_next` work while an executor borrows the descriptor.
    subscriber: Mutex<Subscriber<T>>,
    #[cfg(feature = "tokio")]
    registration: Registration,
}

impl<T: Subscribe + ?Sized> PollableSubscriber<T> {
    pub(crate) fn new(descriptor: Arc<OwnedFd>, subscriber: Subscriber<T>) -> PollableSubscriber<T> {
        PollableSubscriber {
            descriptor,
            subscriber: Mutex::new(subscriber),
            #[cfg(feature = "tokio")]
            registration: Registration::default(),
        }
    }

    /// Returns the next item if one has arrived. Never waits.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Subscriber::try_next`].
    pub fn try_next(&self) -> Result<Option<T::Item>, Error> {
        self.locked().try_next()
    }

    /// Returns whether a hub runs in the domain, as [`Subscriber::hub_is_running`] does.
    pub fn hub_is_running(&self) -> bool {
        self.locked().hub_is_running()
    }

    /// Returns why nothing arrives, as [`Subscriber::why_silent`] does.
    pub fn why_silent(&self) -> Silence {
        self.locked().why_silent()
    }

    /// Returns the duration of the silence, as [`Subscriber::silent_for`] does.
    pub fn silent_for(&self) -> Duration {
        self.locked().silent_for()
    }

    /// Returns the subscriber, for example to wait with its `next`.
    pub fn subscriber_mut(&mut self) -> &mut Subscriber<T> {
        self.subscriber.get_mut().unwrap_or_else(PoisonError::into_inner)
    }

    #[cfg(feature = "tokio")]
    pub(crate) fn registration(&mut self) -> (&mut Registration, &Arc<OwnedFd>) {
        (&mut self.registration, &self.descriptor)
    }

    fn locked(&self) -> MutexGuard<'_, Subscriber<T>> {
        self.subscriber.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T: Subscribe + ?Sized> AsFd for PollableSubscriber<T> {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.descriptor.as_fd()
    }
}

impl<T: Subscribe + ?Sized> AsRawFd for PollableSubscriber<T> {
    fn as_raw_fd(&self) -> RawFd {
        self.descriptor.as_raw_fd()
    }
}

/// Lets tokio's `AsyncFd` borrow the subscriber.
impl<T: Subscribe + ?Sized> AsRawFd for &PollableSubscriber<T> {
    fn as_raw_fd(&self) -> RawFd {
        self.descriptor.as_raw_fd()
    }
}
