//! Recordings as files: one binary with a module for each thing that is held, so that what they all link is linked once.

mod folder;
#[path = "../../../../tests/testkit/skip.rs"]
mod skip;
mod written;

mod convert;
mod damaged;
mod files;
mod hostile;
mod logs;
mod mcap;
mod real;
mod version_1;
