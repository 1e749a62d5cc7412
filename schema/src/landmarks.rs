//! Landmarks in one scan: reflector marks, straight lines, and the corners where two lines meet.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::payload::{FixedPayload, UsedElements, are_finite, used_elements};

/// Maximum number of marks of a scan.
pub const MAX_MARKS: usize = 64;

/// The payload of topic `marks`, 1028 bytes: one sample per scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Marks.v2"))]
#[repr(C)]
pub struct Marks {
    /// Number of marks, at most [`MAX_MARKS`].
    pub count: u8,
    /// Flags: [`Marks::OVERFLOW`], [`Marks::UNAVAILABLE`], [`Marks::NO_LEVEL`].
    pub flags: u8,
    /// 0.
    pub reserved: u16,
    /// The marks in the order of their beams; 0 beyond `count`.
    pub mark_array: [Mark; MAX_MARKS],
}

/// One mark: neighboring beams that a reflector returned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Mark.v2"))]
#[repr(C)]
pub struct Mark {
    /// Sensor angle in 1/1000 degree, from -180,000 to below 180,000: 0 is ahead, counterclockwise is positive.
    pub angle_mdeg: i32,
    /// Range in 1/10 mm.
    pub range_dmm: u32,
    /// Sum of the intensities.
    pub weight: u16,
    /// Highest intensity.
    pub peak: u8,
    /// 1 if the mark touches the first or the last beam, so a part of it may be out of view.
    pub edge: u8,
    /// First beam of the mark.
    pub first_beam: u16,
    /// Last beam of the mark.
    pub last_beam: u16,
}

impl Default for Marks {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl FixedPayload for Marks {
    const ARRAYS: &'static [UsedElements] = &[used_elements!(Marks, mark_array: [Mark; MAX_MARKS], count)];
}

impl Marks {
    /// Flag: there were more marks than fit into the sample.
    pub const OVERFLOW: u8 = 1;
    /// Flag: marks are unknown, because the measuring mode has no reflector bits or [`Marks::NO_LEVEL`] is set.
    pub const UNAVAILABLE: u8 = 2;
    /// Flag, set together with [`Marks::UNAVAILABLE`]: the sensor measures intensities, and no threshold for reflectors
    /// is configured.
    pub const NO_LEVEL: u8 = 4;

    /// Returns the used marks.
    pub fn marks(&self) -> &[Mark] {
        &self.mark_array[..usize::from(self.count).min(MAX_MARKS)]
    }

    /// Returns whether the sensor sends the data that marks are computed from. If not, an empty list does not mean that
    /// there are no reflectors.
    pub fn is_available(&self) -> bool {
        self.flags & Marks::UNAVAILABLE == 0
    }

    /// Returns whether marks are unavailable because no threshold for reflectors is configured.
    pub fn lacks_level(&self) -> bool {
        self.flags & Marks::NO_LEVEL != 0
    }

    /// Returns whether there were more marks than fit into the sample.
    pub fn is_overflow(&self) -> bool {
        self.flags & Marks::OVERFLOW != 0
    }
}

/// Maximum number of lines of a scan, and of corners.
pub const MAX_LINES: usize = 64;

/// The payload of topic `lines`, 3340 bytes: one sample per scan, in the robot's frame.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Lines.v2"))]
#[repr(C)]
pub struct Lines {
    /// Number of lines, at most [`MAX_LINES`].
    pub count: u8,
    /// Number of corners, at most [`MAX_LINES`].
    pub corners: u8,
    /// Flags: [`Lines::OVERFLOW`].
    pub flags: u8,
    /// 0.
    pub reserved: u8,
    /// Number of beams of the scan that have a range.
    pub readings: u16,
    /// Number of beams with a range that end on a line.
    pub on_lines: u16,
    /// Standard deviation of the ranges in meters, estimated from this scan.
    pub noise_m: f32,
    /// The lines in the order of their beams; 0 beyond `count`.
    pub line_array: [Line; MAX_LINES],
    /// The corners in the order of their beams; 0 beyond `corners`.
    pub corner_array: [Corner; MAX_LINES],
}

/// A line feature: a straight surface that neighboring beams end on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Line.v2"))]
#[repr(C)]
pub struct Line {
    /// Point on the first beam: meters ahead of the robot's center.
    pub x1_m: f32,
    /// Point on the first beam: meters to the left of the center.
    pub y1_m: f32,
    /// Point on the last beam: meters ahead of the robot's center.
    pub x2_m: f32,
    /// Point on the last beam: meters to the left of the center.
    pub y2_m: f32,
    /// Distance of the infinite line from the center in meters: x cos alpha + y sin alpha = r.
    pub r_m: f32,
    /// Direction from the center to the line's nearest point, in radians from -pi to pi.
    pub alpha_rad: f32,
    /// Standard deviation of `r_m` in meters.
    pub sd_r_m: f32,
    /// Standard deviation of `alpha_rad` in radians.
    pub sd_alpha_rad: f32,
    /// First beam of the line.
    pub first: u16,
    /// Last beam of the line.
    pub last: u16,
    /// Number of beams on the line that have a range.
    pub points: u16,
    /// 0.
    pub reserved: u16,
}

/// Point at which two neighboring lines meet, in the robot's frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Corner.v2"))]
#[repr(C)]
pub struct Corner {
    /// Meters ahead of the robot's center.
    pub x_m: f32,
    /// Meters to the left of the center.
    pub y_m: f32,
    /// Index of the first line.
    pub first_line: u16,
    /// Index of the second line.
    pub second_line: u16,
}

impl Default for Lines {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl FixedPayload for Lines {
    const ARRAYS: &'static [UsedElements] = &[
        used_elements!(Lines, line_array: [Line; MAX_LINES], count),
        used_elements!(Lines, corner_array: [Corner; MAX_LINES], corners),
    ];

    fn is_valid(&self) -> bool {
        let is_finite = |line: &Line| {
            let &Line { x1_m, y1_m, x2_m, y2_m, r_m, alpha_rad, sd_r_m, sd_alpha_rad, .. } = line;
            are_finite(&[x1_m, y1_m, x2_m, y2_m, r_m, alpha_rad, sd_r_m, sd_alpha_rad])
        };
        let is_corner = |corner: &Corner| {
            let has_lines = corner.first_line.max(corner.second_line) < self.count.into();
            has_lines && are_finite(&[corner.x_m, corner.y_m])
        };
        self.noise_m.is_finite() && self.lines().iter().all(is_finite) && self.corners().iter().all(is_corner)
    }
}

impl Lines {
    /// Flag: there were more lines than `lines.max`, so some were joined or dropped.
    pub const OVERFLOW: u8 = 1;

    /// Returns the used lines.
    pub fn lines(&self) -> &[Line] {
        &self.line_array[..usize::from(self.count).min(MAX_LINES)]
    }

    /// Returns the used corners.
    pub fn corners(&self) -> &[Corner] {
        &self.corner_array[..usize::from(self.corners).min(MAX_LINES)]
    }

    /// Returns whether there were more lines than fit into the sample.
    pub fn is_overflow(&self) -> bool {
        self.flags & Lines::OVERFLOW != 0
    }
}
