//! A machine with a listener that publishes, and a robot's verdict of what it publishes, in virtual time. Topics are queues in
//! memory. Refuses to know what was sent.

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

/// The machine.
pub(crate) struct Receiving {
    /// Its clocks at the begin.
    clocks: Stamp,
    pub(crate) incoming: Incoming,
    pub(crate) republisher: Republisher<Memory>,
    memory: Memory,
    /// Datagrams that the kernel has, with the time at which they came.
    queue: VecDeque<(Nanos, Vec<u8>)>,
    /// The listener does not run until then.
    stalled_until: Nanos,
    look_at: Nanos,
    pub(crate) robot: Robot,
    followed: Vec<(String, ZonesState)>,
}

/// A sample that was published of topic zones.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Published {
    /// Which one of the sensors that are followed.
    pub(crate) position: usize,
    pub(crate) header: Header,
    pub(crate) zones: Zones,
}

/// What is seen from outside of a datagram that was taken.
pub(crate) enum Seen<'a> {
    Datagram { came: Nanos, bytes: &'a [u8], arrived: &'a Arrived<'a> },
    Published(Published),
}

/// The process that publishes.
const PID: u32 = 77;
/// The listener's longest sleep.
const LOOK_EVERY_NS: Nanos = 100_000_000;

impl Receiving {
    /// Follows the zones of `names` of the gateway that is called so.
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

    /// The kernel has a datagram, that came now.
    pub(crate) fn catch(&mut self, now: Nanos, bytes: Vec<u8>) {
        self.queue.push_back((now, bytes));
    }

    /// The listener does not run until `until`.
    pub(crate) fn stall(&mut self, until: Nanos) {
        self.stalled_until = until;
    }

    /// When something happens next by itself.
    pub(crate) fn next(&self, now: Nanos) -> Nanos {
        let moment = self.moment(now);
        let left = self.followed.iter().filter_map(|(_, state)| state.left(moment));
        let silence_at = left.min().map_or(Nanos::MAX, |left| now + left.as_nanos() as Nanos);
        silence_at.min(self.look_at.max(self.stalled_until))
    }

    /// Takes what waits, and shows it.
    pub(crate) fn step(&mut self, now: Nanos, hub: &str, mut seen: impl FnMut(Seen<'_>)) {
        if now >= self.stalled_until {
            let wall = self.stamp(now);
            while let Some((came, bytes)) = self.queue.pop_front() {
                let (arrival, mut whole) = (self.stamp(came), Vec::new());
                let arrived = self.incoming.receive(&bytes, 1, arrival, &mut whole);
                seen(Seen::Datagram { came, bytes: &bytes, arrived: &arrived });
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
                self.look_at = now + LOOK_EVERY_NS;
                self.republisher.look(wall.monotonic_ns, wall);
            }
        }
        self.follow(now, seen);
    }

    /// The consumer takes what is published, and sees what is not.
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

    /// The verdict of the sensor at this position.
    pub(crate) fn verdict(&self, position: usize) -> Verdict {
        self.robot.sensors().nth(position).expect("it is followed").1
    }

    /// Since the begin, of a stamp of CLOCK_MONOTONIC here.
    pub(crate) fn since_begin(&self, stamp_ns: u64) -> Nanos {
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
