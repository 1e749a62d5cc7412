//! One turn of a scanner: ranges in device units with their codes, and what comes with them. Refuses to know the sensor's
//! protocol and modes: each scan contains the few numbers that are needed to read it.

mod code;
mod family;
mod lms;

use std::fmt;

use bytemuck::{Pod, Zeroable, cast_slice, cast_slice_mut};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::sliced::sliced;
pub use code::Code;
pub use family::{Family, PacketFacts};

/// The most beams of a scan, of any family.
pub const BEAMS: usize = 8192;

/// Bits of [`ScanHead::contents`]: which arrays there are beside the ranges, each with a value for every beam.
pub struct Contents;

impl Contents {
    /// One byte: intensities, or of some modes of an LMS the field bits above the range.
    pub const UPPER: u8 = 1;
    /// Two bytes: intensities.
    pub const WIDE: u8 = 2;
    /// The exact angle in radians, a 32-bit float; nan where nothing was measured.
    pub const ANGLES: u8 = 4;
    /// Those of a turn on a grid of beams.
    pub const TURNING: u8 = Contents::UPPER | Contents::ANGLES;
    /// All that there are.
    pub const ALL: u8 = 7;
}

/// What stands before the arrays of a [`Scan`]. 64 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ScanHead {
    /// Angle of beam 0 in radians: 0 is the sensor's own ahead, counter-clockwise positive seen from above.
    pub first_angle: f64,
    /// Angle from one beam to the next in radians; negative for a scanner that turns clockwise.
    pub step: f64,
    /// Angle between two points that the sensor itself measures, in radians: not that of the grid that they are put on.
    pub spacing: f32,
    /// Time from one beam to the next in ns.
    pub beam_time_ns: u32,
    /// When beam 0 was measured, in ns after the sample's stamp; mostly before it.
    pub first_beam_ns: i32,
    /// Micrometres per device unit.
    pub unit_um: u32,
    /// Beams, in the order of their measuring, at most [`BEAMS`].
    pub count: u16,
    /// The greatest value that is a range; all above are codes.
    pub valid_to: u16,
    /// The code of a beam that nothing returned to.
    pub no_return: u16,
    /// The code of an echo from beyond the range limit; [`no_return`](Self::no_return) where the family has none.
    pub beyond: u16,
    /// Points that found their beam taken by a nearer one.
    pub collapsed: u16,
    /// See [`Family`].
    pub family: u8,
    /// [`Scan::INCOMPLETE`] or 0.
    pub flags: u8,
    /// Bits of [`Contents`].
    pub contents: u8,
    /// Bits of an intensity; 0: there are none.
    pub intensity_bits: u8,
    /// Turns in which the beams were measured, beam i in turn i modulo this; 0 is 1.
    pub turns: u8,
    /// 0.
    pub reserved: u8,
    /// Time of a turn in ns where there are several, else 0.
    pub turn_ns: u32,
    /// 0.
    pub reserved2: [u8; 12],
}

sliced! {
    /// The payload of topic `scan`: a [`ScanHead`], which its fields are read through, and behind it as many values as beams
    /// of each array that there is: exact angles (4 bytes), ranges (2), wide intensities (2), upper bits (1).
    ///
    /// # Examples
    ///
    /// ```
    /// use schema::{Code, Scan, ScanHead};
    ///
    /// let head = ScanHead { unit_um: 10_000, valid_to: 8182, no_return: 8191, step: 0.5_f64.to_radians(), ..ScanHead::default() };
    /// let scan = Scan::of(head, &[123, 8191]);
    /// assert_eq!((scan.distance_mm(0), scan.angle_deg(1)), (Some(1230), 0.5));
    /// assert_eq!((scan.distance_mm(1), scan.code(1)), (None, Some(Code::NoReturn)));
    /// ```
    Scan, ScanWord, "scanhub.Scan.v2", ScanHead
}

