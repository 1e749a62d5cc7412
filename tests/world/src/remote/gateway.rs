//! A run of a gateway: it subscribes to topics of the hub like any subscriber, and passes datagrams to a network.

use scanhub_client::clock::Moment;
use scanhub_client::streams::{Noted, Numbers, ZonesState};
use scanhub_network::lan::Stamp;
use scanhub_network::lan::outgoing::{
    ANNOUNCE_EVERY, Form, Outgoing, PayloadRef, Sample as Outbound, Transmit,
};
use scanhub_schema::datagram::{Datagram, HEAD, PARTS};
use scanhub_schema::{MILLIS, Nanos, Topic};

use super::{Terms, WAKES};
use crate::consumer::Number;
use crate::event::Event;
use crate::network::Network;
use crate::planted::Defect;
use crate::setup::Setup;
use crate::shared::Shared;
use crate::topics::Sample;

/// The gateway.
pub(super) struct Gateway {
    outgoing: Outgoing,
    epoch: u32,
    sources: Vec<Source>,
    /// What is known of each sensor's zones.
    zones: Vec<ZonesState>,
    repeat: Option<std::time::Duration>,
    /// When it looks at its topics.
    next_at: Nanos,
    tick_at: Nanos,
}

/// One topic of one sensor.
struct Source {
    sensor: usize,
    topic: Topic,
    number: Number,
    numbers: Numbers,
    /// There was a place for it.
    is_attached: bool,
}

impl Gateway {
    /// Number `life` of all gateways follows `sensors`.
    pub(super) fn begin(shared: &Shared, terms: &Terms, life: u32, sensors: usize) -> Gateway {
        let (now, epoch) = (shared.clock.get(), EPOCH + life);
        shared.tell(&Event::GatewayBegins { epoch });
        let form = terms.key().map_or(Form::Sealed, Form::Authenticated);
        let mut outgoing = match terms.are_bridges {
            true => Outgoing::waiting(HUB, epoch),
            false => Outgoing::new(HUB, epoch, form, terms.longest),
        };
        let mut sources = Vec::new();
        for sensor in 0..sensors {
            let position = outgoing.follow(&Setup::name(sensor), |topic| terms.every(topic));
            for topic in Topic::OF_LINKS.into_iter().filter(|&topic| outgoing.wants(position, topic)) {
                let number = Number(NUMBERS * life + sources.len() as u32);
                let numbers = Numbers::default();
                sources.push(Source { sensor, topic, number, numbers, is_attached: false });
            }
        }
        sources.iter_mut().for_each(|source| source.attach(shared));
        let zones = (0..sensors).map(|_| ZonesState::new(moment(now))).collect();
        let (repeat, next_at, tick_at) = (terms.repeat, now + GREETING, now + TICK);
        Gateway { outgoing, epoch, sources, zones, repeat, next_at, tick_at }
    }

    /// The hub woke the consumers of a sensor at `at`.
    pub(super) fn wake(&mut self, at: Nanos) {
        self.next_at = self.next_at.min(at + WAKES);
    }

    /// When it has something to do.
    pub(super) fn next_ns(&self, now: Nanos) -> Nanos {
        let left = self.zones.iter().filter_map(|zones| zones.left(moment(now))).min();
        let silence = left.map_or(Nanos::MAX, |left| now.saturating_add(left.as_nanos() as Nanos));
        silence.min(self.next_at).min(self.tick_at)
    }

    /// Sends what waits, and what is due.
    pub(super) fn run(&mut self, shared: &Shared, now: Nanos, uplink: &mut Uplink<'_>) {
        self.next_at = Nanos::MAX;
        let stamp = stamp(shared, now);
        let Gateway { outgoing, sources, zones, .. } = self;
        for source in sources.iter_mut() {
            let (sensor, zones) = (source.sensor, &mut zones[source.sensor]);
            while let Some((sample, missed)) = source.take(shared, now) {
                let header = Some(&sample.header);
                lend(&sample, |payload| match payload {
                    PayloadRef::Zones(said) => {
                        let heard = zones.take(&sample.header, said, missed, moment(now));
                        let payload = PayloadRef::Zones(&heard.zones);
                        outgoing.sample(sensor, &Outbound { header, missed, payload }, stamp, uplink);
                    }
                    payload => outgoing.sample(sensor, &Outbound { header, missed, payload }, stamp, uplink),
                });
            }
            if source.topic == Topic::Zones
                && let Some(silence) = zones.silence(moment(now))
            {
                let payload = PayloadRef::Zones(&silence.zones);
                outgoing.sample(sensor, &Outbound { header: None, missed: 0, payload }, stamp, uplink);
            }
        }
        if now >= self.tick_at {
            self.tick_at = now + TICK;
            self.sources
                .iter_mut()
                .filter(|source| !source.is_attached)
                .for_each(|source| source.attach(shared));
            if let Some(every) = self.repeat {
                self.outgoing.repeat(every, stamp, uplink);
            }
            if !shared.planted.is(Defect::Unannounced) {
                self.announce(shared, now, uplink);
            }
        }
    }

    /// Says who all sensors are.
    pub(super) fn announce(&mut self, shared: &Shared, now: Nanos, uplink: &mut Uplink<'_>) {
        self.outgoing.announce(stamp(shared, now), uplink);
    }

    /// Whether a sample waits until it is handed over.
    pub(super) fn is_waiting(&self) -> bool {
        self.outgoing.is_waiting()
    }

