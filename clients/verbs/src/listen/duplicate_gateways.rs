//! Two gateways that send under one number in two epochs, as those of two machines made from one disk image do: the
//! datagrams of the one that began first are refused, for as long as both send. (Those of one epoch the account keeps
//! apart.) Told apart from a gateway that was started anew, of whose life before something comes late. Time is an argument;
//! refuses to know why a datagram is refused.

use std::time::{Duration, Instant};

use schema::datagram::LIVES;

/// The gateways of which something was refused as of a life that is over.
#[derive(Default)]
pub(super) struct DuplicateGateways(Vec<Duplicate>);

struct Duplicate {
    hub: u64,
    since: Instant,
    /// Refused datagrams behind one that was taken.
    turns: u32,
    /// Its last datagram was taken.
    is_taken: bool,
    is_told: bool,
}

/// So many turns, over so long, are no remains of a life that is over.
const TURNS: u32 = 8;
const SPAN: Duration = Duration::from_secs(3);
/// Turns are counted anew after so long: each start of a gateway may give some.
const WINDOW: Duration = Duration::from_secs(30);

impl DuplicateGateways {
    /// A datagram of `hub` was taken.
    pub(super) fn taken(&mut self, hub: u64) {
        if let Some(duplicate) = self.of(hub) {
            duplicate.is_taken = true;
        }
    }

    /// A datagram of `hub` was refused as of a life that is over; whether it is known now that there are two of it, which
    /// is said once.
    pub(super) fn refused(&mut self, hub: u64, now: Instant) -> bool {
        let Some(duplicate) = self.of(hub) else {
            // Whoever can send can invent hubs: the oldest makes room.
            if self.0.len() == LIVES {
                self.0.remove(0);
            }
            self.0.push(Duplicate { hub, since: now, turns: 0, is_taken: false, is_told: false });
            return false;
        };
        if now - duplicate.since >= WINDOW {
            (duplicate.since, duplicate.turns) = (now, 0);
        }
        duplicate.turns += u32::from(std::mem::take(&mut duplicate.is_taken));
        let is_new = duplicate.turns >= TURNS && now - duplicate.since >= SPAN && !duplicate.is_told;
        duplicate.is_told |= is_new;
        is_new
    }

    fn of(&mut self, hub: u64) -> Option<&mut Duplicate> {
        self.0.iter_mut().find(|duplicate| duplicate.hub == hub)
    }
}

/// What to do about the gateway that is called `hub`.
pub(super) fn remedy(hub: &str) -> String {
    format!(
        "two gateways send as {hub}, and what one of them sends is refused: was one machine made from a copy of the \
         other's disk? Remove the files gateway-* in the state directory of one of them \
         (~/.local/state/scanhub, or what XDG_STATE_HOME or its service says) and start its gateway again"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each datagram of hub 7 that is taken is followed by one that is refused, `every` so long, `count` times; when that
    /// was told.
    fn told(duplicates: &mut DuplicateGateways, begin: Instant, every: Duration, count: u32) -> Vec<u32> {
        let turn = |n: &u32| {
            duplicates.taken(7);
            duplicates.taken(8);
            duplicates.refused(7, begin + every * *n)
        };
        (0..count).filter(turn).collect()
    }

    #[test]
    fn two_gateways_are_told_once() {
        let (mut duplicates, begin) = (DuplicateGateways::default(), Instant::now());
        assert_eq!(told(&mut duplicates, begin, Duration::from_millis(100), 1000), [30]);
        let mut seldom = DuplicateGateways::default();
        assert_eq!(told(&mut seldom, begin, Duration::from_secs(1), 1000), [8]);
    }

    #[test]
    fn what_comes_late_of_a_life_that_is_over_is_not_another_gateway() {
        let (mut duplicates, begin) = (DuplicateGateways::default(), Instant::now());
        assert!(told(&mut duplicates, begin, Duration::from_millis(1), 1000).is_empty(), "a start anew");
        let later = begin + Duration::from_secs(3600);
        assert!(told(&mut duplicates, later, Duration::from_millis(1), 1000).is_empty(), "and another one");
        // One that was sent back in time, and is alone.
        let mut alone = DuplicateGateways::default();
        assert!((0..1000).all(|n| !alone.refused(7, begin + Duration::from_millis(100) * n)));
    }
}
