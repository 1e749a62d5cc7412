//! Three dimensions with a planar scanner that a mount tilts: its scans and the mount's angles become points, sweep by sweep,
//! and what stands before the learned background, or near the robot, becomes obstacles. No clock and no I/O: time is that of
//! the stamps, so a recording gives the same at any speed.
//!
//! [`Mount`] is where the axis is; [`Tilting`] takes scans and [`Angle`]s and hands out [`Sweep`]s. An angle that cannot be
//! trusted makes no points; [`Counts`] say how many were withheld, and why.

mod angles;
mod background;
mod check;
mod delay;
mod mount;
mod obstacles;
mod scenery;
mod settings;
mod sweep;
mod swing;
mod tilting;

/// The examples of the page.
#[cfg(doctest)]
#[doc = include_str!("../../../docs/tilt.md")]
struct Page;

pub use angles::{Angle, Withheld};
pub use check::{Check, Floor, Wall};
pub use mount::Mount;
pub use scanhub_schema::{OBSTACLES, Obstacle, PointClass};
pub use settings::Settings;
pub use sweep::{Point, Sweep};
pub use tilting::{Counts, Tilting};
