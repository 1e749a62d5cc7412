//! Nothing comes over the network that the hub did not publish: no datagram is taken that was not sent like this bit by bit,
//! none is refused that came as it was sent, unless its gateway's life is over, or a key is given and it is not known to be new, and what a listener publishes is byte by byte
//! what the hub published, with its number, time and quality, and never a half of it.
//!
//! Two things nobody published (`docs/topics.md`): zones that are unknown, because nothing came, and that a sensor is silent,
//! after 3 s of it. A listener that is behind may say so of a time that is over: what counts is the stamp, by which nothing
//! came in the 3 s before.

use std::collections::{BTreeMap, BTreeSet, HashSet};

use scanhub_schema::datagram::{Announce, Announced, Datagram, DatagramError, Head, Packed, WINDOW};
use scanhub_schema::{Flags, Header, MILLIS, Nanos, Quality, State, Status, Topic, Zones};

use super::{Judge, Say};
use crate::event::{Arrival, Event};
use crate::hash::History;
use crate::remote::{Packet, Terms};

/// What was published and sent.
pub(crate) struct RemoteNothingInvented {
    published: HashSet<u64>,
    /// Lives of the hub.
    boots: HashSet<u64>,
    /// By epoch, sensor, topic, number and part.
    sent: BTreeMap<(u32, u8, u8, u32, u8), u64>,
    /// The greatest epoch that the listener took.
    epoch: u32,
    /// Epoch and sensor of the announcements that the listener took: before it nobody knows whose samples are.
    named: HashSet<(u32, u8)>,
    /// When samples of each sensor came that the listener took, knew and did not find late.
    heard_at: BTreeSet<(usize, Nanos)>,
    /// With a key: by epoch, sensor and topic the first number that was announced to the listener, and the highest it took.
    numbers: BTreeMap<(u32, u8, u8), (u32, u32)>,
    has_key: bool,
    /// CLOCK_MONOTONIC of the listener's machine when the world began.
    clock: Nanos,
    packet: Packet,
    /// What everybody may say.
    unknown: Vec<u8>,
}

impl RemoteNothingInvented {
    pub(crate) fn new(terms: &Terms) -> Self {
        let mut unknown = vec![0; size_of::<Zones>()];
        let len = Zones::unknown().pack(&mut unknown).unwrap_or_default();
        unknown.truncate(len);
        RemoteNothingInvented {
            published: HashSet::new(),
            boots: HashSet::new(),
            sent: BTreeMap::new(),
            epoch: 0,
            named: HashSet::new(),
            heard_at: BTreeSet::new(),
            numbers: BTreeMap::new(),
            has_key: terms.has_key,
            clock: terms.clocks.monotonic_ns,
            packet: Packet::new(terms),
            unknown,
        }
    }
}

impl RemoteNothingInvented {
    /// Whether a listener with a key refuses it rightly: it came before its sensor's announcement, or is older than that, or
    /// than the window, as a recording is.
    fn is_before(&self, head: &Head, why: DatagramError) -> bool {
        let known = self.numbers.get(&(head.epoch, head.sensor, head.topic));
        match (why, known) {
            (DatagramError::Untimely, None) => self.has_key,
            (DatagramError::Stale, Some((first, highest))) => {
                self.has_key && (head.sequence < *first || head.sequence + WINDOW as u32 <= *highest)
            }
            _ => false,
        }
    }

    /// The listener took this.
    fn take_number(&mut self, datagram: &Datagram<'_>) {
        let head = &datagram.head;
        let own = self.numbers.entry((head.epoch, head.sensor, head.topic));
        let own = own.or_insert((head.sequence, head.sequence));
        own.1 = own.1.max(head.sequence);
        if head.topic == Announce::NUMBER
            && let Some(announce) = Announce::unpack(datagram.payload)
        {
            for Announced { topic, next, .. } in announce.topics() {
                self.numbers.entry((head.epoch, head.sensor, *topic)).or_insert((*next, *next));
            }
        }
    }
}

