//! Moves the cuts between pieces to where they cost least, takes a cut from where it helps least to where it helps most,
//! and leaves out rays at ends that fit worst. The number of pieces stays. Refuses to know what decided on it.

use super::cut::Bounds;
use super::fit::{Ray, Sums};
use super::piece::Piece;

/// Moves each cut to where it costs least; whether any moved.
pub(super) fn slide(pieces: &mut [Piece], rays: &[Ray]) -> bool {
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

/// Slides, in rounds, until nothing moves or it has been done often enough.
pub(super) fn settle(pieces: &mut [Piece], rays: &[Ray], rounds: usize) {
    for _ in 0..rounds {
        if !slide(pieces, rays) {
            break;
        }
    }
}

/// Takes a cut from where it helps least to where it helps most, while that helps, at most once for each piece.
pub(super) fn exchange(pieces: &mut [Piece], rays: &[Ray], bounds: &Bounds) {
    let least = bounds.min_points.max(2);
    for _ in 0..pieces.len() {
        // The piece whose cut in two helps most.
        let mut best = (0.0, 0, 0, (Sums::default(), Sums::default()));
        for (i, piece) in pieces.iter().enumerate() {
            if piece.len() < 2 * least || piece.error <= best.0 {
                continue;
            }
            let (cut, sums, error) = halves(rays, piece, least);
            if piece.error - error > best.0 {
                best = (piece.error - error, i, cut, sums);
            }
        }
        let (gain, split, cut, sums) = best;
        // The two neighbours that are joined at the least price, neither of them the one to be cut.
        let mut cheapest = (f64::INFINITY, 0);
        for i in 1..pieces.len() {
            let price = pieces[i - 1].price(&pieces[i], bounds.variance);
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
        // The place that joining has left free goes to where a second half is to stand.
        let at = if join < split {
            pieces[join + 1..split].rotate_left(1);
            split - 1
        } else {
            pieces[split + 1..join + 2].rotate_right(1);
            split
        };
        (pieces[at], pieces[at + 1]) = (left, right);
        settle(pieces, rays, SETTLED);
    }
}

/// More rounds than cuts take to settle.
const SETTLED: usize = 8;

/// Leaves out rays at the ends of pieces, that which costs most first, if it costs more than three rays on average.
pub(super) fn trim(pieces: &mut [Piece], rays: &[Ray], bounds: &Bounds) {
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

/// Where to cut a piece in two, of at least so many rays each, so that it costs least.
fn halves(rays: &[Ray], piece: &Piece, least: usize) -> (usize, (Sums, Sums), f64) {
    let mut best = (piece.first, (Sums::default(), Sums::default()), f64::INFINITY);
    let mut left = Sums::of(&rays[piece.first..piece.first + least - 1]);
    for cut in piece.first + least..=piece.end - least {
        left = left + Sums::one(&rays[cut - 1]);
        let right = piece.sums - left;
        let error = left.error() + right.error();
        if error < best.2 {
            best = (cut, (left, right), error);
        }
    }
    best
}

/// Where the cut between two pieces costs less than where it is.
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
