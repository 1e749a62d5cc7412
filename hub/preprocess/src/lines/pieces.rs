//! Partition of the rays of a scan into pieces. The rays of a piece end on one line. The steps are:
//!
//! - Neighboring pieces are joined. At first, each piece has two rays. The next join is always the one with the lowest
//!   cost. Joining ends when there are few enough pieces and one more join would cost too much.
//! - Each cut between two pieces is moved to where it costs least.
//! - A cut that hardly helps is removed, and another piece is cut in two instead, where the cut helps most.
//! - Rays at the ends of pieces are dropped if they fit worst.
//!
//! All costs are errors: sums of squared differences between ranges and lines, in m2.

use super::fit::{LineEquation, Ray, Sums};

/// Limits of the partition.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Bounds {
    /// Maximum number of pieces.
    pub(super) max: usize,
    /// Maximum cost of a join in m2, if there are at most `max` pieces. With more pieces, a join may cost more.
    pub(super) penalty: f64,
    /// Variance of a range in m2. The cost of joining two pieces is reduced if their own variance is greater.
    pub(super) variance: f64,
    /// Cost in m2 of dropping a ray because there are too many pieces.
    pub(super) loss: f64,
    /// Minimum number of rays of a piece. Smaller pieces are dropped.
    pub(super) min_points: usize,
    /// Maximum number of rounds in which cuts are moved after joining.
    pub(super) rounds: usize,
    /// Whether a cut may also be removed in favor of a cut in another piece.
    pub(super) exchange: bool,
    /// Maximum number of rays that may be dropped at the ends of pieces. The rays that fit worst are dropped first.
    pub(super) trimmed: usize,
}

/// Pieces of a scan.
pub(super) struct Pieces<'a> {
    pub(super) list: &'a [Piece],
    /// Whether there were more pieces than allowed. The excess pieces were joined or dropped.
    pub(super) is_full: bool,
}

/// Buffers for the partition of scans.
pub(super) struct ScanPartitioner {
    pieces: Box<[Piece]>,
    count: usize,
    joiner: Joiner,
}

impl ScanPartitioner {
    /// Creates the memory for at most `beams` beams.
    pub(super) fn new(beams: usize) -> ScanPartitioner {
        let pieces = vec![Piece::default(); beams].into();
        ScanPartitioner { pieces, count: 0, joiner: Joiner::new(beams) }
    }

    /// Returns the pieces of `rays`. `ends` has the index after the last ray of each group.
    pub(super) fn partition(&mut self, rays: &[Ray], ends: &[u16], bounds: &Bounds) -> Pieces<'_> {
        self.begin(rays, ends, bounds.min_points);
        let (count, is_full) = self.joiner.join(&mut self.pieces[..self.count], bounds);
        self.count = count;
        move_cuts_until_stable(&mut self.pieces[..count], rays, bounds.rounds);
        if bounds.exchange {
            exchange(&mut self.pieces[..count], rays, bounds);
        }
        self.drop_small_pieces(rays, bounds);
        trim(&mut self.pieces[..self.count], rays, bounds);
        Pieces { list: &self.pieces[..self.count], is_full }
    }

    /// Creates a piece of each pair of neighboring rays. In a group with an odd number of rays, the last piece has
    /// three rays. Groups that are too small are dropped.
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

    /// Drops pieces that are too small. The pieces next to a dropped piece take over those of its rays that fit their
    /// lines.
    fn drop_small_pieces(&mut self, rays: &[Ray], bounds: &Bounds) {
        let mut kept_count: usize = 0;
        let mut is_apart = true;
        for i in 0..self.count {
            let mut piece = self.pieces[i];
            let is_last = piece.is_last;
            if piece.len() >= bounds.min_points {
                if let Some(previous) = kept_count.checked_sub(1).filter(|_| !is_apart) {
                    let previous = &mut self.pieces[previous];
                    previous.end += previous.grow(rays[previous.end..piece.first].iter(), bounds.variance);
                    piece.first -= piece.grow(rays[previous.end..piece.first].iter().rev(), bounds.variance);
                }
                self.pieces[kept_count] = piece;
                kept_count += 1;
                is_apart = false;
            }
            is_apart |= is_last;
        }
        self.count = kept_count;
    }
}

/// Piece of a scan: consecutive rays that end on one line.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Piece {
    pub(super) first: usize,
    /// Index after the last ray.
    pub(super) end: usize,
    pub(super) sums: Sums,
    /// Sum of the squared differences of the ranges from the line, in m2.
    pub(super) error: f64,
    /// Whether the next piece is never joined with this piece, because it starts a group or a piece between them was
    /// dropped.
    pub(super) is_last: bool,
}

