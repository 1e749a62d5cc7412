//! Scan in the buffer of a session, complete or still arriving, and the grid of beams to which a session assigns the
//! points of a revolution. [`RawScan::write`] converts the received values to ranges, directly in the shared memory
//! that subscribers read.

use core::f32::consts::TAU;

use scanhub_schema::{Code, Family, Nanos, Scan, ScanArrays, ScanHead};

use crate::line::ClosedRevolution;

/// Scan as the session received it.
#[derive(Clone, Copy, Debug)]
pub struct RawScan<'a> {
    /// Serial number among all scans of the session, including scans that the session does not return.
    pub number: u64,
    /// Time at which beam 0 was measured, even if beam 0 has no point. For a scan with fixed angles, the time at which
    /// the first byte arrived.
    pub first: Nanos,
    /// Time at which the last point was measured. For a scan with fixed angles, the time at which the last byte
    /// arrived.
    pub last: Nanos,
    /// Time from one scan to the next in nanoseconds; 0 if it is unknown.
    pub period: Nanos,
    /// Reasons why the scan is suspect: bits of [`crate::line::suspect`]; 0 means clean.
    pub reasons: u8,
    /// Number of bytes of an incomplete telegram that have arrived; 0 for packets.
    pub bytes: usize,
    /// Angles, unit and arrays of the scan.
    pub head: ScanHead,
    /// The received values.
    pub values: Values<'a>,
}

/// Values of a scan, in the format of the scanner.
#[derive(Clone, Copy, Debug)]
pub enum Values<'a> {
    /// Little-endian words of a scan whose beams have fixed angles. The words belong to the first beams.
    Words {
        /// The words, two bytes for each beam.
        bytes: &'a [u8],
        /// Number of low bits of a word that contain the range. The other bits become the `upper` array of the scan.
        range_bits: u8,
    },
    /// Points of a revolution in the order of arrival, for a grid of beams.
    Points {
        /// The points.
        points: &'a [Point],
        /// Number of points that the scanner measures per second; 0 if it is unknown.
        per_second: f32,
    },
}

impl<'a> RawScan<'a> {
    /// Creates the scan of `revolution`, whose points are `points`, on a grid of `beams` beams. `first` and `last` are
    /// the stamps of beam 0 and of the last point. `per_second` is the number of points per second. It is 0 if the
    /// number is unknown.
    pub fn revolution(
        family: Family,
        revolution: &ClosedRevolution,
        (first, last): (Nanos, Nanos),
        (beams, per_second): (usize, f32),
        points: &'a [Point],
    ) -> RawScan<'a> {
        let &ClosedRevolution { number, period, reasons, incomplete, .. } = revolution;
        let head = revolution_head(family, beams, period, per_second, incomplete);
        let values = Values::Points { points, per_second };
        RawScan { number, first, last, period, reasons, bytes: 0, head, values }
    }

    /// Returns the number of beams.
    pub fn beams(&self) -> usize {
        self.head.count.into()
    }

    /// Returns the points of a revolution. Returns an empty slice for a scan with fixed angles.
    pub fn points(&self) -> &'a [Point] {
        if let Values::Points { points, .. } = self.values { points } else { &[] }
    }

    /// Returns whether points of the revolution are missing.
    pub fn is_incomplete(&self) -> bool {
        self.head.flags & Scan::INCOMPLETE != 0
    }

    /// Returns the length of the scan as a payload, in bytes.
    pub fn payload_len(&self) -> usize {
        Scan::len(self.beams(), self.head.contents)
    }

    /// Writes all bytes of `scan` up to [`payload_len`](Self::payload_len). Beams whose values have not arrived become
    /// [`NOT_MEASURED`].
    ///
    /// # Panics
    ///
    /// Panics if `scan` is shorter than [`payload_len`](Self::payload_len) bytes.
    pub fn write(&self, scan: &mut Scan) {
        let ScanArrays { angles, ranges, upper, .. } = scan.begin(self.head);
        match self.values {
            Values::Words { bytes, range_bits } => {
                let (words, _) = bytes.as_chunks::<2>();
                let mask = (1 << range_bits) - 1;
                let arrived = words.len().min(ranges.len());
                for ((range, upper), word) in ranges.iter_mut().zip(&mut *upper).zip(words) {
                    let word = u16::from_le_bytes(*word);
                    (*range, *upper) = (word & mask, (word >> range_bits) as u8);
                }
                ranges[arrived..].fill(Scan::NOT_MEASURED);
                upper[arrived..].fill(0);
            }
            Values::Points { points, .. } => {
                let collisions = Grid::new(self.beams()).fill(points, ranges, upper, angles);
                scan.collisions = u16::try_from(collisions).unwrap_or(u16::MAX);
            }
        }
    }
}

