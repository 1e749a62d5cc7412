//! One scan, as the sensor sent it: ranges in device units with their codes, and the bits above the range. Refuses to
//! know the sensor's modes: each scan contains the few numbers that are needed to read a range.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

/// The most beams a scan has: 100 degrees in quarters.
pub const BEAMS: usize = 401;

/// Bit of [`Scan::contents`]: the upper bits are present.
pub const CONTENTS_UPPER: u8 = 1;

/// One turn of the mirror, in ns (75 Hz).
pub const TURN_NS: u64 = 13_320_000;

/// The payload of topic `scan`, 1216 bytes. The hub's decoder writes it in place.
///
/// # Examples
///
/// ```
/// use schema::Scan;
///
/// let mut scan = Scan { count: 2, unit_mm: 10, range_bits: 13, first_angle_mdeg: 0, step_mdeg: 500, ..Scan::default() };
/// scan.range_array[..2].copy_from_slice(&[123, 8191]);
/// assert_eq!((scan.distance_mm(0), scan.angle_deg(1)), (Some(1230), 0.5));
/// // The largest values are codes: there is no distance.
/// assert!(scan.distance_mm(1).is_none() && scan.code(1).is_some());
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Scan.v1"))]
#[repr(C)]
pub struct Scan {
    /// Beams used, at most [`BEAMS`].
    pub count: u16,
    /// Millimetres per device unit: 1, 10 or 100.
    pub unit_mm: u8,
    /// Bits of a range: 13, 14 or 15. The largest values are codes.
    pub range_bits: u8,
    /// Angle of beam 0 in 1/1000 degree: counter-clockwise seen from above, 0 right, 90 ahead.
    pub first_angle_mdeg: i32,
    /// Angle between two beams in 1/1000 degree.
    pub step_mdeg: u16,
    /// Bits of intensity in the upper bits, 0 to 3; 0: they are field bits.
    pub intensity_bits: u8,
    /// [`CONTENTS_UPPER`] or 0.
    pub contents: u8,
    /// Ranges in device units, codes included, upper bits masked off; 0 beyond `count`.
    pub range_array: [u16; BEAMS],
    /// The bits above the range as sent, shifted down; 0 beyond `count`.
    pub upper_array: [u8; BEAMS],
    /// 0.
    pub pad: [u8; 1],
}

impl Default for Scan {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl Scan {
    /// Returns the ranges that are used, in device units, codes included.
    #[inline]
    pub fn ranges(&self) -> &[u16] {
        &self.range_array[..self.beams()]
    }

    /// Returns the upper bits of the beams, as many as ranges, or none if the mode does not send them.
    #[inline]
    pub fn upper(&self) -> &[u8] {
        if self.contents & CONTENTS_UPPER == 0 { &[] } else { &self.upper_array[..self.beams()] }
    }

    /// Returns the intensities of the beams, or none if the mode has no reflector bits.
    #[inline]
    pub fn intensities(&self) -> &[u8] {
        if self.intensity_bits == 0 { &[] } else { self.upper() }
    }

    /// Returns the number of beams used: `count`, never more than [`BEAMS`].
    #[inline]
    pub fn beams(&self) -> usize {
        usize::from(self.count).min(BEAMS)
    }

    /// Returns the largest value that the range's bits hold; codes are counted down from it.
    #[inline]
    pub fn max(&self) -> u16 {
        ((1_u32 << u32::from(self.range_bits).min(16)) - 1) as u16
    }

    /// Returns the range of beam `i` in device units, if it is a valid reading.
    #[inline]
    pub fn range(&self, i: usize) -> Option<u16> {
        let value = *self.ranges().get(i)?;
        if self.classify(value).is_none() { Some(value) } else { None }
    }

    /// Returns why beam `i` has no valid reading; nothing if it has one or is not there.
    #[inline]
    pub fn code(&self, i: usize) -> Option<Code> {
        self.classify(*self.ranges().get(i)?)
    }

    /// Returns the range of beam `i` in mm, if it is a valid reading.
    #[inline]
    pub fn distance_mm(&self, i: usize) -> Option<u32> {
        Some(u32::from(self.range(i)?) * u32::from(self.unit_mm))
    }

