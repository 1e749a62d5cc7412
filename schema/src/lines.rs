//! The straight lines in one scan, and the corners where two of them meet. Refuses to know how they are found.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

/// The most lines of a scan, and the most corners.
pub const LINES: usize = 64;

/// The payload of topic `lines`, 3340 bytes: one sample per scan, in the robot's frame.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Lines.v2"))]
#[repr(C)]
pub struct Lines {
    /// Lines used, at most [`LINES`].
    pub count: u8,
    /// Corners used, at most [`LINES`].
    pub corners: u8,
    /// [`Lines::OVERFLOW`].
    pub flags: u8,
    /// 0.
    pub reserved: u8,
    /// Beams of the scan that have a range.
    pub readings: u16,
    /// Beams of them that end on a line.
    pub on_lines: u16,
    /// Standard deviation of the ranges in this scan, in metres, as its own beams tell it.
    pub noise_m: f32,
    /// The lines in the order of their beams; 0 beyond `count`.
    pub line_array: [Line; LINES],
    /// The corners in the order of their beams; 0 beyond `corners`.
    pub corner_array: [Corner; LINES],
}

/// One line: a straight surface that neighbouring beams end on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Line.v2"))]
#[repr(C)]
pub struct Line {
    /// Where its first beam meets it: metres ahead of the robot's centre.
    pub x1_m: f32,
    /// Metres to the left of the centre.
    pub y1_m: f32,
    /// Where its last beam meets it.
    pub x2_m: f32,
    /// The same, to the left.
    pub y2_m: f32,
    /// Distance of the whole line from the centre: x cos alpha + y sin alpha = r.
    pub r_m: f32,
    /// Direction from the centre to the line's nearest point, in radians from -pi to pi.
    pub alpha_rad: f32,
    /// Standard deviation of `r_m`.
    pub sd_r_m: f32,
    /// Standard deviation of `alpha_rad`.
    pub sd_alpha_rad: f32,
    /// Its first beam.
    pub first: u16,
    /// Its last beam.
    pub last: u16,
    /// Its beams that have a range.
    pub points: u16,
    /// 0.
    pub reserved: u16,
}

/// Where two neighbouring lines meet, in the robot's frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Corner.v2"))]
#[repr(C)]
pub struct Corner {
    /// Metres ahead of the robot's centre.
    pub x_m: f32,
    /// Metres to the left of it.
    pub y_m: f32,
    /// Number of the one line, from 0.
    pub first_line: u16,
    /// Number of the other.
    pub second_line: u16,
}

impl Default for Lines {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl Lines {
    /// Flag: there are more lines than are allowed; the others were joined or left out.
    pub const OVERFLOW: u8 = 1;

    /// Returns the lines that are used.
    pub fn lines(&self) -> &[Line] {
        &self.line_array[..usize::from(self.count).min(LINES)]
    }

    /// Returns the corners that are used.
    pub fn corners(&self) -> &[Corner] {
        &self.corner_array[..usize::from(self.corners).min(LINES)]
    }

    /// Returns whether there are more lines than are allowed.
    pub fn is_overflow(&self) -> bool {
        self.flags & Lines::OVERFLOW != 0
    }
}