/// Returns the head of a revolution's scan on a grid of `beams` beams. The revolution takes `period` nanoseconds.
/// `points_per_second` is 0 if it is unknown.
pub fn revolution_head(
    family: Family,
    beams: usize,
    period: Nanos,
    points_per_second: f32,
    is_incomplete: bool,
) -> ScanHead {
    let head = ScanHead::of_revolution(family, beams);
    // Number of points that the scanner measures in a revolution.
    let measured_points = f64::from(points_per_second) * period as f64 / 1e9;
    let spacing = if measured_points >= 1.0 { core::f64::consts::TAU / measured_points } else { -head.step };
    ScanHead {
        spacing: spacing as f32,
        beam_time_ns: u32::try_from(period / beams.max(1) as u64).unwrap_or(u32::MAX),
        flags: if is_incomplete { Scan::INCOMPLETE } else { 0 },
        ..head
    }
}

/// One measurement of a rotating scanner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Angle in radians. 0 is straight ahead, and counterclockwise as seen from above is positive. For a head that
    /// rotates clockwise, angles go from 0 to -2 pi.
    pub angle: f32,
    /// Range in millimeters, or [`NO_RETURN`].
    pub range: u16,
    /// Strength of the echo, in units of the scanner.
    pub intensity: u8,
}

/// Range of a beam without an echo. It is greater than every measured range.
pub const NO_RETURN: u16 = Code::NoReturn.value();
/// Range of a beam without a point in this revolution.
pub const NOT_MEASURED: u16 = Scan::NOT_MEASURED;
/// Number of beams that a grid may have.
pub const BEAM_RANGE: core::ops::RangeInclusive<usize> = 2..=scanhub_schema::MAX_BEAMS;

/// Grid of equal bins over 360 degrees, for a head that rotates clockwise. Beam 0 points ahead. The angle of beam `i`
/// is `i` times the [`step`](Grid::step), which is negative, so beams are in the order of measurement. The bin of beam
/// 0 begins half a step before the scanner's zero, so 0 and 360 degrees belong to the same beam.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    beams: usize,
}

impl Grid {
    /// Creates a grid of `beams` beams, limited to [`BEAM_RANGE`].
    pub const fn new(beams: usize) -> Grid {
        let (min, max) = (*BEAM_RANGE.start(), *BEAM_RANGE.end());
        let beams = if beams < min { min } else { beams };
        Grid { beams: if beams > max { max } else { beams } }
    }

    /// Returns the number of beams.
    pub const fn beams(&self) -> usize {
        self.beams
    }

    /// Returns the angle from one beam to the next, in radians. It is negative.
    pub fn step(&self) -> f64 {
        -core::f64::consts::TAU / self.beams as f64
    }

