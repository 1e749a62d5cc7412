//! Judges of invented data: each sample was sent by a scanner, and each remote sample was published by the hub.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::rc::Rc;

use scanhub_network::lan::WINDOW;
use scanhub_schema::datagram::{Announce, Announced, Datagram, DatagramError, Head, Packed};
use scanhub_schema::{Flags, Header, MILLIS, Nanos, Quality, Scan, State, Status, Topic, Zones};

use super::{Judge, Say};
use crate::event::{Arrival, Event};
use crate::family::Family;
use crate::hash::History;
use crate::remote::{Forgery, Packet, Terms};

/// Judge: the hub delivers nothing that no scanner sent, unless it marks it as suspect: each telegram byte by byte, as often as
/// it was sent, and each scan value by value.
pub(crate) struct NothingInvented {
    sensors: Vec<OfSensor>,
}

struct OfSensor {
    family: Rc<dyn Family>,
    /// Number of times that a telegram was sent and not published.
    open: HashMap<u64, u32>,
    /// Published units that were not sent. The next telegram decides whether foreign bytes arrived before it, because
    /// more bytes were read than the known telegrams have.
    strange: Vec<Vec<u8>>,
    /// Place behind the last byte that was read.
    read: u64,
    /// Last telegrams that the line damaged. An empty one stands for foreign bytes between two telegrams.
    damaged: VecDeque<Vec<u8>>,
    /// Place behind the last telegram.
    end: u64,
    /// Number, life and bytes of the last published sample of telegrams.
    last: (u64, u64, Vec<u8>),
}

impl NothingInvented {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> NothingInvented {
        let sensor = |family: &Rc<dyn Family>| OfSensor {
            family: family.clone(),
            open: HashMap::new(),
            strange: Vec::new(),
            read: 0,
            damaged: VecDeque::new(),
            end: 0,
            last: Default::default(),
        };
        NothingInvented { sensors: sensors.iter().map(sensor).collect() }
    }
}

impl Judge for NothingInvented {
    fn name(&self) -> &'static str {
        "nothing_invented"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Sent { sensor, telegram } => {
                let of = &mut self.sensors[sensor];
                *of.open.entry(History::of(telegram.bytes)).or_default() += 1;
                let (begin, end) = telegram.span;
                if std::mem::replace(&mut of.end, end) < begin {
                    of.damage(&[]);
                }
                if telegram.damage.is_some() {
                    of.damage(telegram.bytes);
                }
                of.judge_strange(sensor, say);
            }
            Event::Read { sensor, to, .. } => self.sensors[sensor].read = to,
            Event::Published { sensor, sample } if sample.topic == Topic::Telegram => {
                let of = &mut self.sensors[sensor];
                for unit in of.family.units(&sample.bytes) {
                    let is_known = of.take(History::of(unit));
                    let mut damaged = of.damaged.iter().map(Vec::as_slice);
                    let is_clean = sample.header.reasons == 0;
                    if !is_known && is_clean && !of.family.is_collision(unit, &mut damaged) {
                        of.strange.push(unit.to_vec());
                    }
                }
                if of.read <= of.end {
                    of.judge_strange(sensor, say);
                }
                (of.last.0, of.last.1) = (sample.header.seq, sample.header.boot);
                of.last.2.clear();
                of.last.2.extend_from_slice(&sample.bytes);
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Scan => {
                let OfSensor { family, last: (seq, boot, telegram), .. } = &self.sensors[sensor];
                let mut scan = Box::<Scan>::default();
                if !Scan::unpack_into(&mut scan, &sample.bytes) {
                    say.broken(format!("sensor {sensor}: what is no scan"));
                }
                if (*seq, *boot) == (sample.header.seq, sample.header.boot)
                    && !family.is_scan_of(&scan, telegram)
                {
                    say.broken(format!("sensor {sensor}: a scan that is not that of telegram {seq}"));
                }
            }
            _ => {}
        }
    }
}

impl OfSensor {
    /// Reports strange units that are not a mixture of damaged telegrams.
    fn judge_strange(&mut self, sensor: usize, say: &mut Say<'_>) {
        for unit in std::mem::take(&mut self.strange) {
            if !self.family.is_collision(&unit, &mut self.damaged.iter().map(Vec::as_slice)) {
                say.broken(format!("sensor {sensor} did not send {unit:02X?}"));
            }
        }
    }

    /// The line damaged `telegram`.
    fn damage(&mut self, telegram: &[u8]) {
        self.damaged.truncate(REMEMBERED - 1);
        self.damaged.push_front(telegram.to_vec());
    }

    /// Takes a telegram that was sent and not published. Returns whether there is one.
    fn take(&mut self, key: u64) -> bool {
        let Entry::Occupied(mut entry) = self.open.entry(key) else { return false };
        *entry.get_mut() -= 1;
        if *entry.get() == 0 {
            entry.remove();
        }
        true
    }
}

/// Number of damaged telegrams that are kept.
const REMEMBERED: usize = 4;

/// Judge: the network delivers nothing that the hub did not publish. The listener accepts no datagram that was not sent with
/// the same bits. It refuses no datagram that was, except after the end of its gateway's run, or with a key if the datagram is
/// not known to be new. A listener publishes samples of the hub with number, time and quality, and never a part of one.
///
/// Two samples have no source (`docs/topics.md`): unknown zones, because no sample arrived, and a silent sensor after 3 s of
/// silence. A late listener may report a silence of the past, so its stamp counts: no sample arrived in the 3 s before it.
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

/// Judge: with a key, a listener refuses every forged datagram for the right reason, and never accepts a recorded datagram
/// as new. Other judges check that it counts all refusals and always accepts the right gateway.
#[derive(Default)]
pub(crate) struct RemoteKeys {
    forged: HashMap<u64, Forgery>,
    /// Datagrams that were recorded and sent again.
    again: HashSet<u64>,
    /// Datagrams that the running listener accepted.
    taken: HashSet<u64>,
}

impl Judge for RemoteKeys {
    fn name(&self) -> &'static str {
        "remote_keys"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::ListenerBegins { .. } => self.taken.clear(),
            Event::Forged { forgery: Forgery::Recording, bytes } => _ = self.again.insert(History::of(bytes)),
            Event::Forged { forgery, bytes } => _ = self.forged.insert(History::of(bytes), forgery),
            Event::Arrived { datagram, bytes, outcome, .. } => {
                let bytes = History::of(bytes);
                let is_new = matches!(outcome, Arrival::Announced | Arrival::Sample { late: false });
                if let Some(forgery) = self.forged.get(&bytes) {
                    let due = match forgery {
                        Forgery::Plain => DatagramError::Unauthenticated,
                        _ => DatagramError::Mac,
                    };
                    if outcome != Arrival::Refused(due) {
                        say.broken(format!("{forgery:?}, and it is {outcome:?}, due {due:?}: {datagram:?}"));
                    }
                } else if is_new && !self.taken.insert(bytes) {
                    say.broken(format!("it was taken before: {datagram:?}"));
                } else if is_new && self.again.contains(&bytes) {
                    say.broken(format!("it was recorded: {datagram:?}"));
                }
            }
            _ => {}
        }
    }
}
