//! Tests that run again in a prepared process: in another network, with other mounts, or as another user.

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

use super::child::spawn;

/// Returns the path of the test binary.
pub(crate) fn own_program() -> std::path::PathBuf {
    std::env::current_exe().unwrap_or_else(|error| panic!("the path of the test binary is unknown: {error}"))
}

/// Returns the arguments with which the test binary runs only the test `name`, which includes the path of its modules.
pub(crate) fn single_test_args(name: &str) -> [&str; 3] {
    ["--exact", name, "--nocapture"]
}

/// Runs `command`, which runs only the test `name`, and prints its output.
///
/// # Panics
///
/// Panics if the test fails in the new process, or if no test has this name.
pub(crate) fn rerun_test(name: &str, mut command: Command) {
    command.stdin(Stdio::null()).stdout(Stdio::piped());
    let mut child =
        spawn(command).unwrap_or_else(|error| panic!("cannot run {name} in another process: {error}"));
    let out = child.stdout.take().expect("stdout is a pipe");
    let mut passed = false;
    for line in BufReader::new(out).lines().map_while(Result::ok) {
        passed |= line.starts_with("test result: ok. 1 passed");
        println!("{line}");
    }
    let status = child.wait().expect("the process can be waited for");
    assert!(
        status.success() && passed,
        "{name} failed in another process, or no test has this name: {status}"
    );
}

/// Runs `test`, whose name is `name`, in a separate process. A test needs this if it depends on descriptor numbers or
/// on the number of open descriptors. A test also needs it if its descriptors must not be inherited by children of
/// other tests.
///
/// # Panics
///
/// Panics if the test fails.
pub(crate) fn in_own_process(name: &str, test: impl FnOnce()) {
    const CHILD_VARIABLE: &str = "SCANHUB_TEST_PROCESS";
    if std::env::var_os(CHILD_VARIABLE).is_some_and(|inside| inside == name) {
        return test();
    }
    let mut command = Command::new(own_program());
    command.args(single_test_args(name)).env(CHILD_VARIABLE, name);
    rerun_test(name, command);
}
