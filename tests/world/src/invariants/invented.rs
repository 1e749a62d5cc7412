//! Invariants against invented data. A scanner has sent the data of each sample, and the hub has published each remote
//! sample.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::rc::Rc;

use scanhub_network::lan::WINDOW_LEN;
use scanhub_schema::datagram::{Announce, Announced, Datagram, DatagramError, DatagramPayload, Head};
use scanhub_schema::{Flags, Header, MILLIS, Nanos, Quality, Scan, State, Status, Topic, Zones};

use super::{Invariant, ViolationReporter};
use crate::event::{DatagramOutcome, Event};
use crate::family::Family;
use crate::hash::HistoryHash;
use crate::remote::{Forgery, LinkSettings, PayloadBuffer};

/// Invariant: the hub delivers only what a scanner sent, except for data that the hub marks as suspect. Each telegram
/// is compared byte by byte, and is published at most as often as it was sent. Each scan is compared with its telegram
/// value by value.
pub(crate) struct NothingInvented {
    sensors: Vec<SensorTelegrams>,
}

struct SensorTelegrams {
    family: Rc<dyn Family>,
    /// Number of times that each telegram was sent and not yet published. The key is the hash of the telegram.
    unpublished: HashMap<u64, u32>,
    /// Published units that no scanner sent. If the hub has read more bytes than the known telegrams contain, foreign
    /// bytes may have arrived. Then the units are checked only after the next telegram, because its position shows
    /// whether foreign bytes did arrive.
    foreign: Vec<Vec<u8>>,
    /// Position after the last byte that was read.
    read_end: u64,
    /// Last telegrams that the line damaged. An empty entry represents foreign bytes between two telegrams, which no
    /// scanner sent.
    damaged: VecDeque<Vec<u8>>,
    /// Position after the last telegram.
    sent_end: u64,
    /// Sequence number, boot ID and bytes of the last published sample of topic `telegram`.
    last: (u64, u64, Vec<u8>),
}

impl NothingInvented {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> NothingInvented {
        let sensor = |family: &Rc<dyn Family>| SensorTelegrams {
            family: family.clone(),
            unpublished: HashMap::new(),
            foreign: Vec::new(),
            read_end: 0,
            damaged: VecDeque::new(),
            sent_end: 0,
            last: Default::default(),
        };
        NothingInvented { sensors: sensors.iter().map(sensor).collect() }
    }
}

impl Invariant for NothingInvented {
    fn name(&self) -> &'static str {
        "nothing_invented"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Sent { sensor, telegram } => {
                let of = &mut self.sensors[sensor];
                *of.unpublished.entry(HistoryHash::hash_bytes(telegram.bytes)).or_default() += 1;
                let (begin, end) = telegram.span;
                if std::mem::replace(&mut of.sent_end, end) < begin {
                    of.damage(&[]);
                }
                if telegram.damage.is_some() {
                    of.damage(telegram.bytes);
                }
                of.check_foreign(sensor, reporter);
            }
            Event::Read { sensor, to, .. } => self.sensors[sensor].read_end = to,
            Event::Published { sensor, sample } if sample.topic == Topic::Telegram => {
                let of = &mut self.sensors[sensor];
                for unit in of.family.telegrams(&sample.bytes) {
                    let is_known = of.take(HistoryHash::hash_bytes(unit));
                    let mut damaged = of.damaged.iter().map(Vec::as_slice);
                    let is_clean = sample.header.reasons == 0;
                    if !is_known && is_clean && !of.family.is_collision(unit, &mut damaged) {
                        of.foreign.push(unit.to_vec());
                    }
                }
                if of.read_end <= of.sent_end {
                    of.check_foreign(sensor, reporter);
                }
                (of.last.0, of.last.1) = (sample.header.seq, sample.header.boot);
                of.last.2.clear();
                of.last.2.extend_from_slice(&sample.bytes);
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Scan => {
                let SensorTelegrams { family, last: (seq, boot, telegram), .. } = &self.sensors[sensor];
                let mut scan = Box::<Scan>::default();
                if !Scan::unpack_into(&mut scan, &sample.bytes) {
                    reporter.report(format!("sensor {sensor}: a sample that is not a valid scan"));
                }
                if (*seq, *boot) == (sample.header.seq, sample.header.boot)
                    && !family.is_scan_of(&scan, telegram)
                {
                    reporter.report(format!("sensor {sensor}: a scan that differs from telegram {seq}"));
                }
            }
            _ => {}
        }
    }
}