impl Piece {
    /// Creates the piece of the rays from `first` to before `end`.
    fn of(rays: &[Ray], first: usize, end: usize, is_last: bool) -> Piece {
        let sums = Sums::of(&rays[first..end]);
        Piece { first, end, sums, error: sums.error(), is_last }
    }

    /// Returns the line with the minimum error.
    pub(super) fn line(&self) -> LineEquation {
        self.sums.line()
    }

    pub(super) fn len(&self) -> usize {
        self.end - self.first
    }

    /// Returns this piece and the next one as one piece.
    fn joined(&self, next: &Piece) -> Piece {
        let sums = self.sums + next.sums;
        Piece { first: self.first, end: next.end, sums, error: sums.error(), is_last: next.is_last }
    }

    /// Returns the cost of joining this piece with the next one, in m2, if ranges have this `variance`. If the ranges
    /// of the two pieces vary more, because the surfaces are not quite straight, the cost is reduced.
    fn join_cost(&self, next: &Piece, variance: f64) -> f64 {
        if self.is_last {
            return f64::INFINITY;
        }
        let apart = self.error + next.error;
        let free = (self.len() + next.len()).saturating_sub(4).max(1) as f64;
        ((self.sums + next.sums).error() - apart) / (apart / free / variance).max(1.0)
    }

