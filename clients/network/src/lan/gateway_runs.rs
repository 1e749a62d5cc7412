//! The runs of gateways that a receiver distinguishes: which of them continue, which one makes room for another, and
//! which senders belong to a run.
//!
//! Anyone who can send can invent gateways. A run that is known to deliver is therefore never evicted for one that only
//! announces itself, and the run that has been silent for longest goes first.
//!
//! Each gateway has its own number, so a second gateway with the same number is a copy, for example of its disk. The
//! samples of both must not become one stream. They are distinguished by their senders and by the run of the hub
//! (`boot`) that they announce. A sender is any number that differs between two of them. Time is an argument.

use std::cmp::Ordering;

/// Maximum number of runs of gateways that are distinguished.
pub const LIVES: usize = 64;

/// Gateway and epoch of a run.
pub(super) type RunId = (u64, u32);

/// Runs of gateways. For each gateway, the highest accepted epoch is active, and lower ones are retired.
pub(super) struct GatewayRuns {
    /// The retired runs in the order in which they retired, followed by the active ones.
    all: [Place; LIVES],
    records: [Record; LIVES],
    retired: usize,
    count: usize,
}

/// A run, and the index of its record.
#[derive(Clone, Copy)]
struct Place {
    run: RunId,
    slot: usize,
}

/// State of a run.
#[derive(Clone, Copy)]
pub(super) struct Record {
    /// Time at which the run was accepted.
    since_ns: u64,
    pub(super) standing: Standing,
    pub(super) senders: Senders,
}

/// Result of looking up a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RunLookup {
    /// A higher epoch of the same gateway was accepted, and has not been evicted.
    Over,
    /// The run is active, and its record has this index.
    At(usize),
    /// No datagram of this run was accepted, or none of its gateway.
    New,
}

/// A run that was evicted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct EvictedRun {
    pub(super) run: RunId,
    /// Whether it was still active and had to make room for another run.
    pub(super) is_displaced: bool,
}

impl GatewayRuns {
    /// Creates an empty table.
    pub(super) fn new() -> GatewayRuns {
        GatewayRuns {
            all: std::array::from_fn(|slot| Place { run: (0, 0), slot }),
            records: [Record::new(0); LIVES],
            retired: 0,
            count: 0,
        }
    }

    /// Returns the time at which the run was accepted, unless it is unknown or was evicted.
    pub(super) fn since_ns(&self, run: RunId) -> Option<u64> {
        let place = self.all[..self.count].iter().find(|place| place.run == run)?;
        Some(self.records[place.slot].since_ns)
    }

    /// Compares `run` with the active run of its gateway.
    pub(super) fn find(&self, (hub, epoch): RunId) -> RunLookup {
        let Some(place) = self.going_on().iter().find(|place| place.run.0 == hub) else {
            return RunLookup::New;
        };
        match place.run.1.cmp(&epoch) {
            Ordering::Greater => RunLookup::Over,
            Ordering::Equal => RunLookup::At(place.slot),
            Ordering::Less => RunLookup::New,
        }
    }

    /// Returns the record of the run that was found at `slot`.
    pub(super) fn record(&self, slot: usize) -> &Record {
        &self.records[slot]
    }

    /// Returns the record to be changed.
    pub(super) fn record_mut(&mut self, slot: usize) -> &mut Record {
        &mut self.records[slot]
    }

    /// Returns whether a run can be evicted for `arrival`, which belongs to `run`.
    pub(super) fn can_evict(&self, run: RunId, arrival: Arrival) -> bool {
        let (hub, epoch) = run;
        let is_older = |place: &Place| place.run.0 == hub && place.run.1 < epoch;
        self.retired > 0 || self.going_on().iter().any(is_older) || self.least(run, arrival).is_some()
    }

    /// Returns whether there is no place for another run.
    pub(super) fn is_full(&self) -> bool {
        self.count == LIVES
    }