impl SensorTelegrams {
    /// Reports each foreign unit, except a unit that may be a mixture of damaged telegrams.
    fn check_foreign(&mut self, sensor: usize, reporter: &mut ViolationReporter<'_>) {
        for unit in std::mem::take(&mut self.foreign) {
            if !self.family.is_collision(&unit, &mut self.damaged.iter().map(Vec::as_slice)) {
                reporter.report(format!("sensor {sensor} did not send {unit:02X?}"));
            }
        }
    }

    /// Stores a telegram that the line damaged.
    fn damage(&mut self, telegram: &[u8]) {
        self.damaged.truncate(MAX_DAMAGED - 1);
        self.damaged.push_front(telegram.to_vec());
    }

    /// Removes the telegram with the hash `key` from the telegrams that were sent and not yet published. Returns
    /// whether it was one of them.
    fn take(&mut self, key: u64) -> bool {
        let Entry::Occupied(mut entry) = self.unpublished.entry(key) else { return false };
        *entry.get_mut() -= 1;
        if *entry.get() == 0 {
            entry.remove();
        }
        true
    }
}

/// Maximum number of stored damaged telegrams.
const MAX_DAMAGED: usize = 4;

/// Invariant: the network delivers nothing that the hub did not publish. The listener accepts only datagrams that were
/// sent with the same bits. It accepts every datagram that was sent, with two exceptions: the run of the gateway has
/// ended, or the listener has a key and cannot decide whether the datagram is new. A listener publishes samples of the
/// hub with sequence number, time and quality, and never only a part of a sample.
///
/// Two samples have no source (`docs/topics.md`). The first one is unknown zones, which the listener publishes because
/// no sample arrived. The second one is a status that reports a silent sensor, after 3 s of silence. A listener that
/// runs late may report a past silence, so the invariant checks the stamp of the status: no sample arrived in the 3 s
/// before it.
pub(crate) struct RemoteNothingInvented {
    published: HashSet<u64>,
    /// Boot IDs of the hub's runs.
    boots: HashSet<u64>,
    /// Hashes of the sent datagrams by epoch, sensor, topic, sequence number and part.
    sent: BTreeMap<(u32, u8, u8, u32, u8), u64>,
    /// Highest epoch that the listener accepted.
    epoch: u32,
    /// Epoch and sensor of each announcement that the listener accepted. Before this announcement, the listener cannot
    /// assign a sample to a sensor.
    announced: HashSet<(u32, u8)>,
    /// Sensor and time of arrival of each sample that the listener accepted, assigned to a sensor and did not mark as
    /// late.
    arrived_at: BTreeSet<(usize, Nanos)>,
    /// Two sequence numbers for each epoch, sensor and topic: the first one that was announced to the listener, and the
    /// highest one that the listener accepted. Only used if the listener has a key.
    numbers: BTreeMap<(u32, u8, u8), (u32, u32)>,
    has_key: bool,
    /// `CLOCK_MONOTONIC` of the listener's machine when the world began.
    clock_offset: Nanos,
    packet: PayloadBuffer,
    /// Payload of unknown zones. A listener may publish these zones although the hub did not publish them.
    unknown: Vec<u8>,
}

