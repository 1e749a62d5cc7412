//! A router between two bridges, with a link to each of them. Everything that the router accepts arrives once and in
//! order. However, the links can be slow or closed. If the router is killed, all datagrams in the router are lost. Both
//! bridges connect to the next router by themselves.

use std::collections::VecDeque;

use scanhub_schema::{MICROS, MILLIS, Nanos};

/// The router and its links.
pub(super) struct Router {
    /// Rate of the link if there are no faults, and current rate of the link, in bytes per second.
    rate: u64,
    current_rate: u64,
    delay_ns: Nanos,
    is_running: bool,
    /// Whether a partition is active.
    is_partitioned: bool,
    /// Time span in which the sender can pass datagrams to the router. The span ends when the sender detects that its
    /// link is lost.
    connected: (Nanos, Nanos),
    /// Time from which the receiver is connected.
    receives_from: Nanos,
    /// Time at which the link can accept the next datagram.
    has_room_at: Nanos,
    /// Datagrams on their way, with their times of arrival.
    in_transit: VecDeque<(Nanos, Vec<u8>)>,
    bytes: usize,
    random: fastrand::Rng,
}

impl Router {
    /// Creates a router to which both bridges are connected.
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

    /// Sets the packet loss and the delay of the link. Packets that are lost are sent again, so loss reduces the rate
    /// of the link.
    pub(super) fn set_link(&mut self, loss: f64, delay_ns: Nanos) {
        self.current_rate = (self.rate as f64 / (1.0 + 100.0 * loss)) as u64;
        self.delay_ns = delay_ns;
    }

    /// Starts or ends a partition.
    pub(super) fn set_partitioned(&mut self, is_partitioned: bool, now: Nanos) {
        if self.is_partitioned && !is_partitioned {
            // The datagrams that the partition delayed arrive now, in order.
            for ((at, _), after) in self.in_transit.iter_mut().zip((now..).step_by(MAX_SPACING_NS)) {
                *at = after.max(*at);
            }
        }
        self.is_partitioned = is_partitioned;
    }

    /// Kills the router. All datagrams in the router are lost. Datagrams that the sender passes on before it detects
    /// the loss of its link are lost, too.
    pub(super) fn kill(&mut self, now: Nanos) {
        if self.is_running {
            self.is_running = false;
            self.connected.1 = self.connected.1.min(now + self.delay_ns.min(MAX_DISCONNECT_DELAY));
            self.receives_from = Nanos::MAX;
            self.in_transit.clear();
            self.bytes = 0;
        }
    }

    /// Starts another router. Both bridges try to connect from time to time. With `gives_up`, they never connect.
    pub(super) fn begin(&mut self, now: Nanos, gives_up: bool) {
        if !self.is_running && !gives_up {
            self.is_running = true;
            let mut found = || now + self.random.u64(0..=RECONNECT_INTERVAL);
            self.connected = (found(), Nanos::MAX);
            self.receives_from = found();
            self.has_room_at = self.connected.0;
        }
    }

    /// Connects a listener that has just started.
    pub(super) fn connect_listener(&mut self, now: Nanos) {
        if self.is_running {
            self.receives_from = self.receives_from.max(now + CONNECT_TIME);
        }
    }

    /// Returns the time at which the router has room for the next datagram, or [`Nanos::MAX`] if that time is unknown.
    pub(super) fn next_room_at(&self) -> Nanos {
        let at = self.has_room_at.max(self.connected.0);
        if at >= self.connected.1 || self.bytes >= SOCKET_BUFFER_LEN { Nanos::MAX } else { at }
    }

    /// Accepts a datagram from the sender.
    pub(super) fn send(&mut self, now: Nanos, bytes: &[u8]) {
        self.has_room_at = now + bytes.len() as u64 * 1_000_000_000 / self.current_rate;
        if !self.is_running {
            return;
        }
        let last = self.in_transit.back().map_or(0, |(at, _)| *at);
        self.bytes += bytes.len();
        self.in_transit.push_back((last.max(self.has_room_at + self.delay_ns), bytes.to_vec()));
    }

    /// Returns the time at which the next datagram arrives.
    pub(super) fn next_delivery(&self) -> Option<Nanos> {
        self.in_transit.front().filter(|_| !self.is_partitioned).map(|(at, _)| *at)
    }

    /// Returns the earliest datagram that has reached the receiver by `now`.
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

/// Possible rates of a link, in bytes per second. They range from a radio link to a fast network.
const LINK_RATES: [u64; 3] = [2_000_000, 5_000_000, 50_000_000];
/// Number of bytes that the sockets of a link buffer.
const SOCKET_BUFFER_LEN: usize = 64 << 10;
/// Time between the arrivals of datagrams that a partition has delayed, in nanoseconds.
const MAX_SPACING_NS: usize = 10_000;
/// Maximum time from the end of a router until a sender detects the loss of its link.
const MAX_DISCONNECT_DELAY: Nanos = 20 * MILLIS;
/// Time from the start of a listener until it is connected.
const CONNECT_TIME: Nanos = 500 * MICROS;
/// Maximum time from the start of a router until a bridge is connected to it.
pub(crate) const RECONNECT_INTERVAL: Nanos = 500 * MILLIS;
/// Maximum time in which a link without faults sends a bridge's whole queue, even if the queue contains the longest
/// samples of all topics.
pub(crate) const MAX_DRAIN_TIME: Nanos = 200 * MILLIS;