    /// Adds `run`, which is neither retired nor known, and retires the active run of its gateway. The caller has
    /// checked that there is a free place or a run that can be evicted. Returns the index of its record, and the
    /// evicted run.
    pub(super) fn take(&mut self, run: RunId, arrival: Arrival) -> (usize, Option<EvictedRun>) {
        if let Some(at) = self.going_on().iter().position(|place| place.run.0 == run.0) {
            self.all[self.retired..=self.retired + at].rotate_right(1);
            self.retired += 1;
        }
        let gone = if self.is_full() { self.evict(run, arrival) } else { None };
        let place = &mut self.all[self.count];
        place.run = run;
        self.records[place.slot] = Record::new(arrival.now_ns);
        self.count += 1;
        (place.slot, gone)
    }

    /// Evicts the run that retired first. If none is retired, evicts the active run of the lowest rank, but not `run`,
    /// to which `arrival` belongs. Returns `None` if all other runs are known to deliver, or if they have just
    /// delivered and `arrival` is not a sample.
    pub(super) fn evict(&mut self, run: RunId, arrival: Arrival) -> Option<EvictedRun> {
        let is_displaced = self.retired == 0;
        let at = if is_displaced { self.least(run, arrival)? } else { 0 };
        Some(EvictedRun { run: self.remove(at), is_displaced })
    }

    /// Removes `run`.
    pub(super) fn forget(&mut self, run: RunId) {
        if let Some(at) = self.all[..self.count].iter().position(|place| place.run == run) {
            self.remove(at);
        }
    }

    fn remove(&mut self, at: usize) -> RunId {
        self.all[at..self.count].rotate_left(1);
        self.count -= 1;
        self.retired -= usize::from(at < self.retired);
        self.all[self.count].run
    }

    /// Returns the position of the active run with the lowest rank among those that may be evicted.
    fn least(&self, run: RunId, arrival: Arrival) -> Option<usize> {
        let may_go = |at: &usize| {
            let Place { run: other, slot } = self.all[*at];
            other != run && self.records[slot].standing.may_go(arrival)
        };
        let worth = |at: &usize| self.records[self.all[*at].slot].standing.worth_ns();
        (self.retired..self.count).filter(may_go).min_by_key(worth)
    }

    fn going_on(&self) -> &[Place] {
        &self.all[self.retired..self.count]
    }
}

impl Record {
    fn new(since_ns: u64) -> Record {
        Record { since_ns, standing: Standing::NONE, senders: Senders::NONE }
    }
}

/// Kind and time of a received datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// Whether it is a sample rather than an announcement.
    pub delivers: bool,
    /// Time of arrival, in ns of a clock that is never set.
    pub now_ns: u64,
}

/// Rank of a run when there is no room for another one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Standing {
    heard_ns: u64,
    /// Times of the first and the last sample.
    delivered_ns: Option<(u64, u64)>,
}

/// Minimum time between the first and the last sample of a run that is known to deliver.
const PROVEN_NS: u64 = 1_000_000_000;
/// Time after its last sample for which a run that is known to deliver keeps its rank.
const KEPT_NS: u64 = 60_000_000_000;

impl Standing {
    /// Rank of a run from which nothing was accepted.
    pub const NONE: Standing = Standing { heard_ns: 0, delivered_ns: None };

    /// Records that a datagram was accepted.
    pub fn take(&mut self, arrival: Arrival) {
        let now_ns = arrival.now_ns;
        self.heard_ns = now_ns;
        if arrival.delivers {
            self.delivered_ns = Some((self.delivered_ns.map_or(now_ns, |(first_ns, _)| first_ns), now_ns));
        }
    }

