//! A run of a listener, and a robot that subscribes to the listener's topics. The listener takes datagrams in the order
//! of their arrival, and publishes their samples. The robot handles the zones of remote sensors as the client library
//! does.

use std::collections::{HashMap, VecDeque};

use scanhub_client::Robot;
use scanhub_client::streams::ZonesState;
use scanhub_network::lan::WallTimestamp;
use scanhub_network::lan::incoming::{Incoming, ReceiveOutcome};
use scanhub_network::lan::republish::Republisher;
use scanhub_schema::datagram::{Datagram, DatagramError, DatagramPayload, HEADER_LEN, Head};
use scanhub_schema::{Nanos, Topic, Verdict, Zones};

use super::topics::{PublishedSample, TopicMemory};
use super::{LinkSettings, MAX_SLEEP, WAKE_DELAY};
use crate::event::{DatagramOutcome, Event};
use crate::injected_defects::Defect;
use crate::setup::Setup;
use crate::shared::SharedState;

/// The listener.
pub(super) struct Listener {
    run: u64,
    incoming: Incoming,
    republisher: Republisher<TopicMemory>,
    /// Datagrams in the kernel's buffer, with their times of arrival.
    kernel_queue: VecDeque<(Nanos, Vec<u8>)>,
    queued: usize,
    /// Time at which the listener reads its sockets, and time of its next periodic check.
    next_at: Nanos,
    next_check_at: Nanos,
}

impl Listener {
    /// Starts the listener as run number `run`. The listener publishes in `memory`.
    pub(super) fn begin(
        shared: &SharedState,
        terms: &LinkSettings,
        run: u64,
        memory: TopicMemory,
        epochs: &HashMap<u64, u32>,
    ) -> Listener {
        let now = shared.clock.get();
        let incoming = match terms.key().filter(|_| !shared.defect.is_active(Defect::RemoteUnchecked)) {
            Some(key) => Incoming::with_key(&Topic::ALL, key, epochs.clone()),
            None => Incoming::new(&Topic::ALL),
        };
        shared.log.record(now, &Event::ListenerStarted { run });
        Listener {
            run,
            incoming,
            republisher: Republisher::new(memory, PUBLISHER_PID, terms.stamp(now).monotonic_ns),
            kernel_queue: VecDeque::new(),
            queued: 0,
            next_at: Nanos::MAX,
            next_check_at: now,
        }
    }

    /// Adds a datagram to the kernel's buffer, if the buffer has room.
    pub(super) fn receive(&mut self, now: Nanos, bytes: Vec<u8>) {
        if self.queued + bytes.len() <= RECEIVE_BUFFER_LEN {
            self.queued += bytes.len();
            self.kernel_queue.push_back((now, bytes));
            self.next_at = self.next_at.min(now + WAKE_DELAY);
        }
    }

    /// Returns the time at which the listener next has something to do.
    pub(super) fn next_ns(&self) -> Nanos {
        self.next_at.min(self.next_check_at)
    }

    /// Reads the datagrams in the kernel's buffer. Two arguments matter only with a key: the wall clock of the
    /// listener's machine is `clock_offset_ns` ahead of virtual time, and the listener saves accepted epochs in
    /// `epochs`.
    pub(super) fn run(
        &mut self,
        shared: &SharedState,
        terms: &LinkSettings,
        now: Nanos,
        clock_offset_ns: Nanos,
        epochs: &mut HashMap<u64, u32>,
    ) {
        self.next_at = Nanos::MAX;
        loop {
            let mut read = None;
            for _ in 0..BATCH_SIZE.min(self.kernel_queue.len()) {
                let Some((arrived_at, bytes)) = self.kernel_queue.pop_front() else { break };
                self.queued -= bytes.len();
                self.take(shared, terms, (arrived_at, clock_offset_ns), &bytes, now);
                read = Some(arrived_at);
            }
            if let Some(known) = self.incoming.take_epochs() {
                epochs.extend(known);
            }
            let read = read.filter(|_| !self.kernel_queue.is_empty()).unwrap_or(now);
            self.republisher.wake();
            if now >= self.next_check_at {
                self.next_check_at = now + MAX_SLEEP;
                self.republisher.do_periodic_work(terms.stamp(now).monotonic_ns, terms.stamp(read));
            }
            if self.kernel_queue.is_empty() {
                return;
            }
        }
    }

    fn take(
        &mut self,
        shared: &SharedState,
        terms: &LinkSettings,
        (came, ahead_ns): (Nanos, Nanos),
        bytes: &[u8],
        now: Nanos,
    ) {
        let arrival = |at| match terms.has_key {
            true => WallTimestamp { wall_ns: at + ahead_ns, ..terms.stamp(at) },
            false => terms.stamp(at),
        };
        let wall = terms.stamp(now);
        if shared.defect.triggers(Defect::RemoteCountedTwice, 100) {
            self.incoming.receive(bytes, 1, arrival(came), &mut Vec::new());
        }
        let stamped = if shared.defect.is_active(Defect::RemoteStampedLate) { now } else { came };
        let mut whole = Vec::new();
        let half = shared.defect.triggers(Defect::RemoteHalf, 10).then(|| partial_sample(bytes)).flatten();
        let taken = half.as_deref().unwrap_or(bytes);
        let arrived = self.incoming.receive(taken, 1, arrival(stamped), &mut whole);
        let outcome = match &arrived {
            ReceiveOutcome::Refused { reason: why, .. } => DatagramOutcome::Refused(*why),
            ReceiveOutcome::Untimely { .. } => DatagramOutcome::Refused(DatagramError::Untimely),
            ReceiveOutcome::Part => DatagramOutcome::Part,
            // The last two outcomes do not occur, because this listener does not select hubs, and its gateway has no
            // name.
            ReceiveOutcome::Duplicate | ReceiveOutcome::Ignored | ReceiveOutcome::Foreign => {
                DatagramOutcome::Duplicate
            }
            ReceiveOutcome::Announced(_) => DatagramOutcome::Announcement,
            ReceiveOutcome::Sample(sample) => DatagramOutcome::Sample { late: sample.remote.late },
        };
        let datagram = Datagram::read(bytes).ok();
        shared
            .log
            .record(now, &Event::Arrived { arrived_at: came, datagram: datagram.as_ref(), bytes, outcome });
        if let Some(head) = arrived.begins() {
            self.republisher.on_run_started(head, wall);
        }
        let made = match &arrived {
            ReceiveOutcome::Sample(sample) => {
                self.republisher.sample(sample, || GATEWAY_NAME.to_owned(), wall)
            }
            ReceiveOutcome::Announced(announced) => {
                self.republisher.on_announcement(announced, GATEWAY_NAME, wall)
            }
            _ => Ok(None),
        };
        if let Err(failure) = made {
            shared.log.record(now, &Event::ActionTaken { text: &format!("a listener says {failure}") });
        }
    }

