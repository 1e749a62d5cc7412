//! A scan in the buffer of a session, complete or still arriving. It writes itself into a payload: here raw values
//! become ranges, directly in the shared memory that subscribers read.

use std::f64::consts::TAU;

use crate::line::grid::{Grid, Point};
use crate::line::{self, Closed};
use scanhub_schema::{Code, Family, Nanos, Scan, ScanArrays, ScanHead};

/// A scan as it was received.
#[derive(Clone, Copy, Debug)]
pub struct RawScan<'a> {
    /// Number among the scans of the session. Scans that are not returned have numbers, too.
    pub number: u64,
    /// Time at which beam 0 was, or would have been, measured, or at which the first byte arrived.
    pub first: Nanos,
    /// Time at which the last point was measured, or at which the last byte arrived.
    pub last: Nanos,
    /// Time from one scan to the next; 0 if it is not known.
    pub period: Nanos,
    /// Reasons for suspicion: bits of [`crate::line::suspect`]; 0 is clean.
    pub reasons: u8,
    /// Bytes of a partial telegram that have arrived; 0 for packets.
    pub bytes: usize,
    /// Angles, unit and arrays.
    pub head: ScanHead,
    /// The values.
    pub values: Values<'a>,
}

/// Values of a scan as they were received.
#[derive(Clone, Copy, Debug)]
pub enum Values<'a> {
    /// Little-endian words of the first beams, which have fixed angles.
    Words {
        /// Two bytes for each beam.
        bytes: &'a [u8],
        /// Low bits of a word that are the range. The others are the upper bits of the scan.
        range_bits: u8,
    },
    /// Points of a revolution in the order of arrival, to be assigned to a grid of beams.
    Points {
        /// The points.
        points: &'a [Point],
        /// Points that the scanner measures per second; 0 if unknown.
        per_second: f32,
    },
}

impl<'a> RawScan<'a> {
    /// Returns the scan of the revolution `closed` with its `points`, on a grid of `beams`. `stamps` are those of beam
    /// 0 and of the last point. `per_second` is the number of points per second; 0 if unknown.
    pub fn revolution(
        family: Family,
        closed: &Closed,
        (first, last): (Nanos, Nanos),
        (beams, per_second): (usize, f32),
        points: &'a [Point],
    ) -> RawScan<'a> {
        let &Closed { number, period, reasons, incomplete, .. } = closed;
        let head = revolution_head(family, beams, period, per_second, incomplete);
        let values = Values::Points { points, per_second };
        RawScan { number, first, last, period, reasons, bytes: 0, head, values }
    }

    /// Returns the number of beams.
    pub fn beams(&self) -> usize {
        self.head.count.into()
    }

    /// Returns the points of a revolution; none of a scan with fixed angles.
    pub fn points(&self) -> &'a [Point] {
        if let Values::Points { points, .. } = self.values { points } else { &[] }
    }

    /// Returns whether packets of the revolution are missing.
    pub fn is_incomplete(&self) -> bool {
        self.head.flags & Scan::INCOMPLETE != 0
    }

    /// Returns the length of its payload in bytes.
    pub fn payload_len(&self) -> usize {
        Scan::len(self.beams(), self.head.contents)
    }

    /// Writes it into `scan`, every byte that it uses. Beams whose values have not arrived are not measured.
    ///
    /// # Panics
    ///
    /// Panics if `scan` has less memory than [`payload_len`](Self::payload_len) bytes.
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
                let placed = Grid::new(self.beams()).fill(points, ranges, upper, angles);
                scan.collapsed = u16::try_from(placed.collapsed).unwrap_or(u16::MAX);
            }
        }
    }
}

/// Returns the head of the scan of a revolution that takes `period`, on a grid of `beams`. `points_per_second` is 0 if
/// it is not known.
pub fn revolution_head(
    family: Family,
    beams: usize,
    period: Nanos,
    points_per_second: f32,
    is_incomplete: bool,
) -> ScanHead {
    let head = ScanHead::turning(family, beams);
    // The scanner's own points in a revolution.
    let own = f64::from(points_per_second) * period as f64 / 1e9;
    let spacing = if own >= 1.0 { TAU / own } else { -head.step };
    ScanHead {
        spacing: spacing as f32,
        beam_time_ns: u32::try_from(period / beams.max(1) as u64).unwrap_or(u32::MAX),
        flags: if is_incomplete { Scan::INCOMPLETE } else { 0 },
        ..head
    }
}

const _: () = assert!(line::grid::NO_RETURN == Code::NoReturn.value());
const _: () = assert!(line::grid::NOT_MEASURED == Scan::NOT_MEASURED);
const _: () = assert!(*line::grid::BEAMS.end() == scanhub_schema::BEAMS);

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::Contents;

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
        assert_eq!(raw.payload_len(), Scan::len(8, Contents::TURNING));
        assert_eq!((scan.beams(), scan.collapsed, scan.is_incomplete()), (8, 1, true));
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
    fn writes_words_that_have_arrived() {
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
}
