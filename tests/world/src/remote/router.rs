//! A router between the machines, as a bridge meets it: a link that is slow at times and closed at others, on which everything
//! comes once and in order, until the router is killed with all that it holds. Both ends find it again by themselves. Refuses
//! to know what a datagram says.

use std::collections::VecDeque;

use scanhub_schema::{MICROS, MILLIS, Nanos};

/// The router, and the links to it.
pub(super) struct Router {
    /// Bytes a second, of a link that is well, and of the link as it is now.
    rate: u64,
    rate_now: u64,
    delay_ns: Nanos,
    is_there: bool,
    /// So many partitions last.
    is_cut: bool,
    /// The sender hands over from the one time until the other one, when it knows that its link is no more.
    linked: (Nanos, Nanos),
    /// From then on the receiver hears.
    hears_from: Nanos,
    /// When there is room for more.
    free_at: Nanos,
    /// With the time at which each comes.
    under_way: VecDeque<(Nanos, Vec<u8>)>,
    bytes: usize,
    random: fastrand::Rng,
}

impl Router {
    /// A router that both ends are connected to.
    pub(super) fn new(seed: u64, delay_ns: Nanos) -> Router {
        let mut random = fastrand::Rng::with_seed(seed ^ 0x0B41_D6E0);
        let rate = RATES[random.usize(..RATES.len())];
        Router {
            rate,
            rate_now: rate,
            delay_ns,
            is_there: true,
            is_cut: false,
            linked: (0, Nanos::MAX),
            hears_from: 0,
            free_at: 0,
            under_way: VecDeque::new(),
            bytes: 0,
            random,
        }
    }

    /// A network that loses so many packets and takes so long: what is lost is sent again, which takes time.
    pub(super) fn set_link(&mut self, loss: f64, delay_ns: Nanos) {
        self.rate_now = (self.rate as f64 / (1.0 + 100.0 * loss)) as u64;
        self.delay_ns = delay_ns;
    }

    /// Nothing passes, or something does again.
    pub(super) fn cut(&mut self, is_cut: bool, now: Nanos) {
        if self.is_cut && !is_cut {
            // What waited for this comes now, in its order.
            for ((at, _), after) in self.under_way.iter_mut().zip((now..).step_by(APART)) {
                *at = after.max(*at);
            }
        }
        self.is_cut = is_cut;
    }

    /// It is killed: what it has is lost, and what is handed over until the sender knows.
    pub(super) fn kill(&mut self, now: Nanos) {
        if self.is_there {
            self.is_there = false;
            self.linked.1 = self.linked.1.min(now + self.delay_ns.min(KNOWN));
            self.hears_from = Nanos::MAX;
            self.under_way.clear();
            self.bytes = 0;
        }
    }

    /// It is there again. Both ends try to connect now and then; they never do if it `is_given_up`.
    pub(super) fn begin(&mut self, now: Nanos, is_given_up: bool) {
        if !self.is_there && !is_given_up {
            self.is_there = true;
            let mut found = || now + self.random.u64(0..=RECONNECTED);
            self.linked = (found(), Nanos::MAX);
            self.hears_from = found();
            self.free_at = self.linked.0;
        }
    }

    /// A listener begins.
    pub(super) fn meet(&mut self, now: Nanos) {
        if self.is_there {
            self.hears_from = self.hears_from.max(now + MET);
        }
    }

    /// When there is room for a datagram that waits; never as long as nobody knows when.
    pub(super) fn room_at(&self) -> Nanos {
        let at = self.free_at.max(self.linked.0);
        if at >= self.linked.1 || self.bytes >= BUFFER { Nanos::MAX } else { at }
    }

    /// Takes what is handed over.
    pub(super) fn send(&mut self, now: Nanos, bytes: &[u8]) {
        self.free_at = now + bytes.len() as u64 * 1_000_000_000 / self.rate_now;
        if !self.is_there {
            return;
        }
        let last = self.under_way.back().map_or(0, |(at, _)| *at);
        self.bytes += bytes.len();
        self.under_way.push_back((last.max(self.free_at + self.delay_ns), bytes.to_vec()));
    }

    /// When something comes.
    pub(super) fn next(&self) -> Option<Nanos> {
        self.under_way.front().filter(|_| !self.is_cut).map(|(at, _)| *at)
    }

    /// What came to the receiver until `now`, the earliest first.
    pub(super) fn poll(&mut self, now: Nanos) -> Option<Vec<u8>> {
        while self.next().is_some_and(|at| at <= now) {
            let (at, bytes) = self.under_way.pop_front()?;
            self.bytes -= bytes.len();
            if at >= self.hears_from {
                return Some(bytes);
            }
        }
        None
    }
}

/// A link has one of these: a radio link, a network.
const RATES: [u64; 3] = [2_000_000, 5_000_000, 50_000_000];
/// So much waits in sockets.
const BUFFER: usize = 64 << 10;
/// Between two that come at once, in nanoseconds.
const APART: usize = 10_000;
/// A sender knows of the end of its link after so long, at most.
const KNOWN: Nanos = 20 * MILLIS;
/// Who begins is connected after so long.
const MET: Nanos = 500 * MICROS;
/// Between two attempts to connect, and until it is connected.
pub(crate) const RECONNECTED: Nanos = 500 * MILLIS;
/// What waits has gone out after so long on a link that is well: the longest samples of all topics.
pub(crate) const ROUND: Nanos = 200 * MILLIS;