    /// Adds rays of `gap` to the piece, and returns the number of added rays. The first ray of `gap` must be next to
    /// the piece. Ends at the first ray that is more than three standard deviations away from the line of the piece.
    fn grow<'a>(&mut self, gap: impl Iterator<Item = &'a Ray>, variance: f64) -> usize {
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

/// Joiner of neighboring pieces. Pieces that were joined to another piece or dropped stay in the list without rays, so
/// the joiner stores the neighbors of each remaining piece.
struct Joiner {
    /// Index of the piece before each piece, or [`NO_PIECE`].
    before: Box<[u16]>,
    /// Index of the piece after each piece, or [`NO_PIECE`].
    after: Box<[u16]>,
    /// Cost of joining each piece with the next one.
    costs: TournamentTree,
}

const NO_PIECE: u16 = u16::MAX;

impl Joiner {
    /// Creates a joiner for the pieces of at most `beams` beams.
    pub(super) fn new(beams: usize) -> Joiner {
        let before = vec![NO_PIECE; beams].into();
        let after = vec![NO_PIECE; beams].into();
        Joiner { before, after, costs: TournamentTree::new(beams) }
    }

    /// Joins `pieces`. Moves the remaining pieces to the start of `pieces`, and returns their number. Also returns
    /// whether there were more pieces than allowed.
    pub(super) fn join(&mut self, pieces: &mut [Piece], bounds: &Bounds) -> (usize, bool) {
        self.begin(pieces, bounds.variance);
        let (mut remaining, mut is_full) = (pieces.len(), false);
        while remaining > 1 {
            let (at, price) = self.costs.minimum();
            let is_too_dear = price > bounds.penalty;
            if remaining <= bounds.max && is_too_dear {
                break;
            }
            // If there is no penalty, only the number of pieces limits joining, so no join costs too much.
            is_full |= is_too_dear && bounds.penalty > 0.0;
            match self.worst(pieces, bounds.loss, price) {
                Some(worst) if remaining > bounds.max => self.drop_piece(pieces, worst),
                _ if price.is_finite() => self.join_at(pieces, at, bounds.variance),
                _ => break,
            }
            remaining -= 1;
        }
        let mut kept_count = 0;
        for i in 0..pieces.len() {
            if pieces[i].len() > 0 {
                pieces[kept_count] = pieces[i];
                kept_count += 1;
            }
        }
        (kept_count, is_full)
    }

    fn begin(&mut self, pieces: &[Piece], variance: f64) {
        self.costs.clear(pieces.len());
        for (i, piece) in pieces.iter().enumerate() {
            let next = pieces.get(i + 1);
            self.before[i] = if i == 0 { NO_PIECE } else { i as u16 - 1 };
            self.after[i] = if next.is_none() { NO_PIECE } else { i as u16 + 1 };
            self.costs.initialize(i, next.map_or(f64::INFINITY, |next| piece.join_cost(next, variance)));
        }
        self.costs.build();
    }

    /// Returns the index of the piece with the lowest cost of dropping it, if this cost is less than `price`.
    fn worst(&self, pieces: &[Piece], loss: f64, price: f64) -> Option<usize> {
        // A piece has at least two rays, so dropping it cannot cost less.
        if price <= 2.0 * loss {
            return None;
        }
        let cost = |i: &usize| pieces[*i].len() as f64 * loss - pieces[*i].error;
        let remaining = (0..pieces.len()).filter(|&i| pieces[i].len() > 0);
        remaining.min_by(|a, b| cost(a).total_cmp(&cost(b))).filter(|worst| cost(worst) < price)
    }

    fn drop_piece(&mut self, pieces: &mut [Piece], i: usize) {
        let (back, next) = (self.before[i], self.after[i]);
        if back != NO_PIECE {
            let back = usize::from(back);
            self.after[back] = next;
            pieces[back].is_last = true;
            self.costs.set(back, f64::INFINITY);
        }
        if next != NO_PIECE {
            self.before[usize::from(next)] = back;
        }
        pieces[i].end = pieces[i].first;
        self.costs.set(i, f64::INFINITY);
    }

    /// Joins the piece `at` with the next one.
    fn join_at(&mut self, pieces: &mut [Piece], at: usize, variance: f64) {
        let removed = usize::from(self.after[at]);
        pieces[at] = pieces[at].joined(&pieces[removed]);
        pieces[removed].end = pieces[removed].first;
        self.after[at] = self.after[removed];
        self.costs.set(removed, f64::INFINITY);
        let mut price = f64::INFINITY;
        if self.after[at] != NO_PIECE {
            let next = usize::from(self.after[at]);
            self.before[next] = at as u16;
            price = pieces[at].join_cost(&pieces[next], variance);
        }
        self.costs.set(at, price);
        if self.before[at] != NO_PIECE {
            let back = usize::from(self.before[at]);
            self.costs.set(back, pieces[back].join_cost(&pieces[at], variance));
        }
    }
}

/// Tournament tree: finds the minimum of some numbers. If a single number changes, the tree is updated quickly.
struct TournamentTree {
    values: Box<[f64]>,
    /// For each inner node, the index of the smallest number below the node. The root is node 1, and the children of
    /// node n are the nodes 2n and 2n + 1. The numbers are the leaves, from node `size` on.
    winners: Box<[u16]>,
    /// Number of leaves, a power of two.
    size: usize,
}

impl TournamentTree {
    /// Creates a tree for at most half as many numbers as `beams`, but at least one number.
    fn new(beams: usize) -> TournamentTree {
        let beams = beams.max(1);
        let values = vec![f64::INFINITY; beams].into();
        let winners = vec![0; beams].into();
        TournamentTree { values, winners, size: 1 }
    }

    /// Starts with `count` numbers, all infinite.
    fn clear(&mut self, count: usize) {
        self.size = count.next_power_of_two();
        self.values[..self.size].fill(f64::INFINITY);
    }

    /// Sets a number before the tree is built.
    fn initialize(&mut self, i: usize, value: f64) {
        self.values[i] = value;
    }

    /// Builds the tree.
    fn build(&mut self) {
        for node in (1..self.size).rev() {
            self.update_winner(node);
        }
    }

    /// Sets the number with the index `i`, and updates the tree.
    fn set(&mut self, i: usize, value: f64) {
        self.values[i] = value;
        let mut node = (self.size + i) / 2;
        while node > 0 {
            self.update_winner(node);
            node /= 2;
        }
    }

    /// Returns the index of the minimum, and the minimum.
    fn minimum(&self) -> (usize, f64) {
        let i = self.winner(1);
        (i, self.values[i])
    }

    fn winner(&self, node: usize) -> usize {
        if node >= self.size { node - self.size } else { self.winners[node].into() }
    }

    fn update_winner(&mut self, node: usize) {
        let (left, right) = (self.winner(2 * node), self.winner(2 * node + 1));
        let smaller = if self.values[left] <= self.values[right] { left } else { right };
        self.winners[node] = smaller as u16;
    }
}

/// Moves each cut to where it costs least. Returns whether any cut moved.
fn move_cuts(pieces: &mut [Piece], rays: &[Ray]) -> bool {
    let mut moved = false;
    for i in 1..pieces.len() {
        let (left, right) = (pieces[i - 1], pieces[i]);
        if left.is_last {
            continue;
        }
        if let Some((cut, sums)) = best_cut(rays, &left, &right) {
            pieces[i - 1] = Piece { end: cut, sums: sums.0, error: sums.0.error(), ..left };
            pieces[i] = Piece { first: cut, sums: sums.1, error: sums.1.error(), ..right };
            moved = true;
        }
    }
    moved
}

/// Moves all cuts in rounds until no cut moves any more, at most `rounds` times.
fn move_cuts_until_stable(pieces: &mut [Piece], rays: &[Ray], rounds: usize) {
    for _ in 0..rounds {
        if !move_cuts(pieces, rays) {
            break;
        }
    }
}

/// Joins the two pieces that are cheapest to join, and cuts another piece in two where this helps most. Repeats this as
/// long as it lowers the cost, at most once per piece.
fn exchange(pieces: &mut [Piece], rays: &[Ray], bounds: &Bounds) {
    let min_points = bounds.min_points.max(2);
    for _ in 0..pieces.len() {
        // Find the piece for which a cut in two helps most.
        let mut best = (0.0, 0, 0, (Sums::default(), Sums::default()));
        for (i, piece) in pieces.iter().enumerate() {
            if piece.len() < 2 * min_points || piece.error <= best.0 {
                continue;
            }
            let (cut, sums, error) = halves(rays, piece, min_points);
            if piece.error - error > best.0 {
                best = (piece.error - error, i, cut, sums);
            }
        }
        let (gain, split, cut, sums) = best;
        // Find the two neighboring pieces that are cheapest to join. Neither may be the piece that will be cut.
        let mut cheapest = (f64::INFINITY, 0);
        for i in 1..pieces.len() {
            let price = pieces[i - 1].join_cost(&pieces[i], bounds.variance);
            if price < cheapest.0 && i - 1 != split && i != split {
                cheapest = (price, i - 1);
            }
        }
        let (price, join) = cheapest;
        if gain <= price * 1.000_001 {
            break;
        }
        let piece = pieces[split];
        let left = Piece { end: cut, sums: sums.0, error: sums.0.error(), is_last: false, ..piece };
        let right = Piece { first: cut, sums: sums.1, error: sums.1.error(), ..piece };
        pieces[join] = pieces[join].joined(&pieces[join + 1]);
        // Joining has freed a slot in the list. Move the slot next to the piece that is cut, for its second half.
        let at = if join < split {
            pieces[join + 1..split].rotate_left(1);
            split - 1
        } else {
            pieces[split + 1..join + 2].rotate_right(1);
            split
        };
        (pieces[at], pieces[at + 1]) = (left, right);
        move_cuts_until_stable(pieces, rays, MAX_ROUNDS);
    }
}

/// Drops rays at the ends of pieces, the ray with the highest cost first, as long as this ray costs more than three
/// times the mean of all rays.
fn trim(pieces: &mut [Piece], rays: &[Ray], bounds: &Bounds) {
    let count: usize = pieces.iter().map(Piece::len).sum();
    let mut error: f64 = pieces.iter().map(|piece| piece.error).sum();
    for left in 0..bounds.trimmed {
        let mut best = (3.0 * error / (count - left).max(1) as f64, None);
        for (i, piece) in pieces.iter().enumerate() {
            if piece.len() <= bounds.min_points.max(2) || piece.error <= best.0 {
                continue;
            }
            for at in [piece.first, piece.end - 1] {
                let sums = piece.sums - Sums::one(&rays[at]);
                let gain = piece.error - sums.error();
                if gain > best.0 {
                    best = (gain, Some((i, at, sums)));
                }
            }
        }
        let (gain, Some((i, at, sums))) = best else { break };
        error -= gain;
        let piece = &mut pieces[i];
        (piece.sums, piece.error) = (sums, sums.error());
        if at == piece.first { piece.first += 1 } else { piece.end -= 1 }
    }
}

/// Returns the best cut of a piece into two parts of at least `min_points` rays each: the index of the cut, the sums of
/// both parts, and the sum of their errors.
fn halves(rays: &[Ray], piece: &Piece, min_points: usize) -> (usize, (Sums, Sums), f64) {
    let mut best = (piece.first, (Sums::default(), Sums::default()), f64::INFINITY);
    let mut left = Sums::of(&rays[piece.first..piece.first + min_points - 1]);
    for cut in piece.first + min_points..=piece.end - min_points {
        left = left + Sums::one(&rays[cut - 1]);
        let right = piece.sums - left;
        let error = left.error() + right.error();
        if error < best.2 {
            best = (cut, (left, right), error);
        }
    }
    best
}

/// Returns the best cut between two pieces, and the sums of both pieces then. Returns `None` if no other cut costs less
/// than the current one.
fn best_cut(rays: &[Ray], left: &Piece, right: &Piece) -> Option<(usize, (Sums, Sums))> {
    let here = left.error + right.error;
    let mut best = (here * 0.999_999 - 1e-12, None);
    let (mut l, mut r) = (left.sums, right.sums);
    for cut in (left.first + 2..left.end).rev() {
        let one = Sums::one(&rays[cut]);
        (l, r) = (l - one, r + one);
        let error = l.error() + r.error();
        if error < best.0 {
            best = (error, Some((cut, (l, r))));
        }
    }
    (l, r) = (left.sums, right.sums);
    for cut in right.first + 1..right.end - 1 {
        let one = Sums::one(&rays[cut - 1]);
        (l, r) = (l + one, r - one);
        let error = l.error() + r.error();
        if error < best.0 {
            best = (error, Some((cut, (l, r))));
        }
    }
    best.1
}

/// Maximum number of rounds in which cuts are moved after an exchange. Usually, no cut moves any more after fewer
/// rounds.
const MAX_ROUNDS: usize = 8;
