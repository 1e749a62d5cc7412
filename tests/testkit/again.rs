//! A test that runs once more, in a process to which something was done before: another network, other mounts, other
//! users. Makes sure that it did run there.

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

/// Where the tests are that this process belongs to.
pub(crate) fn own_program() -> std::path::PathBuf {
    std::env::current_exe().unwrap_or_else(|error| panic!("no path: {error}"))
}

/// The words after which this program runs the test `name` (with its modules) and nothing else.
pub(crate) fn only(name: &str) -> [&str; 3] {
    ["--exact", name, "--nocapture"]
}

/// Runs what ends in running the test `name` by itself, and shows what it says.
///
/// # Panics
///
/// If the test failed there, or there is none of that name.
pub(crate) fn run_again(name: &str, mut command: Command) {
    command.stdin(Stdio::null()).stdout(Stdio::piped());
    let mut child = command.spawn().unwrap_or_else(|error| panic!("{name} does not start again: {error}"));
    let out = child.stdout.take().expect("a pipe");
    let mut passed = false;
    for line in BufReader::new(out).lines().map_while(Result::ok) {
        passed |= line.starts_with("test result: ok. 1 passed");
        println!("{line}");
    }
    let status = child.wait().expect("it can be waited for");
    assert!(status.success() && passed, "{name} failed where it ran again: {status}");
}

/// Runs `test`, which is called `name`, in a process of its own: it opens descriptors that processes which other tests
/// start would inherit, whose number counts.
///
/// # Panics
///
/// If the test fails.
pub(crate) fn in_own_process(name: &str, test: impl FnOnce()) {
    const INSIDE: &str = "SCANHUB_TEST_PROCESS";
    if std::env::var_os(INSIDE).is_some_and(|inside| inside == name) {
        return test();
    }
    let mut command = Command::new(own_program());
    command.args(only(name)).env(INSIDE, name);
    run_again(name, command);
}
