//! Puts a turn of a scanner whose points fall where they like on a grid of beams, as a scan. Refuses to know what the
//! scanner speaks.

use crate::line;
use crate::line::Turn;
use crate::line::grid::{Grid, Point};
use schema::{Code, Contents, Family, Scan, ScanArrays, ScanHead};

/// A turn of a scanner's head.
#[derive(Clone, Copy, Debug)]
pub struct Turning<'a> {
    /// Of which family it is.
    pub family: Family,
    /// Its points as they came.
    pub points: &'a [Point],
    /// How long a turn takes, in ns.
    pub period_ns: u64,
    /// Points that the scanner measures in a second; 0 unknown.
    pub points_per_second: f32,
    /// Whether packets of it are missing.
    pub incomplete: bool,
}

impl<'a> Turning<'a> {
    /// `turn` of a scanner of `family`.
    pub fn of(turn: &Turn<'a>, family: Family) -> Turning<'a> {
        Turning {
            family,
            points: turn.points,
            period_ns: turn.period,
            points_per_second: turn.points_per_second,
            incomplete: turn.incomplete,
        }
    }

    /// Returns the bytes of the scan of so many beams.
    pub const fn len(beams: usize) -> usize {
        Scan::len(beams, Contents::TURNING)
    }

    /// Writes the turn into `scan` on a grid of `beams`, every byte that it uses; beam 0 is measured at the sample's stamp.
    ///
    /// # Panics
    ///
    /// If `scan` has less memory than [`len`](Self::len) says.
    pub fn decode(&self, beams: usize, scan: &mut Scan) {
        let grid = Grid::new(beams);
        let head = ScanHead::turning(self.family, grid.beams());
        // Points of the scanner's own in a turn.
        let own = f64::from(self.points_per_second) * self.period_ns as f64 / 1e9;
        let spacing = if own >= 1.0 { std::f64::consts::TAU / own } else { -head.step };
        let ScanArrays { angles, ranges, upper, .. } = scan.begin(ScanHead {
            spacing: spacing as f32,
            beam_time_ns: u32::try_from(self.period_ns / grid.beams() as u64).unwrap_or(u32::MAX),
            flags: if self.incomplete { Scan::INCOMPLETE } else { 0 },
            ..head
        });
        let placed = grid.fill(self.points, ranges, upper, angles);
        scan.collapsed = u16::try_from(placed.collapsed).unwrap_or(u16::MAX);
    }
}

const _: () = assert!(line::grid::NO_RETURN == Code::NoReturn.value());
const _: () = assert!(line::grid::NOT_MEASURED == Scan::NOT_MEASURED);
const _: () = assert!(*line::grid::BEAMS.end() == schema::BEAMS);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_is_a_scan() {
        let point = |degrees: f32, range| Point { angle: -degrees.to_radians(), range, intensity: 9 };
        let points =
            [point(0.2, 1000), point(91.0, 700), point(92.0, 500), point(181.0, Code::NoReturn.value())];
        let turning = Turning {
            family: Family::Ld,
            points: &points,
            period_ns: 100_000_000,
            points_per_second: 40.0,
            incomplete: true,
        };
        let mut scan = Scan::zeroed(Turning::len(8));
        turning.decode(8, &mut scan);
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
}
