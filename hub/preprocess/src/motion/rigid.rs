//! Where something is and where it looks, in the plane.

use std::f64::consts::{PI, TAU};

/// A place and a direction in some frame: metres, and radians counter-clockwise from -pi to pi.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rigid {
    /// Ahead.
    pub x: f64,
    /// To the left.
    pub y: f64,
    /// Direction.
    pub yaw: f64,
    cos: f64,
    sin: f64,
}

impl Default for Rigid {
    fn default() -> Self {
        Rigid { x: 0.0, y: 0.0, yaw: 0.0, cos: 1.0, sin: 0.0 }
    }
}

impl Rigid {
    /// The place `x`, `y` and the direction `yaw`.
    pub fn new(x: f64, y: f64, yaw: f64) -> Rigid {
        let (sin, cos) = yaw.sin_cos();
        Rigid { x, y, yaw: (yaw + PI).rem_euclid(TAU) - PI, cos, sin }
    }

    /// Returns what is `next` in the frame of this one, in the frame that this one is in.
    pub fn then(&self, next: &Rigid) -> Rigid {
        let (x, y) = self.point((next.x, next.y));
        Rigid::new(x, y, self.yaw + next.yaw)
    }

    /// Returns the frame that this one is in, as seen from this one.
    pub fn inverse(&self) -> Rigid {
        let (x, y) = self.turned_back((-self.x, -self.y));
        Rigid::new(x, y, -self.yaw)
    }

    /// Returns a point of this frame in the frame that this one is in.
    #[inline]
    pub fn point(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.x + self.cos * x - self.sin * y, self.y + self.sin * x + self.cos * y)
    }

    /// Returns a direction of this frame in the frame that this one is in.
    #[inline]
    pub(super) fn turned(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.cos * x - self.sin * y, self.sin * x + self.cos * y)
    }

    /// Returns a direction of the frame that this one is in, in this frame.
    pub(super) fn turned_back(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.cos * x + self.sin * y, self.cos * y - self.sin * x)
    }
}
