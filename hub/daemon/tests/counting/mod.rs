//! The system's allocator, with counts of the allocations of one thread, for tests that no memory is allocated.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicI32, AtomicI64, AtomicU64, Ordering::Relaxed};

use rustix::thread::gettid;

/// Allocator that counts the allocations of one thread.
struct CountingAllocator;

/// ID of the thread whose allocations are counted; 0 for none.
pub(crate) static WATCHED_THREAD: AtomicI32 = AtomicI32::new(0);
/// Number of allocations of the watched thread.
pub(crate) static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);
/// Number of bytes that the watched thread has allocated and not freed.
pub(crate) static HELD_BYTES: AtomicI64 = AtomicI64::new(0);

fn note(allocations: u64, bytes: i64) {
    let watched = WATCHED_THREAD.load(Relaxed);
    if watched != 0 && gettid().as_raw_nonzero().get() == watched {
        ALLOCATIONS.fetch_add(allocations, Relaxed);
        HELD_BYTES.fetch_add(bytes, Relaxed);
    }
}

// SAFETY: every call is passed to the system's allocator unchanged, and counting allocates no memory.
unsafe impl GlobalAlloc for CountingAllocator {
    // SAFETY: the caller fulfills the contract of the trait, which is that of the system's allocator.
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note(1, layout.size() as i64);
        // SAFETY: as above.
        unsafe { System.alloc(layout) }
    }

    // SAFETY: as above.
    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        note(0, -(layout.size() as i64));
        // SAFETY: as above.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;
