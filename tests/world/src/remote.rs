//! The other machine, which receives the topics of the hub: a gateway, a network, a listener that publishes, and a robot. Each
//! of them starts and ends by itself.

mod forger;
mod gateway;
mod listener;
mod router;
mod topics;

use std::collections::HashMap;
use std::num::NonZeroU64;
use std::time::Duration;

use scanhub_client::clock::Moment;
use scanhub_network::lan::{Key, Stamp};
use scanhub_schema::datagram::{MTU_ETHERNET, MTU_LEAST, MTU_SAFE};
use scanhub_schema::{MICROS, MILLIS, Nanos, Topic};

use crate::actions;
use crate::event::Event;
use crate::network::{Faults, Network};
use crate::plan::Plan;
use crate::planted::Defect;
use crate::setup::Setup;
use crate::shared::Shared;
use forger::Forger;
pub(crate) use forger::Forgery;
use gateway::Gateway;
pub(crate) use gateway::{NUMBERS as FIRST_NUMBER, Packet};
use listener::{Listener, RemoteRobot};
use router::Router;
pub(crate) use router::{RECONNECTED, ROUND};
use topics::Memory;

/// How gateway, network and listener are, as the seed has it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Terms {
    /// Of what comes with each scan every so many go out.
    pub(crate) every: NonZeroU64,
    /// Telegrams go out too.
    sends_telegrams: bool,
    /// The longest datagram, in bytes.
    longest: usize,
    /// Between two times that a background goes out.
    repeat: Option<Duration>,
    /// The shortest way.
    pub(crate) delay_ns: Nanos,
    /// The clocks of the machine that listens, when a world begins.
    pub(crate) clocks: Stamp,
    /// Gateway and listener have a key.
    pub(crate) has_key: bool,
    /// Gateway and listener are bridges, and a router is between them.
    pub(crate) are_bridges: bool,
    /// Topics that the gateway does not send.
    lonely: [bool; Topic::ALL.len()],
    /// With a key: so much the wall clock of the listener's machine is ahead of the hub's, in ns.
    ahead_ns: i64,
}

impl Terms {
    pub(crate) fn of_plan(plan: &Plan) -> Terms {
        let seed = plan.seed;
        let mut random = fastrand::Rng::with_seed(seed ^ 0x001A_0000_1A00);
        let every = NonZeroU64::MIN.saturating_add([0, 0, 1, 3, 7][random.usize(..5)]);
        let mut lonely = [false; Topic::ALL.len()];
        actions::lonely_topics(&plan.actions, seed)
            .into_iter()
            .for_each(|topic| lonely[topic as usize] = true);
        Terms {
            every,
            sends_telegrams: random.bool(),
            longest: [MTU_LEAST, MTU_SAFE, MTU_SAFE, MTU_ETHERNET][random.usize(..4)],
            repeat: random.bool().then(|| Duration::from_secs(random.u64(1..20))),
            delay_ns: random.u64(50..20_000) * MICROS,
            clocks: Stamp { monotonic_ns: random.u64(1..1 << 50), wall_ns: random.u64(1 << 60..1 << 61) },
            has_key: actions::have_key(&plan.actions),
            are_bridges: actions::are_bridges(&plan.actions),
            lonely,
            ahead_ns: random.i64(-2_000_000_000..2_000_000_000),
        }
    }

    /// Every how manieth sample of `topic` goes out, if any do.
    pub(crate) fn every(&self, topic: Topic) -> Option<NonZeroU64> {
        match topic {
            Topic::Telegram if !self.sends_telegrams => None,
            _ if self.lonely[topic as usize] => None,
            Topic::Background | Topic::Status => Some(NonZeroU64::MIN),
            _ => Some(self.every),
        }
    }

    /// A moment on the clocks of the machine that listens.
    fn stamp(&self, now: Nanos) -> Stamp {
        let Stamp { monotonic_ns, wall_ns } = self.clocks;
        Stamp { monotonic_ns: monotonic_ns + now, wall_ns: wall_ns + now }
    }

    /// The key, if there is one.
    fn key(&self) -> Option<Key> {
        self.has_key.then(|| Key::new(&[7; Key::LEN]))
    }

    /// That machine is never suspended.
    fn moment(&self, now: Nanos) -> Moment {
        let Stamp { monotonic_ns, .. } = self.stamp(now);
        Moment { monotonic_ns, boottime_ns: monotonic_ns }
    }
}

/// Everything from the gateway on.
pub(crate) struct Remote {
    terms: Terms,
    sensors: usize,
    gateway: Option<Gateway>,
    /// How many there were.
    gateways: u32,
    /// The gateway's process does not run until then, and the listener's.
    gateway_stalled_until: Nanos,
    listener_stalled_until: Nanos,
    network: Network,
    /// Instead of a network, if they are bridges.
    router: Option<Router>,
    faults: Faults,
    /// So many partitions last.
    partitions: usize,
    /// The sockets of the gateway take so many datagrams of what is sent less, from 0 to 1.
    pub(crate) refusal: f64,
    random: fastrand::Rng,
    listener: Option<Listener>,
    listeners: u64,
    memory: Memory,
    robot: RemoteRobot,
    forger: Forger,
    /// So much more the wall clocks are apart now, in ns.
    apart_ns: i64,
    /// The greatest epochs, as listeners keep them.
    epochs: HashMap<u64, u32>,
}

