//! The other machine of a world, which receives the hub's topics. This module has a gateway, a network, a listener that
//! publishes topics, and a robot. Gateway and listener start and end independently of each other.

mod forger;
mod gateway;
mod listener;
mod router;
mod topics;

use std::collections::HashMap;
use std::num::NonZeroU64;
use std::time::Duration;

use scanhub_client::clock::Timestamp;
use scanhub_network::lan::{Key, WallTimestamp};
use scanhub_schema::datagram::{MIN_MTU, MTU_ETHERNET, MTU_SAFE};
use scanhub_schema::{MICROS, MILLIS, Nanos, Topic};

use crate::actions;
use crate::event::Event;
use crate::injected_defects::Defect;
use crate::network::{Faults, Network};
use crate::scenario::Scenario;
use crate::setup::Setup;
use crate::shared::SharedState;
use forger::Forger;
pub(crate) use forger::Forgery;
use gateway::Gateway;
pub(crate) use gateway::{FIRST_SUBSCRIBER_ID as FIRST_NUMBER, PayloadBuffer};
use listener::{Listener, RemoteRobot};
use router::Router;
pub(crate) use router::{MAX_DRAIN_TIME, RECONNECT_INTERVAL};
use topics::TopicMemory;

/// Settings of gateway, network and listener, drawn from the seed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LinkSettings {
    /// Interval at which the gateway sends scans and samples derived from scans: the gateway sends one of this number
    /// of samples.
    pub(crate) send_interval: NonZeroU64,
    /// Whether the gateway also sends telegrams.
    sends_telegrams: bool,
    /// Maximum length of a datagram, in bytes.
    max_datagram_len: usize,
    /// Interval at which the gateway sends the background again.
    background_interval: Option<Duration>,
    /// Minimum delay of the network.
    pub(crate) delay_ns: Nanos,
    /// Time on the clocks of the listener's machine when the world begins.
    pub(crate) initial_clocks: WallTimestamp,
    /// Whether gateway and listener have a key.
    pub(crate) has_key: bool,
    /// Whether gateway and listener are bridges, with a router between them.
    pub(crate) are_bridges: bool,
    /// Topics that the gateway does not send.
    without_subscribers: [bool; Topic::ALL.len()],
    /// Time by which the wall clock of the listener's machine is ahead of the hub's wall clock, in nanoseconds. Only
    /// used with a key.
    clock_offset_ns: i64,
}

impl LinkSettings {
    pub(crate) fn from_scenario(scenario: &Scenario) -> LinkSettings {
        let seed = scenario.seed;
        let mut random = fastrand::Rng::with_seed(seed ^ 0x001A_0000_1A00);
        let send_interval = NonZeroU64::MIN.saturating_add([0, 0, 1, 3, 7][random.usize(..5)]);
        let mut without_subscribers = [false; Topic::ALL.len()];
        actions::topics_without_constant_subscriber(&scenario.actions, seed)
            .into_iter()
            .for_each(|topic| without_subscribers[topic as usize] = true);
        LinkSettings {
            send_interval,
            sends_telegrams: random.bool(),
            max_datagram_len: [MIN_MTU, MTU_SAFE, MTU_SAFE, MTU_ETHERNET][random.usize(..4)],
            background_interval: random.bool().then(|| Duration::from_secs(random.u64(1..20))),
            delay_ns: random.u64(50..20_000) * MICROS,
            initial_clocks: WallTimestamp {
                monotonic_ns: random.u64(1..1 << 50),
                wall_ns: random.u64(1 << 60..1 << 61),
            },
            has_key: actions::have_key(&scenario.actions),
            are_bridges: actions::are_bridges(&scenario.actions),
            without_subscribers,
            clock_offset_ns: random.i64(-2_000_000_000..2_000_000_000),
        }
    }

    /// Returns the interval at which the gateway sends samples of `topic`, in samples. Returns `None` if the gateway
    /// does not send this topic.
    pub(crate) fn send_interval(&self, topic: Topic) -> Option<NonZeroU64> {
        match topic {
            Topic::Telegram if !self.sends_telegrams => None,
            _ if self.without_subscribers[topic as usize] => None,
            Topic::Background | Topic::Status => Some(NonZeroU64::MIN),
            _ => Some(self.send_interval),
        }
    }

