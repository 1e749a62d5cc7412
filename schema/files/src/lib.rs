//! Files that a user names: bounded reads of regular files, and outputs that are complete or absent. Directories are
//! opened component by component, so that no other user can redirect a path.

#![forbid(unsafe_code)]

#[cfg(feature = "output")]
pub mod output;
#[cfg(feature = "path_walk")]
pub mod path_walk;
pub mod regular_file;
