//! One revolution of a scanner: ranges in device units with their codes, and optional arrays. Each scan contains the
//! few numbers that are needed to decode it, so a reader does not depend on the scanner's protocol or mode.

use std::fmt;

use bytemuck::{Pod, Zeroable, cast_slice, cast_slice_mut};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::family::{Family, lms_code};
use crate::limits::TopicLimits;
use crate::payload::{packed_as_is, read_head, sliced};
use crate::topic::PayloadLen;

/// Maximum number of beams of a scan, in any family.
pub const MAX_BEAMS: usize = 8192;

/// Arrays that a scan has in addition to the ranges, each with a value for every beam. Bits of
/// [`ScanHead::contents`].
pub struct ArrayFlags;

impl ArrayFlags {
    /// Intensities of at most 8 bits, or field bits in some modes of an LMS.
    pub const UPPER: u8 = 1;
    /// Intensities of more than 8 bits.
    pub const WIDE: u8 = 2;
    /// Exact angles in radians, as 32-bit floats.
    pub const ANGLES: u8 = 4;
    /// Arrays of a revolution on a grid of beams.
    pub const REVOLUTION: u8 = ArrayFlags::UPPER | ArrayFlags::ANGLES;
    /// All arrays.
    pub const ALL: u8 = 7;
}

/// Head of a scan, before the arrays. 64 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ScanHead {
    /// Angle of beam 0 in radians; 0 is ahead of the sensor, counterclockwise is positive.
    pub first_angle: f64,
    /// Radians from one beam to the next; negative for a scanner that rotates clockwise.
    pub step: f64,
    /// Radians between two measured points; `step` may be different.
    pub spacing: f32,
    /// Time from one beam to the next in ns.
    pub beam_time_ns: u32,
    /// Time of beam 0, in ns after the sample's first stamp; mostly negative.
    pub first_beam_ns: i32,
    /// Micrometers per device unit.
    pub unit_um: u32,
    /// Number of beams, at most [`MAX_BEAMS`]. The beams are in the order of their measurement.
    pub count: u16,
    /// Highest value that is a range; all higher values are codes.
    pub valid_to: u16,
    /// Code of a beam without an echo.
    pub no_return: u16,
    /// Code of an echo from beyond the range limit; [`no_return`](Self::no_return) if the family has no such code.
    pub beyond: u16,
    /// Number of points that were dropped because another point has the same beam. Points without a return are
    /// included.
    pub collisions: u16,
    /// Family of the scanner: [`Family`].
    pub family: u8,
    /// Flags: [`Scan::INCOMPLETE`].
    pub flags: u8,
    /// Arrays that follow the head: [`ArrayFlags`].
    pub contents: u8,
    /// Bits of an intensity; 0 if the scan has no intensities.
    pub intensity_bits: u8,
    /// Number of revolutions in the scan: beam i is from revolution i modulo this number. 0 means 1.
    pub turns: u8,
    /// 0.
    pub reserved: u8,
    /// Time of a revolution in ns if the scan took several revolutions; otherwise 0.
    pub turn_ns: u32,
    /// 0.
    pub reserved2: [u8; 12],
}

sliced! {
    /// The payload of topic `scan`: a [`ScanHead`], whose fields can be read directly, followed by the arrays with a
    /// value for every beam: exact angles (4 bytes), ranges (2), wide intensities (2), upper bits (1).
    ///
    /// # Examples
    ///
    /// ```
    /// use scanhub_schema::{Code, Scan, ScanHead};
    ///
    /// let head = ScanHead { unit_um: 10_000, valid_to: 8182, no_return: 8191, step: 0.5_f64.to_radians(), ..ScanHead::default() };
    /// let scan = Scan::of(head, &[123, 8191]);
    /// assert_eq!((scan.distance_mm(0), scan.angle_deg(1)), (Some(1230), 0.5));
    /// assert_eq!((scan.distance_mm(1), scan.code(1)), (None, Some(Code::NoReturn)));
    /// ```
    Scan, ScanWord, "scanhub.Scan.v2", ScanHead
}

/// Arrays of a scan, for writing. An array that the scan does not have is empty.
#[derive(Debug)]
pub struct ScanArrays<'a> {
    /// Exact angles in radians.
    pub angles: &'a mut [f32],
    /// Ranges in device units, codes included.
    pub ranges: &'a mut [u16],
    /// Intensities of more than 8 bits.
    pub wide: &'a mut [u16],
    /// Intensities, or field bits.
    pub upper: &'a mut [u8],
}

