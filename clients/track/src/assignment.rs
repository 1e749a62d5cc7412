//! Which leg belongs to which place, so that all together fit best. Legs and places that nobody else wants are given at once;
//! those that compete go to a solver. Refuses to know what legs are.

use pathfinding::matrix::Matrix;
use pathfinding::prelude::kuhn_munkres;

/// A leg that may belong to a place.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Edge {
    pub(crate) leg: usize,
    pub(crate) place: usize,
    /// More than 0: how much better this is than leaving both alone.
    pub(crate) gain: f64,
}

/// The memory of an assignment.
#[derive(Default)]
pub(crate) struct Assignment {
    /// Number of the group of each leg, and of each place behind them.
    group: Vec<usize>,
    legs: Vec<usize>,
    places: Vec<usize>,
    order: Vec<usize>,
}

impl Assignment {
    /// Appends to `pairs` each leg with its place, so that the sum of the gains is the greatest.
    pub(crate) fn solve(
        &mut self,
        (legs, places): (usize, usize),
        edges: &mut [Edge],
        pairs: &mut Vec<(usize, usize)>,
    ) {
        self.group.clear();
        self.group.extend(0..legs + places);
        for edge in &*edges {
            let (a, b) = (self.root(edge.leg), self.root(legs + edge.place));
            self.group[a.max(b)] = a.min(b);
        }
        self.order.clear();
        for edge in &*edges {
            let root = self.root(edge.leg);
            self.order.push(root);
        }
        // By group, in the order in which they came.
        let mut done = 0;
        while done < edges.len() {
            let Some(group) = self.order.iter().copied().filter(|&group| group != usize::MAX).min() else {
                break;
            };
            let mine = |order: &[usize]| order.iter().filter(|&&one| one == group).count();
            let count = mine(&self.order);
            done += count;
            let of_group = (0..edges.len()).filter(|&i| self.order[i] == group);
            if count == 1 {
                pairs.extend(of_group.map(|i| (edges[i].leg, edges[i].place)));
            } else {
                self.legs.clear();
                self.places.clear();
                for i in of_group {
                    if !self.legs.contains(&edges[i].leg) {
                        self.legs.push(edges[i].leg);
                    }
                    if !self.places.contains(&edges[i].place) {
                        self.places.push(edges[i].place);
                    }
                }
                self.compete(edges, group, pairs);
            }
            self.order.iter_mut().filter(|one| **one == group).for_each(|one| *one = usize::MAX);
        }
    }

    fn compete(&self, edges: &[Edge], group: usize, pairs: &mut Vec<(usize, usize)>) {
        // The solver wants at least as many columns as rows.
        let turn = self.legs.len() > self.places.len();
        let (rows, columns) = if turn { (&self.places, &self.legs) } else { (&self.legs, &self.places) };
        let mut weights = Matrix::new(rows.len(), columns.len(), 0_i64);
        for (edge, _) in edges.iter().zip(&self.order).filter(|(_, of)| **of == group) {
            let (row, column) = if turn { (edge.place, edge.leg) } else { (edge.leg, edge.place) };
            let place = |list: &[usize], what| list.iter().position(|&one| one == what);
            if let (Some(row), Some(column)) = (place(rows, row), place(columns, column)) {
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

    /// Elements for which there is memory.
    #[cfg(test)]
    pub(crate) fn capacity(&self) -> usize {
        self.group.capacity() + self.legs.capacity() + self.places.capacity() + self.order.capacity()
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

    /// The slow way: each leg with each place that is free, or with none.
    fn best(edges: &[Edge], leg: usize, legs: usize, taken: u32) -> f64 {
        if leg == legs {
            return 0.0;
        }
        let free = edges.iter().filter(|edge| edge.leg == leg && taken >> edge.place & 1 == 0);
        let with = free.map(|edge| edge.gain + best(edges, leg + 1, legs, taken | 1 << edge.place));
        with.fold(best(edges, leg + 1, legs, taken), f64::max)
    }

    #[test]
    fn the_sum_is_the_greatest() {
        let mut random = fastrand::Rng::with_seed(1);
        let mut assignment = Assignment::default();
        for _ in 0..400 {
            let (legs, places) = (random.usize(1..7), random.usize(1..7));
            let mut edges = Vec::new();
            for leg in 0..legs {
                for place in 0..places {
                    if random.f64() < 0.4 {
                        edges.push(Edge { leg, place, gain: 0.01 + 10.0 * random.f64() });
                    }
                }
            }
            let mut pairs = Vec::new();
            assignment.solve((legs, places), &mut edges, &mut pairs);
            let gain = |&(leg, place): &(usize, usize)| {
                edges.iter().find(|edge| (edge.leg, edge.place) == (leg, place)).unwrap().gain
            };
            let sum: f64 = pairs.iter().map(gain).sum();
            assert!((sum - best(&edges, 0, legs, 0)).abs() < 1e-4, "{edges:?}");
            for (i, one) in pairs.iter().enumerate() {
                assert!(pairs[..i].iter().all(|other| other.0 != one.0 && other.1 != one.1));
            }
        }
    }
}
