//! Velocity of a robot that moves while a scan is measured.

use scanhub_schema::{Pose, Scan};

/// Velocity of a robot or of a sensor, in its own frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Velocity {
    /// Ahead, in m/s.
    pub x: f64,
    /// To the left, in m/s.
    pub y: f64,
    /// Counterclockwise, in rad/s.
    pub yaw: f64,
}

impl Velocity {
    /// Returns the constant velocity that leads to the position `x`, `y`, `yaw` within `seconds`, in meters and radians.
    pub fn of_step((x, y, yaw): (f64, f64, f64), seconds: f64) -> Velocity {
        // The step is the chord of an arc.
        let half = yaw / 2.0;
        let arc = if half.abs() > STRAIGHT_RAD { half / half.sin() } else { 1.0 } / seconds;
        let (sin, cos) = half.sin_cos();
        Velocity { x: arc * (cos * x + sin * y), y: arc * (cos * y - sin * x), yaw: yaw / seconds }
    }

    /// Returns the position after `seconds`, or before if they are negative, in the frame of the start: x and y in meters, yaw in
    /// radians.
    #[inline]
    pub fn position(&self, seconds: f64) -> (f64, f64, f64) {
        let half = self.yaw * seconds / 2.0;
        let (sin, cos) = half.sin_cos();
        let chord = if half.abs() > STRAIGHT_RAD { sin / half } else { 1.0 } * seconds;
        (chord * (cos * self.x - sin * self.y), chord * (sin * self.x + cos * self.y), 2.0 * half)
    }

    /// Returns the velocity of a sensor at `pose` on the robot.
    pub fn of_sensor(&self, pose: &Pose) -> Velocity {
        let (x, y) = (self.x - self.yaw * pose.y_m, self.y + self.yaw * pose.x_m);
        let (sin, cos) = pose.yaw_rad.sin_cos();
        let (x, y) = (cos * x + sin * y, cos * y - sin * x);
        match pose.upside_down {
            0 => Velocity { x, y, yaw: self.yaw },
            _ => Velocity { x, y: -y, yaw: -self.yaw },
        }
    }

    /// Returns `other` less this velocity.
    pub(crate) fn difference(&self, other: &Velocity) -> Velocity {
        Velocity { x: other.x - self.x, y: other.y - self.y, yaw: other.yaw - self.yaw }
    }

    /// Moves a part of the way to the `measured` velocity, which has noise.
    pub(crate) fn approach(&mut self, measured: &Velocity) {
        let Velocity { x, y, yaw } = self.difference(measured);
        (self.x, self.y, self.yaw) = (self.x + GAIN * x, self.y + GAIN * y, self.yaw + GAIN * yaw);
    }

    /// Returns whether a robot with this velocity moves by more than `limit_m`, or turns by more than a fifth of it in radians,
    /// while `scan` is measured.
    pub(crate) fn distorts(&self, scan: &Scan, limit_m: f64) -> bool {
        let [first_s, last_s] = times(scan);
        let span_s = last_s - first_s;
        span_s * self.x.hypot(self.y) > limit_m || span_s * self.yaw.abs() > limit_m / FAR_M
    }

    /// Returns whether a robot can change its velocity by this one from one scan to the next.
    pub(crate) fn is_possible(&self) -> bool {
        self.x.hypot(self.y) < MAX_CHANGE_M_S && self.yaw.abs() < MAX_CHANGE_RAD_S
    }

    /// Returns how far the beams of `scan` are off on average if they are corrected by a velocity that differs by this one.
    pub(crate) fn offset(&self, scan: &Scan) -> [f64; 3] {
        let [first_s, last_s] = times(scan);
        [self.x, self.y, self.yaw].map(|speed| speed * (first_s + last_s) / 2.0)
    }
}

/// Returns the times of the first and the last beam, in seconds after the stamp of `scan`.
pub(crate) fn times(scan: &Scan) -> [f64; 2] {
    let last = scan.beams().saturating_sub(1);
    // The last beam is measured before others if there are several revolutions.
    let turns = usize::from(scan.turns.max(1));
    let of_turns = (last + 1).saturating_sub(turns)..=last;
    let latest = of_turns.map(|beam| scan.beam_ns(beam)).max().unwrap_or(0);
    [scan.beam_ns(0), latest].map(|time| 1e-9 * time as f64)
}

/// Half the turn of a step below which an arc equals its chord.
const STRAIGHT_RAD: f64 = 1e-6;
/// Part of the way to the measured velocity, per scan.
const GAIN: f64 = 0.3;
/// Maximum change of velocity from one scan to the next. A robot brakes and turns less hard.
const MAX_CHANGE_M_S: f64 = 2.0;
const MAX_CHANGE_RAD_S: f64 = 6.0;
/// Distance of walls that a turn moves as far as the same motion, in meters.
const FAR_M: f64 = 5.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_velocity_leads_to_its_step() {
        let mut random = fastrand::Rng::with_seed(45);
        for _ in 0..1000 {
            let mut number = |scale: f64| scale * (random.f64() - 0.5);
            let step = (number(0.5), number(0.5), number(2.0));
            let seconds = 0.01 + number(0.01).abs();
            let velocity = Velocity::of_step(step, seconds);
            let again = velocity.position(seconds);
            let half = velocity.position(seconds / 2.0);
            // The second half begins where the first one ends.
            let (sin, cos) = half.2.sin_cos();
            let twice =
                (half.0 + cos * half.0 - sin * half.1, half.1 + sin * half.0 + cos * half.1, 2.0 * half.2);
            for end in [again, twice] {
                for off in [step.0 - end.0, step.1 - end.1, step.2 - end.2] {
                    assert!(off.abs() < 1e-9, "{step:?} {end:?}");
                }
            }
        }
    }
}