    /// Returns whether the run may be evicted for a run that `arrival` belongs to. It may if it has not delivered for 3
    /// s. For a sample, it also may if it has delivered for less than a second.
    pub fn may_go(&self, arrival: Arrival) -> bool {
        let silent_ns = |(_, last_ns): (u64, u64)| arrival.now_ns.saturating_sub(last_ns);
        let is_busy = self.delivered_ns.is_some_and(|delivered_ns| silent_ns(delivered_ns) < SILENCE_NS);
        !is_busy || arrival.delivers && !self.is_proven()
    }

    /// Returns the time until which the run counts as active. Of the runs that may be evicted, the one with the lowest
    /// value is evicted first.
    pub fn worth_ns(&self) -> u64 {
        match self.delivered_ns {
            None => self.heard_ns,
            Some((_, last_ns)) => last_ns + if self.is_proven() { KEPT_NS } else { SILENCE_NS },
        }
    }

    /// Returns whether the run is known to deliver: a second or more passed between its first and its last sample.
    pub fn is_proven(&self) -> bool {
        self.delivered_ns.is_some_and(|(first_ns, last_ns)| last_ns.saturating_sub(first_ns) >= PROVEN_NS)
    }
}

/// Senders of one run of a gateway.
#[derive(Clone, Copy)]
pub(super) struct Senders {
    /// The first one is the sender that the run belongs to.
    all: [Sender; MAX_SENDERS],
    count: usize,
    is_shared: bool,
}

/// One sender.
#[derive(Clone, Copy, Default)]
struct Sender {
    from: u64,
    /// Runs of the hub that it has announced, the latest one first. 0 is none.
    boots: [u64; MAX_BOOTS],
    heard_ns: u64,
    announced_ns: u64,
    /// Time since which it has announced a run of the hub that the first sender does not announce.
    other_since_ns: Option<u64>,
}

/// Result of comparing a datagram's sender with the sender of the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SenderMatch {
    /// The sender belongs to this gateway.
    Own,
    /// The sender belongs to another gateway with the same number, or may do so.
    Twin,
    /// The sender is a different gateway, and the previous one is silent, so its run has ended. Not used while two
    /// gateways are known to send: samples of one would then appear under the name of the other.
    Next,
}

/// Senders that are distinguished: the sockets of the gateway, another gateway, and one for a sender that appears in
/// between.
const MAX_SENDERS: usize = 4;
/// A hub that restarts announces another run, and announcements of the previous run may arrive late.
const MAX_BOOTS: usize = 4;
/// Time without a datagram after which a sender counts as silent: three announcements.
pub(super) const SILENCE_NS: u64 = 3_000_000_000;
/// Time for which two senders announce different runs of a hub before they count as two gateways. The sockets of one
/// gateway change their run within milliseconds of each other.
const SHARED_NS: u64 = 500_000_000;

impl Senders {
    /// State before the first datagram.
    pub(super) const NONE: Senders = Senders {
        all: [Sender { from: 0, boots: [0; MAX_BOOTS], heard_ns: 0, announced_ns: 0, other_since_ns: None };
            MAX_SENDERS],
        count: 0,
        is_shared: false,
    };

    /// Returns whom a datagram of sender `from` belongs to. `boot` is the run of the hub if the datagram is an
    /// announcement. A sender that has not announced itself does not count as the same gateway.
    pub(super) fn judge(&self, from: u64, boot: Option<u64>, now_ns: u64) -> SenderMatch {
        let known = &self.all[..self.count];
        let Some(first) = known.first().filter(|first| first.from != from) else { return SenderMatch::Own };
        let announced = known.iter().find(|sender| sender.from == from).map(|sender| sender.boots[0]);
        let boot = boot.or(announced).filter(|boot| *boot != 0);
        match boot.is_some_and(|boot| first.boots.contains(&boot)) {
            true => SenderMatch::Own,
            false if first.is_silent(now_ns) && !self.is_shared => SenderMatch::Next,
            false => SenderMatch::Twin,
        }
    }