    /// Ends the listener, and reports its counters.
    pub(super) fn end(self, shared: &SharedState, now: Nanos) {
        let stats = self.incoming.gateways();
        for row in stats.rows() {
            shared.log.record(now, &Event::ListenerCounters { row });
        }
        let refused = DatagramError::ALL.iter().map(|&why| stats.refused(why)).sum();
        let (given_up, sensors) = (stats.evicted().runs, self.republisher.names().len());
        shared.log.record(now, &Event::ListenerEnded { run: self.run, refused, evicted: given_up, sensors });
    }
}

/// Returns the sample that a faulty listener would create from a single part. Zeros replace the other parts.
fn partial_sample(bytes: &[u8]) -> Option<Vec<u8>> {
    let Datagram { head, payload, .. } = Datagram::read(bytes).ok().filter(|it| it.head.parts > 1)?;
    let begin = HEADER_LEN + payload.len() * usize::from(head.part);
    let mut buffer = vec![0; HEADER_LEN + payload.len() * usize::from(head.parts)];
    buffer[begin..begin + payload.len()].copy_from_slice(payload);
    let len = buffer.len() - HEADER_LEN;
    Some(Head { part: 0, parts: 1, ..head }.seal(&mut buffer, len)?.to_vec())
}

/// Process ID in the headers that the listener publishes.
const PUBLISHER_PID: u32 = 77;
/// Maximum number of datagrams that the listener handles before it does other work.
const BATCH_SIZE: usize = 64;
/// Size of the kernel's buffer, in bytes.
const RECEIVE_BUFFER_LEN: usize = 1 << 20;

/// A subscriber to all topics of all remote sensors.
pub(super) struct RemoteRobot {
    robot: Robot,
    /// Names of the sensors, states of their zones, and last accepted verdicts.
    sensors: Vec<(String, ZonesState, Verdict)>,
}

impl RemoteRobot {
    pub(super) fn new(terms: &LinkSettings, sensors: usize) -> RemoteRobot {
        let mut robot = Robot::default();
        let mut follow = |number| {
            let name = format!("{GATEWAY_NAME}.{}", Setup::name(number));
            robot.expect(&name);
            (name, ZonesState::new(terms.moment(0)), Verdict::Unknown)
        };
        let sensors = (0..sensors).map(&mut follow).collect();
        RemoteRobot { robot, sensors }
    }

    /// Returns the time at which the next verdict expires if no sample arrives.
    pub(super) fn next_ns(&self, terms: &LinkSettings, now: Nanos) -> Nanos {
        let left = self.sensors.iter().filter_map(|(_, state, _)| state.time_left(terms.moment(now)));
        left.min().map_or(Nanos::MAX, |left| now.saturating_add(left.as_nanos() as Nanos))
    }

    /// Takes all published samples, and updates the verdicts of sensors whose samples no longer arrive.
    pub(super) fn run(
        &mut self,
        shared: &SharedState,
        terms: &LinkSettings,
        memory: &TopicMemory,
        now: Nanos,
    ) {
        let moment = terms.moment(now);
        for (sensor, (name, state, believed)) in self.sensors.iter_mut().enumerate() {
            for PublishedSample { topic, header, mut payload } in memory.take(name) {
                if shared.defect.triggers(Defect::RemoteAltered, 100) {
                    payload[0] ^= 1;
                }
                let republished = Event::Republished { sensor, topic, header: &header, payload: &payload };
                shared.log.record(now, &republished);
                let mut zones = Zones::default();
                if topic == Topic::Zones && zones.unpack(&payload) {
                    self.robot.update(sensor, state.take(&header, &zones, 0, moment).zones);
                    accept_verdict(shared, now, sensor, believed, &self.robot);
                }
            }
            if let Some(silence) = state.silence(moment)
                && !shared.defect.is_active(Defect::RemoteSurvivingVerdict)
            {
                self.robot.update(sensor, silence.zones);
                accept_verdict(shared, now, sensor, believed, &self.robot);
            }
        }
    }
}

fn accept_verdict(shared: &SharedState, now: Nanos, sensor: usize, accepted: &mut Verdict, robot: &Robot) {
    let verdict = robot.sensors().nth(sensor).map_or(Verdict::Unknown, |(_, verdict)| verdict);
    if std::mem::replace(accepted, verdict) != verdict {
        shared.log.record(now, &Event::RemoteVerdictAccepted { sensor, verdict });
    }
}

/// Name of the gateway on the listener's machine.
const GATEWAY_NAME: &str = "robot1";
