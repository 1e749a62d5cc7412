//! A run of a listener, and a robot that follows its topics. The listener takes datagrams in the order in which they arrived, and
//! publishes their samples. The robot follows the zones of remote sensors by the rules of the client library.

use std::collections::{HashMap, VecDeque};

use scanhub_client::Robot;
use scanhub_client::streams::ZonesState;
use scanhub_network::lan::Stamp;
use scanhub_network::lan::incoming::{Arrived, Incoming};
use scanhub_network::lan::republish::Republisher;
use scanhub_schema::datagram::{Datagram, DatagramError, HEAD, Head, Packed};
use scanhub_schema::{Nanos, Topic, Verdict, Zones};

use super::topics::{Memory, Published};
use super::{LOOKS, Terms, WAKES};
use crate::event::{Arrival, Event};
use crate::planted::Defect;
use crate::setup::Setup;
use crate::shared::Shared;

/// The listener.
pub(super) struct Listener {
    life: u64,
    incoming: Incoming,
    republisher: Republisher<Memory>,
    /// Datagrams that the kernel has, with the time at which they came.
    queue: VecDeque<(Nanos, Vec<u8>)>,
    queued: usize,
    /// When it looks at its sockets, and at what is due now and then.
    next_at: Nanos,
    look_at: Nanos,
}

impl Listener {
    /// Number `life` of all listeners publishes in `memory`.
    pub(super) fn begin(
        shared: &Shared,
        terms: &Terms,
        life: u64,
        memory: Memory,
        epochs: &HashMap<u64, u32>,
    ) -> Listener {
        let now = shared.clock.get();
        let incoming = match terms.key().filter(|_| !shared.planted.is(Defect::RemoteUnchecked)) {
            Some(key) => Incoming::with_key(&Topic::ALL, key, epochs.clone()),
            None => Incoming::new(&Topic::ALL),
        };
        shared.log.tell(now, &Event::ListenerBegins { life });
        Listener {
            life,
            incoming,
            republisher: Republisher::new(memory, PID, terms.stamp(now).monotonic_ns),
            queue: VecDeque::new(),
            queued: 0,
            next_at: Nanos::MAX,
            look_at: now,
        }
    }

    /// A datagram came, if there is room for it.
    pub(super) fn catch(&mut self, now: Nanos, bytes: Vec<u8>) {
        if self.queued + bytes.len() <= ROOM {
            self.queued += bytes.len();
            self.queue.push_back((now, bytes));
            self.next_at = self.next_at.min(now + WAKES);
        }
    }

    /// When it has something to do.
    pub(super) fn next_ns(&self) -> Nanos {
        self.next_at.min(self.look_at)
    }

    /// Takes what waits. With a key its machine's wall clock is `ahead_ns` of the world's, and `epochs` are kept.
    pub(super) fn run(
        &mut self,
        shared: &Shared,
        terms: &Terms,
        now: Nanos,
        ahead_ns: Nanos,
        epochs: &mut HashMap<u64, u32>,
    ) {
        self.next_at = Nanos::MAX;
        loop {
            let mut read = None;
            for _ in 0..TURN.min(self.queue.len()) {
                let Some((came, bytes)) = self.queue.pop_front() else { break };
                self.queued -= bytes.len();
                self.take(shared, terms, (came, ahead_ns), &bytes, now);
                read = Some(came);
            }
            if let Some(known) = self.incoming.take_epochs() {
                epochs.extend(known);
            }
            let read = read.filter(|_| !self.queue.is_empty()).unwrap_or(now);
            self.republisher.wake();
            if now >= self.look_at {
                self.look_at = now + LOOKS;
                self.republisher.look(terms.stamp(now).monotonic_ns, terms.stamp(read));
            }
            if self.queue.is_empty() {
                return;
            }
        }
    }

    fn take(
        &mut self,
        shared: &Shared,
        terms: &Terms,
        (came, ahead_ns): (Nanos, Nanos),
        bytes: &[u8],
        now: Nanos,
    ) {
        let arrival = |at| match terms.has_key {
            true => Stamp { wall_ns: at + ahead_ns, ..terms.stamp(at) },
            false => terms.stamp(at),
        };
        let wall = terms.stamp(now);
        if shared.planted.strikes(Defect::RemoteCountedTwice, 100) {
            self.incoming.receive(bytes, 1, arrival(came), &mut Vec::new());
        }
        let stamped = if shared.planted.is(Defect::RemoteStampedLate) { now } else { came };
        let mut whole = Vec::new();
        let half = shared.planted.strikes(Defect::RemoteHalf, 10).then(|| half(bytes)).flatten();
        let taken = half.as_deref().unwrap_or(bytes);
        let arrived = self.incoming.receive(taken, 1, arrival(stamped), &mut whole);
        let outcome = match &arrived {
            Arrived::Refused { why, .. } => Arrival::Refused(*why),
            Arrived::Untimely { .. } => Arrival::Refused(DatagramError::Untimely),
            Arrived::Part => Arrival::Part,
            // No hub is selected, and this network has no names.
            Arrived::Known | Arrived::Ignored | Arrived::Foreign => Arrival::Known,
            Arrived::Announced(_) => Arrival::Announced,
            Arrived::Sample(sample) => Arrival::Sample { late: sample.remote.late },
        };
        let datagram = Datagram::read(bytes).ok();
        shared.log.tell(now, &Event::Arrived { came, datagram: datagram.as_ref(), bytes, outcome });
        if let Some(head) = arrived.begins() {
            self.republisher.begun(head, wall);
        }
        let made = match &arrived {
            Arrived::Sample(sample) => self.republisher.sample(sample, || GATEWAY.to_owned(), wall),
            Arrived::Announced(announced) => self.republisher.announced(announced, GATEWAY, wall),
            _ => Ok(None),
        };
        if let Err(failure) = made {
            shared.log.tell(now, &Event::Acted { text: &format!("a listener says {failure}") });
        }
    }

