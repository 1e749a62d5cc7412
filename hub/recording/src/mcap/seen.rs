//! Remembers what was read, as long as a damaged file may repeat it. Refuses to know what it is.

use std::collections::hash_map::DefaultHasher;
use std::collections::{HashSet, VecDeque};
use std::hash::{Hash, Hasher};

/// The last [`KEPT`] pairs of bytes that it was shown.
#[derive(Debug, Default)]
pub(crate) struct Seen {
    known: HashSet<u64>,
    order: VecDeque<u64>,
}

impl Seen {
    /// Whether the pair was not there before; it is from now on.
    pub(crate) fn is_new(&mut self, head: &[u8], body: &[u8]) -> bool {
        let mut hasher = DefaultHasher::new();
        (head, body).hash(&mut hasher);
        let name = hasher.finish();
        if !self.known.insert(name) {
            return false;
        }
        self.order.push_back(name);
        if self.order.len() > KEPT
            && let Some(oldest) = self.order.pop_front()
        {
            self.known.remove(&oldest);
        }
        true
    }
}

/// Telegrams of many minutes, in less than two megabytes.
const KEPT: usize = 1 << 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_there_is_known_for_a_while() {
        let mut seen = Seen::default();
        assert!(seen.is_new(b"a", b"bc") && seen.is_new(b"ab", b"c") && !seen.is_new(b"a", b"bc"));
        for number in 0..KEPT {
            assert!(seen.is_new(&number.to_le_bytes(), b"x"));
        }
        assert!(seen.is_new(b"a", b"bc"));
        assert_eq!((seen.known.len(), seen.order.len()), (KEPT, KEPT));
    }
}
