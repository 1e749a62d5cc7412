//! Where the axis of a mount is, and where a beam ends that was measured at an angle of it. Refuses to know where the angle
//! comes from.

/// A mount with one axis, and the scanner on it. All in the robot's frame: x ahead, y left, z up, in metres; z is 0 at the
/// floor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mount {
    /// A point of the axis.
    pub axis_at: [f64; 3],
    /// The way of the axis, of any length but 0. Angles grow right-handed around it: around y, which is the default, a greater
    /// angle looks farther down; around -y farther up.
    pub axis: [f64; 3],
    /// The angle at which the scanner is as the following say, and measures level.
    pub level_rad: f64,
    /// Where its beams come from.
    pub sensor_at: [f64; 3],
    /// Where it looks, counter-clockwise from ahead.
    pub yaw_rad: f64,
    /// It hangs: its beams run the other way.
    pub is_upside_down: bool,
}

impl Default for Mount {
    /// A scanner at the origin that looks ahead, on an axis through itself.
    fn default() -> Mount {
        Mount {
            axis_at: [0.0; 3],
            axis: [0.0, 1.0, 0.0],
            level_rad: 0.0,
            sensor_at: [0.0; 3],
            yaw_rad: 0.0,
            is_upside_down: false,
        }
    }
}

impl Mount {
    /// Returns the direction of the beam at `beam_rad` (0 where the scanner looks, counter-clockwise) while the mount's angle is
    /// `angle_rad`: a unit vector.
    pub fn direction(&self, angle_rad: f64, beam_rad: f64) -> [f64; 3] {
        let turned = if self.is_upside_down { -beam_rad } else { beam_rad };
        let (sin, cos) = (self.yaw_rad + turned).sin_cos();
        self.turned([cos, sin, 0.0], angle_rad)
    }

    /// Returns where the beams come from while the mount's angle is `angle_rad`.
    pub fn origin(&self, angle_rad: f64) -> [f64; 3] {
        let arm = std::array::from_fn(|i| self.sensor_at[i] - self.axis_at[i]);
        let arm = self.turned(arm, angle_rad);
        std::array::from_fn(|i| self.axis_at[i] + arm[i])
    }

    /// Returns where that beam ends, `range_m` away.
    pub fn point(&self, angle_rad: f64, beam_rad: f64, range_m: f64) -> [f64; 3] {
        let (origin, way) = (self.origin(angle_rad), self.direction(angle_rad, beam_rad));
        std::array::from_fn(|i| origin[i] + range_m * way[i])
    }

    /// Rodrigues' formula.
    fn turned(&self, v: [f64; 3], angle_rad: f64) -> [f64; 3] {
        let length = dot(self.axis, self.axis).sqrt();
        let k = self.axis.map(|value| value / length);
        let (sin, cos) = (angle_rad - self.level_rad).sin_cos();
        let (across, along) = (cross(k, v), dot(k, v));
        std::array::from_fn(|i| v[i] * cos + across[i] * sin + k[i] * along * (1.0 - cos))
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_6};

    fn is_near(a: [f64; 3], b: [f64; 3]) -> bool {
        (0..3).all(|i| (a[i] - b[i]).abs() < 1e-9)
    }

    #[test]
    fn a_greater_angle_looks_down_to_the_floor() {
        let mount = Mount { axis_at: [0.0, 0.0, 1.0], sensor_at: [0.0, 0.0, 1.0], ..Mount::default() };
        assert!(is_near(mount.point(FRAC_PI_6, 0.0, 2.0), [3.0_f64.sqrt(), 0.0, 0.0]));
        assert!(
            is_near(mount.point(FRAC_PI_6, FRAC_PI_2, 2.0), [0.0, 2.0, 1.0]),
            "along the axis nothing sinks"
        );
        let other = Mount { axis: [0.0, -2.0, 0.0], ..mount };
        assert!(is_near(other.point(-FRAC_PI_6, 0.0, 2.0), [3.0_f64.sqrt(), 0.0, 0.0]));
    }

    #[test]
    fn the_arm_turns_with_the_mount_and_level_is_where_it_is_said() {
        let mount = Mount {
            axis_at: [0.1, 0.0, 1.0],
            sensor_at: [0.2, 0.0, 1.0],
            level_rad: 0.3,
            yaw_rad: FRAC_PI_2,
            is_upside_down: true,
            ..Mount::default()
        };
        assert!(is_near(mount.point(0.3, 0.0, 1.0), [0.2, 1.0, 1.0]));
        assert!(is_near(mount.point(0.3, FRAC_PI_2, 1.0), [1.2, 0.0, 1.0]), "it hangs");
        assert!(is_near(mount.origin(0.3 + FRAC_PI_2), [0.1, 0.0, 0.9]));
    }
}