    /// It is gone; its account is what it would have told.
    pub(super) fn end(self, shared: &Shared, now: Nanos) {
        let stats = self.incoming.gateways();
        for row in stats.rows() {
            shared.log.tell(now, &Event::Counted { row });
        }
        let refused = DatagramError::ALL.iter().map(|&why| stats.refused(why)).sum();
        let (given_up, sensors) = (stats.evicted().runs, self.republisher.names().len());
        shared.log.tell(now, &Event::ListenerEnds { life: self.life, refused, given_up, sensors });
    }
}

/// What a listener that does not wait for the other parts would make of one: a sample that has nothing where these belong.
fn half(bytes: &[u8]) -> Option<Vec<u8>> {
    let Datagram { head, payload, .. } = Datagram::read(bytes).ok().filter(|it| it.head.parts > 1)?;
    let begin = HEAD + payload.len() * usize::from(head.part);
    let mut buffer = vec![0; HEAD + payload.len() * usize::from(head.parts)];
    buffer[begin..begin + payload.len()].copy_from_slice(payload);
    let len = buffer.len() - HEAD;
    Some(Head { part: 0, parts: 1, ..head }.seal(&mut buffer, len)?.to_vec())
}

/// The process that publishes.
const PID: u32 = 77;
/// Datagrams that are taken before anything else has its turn.
const TURN: usize = 64;
/// Bytes that wait in the kernel.
const ROOM: usize = 1 << 20;

/// A subscriber to all topics of all remote sensors.
pub(super) struct RemoteRobot {
    robot: Robot,
    /// Names of the sensors, states of their zones, and last accepted verdicts.
    sensors: Vec<(String, ZonesState, Verdict)>,
}

impl RemoteRobot {
    pub(super) fn new(terms: &Terms, sensors: usize) -> RemoteRobot {
        let mut robot = Robot::default();
        let mut follow = |number| {
            let name = format!("{GATEWAY}.{}", Setup::name(number));
            robot.expect(&name);
            (name, ZonesState::new(terms.moment(0)), Verdict::Unknown)
        };
        let sensors = (0..sensors).map(&mut follow).collect();
        RemoteRobot { robot, sensors }
    }

    /// Returns the time at which a verdict expires if no sample arrives.
    pub(super) fn next_ns(&self, terms: &Terms, now: Nanos) -> Nanos {
        let left = self.sensors.iter().filter_map(|(_, state, _)| state.left(terms.moment(now)));
        left.min().map_or(Nanos::MAX, |left| now.saturating_add(left.as_nanos() as Nanos))
    }

    /// Takes what waits, and sees what does not come.
    pub(super) fn run(&mut self, shared: &Shared, terms: &Terms, memory: &Memory, now: Nanos) {
        let moment = terms.moment(now);
        for (sensor, (name, state, believed)) in self.sensors.iter_mut().enumerate() {
            for Published { topic, header, mut payload } in memory.take(name) {
                if shared.planted.strikes(Defect::RemoteAltered, 100) {
                    payload[0] ^= 1;
                }
                let republished = Event::Republished { sensor, topic, header: &header, payload: &payload };
                shared.log.tell(now, &republished);
                let mut zones = Zones::default();
                if topic == Topic::Zones && zones.unpack(&payload) {
                    self.robot.hear(sensor, state.take(&header, &zones, 0, moment).zones);
                    believe(shared, now, sensor, believed, &self.robot);
                }
            }
            if let Some(silence) = state.silence(moment)
                && !shared.planted.is(Defect::RemoteSurvivingVerdict)
            {
                self.robot.hear(sensor, silence.zones);
                believe(shared, now, sensor, believed, &self.robot);
            }
        }
    }
}

fn believe(shared: &Shared, now: Nanos, sensor: usize, believed: &mut Verdict, robot: &Robot) {
    let verdict = robot.sensors().nth(sensor).map_or(Verdict::Unknown, |(_, verdict)| verdict);
    if std::mem::replace(believed, verdict) != verdict {
        shared.log.tell(now, &Event::RemoteBelieves { sensor, verdict });
    }
}

/// Name of the gateway on the listener's machine.
const GATEWAY: &str = "robot1";
