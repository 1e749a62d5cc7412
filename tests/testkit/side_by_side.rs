//! Concurrent calls of one function for several items, for tests that mostly wait.

use std::panic::resume_unwind;
use std::thread;

/// Calls `each` for all `items` at the same time, each call in its own thread, and returns the results in the order of
/// the items.
///
/// # Panics
///
/// Panics with the panic of the first item whose call panicked.
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