impl RemoteNothingInvented {
    pub(crate) fn new(terms: &LinkSettings) -> Self {
        let mut unknown = vec![0; size_of::<Zones>()];
        let len = Zones::unknown().pack(&mut unknown).unwrap_or_default();
        unknown.truncate(len);
        RemoteNothingInvented {
            published: HashSet::new(),
            boots: HashSet::new(),
            sent: BTreeMap::new(),
            epoch: 0,
            announced: HashSet::new(),
            arrived_at: BTreeSet::new(),
            numbers: BTreeMap::new(),
            has_key: terms.has_key,
            clock_offset: terms.initial_clocks.monotonic_ns,
            packet: PayloadBuffer::new(terms),
            unknown,
        }
    }
}

impl RemoteNothingInvented {
    /// Returns whether a listener with a key is right to refuse a datagram. The refusal is right if the datagram
    /// arrived before the announcement of its sensor. It is also right if the datagram is older than the announcement
    /// or than the window of sequence numbers, which is true of a recorded datagram.
    fn is_rightly_refused(&self, head: &Head, reason: DatagramError) -> bool {
        let known = self.numbers.get(&(head.epoch, head.sensor, head.topic));
        match (reason, known) {
            (DatagramError::Untimely, None) => self.has_key,
            (DatagramError::Stale, Some((first, highest))) => {
                self.has_key && (head.sequence < *first || head.sequence + WINDOW_LEN as u32 <= *highest)
            }
            _ => false,
        }
    }

    /// Stores the sequence numbers of a datagram that the listener accepted.
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

impl Invariant for RemoteNothingInvented {
    fn name(&self) -> &'static str {
        "remote_nothing_invented"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::HubStarted { boot, .. } => _ = self.boots.insert(boot),
            Event::Published { sensor, sample } => {
                if let Some(payload) = self.packet.encode(sample) {
                    self.published.insert(key(sensor, sample.topic, &sample.header, payload));
                }
            }
            Event::Transmitted { datagram, bytes, .. } => {
                _ = self.sent.insert(part_key(datagram), HistoryHash::hash_bytes(bytes))
            }
            Event::ListenerStarted { .. } => {
                // A listener with a key saves the epoch.
                self.epoch = if self.has_key { self.epoch } else { 0 };
                self.numbers.clear();
                self.announced.clear();
                self.arrived_at.clear();
            }
            Event::Arrived { arrived_at, datagram, bytes, outcome } => {
                let sent = datagram.and_then(|datagram| self.sent.get(&part_key(datagram)).copied());
                let is_sent = sent == Some(HistoryHash::hash_bytes(bytes));
                match (outcome, datagram) {
                    (DatagramOutcome::Refused(why), Some(datagram)) if is_sent => {
                        let is_over = datagram.head.epoch < self.epoch && why == DatagramError::Epoch;
                        if !is_over && !self.is_rightly_refused(&datagram.head, why) {
                            reporter.report(format!("{why:?}: {:?}", datagram.head));
                        }
                    }
                    (DatagramOutcome::Refused(_), _) => {}
                    (DatagramOutcome::Part, Some(_)) if is_sent => {}
                    (_, Some(datagram)) if is_sent => {
                        let head = &datagram.head;
                        self.epoch = self.epoch.max(head.epoch);
                        let gateway_sensor = (head.epoch, head.sensor);
                        self.take_number(datagram);
                        match outcome {
                            DatagramOutcome::Announcement => _ = self.announced.insert(gateway_sensor),
                            DatagramOutcome::Sample { late: false }
                                if self.announced.contains(&gateway_sensor) =>
                            {
                                self.arrived_at.insert((head.sensor.into(), arrived_at));
                            }
                            _ => {}
                        }
                    }
                    _ => reporter.report(format!("{} bytes that were not sent like this", bytes.len())),
                }
            }
            Event::Republished { sensor, topic, header, payload } => {
                let is_published = self.published.contains(&key(sensor, topic, header, payload));
                let is_listener_report = match topic {
                    Topic::Zones => payload == self.unknown,
                    Topic::Status => {
                        let arrived_ns = header.stamp_last_ns.saturating_sub(self.clock_offset);
                        let before =
                            (sensor, (arrived_ns + 1).saturating_sub(SILENCE_TIMEOUT))..(sensor, arrived_ns);
                        let is_silent = arrived_ns <= at && self.arrived_at.range(before).next().is_none();
                        is_silent && status(payload).state() == Some(State::Silent)
                    }
                    _ => false,
                };
                if !is_published && !is_listener_report {
                    reporter.report(format!(
                        "sensor {sensor}: {topic:?} was not published by the hub: {header:?}"
                    ));
                }
                if usize::from(header.sensor) != sensor || !self.boots.contains(&header.boot) {
                    reporter.report(format!("sensor {sensor}: unknown sensor or hub: {header:?}"));
                }
            }
            _ => {}
        }
    }
}

