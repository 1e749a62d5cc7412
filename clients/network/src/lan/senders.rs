//! Detection of two gateways that send under one number, for example because the disk of one machine is a copy of the
//! other's. Their samples must not become one stream.
//!
//! Gateways with the same epoch are distinguished by their senders and by the run of the hub (`boot`) that they
//! announce. A sender is identified by a number that differs between two gateways, such as its address and port. If the
//! epochs differ, the gateway with the lower epoch is refused for as long as both send. Time is an argument.

/// Senders of one run of a gateway.
#[derive(Clone, Copy)]
pub(super) struct Senders {
    /// Known senders. The first one is the sender to which the run belongs.
    all: [Sender; MAX_SENDERS],
    count: usize,
    is_shared: bool,
}

/// One sender.
#[derive(Clone, Copy, Default)]
struct Sender {
    from: u64,
    /// Runs of the hub that the sender has announced, the latest one first. 0 stands for no run.
    boots: [u64; MAX_BOOTS],
    last_datagram_ns: u64,
    announced_ns: u64,
    /// Time since which the sender has announced a run of the hub that the first sender does not announce.
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

/// Maximum number of senders that are distinguished. It is enough for the sockets of the gateway, another gateway, and
/// a sender that appears in between.
const MAX_SENDERS: usize = 4;
/// Maximum number of runs of the hub that are kept for each sender. One would not be enough: after a restart of the
/// hub, announcements of its previous run may arrive late.
const MAX_BOOTS: usize = 4;
/// Time without a datagram after which a sender counts as silent, in ns: three times the interval of announcements.
pub(super) const SILENCE_NS: u64 = 3_000_000_000;
/// Time for which two senders must announce different runs of a hub before they count as two gateways, in ns. The
/// sockets of one gateway change to a new run of the hub within milliseconds of each other.
const MIN_SHARED_TIME_NS: u64 = 500_000_000;

impl Senders {
    /// State before the first datagram.
    pub(super) const NONE: Senders = Senders {
        all: [Sender {
            from: 0,
            boots: [0; MAX_BOOTS],
            last_datagram_ns: 0,
            announced_ns: 0,
            other_since_ns: None,
        }; MAX_SENDERS],
        count: 0,
        is_shared: false,
    };

    /// Returns whether a datagram of sender `from` belongs to the gateway of this run. `boot` is the run of the hub if
    /// the datagram is an announcement. A further sender that has sent no announcement does not count as the same
    /// gateway.
    pub(super) fn match_sender(&self, from: u64, boot: Option<u64>, now_ns: u64) -> SenderMatch {
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
    pub(super) fn record(&mut self, from: u64, boot: Option<u64>, now_ns: u64) {
        let is_own = self.match_sender(from, boot, now_ns) == SenderMatch::Own;
        let first = self.all[0];
        let at = self.sender_index(from);
        let sender = &mut self.all[at];
        sender.last_datagram_ns = now_ns;
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
            let is_long = now_ns.saturating_sub(since_ns) >= MIN_SHARED_TIME_NS;
            self.is_shared |= is_long && first.announced_ns > since_ns;
        }
    }

    /// Moves the gateway to the address `from`, where it has announced another run of its hub.
    pub(super) fn move_to(&mut self, from: u64, boot: u64, now_ns: u64) {
        let boots = self.all[0].boots;
        let at = self.sender_index(from);
        self.all[at].boots = boots;
        self.all[at].announce(boot, now_ns);
        self.all[at].last_datagram_ns = now_ns;
        self.all[at].other_since_ns = None;
        self.all[..=at].rotate_right(1);
    }

    /// Returns whether two gateways are known to send.
    pub(super) fn is_shared(&self) -> bool {
        self.is_shared
    }

    /// Returns the index of sender `from`. A new sender replaces the one that has been silent for longest, but never
    /// the first one.
    fn sender_index(&mut self, from: u64) -> usize {
        if let Some(at) = self.all[..self.count].iter().position(|sender| sender.from == from) {
            return at;
        }
        let at = if self.count < MAX_SENDERS {
            self.count += 1;
            self.count - 1
        } else {
            (1..MAX_SENDERS).min_by_key(|&at| self.all[at].last_datagram_ns).unwrap_or(MAX_SENDERS - 1)
        };
        self.all[at] = Sender { from, ..Sender::default() };
        at
    }
}

impl Sender {
    fn is_silent(&self, now_ns: u64) -> bool {
        now_ns.saturating_sub(self.last_datagram_ns) >= SILENCE_NS
    }

    fn announce(&mut self, boot: u64, now_ns: u64) {
        self.announced_ns = now_ns;
        let at = self.boots.iter().position(|known| *known == boot).unwrap_or(MAX_BOOTS - 1);
        self.boots[..=at].rotate_right(1);
        self.boots[0] = boot;
    }
}

/// Detector of two gateways with different epochs that send under one number. The one with the lower epoch then
/// continues to send. After a restart of a single gateway, in contrast, only a few datagrams of its previous run arrive
/// late.
#[derive(Default)]
pub(super) struct DuplicateDetector {
    /// Start of the window, which begins with a refused datagram.
    since_ns: Option<u64>,
    /// Number of refused datagrams in the window that directly followed an accepted one.
    alternations: u32,
    /// Whether the last datagram was accepted.
    is_accepted: bool,
    is_reported: bool,
}

/// Minimum number of alternations after which there are two gateways.
const MIN_ALTERNATIONS: u32 = 8;
/// Minimum time that these alternations must cover, in ns.
const MIN_ALTERNATION_SPAN_NS: u64 = 3_000_000_000;
/// Length of the window in which alternations are counted, in ns. It is limited because each restart of a gateway may
/// cause some alternations.
const ALTERNATION_WINDOW_NS: u64 = 30_000_000_000;

impl DuplicateDetector {
    /// Records that a datagram of the gateway was accepted.
    pub(super) fn on_accepted(&mut self) {
        self.is_accepted = true;
    }