    /// Returns the time on the clocks of the listener's machine at `now`.
    fn stamp(&self, now: Nanos) -> WallTimestamp {
        let WallTimestamp { monotonic_ns, wall_ns } = self.initial_clocks;
        WallTimestamp { monotonic_ns: monotonic_ns + now, wall_ns: wall_ns + now }
    }

    /// Returns the key of gateway and listener, or `None` if they have no key.
    fn key(&self) -> Option<Key> {
        self.has_key.then(|| Key::new(&[7; Key::LEN]))
    }

    /// Returns the timestamp of the listener's machine at `now`. The machine is never suspended.
    fn moment(&self, now: Nanos) -> Timestamp {
        let WallTimestamp { monotonic_ns, .. } = self.stamp(now);
        Timestamp { monotonic_ns, boottime_ns: monotonic_ns }
    }
}

/// Everything between the hub and a remote robot: gateway, network or router, listener and robot.
pub(crate) struct RemoteMachines {
    terms: LinkSettings,
    sensors: usize,
    gateway: Option<Gateway>,
    /// Number of gateways that have been started.
    gateways: u32,
    /// Times until which the process of the gateway and the process of the listener are stalled.
    gateway_stalled_until: Nanos,
    listener_stalled_until: Nanos,
    network: Network,
    /// Router between the bridges, which replaces the network.
    router: Option<Router>,
    faults: Faults,
    /// Number of partitions that are active.
    active_partitions: usize,
    /// Rate of datagrams that the gateway's sockets refuse, from 0 to 1.
    pub(crate) refusal_rate: f64,
    random: fastrand::Rng,
    listener: Option<Listener>,
    listeners: u64,
    memory: TopicMemory,
    robot: RemoteRobot,
    forger: Forger,
    /// Additional time by which an action has set the wall clock of the listener's machine ahead, in nanoseconds.
    extra_clock_offset_ns: i64,
    /// Highest epoch of each hub that listeners have saved.
    epochs: HashMap<u64, u32>,
}

impl RemoteMachines {
    pub(crate) fn new(scenario: &Scenario, setup: &Setup) -> RemoteMachines {
        let (seed, terms) = (scenario.seed, LinkSettings::from_scenario(scenario));
        let faults = Faults { delay_ns: terms.delay_ns, ..Faults::default() };
        let sensors = setup.sensors.len();
        RemoteMachines {
            terms,
            sensors,
            gateway: None,
            gateways: 0,
            gateway_stalled_until: 0,
            listener_stalled_until: 0,
            network: Network::new(seed, faults),
            router: terms.are_bridges.then(|| Router::new(seed, terms.delay_ns)),
            faults,
            active_partitions: 0,
            refusal_rate: 0.0,
            random: fastrand::Rng::with_seed(seed ^ 0x5E4D),
            listener: None,
            listeners: 0,
            memory: TopicMemory::default(),
            robot: RemoteRobot::new(&terms, sensors),
            forger: Forger::default(),
            extra_clock_offset_ns: 0,
            epochs: HashMap::new(),
        }
    }

    /// Starts a gateway, if no gateway is running.
    pub(crate) fn begin_gateway(&mut self, shared: &SharedState) {
        if self.gateway.is_none() {
            self.gateways += 1;
            self.gateway = Some(Gateway::begin(shared, &self.terms, self.gateways, self.sensors));
        }
    }

    /// Kills the gateway, or ends it in an orderly way. In an orderly end, the gateway sends a final announcement.
    pub(crate) fn end_gateway(&mut self, shared: &SharedState, is_killed: bool) {
        let Some(mut gateway) = self.gateway.take() else { return };
        let now = shared.clock.get();
        if !is_killed {
            gateway.announce(shared, now, &mut self.uplink(shared, now));
            self.hand_over(shared, &mut gateway, now);
        }
        gateway.detach(shared, is_killed, false);
    }

    /// Starts a listener, if no listener is running.
    pub(crate) fn begin_listener(&mut self, shared: &SharedState) {
        if self.listener.is_none() {
            self.listeners += 1;
            self.router.iter_mut().for_each(|router| router.connect_listener(shared.clock.get()));
            self.listener =
                Some(Listener::begin(shared, &self.terms, self.listeners, self.memory.clone(), &self.epochs));
        }
    }