    /// Returns the angle of beam `i` in 1/1000 degree.
    pub fn angle_mdeg(&self, i: usize) -> i32 {
        self.first_angle_mdeg.saturating_add(i as i32 * i32::from(self.step_mdeg))
    }

    /// Returns the angle of beam `i` in degrees.
    pub fn angle_deg(&self, i: usize) -> f64 {
        f64::from(self.angle_mdeg(i)) / 1000.0
    }

    /// Returns how long before the telegram's first byte beam `i` was measured, in ns. A degree is measured in as many turns
    /// as it has steps, beam i in turn i mod n; the sensor sends after the last beam of the last turn.
    pub fn beam_age_ns(&self, i: usize) -> u64 {
        let turns = (1000 / u64::from(self.step_mdeg.max(1))).max(1);
        let later_turns = turns - 1 - i as u64 % turns;
        let later_beams = self.beams().saturating_sub(1).saturating_sub(i) as u64;
        later_turns * TURN_NS + later_beams * u64::from(self.step_mdeg) * TURN_NS / 360_000
    }

    #[inline]
    fn classify(&self, value: u16) -> Option<Code> {
        match self.max().checked_sub(value) {
            Some(code) if code > Code::BEYOND.0 => None,
            Some(code) => Some(Code(code)),
            None => Some(Code::OVERFLOW),
        }
    }
}

/// Why a beam has no valid reading: the largest value of its range minus what was sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Code(pub u16);

impl Code {
    /// No echo.
    pub const NO_RETURN: Code = Code(0);
    /// The receiver was dazzled.
    pub const DAZZLE: Code = Code(1);
    /// The measurement overflowed; so read the reserved codes 3, 6 and 7, too.
    pub const OVERFLOW: Code = Code(2);
    /// Too much noise for the signal.
    pub const NOISE: Code = Code(4);
    /// The sensor could not read its own measurement.
    pub const READ_ERROR: Code = Code(5);
    /// An echo from beyond the range limit.
    pub const BEYOND: Code = Code(8);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scan(range_bits: u8, ranges: &[u16]) -> Scan {
        let mut scan =
            Scan { count: ranges.len() as u16, unit_mm: 10, range_bits, step_mdeg: 500, ..Scan::default() };
        scan.range_array[..ranges.len()].copy_from_slice(ranges);
        scan
    }

    #[test]
    fn the_nine_largest_values_are_codes() {
        for (bits, max) in [(13, 0x1FFF), (14, 0x3FFF), (15, 0x7FFF)] {
            let scan = scan(bits, &[max, max - 8, max - 9, 0]);
            assert_eq!(scan.code(0), Some(Code::NO_RETURN));
            assert_eq!(scan.code(1), Some(Code::BEYOND));
            assert_eq!((scan.code(2), scan.range(2)), (None, Some(max - 9)));
            assert_eq!(scan.distance_mm(2), Some(u32::from(max - 9) * 10));
            assert_eq!(scan.range(3), Some(0));
            assert_eq!((scan.range(4), scan.code(4)), (None, None));
        }
    }

    #[test]
    fn a_count_beyond_the_array_is_cut() {
        let scan = Scan { count: u16::MAX, ..Scan::default() };
        assert_eq!(scan.ranges().len(), BEAMS);
    }

    #[test]
    fn half_degrees_are_measured_one_turn_later() {
        let mut scan = scan(13, &[0; 361]);
        scan.unit_mm = 1;
        assert_eq!(scan.beam_age_ns(360), TURN_NS);
        assert_eq!(scan.beam_age_ns(359), TURN_NS * 500 / 360_000);
        assert_eq!(scan.beam_age_ns(0), TURN_NS + TURN_NS / 2);
        scan.step_mdeg = 1000;
        scan.count = 181;
        assert_eq!(scan.beam_age_ns(180), 0);
    }

    #[test]
    fn intensities_only_where_the_mode_has_them() {
        let mut scan = scan(13, &[1, 2]);
        scan.upper_array[1] = 7;
        assert!(scan.upper().is_empty());
        scan.contents = CONTENTS_UPPER;
        assert_eq!((scan.upper(), scan.intensities()), (&[0, 7][..], &[][..]));
        scan.intensity_bits = 3;
        assert_eq!(scan.intensities(), [0, 7]);
    }
}
