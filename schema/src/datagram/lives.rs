//! The lives of gateways that are told apart: which of them go on, and which one is given up when there is no room for
//! another. Refuses to know what came in them.

/// The most lives of gateways that are told apart.
pub const LIVES: usize = 64;

/// Gateway and epoch.
pub(super) type Life = (u64, u32);

/// Of each gateway the greatest epoch that was taken, which goes on, and smaller ones, which are retired.
pub(super) struct Lives {
    /// The retired ones in the order in which they were, behind them those that go on.
    all: [Life; LIVES],
    retired: usize,
    count: usize,
}

impl Lives {
    /// None.
    pub(super) fn new() -> Lives {
        Lives { all: [(0, 0); LIVES], retired: 0, count: 0 }
    }

    /// It was taken and not given up.
    pub(super) fn contains(&self, life: Life) -> bool {
        self.all[..self.count].contains(&life)
    }

    /// A greater epoch of the same gateway was taken. So it is of one that was given up: the greatest never is.
    pub(super) fn is_over(&self, (hub, epoch): Life) -> bool {
        self.going_on().iter().any(|&(known, greatest)| known == hub && greatest > epoch)
    }

    /// Whether one can be given up, when `life` is taken.
    pub(super) fn can_give_up(&self, (hub, epoch): Life) -> bool {
        self.retired > 0 || self.going_on().iter().any(|&(known, older)| known == hub && older < epoch)
    }

    /// There is no place for one more.
    pub(super) fn is_full(&self) -> bool {
        self.count == LIVES
    }

    /// Takes `life`, which is not over and not there, and retires the one of its gateway that went on until now. Then
    /// there is room, or one to give up: the caller has looked. Answers what was given up.
    pub(super) fn take(&mut self, life: Life) -> Option<Life> {
        if let Some(at) = self.going_on().iter().position(|&(hub, _)| hub == life.0) {
            self.all[self.retired..=self.retired + at].rotate_right(1);
            self.retired += 1;
        }
        let given_up = if self.is_full() { self.give_up() } else { None };
        self.all[self.count] = life;
        self.count += 1;
        given_up
    }

    /// Forgets the one that has been retired longest, if any is.
    pub(super) fn give_up(&mut self) -> Option<Life> {
        if self.retired == 0 {
            return None;
        }
        self.all[..self.count].rotate_left(1);
        self.count -= 1;
        self.retired -= 1;
        Some(self.all[self.count])
    }

    fn going_on(&self) -> &[Life] {
        &self.all[self.retired..self.count]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_retired_one_is_given_up() {
        let mut lives = Lives::new();
        for life in [(1, 5), (2, 5), (3, 5), (2, 6), (1, 9), (2, 7)] {
            assert_eq!(lives.take(life), None);
        }
        assert!(lives.contains((2, 5)) && lives.is_over((1, 8)) && !lives.is_over((1, 9)));
        assert_eq!([(); 4].map(|()| lives.give_up()), [Some((2, 5)), Some((1, 5)), Some((2, 6)), None]);
        assert!(lives.is_over((2, 6)) && !lives.contains((2, 6)), "its gateway goes on with a greater epoch");
        assert!(lives.contains((1, 9)) && lives.contains((2, 7)) && lives.contains((3, 5)));
    }

    #[test]
    fn who_starts_again_makes_its_own_room() {
        let mut lives = Lives::new();
        for hub in 0..LIVES as u64 {
            assert!(!lives.is_full());
            assert_eq!(lives.take((hub, 1)), None);
        }
        assert!(lives.is_full() && !lives.can_give_up((99, 1)) && lives.can_give_up((7, 2)));
        assert_eq!(lives.take((7, 2)), Some((7, 1)));
        assert!(lives.is_full() && lives.is_over((7, 1)) && !lives.can_give_up((7, 2)));
    }
}
