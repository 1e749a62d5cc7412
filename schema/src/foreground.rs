//! What is in front of the background, in one scan. Refuses to know how a background is learned.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::BEAMS;

/// The most segments of a scan.
pub const SEGMENTS: usize = 64;
/// Bytes of a set of beams.
const SET: usize = BEAMS.div_ceil(8);

/// The payload of topic `foreground`, 1892 bytes: one sample per scan, an empty one too.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Foreground.v1"))]
#[repr(C)]
pub struct Foreground {
    /// Generation of the background model that the scan was compared with.
    pub generation: u32,
    /// Beams of the scan, at most [`BEAMS`].
    pub count: u16,
    /// Beams in the foreground.
    pub beams: u16,
    /// Millimetres per device unit: 1, 10 or 100.
    pub unit_mm: u8,
    /// Segments that did not fit; 255: or more.
    pub left_out: u8,
    /// Segments used, at most [`SEGMENTS`].
    pub segments: u16,
    /// The beams in the foreground: beam i is bit i % 8 of byte i / 8.
    pub bit_array: [u8; SET],
    /// 0.
    pub pad: [u8; 1],
    /// Their ranges in device units, as many as beams, in their order; 0 beyond.
    pub range_array: [u16; BEAMS],
    /// 0.
    pub pad2: [u8; 2],
    /// The segments in the order of their beams; 0 beyond `segments`.
    pub segment_array: [Segment; SEGMENTS],
}

/// Neighbouring foreground beams that belong together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Segment.v1"))]
#[repr(C)]
pub struct Segment {
    /// Its first beam.
    pub first: u16,
    /// Its last beam.
    pub last: u16,
    /// Its smallest range in device units.
    pub nearest: u16,
    /// Distance of its first and last point in device units.
    pub width: u16,
    /// Mean of its points in the robot's frame: mm ahead of the centre.
    pub x_mm: i32,
    /// Mean of its points in the robot's frame: mm to the left of the centre.
    pub y_mm: i32,
}

impl Default for Foreground {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl Foreground {
    /// Returns whether beam `i` is in the foreground.
    pub fn contains(&self, i: usize) -> bool {
        i < BEAMS && self.bit_array[i / 8] >> (i % 8) & 1 == 1
    }

    /// Returns the beams in the foreground with their ranges in device units, in the order of the beams.
    pub fn readings(&self) -> impl Iterator<Item = (usize, u16)> + '_ {
        (0..BEAMS).filter(|&i| self.contains(i)).zip(self.ranges().iter().copied())
    }

    /// Returns the ranges of the foreground beams in device units.
    pub fn ranges(&self) -> &[u16] {
        &self.range_array[..usize::from(self.beams).min(BEAMS)]
    }

    /// Returns the segments that are used.
    pub fn segments(&self) -> &[Segment] {
        &self.segment_array[..usize::from(self.segments).min(SEGMENTS)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readings_pair_beams_with_packed_ranges() {
        let mut foreground = Foreground { beams: 2, ..Foreground::default() };
        foreground.bit_array[0] = 0x80;
        foreground.bit_array[50] = 1;
        foreground.range_array[..2].copy_from_slice(&[700, 800]);
        assert_eq!(foreground.readings().collect::<Vec<_>>(), [(7, 700), (400, 800)]);
        assert!(!foreground.contains(401));
    }
}
