//! A router between the machines, as a bridge meets it: a link that is slow at times and closed at others, on which everything
//! comes once and in order, until the router is killed with all that it holds. Both ends find it again by themselves. Refuses
//! to know what a datagram says.

use std::collections::VecDeque;

use scanhub_schema::{MICROS, MILLIS, Nanos};

/// The router, and the links to it.
pub(super) struct Router {
    /// Bytes a second, of a link that is well, and of the link as it is now.
    rate: u64,
    current_rate: u64,
    delay_ns: Nanos,
    is_running: bool,
    /// So many partitions last.
    is_partitioned: bool,
    /// The sender hands over from the one time until the other one, when it knows that its link is no more.
    connected: (Nanos, Nanos),
    /// From then on the receiver hears.
    receives_from: Nanos,
    /// When there is room for more.
    has_room_at: Nanos,
    /// With the time at which each comes.
    in_transit: VecDeque<(Nanos, Vec<u8>)>,
    bytes: usize,
    random: fastrand::Rng,
}

impl Router {
    /// A router that both ends are connected to.
    pub(super) fn new(seed: u64, delay_ns: Nanos) -> Router {
        let mut random = fastrand::Rng::with_seed(seed ^ 0x0B41_D6E0);
        let rate = LINK_RATES[random.usize(..LINK_RATES.len())];
        Router {
            rate,
            current_rate: rate,
            delay_ns,
            is_running: true,
            is_partitioned: false,
            connected: (0, Nanos::MAX),
            receives_from: 0,
            has_room_at: 0,
            in_transit: VecDeque::new(),
            bytes: 0,
            random,
        }
    }

    /// A network that loses so many packets and takes so long: what is lost is sent again, which takes time.
    pub(super) fn set_link(&mut self, loss: f64, delay_ns: Nanos) {
        self.current_rate = (self.rate as f64 / (1.0 + 100.0 * loss)) as u64;
        self.delay_ns = delay_ns;
    }

    /// Nothing passes, or something does again.
    pub(super) fn set_partitioned(&mut self, is_partitioned: bool, now: Nanos) {
        if self.is_partitioned && !is_partitioned {
            // What waited for this comes now, in its order.
            for ((at, _), after) in self.in_transit.iter_mut().zip((now..).step_by(MAX_SPACING_NS)) {
                *at = after.max(*at);
            }
        }
        self.is_partitioned = is_partitioned;
    }

    /// It is killed: what it has is lost, and what is handed over until the sender knows.
    pub(super) fn kill(&mut self, now: Nanos) {
        if self.is_running {
            self.is_running = false;
            self.connected.1 = self.connected.1.min(now + self.delay_ns.min(MAX_DISCONNECT_DELAY));
            self.receives_from = Nanos::MAX;
            self.in_transit.clear();
            self.bytes = 0;
        }
    }

    /// It is there again. Both ends try to connect now and then; they never do if it `is_given_up`.
    pub(super) fn begin(&mut self, now: Nanos, gives_up: bool) {
        if !self.is_running && !gives_up {
            self.is_running = true;
            let mut found = || now + self.random.u64(0..=RECONNECT_INTERVAL);
            self.connected = (found(), Nanos::MAX);
            self.receives_from = found();
            self.has_room_at = self.connected.0;
        }
    }

    /// A listener begins.
    pub(super) fn connect_listener(&mut self, now: Nanos) {
        if self.is_running {
            self.receives_from = self.receives_from.max(now + CONNECT_TIME);
        }
    }

    /// When there is room for a datagram that waits; never as long as nobody knows when.
    pub(super) fn next_room_at(&self) -> Nanos {
        let at = self.has_room_at.max(self.connected.0);
        if at >= self.connected.1 || self.bytes >= SOCKET_BUFFER_LEN { Nanos::MAX } else { at }
    }

    /// Takes what is handed over.
    pub(super) fn send(&mut self, now: Nanos, bytes: &[u8]) {
        self.has_room_at = now + bytes.len() as u64 * 1_000_000_000 / self.current_rate;
        if !self.is_running {
            return;
        }
        let last = self.in_transit.back().map_or(0, |(at, _)| *at);
        self.bytes += bytes.len();
        self.in_transit.push_back((last.max(self.has_room_at + self.delay_ns), bytes.to_vec()));
    }

    /// When something comes.
    pub(super) fn next_delivery(&self) -> Option<Nanos> {
        self.in_transit.front().filter(|_| !self.is_partitioned).map(|(at, _)| *at)
    }

    /// What came to the receiver until `now`, the earliest first.
    pub(super) fn poll(&mut self, now: Nanos) -> Option<Vec<u8>> {
        while self.next_delivery().is_some_and(|at| at <= now) {
            let (at, bytes) = self.in_transit.pop_front()?;
            self.bytes -= bytes.len();
            if at >= self.receives_from {
                return Some(bytes);
            }
        }
        None
    }
}

/// A link has one of these: a radio link, a network.
const LINK_RATES: [u64; 3] = [2_000_000, 5_000_000, 50_000_000];
/// So much waits in sockets.
const SOCKET_BUFFER_LEN: usize = 64 << 10;
/// Between two that come at once, in nanoseconds.
const MAX_SPACING_NS: usize = 10_000;
/// A sender knows of the end of its link after so long, at most.
const MAX_DISCONNECT_DELAY: Nanos = 20 * MILLIS;
/// Who begins is connected after so long.
const CONNECT_TIME: Nanos = 500 * MICROS;
/// Between two attempts to connect, and until it is connected.
pub(crate) const RECONNECT_INTERVAL: Nanos = 500 * MILLIS;
/// What waits has gone out after so long on a link that is well: the longest samples of all topics.
pub(crate) const MAX_DRAIN_TIME: Nanos = 200 * MILLIS;
