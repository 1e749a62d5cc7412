//! Detects people and obstacles in the scans of a hub. Contains the verbs `scanhub track` and `scanhub tilt`, and their
//! libraries.
//!
//! - [`track`] tracks people across the sensors and rooms of a site.
//! - [`tilt`] computes points and obstacles in three dimensions from a scanner that a mount tilts.
//! - [`verbs`] subscribes to a hub, and prints and publishes the results of `track` and `tilt`.
//!
//! `track` and `tilt` use neither a clock nor I/O. Time is an argument, so a recording gives the same results at any
//! speed.

#![forbid(unsafe_code)]

pub mod tilt;
pub mod track;
pub mod verbs;
