//! Motion of a robot in the plane: its velocity, transforms between its positions, and the correction of scans. Scans
//! are corrected because a moving robot measures each beam from another position.

use std::f64::consts::{PI, TAU};

use scanhub_schema::{ArrayFlags, Pose, Scan, ScanHead, ScanWord};

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
    /// Returns the constant velocity that leads to the position `x`, `y` (in meters) and the direction `yaw` (in
    /// radians) within `seconds`, in the frame of the start.
    pub fn of_step((x, y, yaw): (f64, f64, f64), seconds: f64) -> Velocity {
        // A robot with a constant velocity moves on an arc, and the step is the chord of this arc.
        let half = yaw / 2.0;
        let arc = if half.abs() > MIN_ARC_RAD { half / half.sin() } else { 1.0 } / seconds;
        let (sin, cos) = half.sin_cos();
        Velocity { x: arc * (cos * x + sin * y), y: arc * (cos * y - sin * x), yaw: yaw / seconds }
    }

    /// Returns the position after `seconds` in the frame of the start: x and y in meters, yaw in radians. A negative
    /// number of seconds gives the position before the start.
    #[inline]
    pub fn position(&self, seconds: f64) -> (f64, f64, f64) {
        let half = self.yaw * seconds / 2.0;
        let (sin, cos) = half.sin_cos();
        let chord = if half.abs() > MIN_ARC_RAD { sin / half } else { 1.0 } * seconds;
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

    /// Returns `other` minus this velocity.
    pub(crate) fn difference(&self, other: &Velocity) -> Velocity {
        Velocity { x: other.x - self.x, y: other.y - self.y, yaw: other.yaw - self.yaw }
    }

    /// Changes this velocity by [`FILTER_GAIN`] of its difference from the `measured` velocity, which has noise.
    pub(crate) fn approach(&mut self, measured: &Velocity) {
        let Velocity { x, y, yaw } = self.difference(measured);
        (self.x, self.y, self.yaw) =
            (self.x + FILTER_GAIN * x, self.y + FILTER_GAIN * y, self.yaw + FILTER_GAIN * yaw);
    }

    /// Returns whether a robot with this velocity, while `scan` is measured, moves by more than `limit_m` meters or
    /// turns by so much that walls at [`WALL_DISTANCE_M`] move by more than `limit_m`.
    pub(crate) fn distorts(&self, scan: &Scan, limit_m: f64) -> bool {
        let [first_s, last_s] = times(scan);
        let span_s = last_s - first_s;
        span_s * self.x.hypot(self.y) > limit_m || span_s * self.yaw.abs() > limit_m / WALL_DISTANCE_M
    }

    /// Returns whether a robot can change its velocity by this difference of velocities from one scan to the next.
    pub(crate) fn is_possible(&self) -> bool {
        self.x.hypot(self.y) < MAX_CHANGE_M_S && self.yaw.abs() < MAX_CHANGE_RAD_S
    }

    /// Returns the mean offset of the beams of `scan` in x, y and yaw, if the beams were corrected by a velocity that
    /// differs from the true velocity by this difference.
    pub(crate) fn offset(&self, scan: &Scan) -> [f64; 3] {
        let [first_s, last_s] = times(scan);
        [self.x, self.y, self.yaw].map(|speed| speed * (first_s + last_s) / 2.0)
    }
}

/// Position and direction of a robot in a frame: meters, and radians counterclockwise from -pi to pi. It is also the
/// transform from the robot's own frame into that frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose2 {
    /// Position ahead, in meters.
    pub x: f64,
    /// Position to the left, in meters.
    pub y: f64,
    /// Direction, in radians.
    pub yaw: f64,
    cos: f64,
    sin: f64,
}

impl Default for Pose2 {
    fn default() -> Self {
        Pose2 { x: 0.0, y: 0.0, yaw: 0.0, cos: 1.0, sin: 0.0 }
    }
}

impl Pose2 {
    /// Creates the transform of position `x`, `y` and direction `yaw`.
    pub fn new(x: f64, y: f64, yaw: f64) -> Pose2 {
        let (sin, cos) = yaw.sin_cos();
        Pose2 { x, y, yaw: (yaw + PI).rem_euclid(TAU) - PI, cos, sin }
    }

    /// Returns the pose in the outer frame of a robot that is at the pose `next` in the frame of this pose.
    pub fn then(&self, next: &Pose2) -> Pose2 {
        let (x, y) = self.point((next.x, next.y));
        Pose2::new(x, y, self.yaw + next.yaw)
    }

    /// Returns the inverse transform.
    pub fn inverse(&self) -> Pose2 {
        let (x, y) = self.turned_back((-self.x, -self.y));
        Pose2::new(x, y, -self.yaw)
    }

    /// Transforms a point from the frame of this pose to the outer frame.
    #[inline]
    pub fn point(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.x + self.cos * x - self.sin * y, self.y + self.sin * x + self.cos * y)
    }

    /// Transforms a direction from the frame of this pose to the outer frame.
    #[inline]
    pub(crate) fn turned(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.cos * x - self.sin * y, self.sin * x + self.cos * y)
    }

    /// Transforms a direction from the outer frame to the frame of this pose.
    pub(crate) fn turned_back(&self, (x, y): (f64, f64)) -> (f64, f64) {
        (self.cos * x + self.sin * y, self.cos * y - self.sin * x)
    }
}

/// Scan without the distortion by motion, as if the sensor had measured all beams at the scan's stamp.
pub(crate) struct UndistortedScan {
    words: Box<[ScanWord]>,
    beams: usize,
}

