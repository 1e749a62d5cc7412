//! Joins neighbouring pieces, the two that cost least first, until there are few enough and one more would cost too much.
//! Refuses to know where cuts between them would be better.

use super::cut::Bounds;
use super::least::Least;
use super::piece::Piece;

/// Who stands beside whom, and what it costs to join each piece with the next.
pub(super) struct Joiner {
    before: Box<[u16]>,
    after: Box<[u16]>,
    least: Least,
}

const NONE: u16 = u16::MAX;

impl Joiner {
    /// For pieces of at least two of at most so many `beams`.
    pub(super) fn new(beams: usize) -> Joiner {
        let before = vec![NONE; beams].into();
        let after = vec![NONE; beams].into();
        Joiner { before, after, least: Least::new(beams) }
    }

    /// Joins `pieces`; how many are left, which then stand at the beginning, and whether they had to be fewer than they are.
    pub(super) fn join(&mut self, pieces: &mut [Piece], bounds: &Bounds) -> (usize, bool) {
        self.begin(pieces, bounds.variance);
        let (mut left, mut is_full) = (pieces.len(), false);
        while left > 1 {
            let (at, price) = self.least.get();
            let is_too_dear = price > bounds.penalty;
            if left <= bounds.max && is_too_dear {
                break;
            }
            // Where the number is the only bound, joining has no price that would be too much.
            is_full |= is_too_dear && bounds.penalty > 0.0;
            match self.worst(pieces, bounds.loss, price) {
                Some(worst) if left > bounds.max => self.leave_out(pieces, worst),
                _ if price.is_finite() => self.join_at(pieces, at, bounds.variance),
                _ => break,
            }
            left -= 1;
        }
        let mut kept = 0;
        for i in 0..pieces.len() {
            if pieces[i].len() > 0 {
                pieces[kept] = pieces[i];
                kept += 1;
            }
        }
        (kept, is_full)
    }

    fn begin(&mut self, pieces: &[Piece], variance: f64) {
        self.least.begin(pieces.len());
        for (i, piece) in pieces.iter().enumerate() {
            let next = pieces.get(i + 1);
            self.before[i] = if i == 0 { NONE } else { i as u16 - 1 };
            self.after[i] = if next.is_none() { NONE } else { i as u16 + 1 };
            self.least.put(i, next.map_or(f64::INFINITY, |next| piece.price(next, variance)));
        }
        self.least.build();
    }

    /// The piece that costs least if none of its rays belongs to any, if that is less than `price`.
    fn worst(&self, pieces: &[Piece], loss: f64, price: f64) -> Option<usize> {
        // Two rays are the fewest of a piece.
        if price <= 2.0 * loss {
            return None;
        }
        let cost = |i: &usize| pieces[*i].len() as f64 * loss - pieces[*i].error;
        let there = (0..pieces.len()).filter(|&i| pieces[i].len() > 0);
        there.min_by(|a, b| cost(a).total_cmp(&cost(b))).filter(|worst| cost(worst) < price)
    }

    fn leave_out(&mut self, pieces: &mut [Piece], i: usize) {
        let (back, next) = (self.before[i], self.after[i]);
        if back != NONE {
            let back = usize::from(back);
            self.after[back] = next;
            pieces[back].is_last = true;
            self.least.set(back, f64::INFINITY);
        }
        if next != NONE {
            self.before[usize::from(next)] = back;
        }
        pieces[i].end = pieces[i].first;
        self.least.set(i, f64::INFINITY);
    }

    /// Joins a piece with the next.
    fn join_at(&mut self, pieces: &mut [Piece], at: usize, variance: f64) {
        let gone = usize::from(self.after[at]);
        pieces[at] = pieces[at].joined(&pieces[gone]);
        pieces[gone].end = pieces[gone].first;
        self.after[at] = self.after[gone];
        self.least.set(gone, f64::INFINITY);
        let mut price = f64::INFINITY;
        if self.after[at] != NONE {
            let next = usize::from(self.after[at]);
            self.before[next] = at as u16;
            price = pieces[at].price(&pieces[next], variance);
        }
        self.least.set(at, price);
        if self.before[at] != NONE {
            let back = usize::from(self.before[at]);
            self.least.set(back, pieces[back].price(&pieces[at], variance));
        }
    }
}
