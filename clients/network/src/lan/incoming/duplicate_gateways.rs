//! Two gateways that send under one number in two epochs, as those of two machines made from one disk image do: the
//! datagrams of the one that began first are refused, for as long as both send. (Those of one epoch the account keeps
//! apart.) Told apart from a gateway that was started anew, of whose life before something comes late. Time is an argument;
//! refuses to know why a datagram is refused.

use crate::lan::LIVES;

/// The gateways of which something was refused as of a life that is over.
#[derive(Default)]
pub(super) struct DuplicateGateways(Vec<Duplicate>);

struct Duplicate {
    hub: u64,
    since_ns: u64,
    /// Refused datagrams behind one that was taken.
    turns: u32,
    /// Its last datagram was taken.
    is_taken: bool,
    is_told: bool,
}

/// So many turns, over so long, are no remains of a life that is over.
const TURNS: u32 = 8;
const SPAN_NS: u64 = 3_000_000_000;
/// Turns are counted anew after so long: each start of a gateway may give some.
const WINDOW_NS: u64 = 30_000_000_000;

impl DuplicateGateways {
    /// A datagram of `hub` was taken.
    pub(super) fn taken(&mut self, hub: u64) {
        if let Some(duplicate) = self.of(hub) {
            duplicate.is_taken = true;
        }
    }

    /// A datagram of `hub` was refused as of a life that is over; whether it is known now that there are two of it, which
    /// is said once.
    pub(super) fn refused(&mut self, hub: u64, now_ns: u64) -> bool {
        let Some(duplicate) = self.of(hub) else {
            // Whoever can send can invent hubs: the oldest makes room.
            if self.0.len() == LIVES {
                self.0.remove(0);
            }
            self.0.push(Duplicate { hub, since_ns: now_ns, turns: 0, is_taken: false, is_told: false });
            return false;
        };
        if now_ns.saturating_sub(duplicate.since_ns) >= WINDOW_NS {
            (duplicate.since_ns, duplicate.turns) = (now_ns, 0);
        }
        duplicate.turns += u32::from(std::mem::take(&mut duplicate.is_taken));
        let is_long = now_ns.saturating_sub(duplicate.since_ns) >= SPAN_NS;
        let is_new = duplicate.turns >= TURNS && is_long && !duplicate.is_told;
        duplicate.is_told |= is_new;
        is_new
    }

    fn of(&mut self, hub: u64) -> Option<&mut Duplicate> {
        self.0.iter_mut().find(|duplicate| duplicate.hub == hub)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each datagram of hub 7 that is taken is followed by one that is refused, `every` so long, `count` times; when that
    /// was told.
    fn told(duplicates: &mut DuplicateGateways, begin_ms: u64, every_ms: u64, count: u64) -> Vec<u64> {
        let turn = |n: &u64| {
            duplicates.taken(7);
            duplicates.taken(8);
            duplicates.refused(7, (begin_ms + every_ms * *n) * 1_000_000)
        };
        (0..count).filter(turn).collect()
    }

    #[test]
    fn two_gateways_are_told_once() {
        let mut duplicates = DuplicateGateways::default();
        assert_eq!(told(&mut duplicates, 0, 100, 1000), [30]);
        let mut seldom = DuplicateGateways::default();
        assert_eq!(told(&mut seldom, 0, 1000, 1000), [8]);
    }

    #[test]
    fn what_comes_late_of_a_life_that_is_over_is_not_another_gateway() {
        let mut duplicates = DuplicateGateways::default();
        assert!(told(&mut duplicates, 0, 1, 1000).is_empty(), "a start anew");
        assert!(told(&mut duplicates, 3_600_000, 1, 1000).is_empty(), "and another one");
        // One that was sent back in time, and is alone.
        let mut alone = DuplicateGateways::default();
        assert!((0..1000).all(|n| !alone.refused(7, 100_000_000 * n)));
    }
}
