//! The least of some numbers that change one at a time: a tree of winners. Refuses to know what they are.

/// A place for so many numbers.
pub(super) struct Least {
    values: Box<[f64]>,
    /// The winner of each match, from 1, the root; behind the matches stand the numbers themselves.
    winners: Box<[u16]>,
    size: usize,
}

impl Least {
    /// For at most half as many numbers as `beams`, or one.
    pub(super) fn new(beams: usize) -> Least {
        let beams = beams.max(1);
        let values = vec![f64::INFINITY; beams].into();
        let winners = vec![0; beams].into();
        Least { values, winners, size: 1 }
    }

    /// Begins with `count` numbers, all infinite.
    pub(super) fn begin(&mut self, count: usize) {
        self.size = count.next_power_of_two();
        self.values[..self.size].fill(f64::INFINITY);
    }

    /// Sets a number before the tree is built.
    pub(super) fn put(&mut self, i: usize, value: f64) {
        self.values[i] = value;
    }

    /// Builds the tree.
    pub(super) fn build(&mut self) {
        for node in (1..self.size).rev() {
            self.play(node);
        }
    }

    /// Sets a number.
    pub(super) fn set(&mut self, i: usize, value: f64) {
        self.values[i] = value;
        let mut node = (self.size + i) / 2;
        while node > 0 {
            self.play(node);
            node /= 2;
        }
    }

    /// Returns the least number, and which it is.
    pub(super) fn get(&self) -> (usize, f64) {
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
