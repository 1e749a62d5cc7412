//! Assigns detected legs to expected positions of legs, so that the sum of the gains is maximal. A leg and a position
//! that have no alternatives are assigned at once. A solver assigns the others.

use pathfinding::matrix::Matrix;
use pathfinding::prelude::kuhn_munkres;

/// A leg that may belong to an expected position.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Edge {
    pub(crate) leg: usize,
    pub(crate) target: usize,
    /// Gain compared with leaving the leg and the position unassigned. It is always positive.
    pub(crate) gain: f64,
}

/// Solver of assignments, with its buffers.
#[derive(Default)]
pub(crate) struct Assignment {
    /// Group of each leg, followed by the group of each position. Edges connect the legs and positions of a group.
    group: Vec<usize>,
    legs: Vec<usize>,
    targets: Vec<usize>,
    /// Group and index of each edge, sorted.
    order: Vec<(usize, usize)>,
}

impl Assignment {
    /// Adds each assigned leg with its position to `pairs`, so that the sum of the gains is maximal.
    pub(crate) fn solve(
        &mut self,
        (legs, targets): (usize, usize),
        edges: &[Edge],
        pairs: &mut Vec<(usize, usize)>,
    ) {
        self.group.clear();
        self.group.extend(0..legs + targets);
        for edge in edges {
            let (a, b) = (self.root(edge.leg), self.root(legs + edge.target));
            self.group[a.max(b)] = a.min(b);
        }
        self.order.clear();
        for (i, edge) in edges.iter().enumerate() {
            let root = self.root(edge.leg);
            self.order.push((root, i));
        }
        // Sort by group, and within a group in the order of the edges.
        self.order.sort_unstable();
        let order = std::mem::take(&mut self.order);
        for group in order.chunk_by(|a, b| a.0 == b.0) {
            if let &[(_, alone)] = group {
                pairs.push((edges[alone].leg, edges[alone].target));
                continue;
            }
            self.legs.clear();
            self.targets.clear();
            for &(_, i) in group {
                if !self.legs.contains(&edges[i].leg) {
                    self.legs.push(edges[i].leg);
                }
                if !self.targets.contains(&edges[i].target) {
                    self.targets.push(edges[i].target);
                }
            }
            self.compete(edges, group, pairs);
        }
        self.order = order;
    }

    fn compete(&self, edges: &[Edge], group: &[(usize, usize)], pairs: &mut Vec<(usize, usize)>) {
        // The most frequent case: two legs of one person.
        if let (&[leg, other_leg], &[target, other_target]) = (&self.legs[..], &self.targets[..]) {
            let find = |leg: usize, target: usize| {
                group.iter().map(|&(_, i)| &edges[i]).find(|one| (one.leg, one.target) == (leg, target))
            };
            let straight = [find(leg, target), find(other_leg, other_target)];
            let crossed = [find(leg, other_target), find(other_leg, target)];
            let gain = |two: &[Option<&Edge>; 2]| two.iter().flatten().map(|edge| edge.gain).sum::<f64>();
            let best = if gain(&crossed) > gain(&straight) { crossed } else { straight };
            pairs.extend(best.into_iter().flatten().map(|edge| (edge.leg, edge.target)));
            return;
        }
        // The solver requires at least as many columns as rows.
        let turn = self.legs.len() > self.targets.len();
        let (rows, columns) = if turn { (&self.targets, &self.legs) } else { (&self.legs, &self.targets) };
        let mut weights = Matrix::new(rows.len(), columns.len(), 0_i64);
        for edge in group.iter().map(|&(_, i)| &edges[i]) {
            let (row, column) = if turn { (edge.target, edge.leg) } else { (edge.leg, edge.target) };
            let index_in = |list: &[usize], what| list.iter().position(|&one| one == what);
            if let (Some(row), Some(column)) = (index_in(rows, row), index_in(columns, column)) {
                weights[(row, column)] = (edge.gain * 1e6) as i64;
            }
        }
        let (_, columns_of) = kuhn_munkres(&weights);
        for (row, column) in columns_of.into_iter().enumerate() {
            if weights[(row, column)] > 0 {
                let (row, column) = (rows[row], columns[column]);
                pairs.push(if turn { (column, row) } else { (row, column) });
            }
        }
    }

    /// Returns the number of elements for which memory is allocated.
    #[cfg(test)]
    pub(crate) fn capacity(&self) -> usize {
        self.group.capacity() + self.legs.capacity() + self.targets.capacity() + self.order.capacity()
    }

    fn root(&mut self, mut one: usize) -> usize {
        while self.group[one] != one {
            self.group[one] = self.group[self.group[one]];
            one = self.group[one];
        }
        one
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the maximum sum of the gains of `leg` and the legs after it. Tries each leg with each free position, and
    /// without a position. Bit i of `taken` is set if position i is not free.
    fn best(edges: &[Edge], leg: usize, legs: usize, taken: u32) -> f64 {
        if leg == legs {
            return 0.0;
        }
        let free = edges.iter().filter(|edge| edge.leg == leg && taken >> edge.target & 1 == 0);
        let with = free.map(|edge| edge.gain + best(edges, leg + 1, legs, taken | 1 << edge.target));
        with.fold(best(edges, leg + 1, legs, taken), f64::max)
    }

    #[test]
    fn assignment_has_the_greatest_total_gain() {
        let mut random = fastrand::Rng::with_seed(1);
        let mut assignment = Assignment::default();
        for _ in 0..400 {
            let (legs, targets) = (random.usize(1..7), random.usize(1..7));
            let mut edges = Vec::new();
            for leg in 0..legs {
                for target in 0..targets {
                    if random.f64() < 0.4 {
                        edges.push(Edge { leg, target, gain: 0.01 + 10.0 * random.f64() });
                    }
                }
            }
            let mut pairs = Vec::new();
            assignment.solve((legs, targets), &edges, &mut pairs);
            let gain = |&(leg, target): &(usize, usize)| {
                edges.iter().find(|edge| (edge.leg, edge.target) == (leg, target)).unwrap().gain
            };
            let sum: f64 = pairs.iter().map(gain).sum();
            assert!((sum - best(&edges, 0, legs, 0)).abs() < 1e-4, "{edges:?}");
            for (i, one) in pairs.iter().enumerate() {
                assert!(pairs[..i].iter().all(|other| other.0 != one.0 && other.1 != one.1));
            }
        }
    }
}
