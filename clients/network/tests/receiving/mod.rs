//! Receiving machine in virtual time: a listener that publishes remote sensors, and a robot that subscribes to their
//! zones. Topics are queues in memory.

use std::collections::VecDeque;

use scanhub_client::Robot;
use scanhub_client::clock::Timestamp;
use scanhub_client::streams::ZonesState;
use scanhub_network::lan::WallTimestamp;
use scanhub_network::lan::incoming::{Incoming, ReceiveOutcome};
use scanhub_network::lan::republish::Republisher;
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::{Header, Topic, Verdict, Zones};

use crate::network::Nanos;
use crate::remote_topics::{self, TopicMemory};

/// Receiving machine.
pub(crate) struct ReceivingMachine {
    /// Clocks at the start.
    clocks: WallTimestamp,
    pub(crate) incoming: Incoming,
    pub(crate) republisher: Republisher<TopicMemory>,
    memory: TopicMemory,
    /// Datagrams in the kernel's buffer, with the time of their arrival.
    queue: VecDeque<(Nanos, Vec<u8>)>,
    /// Time until which the listener is stopped.
    stalled_until: Nanos,
    next_check_at: Nanos,
    pub(crate) robot: Robot,
    subscriptions: Vec<(String, ZonesState)>,
}

/// A published sample of topic zones.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PublishedZones {
    /// Position of the sensor in the robot.
    pub(crate) position: usize,
    pub(crate) header: Header,
    pub(crate) zones: Zones,
}

/// Event that a test observes.
pub(crate) enum TestEvent<'a> {
    Datagram { arrived_at: Nanos, bytes: &'a [u8], arrived: &'a ReceiveOutcome<'a> },
    Published(PublishedZones),
}

/// ID of the publishing process.
const PUBLISHER_PID: u32 = 77;
/// Maximum sleep of the listener.
const MAX_SLEEP_NS: Nanos = 100_000_000;

impl ReceivingMachine {
    /// Creates a machine whose robot subscribes to the zones of `names` of gateway `hub`.
    pub(crate) fn new(clocks: WallTimestamp, hub: &str, names: &[&str]) -> ReceivingMachine {
        let memory = TopicMemory::default();
        let mut receiving = ReceivingMachine {
            clocks,
            incoming: Incoming::new(&Topic::ALL),
            republisher: Republisher::new(memory.clone(), PUBLISHER_PID, clocks.monotonic_ns),
            memory,
            queue: VecDeque::new(),
            stalled_until: 0,
            next_check_at: 0,
            robot: Robot::default(),
            subscriptions: Vec::new(),
        };
        for name in names {
            let name = format!("{hub}.{name}");
            receiving.robot.expect(&name);
            receiving.subscriptions.push((name, ZonesState::new(receiving.moment(0))));
        }
        receiving
    }

    /// Puts a datagram that arrives now into the kernel's buffer.
    pub(crate) fn deliver(&mut self, now: Nanos, bytes: Vec<u8>) {
        self.queue.push_back((now, bytes));
    }

    /// Stops the listener until `until`.
    pub(crate) fn stall(&mut self, until: Nanos) {
        self.stalled_until = until;
    }

    /// Returns the time of the next event if no datagram arrives before.
    pub(crate) fn next(&self, now: Nanos) -> Nanos {
        let moment = self.moment(now);
        let left = self.subscriptions.iter().filter_map(|(_, state)| state.time_left(moment));
        let silence_at = left.min().map_or(Nanos::MAX, |left| now + left.as_nanos() as Nanos);
        silence_at.min(self.next_check_at.max(self.stalled_until))
    }

    /// Handles waiting datagrams, and calls `on_event` with each event.
    pub(crate) fn step(&mut self, now: Nanos, hub: &str, mut on_event: impl FnMut(TestEvent<'_>)) {
        if now >= self.stalled_until {
            let wall = self.stamp(now);
            while let Some((arrived_at, bytes)) = self.queue.pop_front() {
                let (arrival, mut whole) = (self.stamp(arrived_at), Vec::new());
                let arrived = self.incoming.receive(&bytes, 1, arrival, &mut whole);
                on_event(TestEvent::Datagram { arrived_at, bytes: &bytes, arrived: &arrived });
                if let Some(head) = arrived.begins() {
                    self.republisher.on_run_started(head, wall);
                }
                let made = match &arrived {
                    ReceiveOutcome::Sample(sample) => {
                        self.republisher.sample(sample, || hub.to_owned(), wall)
                    }
                    ReceiveOutcome::Announced(announced) => {
                        self.republisher.on_announcement(announced, hub, wall)
                    }
                    _ => Ok(None),
                };
                made.expect("memory is not short");
            }
            self.republisher.wake();
            if now >= self.next_check_at {
                self.next_check_at = now + MAX_SLEEP_NS;
                self.republisher.do_periodic_work(wall.monotonic_ns, wall);
            }
        }
        self.take_published(now, on_event);
    }

    /// Receives the published zones, and detects silences.
    fn take_published(&mut self, now: Nanos, mut on_event: impl FnMut(TestEvent<'_>)) {
        let moment = self.moment(now);
        for (position, (name, state)) in self.subscriptions.iter_mut().enumerate() {
            let waiting = self.memory.take(name).into_iter();
            for remote_topics::PublishedSample { header, payload, .. } in
                waiting.filter(|published| published.topic == Topic::Zones)
            {
                let mut zones = Zones::default();
                assert!(zones.unpack(&payload));
                on_event(TestEvent::Published(PublishedZones { position, header, zones }));
                self.robot.update(position, state.take(&header, &zones, 0, moment).zones);
            }
            if let Some(silence) = state.silence(moment) {
                self.robot.update(position, silence.zones);
            }
        }
    }

    /// Returns the verdict of the sensor at this position.
    pub(crate) fn verdict(&self, position: usize) -> Verdict {
        self.robot.sensors().nth(position).expect("it is followed").1
    }

    /// Returns the time from the start to a stamp of CLOCK_MONOTONIC.
    pub(crate) fn since_start(&self, stamp_ns: u64) -> Nanos {
        stamp_ns.checked_sub(self.clocks.monotonic_ns).expect("a stamp of this machine")
    }

    fn stamp(&self, now: Nanos) -> WallTimestamp {
        WallTimestamp { monotonic_ns: self.clocks.monotonic_ns + now, wall_ns: self.clocks.wall_ns + now }
    }

    fn moment(&self, now: Nanos) -> Timestamp {
        let monotonic_ns = self.stamp(now).monotonic_ns;
        Timestamp { monotonic_ns, boottime_ns: monotonic_ns }
    }
}
