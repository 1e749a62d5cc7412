//! Where a sensor is mounted on the robot, and where its beams point. Refuses to know what they hit.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

/// A sensor's pose in the robot's frame: x ahead, y left, the origin at the robot's center. 32 bytes.
///
/// The default is a sensor at the centre that looks ahead.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Pose.v2"))]
#[repr(C)]
pub struct Pose {
    /// Position of the sensor, in meters ahead of the robot's center.
    pub x_m: f64,
    /// Position of the sensor, in meters to the left of the robot's center.
    pub y_m: f64,
    /// Direction of the sensor, in radians counterclockwise from ahead.
    pub yaw_rad: f64,
    /// 1 if the sensor is mounted upside down, so that its first beam is the leftmost.
    pub upside_down: u8,
    /// 0. In a status, the first one is 1 if a threshold for reflectors (`marks.level`) is configured.
    pub reserved: [u8; 7],
}

impl Pose {
    /// Returns the direction of the beam at sensor angle `angle` (radians; 0 ahead, counter-clockwise as an upright sensor
    /// sees it) in the robot's frame: a unit vector.
    pub fn direction(&self, angle: f64) -> (f64, f64) {
        let turned = if self.upside_down == 0 { angle } else { -angle };
        let (sin, cos) = (self.yaw_rad + turned).sin_cos();
        (cos, sin)
    }

    /// Returns the point at `range_mm` on that beam in the robot's frame, in mm.
    pub fn point_mm(&self, angle: f64, range_mm: f64) -> (f64, f64) {
        let (x, y) = self.direction(angle);
        (1000.0 * self.x_m + range_mm * x, 1000.0 * self.y_m + range_mm * y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    #[test]
    fn beams_point_where_the_sensor_is_turned_and_mounted() {
        let near = |(x, y): (f64, f64), (a, b): (f64, f64)| (x - a).abs() < 1e-9 && (y - b).abs() < 1e-9;
        let ahead = Pose { x_m: 0.3, y_m: -0.1, ..Pose::default() };
        assert!(near(ahead.point_mm(0.0, 500.0), (800.0, -100.0)));
        assert!(near(ahead.point_mm(-FRAC_PI_2, 500.0), (300.0, -600.0)), "the first beam looks right");
        let rear = Pose { yaw_rad: 2.0 * FRAC_PI_2, ..Pose::default() };
        assert!(near(rear.direction(-FRAC_PI_2), (0.0, 1.0)), "behind, right is left");
        let turned_over = Pose { yaw_rad: FRAC_PI_2, upside_down: 1, ..Pose::default() };
        assert!(near(turned_over.direction(0.0), (0.0, 1.0)));
        assert!(
            near(turned_over.direction(-FRAC_PI_2), (-1.0, 0.0)),
            "upside down, the first beam looks left"
        );
    }
}
