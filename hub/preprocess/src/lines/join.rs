//! Pieces of neighboring rays that end on one line, and how they are joined: the two that cost least first, until there are few
//! enough and one more would cost too much. `cut` moves the cuts between them afterwards.

use super::cut::Bounds;
use super::fit::{Line, Ray, Sums};

/// Consecutive rays that end on one line.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Piece {
    pub(super) first: usize,
    /// Index after the last ray.
    pub(super) end: usize,
    pub(super) sums: Sums,
    /// Sum of the squared differences of the ranges from the line, in m2.
    pub(super) error: f64,
    /// Whether the next piece starts a group, so that it is never joined with this one.
    pub(super) is_last: bool,
}

impl Piece {
    /// Creates the piece of the rays from `first` to before `end`.
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

    /// Returns this piece and the next one as one piece.
    pub(super) fn joined(&self, next: &Piece) -> Piece {
        let sums = self.sums + next.sums;
        Piece { first: self.first, end: next.end, sums, error: sums.error(), is_last: next.is_last }
    }

    /// Returns the cost of joining this piece with the next one, in m2, if ranges have this `variance`. If both pieces vary more,
    /// as surfaces do that are not quite straight, the cost counts less.
    pub(super) fn price(&self, next: &Piece, variance: f64) -> f64 {
        if self.is_last {
            return f64::INFINITY;
        }
        let apart = self.error + next.error;
        let free = (self.len() + next.len()).saturating_sub(4).max(1) as f64;
        ((self.sums + next.sums).error() - apart) / (apart / free / variance).max(1.0)
    }

    /// Adds the rays of `gap`, starting with those next to the piece, while they are within three standard deviations of its
    /// line. Returns their number.
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

/// Order of the pieces, and the cost of joining each of them with the next one.
pub(super) struct Joiner {
    before: Box<[u16]>,
    after: Box<[u16]>,
    least: Least,
}

const NONE: u16 = u16::MAX;

impl Joiner {
    /// Creates a joiner for pieces of at least two rays, of at most `beams` beams.
    pub(super) fn new(beams: usize) -> Joiner {
        let before = vec![NONE; beams].into();
        let after = vec![NONE; beams].into();
        Joiner { before, after, least: Least::new(beams) }
    }

    /// Joins `pieces`. Returns how many are left, which are then the first ones, and whether there were more than allowed.
    pub(super) fn join(&mut self, pieces: &mut [Piece], bounds: &Bounds) -> (usize, bool) {
        self.begin(pieces, bounds.variance);
        let (mut left, mut is_full) = (pieces.len(), false);
        while left > 1 {
            let (at, price) = self.least.get();
            let is_too_dear = price > bounds.penalty;
            if left <= bounds.max && is_too_dear {
                break;
            }
            // If the number is the only limit, no cost is too high.
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

    /// Returns the piece that costs least if its rays belong to no piece, if that is less than `price`.
    fn worst(&self, pieces: &[Piece], loss: f64, price: f64) -> Option<usize> {
        // A piece has at least two rays.
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

    /// Joins the piece `at` with the next one.
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

/// Minimum of numbers that change one at a time: a tournament tree.
struct Least {
    values: Box<[f64]>,
    /// Winner of each match. The root is 1; the numbers themselves follow after the matches.
    winners: Box<[u16]>,
    size: usize,
}

impl Least {
    /// Creates a tree for at most half as many numbers as `beams`, or for one.
    fn new(beams: usize) -> Least {
        let beams = beams.max(1);
        let values = vec![f64::INFINITY; beams].into();
        let winners = vec![0; beams].into();
        Least { values, winners, size: 1 }
    }

    /// Starts with `count` numbers, all infinite.
    fn begin(&mut self, count: usize) {
        self.size = count.next_power_of_two();
        self.values[..self.size].fill(f64::INFINITY);
    }

    /// Sets a number before the tree is built.
    fn put(&mut self, i: usize, value: f64) {
        self.values[i] = value;
    }

    /// Builds the tree.
    fn build(&mut self) {
        for node in (1..self.size).rev() {
            self.play(node);
        }
    }

    /// Sets a number.
    fn set(&mut self, i: usize, value: f64) {
        self.values[i] = value;
        let mut node = (self.size + i) / 2;
        while node > 0 {
            self.play(node);
            node /= 2;
        }
    }

    /// Returns the index of the minimum, and the minimum.
    fn get(&self) -> (usize, f64) {
        let i = self.winner(1);
        (i, self.values[i])
    }

    fn winner(&self, node: usize) -> usize {
        if node >= self.size { node - self.size } else { self.winners[node].into() }
    }

    fn play(&mut self, node: usize) {
        let (left, right) = (self.winner(2 * node), self.winner(2 * node + 1));
        let least = if self.values[left] <= self.values[right] { left } else { right };
        self.winners[node] = least as u16;
    }
}