    /// Records a datagram of sender `from` that was accepted, or refused because it came from another gateway.
    pub(super) fn note(&mut self, from: u64, boot: Option<u64>, now_ns: u64) {
        let is_own = self.judge(from, boot, now_ns) == SenderMatch::Own;
        let first = self.all[0];
        let at = self.place(from);
        let sender = &mut self.all[at];
        sender.heard_ns = now_ns;
        if let Some(boot) = boot {
            sender.announce(boot, now_ns);
        }
        if at == 0 {
            return;
        }
        if is_own {
            sender.other_since_ns = None;
            if first.is_silent(now_ns) {
                // The gateway continues at another address.
                sender.boots = first.boots;
                self.all[..=at].rotate_right(1);
            }
        } else if boot.is_some() && first.boots[0] != 0 {
            let since_ns = *sender.other_since_ns.get_or_insert(now_ns);
            let is_long = now_ns.saturating_sub(since_ns) >= SHARED_NS;
            self.is_shared |= is_long && first.announced_ns > since_ns;
        }
    }

    /// Moves the gateway to the address `from`, where it has announced another run of its hub.
    pub(super) fn move_to(&mut self, from: u64, boot: u64, now_ns: u64) {
        let boots = self.all[0].boots;
        let at = self.place(from);
        self.all[at].boots = boots;
        self.all[at].announce(boot, now_ns);
        self.all[at].heard_ns = now_ns;
        self.all[at].other_since_ns = None;
        self.all[..=at].rotate_right(1);
    }

    /// Returns whether two gateways are known to send.
    pub(super) fn is_shared(&self) -> bool {
        self.is_shared
    }

    /// Returns the index of sender `from`. A new sender replaces the one that has been silent for longest, but never
    /// the first one.
    fn place(&mut self, from: u64) -> usize {
        if let Some(at) = self.all[..self.count].iter().position(|sender| sender.from == from) {
            return at;
        }
        let at = if self.count < MAX_SENDERS {
            self.count += 1;
            self.count - 1
        } else {
            (1..MAX_SENDERS).min_by_key(|&at| self.all[at].heard_ns).unwrap_or(MAX_SENDERS - 1)
        };
        self.all[at] = Sender { from, ..Sender::default() };
        at
    }
}

impl Sender {
    fn is_silent(&self, now_ns: u64) -> bool {
        now_ns.saturating_sub(self.heard_ns) >= SILENCE_NS
    }