    /// Assigns `points`, in any order, to beams by their angles. Returns the number of points whose bin already had a
    /// point. Each slice has at least one element per beam, and the method writes all these elements. A bin keeps the
    /// nearest of its points, with the exact angle of this point. A point without an echo counts as the farthest. The
    /// angle of a bin without a point is NaN.
    pub fn fill(
        &self,
        points: &[Point],
        ranges: &mut [u16],
        intensities: &mut [u8],
        angles: &mut [f32],
    ) -> u32 {
        let beams = self.beams;
        let (ranges, intensities, angles) =
            (&mut ranges[..beams], &mut intensities[..beams], &mut angles[..beams]);
        ranges.fill(NOT_MEASURED);
        intensities.fill(0);
        angles.fill(f32::NAN);
        let bins_per_radian = -(beams as f32) / TAU;
        let mut collisions = 0;
        for point in points {
            // Add one revolution, so that angles of up to one revolution on either side are accepted. Add 0.5, so that
            // the conversion below rounds to the nearest beam.
            let bin_position = point.angle * bins_per_radian + (beams as f32 + 0.5);
            // NaN has no beam. The value is converted to 32 bits because a conversion to 64 bits takes three times as
            // long.
            let measured = if bin_position >= 0.0 { bin_position as u32 as usize } else { usize::MAX };
            let mut bin = measured;
            let mut angle = point.angle - TAU;
            for _ in 0..2 {
                if bin >= beams {
                    (bin, angle) = (bin - beams, angle + TAU);
                }
            }
            let Some(range) = ranges.get_mut(bin) else { continue };
            let is_taken = *range != NOT_MEASURED;
            collisions += u32::from(is_taken);
            // Any other point replaces a point without an echo, because NO_RETURN exceeds every range.
            if point.range < *range {
                *range = point.range;
                intensities[bin] = point.intensity;
                // Keep the angle in the same revolution as the angle of its beam.
                angles[bin] = if (beams..2 * beams).contains(&measured) { point.angle } else { angle };
            }
        }
        collisions
    }
}

#[cfg(test)]
mod tests {
    use scanhub_schema::ArrayFlags;

    use super::*;

    #[test]
    fn writes_revolution() {
        let point = |degrees: f32, range| Point { angle: -degrees.to_radians(), range, intensity: 9 };
        let points =
            [point(0.2, 1000), point(91.0, 700), point(92.0, 500), point(181.0, Code::NoReturn.value())];
        let raw = RawScan {
            number: 0,
            first: 0,
            last: 0,
            period: 100_000_000,
            reasons: 0,
            bytes: 0,
            head: revolution_head(Family::Ld, 8, 100_000_000, 40.0, true),
            values: Values::Points { points: &points, per_second: 40.0 },
        };
        let mut scan = Scan::zeroed(raw.payload_len());
        raw.write(&mut scan);
        assert_eq!(raw.payload_len(), Scan::len(8, ArrayFlags::REVOLUTION));
        assert_eq!((scan.beams(), scan.collisions, scan.is_incomplete()), (8, 1, true));
        assert_eq!(
            (scan.distance_mm(0), scan.distance_mm(2), scan.intensities().get(2)),
            (Some(1000), Some(500), Some(9))
        );
        assert!((scan.angle(2).to_degrees() + 92.0).abs() < 1e-4);
        assert_eq!((scan.code(4), scan.code(1)), (Some(Code::NoReturn), Some(Code::NotMeasured)));
        assert_eq!((scan.beam_ns(4), scan.angle_deg(6)), (50_000_000, -270.0));
        assert!((scan.spacing.to_degrees() - 90.0).abs() < 1e-3, "four points a turn");
    }

    #[test]
    fn writes_received_words_of_a_partial_scan() {
        let raw = |bytes| RawScan {
            number: 0,
            first: 0,
            last: 0,
            period: 0,
            reasons: 0,
            bytes: 0,
            head: ScanHead::lms(3, -90_000, 500, 1, 13),
            values: Values::Words { bytes, range_bits: 13 },
        };
        let mut scan = Scan::zeroed(raw(&[]).payload_len());
        let bytes = [0x0A, 0x20, 0x0B, 0x40, 0x0C, 0x60];
        raw(&bytes).write(&mut scan);
        assert_eq!((scan.ranges(), scan.upper()), (&[10, 11, 12][..], &[1, 2, 3][..]));
        raw(&bytes[..3]).write(&mut scan);
        let rest = Scan::NOT_MEASURED;
        assert_eq!((scan.ranges(), scan.upper()), (&[10, rest, rest][..], &[1, 0, 0][..]));
    }

    const NONE: Point = Point { angle: 0.0, range: NO_RETURN, intensity: 0 };

    fn at(degrees: f32, range: u16) -> Point {
        Point { angle: -degrees.to_radians(), range, intensity: (range % 251) as u8 }
    }

