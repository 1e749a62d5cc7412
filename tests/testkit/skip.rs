//! Requirements of tests that a machine may not meet. A test whose requirement is missing prints the reason and is
//! skipped. The test fails instead if the variable `SCANHUB_REQUIRE` lists the requirement. `.ci/run` sets this
//! variable to a list of names that are separated by commas.
#![allow(dead_code)] // Each test binary uses only a part of this module.

use std::fmt::Display;
use std::io::Write;

/// Names of all requirements, as in `SCANHUB_REQUIRE`.
const NEEDS: [&str; 27] = [
    "bash",
    "cc",
    "c++",
    "cmake",
    "pkg-config",
    "valgrind",
    // Python of version 3.9 or later.
    "python",
    // Modules that the Python programs in the docs import, and readers of recordings from other projects.
    "python-packages",
    // A Python module with which an example draws a picture.
    "matplotlib",
    // A Python module with an event loop that replaces the one of asyncio.
    "uvloop",
    // The vendor's driver for RPLIDARs, which is not built for every version of Python.
    "rplidar-driver",
    "setsid",
    "tmux",
    // A headless browser.
    "chromium",
    "tshark",
    // The program `scanhub-bridge`, in the directory of the program `scanhub`.
    "bridge",
    "systemd-analyze",
    // Permission to create a network namespace, and the program `ip`.
    "netns",
    // A pair of interfaces in a network namespace.
    "veth",
    // A queue whose length `tc` limits, in a network namespace.
    "tc",
    // A network namespace in which the version of IGMP can be selected.
    "igmp",
    "ipv6",
    // Permission to mount file systems in a new namespace.
    "mounts",
    // The user root, who can start programs as other users.
    "root",
    // A directory that other users may enter, so that they can start the program in it.
    "open-directory",
    // An x86-64 machine on which a process may trace its children.
    "ptrace",
    // Recordings of real scanners, in the directory SCANHUB_DATA.
    "recordings",
];

/// Prints that the test, or the rest of the test, is skipped because `need` is missing. `why` is the text of the
/// reason. The caller then returns from the test.
///
/// # Panics
///
/// Panics if `SCANHUB_REQUIRE` contains `need`, or if `need` is not in [`NEEDS`].
pub(crate) fn skip(need: &str, why: impl Display) {
    let required = std::env::var("SCANHUB_REQUIRE").unwrap_or_default();
    match verdict(&required, need, &why.to_string()) {
        // libtest captures the output of `eprintln!`, but not that of `writeln!` to stderr.
        Ok(line) => drop(writeln!(std::io::stderr(), "{line}")),
        Err(line) => panic!("{line}"),
    }
}

/// Returns the message for a test whose requirement `need` is missing.
///
/// # Errors
///
/// Returns the message of a failure if the list `required` contains `need`, or if a name is not in [`NEEDS`].
pub(crate) fn verdict(required: &str, need: &str, why: &str) -> Result<String, String> {
    let required: Vec<&str> = required.split(',').map(str::trim).filter(|name| !name.is_empty()).collect();
    if let Some(unknown) = required.iter().chain([&need]).find(|name| !NEEDS.contains(name)) {
        return Err(format!("{unknown:?} is not a requirement of tests; known are {}", NEEDS.join(", ")));
    }
    if required.contains(&need) {
        return Err(format!("{need} is required here by SCANHUB_REQUIRE: {why}"));
    }
    Ok(format!("skipped for want of {need}: {why}"))
}
