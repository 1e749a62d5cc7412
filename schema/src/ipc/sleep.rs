//! Sleeps on the wake services of several sensors at once. Hides what wakes consumers; refuses to know why they wait.
//!
//! Waking up and taking the wake-ups are two calls, so that samples can be received between them: a pending wake-up loses
//! nothing, and taking it costs several system calls.
#![allow(unsafe_code)]

use std::os::fd::BorrowedFd;
use std::time::Duration;

use iceoryx2::port::listener::ListenerWaitError;
use iceoryx2::prelude::FileDescriptorBased;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;

use super::Listener;
use crate::{Failure, Kind};

/// Sleeps until one of `listeners` is woken, a signal arrives or `timeout` is over. Wake-ups stay pending: take them with
/// [`take_wakeups`], then look once more for samples, before the next sleep.
///
/// # Errors
///
/// [`Kind::Short`] if the system cannot wait.
pub fn sleep(listeners: &[&Listener], timeout: Duration) -> Result<(), Failure> {
    let mut fds: Vec<PollFd<'_>> = listeners
        .iter()
        .map(|listener| PollFd::from_borrowed_fd(descriptor(listener), PollFlags::IN))
        .collect();
    let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: i64::from(timeout.subsec_nanos()) };
    match poll(&mut fds, Some(&timeout)) {
        Ok(_) | Err(Errno::INTR) => Ok(()),
        Err(error) => Err(broken(&error)),
    }
}

/// Returns what is readable while wake-ups of `listener` are pending: for who waits for other things as well.
pub fn descriptor(listener: &Listener) -> BorrowedFd<'_> {
    // SAFETY: the descriptor is open as long as the listener lives, which is borrowed as long as the result.
    unsafe { BorrowedFd::borrow_raw(listener.file_descriptor().native_handle()) }
}

/// Takes all pending wake-ups of `listeners`; returns whether there were any. Look for samples that were sent before this
/// call after it.
///
/// # Errors
///
/// [`Kind::Short`] if a listener does not work.
pub fn take_wakeups(listeners: &[&Listener]) -> Result<bool, Failure> {
    let mut any = false;
    for listener in listeners {
        match listener.try_wait(|_| any = true) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
            Err(error) => return Err(broken(&error)),
        }
    }
    Ok(any)
}

fn broken(error: &dyn std::fmt::Debug) -> Failure {
    Failure::new(Kind::Short, format!("cannot wait for the hub: {error:?}"), "`ulimit -n` may be too small")
}
