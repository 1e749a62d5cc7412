//! A machine with a listener that publishes, and a robot that subscribes to the zones, in virtual time. Topics are
//! queues in memory.

use std::collections::VecDeque;

use scanhub_client::Robot;
use scanhub_client::clock::Moment;
use scanhub_client::streams::ZonesState;
use scanhub_network::lan::Stamp;
use scanhub_network::lan::incoming::{Arrived, Incoming};
use scanhub_network::lan::republish::Republisher;
use scanhub_schema::datagram::Packed;
use scanhub_schema::{Header, Topic, Verdict, Zones};

use crate::network::Nanos;
use crate::remote_topics::{self, Memory};

/// Receiving machine.
pub(crate) struct Receiving {
    /// Clocks at the start.
    clocks: Stamp,
    pub(crate) incoming: Incoming,
    pub(crate) republisher: Republisher<Memory>,
    memory: Memory,
    /// Datagrams in the kernel's buffer, with the time of their arrival.
    queue: VecDeque<(Nanos, Vec<u8>)>,
    /// Time until which the listener is stopped.
    stalled_until: Nanos,
    look_at: Nanos,
    pub(crate) robot: Robot,
    followed: Vec<(String, ZonesState)>,
}

/// A published sample of topic zones.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Published {
    /// Position of its sensor.
    pub(crate) position: usize,
    pub(crate) header: Header,
    pub(crate) zones: Zones,
}

/// Event that a test observes.
pub(crate) enum Seen<'a> {
    Datagram { arrived_at: Nanos, bytes: &'a [u8], arrived: &'a Arrived<'a> },
    Published(Published),
}

/// ID of the publishing process.
const PID: u32 = 77;
/// Maximum sleep of the listener.
const MAX_SLEEP_NS: Nanos = 100_000_000;

impl Receiving {
    /// Creates a machine whose robot subscribes to the zones of `names` of gateway `hub`.
    pub(crate) fn new(clocks: Stamp, hub: &str, names: &[&str]) -> Receiving {
        let memory = Memory::default();
        let mut receiving = Receiving {
            clocks,
            incoming: Incoming::new(&Topic::ALL),
            republisher: Republisher::new(memory.clone(), PID, clocks.monotonic_ns),
            memory,
            queue: VecDeque::new(),
            stalled_until: 0,
            look_at: 0,
            robot: Robot::default(),
            followed: Vec::new(),
        };
        for name in names {
            let name = format!("{hub}.{name}");
            receiving.robot.expect(&name);
            receiving.followed.push((name, ZonesState::new(receiving.moment(0))));
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

    /// Returns the time of the next event without a datagram.
    pub(crate) fn next(&self, now: Nanos) -> Nanos {
        let moment = self.moment(now);
        let left = self.followed.iter().filter_map(|(_, state)| state.left(moment));
        let silence_at = left.min().map_or(Nanos::MAX, |left| now + left.as_nanos() as Nanos);
        silence_at.min(self.look_at.max(self.stalled_until))
    }

    /// Handles waiting datagrams, and calls `seen` with each event.
    pub(crate) fn step(&mut self, now: Nanos, hub: &str, mut seen: impl FnMut(Seen<'_>)) {
        if now >= self.stalled_until {
            let wall = self.stamp(now);
            while let Some((arrived_at, bytes)) = self.queue.pop_front() {
                let (arrival, mut whole) = (self.stamp(arrived_at), Vec::new());
                let arrived = self.incoming.receive(&bytes, 1, arrival, &mut whole);
                seen(Seen::Datagram { arrived_at, bytes: &bytes, arrived: &arrived });
                if let Some(head) = arrived.begins() {
                    self.republisher.begun(head, wall);
                }
                let made = match &arrived {
                    Arrived::Sample(sample) => self.republisher.sample(sample, || hub.to_owned(), wall),
                    Arrived::Announced(announced) => self.republisher.announced(announced, hub, wall),
                    _ => Ok(None),
                };
                made.expect("memory is not short");
            }
            self.republisher.wake();
            if now >= self.look_at {
                self.look_at = now + MAX_SLEEP_NS;
                self.republisher.look(wall.monotonic_ns, wall);
            }
        }
        self.follow(now, seen);
    }

    /// Receives the published zones, and detects silences.
    fn follow(&mut self, now: Nanos, mut seen: impl FnMut(Seen<'_>)) {
        let moment = self.moment(now);
        for (position, (name, state)) in self.followed.iter_mut().enumerate() {
            let waiting = self.memory.take(name).into_iter();
            for remote_topics::Published { header, payload, .. } in
                waiting.filter(|published| published.topic == Topic::Zones)
            {
                let mut zones = Zones::default();
                assert!(zones.unpack(&payload));
                seen(Seen::Published(Published { position, header, zones }));
                self.robot.hear(position, state.take(&header, &zones, 0, moment).zones);
            }
            if let Some(silence) = state.silence(moment) {
                self.robot.hear(position, silence.zones);
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

    fn stamp(&self, now: Nanos) -> Stamp {
        Stamp { monotonic_ns: self.clocks.monotonic_ns + now, wall_ns: self.clocks.wall_ns + now }
    }

    fn moment(&self, now: Nanos) -> Moment {
        let monotonic_ns = self.stamp(now).monotonic_ns;
        Moment { monotonic_ns, boottime_ns: monotonic_ns }
    }
}
