//! What stands before the background in one scan: its beams with their ranges, and the segments that they form. Refuses
//! to know how they are found.

use std::fmt;

use bytemuck::{Pod, Zeroable, cast_slice, cast_slice_mut};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::sliced::sliced;

/// The most segments of a scan.
pub const SEGMENTS: usize = 64;

/// What stands before the arrays of a [`Foreground`]. 24 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct ForegroundHead {
    /// Generation of the background model that the scan was compared with.
    pub generation: u32,
    /// Micrometres per device unit.
    pub unit_um: u32,
    /// Beams of the scan.
    pub count: u16,
    /// Beams in the foreground.
    pub beams: u16,
    /// Segments used, at most [`SEGMENTS`].
    pub segments: u16,
    /// Segments that did not fit.
    pub left_out: u16,
    /// Bit i is 1 if segment i is supported: it has several beams, or the foreground of the scan before was near it.
    pub supported: u64,
}

sliced! {
    /// The payload of topic `foreground`, one sample per scan, an empty one too: a [`ForegroundHead`], which its fields are
    /// read through, and behind it [`SEGMENTS`] segments of 16 bytes, a bit for every beam of the scan in pairs of bytes, and
    /// a range of two bytes for every beam of the scan. Of segments and ranges those that are used come first, the others are
    /// 0.
    Foreground, ForegroundWord, "scanhub.Foreground.v2", ForegroundHead
}

/// Neighbouring foreground beams that belong together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Segment.v2"))]
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

/// The arrays of a foreground that is written.
#[derive(Debug)]
pub struct ForegroundArrays<'a> {
    /// All places for segments.
    pub segments: &'a mut [Segment],
    /// The beams in the foreground: beam i is bit i % 8 of byte i / 8.
    pub bits: &'a mut [u8],
    /// Their ranges in device units, in the order of the beams: places for all beams of the scan.
    pub ranges: &'a mut [u16],
}

impl Foreground {
    /// Returns the bytes of the foreground of a scan of so many beams.
    pub const fn len(beams: usize) -> usize {
        BITS + set(beams) + 2 * beams
    }

    /// Returns an empty foreground of a scan of `beams` beams.
    pub fn of(beams: usize) -> Box<Foreground> {
        let mut foreground = Foreground::zeroed(Foreground::len(beams));
        foreground.count = beams as u16;
        foreground
    }

    /// Writes `head` and returns the arrays, which have to be filled.
    ///
    /// # Panics
    ///
    /// If the memory is too short for them.
    pub fn begin(&mut self, head: ForegroundHead) -> ForegroundArrays<'_> {
        **self = head;
        let n = usize::from(head.count);
        let (segments, rest) = self.memory_mut()[Foreground::HEAD..].split_at_mut(BITS - Foreground::HEAD);
        let (bits, rest) = rest.split_at_mut(set(n));
        ForegroundArrays {
            segments: cast_slice_mut(segments),
            bits: &mut bits[..n.div_ceil(8)],
            ranges: cast_slice_mut(&mut rest[..2 * n]),
        }
    }

    /// Returns whether beam `i` is in the foreground.
    pub fn contains(&self, i: usize) -> bool {
        self.bits().get(i / 8).is_some_and(|byte| byte >> (i % 8) & 1 == 1)
    }

    /// Returns the beams in the foreground with their ranges in device units, in the order of the beams.
    pub fn readings(&self) -> impl Iterator<Item = (usize, u16)> + '_ {
        let bytes = self.bits().iter().enumerate().filter(|(_, byte)| **byte != 0);
        let of_byte = |(at, &byte): (usize, &u8)| {
            (0..8).filter(move |bit| byte >> bit & 1 == 1).map(move |bit| 8 * at + bit)
        };
        bytes.flat_map(of_byte).take_while(|&i| i < self.scan_beams()).zip(self.ranges().iter().copied())
    }

    /// Returns the ranges of the foreground beams in device units.
    pub fn ranges(&self) -> &[u16] {
        let (n, begin) = (usize::from(self.beams).min(self.scan_beams()), BITS + set(self.scan_beams()));
        self.memory().get(begin..begin + 2 * n).map_or(&[], cast_slice)
    }

    /// Returns the segments that are used.
    pub fn segments(&self) -> &[Segment] {
        let all: &[Segment] = self.memory().get(Foreground::HEAD..BITS).map_or(&[], cast_slice);
        &all[..usize::from(self.segments).min(all.len())]
    }

    /// Returns whether segment `i` is supported: a single beam that nothing in the scan before was near to is not, and may
    /// be an edge that flickers.
    pub fn has_support(&self, i: usize) -> bool {
        i < self.segments().len() && self.supported >> i & 1 == 1
    }

    /// Returns a bit for every beam of the scan, as [`ForegroundArrays::bits`].
    pub(crate) fn bits(&self) -> &[u8] {
        self.memory().get(BITS..BITS + self.scan_beams().div_ceil(8)).unwrap_or_default()
    }

    /// Writes 0 to the first `len` bytes; `false` if there is too little memory.
    pub(crate) fn clear(&mut self, len: usize) -> bool {
        self.memory_mut().get_mut(..len).map(|memory| memory.fill(0)).is_some()
    }

    /// Beams of the scan, as far as there is memory for them.
    fn scan_beams(&self) -> usize {
        let n = usize::from(self.count);
        if Foreground::len(n) <= self.memory().len() { n } else { 0 }
    }

    fn used(&self) -> usize {
        Foreground::len(self.scan_beams())
    }
}

impl fmt::Debug for Foreground {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let readings: Vec<_> = self.readings().collect();
        f.debug_struct("Foreground")
            .field("head", &**self)
            .field("readings", &readings)
            .field("segments", &self.segments())
            .finish()
    }
}

/// Where the bits begin.
const BITS: usize = Foreground::HEAD + SEGMENTS * size_of::<Segment>();

/// Bytes of a bit for every beam; the ranges behind them take two each.
const fn set(beams: usize) -> usize {
    2 * beams.div_ceil(16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readings_pair_beams_with_ranges_and_segments_with_support() {
        let mut foreground = Foreground::of(401);
        let arrays = foreground.begin(ForegroundHead { count: 401, beams: 2, ..ForegroundHead::default() });
        (arrays.bits[0], arrays.bits[50]) = (0x80, 1);
        arrays.ranges[..2].copy_from_slice(&[700, 800]);
        assert_eq!(foreground.readings().collect::<Vec<_>>(), [(7, 700), (400, 800)]);
        assert!(!foreground.contains(401) && !foreground.contains(10_000));
        foreground.supported = 0b101;
        foreground.segments = 2;
        assert_eq!([0, 1, 2, 64].map(|i| foreground.has_support(i)), [true, false, false, false]);
        foreground.count = 2000;
        assert_eq!(foreground.readings().count(), 0, "there is no memory for so many");
    }
}