    /// The sample that has waited for longest, which is handed over now and taken or not.
    pub(super) fn hand(&mut self, shared: &Shared, now: Nanos, is_taken: bool) -> Option<Vec<u8>> {
        if shared.planted.strikes(Defect::RouterUntold, 100) {
            self.outgoing.hand(stamp(shared, now));
        }
        let handed = self.outgoing.hand(stamp(shared, now))?;
        let (sensor, topic, bytes) = (handed.sensor.0, handed.topic, handed.datagram.to_vec());
        let datagram = Datagram::read(&bytes).expect("a bridge makes whole datagrams");
        shared.log.tell(now, &Event::Transmitted { datagram: &datagram, bytes: &bytes, is_taken });
        if !is_taken {
            self.outgoing.not_taken(sensor, topic, bytes.len());
        }
        Some(bytes)
    }

    /// It is gone.
    pub(super) fn leave(self, shared: &Shared, is_killed: bool, is_drained: bool) {
        for (sensor, rows) in self.outgoing.account().enumerate() {
            for (topic, row) in rows.used() {
                shared.tell(&Event::Accounted { sensor, topic, row });
            }
        }
        for source in self.sources.into_iter().filter(|source| source.is_attached) {
            shared.board.borrow_mut().detach(source.sensor, source.topic, source.number, is_killed);
            shared.tell(&Event::Left { consumer: source.number, is_drained });
        }
        shared.tell(&Event::GatewayEnds { epoch: self.epoch, is_killed });
    }
}

impl Source {
    /// Takes a place, if there is one.
    fn attach(&mut self, shared: &Shared) {
        let Source { sensor, topic, number, .. } = *self;
        self.is_attached = shared.board.borrow_mut().attach(sensor, topic, number, false);
        if self.is_attached {
            let (is_prompt, is_listener) = (false, false);
            shared.tell(&Event::Attached { consumer: number, sensor, topic, is_prompt, is_listener });
        }
    }

    /// The oldest sample that waits, and how many were missed before it.
    fn take(&mut self, shared: &Shared, now: Nanos) -> Option<(std::rc::Rc<Sample>, u64)> {
        let sample = shared.board.borrow_mut().take(self.sensor, self.topic, self.number)?;
        let Noted { missed, .. } = self.numbers.note(&sample.header);
        shared.log.tell(now, &Event::Taken { consumer: self.number, sample: &sample, missed });
        Some((sample, missed))
    }
}

/// The way to the network.
pub(super) struct Uplink<'a> {
    pub(super) shared: &'a Shared,
    pub(super) now: Nanos,
    pub(super) random: &'a mut fastrand::Rng,
    pub(super) refusal: f64,
    pub(super) network: &'a mut Network,
}

impl Transmit for Uplink<'_> {
    fn transmit(&mut self, bytes: &[u8], _group: u8, _above: u8) -> bool {
        let is_taken = self.refusal <= 0.0 || self.random.f64() >= self.refusal;
        let datagram = Datagram::read(bytes).expect("a gateway makes whole datagrams");
        self.shared.log.tell(self.now, &Event::Transmitted { datagram: &datagram, bytes, is_taken });
        if is_taken {
            self.network.send(self.now, bytes);
        }
        is_taken
    }
}

/// The clocks of the hub's machine.
fn stamp(shared: &Shared, now: Nanos) -> Stamp {
    Stamp { monotonic_ns: now, wall_ns: now + shared.wall_ahead.get() }
}

fn moment(now: Nanos) -> Moment {
    Moment { monotonic_ns: now, boottime_ns: now }
}

/// The gateway's number.
const HUB: u64 = 0x5f3a_12bc_00d1_e2f3;
/// The epoch before the first one.
const EPOCH: u32 = 1_780_000_000;
/// As consumers, gateways have numbers beyond those of all others.
pub(crate) const NUMBERS: u32 = 1_000_000;
/// Between two announcements.
const TICK: Nanos = ANNOUNCE_EVERY.as_nanos() as Nanos;
/// A hub that lives hands what it keeps to newcomers within so long, and wakes nobody for it.
const GREETING: Nanos = 110 * MILLIS;

/// Defines `lend`, which reads the bytes of a sample by the table of topics.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Passes the payload of `sample` to `to`.
        fn lend<R>(sample: &Sample, to: impl FnOnce(PayloadRef<'_>) -> R) -> R {
            match sample.topic {
                $(scanhub_schema::Topic::$topic => to(PayloadRef::$topic(payloads!($payload sample))),)*
            }
        }
    };
    ([u8] $sample:ident) => {
        &$sample.bytes
    };
    (Scan $sample:ident) => {
        &scanhub_schema::Scan::of_bytes(&$sample.bytes)
    };
    (Foreground $sample:ident) => {
        &scanhub_schema::Foreground::of_bytes(&$sample.bytes)
    };
    (Background $sample:ident) => {
        &scanhub_schema::Background::of_bytes(&$sample.bytes)
    };
    (Cloud $sample:ident) => {
        &scanhub_schema::Cloud::of_bytes(&$sample.bytes)
    };
    ($payload:ident $sample:ident) => {
        &bytemuck::pod_read_unaligned::<scanhub_schema::$payload>(&$sample.bytes)
    };
}

scanhub_schema::for_each_topic!(payloads);

/// Buffer for a payload as in datagrams. Its size limits some payloads.
pub(crate) struct Packet {
    room: Vec<u8>,
}

impl Packet {
    pub(crate) fn new(terms: &Terms) -> Packet {
        // A bridge sends samples whole.
        let room = if terms.are_bridges { u16::MAX.into() } else { PARTS * (terms.longest - HEAD) };
        Packet { room: vec![0; room] }
    }

    /// Returns the payload of `sample` in datagrams, or `None` if it does not fit.
    pub(crate) fn of(&mut self, sample: &Sample) -> Option<&[u8]> {
        let len = lend(sample, |payload| payload.pack(&mut self.room))?;
        self.room.get(..len)
    }
}
