//! What a machine may lack: the test that needs it is left out and says why, or fails where the machine is known to have it.
//! `SCANHUB_REQUIRE` names what that is, with commas between; `.ci/run` sets it.
#![allow(dead_code)] // The tests of a crate need a part of it.

use std::fmt::Display;
use std::io::Write;

/// What tests can do without, by its name in `SCANHUB_REQUIRE`.
const NEEDS: [&str; 27] = [
    "bash",
    "cc",
    "c++",
    "cmake",
    "pkg-config",
    "valgrind",
    // Version 3.9 or later.
    "python",
    // What the pages and other people's readers of recordings import.
    "python-packages",
    // Draws the picture of an example.
    "matplotlib",
    // An event loop in place of that of asyncio.
    "uvloop",
    // The vendor's driver of the RPLIDARs, of which there is no build for every Python.
    "rplidar-driver",
    "setsid",
    "tmux",
    // A headless browser.
    "chromium",
    "tshark",
    // The program `scanhub-bridge`, beside the program.
    "bridge",
    "systemd-analyze",
    // A user who may make a network namespace, and `ip`.
    "netns",
    // In it a pair of interfaces.
    "veth",
    // In it a queue that `tc` limits.
    "tc",
    // In it a version of IGMP that can be chosen.
    "igmp",
    "ipv6",
    // A user who may mount in a namespace of its own.
    "mounts",
    // Root, who can be other users.
    "root",
    // A place of the program where other users can start it.
    "open-directory",
    // A machine with x86-64 on which a process may trace its children.
    "ptrace",
    // Of real sensors, in SCANHUB_DATA.
    "recordings",
];

/// Says that a test, or the rest of it, is left out for want of `need`, and why.
///
/// # Panics
///
/// If `need` is required here, or is none of those that are known.
pub(crate) fn skip(need: &str, why: impl Display) {
    let required = std::env::var("SCANHUB_REQUIRE").unwrap_or_default();
    match verdict(&required, need, &why.to_string()) {
        // Past what libtest keeps to itself.
        Ok(line) => drop(writeln!(std::io::stderr(), "{line}")),
        Err(line) => panic!("{line}"),
    }
}

/// What is to be said where `need` lacks and `required` is required; as an error if the test may not be left out.
pub(crate) fn verdict(required: &str, need: &str, why: &str) -> Result<String, String> {
    let required: Vec<&str> = required.split(',').map(str::trim).filter(|name| !name.is_empty()).collect();
    if let Some(unknown) = required.iter().chain([&need]).find(|name| !NEEDS.contains(name)) {
        return Err(format!("{unknown:?} is nothing that a test needs; there are {}", NEEDS.join(", ")));
    }
    if required.contains(&need) {
        return Err(format!("{need} is required here by SCANHUB_REQUIRE: {why}"));
    }
    Ok(format!("skipped for want of {need}: {why}"))
}