/// The intensities of a scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Intensities<'a> {
    /// At most 8 bits each, or empty.
    Narrow(&'a [u8]),
    /// More than 8 bits each.
    Wide(&'a [u16]),
}

impl PayloadLen for Scan {
    fn max_payload_len(limits: &TopicLimits) -> usize {
        Scan::len(limits.beams, limits.contents)
    }
}

packed_as_is!(Scan);

impl Scan {
    /// Range of a beam that was not measured, in every family. It is neither a reading nor a missing echo.
    pub const NOT_MEASURED: u16 = u16::MAX;
    /// Flag: packets of the revolution are missing.
    pub const INCOMPLETE: u8 = 1;

    /// Returns the length in bytes of a scan of `beams` beams with the arrays of `contents`.
    pub const fn len(beams: usize, contents: u8) -> usize {
        Scan::HEAD + beams * total_bytes_per_beam(contents)
    }

    /// Returns a scan with `head` and a beam for each of `ranges`. All other arrays are 0.
    pub fn of(head: ScanHead, ranges: &[u16]) -> Box<Scan> {
        let mut scan = Scan::zeroed(Scan::len(ranges.len(), head.contents));
        let head = ScanHead { count: ranges.len() as u16, ..head };
        scan.begin(head).ranges.copy_from_slice(ranges);
        scan
    }

    /// Writes `head` and returns the arrays, which the caller must fill.
    ///
    /// # Panics
    ///
    /// Panics if the memory is too short for the head and the arrays.
    pub fn begin(&mut self, head: ScanHead) -> ScanArrays<'_> {
        **self = head;
        let (n, contents) = (usize::from(head.count), head.contents);
        let (_, rest) = self.memory_mut().split_at_mut(Scan::HEAD);
        let (angles, rest) = rest.split_at_mut(if contents & ArrayFlags::ANGLES != 0 { 4 * n } else { 0 });
        let (ranges, rest) = rest.split_at_mut(2 * n);
        let (wide, rest) = rest.split_at_mut(if contents & ArrayFlags::WIDE != 0 { 2 * n } else { 0 });
        let upper = &mut rest[..if contents & ArrayFlags::UPPER != 0 { n } else { 0 }];
        ScanArrays {
            angles: cast_slice_mut(angles),
            ranges: cast_slice_mut(ranges),
            wide: cast_slice_mut(wide),
            upper,
        }
    }

    /// Returns the ranges in device units, codes included.
    #[inline]
    pub fn ranges(&self) -> &[u16] {
        self.array(ArrayFlags::ANGLES, 2)
    }

    /// Returns the arrays for writing.
    ///
    /// # Panics
    ///
    /// Panics if the memory is too short for the head's number of beams.
    pub fn arrays(&mut self) -> ScanArrays<'_> {
        let head = **self;
        self.begin(head)
    }

    /// Returns the bits above the ranges, one value for each beam; empty if the sensor does not send them.
    #[inline]
    pub fn upper(&self) -> &[u8] {
        if self.has(ArrayFlags::UPPER) {
            self.array(ArrayFlags::ANGLES | RANGES | ArrayFlags::WIDE, 1)
        } else {
            &[]
        }
    }

    /// Returns the intensities, one for each beam; empty if the sensor does not send them.
    #[inline]
    pub fn intensities(&self) -> Intensities<'_> {
        if self.intensity_bits == 0 {
            Intensities::Narrow(&[])
        } else if self.has(ArrayFlags::WIDE) {
            Intensities::Wide(self.array(ArrayFlags::ANGLES | RANGES, 2))
        } else {
            Intensities::Narrow(self.upper())
        }
    }

    /// Returns the exact angles in radians, one for each beam, NaN if nothing was measured. Empty if the scan has no
    /// exact angles, because the angles of the grid are exact.
    #[inline]
    pub fn exact_angles(&self) -> &[f32] {
        if self.has(ArrayFlags::ANGLES) { self.array(0, 4) } else { &[] }
    }

    /// Returns the number of beams: `count`, or a lower number if the payload has memory for fewer beams only.
    #[inline]
    pub fn beams(&self) -> usize {
        let room = self.memory().len().saturating_sub(Scan::HEAD) / total_bytes_per_beam(self.contents);
        usize::from(self.count).min(room)
    }

    /// Returns the range of beam `i` in device units, if it is a valid reading.
    #[inline]
    pub fn range(&self, i: usize) -> Option<u16> {
        self.ranges().get(i).copied().filter(|&value| value <= self.valid_to)
    }

    /// Returns the reason why beam `i` has no valid reading. Returns `None` if the beam has a valid reading or does not
    /// exist.
    #[inline]
    pub fn code(&self, i: usize) -> Option<Code> {
        let value = *self.ranges().get(i)?;
        (value > self.valid_to).then(|| Code::of(self, value))
    }

    /// Returns the range of beam `i` in mm, rounded down, if it is a valid reading.
    #[inline]
    pub fn distance_mm(&self, i: usize) -> Option<u32> {
        Some((u64::from(self.range(i)?) * u64::from(self.unit_um) / 1000) as u32)
    }

    /// Returns the range of beam `i` in meters, if it is a valid reading.
    #[inline]
    pub fn distance_m(&self, i: usize) -> Option<f64> {
        Some(f64::from(self.range(i)?) * f64::from(self.unit_um) / 1e6)
    }

    /// Returns the angle of beam `i` in radians: the exact angle if there is one, otherwise the angle of the grid.
    #[inline]
    pub fn angle(&self, i: usize) -> f64 {
        match self.exact_angles().get(i) {
            Some(exact) if !exact.is_nan() => f64::from(*exact),
            _ => self.first_angle + i as f64 * self.step,
        }
    }

    /// Returns the angle of beam `i` in degrees, rounded to a millionth.
    pub fn angle_deg(&self, i: usize) -> f64 {
        in_degrees(self.angle(i))
    }

    /// Returns the time at which beam `i` was measured, in ns after the sample's stamp. The stamp of an LMS is the end
    /// of its last revolution.
    pub fn beam_ns(&self, i: usize) -> i64 {
        let revolution = i % usize::from(self.turns.max(1));
        let [i, turn] = [i, revolution].map(|number| number as i64);
        i64::from(self.first_beam_ns) + i * i64::from(self.beam_time_ns) + turn * i64::from(self.turn_ns)
    }

    /// Returns whether packets of the revolution are missing.
    pub fn is_incomplete(&self) -> bool {
        self.flags & Scan::INCOMPLETE != 0
    }

    #[inline]
    fn has(&self, contents: u8) -> bool {
        self.contents & contents != 0
    }

    /// Returns the array that follows the arrays `before`. Each of its values has `size` bytes.
    #[inline]
    fn array<T: Pod>(&self, before: u8, size: usize) -> &[T] {
        let n = self.beams();
        let begin = Scan::HEAD + n * bytes_per_beam(before & (self.contents | RANGES));
        self.memory().get(begin..begin + n * size).map_or(&[], cast_slice)
    }

    fn used(&self) -> usize {
        Scan::len(self.beams(), self.contents)
    }

    /// Returns the length in bytes of the scan in a datagram's payload, or `None` if the scan is not valid.
    fn packed_len(payload: &[u8]) -> Option<usize> {
        let head: ScanHead = read_head(payload)?;
        let len = Scan::len(head.count.into(), head.contents);
        let is_known = usize::from(head.count) <= MAX_BEAMS && head.contents & !ArrayFlags::ALL == 0;
        let is_finite = head.first_angle.is_finite() && head.step.is_finite() && head.spacing.is_finite();
        (is_known && is_finite && len <= payload.len()).then_some(len)
    }

    fn widen(limits: &mut TopicLimits, head: &ScanHead) {
        limits.beams = limits.beams.max(head.count.into());
        limits.contents |= head.contents;
    }
}