impl UndistortedScan {
    /// Allocates a scan of at most `beams` beams.
    pub(crate) fn new(beams: usize) -> UndistortedScan {
        UndistortedScan { words: vec![ScanWord::default(); beams + Scan::words(0)].into(), beams }
    }

    /// Computes `scan` without the distortion that a sensor with this `velocity` causes. The beams of the result have
    /// exact angles. If two points fall on the same beam, the nearer one remains.
    pub(crate) fn compute(&mut self, scan: &Scan, velocity: &Velocity) -> &Scan {
        let count = scan.beams().min(self.beams);
        let [first_s, last_s] = times(scan);
        let first_angle = scan.first_angle + velocity.yaw * (first_s + last_s) / 2.0;
        let farthest_um = f64::from(scan.valid_to) * f64::from(scan.unit_um);
        let unit_um = (farthest_um / f64::from(NO_RETURN)).ceil().max(1.0);
        let head = ScanHead {
            first_angle,
            unit_um: unit_um as u32,
            valid_to: NO_RETURN - 1,
            no_return: NO_RETURN,
            beyond: NO_RETURN,
            count: count as u16,
            contents: ArrayFlags::ANGLES,
            turns: 1,
            intensity_bits: 0,
            ..**scan
        };
        let (old_m, new_m) = (1e-6 * f64::from(scan.unit_um), 1e-6 * unit_um);
        let is_whole = is_whole(count, scan.step);
        let arrays = Scan::of_words_mut(&mut self.words).begin(head);
        arrays.angles.fill(f32::NAN);
        arrays.ranges.fill(NO_RETURN);
        for i in 0..count {
            let Some(range) = scan.range(i).filter(|range| *range > 0) else { continue };
            let (x, y, yaw) = velocity.position(1e-9 * scan.beam_ns(i) as f64);
            let range = f64::from(range) * old_m;
            let angle = scan.angle(i) + yaw;
            let (sin, cos) = angle.sin_cos();
            let (along, across) = (range + cos * x + sin * y, cos * y - sin * x);
            let angle = angle + across.atan2(along);
            let range = (along.hypot(across) / new_m).round();
            let slot = (angle - first_angle) / scan.step;
            let beam_of = |slot: f64| {
                let beam = slot.round() as i64;
                let beam = if is_whole { beam.rem_euclid(count as i64) } else { beam };
                usize::try_from(beam).ok().filter(|beam| *beam < count)
            };
            let Some(mut beam) = beam_of(slot).filter(|_| range >= 1.0) else { continue };
            // Points of consecutive revolutions may fall on the same beam, and leave a neighboring beam empty. Use the
            // neighboring beam then.
            if arrays.ranges[beam] != NO_RETURN {
                let other = (f64::from(arrays.angles[beam]) - first_angle) / scan.step;
                let next = beam_of(if slot > other { slot.round() + 1.0 } else { slot.round() - 1.0 });
                beam = next.filter(|next| arrays.ranges[*next] == NO_RETURN).unwrap_or(beam);
            }
            if range < f64::from(arrays.ranges[beam]) {
                (arrays.ranges[beam], arrays.angles[beam]) = (range as u16, angle as f32);
            }
        }
        Scan::of_words(&self.words)
    }
}

/// Returns the times of the first and the last beam, in seconds after the stamp of `scan`.
pub(crate) fn times(scan: &Scan) -> [f64; 2] {
    let last = scan.beams().saturating_sub(1);
    // If a scan takes several revolutions, the last beam need not be the one that is measured last.
    let turns = usize::from(scan.turns.max(1));
    let of_turns = (last + 1).saturating_sub(turns)..=last;
    let latest = of_turns.map(|beam| scan.beam_ns(beam)).max().unwrap_or(0);
    [scan.beam_ns(0), latest].map(|time| 1e-9 * time as f64)
}

/// Returns whether `beams` beams that are `step` radians apart form a whole revolution, so that the last beam is a
/// neighbor of the first one.
pub(crate) fn is_whole(beams: usize, step: f64) -> bool {
    beams as f64 + 1.5 >= TAU / step.abs()
}

/// Value of a beam without a reading in an undistorted scan.
const NO_RETURN: u16 = u16::MAX;
/// Half of the turn of a step, in radians, below which the arc counts as a straight line.
const MIN_ARC_RAD: f64 = 1e-6;
/// Share of the difference from the measured velocity by which the filtered velocity changes at each scan.
const FILTER_GAIN: f64 = 0.3;
/// Maximum change of velocity from one scan to the next, in m/s. Even if a robot brakes, its velocity changes less.
const MAX_CHANGE_M_S: f64 = 2.0;
/// Maximum change of the speed of a turn from one scan to the next, in rad/s. The speed of a real robot's turn changes
/// less.
const MAX_CHANGE_RAD_S: f64 = 6.0;
/// Assumed distance of walls in meters, for comparing turns with motion. A turn by an angle in radians moves the points
/// of such a wall by the angle times this distance.
const WALL_DISTANCE_M: f64 = 5.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn velocity_integrates_to_the_step() {
        let mut random = fastrand::Rng::with_seed(45);
        for _ in 0..1000 {
            let mut number = |scale: f64| scale * (random.f64() - 0.5);
            let step = (number(0.5), number(0.5), number(2.0));
            let seconds = 0.01 + number(0.01).abs();
            let velocity = Velocity::of_step(step, seconds);
            let again = velocity.position(seconds);
            let half = velocity.position(seconds / 2.0);
            // The second half of the motion begins where the first half ends.
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
