//! The operations on the words of a bell, and their order: the part that must be right in all interleavings of hub and
//! consumers, and is tested in all of them below. Refuses to know where the words are and how threads sleep.

use std::sync::atomic::{AtomicU32, Ordering, fence};

use rustix::thread::futex;

/// A word that several processes see, and at which their threads can sleep.
pub(super) trait Word {
    fn fetch_add(&self, summand: u32, order: Ordering) -> u32;
    fn load(&self, order: Ordering) -> u32;
    fn store(&self, value: u32, order: Ordering);
    fn fence(order: Ordering);
    /// Wakes all threads that sleep at this word.
    fn wake(&self);
}

/// Counts one more and wakes all who sleep at the word `rung`. Who sees the new number sees what was sent before.
pub(super) fn ring(rung: &impl Word) {
    rung.fetch_add(1, Ordering::Release);
    rung.wake();
}

/// The number in the word `rung`: what was sent before it came to be can be received after this.
pub(super) fn rung<W: Word>(rung: &W) -> u32 {
    // Only a relaxed load may touch memory that is mapped read-only.
    let number = rung.load(Ordering::Relaxed);
    W::fence(Ordering::Acquire);
    number
}

/// Says in the word `closed` that nobody rings any more, and wakes all once more: who sees the new number sees that, too.
pub(super) fn close<W: Word>(closed: &W, rung: &W) {
    closed.store(1, Ordering::Relaxed);
    ring(rung);
}

impl Word for AtomicU32 {
    fn fetch_add(&self, summand: u32, order: Ordering) -> u32 {
        self.fetch_add(summand, order)
    }

    fn load(&self, order: Ordering) -> u32 {
        self.load(order)
    }

    fn store(&self, value: u32, order: Ordering) {
        self.store(value, order);
    }

    fn fence(order: Ordering) {
        fence(order);
    }

    fn wake(&self) {
        // Nobody there is no error, and there is no other one for a word that is mapped.
        let _ = futex::wake(self, futex::Flags::empty(), i32::MAX as u32);
    }
}

#[cfg(test)]
mod tests;