impl fmt::Debug for Scan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Scan").field("head", &**self).field("ranges", &self.ranges()).finish_non_exhaustive()
    }
}

impl Intensities<'_> {
    /// Returns the number of intensities: the number of beams, or 0.
    pub fn len(&self) -> usize {
        match self {
            Intensities::Narrow(values) => values.len(),
            Intensities::Wide(values) => values.len(),
        }
    }

    /// Returns whether there are no intensities.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the intensity of beam `i`, or `None` if the scan has no intensity for this beam.
    pub fn get(&self, i: usize) -> Option<u16> {
        match self {
            Intensities::Narrow(values) => values.get(i).map(|&value| value.into()),
            Intensities::Wide(values) => values.get(i).copied(),
        }
    }

    /// Returns all intensities in the order of the beams.
    pub fn iter(&self) -> impl Iterator<Item = u16> + '_ {
        (0..self.len()).filter_map(|i| self.get(i))
    }
}

/// Returns `radians` in degrees, rounded to a millionth. An angle that was converted from decimal degrees becomes the
/// same decimal again.
pub fn in_degrees(radians: f64) -> f64 {
    (radians.to_degrees() * 1e6).round() / 1e6 + 0.0
}

/// Returns `radians` in 1/1000 degree, from -180,000 to below 180,000. The configuration gives sectors in this unit and
/// range.
pub fn in_sector_mdeg(radians: f64) -> i32 {
    let mdeg = (1000.0 * in_degrees(radians)).round() as i64 % 360_000;
    ((mdeg + 180_000).rem_euclid(360_000) - 180_000) as i32
}

/// Bit for the array of ranges, in addition to the bits of [`ArrayFlags`]. [`ScanHead::contents`] does not have this
/// bit, because every scan has ranges.
const RANGES: u8 = 0x80;

/// Returns the number of bytes that a beam has in the arrays of `contents`.
const fn bytes_per_beam(contents: u8) -> usize {
    4 * bit(contents, ArrayFlags::ANGLES)
        + 2 * bit(contents, RANGES)
        + 2 * bit(contents, ArrayFlags::WIDE)
        + bit(contents, ArrayFlags::UPPER)
}

