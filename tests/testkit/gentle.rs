//! How tests share two cores. A simulated sensor sends whether or not its reader gets a processor, so tests that compile or
//! compute for seconds run at a lower priority; tests that mostly wait run side by side.

use std::ffi::OsStr;
use std::panic::resume_unwind;
use std::process::Command;
use std::thread;

use rustix::process::{getpriority_process, setpriority_process};

/// The lowest priority of a process.
const LAST: i32 = 19;
/// Below tests that measure time, above those that only compute.
const BEHIND: i32 = 5;

/// Gives this thread, and what it starts from now on, the lowest priority: for tests that only compute.
pub(crate) fn compute_gently() {
    stand_at(LAST);
}

/// Gives this thread, and what it starts from now on, a lower priority than tests that measure time have.
pub(crate) fn wait_gently() {
    stand_at(BEHIND);
}

/// Linux sets it for this thread alone. It is never raised again: only root may.
fn stand_at(place: i32) {
    let now = getpriority_process(None).unwrap_or_else(|error| panic!("no priority: {error}"));
    let done = setpriority_process(None, place.max(now));
    done.unwrap_or_else(|error| panic!("anybody may stand behind: {error}"));
}

/// Calls `each` for every one of `items`, all at the same time, each in a thread of its own.
///
/// # Panics
///
/// With the panic of the first call that panicked.
pub(crate) fn side_by_side<T: Send, R: Send>(
    items: impl IntoIterator<Item = T>,
    each: impl Fn(T) -> R + Sync,
) -> Vec<R> {
    let each = &each;
    thread::scope(|scope| {
        let begun: Vec<_> = items.into_iter().map(|item| scope.spawn(move || each(item))).collect();
        let done = begun.into_iter().map(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)));
        done.collect()
    })
}

/// A command that starts `program` at the lowest priority; its arguments may follow.
pub(crate) fn gentle(program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new("nice");
    command.arg("-n").arg(LAST.to_string()).arg(program);
    command
}
