//! Neighbouring rays that end on one line, and what it costs to join two such pieces. Refuses to know how many there may be.

use super::fit::{Line, Ray, Sums};

/// Some rays one after the other.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Piece {
    pub(super) first: usize,
    /// Behind the last.
    pub(super) end: usize,
    pub(super) sums: Sums,
    /// In m2.
    pub(super) error: f64,
    /// The next one begins a group: it is never joined with this one.
    pub(super) is_last: bool,
}

impl Piece {
    /// The rays from `first` to before `end`.
    pub(super) fn of(rays: &[Ray], first: usize, end: usize, is_last: bool) -> Piece {
        let sums = Sums::of(&rays[first..end]);
        Piece { first, end, sums, error: sums.error(), is_last }
    }

    /// Returns the line of least error.
    pub(super) fn line(&self) -> Line {
        self.sums.line()
    }

    pub(super) fn len(&self) -> usize {
        self.end - self.first
    }

    /// Returns both in one.
    pub(super) fn joined(&self, next: &Piece) -> Piece {
        let sums = self.sums + next.sums;
        Piece { first: self.first, end: next.end, sums, error: sums.error(), is_last: next.is_last }
    }

    /// What joining with the next one costs, if ranges have this `variance`: where both vary more, as surfaces do that are not
    /// quite straight, it counts for less.
    pub(super) fn price(&self, next: &Piece, variance: f64) -> f64 {
        if self.is_last {
            return f64::INFINITY;
        }
        let apart = self.error + next.error;
        let free = (self.len() + next.len()).saturating_sub(4).max(1) as f64;
        ((self.sums + next.sums).error() - apart) / (apart / free / variance).max(1.0)
    }

    /// Takes in the rays of `gap`, first of all those next to it, for as long as they are within three deviations of its line;
    /// how many these are.
    pub(super) fn grow<'a>(&mut self, gap: impl Iterator<Item = &'a Ray>, variance: f64) -> usize {
        let mut taken = 0;
        for ray in gap {
            let free = (self.len() + taken).saturating_sub(2).max(1) as f64;
            let off = ray.range - 1.0 / self.line().inverse(ray);
            let is_near = off * off <= 9.0 * (self.error / free).max(variance);
            if !is_near {
                break;
            }
            self.sums = self.sums + Sums::one(ray);
            self.error = self.sums.error();
            taken += 1;
        }
        taken
    }
}