const fn bit(contents: u8, mask: u8) -> usize {
    if contents & mask != 0 { 1 } else { 0 }
}

/// Returns the number of bytes that a beam has in all arrays of a scan with `contents`.
const fn total_bytes_per_beam(contents: u8) -> usize {
    bytes_per_beam(contents & ArrayFlags::ALL | RANGES)
}

/// Reason why a beam has no valid reading. In the array of ranges, a code has a value above the highest range. An LMS
/// has its own values for the codes. All other families share the values of [`Code::value`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// Nothing was measured.
    NotMeasured,
    /// No echo.
    NoReturn,
    /// An echo from beyond the range limit.
    Beyond,
    /// The object is too near to be measured.
    TooNear,
    /// The receiver was dazzled.
    TooBright,
    /// The signal is too weak in comparison with the noise.
    Weak,
    /// The measurement overflowed.
    Overflow,
    /// The sensor reported an error for this beam.
    Error,
}

impl Code {
    /// Returns the code's name, which all commands print.
    pub fn name(self) -> &'static str {
        match self {
            Code::NotMeasured => "not_measured",
            Code::NoReturn => "no_return",
            Code::Beyond => "beyond",
            Code::TooNear => "too_near",
            Code::TooBright => "too_bright",
            Code::Weak => "weak",
            Code::Overflow => "overflow",
            Code::Error => "error",
        }
    }

    /// Returns the value of the code in scans of all families except the LMS.
    pub const fn value(self) -> u16 {
        match self {
            Code::NotMeasured => Scan::NOT_MEASURED,
            Code::NoReturn => 0xFFFE,
            Code::Beyond => 0xFFFD,
            Code::TooNear => 0xFFFC,
            Code::TooBright => 0xFFFB,
            Code::Weak => 0xFFFA,
            Code::Overflow => 0xFFF9,
            Code::Error => 0xFFF8,
        }
    }

    /// Returns the code of `value`, which is not a range, in a scan with `head`.
    pub(super) fn of(head: &ScanHead, value: u16) -> Code {
        if value == Scan::NOT_MEASURED {
            return Code::NotMeasured;
        }
        if head.family == Family::Lms as u8 {
            return lms_code(head, value);
        }
        let all = [Code::NoReturn, Code::Beyond, Code::TooNear, Code::TooBright, Code::Weak, Code::Overflow];
        all.into_iter().find(|code| code.value() == value).unwrap_or(Code::Error)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;

    /// Returns a scan of a clockwise revolution, with all arrays.
    fn revolution() -> Box<Scan> {
        let head = ScanHead {
            step: -TAU / 4.0,
            unit_um: 250,
            valid_to: 0xFFEF,
            no_return: Code::NoReturn.value(),
            beyond: Code::NoReturn.value(),
            family: Family::Ld as u8,
            contents: ArrayFlags::ALL,
            intensity_bits: 16,
            beam_time_ns: 100,
            ..ScanHead::default()
        };
        let mut scan = Scan::of(head, &[4001, Code::NoReturn.value(), Scan::NOT_MEASURED]);
        let arrays = scan.arrays();
        arrays.angles.copy_from_slice(&[0.25, f32::NAN, f32::NAN]);
        arrays.wide.copy_from_slice(&[700, 0, 0]);
        arrays.upper.copy_from_slice(&[7, 8, 9]);
        scan
    }

    #[test]
    fn scan_arrays_are_read_as_written() {
        let scan = revolution();
        assert_eq!((scan.bytes().len(), scan.beams()), (64 + 3 * 9, 3));
        assert_eq!((scan.range(0), scan.distance_mm(0)), (Some(4001), Some(1000)));
        assert_eq!((scan.code(1), scan.code(2)), (Some(Code::NoReturn), Some(Code::NotMeasured)));
        assert_eq!((scan.angle(0), scan.angle_deg(1), scan.angle_deg(2)), (0.25, -90.0, -180.0));
        assert_eq!((scan.intensities().get(0), scan.upper()), (Some(700), &[7, 8, 9][..]));
        assert_eq!((scan.beam_ns(2), scan.exact_angles().len()), (200, 3));
        assert_eq!(scan.boxed(), scan);
    }

    #[test]
    fn count_beyond_the_memory_is_cut() {
        let mut scan = revolution();
        scan.count = u16::MAX;
        // The memory consists of whole words, so it has 32 bytes after the head, enough for 3 beams of 9 bytes.
        assert_eq!((scan.ranges().len(), scan.upper().len(), scan.exact_angles().len()), (3, 3, 3));
        assert_eq!(Scan::of_words(&[]).beams(), 0, "a stranger's");
    }
}