    /// Kills the listener. The datagrams in its sockets are lost.
    pub(crate) fn kill_listener(&mut self, shared: &SharedState) {
        if let Some(listener) = self.listener.take() {
            listener.end(shared, shared.clock.get());
        }
    }

    /// Stops the process of the gateway or of the listener until `until`.
    pub(crate) fn stall(&mut self, is_listener: bool, until: Nanos) {
        let RemoteMachines { gateway_stalled_until, listener_stalled_until, .. } = self;
        let stalled = if is_listener { listener_stalled_until } else { gateway_stalled_until };
        *stalled = until.max(*stalled);
    }

    /// Ends all stalls.
    pub(crate) fn clear_faults(&mut self) {
        (self.gateway_stalled_until, self.listener_stalled_until) = (0, 0);
    }

    /// Sets the additional time by which the wall clock of the listener's machine is ahead, in nanoseconds.
    pub(crate) fn set_extra_clock_offset(&mut self, offset_ns: i64) {
        self.extra_clock_offset_ns = offset_ns;
    }

    /// Sends `count` datagrams of the kind `forgery` from a machine without the key.
    pub(crate) fn forge(&mut self, shared: &SharedState, forgery: Forgery, count: usize) {
        let now = shared.clock.get();
        for bytes in self.forger.forge(forgery, count, self.wall_ns(shared, now)) {
            shared.log.record(now, &Event::Forged { forgery, bytes: &bytes });
            self.network.send(now, &bytes);
        }
    }

    /// Returns the wall clock of the listener's machine at `now`, for a world with a key. Unless an action sets an
    /// additional offset, the difference between this clock and the hub's clock is as small as between clocks that the
    /// same time server sets.
    fn wall_ns(&self, shared: &SharedState, now: Nanos) -> Nanos {
        (now + shared.wall_offset.get())
            .saturating_add_signed(self.terms.clock_offset_ns + self.extra_clock_offset_ns)
    }

    /// Replaces the faults of the network. The network keeps its minimum delay.
    pub(crate) fn set_faults(&mut self, faults: Faults, now: Nanos) {
        self.faults = Faults { delay_ns: self.terms.delay_ns + faults.delay_ns, ..faults };
        self.apply_network_faults(now);
    }

    /// Starts or ends one partition.
    pub(crate) fn change_partitions(&mut self, begins: bool, now: Nanos) {
        self.active_partitions =
            if begins { self.active_partitions + 1 } else { self.active_partitions.saturating_sub(1) };
        self.apply_network_faults(now);
    }

    fn apply_network_faults(&mut self, now: Nanos) {
        if let Some(router) = &mut self.router {
            router.set_link(self.faults.loss, self.faults.delay_ns);
            return router.set_partitioned(self.active_partitions > 0, now);
        }
        let loss = if self.active_partitions > 0 { 1.0 } else { self.faults.loss };
        self.network.set_faults(Faults { loss, ..self.faults }, now);
    }

    /// Kills the router. The router loses everything that it holds.
    pub(crate) fn kill_router(&mut self, now: Nanos) {
        match &mut self.router {
            Some(router) => router.kill(now),
            None => self.change_partitions(true, now),
        }
    }

    /// Starts another router.
    pub(crate) fn begin_router(&mut self, shared: &SharedState) {
        let now = shared.clock.get();
        match &mut self.router {
            Some(router) => router.begin(now, shared.defect.is_active(Defect::RouterNotReconnected)),
            None => self.change_partitions(false, now),
        }
    }

    /// Passes the queue of a bridge to the router, as long as the router has room.
    fn hand_over(&mut self, shared: &SharedState, gateway: &mut Gateway, now: Nanos) {
        while let Some(router) = self.router.as_mut().filter(|router| router.next_room_at() <= now) {
            let is_taken = self.refusal_rate <= 0.0 || self.random.f64() >= self.refusal_rate;
            let Some(bytes) = gateway.take_next(shared, now, is_taken) else { return };
            if is_taken {
                router.send(now, &bytes);
            }
        }
    }

