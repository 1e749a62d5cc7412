//! The system's allocator with a count of what one thread takes from it: for tests that promise that nothing is taken.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicI32, AtomicI64, AtomicU64, Ordering::Relaxed};

use rustix::thread::gettid;

/// Counts what one thread asks for.
struct CountingAllocator;

/// The thread whose requests are counted; 0: nobody's.
pub(crate) static WATCHED_THREAD: AtomicI32 = AtomicI32::new(0);
/// Pieces taken.
pub(crate) static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);
/// Bytes taken and not given back.
pub(crate) static HELD_BYTES: AtomicI64 = AtomicI64::new(0);

fn note(allocations: u64, bytes: i64) {
    let watched = WATCHED_THREAD.load(Relaxed);
    if watched != 0 && gettid().as_raw_nonzero().get() == watched {
        ALLOCATIONS.fetch_add(allocations, Relaxed);
        HELD_BYTES.fetch_add(bytes, Relaxed);
    }
}

// SAFETY: every call goes to the system's allocator as it came; counting asks for no memory.
unsafe impl GlobalAlloc for CountingAllocator {
    // SAFETY: the caller keeps the promises of the trait, which are those of the system's allocator.
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
