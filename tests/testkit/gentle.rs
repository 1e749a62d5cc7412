//! Tests beside each other: what waits is waited for together, and who only computes makes room for who has to be in time: beside tests with a sensor, which sends whether or not somebody
//! reads, others compile or search for seconds.

use std::ffi::OsStr;
use std::panic::resume_unwind;
use std::process::Command;
use std::thread;

use rustix::process::{getpriority_process, setpriority_process};

/// As far behind as a process can stand.
const LAST: i32 = 19;
/// Behind what is about time, and before what only computes.
const BEHIND: i32 = 5;

/// Lets this thread, and what it starts from now on, stand behind all others. For tests that do nothing but compute.
pub(crate) fn compute_gently() {
    stand_at(LAST);
}

/// Lets this thread, and what it starts from now on, stand behind those tests that hold something about time.
pub(crate) fn wait_gently() {
    stand_at(BEHIND);
}

/// Of this thread alone, as Linux has it; none comes forward again, which root alone may.
fn stand_at(place: i32) {
    let now = getpriority_process(None).unwrap_or_else(|error| panic!("no priority: {error}"));
    let done = setpriority_process(None, place.max(now));
    done.unwrap_or_else(|error| panic!("anybody may stand behind: {error}"));
}

/// Does `each` of these with every one of `items`, all of them side by side: what mostly waits is waited for once.
///
/// # Panics
///
/// As the first one does that panics.
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

/// A command that starts `program` behind all others; its arguments may follow.
pub(crate) fn gentle(program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new("nice");
    command.arg("-n").arg(LAST.to_string()).arg(program);
    command
}