    /// Wakes the gateway, because the hub woke the subscribers of a sensor at `at`.
    pub(crate) fn wake(&mut self, at: Nanos) {
        if let Some(gateway) = &mut self.gateway {
            gateway.wake(at);
        }
    }

    /// Returns the time of the next event.
    pub(crate) fn next_ns(&self, now: Nanos) -> Nanos {
        let room_at = self.router.as_ref().map_or(Nanos::MAX, Router::next_room_at);
        let gateway = self.gateway.as_ref().map(|gateway| {
            let handed_at = if gateway.is_waiting() { room_at } else { Nanos::MAX };
            gateway.next_ns(now).min(handed_at).max(self.gateway_stalled_until)
        });
        let listener =
            self.listener.as_ref().map(|listener| listener.next_ns().max(self.listener_stalled_until));
        let next_arrivals = self
            .network
            .next_delivery()
            .into_iter()
            .chain(self.router.as_ref().and_then(Router::next_delivery));
        let all = gateway.into_iter().chain(listener).chain(next_arrivals);
        all.fold(self.robot.next_ns(&self.terms, now), Nanos::min)
    }

    /// Runs gateway, network, listener and robot at `now`.
    pub(crate) fn run_due(&mut self, shared: &SharedState, now: Nanos) {
        if now >= self.gateway_stalled_until
            && let Some(mut gateway) = self.gateway.take()
        {
            if gateway.next_ns(now) <= now {
                gateway.run(shared, now, &mut self.uplink(shared, now));
            }
            self.hand_over(shared, &mut gateway, now);
            self.gateway = Some(gateway);
        }
        self.deliver(shared, now);
        self.robot.run(shared, &self.terms, &self.memory, now);
    }

    /// Passes the datagrams that have arrived by `now` to the listener.
    fn deliver(&mut self, shared: &SharedState, now: Nanos) {
        let wall_ns = self.wall_ns(shared, now);
        while let Some(bytes) =
            self.router.as_mut().map_or_else(|| self.network.poll(now), |router| router.poll(now))
        {
            if self.terms.has_key {
                self.forger.record(wall_ns, &bytes);
            }
            if let Some(listener) = &mut self.listener {
                listener.receive(now, bytes);
            }
        }
        if let Some(listener) = self.listener.as_mut().filter(|_| now >= self.listener_stalled_until)
            && listener.next_ns() <= now
        {
            let ahead_ns = wall_ns.wrapping_sub(now);
            listener.run(shared, &self.terms, now, ahead_ns, &mut self.epochs);
        }
    }

    /// Delivers everything that is queued or in transit, and ends all processes.
    pub(crate) fn close(&mut self, shared: &SharedState) {
        let mut now = shared.clock.get();
        if let Some(mut gateway) = self.gateway.take() {
            let uplink = &mut self.uplink(shared, now);
            gateway.run(shared, now, uplink);
            gateway.announce(shared, now, uplink);
            while let Some(room_at) =
                self.router.as_ref().map(Router::next_room_at).filter(|_| gateway.is_waiting())
                && let Some(at) =
                    [room_at].into_iter().chain(self.router.as_ref().and_then(Router::next_delivery)).min()
                && at < Nanos::MAX
            {
                now = now.max(at);
                self.hand_over(shared, &mut gateway, now);
                self.deliver(shared, now);
            }
            gateway.detach(shared, false, true);
        }
        while let Some(at) =
            self.router.as_ref().map_or_else(|| self.network.next_delivery(), Router::next_delivery)
        {
            now = now.max(at);
            self.deliver(shared, now);
        }
        now += WAKE_DELAY;
        self.deliver(shared, now);
        self.robot.run(shared, &self.terms, &self.memory, now);
        if let Some(listener) = self.listener.take() {
            listener.end(shared, now);
        }
    }

    fn uplink<'a>(&'a mut self, shared: &'a SharedState, now: Nanos) -> gateway::Uplink<'a> {
        let RemoteMachines { network, random, refusal_rate, .. } = self;
        gateway::Uplink { shared, now, random, refusal_rate: *refusal_rate, network }
    }
}

/// Delay of a process that a datagram or a ring of the doorbell wakes.
const WAKE_DELAY: Nanos = 60 * MICROS;
/// Maximum interval between the checks of a listener.
const MAX_SLEEP: Nanos = 100 * MILLIS;