/// Returns a hash of everything in a sample that a network must not change. The stamps of a status may change: the
/// status gets its stamp when it is sent, and its state starts when the listener first receives the state.
fn key(sensor: usize, topic: Topic, header: &Header, payload: &[u8]) -> u64 {
    let flags = header.flags & (Flags::SIMULATED | Flags::REPLAYED | Flags::STAMP_ESTIMATED);
    let is_suspect = header.quality() == Quality::Suspect;
    let mut history = HistoryHash::new();
    history.add_number(sensor as u64);
    history.add_number(topic as u64);
    history.add_number(u64::from(header.seq as u32));
    history.add_number(u64::from(flags) << 1 | u64::from(is_suspect));
    if topic == Topic::Status {
        history.add_bytes(bytemuck::bytes_of(&Status { since_ns: 0, ..status(payload) }));
    } else {
        history.add_number(header.wall_ns);
        history.add_bytes(payload);
    }
    history.value()
}

fn status(payload: &[u8]) -> Status {
    let mut status = Status::default();
    let _ = status.unpack(payload);
    status
}

fn part_key(datagram: &Datagram<'_>) -> (u32, u8, u8, u32, u8) {
    let head = &datagram.head;
    (head.epoch, head.sensor, head.topic, head.sequence, head.part)
}

/// Time without a sample after which a sensor is silent.
const SILENCE_TIMEOUT: Nanos = 3_000 * MILLIS;

/// Invariant: a listener with a key refuses every forged datagram for the right reason, and never accepts a recorded
/// datagram as new. Other invariants check that the listener counts all refusals and always accepts the right gateway.
#[derive(Default)]
pub(crate) struct RemoteKeys {
    forged: HashMap<u64, Forgery>,
    /// Hashes of the datagrams that were recorded and sent again.
    replayed: HashSet<u64>,
    /// Hashes of the datagrams that the running listener accepted.
    accepted: HashSet<u64>,
}

impl Invariant for RemoteKeys {
    fn name(&self) -> &'static str {
        "remote_keys"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::ListenerStarted { .. } => self.accepted.clear(),
            Event::Forged { forgery: Forgery::Recording, bytes } => {
                _ = self.replayed.insert(HistoryHash::hash_bytes(bytes))
            }
            Event::Forged { forgery, bytes } => {
                _ = self.forged.insert(HistoryHash::hash_bytes(bytes), forgery)
            }
            Event::Arrived { datagram, bytes, outcome, .. } => {
                let bytes = HistoryHash::hash_bytes(bytes);
                let is_new = matches!(
                    outcome,
                    DatagramOutcome::Announcement | DatagramOutcome::Sample { late: false }
                );
                if let Some(forgery) = self.forged.get(&bytes) {
                    let due = match forgery {
                        Forgery::Plain => DatagramError::Unauthenticated,
                        _ => DatagramError::Mac,
                    };
                    if outcome != DatagramOutcome::Refused(due) {
                        reporter.report(format!("{forgery:?}: {outcome:?} instead of {due:?}: {datagram:?}"));
                    }
                } else if is_new && !self.accepted.insert(bytes) {
                    reporter.report(format!("accepted twice: {datagram:?}"));
                } else if is_new && self.replayed.contains(&bytes) {
                    reporter.report(format!("accepted although it was recorded: {datagram:?}"));
                }
            }
            _ => {}
        }
    }
}
