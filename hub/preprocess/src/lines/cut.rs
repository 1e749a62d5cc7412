//! Cuts the rays of a scan into pieces that end on one line each: beginning with pairs, neighbours are joined
//! ([`join`](super::join)), then the cuts between them are moved ([`refine`](super::refine)). Refuses to know angles,
//! payloads and where a scan comes from.

use super::fit::Ray;
use super::join::Joiner;
use super::piece::Piece;
use super::refine::{exchange, settle, trim};

/// When cutting ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Bounds {
    /// So many pieces at most.
    pub(super) max: usize,
    /// Joining goes on below `max` while it costs less than this, in m2.
    pub(super) penalty: f64,
    /// The variance of a range in m2. Two pieces that are worse than this by themselves are joined for more.
    pub(super) variance: f64,
    /// A ray that belongs to no piece costs this, in m2, where there are too many.
    pub(super) loss: f64,
    /// Pieces of fewer rays are left out.
    pub(super) min_points: usize,
    /// So often cuts are moved.
    pub(super) rounds: usize,
    /// Whether cuts are taken elsewhere too.
    pub(super) exchange: bool,
    /// So many rays at ends of pieces, those that fit worst, may be left out.
    pub(super) trimmed: usize,
}

/// The pieces that a scan was cut into.
pub(super) struct Pieces<'a> {
    pub(super) list: &'a [Piece],
    /// There are more than allowed; they were joined or left out.
    pub(super) is_full: bool,
}

/// The memory for it.
pub(super) struct Cutter {
    pieces: Box<[Piece]>,
    count: usize,
    joiner: Joiner,
}

impl Cutter {
    /// For at most so many `beams`.
    pub(super) fn new(beams: usize) -> Cutter {
        let pieces = vec![Piece::default(); beams].into();
        Cutter { pieces, count: 0, joiner: Joiner::new(beams) }
    }

    /// Returns the pieces of `rays`, of which each group ends where `ends` says: behind its last ray.
    pub(super) fn cut(&mut self, rays: &[Ray], ends: &[u16], bounds: &Bounds) -> Pieces<'_> {
        self.begin(rays, ends, bounds.min_points);
        let (count, is_full) = self.joiner.join(&mut self.pieces[..self.count], bounds);
        self.count = count;
        settle(&mut self.pieces[..count], rays, bounds.rounds);
        if bounds.exchange {
            exchange(&mut self.pieces[..count], rays, bounds);
        }
        self.leave_out(rays, bounds);
        trim(&mut self.pieces[..self.count], rays, bounds);
        Pieces { list: &self.pieces[..self.count], is_full }
    }

    /// Pairs; the last of an odd group has three. Groups that are too small are left out.
    fn begin(&mut self, rays: &[Ray], ends: &[u16], min_points: usize) {
        self.count = 0;
        let mut first = 0;
        for &end in ends {
            let end = usize::from(end);
            if end - first >= min_points.max(2) {
                while first < end {
                    let next = if end - first <= 3 { end } else { first + 2 };
                    self.pieces[self.count] = Piece::of(rays, first, next, next == end);
                    self.count += 1;
                    first = next;
                }
            }
            first = end;
        }
    }

    /// Leaves out pieces that are too small; their neighbours get of their rays what fits.
    fn leave_out(&mut self, rays: &[Ray], bounds: &Bounds) {
        let mut kept: usize = 0;
        let mut is_apart = true;
        for i in 0..self.count {
            let mut piece = self.pieces[i];
            let is_last = piece.is_last;
            if piece.len() >= bounds.min_points {
                if let Some(left) = kept.checked_sub(1).filter(|_| !is_apart) {
                    let left = &mut self.pieces[left];
                    left.end += left.grow(rays[left.end..piece.first].iter(), bounds.variance);
                    piece.first -= piece.grow(rays[left.end..piece.first].iter().rev(), bounds.variance);
                }
                self.pieces[kept] = piece;
                kept += 1;
                is_apart = false;
            }
            is_apart |= is_last;
        }
        self.count = kept;
    }
}
