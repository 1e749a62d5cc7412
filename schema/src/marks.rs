//! Reflector marks in one scan. Refuses to know how they are found.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

/// The most marks of a scan.
pub const MARKS: usize = 64;

/// The payload of topic `marks`, 1028 bytes: one sample per scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Marks.v2"))]
#[repr(C)]
pub struct Marks {
    /// Marks used, at most [`MARKS`].
    pub count: u8,
    /// [`Marks::OVERFLOW`], [`Marks::UNAVAILABLE`] and [`Marks::NO_LEVEL`].
    pub flags: u8,
    /// 0.
    pub reserved: u16,
    /// The marks in the order of their beams; 0 beyond `count`.
    pub mark_array: [Mark; MARKS],
}

/// One mark: neighbouring beams that a reflector answered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Mark.v2"))]
#[repr(C)]
pub struct Mark {
    /// Sensor angle in 1/1000 degree, as in the scan: 0 ahead, counter-clockwise.
    pub angle_mdeg: i32,
    /// Range in 1/10 mm.
    pub range_dmm: u32,
    /// Sum of the intensities.
    pub weight: u16,
    /// The greatest intensity.
    pub peak: u8,
    /// 1: the mark touches the first or the last beam, so a part of it may be outside.
    pub edge: u8,
    /// Its first beam.
    pub first_beam: u16,
    /// Its last beam.
    pub last_beam: u16,
}

impl Default for Marks {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl Marks {
    /// Flag: there were more marks than fit.
    pub const OVERFLOW: u8 = 1;
    /// Flag: the sensor's measuring mode has no reflector bits, or [`Marks::NO_LEVEL`], so that nothing is known of marks.
    pub const UNAVAILABLE: u8 = 2;
    /// Flag, beside [`Marks::UNAVAILABLE`]: the sensor's intensities are counts of any surface, and nobody said from which on
    /// one is a reflector.
    pub const NO_LEVEL: u8 = 4;

    /// Returns the marks that are used.
    pub fn marks(&self) -> &[Mark] {
        &self.mark_array[..usize::from(self.count).min(MARKS)]
    }

    /// Returns whether the sensor sends what marks are found by: without it an empty list says nothing.
    pub fn is_available(&self) -> bool {
        self.flags & Marks::UNAVAILABLE == 0
    }

    /// Returns whether only the least count of a reflector is missing.
    pub fn lacks_level(&self) -> bool {
        self.flags & Marks::NO_LEVEL != 0
    }

    /// Returns whether there were more marks than fit.
    pub fn is_overflow(&self) -> bool {
        self.flags & Marks::OVERFLOW != 0
    }
}
