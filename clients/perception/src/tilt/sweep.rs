//! What one way of the mount from turn to turn has shown.

use scanhub_schema::{Obstacle, PointClass};

/// Where a beam ended.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// In the robot's frame: metres ahead, to the left, above the floor.
    pub at: [f32; 3],
    /// When it was measured.
    pub stamp_ns: u64,
    /// Number of the beam in its scan.
    pub beam: u16,
    /// Beside the background as it was before this sweep.
    pub class: PointClass,
}

/// The points between two turns of the mount.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sweep<'a> {
    /// From 0.
    pub number: u32,
    /// When it began.
    pub from_ns: u64,
    /// When it ended.
    pub until_ns: u64,
    /// It went from one turn to the next, and nothing in between was withheld for want of an angle.
    pub is_complete: bool,
    /// So much of the background was not where it should be that the angles are not to be trusted: all points have class
    /// unknown, and there are no obstacles, whatever stands there.
    pub is_doubted: bool,
    /// Number of the background that the points were compared with: one more each time that it was forgotten.
    pub generation: u32,
    /// Delay of the angles' stamps by which its angles are corrected, in ns.
    pub late_ns: i64,
    /// In the order of their scans.
    pub points: &'a [Point],
    /// What stands there, the nearest first.
    pub obstacles: &'a [Obstacle],
    /// Obstacles that did not fit.
    pub left_out: u32,
}
