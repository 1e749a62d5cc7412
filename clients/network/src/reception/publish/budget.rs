//! Shared memory that remote sensors may use together. Each part of it returns to the budget when its topic is removed.

use std::cell::Cell;
use std::rc::Rc;

/// Bytes of shared memory, and the number of those in use.
#[derive(Debug)]
pub(super) struct Budget {
    bytes: u64,
    used: Cell<u64>,
}

/// Part of a budget that is in use. Dropping it returns it.
#[derive(Debug)]
pub(super) struct Share {
    budget: Rc<Budget>,
    bytes: u64,
}

impl Budget {
    /// Creates a budget of this number of bytes.
    pub(super) fn new(bytes: u64) -> Budget {
        Budget { bytes, used: Cell::new(0) }
    }

    /// Returns whether `bytes` are left.
    pub(super) fn has(&self, bytes: u64) -> bool {
        self.used.get().saturating_add(bytes) <= self.bytes
    }

    /// Takes `bytes`. The caller has checked that they are left.
    pub(super) fn take(self: &Rc<Budget>, bytes: u64) -> Share {
        self.used.set(self.used.get() + bytes);
        Share { budget: self.clone(), bytes }
    }
}

impl Share {
    /// Returns its size.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        self.budget.used.set(self.budget.used.get() - self.bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn share_returns_to_the_budget() {
        let budget = Rc::new(Budget::new(100));
        let shares = [budget.take(60), budget.take(40)];
        assert!(budget.has(0) && !budget.has(1));
        let [first, second] = shares;
        drop(first);
        assert!(budget.has(60) && !budget.has(61) && !budget.has(u64::MAX));
        assert_eq!(second.bytes(), 40);
    }
}