/// The arrays of a scan that is written; those that there are not are empty.
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
    /// Of at most 8 bits, or none.
    Narrow(&'a [u8]),
    /// Of more than 8 bits.
    Wide(&'a [u16]),
}

impl Scan {
    /// The range of a beam that was not measured, of every family: neither a reading nor a missing echo.
    pub const NOT_MEASURED: u16 = u16::MAX;
    /// Flag: packets of the turn are missing.
    pub const INCOMPLETE: u8 = 1;

    /// Returns the bytes of a scan of so many beams with these arrays.
    pub const fn len(beams: usize, contents: u8) -> usize {
        Scan::HEAD + beams * per_beam(contents)
    }

    /// Returns a scan with `head`, as many `ranges` as that shall have beams, and 0 in all other arrays.
    pub fn of(head: ScanHead, ranges: &[u16]) -> Box<Scan> {
        let mut scan = Scan::zeroed(Scan::len(ranges.len(), head.contents));
        let head = ScanHead { count: ranges.len() as u16, ..head };
        scan.begin(head).ranges.copy_from_slice(ranges);
        scan
    }

    /// Writes `head` and returns the arrays, which have to be filled.
    ///
    /// # Panics
    ///
    /// If the memory is too short for them.
    pub fn begin(&mut self, head: ScanHead) -> ScanArrays<'_> {
        **self = head;
        let (n, contents) = (usize::from(head.count), head.contents);
        let (_, rest) = self.memory_mut().split_at_mut(Scan::HEAD);
        let (angles, rest) = rest.split_at_mut(if contents & Contents::ANGLES != 0 { 4 * n } else { 0 });
        let (ranges, rest) = rest.split_at_mut(2 * n);
        let (wide, rest) = rest.split_at_mut(if contents & Contents::WIDE != 0 { 2 * n } else { 0 });
        let upper = &mut rest[..if contents & Contents::UPPER != 0 { n } else { 0 }];
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
        self.array(Contents::ANGLES, 2)
    }

    /// Returns the arrays, to be written.
    ///
    /// # Panics
    ///
    /// If the memory is too short for as many beams as the head says.
    pub fn arrays(&mut self) -> ScanArrays<'_> {
        let head = **self;
        self.begin(head)
    }

    /// Returns the bits above the ranges, as many as ranges; none if the sensor does not send them.
    #[inline]
    pub fn upper(&self) -> &[u8] {
        if self.has(Contents::UPPER) {
            self.array(Contents::ANGLES | RANGES | Contents::WIDE, 1)
        } else {
            &[]
        }
    }

    /// Returns the intensities of the beams, as many as ranges; none if the sensor does not send them.
    #[inline]
    pub fn intensities(&self) -> Intensities<'_> {
        if self.intensity_bits == 0 {
            Intensities::Narrow(&[])
        } else if self.has(Contents::WIDE) {
            Intensities::Wide(self.array(Contents::ANGLES | RANGES, 2))
        } else {
            Intensities::Narrow(self.upper())
        }
    }

    /// Returns the exact angles in radians, as many as ranges, nan where nothing was measured; none of a scanner whose beams
    /// are where [`angle`](Self::angle) says.
    #[inline]
    pub fn exact_angles(&self) -> &[f32] {
        if self.has(Contents::ANGLES) { self.array(0, 4) } else { &[] }
    }

    /// Returns the number of beams: `count`, as far as their values are there.
    #[inline]
    pub fn beams(&self) -> usize {
        let room = self.memory().len().saturating_sub(Scan::HEAD) / per_beam(self.contents);
        usize::from(self.count).min(room)
    }

    /// Returns the range of beam `i` in device units, if it is a valid reading.
    #[inline]
    pub fn range(&self, i: usize) -> Option<u16> {
        self.ranges().get(i).copied().filter(|&value| value <= self.valid_to)
    }

    /// Returns why beam `i` has no valid reading; nothing if it has one or is not there.
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

    /// Returns the range of beam `i` in metres, if it is a valid reading.
    #[inline]
    pub fn distance_m(&self, i: usize) -> Option<f64> {
        Some(f64::from(self.range(i)?) * f64::from(self.unit_um) / 1e6)
    }

    /// Returns the angle of beam `i` in radians: the exact one where there is one, else that of the grid.
    #[inline]
    pub fn angle(&self, i: usize) -> f64 {
        match self.exact_angles().get(i) {
            Some(exact) if !exact.is_nan() => f64::from(*exact),
            _ => self.first_angle + i as f64 * self.step,
        }
    }

    /// Returns the angle of beam `i` in degrees, without what radians lose of a whole number of millionths.
    pub fn angle_deg(&self, i: usize) -> f64 {
        in_degrees(self.angle(i))
    }

    /// Returns when beam `i` was measured, in ns after the sample's stamp, which an LMS sets at the end of its turn.
    pub fn beam_ns(&self, i: usize) -> i64 {
        let turn = i % usize::from(self.turns.max(1));
        let [i, turn] = [i, turn].map(|number| number as i64);
        i64::from(self.first_beam_ns) + i * i64::from(self.beam_time_ns) + turn * i64::from(self.turn_ns)
    }

    /// Returns whether packets of the turn are missing.
    pub fn is_incomplete(&self) -> bool {
        self.flags & Scan::INCOMPLETE != 0
    }

    #[inline]
    fn has(&self, contents: u8) -> bool {
        self.contents & contents != 0
    }

    /// The array behind those of `before`, with values of `size` bytes.
    #[inline]
    fn array<T: Pod>(&self, before: u8, size: usize) -> &[T] {
        let n = self.beams();
        let begin = Scan::HEAD + n * width(before & (self.contents | RANGES));
        self.memory().get(begin..begin + n * size).map_or(&[], cast_slice)
    }

    fn used(&self) -> usize {
        Scan::len(self.beams(), self.contents)
    }
}

