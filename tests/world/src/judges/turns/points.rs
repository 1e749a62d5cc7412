//! A point as a head measured it and as a scan tells it, and whether both are the same.

use scanhub_schema::{Code, Nanos, Scan};
use scanhub_sim::ld::TruePoint;

use crate::event::Figures;
use crate::family::Exactness;

/// A point that was measured.
#[derive(Clone, Copy, PartialEq)]
pub(super) struct Point {
    pub(super) truth: TruePoint,
    /// Degrees since the first one, turns and all.
    pub(super) turned_deg: f64,
}

/// What a scan tells of a point.
#[derive(Debug)]
pub(super) struct Told {
    pub(super) at_ns: Nanos,
    pub(super) clockwise_deg: f64,
    pub(super) range_mm: Option<u16>,
}

/// The beams of `scan` that were measured.
pub(super) fn told(stamp: Nanos, scan: &Scan) -> Vec<Told> {
    let beams = (0..scan.beams()).filter(|&i| scan.code(i) != Some(Code::NotMeasured));
    let told = |i: usize| Told {
        at_ns: stamp.saturating_add_signed(scan.beam_ns(i)),
        clockwise_deg: (-scan.angle(i).to_degrees()).rem_euclid(360.0),
        range_mm: scan.range(i),
    };
    beams.map(told).collect()
}

impl Point {
    /// Whether it is what is told: a scanner may see nothing where there is something.
    pub(super) fn is(&self, told: &Told, exactness: &Exactness) -> bool {
        let (is_there, most_deg) = match (told.range_mm, self.truth.range_mm) {
            (Some(told), Some(exact)) => {
                ((f64::from(told) - exact).abs() < exactness.range_mm, exactness.angle_deg)
            }
            (Some(_), None) => (false, 0.0),
            (None, _) => (true, exactness.nothing_deg),
        };
        is_there && self.off_deg(told.clockwise_deg) < most_deg
    }

    pub(super) fn off_deg(&self, clockwise_deg: f64) -> f64 {
        ((self.truth.clockwise_deg - clockwise_deg + 180.0).rem_euclid(360.0) - 180.0).abs()
    }
}

impl Figures {
    pub(super) fn of(scan: &Scan, told: &[Told], points: &[Option<&Point>]) -> Figures {
        let pairs = || told.iter().zip(points).filter_map(|(told, point)| Some((told, (*point)?)));
        let worst = |off: &dyn Fn((&Told, &Point)) -> f64| pairs().map(off).fold(0.0, f64::max);
        let range_mm = |(told, point): (&Told, &Point)| {
            told.range_mm
                .zip(point.truth.range_mm)
                .map_or(0.0, |(told, exact)| (f64::from(told) - exact).abs())
        };
        Figures {
            scans: 1,
            incomplete: scan.is_incomplete().into(),
            points: pairs().count() as u64,
            angle_deg: worst(&|(told, point)| point.off_deg(told.clockwise_deg)),
            range_mm: worst(&range_mm),
            ..Figures::default()
        }
    }
}
