//! Finds people and obstacles in the scans of a hub: `scanhub track` and `scanhub tilt`, and the libraries that they are built
//! of.
//!
//! - [`track`] follows people across the sensors and rooms of a site.
//! - [`tilt`] computes points and obstacles in three dimensions from a scanner that a mount tilts.
//! - [`verbs`] subscribes to a hub, and prints and publishes the results of both.
//!
//! `track` and `tilt` have neither clock nor I/O: time is an argument, so a recording gives the same results at any speed.

#![forbid(unsafe_code)]

pub mod tilt;
pub mod track;
pub mod verbs;