impl fmt::Debug for Scan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Scan").field("head", &**self).field("ranges", &self.ranges()).finish_non_exhaustive()
    }
}

impl Intensities<'_> {
    /// Returns how many there are: as many as beams, or 0.
    pub fn len(&self) -> usize {
        match self {
            Intensities::Narrow(values) => values.len(),
            Intensities::Wide(values) => values.len(),
        }
    }

    /// Returns whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns that of beam `i`.
    pub fn get(&self, i: usize) -> Option<u16> {
        match self {
            Intensities::Narrow(values) => values.get(i).map(|&value| value.into()),
            Intensities::Wide(values) => values.get(i).copied(),
        }
    }

    /// Returns all of them in the order of the beams.
    pub fn iter(&self) -> impl Iterator<Item = u16> + '_ {
        (0..self.len()).filter_map(|i| self.get(i))
    }
}

/// Returns `radians` in degrees, to a millionth: what a decimal became in radians is that decimal again.
pub fn in_degrees(radians: f64) -> f64 {
    (radians.to_degrees() * 1e6).round() / 1e6 + 0.0
}

/// Returns `radians` in 1/1000 degree from -180,000 on, below 180,000, as sectors are given.
pub fn in_sector_mdeg(radians: f64) -> i32 {
    let mdeg = (1000.0 * in_degrees(radians)).round() as i64 % 360_000;
    ((mdeg + 180_000).rem_euclid(360_000) - 180_000) as i32
}

/// Stands for the ranges among [`Contents`]: they are always there.
const RANGES: u8 = 0x80;

/// Bytes of a beam in the arrays of `contents`.
const fn width(contents: u8) -> usize {
    4 * bit(contents, Contents::ANGLES)
        + 2 * bit(contents, RANGES)
        + 2 * bit(contents, Contents::WIDE)
        + bit(contents, Contents::UPPER)
}

const fn bit(contents: u8, mask: u8) -> usize {
    if contents & mask != 0 { 1 } else { 0 }
}

/// Bytes of a beam in all arrays of a scan with `contents`.
const fn per_beam(contents: u8) -> usize {
    width(contents & Contents::ALL | RANGES)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;

    /// A scan of a clockwise turn, with all arrays.
    fn turning() -> Box<Scan> {
        let head = ScanHead {
            step: -TAU / 4.0,
            unit_um: 250,
            valid_to: 0xFFEF,
            no_return: Code::NoReturn.value(),
            beyond: Code::NoReturn.value(),
            family: Family::Ld as u8,
            contents: Contents::ALL,
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
    fn each_array_is_where_it_was_written() {
        let scan = turning();
        assert_eq!((scan.bytes().len(), scan.beams()), (64 + 3 * 9, 3));
        assert_eq!((scan.range(0), scan.distance_mm(0)), (Some(4001), Some(1000)));
        assert_eq!((scan.code(1), scan.code(2)), (Some(Code::NoReturn), Some(Code::NotMeasured)));
        assert_eq!((scan.angle(0), scan.angle_deg(1), scan.angle_deg(2)), (0.25, -90.0, -180.0));
        assert_eq!((scan.intensities().get(0), scan.upper()), (Some(700), &[7, 8, 9][..]));
        assert_eq!((scan.beam_ns(2), scan.exact_angles().len()), (200, 3));
        assert_eq!(scan.boxed(), scan);
    }

    #[test]
    fn a_count_beyond_the_memory_is_cut() {
        let mut scan = turning();
        scan.count = u16::MAX;
        // 32 bytes behind the head, in whole words.
        assert_eq!((scan.ranges().len(), scan.upper().len(), scan.exact_angles().len()), (3, 3, 3));
        assert_eq!(Scan::of_words(&[]).beams(), 0, "a stranger's");
    }
}
