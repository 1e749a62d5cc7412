//! Motion of a sensor from one scan to the next, as estimated from its scans.

use std::fmt;

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::payload::{FixedPayload, are_finite};
use crate::text::named;

/// The payload of topic `motion`, 120 bytes: one sample per scan, in the robot's frame.
///
/// The step is the pose of the robot at this scan, in the robot's frame at the previous scan. The summed pose is the
/// sum of all steps since the start. It drifts, because the errors of the steps add up.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Motion.v2"))]
#[repr(C)]
pub struct Motion {
    /// Summed pose: meters ahead of the robot's center at the first scan. It drifts.
    pub x_m: f64,
    /// Summed pose: meters to the left of the center at the first scan.
    pub y_m: f64,
    /// Summed pose: radians counterclockwise from the robot's direction at the first scan, from -pi to pi.
    pub yaw_rad: f64,
    /// Step: meters ahead, in the robot's frame at the previous scan.
    pub dx_m: f32,
    /// Step: meters to the left.
    pub dy_m: f32,
    /// Step: radians counterclockwise.
    pub dyaw_rad: f32,
    /// Covariance of the step, row by row, in the order x, y, yaw; in m2, m rad and rad2.
    pub covariance: [f32; 9],
    /// Share of this scan's readings on surfaces of the scan that it was matched with, 0 to 1.
    pub overlap: f32,
    /// Method: [`MotionMethod`]. Treat every other number as refused.
    pub method: u8,
    /// Flags: [`Motion::DEGENERATE`], [`Motion::OPEN`].
    pub flags: u8,
    /// Number of refused steps since the start; 65535 means 65535 or more. The summed pose does not contain them.
    pub refused_steps: u16,
    /// Covariance of the summed pose in the frame of the start, in the layout of [`Motion::covariance`], without
    /// refused steps. It is 0 for the first scan, for an invalid pose, and from a sender with revision 1. See
    /// [`Motion::sum_covariance`].
    pub pose_covariance: [f32; 9],
    /// 0.
    pub reserved: u32,
}

/// Method by which a step was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum MotionMethod {
    /// The first scan, which has no step.
    First,
    /// No step explains the scan. Step and summed pose are unknown, and their numbers are 0.
    Refused,
    /// Only beams were matched, because both scans have no corner or line in common.
    Beams,
    /// Corners of both scans were matched.
    Points,
    /// Lines of both scans were matched.
    Lines,
    /// Corners and lines of both scans were matched.
    Both,
}

named! {
    MotionMethod:
    First "first",
    Refused "refused",
    Beams "beams",
    Points "points",
    Lines "lines",
    Both "both",
}

impl fmt::Display for MotionMethod {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Default for Motion {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl FixedPayload for Motion {
    /// The first revision ends before the covariance of the pose.
    const FIRST_REVISION_LEN: usize = std::mem::offset_of!(Motion, pose_covariance);

    fn is_valid(&self) -> bool {
        let step = [self.dx_m, self.dy_m, self.dyaw_rad, self.overlap];
        are_finite(&[self.x_m, self.y_m, self.yaw_rad])
            && are_finite(step.iter().chain(&self.covariance).chain(&self.pose_covariance))
    }
}

impl Motion {
    /// Flag: the surroundings do not show how far the robot moved in some direction, as in a corridor. The covariance
    /// is large in this direction.
    pub const DEGENERATE: u8 = 1;
    /// Flag: a step since the start was degenerate, so the summed pose may be off by any distance.
    pub const OPEN: u8 = 2;

    /// Returns the method; refused if this version does not know its number.
    pub fn method(&self) -> MotionMethod {
        MotionMethod::ALL.get(usize::from(self.method)).copied().unwrap_or(MotionMethod::Refused)
    }

    /// Returns whether the sample has a step. If not, the step's numbers are 0.
    pub fn has_step(&self) -> bool {
        !matches!(self.method(), MotionMethod::First | MotionMethod::Refused)
    }

    /// Returns whether the summed pose is known. If not, its numbers are 0.
    pub fn has_pose(&self) -> bool {
        self.method() != MotionMethod::Refused
    }

    /// Returns whether the summed pose is known, and no step that it contains was degenerate.
    pub fn has_valid_pose(&self) -> bool {
        self.has_pose() && self.flags & Motion::OPEN == 0
    }

    /// Returns the covariance of the summed pose; `None` if the pose is not valid, or if the sender's payload has no
    /// such covariance.
    pub fn sum_covariance(&self) -> Option<&[f32; 9]> {
        let is_first = self.method() == MotionMethod::First;
        let is_reported = is_first || self.pose_covariance != [0.0; 9];
        (self.has_valid_pose() && is_reported).then_some(&self.pose_covariance)
    }

    /// Returns whether the surroundings do not show how far the robot moved in some direction.
    pub fn is_degenerate(&self) -> bool {
        self.flags & Motion::DEGENERATE != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_motion_method_has_no_step_and_no_pose() {
        for (number, method) in MotionMethod::ALL.into_iter().enumerate() {
            let motion = Motion { method: number as u8, ..Motion::default() };
            assert_eq!((motion.method(), method as usize), (method, number));
        }
        let later = Motion { method: 6, x_m: 1.0, ..Motion::default() };
        assert!(!later.has_step() && !later.has_pose());
        assert!(Motion::default().has_pose() && !Motion::default().has_step());
    }
}
