//! What a picture of the robot shows and where: points in the robot's coordinates, circles with their verdict, the state of
//! each sensor and its rate, age and losses, and why nothing comes. Every picture is drawn from this, so that no two can
//! disagree. Refuses to know terminals, browsers and shared memory; time is an argument.

mod circles;
mod contents;
mod meter;
mod mount;
mod people;
mod read_out;
mod trail;
mod trouble;

use scanhub_schema::Pose;

pub use circles::{Circle, circles};
pub use contents::{Scene, Sensor, verdict};
pub use meter::Meter;
pub use mount::Mount;
pub use people::{Ellipse, People, Person, rooms};
pub use read_out::{Place, Reading};
pub use trail::Trail;
pub use trouble::Trouble;

/// Where a beam ended, in the robot's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Metres ahead of the robot's centre.
    pub x_m: f64,
    /// Metres to the left of it.
    pub y_m: f64,
    /// Which beam of the scan it is.
    pub beam: usize,
    /// How much came back, in the sensor's own units, if it says so.
    pub intensity: Option<u16>,
    /// It stands before the background.
    pub is_foreground: bool,
}

impl Point {
    /// Its distance from the robot's centre in metres.
    pub fn distance_m(&self) -> f64 {
        self.x_m.hypot(self.y_m)
    }
}

fn point_m(pose: &Pose, angle: f64, range_mm: f64) -> (f64, f64) {
    let (x, y) = pose.point_mm(angle, range_mm);
    (x / 1000.0, y / 1000.0)
}
