//! Tests of recordings as files. The tests are one binary with several modules, so that the dependencies are linked
//! only once.

#[cfg(feature = "mcap")]
mod folder;
#[path = "../../../../tests/testkit/skip.rs"]
mod skip;
#[cfg(feature = "mcap")]
mod written;

#[cfg(feature = "mcap")]
mod convert;
#[cfg(feature = "mcap")]
mod damaged;
mod files;
#[cfg(feature = "mcap")]
mod hostile;
#[cfg(feature = "mcap")]
mod logs;
#[cfg(feature = "mcap")]
mod mcap;
mod real;
#[cfg(feature = "mcap")]
mod version_1;
