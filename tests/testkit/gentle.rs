//! Who only computes makes room for who has to be in time: beside tests with a sensor, which sends whether or not somebody
//! reads, others compile or search for seconds.

use std::process::Command;

/// As far behind as a process can stand.
const LAST: i32 = 19;

/// Lets this thread, and what it starts from now on, stand behind all others. For tests that do nothing but compute.
pub(crate) fn compute_gently() {
    // Of this thread alone, on Linux.
    let done = rustix::process::setpriority_process(None, LAST);
    done.unwrap_or_else(|error| panic!("anybody may stand behind: {error}"));
}

/// A command that starts `program` behind all others; its arguments may follow.
pub(crate) fn gentle(program: impl AsRef<std::ffi::OsStr>) -> Command {
    let mut command = Command::new("nice");
    command.arg("-n").arg(LAST.to_string()).arg(program);
    command
}
