//! A life of a listener: it takes datagrams in the order in which they came, and publishes what they say. Refuses to know who
//! follows that.

use std::collections::{HashMap, VecDeque};

use scanhub_lan::Stamp;
use scanhub_lan::incoming::{Arrived, Incoming};
use scanhub_lan::republish::Republisher;
use scanhub_schema::datagram::{Datagram, DatagramError, HEAD, Head};
use scanhub_schema::{Nanos, Topic};

use super::robot::GATEWAY;
use super::topics::Memory;
use super::{LOOKS, Terms, WAKES};
use crate::event::{Arrival, Event};
use crate::planted::Defect;
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
            Arrived::Known => Arrival::Known,
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
            Arrived::Refused { .. } | Arrived::Untimely { .. } | Arrived::Part | Arrived::Known => Ok(None),
        };
        if let Err(failure) = made {
            shared.log.tell(now, &Event::Acted { text: &format!("a listener says {failure}") });
        }
    }

    /// It is gone; its account is what it would have told.
    pub(super) fn end(self, shared: &Shared, now: Nanos) {
        let stats = self.incoming.stats();
        for row in stats.rows() {
            shared.log.tell(now, &Event::Counted { row });
        }
        let refused = DatagramError::ALL.iter().map(|&why| stats.refused(why)).sum();
        let (given_up, sensors) = (stats.given_up().lives, self.republisher.names().len());
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
