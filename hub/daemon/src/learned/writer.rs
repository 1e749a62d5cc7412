//! The thread that writes what links have learned: it may wait for a disk, they may not. Refuses to know what is written, and
//! when.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use port::clock;
use rustix::event::{PollFd, PollFlags, poll};
use schema::Failure;
use shm::StateDirectory;

use super::{Keeper, Slots};
use crate::process::no_resource;

/// The thread; ends when this is dropped, after what was handed on until then.
pub(crate) struct Writer {
    slots: Arc<Slots>,
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// Starts it for `keeper`.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](schema::Kind) if threads are.
    pub(crate) fn start(keeper: Keeper<StateDirectory>) -> Result<Writer, Failure> {
        let (slots, is_over) = (keeper.slots(), Arc::new(AtomicBool::new(false)));
        let its_end = is_over.clone();
        let thread = thread::Builder::new().name(THREAD.into()).spawn(move || write(keeper, &its_end));
        let thread = thread.map_err(|error| no_resource("a thread", &error))?;
        Ok(Writer { slots, is_over, thread: Some(thread) })
    }

    /// What the links share with it.
    pub(crate) fn slots(&self) -> &Slots {
        &self.slots
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.slots.event.signal();
        // One that panicked has said so.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

fn write(mut keeper: Keeper<StateDirectory>, is_over: &AtomicBool) {
    let slots = keeper.slots();
    loop {
        slots.event.clear();
        let is_last = is_over.load(Ordering::Relaxed);
        let now = clock::now();
        let until = keeper.turn(now, clock::wall(now, now), is_last);
        if is_last {
            return;
        }
        let span = (until < u64::MAX).then(|| clock::span(now, until));
        // Whatever ends the wait, it is looked what there is.
        let _ = poll(&mut [PollFd::new(&slots.event, PollFlags::IN)], span.as_ref());
    }
}

/// The thread's name.
const THREAD: &str = "learned";