    fn announce(&mut self, boot: u64, now_ns: u64) {
        self.announced_ns = now_ns;
        let at = self.boots.iter().position(|known| *known == boot).unwrap_or(MAX_BOOTS - 1);
        self.boots[..=at].rotate_right(1);
        self.boots[0] = boot;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn contains(runs: &GatewayRuns, run: RunId) -> bool {
        runs.since_ns(run).is_some()
    }

    const MS: u64 = 1_000_000;

    fn is_over(runs: &GatewayRuns, run: RunId) -> bool {
        runs.find(run) == RunLookup::Over
    }

    fn announces(at_ms: u64) -> Arrival {
        Arrival { delivers: false, now_ns: at_ms * MS }
    }

    fn delivers(at_ms: u64) -> Arrival {
        Arrival { delivers: true, now_ns: at_ms * MS }
    }

    /// Accepts a datagram of a known or unknown run. Returns the run that was evicted for it.
    fn hear(runs: &mut GatewayRuns, run: RunId, arrival: Arrival) -> Option<RunId> {
        let (slot, gone) = match runs.find(run) {
            RunLookup::At(slot) => (slot, None),
            _ => runs.take(run, arrival),
        };
        runs.record_mut(slot).standing.take(arrival);
        gone.map(|gone| gone.run)
    }

    #[test]
    fn the_longest_retired_one_is_given_up() {
        let mut runs = GatewayRuns::new();
        for run in [(1, 5), (2, 5), (3, 5), (2, 6), (1, 9), (2, 7)] {
            assert_eq!(hear(&mut runs, run, delivers(0)), None);
        }
        assert!(contains(&runs, (2, 5)) && is_over(&runs, (1, 8)) && !is_over(&runs, (1, 9)));
        let mut evict = || runs.evict((9, 9), announces(0)).map(|gone| (gone.run, gone.is_displaced));
        let retired = [(2, 5), (1, 5), (2, 6)].map(|run| Some((run, false)));
        assert_eq!([(); 3].map(|()| evict()), retired);
        assert_eq!(evict(), None, "the others deliver");
        assert!(
            is_over(&runs, (2, 6)) && !contains(&runs, (2, 6)),
            "its gateway goes on with a greater epoch"
        );
        assert!(contains(&runs, (1, 9)) && contains(&runs, (2, 7)) && contains(&runs, (3, 5)));
    }

    #[test]
    fn who_starts_again_makes_its_own_room() {
        let mut runs = GatewayRuns::new();
        for hub in 0..LIVES as u64 {
            assert!(!runs.is_full());
            assert_eq!(hear(&mut runs, (hub, 1), delivers(0)), None);
            hear(&mut runs, (hub, 1), delivers(1000));
        }
        let now = delivers(1001);
        assert!(runs.is_full() && !runs.can_evict((99, 1), now) && runs.can_evict((7, 2), now));
        assert_eq!(hear(&mut runs, (7, 2), now), Some((7, 1)));
        assert!(runs.is_full() && is_over(&runs, (7, 1)) && !runs.can_evict((9, 1), announces(1002)));
    }

    #[test]
    fn who_only_announces_never_puts_out_who_delivers() {
        let mut runs = GatewayRuns::new();
        assert_eq!(hear(&mut runs, (1, 1), delivers(0)), None);
        assert_eq!(hear(&mut runs, (2, 1), delivers(0)), None);
        for n in 1..30_000 {
            // One gateway delivers ten times a second, the other one delivered once. Every millisecond, an attacker
            // invents another.
            if n % 100 == 0 {
                assert_eq!(hear(&mut runs, (1, 1), delivers(n)), None, "{n}");
            }
            let gone = hear(&mut runs, (1000 + n, 1), announces(n));
            assert!(gone.is_none_or(|(hub, _)| hub >= 1000 || hub == 2 && n >= 3000), "{n}: {gone:?}");
        }
        assert!(contains(&runs, (1, 1)) && !contains(&runs, (2, 1)));
    }

    #[test]
    fn who_is_known_to_deliver_is_not_put_out_by_one_that_begins_to() {
        let mut runs = GatewayRuns::new();
        let mut displaced = 0;
        for n in 0..30_000 {
            if n % 100 == 0 && !(10_000..20_000).contains(&n) {
                assert_eq!(
                    hear(&mut runs, (1, 1), delivers(n)),
                    None,
                    "{n}: and its silence is not that long"
                );
            }
            if n > 1000 {
                displaced += u32::from(hear(&mut runs, (1000 + n, 1), delivers(n)).is_some());
            }
        }
        assert!(contains(&runs, (1, 1)) && displaced > 28_000);
    }

    #[test]
    fn the_oldest_silence_goes_first() {
        let mut runs = GatewayRuns::new();
        for hub in 0..LIVES as u64 {
            for at_ms in [0, 2000 + hub] {
                assert_eq!(hear(&mut runs, (hub, 1), delivers(at_ms)), None);
            }
        }
        assert!(!runs.can_evict((99, 1), delivers(4999)));
        assert_eq!(hear(&mut runs, (99, 1), delivers(5000)), Some((0, 1)));
        assert_eq!(hear(&mut runs, (100, 1), announces(6000)), Some((1, 1)));
        assert_eq!(hear(&mut runs, (101, 1), announces(6001)), Some((100, 1)), "it never delivered");
    }

    /// Handles a datagram as [`StreamStats`](super::StreamStats) does.
    fn send(senders: &mut Senders, from: u64, boot: Option<u64>, at_ms: u64) -> SenderMatch {
        let sender_match = senders.judge(from, boot, at_ms * MS);
        if sender_match == SenderMatch::Next {
            *senders = Senders::NONE;
        }
        senders.note(from, boot, at_ms * MS);
        sender_match
    }

    #[test]
    fn two_gateways_are_kept_apart_and_known_after_two_announcements() {
        let mut senders = Senders::NONE;
        assert_eq!(send(&mut senders, 1, None, 0), SenderMatch::Own);
        assert_eq!(send(&mut senders, 2, None, 1), SenderMatch::Twin, "it did not say who it is");
        let mut told_ms = None;
        for at_ms in 2..3000 {
            let boot = |begin: u64| (at_ms % 1000 == begin).then_some(begin);
            assert_eq!(send(&mut senders, 1, boot(10), at_ms), SenderMatch::Own);
            assert_eq!(send(&mut senders, 2, boot(300), at_ms), SenderMatch::Twin);
            if senders.is_shared() {
                told_ms.get_or_insert(at_ms);
            }
        }
        assert_eq!(told_ms, Some(1300));
        for (from, boot) in [(2, None), (2, Some(300)), (3, Some(9))] {
            assert_eq!(
                send(&mut senders, from, boot, 60_000),
                SenderMatch::Twin,
                "nobody stands in for the first one"
            );
        }
        assert_eq!(
            send(&mut senders, 3, Some(10), 60_100),
            SenderMatch::Own,
            "the first one at another address"
        );
    }

    #[test]
    fn sockets_of_one_gateway_are_one_also_when_its_hub_starts_again() {
        let mut senders = Senders::NONE;
        for second in 0..20 {
            // Copies arrive first, one of them late. The hub restarts every five seconds.
            let boot = 7 + second / 5;
            let late = if second == 11 { boot - 1 } else { boot };
            send(&mut senders, 2, Some(late), 1000 * second);
            assert_eq!(send(&mut senders, 1, Some(boot), 1000 * second + 2), SenderMatch::Own, "{second}");
            assert_eq!(send(&mut senders, 2, Some(boot), 1000 * second + 3), SenderMatch::Own, "{second}");
            assert_eq!(send(&mut senders, 2, None, 1000 * second + 4), SenderMatch::Own, "{second}");
            assert!(!senders.is_shared(), "{second}");
        }
    }

    #[test]
    fn a_gateway_whose_address_changed_goes_on_and_another_one_begins_anew() {
        let mut senders = Senders::NONE;
        send(&mut senders, 1, Some(7), 0);
        assert_eq!(send(&mut senders, 2, None, 100), SenderMatch::Twin);
        assert_eq!(send(&mut senders, 2, Some(7), 900), SenderMatch::Own);
        assert_eq!(send(&mut senders, 2, None, 4000), SenderMatch::Own);
        assert_eq!(send(&mut senders, 2, Some(8), 4100), SenderMatch::Own, "its hub started again");
        assert_eq!(send(&mut senders, 3, Some(9), 4200), SenderMatch::Twin);
        assert_eq!(send(&mut senders, 3, Some(9), 7099), SenderMatch::Twin);
        assert_eq!(send(&mut senders, 3, Some(9), 7100), SenderMatch::Next);
        assert_eq!(send(&mut senders, 3, None, 7200), SenderMatch::Own);
    }

    #[test]
    fn strangers_put_out_neither_the_gateway_nor_what_is_known_of_it() {
        let mut senders = Senders::NONE;
        send(&mut senders, 1, Some(7), 0);
        for n in 0..1000 {
            assert_eq!(send(&mut senders, 100 + n, Some(1000 + n), n), SenderMatch::Twin);
        }
        assert_eq!(send(&mut senders, 1, None, 1000), SenderMatch::Own);
        assert_eq!(send(&mut senders, 2, Some(7), 1000), SenderMatch::Own);
    }
}
