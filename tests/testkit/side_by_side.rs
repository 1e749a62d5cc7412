//! Calls of one function for several items, each in its own thread: for tests that mostly wait.

use std::panic::resume_unwind;
use std::thread;

/// Calls `each` for every one of `items`, all at the same time, each in a separate thread.
///
/// # Panics
///
/// With the panic of the first call that panicked.
pub(crate) fn run_concurrently<T: Send, R: Send>(
    items: impl IntoIterator<Item = T>,
    each: impl Fn(T) -> R + Sync,
) -> Vec<R> {
    let each = &each;
    thread::scope(|scope| {
        let started: Vec<_> = items.into_iter().map(|item| scope.spawn(move || each(item))).collect();
        let done =
            started.into_iter().map(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)));
        done.collect()
    })
}
