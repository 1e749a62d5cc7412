//! Optics of the head: for each point, the position that the laser hits, and whether and how strongly it is reflected.
//!
//! The laser of a scanner that triangulates sits beside its lens. So the angle of a point lies behind the head's by a
//! shift that depends on its range, and points at the edge of something near come out of angular order. The vendor's
//! decoder of the type 0x84 has the shift as a formula; it is taken for all of such a scanner's modes. Where the
//! formula has no solution, at an edge, nothing comes back.

use schema::Nanos;

use super::models::Model;
use super::protocol::Reading;
use crate::room::Room;
use crate::rotating::{BeamReading, Beams, TruePoint, ahead_deg};

/// A head in a room.
pub(crate) struct Optics {
    model: Model,
    beams: Beams,
    seed: u64,
}

impl Optics {
    pub(crate) fn new(model: Model, room: Room, seed: u64) -> Optics {
        Optics { model, beams: Beams::new(room), seed }
    }

    /// The point measured at `at_ns` while the head was at `head_deg`, as it is.
    pub(crate) fn truth(&mut self, at_ns: Nanos, head_deg: f64) -> TruePoint {
        let (clockwise_deg, look) = self.meet(at_ns, head_deg);
        TruePoint { at_ns, clockwise_deg, range_mm: look.and_then(|look| look.exact_mm) }
    }

    /// The point measured at `at_ns` while the head was at `head_deg`, as the scanner has it in a mode that reaches so
    /// far.
    pub(crate) fn measure(&mut self, at_ns: Nanos, head_deg: f64, reach_m: f64) -> Reading {
        let (clockwise_deg, look) = self.meet(at_ns, head_deg);
        let behind_deg = self.behind_of_nothing_deg(at_ns);
        let nothing = Reading {
            head_deg,
            clockwise_deg: (head_deg - behind_deg + 360.0) % 360.0,
            ..Reading::default()
        };
        let Some(look) = look.filter(|look| self.comes_back(at_ns, clockwise_deg, look)) else {
            return nothing;
        };
        let is_in_reach = |mm: &f64| self.model.reach_mm().contains(mm) && *mm <= 1e3 * reach_m;
        let Some(range_mm) = look.range_mm.filter(is_in_reach) else { return nothing };
        // The least quality that the six bits of the type 0x81 can hold.
        let quality = look.intensity.max(4);
        Reading { clockwise_deg, range_mm: range_mm.round() as u16, quality, ..nothing }
    }

    /// Which point the laser meets: degrees clockwise from the head's zero, and what is seen there.
    fn meet(&mut self, at_ns: Nanos, head_deg: f64) -> (f64, Option<BeamReading>) {
        let mut look_at = |clockwise_deg: f64| self.beams.measure(at_ns, ahead_deg(clockwise_deg));
        if !self.model.triangulates() {
            return (head_deg, Some(look_at(head_deg)));
        }
        let behind = |range_mm: Option<f64>| (head_deg - shift_deg(range_mm) + 360.0) % 360.0;
        let mut clockwise_deg = behind(Some(FAR_MM));
        for _ in 0..TRIES {
            let look = look_at(clockwise_deg);
            let met_deg = behind(look.exact_mm);
            if met_deg == clockwise_deg {
                return (clockwise_deg, Some(look));
            }
            clockwise_deg = met_deg;
        }
        (behind(None), None)
    }

    /// How far behind the head a point is told to be of which nothing came back. A real A1 tells 12 % of its points out
    /// of angular order, and the first one of a turn anywhere from 351 to 359.5 degrees; which rule it follows is not
    /// known.
    fn behind_of_nothing_deg(&self, at_ns: Nanos) -> f64 {
        if !self.model.triangulates() {
            return 0.0;
        }
        let mut random = fastrand::Rng::with_seed(!self.seed ^ at_ns);
        if random.f64() < ASTRAY { 2.0 + 7.0 * random.f64() } else { shift_deg(None) }
    }

    /// Whether enough comes back. Scanners that triangulate lose most of what is indoors: what is dark, far or seen
    /// obliquely. How dark a surface is goes by its direction, in patches.
    fn comes_back(&self, at_ns: Nanos, clockwise_deg: f64, look: &BeamReading) -> bool {
        if !self.model.triangulates() {
            return true;
        }
        let patch = (clockwise_deg / PATCH_DEG) as u64;
        let dark = fastrand::Rng::with_seed(self.seed ^ patch.wrapping_mul(0x9E37_79B9_7F4A_7C15)).f64();
        let dice = fastrand::Rng::with_seed(self.seed ^ at_ns).f64();
        look.signal * (0.75 + 0.5 * dice) > LEAST_SIGNAL * DARKEST.powf(dark)
    }
}

/// By how many degrees a point at `range_mm` lies behind the head, with the steps that the vendor's decoder has: 8
/// degrees less k / 1024 less k^3 / 6442450944 radians, where k is the whole part of 98361 / (4 range); 7.5 degrees
/// below 50 mm and for no return.
pub(crate) fn shift_deg(range_mm: Option<f64>) -> f64 {
    match range_mm {
        Some(range_mm) if range_mm >= 50.0 => {
            let k = (98_361.0 / (4.0 * range_mm.round())).floor();
            8.0 - (k / 1_024.0 + k.powi(3) / 6_442_450_944.0).to_degrees()
        }
        _ => 7.5,
    }
}

/// Share of the points without return that are told anywhere from 2 to 9 degrees behind the head.
const ASTRAY: f64 = 0.27;
/// Where a search for the point begins.
const FAR_MM: f64 = 3_000.0;
/// How often a search is tried.
const TRIES: usize = 6;
/// Width of a surface that is as dark all over, seen from the scanner.
const PATCH_DEG: f64 = 2.0;
/// The least signal that comes back from the brightest surfaces, beside a white one at 1 m, and how many times as much
/// the darkest ones need. By these 61 to 84 % of the points indoors are invalid, as they were on a real A1.
const LEAST_SIGNAL: f64 = 0.003;
const DARKEST: f64 = 20_000.0;