impl Remote {
    pub(crate) fn new(plan: &Plan, setup: &Setup) -> Remote {
        let (seed, terms) = (plan.seed, Terms::of_plan(plan));
        let faults = Faults { delay_ns: terms.delay_ns, ..Faults::default() };
        let sensors = setup.sensors.len();
        Remote {
            terms,
            sensors,
            gateway: None,
            gateways: 0,
            gateway_stalled_until: 0,
            listener_stalled_until: 0,
            network: Network::new(seed, faults),
            router: terms.are_bridges.then(|| Router::new(seed, terms.delay_ns)),
            faults,
            partitions: 0,
            refusal: 0.0,
            random: fastrand::Rng::with_seed(seed ^ 0x5E4D),
            listener: None,
            listeners: 0,
            memory: Memory::default(),
            robot: RemoteRobot::new(&terms, sensors),
            forger: Forger::default(),
            apart_ns: 0,
            epochs: HashMap::new(),
        }
    }

    /// A gateway begins, if there is none.
    pub(crate) fn begin_gateway(&mut self, shared: &Shared) {
        if self.gateway.is_none() {
            self.gateways += 1;
            self.gateway = Some(Gateway::begin(shared, &self.terms, self.gateways, self.sensors));
        }
    }

    /// The gateway is killed, or ends in order: then it has a last word.
    pub(crate) fn end_gateway(&mut self, shared: &Shared, is_killed: bool) {
        let Some(mut gateway) = self.gateway.take() else { return };
        let now = shared.clock.get();
        if !is_killed {
            gateway.announce(shared, now, &mut self.uplink(shared, now));
            self.hand(shared, &mut gateway, now);
        }
        gateway.leave(shared, is_killed, false);
    }

    /// A listener begins, if there is none.
    pub(crate) fn begin_listener(&mut self, shared: &Shared) {
        if self.listener.is_none() {
            self.listeners += 1;
            self.router.iter_mut().for_each(|router| router.meet(shared.clock.get()));
            self.listener =
                Some(Listener::begin(shared, &self.terms, self.listeners, self.memory.clone(), &self.epochs));
        }
    }

    /// The listener is killed: what waits in its sockets is lost.
    pub(crate) fn kill_listener(&mut self, shared: &Shared) {
        if let Some(listener) = self.listener.take() {
            listener.end(shared, shared.clock.get());
        }
    }

    /// The process of the gateway, or of the listener, does not run until then.
    pub(crate) fn stall(&mut self, is_listener: bool, until: Nanos) {
        let Remote { gateway_stalled_until, listener_stalled_until, .. } = self;
        let stalled = if is_listener { listener_stalled_until } else { gateway_stalled_until };
        *stalled = until.max(*stalled);
    }

    /// All processes run.
    pub(crate) fn heal(&mut self) {
        (self.gateway_stalled_until, self.listener_stalled_until) = (0, 0);
    }

    /// The wall clock of the listener's machine is so much further ahead, in ns.
    pub(crate) fn set_apart(&mut self, apart_ns: i64) {
        self.apart_ns = apart_ns;
    }

    /// Somebody sends so many datagrams of this kind.
    pub(crate) fn forge(&mut self, shared: &Shared, forgery: Forgery, count: usize) {
        let now = shared.clock.get();
        for bytes in self.forger.forge(forgery, count, self.wall_ns(shared, now)) {
            shared.log.tell(now, &Event::Forged { forgery, bytes: &bytes });
            self.network.send(now, &bytes);
        }
    }

    /// The wall clock of the listener's machine at `now`, with a key: as far from the hub's as clocks are that are set by the
    /// same server, but for what goes wrong.
    fn wall_ns(&self, shared: &Shared, now: Nanos) -> Nanos {
        (now + shared.wall_ahead.get()).saturating_add_signed(self.terms.ahead_ns + self.apart_ns)
    }

    /// The network has these faults from now on, besides its delay.
    pub(crate) fn set_faults(&mut self, faults: Faults, now: Nanos) {
        self.faults = Faults { delay_ns: self.terms.delay_ns + faults.delay_ns, ..faults };
        self.tell_network(now);
    }

    /// One partition more begins, or one ends.
    pub(crate) fn part(&mut self, begins: bool, now: Nanos) {
        self.partitions = if begins { self.partitions + 1 } else { self.partitions.saturating_sub(1) };
        self.tell_network(now);
    }

    fn tell_network(&mut self, now: Nanos) {
        if let Some(router) = &mut self.router {
            router.set_link(self.faults.loss, self.faults.delay_ns);
            return router.cut(self.partitions > 0, now);
        }
        let loss = if self.partitions > 0 { 1.0 } else { self.faults.loss };
        self.network.set_faults(Faults { loss, ..self.faults }, now);
    }

