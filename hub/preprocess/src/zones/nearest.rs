//! Finds the reading that is nearest to the robot's centre, exact to the millimetre (rounded down), while only a few
//! beams are computed one by one. Refuses to know circles.

use super::spans::{Ranges, Spans};
use schema::BEAMS;

/// Where beams run, and which of their readings count.
pub(super) struct Nearest {
    /// Readings that count: valid, and beyond the robot's own body.
    pub(super) seen: Spans,
    /// For each beam twice s.u, in device units: s is the sensor's place, u the beam's direction.
    pub(super) twice_q: [f64; BEAMS],
    least_twice_q: [f64; BLOCKS],
}

impl Nearest {
    /// No beams.
    pub(super) const NONE: Nearest =
        Nearest { seen: Spans::NONE, twice_q: [0.0; BEAMS], least_twice_q: [0.0; BLOCKS] };

    /// To be called when all beams are set.
    pub(super) fn finish(&mut self) {
        for (block, least) in self.least_twice_q.iter_mut().enumerate() {
            *least = beams(block).map(|i| self.twice_q[i]).fold(f64::INFINITY, f64::min);
        }
    }

    /// The beam whose point is nearest to the centre, the first of several, and the square of its distance without that
    /// of the sensor: r^2 + 2qr, in device units.
    pub(super) fn find(&self, ranges: &Ranges) -> Option<(usize, f64)> {
        let bounds = self.bounds(ranges);
        let best = (1..BLOCKS).fold(0, |best, block| if bounds[block] < bounds[best] { block } else { best });
        let mut nearest = self.nearer(best, ranges, (f64::INFINITY, BEAMS));
        for (block, &bound) in bounds.iter().enumerate() {
            if bound <= nearest.0 {
                nearest = self.nearer(block, ranges, nearest);
            }
        }
        let (square, beam) = nearest;
        (beam < BEAMS).then_some((beam, square))
    }

    /// What no reading of a block falls below: the shortest that counts, taken along the beam that runs best.
    fn bounds(&self, ranges: &Ranges) -> [f64; BLOCKS] {
        let shortest: [u16; BLOCKS] = std::array::from_fn(|block| {
            // A code is longer than any range, and does no harm here.
            beams(block).map(|i| ranges[i].max(self.seen.from[i])).fold(u16::MAX, u16::min)
        });
        std::array::from_fn(|block| {
            let twice_q = self.least_twice_q[block];
            let (shortest, turn) = (f64::from(shortest[block]), -0.5 * twice_q);
            let value = if shortest > turn { shortest } else { turn };
            value * (value + twice_q)
        })
    }

    /// `nearest`, or a reading of the block that is nearer.
    fn nearer(&self, block: usize, ranges: &Ranges, nearest: (f64, usize)) -> (f64, usize) {
        let mut nearest = nearest;
        for i in beams(block) {
            let value = f64::from(ranges[i]);
            let square = value * (value + self.twice_q[i]);
            let is_nearer = square < nearest.0 || (square == nearest.0 && i < nearest.1);
            if is_nearer && self.seen.has(i, ranges[i]) {
                nearest = (square, i);
            }
        }
        nearest
    }
}

/// Beams of which it is first asked whether one of them can be the nearest: their directions differ little, and there
/// are few blocks.
const BLOCK: usize = 32;
const BLOCKS: usize = BEAMS.div_ceil(BLOCK);

/// The beams of a block; the last two overlap.
fn beams(block: usize) -> std::ops::Range<usize> {
    let start = (block * BLOCK).min(BEAMS - BLOCK);
    start..start + BLOCK
}
