//! Samples as an asynchronous stream, for tokio (feature `tokio`).

use std::os::fd::OwnedFd;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use futures_core::Stream;
use scanhub_schema::Kind;
use scanhub_shm::Payload;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::runtime::Handle;

use crate::error::Error;
use crate::follower::Received;
use crate::joined::{Joined, JoinedSubscriber};
use crate::pollable::Pollable;
use crate::robot::{Robot, RobotSubscriber};
use crate::subscribe::Subscriber;
use crate::zones::{Heard, ZonesSubscriber};

/// Registration of a descriptor at the runtime that polls the stream.
#[derive(Default)]
pub(crate) struct Registration(Option<AsyncFd<Arc<OwnedFd>>>);

impl Registration {
    /// Waits until `descriptor` is readable again, or may be.
    fn poll_readable(&mut self, descriptor: &Arc<OwnedFd>, cx: &mut Context<'_>) -> Poll<Result<(), Error>> {
        let is_registered = self.0.is_some();
        let registered = match &self.0 {
            Some(registered) => registered,
            None => {
                if Handle::try_current().is_err() {
                    let hint = "poll the stream in a runtime that has I/O enabled";
                    return Poll::Ready(Err(Error::new(Kind::Configuration, "no tokio runtime", hint)));
                }
                // Its replacement is unsafe, because a type may close its descriptor early. An `Arc` keeps it open.
                #[allow(deprecated)]
                let registered = AsyncFd::with_interest(descriptor.clone(), Interest::READABLE);
                let registered = registered.map_err(|error| {
                    let what = format!("cannot register the descriptor: {error}");
                    Error::new(Kind::Short, what, "`ulimit -n` may be too small").with_source(error)
                });
                self.0.insert(registered?)
            }
        };
        match ready!(registered.poll_read_ready(cx)) {
            Ok(mut guard) => {
                guard.clear_ready();
                Poll::Ready(Ok(()))
            }
            // The runtime of the registration has ended, and another one polls the stream.
            Err(_) if is_registered => {
                self.0 = None;
                self.poll_readable(descriptor, cx)
            }
            Err(error) => {
                let what = format!("cannot wait for the descriptor: {error}");
                Poll::Ready(Err(Error::new(Kind::Failed, what, "").with_source(error)))
            }
        }
    }
}

/// No field is pinned.
impl<T> Unpin for Pollable<T> {}

impl<T> Pollable<T> {
    /// Returns the next item of `take`, which never waits. No item is kept here, so a dropped future loses none.
    fn poll_items<I>(
        &mut self,
        cx: &mut Context<'_>,
        mut take: impl FnMut(&mut T) -> Result<Option<I>, Error>,
    ) -> Poll<Option<Result<I, Error>>> {
        loop {
            if let Some(item) = take(self.subscriber_mut()).transpose() {
                return Poll::Ready(Some(item));
            }
            let (registration, descriptor) = self.registration();
            if let Err(error) = ready!(registration.poll_readable(descriptor, cx)) {
                return Poll::Ready(Some(Err(error)));
            }
        }
    }
}

/// Samples as they arrive. The stream never ends, and a dropped future loses no sample.
impl<P: Payload + ?Sized> Stream for Pollable<Subscriber<P>> {
    type Item = Result<Received<P>, Error>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.get_mut().poll_items(cx, Subscriber::try_next)
    }
}

/// Pairs as they arrive. The stream never ends, and a dropped future loses no pair.
impl<A: Payload + ?Sized, B: Payload + ?Sized> Stream for Pollable<JoinedSubscriber<A, B>> {
    type Item = Result<Joined<A, B>, Error>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.get_mut().poll_items(cx, JoinedSubscriber::try_next)
    }
}

/// Samples, and the silences between them. The stream never ends.
impl Stream for Pollable<ZonesSubscriber> {
    type Item = Result<Heard, Error>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.get_mut().poll_items(cx, ZonesSubscriber::try_next)
    }
}

/// States of the robot's surroundings, after each change. The stream never ends.
impl Stream for Pollable<RobotSubscriber> {
    type Item = Result<Robot, Error>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.get_mut().poll_items(cx, |robot| Ok(robot.try_next()?.cloned()))
    }
}