    /// The router is killed, with what it holds.
    pub(crate) fn kill_router(&mut self, now: Nanos) {
        match &mut self.router {
            Some(router) => router.kill(now),
            None => self.part(true, now),
        }
    }

    /// And another one is there.
    pub(crate) fn begin_router(&mut self, shared: &Shared) {
        let now = shared.clock.get();
        match &mut self.router {
            Some(router) => router.begin(now, shared.planted.is(Defect::RouterGivenUp)),
            None => self.part(false, now),
        }
    }

    /// What waits in a bridge goes to its router, as far as there is room.
    fn hand(&mut self, shared: &Shared, gateway: &mut Gateway, now: Nanos) {
        while let Some(router) = self.router.as_mut().filter(|router| router.room_at() <= now) {
            let is_taken = self.refusal <= 0.0 || self.random.f64() >= self.refusal;
            let Some(bytes) = gateway.hand(shared, now, is_taken) else { return };
            if is_taken {
                router.send(now, &bytes);
            }
        }
    }

    /// The hub woke the consumers of a sensor at `at`.
    pub(crate) fn wake(&mut self, at: Nanos) {
        if let Some(gateway) = &mut self.gateway {
            gateway.wake(at);
        }
    }

    /// When something is due.
    pub(crate) fn next_ns(&self, now: Nanos) -> Nanos {
        let room_at = self.router.as_ref().map_or(Nanos::MAX, Router::room_at);
        let gateway = self.gateway.as_ref().map(|gateway| {
            let handed_at = if gateway.is_waiting() { room_at } else { Nanos::MAX };
            gateway.next_ns(now).min(handed_at).max(self.gateway_stalled_until)
        });
        let listener =
            self.listener.as_ref().map(|listener| listener.next_ns().max(self.listener_stalled_until));
        let came = self.network.next().into_iter().chain(self.router.as_ref().and_then(Router::next));
        let all = gateway.into_iter().chain(listener).chain(came);
        all.fold(self.robot.next_ns(&self.terms, now), Nanos::min)
    }

    /// Does what is due at `now`.
    pub(crate) fn pass(&mut self, shared: &Shared, now: Nanos) {
        if now >= self.gateway_stalled_until
            && let Some(mut gateway) = self.gateway.take()
        {
            if gateway.next_ns(now) <= now {
                gateway.run(shared, now, &mut self.uplink(shared, now));
            }
            self.hand(shared, &mut gateway, now);
            self.gateway = Some(gateway);
        }
        self.deliver(shared, now);
        self.robot.run(shared, &self.terms, &self.memory, now);
    }

    /// What came until `now` is the listener's.
    fn deliver(&mut self, shared: &Shared, now: Nanos) {
        let wall_ns = self.wall_ns(shared, now);
        while let Some(bytes) =
            self.router.as_mut().map_or_else(|| self.network.poll(now), |router| router.poll(now))
        {
            if self.terms.has_key {
                self.forger.hear(wall_ns, &bytes);
            }
            if let Some(listener) = &mut self.listener {
                listener.catch(now, bytes);
            }
        }
        if let Some(listener) = self.listener.as_mut().filter(|_| now >= self.listener_stalled_until)
            && listener.next_ns() <= now
        {
            let ahead_ns = wall_ns.wrapping_sub(now);
            listener.run(shared, &self.terms, now, ahead_ns, &mut self.epochs);
        }
    }

    /// Takes all that waits and that is on its way, and ends.
    pub(crate) fn close(&mut self, shared: &Shared) {
        let mut now = shared.clock.get();
        if let Some(mut gateway) = self.gateway.take() {
            let uplink = &mut self.uplink(shared, now);
            gateway.run(shared, now, uplink);
            gateway.announce(shared, now, uplink);
            while let Some(room_at) =
                self.router.as_ref().map(Router::room_at).filter(|_| gateway.is_waiting())
                && let Some(at) =
                    [room_at].into_iter().chain(self.router.as_ref().and_then(Router::next)).min()
                && at < Nanos::MAX
            {
                now = now.max(at);
                self.hand(shared, &mut gateway, now);
                self.deliver(shared, now);
            }
            gateway.leave(shared, false, true);
        }
        while let Some(at) = self.router.as_ref().map_or_else(|| self.network.next(), Router::next) {
            now = now.max(at);
            self.deliver(shared, now);
        }
        now += WAKES;
        self.deliver(shared, now);
        self.robot.run(shared, &self.terms, &self.memory, now);
        if let Some(listener) = self.listener.take() {
            listener.end(shared, now);
        }
    }

    fn uplink<'a>(&'a mut self, shared: &'a Shared, now: Nanos) -> gateway::Uplink<'a> {
        let Remote { network, random, refusal, .. } = self;
        gateway::Uplink { shared, now, random, refusal: *refusal, network }
    }
}

/// From a datagram or a ring to a process that runs.
const WAKES: Nanos = 60 * MICROS;
/// A listener sleeps no longer than so.
const LOOKS: Nanos = 100 * MILLIS;
