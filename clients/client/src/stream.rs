//! Subscriber as an asynchronous stream, for tokio (feature `tokio`).

use std::os::fd::OwnedFd;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use futures_core::Stream;
use scanhub_schema::Kind;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::runtime::Handle;

use crate::error::Error;
use crate::pollable::PollableSubscriber;
use crate::subscribe::Subscribe;

/// Registration of a descriptor at the runtime that polls the stream.
#[derive(Default)]
pub(crate) struct Registration(Option<AsyncFd<Arc<OwnedFd>>>);

impl Registration {
    /// Waits until `descriptor` is readable again. The wait may also end early.
    fn poll_readable(&mut self, descriptor: &Arc<OwnedFd>, cx: &mut Context<'_>) -> Poll<Result<(), Error>> {
        let is_registered = self.0.is_some();
        let registered = match &self.0 {
            Some(registered) => registered,
            None => {
                if Handle::try_current().is_err() {
                    let hint = "poll the stream in a runtime that has I/O enabled";
                    return Poll::Ready(Err(Error::new(Kind::Configuration, "no tokio runtime", hint)));
                }
                // The replacement of this function is unsafe, because a type may close its descriptor early. Here, an
                // `Arc` keeps it open.
                #[allow(deprecated)]
                let registered = AsyncFd::with_interest(descriptor.clone(), Interest::READABLE);
                let registered = registered.map_err(|error| {
                    let what = format!("cannot register the descriptor: {error}");
                    Error::new(Kind::ResourceExhausted, what, "`ulimit -n` may be too small")
                        .with_source(error)
                });
                self.0.insert(registered?)
            }
        };
        match ready!(registered.poll_read_ready(cx)) {
            Ok(mut guard) => {
                guard.clear_ready();
                Poll::Ready(Ok(()))
            }
            // The runtime of the registration has ended, and another runtime polls the stream.
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

/// No field of the subscriber is pinned.
impl<T: Subscribe + ?Sized> Unpin for PollableSubscriber<T> {}

/// Stream of items as they arrive. It never ends. It keeps no item between polls, so no item is lost if a future is
/// dropped.
impl<T: Subscribe + ?Sized> Stream for PollableSubscriber<T> {
    type Item = Result<T::Item, Error>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = self.get_mut();
        loop {
            if let Some(item) = this.subscriber_mut().try_next().transpose() {
                return Poll::Ready(Some(item));
            }
            let (registration, descriptor) = this.registration();
            if let Err(error) = ready!(registration.poll_readable(descriptor, cx)) {
                return Poll::Ready(Some(Err(error)));
            }
        }
    }
}
