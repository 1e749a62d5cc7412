//! What wakes a thread that waits for descriptors: an eventfd that stays readable until it is hushed. Refuses to know why.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use rustix::event::{EventfdFlags, eventfd};
use rustix::io::Errno;
use schema::{Failure, Kind};

/// Rings until it is hushed.
pub(crate) struct EventFd(OwnedFd);

impl EventFd {
    /// One that does not ring.
    ///
    /// [`Kind::Short`] if descriptors are.
    pub(crate) fn new() -> Result<EventFd, Failure> {
        let made = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK);
        made.map(EventFd).map_err(|error: Errno| {
            Failure::new(Kind::Short, format!("cannot get an eventfd: {error}"), "raise `ulimit -n`")
        })
    }

    pub(crate) fn signal(&self) {
        // Fails only if it rings already.
        let _ = rustix::io::write(&self.0, &1_u64.to_ne_bytes());
    }

    pub(crate) fn clear(&self) {
        // Fails only if it does not ring.
        let _ = rustix::io::read(&self.0, &mut [0; 8]);
    }
}

impl AsFd for EventFd {
    /// Readable as long as it rings.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