impl Judge for RemoteNothingInvented {
    fn name(&self) -> &'static str {
        "remote_nothing_invented"
    }

    fn note(&mut self, at: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::HubBegins { boot, .. } => _ = self.boots.insert(boot),
            Event::Published { sensor, sample } => {
                if let Some(payload) = self.packet.of(sample) {
                    self.published.insert(key(sensor, sample.topic, &sample.header, payload));
                }
            }
            Event::Transmitted { datagram, bytes, .. } => {
                _ = self.sent.insert(place(datagram), History::of(bytes))
            }
            Event::ListenerBegins { .. } => {
                // With a key it is kept.
                self.epoch = if self.has_key { self.epoch } else { 0 };
                self.numbers.clear();
                self.named.clear();
                self.heard_at.clear();
            }
            Event::Arrived { came, datagram, bytes, outcome } => {
                let sent = datagram.and_then(|datagram| self.sent.get(&place(datagram)).copied());
                let is_sent = sent == Some(History::of(bytes));
                match (outcome, datagram) {
                    (Arrival::Refused(why), Some(datagram)) if is_sent => {
                        let is_over = datagram.head.epoch < self.epoch && why == DatagramError::Epoch;
                        if !is_over && !self.is_before(&datagram.head, why) {
                            say.broken(format!("{why:?}: {:?}", datagram.head));
                        }
                    }
                    (Arrival::Refused(_), _) => {}
                    (Arrival::Part, Some(_)) if is_sent => {}
                    (_, Some(datagram)) if is_sent => {
                        let head = &datagram.head;
                        self.epoch = self.epoch.max(head.epoch);
                        let life = (head.epoch, head.sensor);
                        self.take_number(datagram);
                        match outcome {
                            Arrival::Announced => _ = self.named.insert(life),
                            Arrival::Sample { late: false } if self.named.contains(&life) => {
                                self.heard_at.insert((head.sensor.into(), came));
                            }
                            _ => {}
                        }
                    }
                    _ => say.broken(format!("{} bytes that nobody sent so", bytes.len())),
                }
            }
            Event::Republished { sensor, topic, header, payload } => {
                let is_published = self.published.contains(&key(sensor, topic, header, payload));
                let is_said = match topic {
                    Topic::Zones => payload == self.unknown,
                    Topic::Status => {
                        let said = header.stamp_last_ns.saturating_sub(self.clock);
                        let before = (sensor, (said + 1).saturating_sub(SILENT))..(sensor, said);
                        let is_silent = said <= at && self.heard_at.range(before).next().is_none();
                        is_silent && status(payload).state() == Some(State::Silent)
                    }
                    _ => false,
                };
                if !is_published && !is_said {
                    say.broken(format!("sensor {sensor}: nobody published this {topic:?}: {header:?}"));
                }
                if usize::from(header.sensor) != sensor || !self.boots.contains(&header.boot) {
                    say.broken(format!("sensor {sensor}: of no sensor or hub: {header:?}"));
                }
            }
            _ => {}
        }
    }
}

/// What of a sample stays the same over the network. A status is stamped when it is sent, and the beginning of its state when
/// it is first heard of.
fn key(sensor: usize, topic: Topic, header: &Header, payload: &[u8]) -> u64 {
    let flags = header.flags & (Flags::SIMULATED | Flags::REPLAYED | Flags::STAMP_ESTIMATED);
    let is_suspect = header.quality() == Quality::Suspect;
    let mut history = History::new();
    history.number(sensor as u64);
    history.number(topic as u64);
    history.number(u64::from(header.seq as u32));
    history.number(u64::from(flags) << 1 | u64::from(is_suspect));
    if topic == Topic::Status {
        history.bytes(bytemuck::bytes_of(&Status { since_ns: 0, ..status(payload) }));
    } else {
        history.number(header.wall_ns);
        history.bytes(payload);
    }
    history.value()
}

fn status(payload: &[u8]) -> Status {
    let mut status = Status::default();
    let _ = status.unpack(payload);
    status
}

fn place(datagram: &Datagram<'_>) -> (u32, u8, u8, u32, u8) {
    let head = &datagram.head;
    (head.epoch, head.sensor, head.topic, head.sequence, head.part)
}

/// So long nothing came of a sensor that is silent.
const SILENT: Nanos = 3_000 * MILLIS;
