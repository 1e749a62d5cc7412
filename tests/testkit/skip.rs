//! Requirements of tests that a machine may not meet. A test whose requirement is missing is skipped and prints the
//! reason. It fails instead if the variable `SCANHUB_REQUIRE` lists the requirement. `.ci/run` sets this variable to
//! names that are separated by commas.
#![allow(dead_code)] // Each test binary uses only a part of it.

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
    // Version 3.9 or later.
    "python",
    // Modules that programs on the pages import, and readers of recordings from other projects.
    "python-packages",
    // An example draws a picture with it.
    "matplotlib",
    // An event loop that replaces the one of asyncio.
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
    // A queue in a network namespace that `tc` limits.
    "tc",
    // A version of IGMP that can be selected in a network namespace.
    "igmp",
    "ipv6",
    // Permission to mount file systems in a new namespace.
    "mounts",
    // The user root, who can start programs as other users.
    "root",
    // A directory of the program in which other users can start it.
    "open-directory",
    // An x86-64 machine on which a process may trace its children.
    "ptrace",
    // Recordings of real scanners, in the directory SCANHUB_DATA.
    "recordings",
];

/// Prints that the test, or the rest of it, is skipped because `need` is missing, and the reason `why`. The caller then
/// returns from the test.
///
/// # Panics
///
/// Panics if `SCANHUB_REQUIRE` contains `need`, or if `need` is not in [`NEEDS`].
pub(crate) fn skip(need: &str, why: impl Display) {
    let required = std::env::var("SCANHUB_REQUIRE").unwrap_or_default();
    match verdict(&required, need, &why.to_string()) {
        // libtest captures `eprintln!`, but not this.
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