    /// Records that a datagram was refused because of its epoch or sender. Returns `true`, once, if this datagram shows
    /// that two gateways send.
    pub(super) fn on_refused(&mut self, now_ns: u64) -> bool {
        let is_accepted = std::mem::take(&mut self.is_accepted);
        let Some(since_ns) = self.since_ns else {
            self.since_ns = Some(now_ns);
            return false;
        };
        let span_ns = now_ns.saturating_sub(since_ns);
        if span_ns >= ALTERNATION_WINDOW_NS {
            (self.since_ns, self.alternations) = (Some(now_ns), 0);
        }
        self.alternations += u32::from(is_accepted);
        let is_long = (MIN_ALTERNATION_SPAN_NS..ALTERNATION_WINDOW_NS).contains(&span_ns);
        let is_new = self.alternations >= MIN_ALTERNATIONS && is_long && !self.is_reported;
        self.is_reported |= is_new;
        is_new
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Handles a datagram as `GatewayTable` does.
    fn send(senders: &mut Senders, from: u64, boot: Option<u64>, at_ms: u64) -> SenderMatch {
        let sender_match = senders.match_sender(from, boot, at_ms * MS);
        if sender_match == SenderMatch::Next {
            *senders = Senders::NONE;
        }
        senders.record(from, boot, at_ms * MS);
        sender_match
    }

    #[test]
    fn detects_two_gateways_by_their_announcements() {
        let mut senders = Senders::NONE;
        assert_eq!(send(&mut senders, 1, None, 0), SenderMatch::Own);
        assert_eq!(send(&mut senders, 2, None, 1), SenderMatch::Twin, "it did not say who it is");
        let mut reported_ms = None;
        for at_ms in 2..3000 {
            let boot = |begin: u64| (at_ms % 1000 == begin).then_some(begin);
            assert_eq!(send(&mut senders, 1, boot(10), at_ms), SenderMatch::Own);
            assert_eq!(send(&mut senders, 2, boot(300), at_ms), SenderMatch::Twin);
            if senders.is_shared() {
                reported_ms.get_or_insert(at_ms);
            }
        }
        assert_eq!(reported_ms, Some(1300));
        for (from, boot) in [(2, None), (2, Some(300)), (3, Some(9))] {
            assert_eq!(
                send(&mut senders, from, boot, 60_000),
                SenderMatch::Twin,
                "no sender replaces the first one"
            );
        }
        assert_eq!(
            send(&mut senders, 3, Some(10), 60_100),
            SenderMatch::Own,
            "the first one at another address"
        );
    }

    #[test]
    fn sockets_of_one_gateway_match_after_a_hub_restart() {
        let mut senders = Senders::NONE;
        for second in 0..20 {
            // The announcements of sender 2 arrive first, and one of them is late. The hub restarts every five seconds.
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
    fn moved_gateway_continues_and_a_new_one_begins() {
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
    fn invented_senders_do_not_evict_the_gateway() {
        let mut senders = Senders::NONE;
        send(&mut senders, 1, Some(7), 0);
        for n in 0..1000 {
            assert_eq!(send(&mut senders, 100 + n, Some(1000 + n), n), SenderMatch::Twin);
        }
        assert_eq!(send(&mut senders, 1, None, 1000), SenderMatch::Own);
        assert_eq!(send(&mut senders, 2, Some(7), 1000), SenderMatch::Own);
    }

    /// Records an accepted datagram followed by a refused one, every `every_ms`, `count` times. Returns the indices of
    /// the refused datagrams that report two gateways.
    fn reports(detector: &mut DuplicateDetector, begin_ms: u64, every_ms: u64, count: u64) -> Vec<u64> {
        let turn = |n: &u64| {
            detector.on_accepted();
            detector.on_refused((begin_ms + every_ms * *n) * MS)
        };
        (0..count).filter(turn).collect()
    }

    #[test]
    fn reports_two_gateways_once() {
        assert_eq!(reports(&mut DuplicateDetector::default(), 0, 100, 1000), [30]);
        assert_eq!(reports(&mut DuplicateDetector::default(), 0, 1000, 1000), [8]);
    }

    #[test]
    fn late_datagrams_are_not_another_gateway() {
        let mut detector = DuplicateDetector::default();
        assert!(reports(&mut detector, 0, 1, 1000).is_empty(), "a restart");
        assert!(reports(&mut detector, 3_600_000, 1, 1000).is_empty(), "and another one");
        let mut alone = DuplicateDetector::default();
        assert!((0..1000).all(|n| !alone.on_refused(100 * MS * n)), "a gateway whose clock was set back");
    }
}
