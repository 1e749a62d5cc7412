//! Tests about time, on a machine that is busy: they hold for programs that get a processor when they want one, so a failure
//! counts unless the kernel says that the test's programs had to wait for one. Refuses to excuse anything else.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::time::Duration;

thread_local! {
    /// How long the programs that this thread ended had been kept waiting.
    static KEPT_WAITING: Cell<Duration> = const { Cell::new(Duration::ZERO) };
}

/// How long all programs of a test wait for a processor that has nothing else to do.
const USUAL: Duration = Duration::from_millis(200);
/// How often others may be in the way.
const ATTEMPTS: usize = 5;

/// Runs `test`, and once more if it failed while others kept its programs from the processors.
///
/// # Panics
///
/// If it fails and its programs were not kept waiting, or each time.
pub(crate) fn hold_in_time(test: impl Fn()) {
    for attempt in 1.. {
        KEPT_WAITING.set(Duration::ZERO);
        let Err(panic) = catch_unwind(AssertUnwindSafe(&test)) else { return };
        let waited = KEPT_WAITING.get();
        if waited < USUAL || attempt == ATTEMPTS {
            resume_unwind(panic);
        }
        eprintln!("attempt {attempt}: its programs waited {waited:?} for a processor; once more");
    }
}

/// A program of this test ends, which was kept waiting for so long.
pub(super) fn ends_after(kept_waiting: Duration) {
    KEPT_WAITING.set(KEPT_WAITING.get() + kept_waiting);
}
