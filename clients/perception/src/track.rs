//! People, across sensors and rooms: from what stands before the background of several sensors to persons with an identity.
//! No clock, and no I/O but the site file: time is that of the samples, in `wall_ns`, so a recording gives the same tracks
//! at any speed.
//!
//! [`Site`] is where sensors, rooms and doors are; [`People`] takes scans with their foregrounds and makes [`Picture`]s.

mod assignment;
mod filter;
pub mod geometry;
mod order;
mod passage;
mod person;
mod picture;
mod poses;
mod sight;
pub mod site;
mod tracker;

pub use order::{Counts, People};
pub use picture::{Event, Kind, Misplaced, Picture, Track};
pub use sight::LEGS;
pub use site::Site;
pub use tracker::{PERSONS, PICTURE_NS};
