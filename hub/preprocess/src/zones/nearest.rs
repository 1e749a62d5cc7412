//! Finds the reading that is nearest to the robot's centre, exact to the millimetre (rounded down), while only a few
//! beams are computed one by one. Refuses to know circles.

use super::spans::Spans;

/// Where beams run, and which of their readings count.
pub(super) struct Nearest {
    /// Readings that count: valid, and beyond the robot's own body.
    pub(super) seen: Spans,
    /// For each beam twice s.u, in device units: s is the sensor's place, u the beam's direction.
    pub(super) twice_q: Box<[f64]>,
    /// Of the blocks: the least of these, and what no reading falls below in the scan that is looked at.
    least_twice_q: Box<[f64]>,
    bounds: Box<[f64]>,
}

impl Nearest {
    /// For so many beams at most; there are none yet.
    pub(super) fn none(beams: usize) -> Nearest {
        let blocks = vec![0.0; beams.div_ceil(BLOCK)].into_boxed_slice();
        Nearest {
            seen: Spans::none(beams),
            twice_q: vec![0.0; beams].into(),
            least_twice_q: blocks.clone(),
            bounds: blocks,
        }
    }

    /// To be called when all beams are set.
    pub(super) fn finish(&mut self) {
        for (block, least) in self.twice_q.chunks(BLOCK).zip(&mut self.least_twice_q) {
            *least = block.iter().copied().fold(f64::INFINITY, f64::min);
        }
    }

    /// The beam whose point is nearest to the centre, the first of several, and the square of its distance without that
    /// of the sensor: r^2 + 2qr, in device units.
    pub(super) fn find(&mut self, ranges: &[u16]) -> Option<(usize, f64)> {
        self.bound(ranges);
        let bounds = &self.bounds[..ranges.len().div_ceil(BLOCK)];
        let best =
            (1..bounds.len()).fold(0, |best, block| if bounds[block] < bounds[best] { block } else { best });
        let mut nearest = self.nearer(best, ranges, (f64::INFINITY, usize::MAX));
        for (block, &bound) in bounds.iter().enumerate() {
            if bound <= nearest.0 {
                nearest = self.nearer(block, ranges, nearest);
            }
        }
        let (square, beam) = nearest;
        (beam != usize::MAX).then_some((beam, square))
    }

    /// What no reading of a block falls below: the shortest that counts, taken along the beam that runs best.
    fn bound(&mut self, ranges: &[u16]) {
        let blocks = ranges.chunks(BLOCK).zip(self.seen.from.chunks(BLOCK));
        for ((bound, (ranges, from)), &twice_q) in self.bounds.iter_mut().zip(blocks).zip(&self.least_twice_q)
        {
            // A code is longer than any range, and does no harm here.
            let shortest =
                ranges.iter().zip(from).map(|(&range, &from)| range.max(from)).fold(u16::MAX, u16::min);
            let (shortest, turn) = (f64::from(shortest), -0.5 * twice_q);
            let value = if shortest > turn { shortest } else { turn };
            *bound = value * (value + twice_q);
        }
    }

    /// `nearest`, or a reading of the block that is nearer.
    fn nearer(&self, block: usize, ranges: &[u16], nearest: (f64, usize)) -> (f64, usize) {
        let mut nearest = nearest;
        for (i, &range) in ranges.iter().enumerate().skip(block * BLOCK).take(BLOCK) {
            let value = f64::from(range);
            let square = value * (value + self.twice_q[i]);
            let is_nearer = square < nearest.0 || (square == nearest.0 && i < nearest.1);
            if is_nearer && self.seen.has(i, range) {
                nearest = (square, i);
            }
        }
        nearest
    }
}

/// Beams of which it is first asked whether one of them can be the nearest: their directions differ little, and there
/// are few blocks.
const BLOCK: usize = 32;
