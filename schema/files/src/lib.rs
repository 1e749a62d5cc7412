//! Files that a user names: reads of regular files up to a maximum length, and output files that are complete or
//! absent. Directories are opened component by component, so that no other user can redirect a path.

#![forbid(unsafe_code)]

#[cfg(feature = "output")]
pub mod output;
#[cfg(feature = "path_walk")]
pub mod path_walk;
pub mod regular_file;