    /// Assigns `points` to 8 beams. Returns the ranges, the exact angles in degrees clockwise, and the number of points
    /// whose bin already had a point.
    fn eight(points: &[Point]) -> ([u16; 8], [f32; 8], u32) {
        let (mut ranges, mut intensities, mut angles) = ([7; 8], [7; 8], [7.0; 8]);
        let collisions = Grid::new(8).fill(points, &mut ranges, &mut intensities, &mut angles);
        for (range, intensity) in ranges.iter().zip(intensities) {
            let expected = if *range == NOT_MEASURED { 0 } else { (*range % 251) as u8 };
            assert_eq!(intensity, expected);
        }
        (ranges, angles.map(|angle| -angle.to_degrees()), collisions)
    }

    #[test]
    fn nearest_range_wins_and_keeps_its_angle() {
        let turn = [at(44.0, 900), at(47.0, 300), at(50.0, NO_RETURN), at(89.0, NO_RETURN), at(91.0, 1200)];
        let (ranges, angles, collisions) = eight(&turn);
        assert_eq!(ranges[..3], [NOT_MEASURED, 300, 1200]);
        assert!((angles[1] - 47.0).abs() < 1e-3 && (angles[2] - 91.0).abs() < 1e-3 && angles[0].is_nan());
        let empty = ranges.iter().filter(|range| **range == NOT_MEASURED).count();
        assert_eq!((collisions, empty), (3, 6));
    }

    #[test]
    fn no_return_is_distinct_from_not_measured() {
        let (ranges, angles, collisions) = eight(&[at(90.0, NO_RETURN), at(92.0, NO_RETURN)]);
        assert_eq!((ranges[2], ranges[3]), (NO_RETURN, NOT_MEASURED));
        assert!((angles[2] - 90.0).abs() < 1e-3);
        let empty = ranges.iter().filter(|range| **range == NOT_MEASURED).count();
        assert_eq!((collisions, empty), (1, 7));
    }

    #[test]
    fn angles_0_and_360_belong_to_the_same_beam() {
        for degrees in [-22.0, 0.0, 22.0, 338.0, 360.0, 382.0] {
            let (ranges, ..) = eight(&[at(degrees, 500)]);
            assert_eq!(ranges[0], 500, "{degrees}");
        }
        assert_eq!(eight(&[at(23.0, 5)]).0[1], 5);
        assert_eq!(eight(&[at(337.0, 5)]).0[7], 5);
        assert_eq!(eight(&[at(-23.0, 5)]).0[7], 5);
    }

    #[test]
    fn grid_does_not_depend_on_point_order() {
        let mut random = fastrand::Rng::with_seed(3);
        let mut turn = [NONE; 1_000];
        for (number, point) in turn.iter_mut().enumerate() {
            *point = at(number as f32 * 0.36 + random.f32(), random.u16(..4_000));
        }
        let fill = |points: &[Point]| {
            let (mut ranges, mut intensities, mut angles) = ([0; 450], [0; 450], [0.0; 450]);
            let collisions = Grid::new(450).fill(points, &mut ranges, &mut intensities, &mut angles);
            (ranges, collisions)
        };
        let ordered = fill(&turn);
        random.shuffle(&mut turn);
        assert_eq!(fill(&turn), ordered);
    }

    #[test]
    fn every_angle_maps_to_a_beam_even_nan() {
        let grid = Grid::new(8_192);
        let (mut ranges, mut intensities, mut angles) = ([0; 8_192], [0; 8_192], [0.0; 8_192]);
        let wild = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 100.0, -100.0, TAU, -TAU, 2.0 * TAU];
        let points = wild.map(|angle| Point { angle, ..NONE });
        let collisions = grid.fill(&points, &mut ranges, &mut intensities, &mut angles);
        assert_eq!((ranges[0], collisions), (NO_RETURN, 1));
        assert!(ranges[1..].iter().all(|range| *range == NOT_MEASURED));
        for beam in 0..8_192 {
            let point = Point { angle: (beam as f64 * grid.step()) as f32, range: 77, intensity: 1 };
            grid.fill(&[point], &mut ranges, &mut intensities, &mut angles);
            assert_eq!(ranges[beam], 77, "{beam}");
        }
        assert_eq!((Grid::new(0).beams(), Grid::new(9_000).beams()), (2, 8_192));
    }
}
