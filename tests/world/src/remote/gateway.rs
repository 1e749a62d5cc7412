//! A run of a gateway: a subscriber to the hub's topics that sends datagrams to a network.

use scanhub_client::clock::Timestamp;
use scanhub_client::streams::{SequenceGap, SequenceTracker, ZonesState};
use scanhub_network::lan::WallTimestamp;
use scanhub_network::lan::outgoing::{
    ANNOUNCEMENT_INTERVAL, Form, Outgoing, PayloadRef, Sample as Outbound, Transmit,
};
use scanhub_schema::datagram::{Datagram, HEADER_LEN, MAX_PARTS};
use scanhub_schema::{MILLIS, Nanos, Topic};

use super::{LinkSettings, WAKE_DELAY};
use crate::event::Event;
use crate::injected_defects::Defect;
use crate::network::Network;
use crate::setup::Setup;
use crate::shared::SharedState;
use crate::subscriber::SubscriberId;
use crate::topics::Sample;

/// The gateway.
pub(super) struct Gateway {
    outgoing: Outgoing,
    epoch: u32,
    subscriptions: Vec<TopicSubscription>,
    /// State of the zones of each sensor.
    zones: Vec<ZonesState>,
    background_interval: Option<std::time::Duration>,
    /// Time at which the gateway next polls its topics.
    next_poll_at: Nanos,
    tick_at: Nanos,
}

/// Subscription of the gateway to one topic of one sensor.
struct TopicSubscription {
    sensor: usize,
    topic: Topic,
    id: SubscriberId,
    sequence: SequenceTracker,
    /// Whether the topic had a free slot for the gateway.
    is_attached: bool,
}

impl Gateway {
    /// Starts the gateway as run number `run`, with `sensors` sensors.
    pub(super) fn begin(shared: &SharedState, terms: &LinkSettings, run: u32, sensors: usize) -> Gateway {
        let (now, epoch) = (shared.clock.get(), BASE_EPOCH + run);
        shared.log_event(&Event::GatewayStarted { epoch });
        let form = terms.key().map_or(Form::Sealed, Form::Authenticated);
        let mut outgoing = match terms.are_bridges {
            true => Outgoing::with_queue(HUB_ID, epoch),
            false => Outgoing::new(HUB_ID, epoch, form, terms.max_datagram_len),
        };
        let mut subscriptions = Vec::new();
        for sensor in 0..sensors {
            let position = outgoing.follow(&Setup::name(sensor), |topic| terms.send_interval(topic));
            for topic in Topic::OF_LINKS.into_iter().filter(|&topic| outgoing.needs(position, topic)) {
                let id = SubscriberId(FIRST_SUBSCRIBER_ID * run + subscriptions.len() as u32);
                let sequence = SequenceTracker::default();
                subscriptions.push(TopicSubscription { sensor, topic, id, sequence, is_attached: false });
            }
        }
        subscriptions.iter_mut().for_each(|source| source.attach(shared));
        let zones = (0..sensors).map(|_| ZonesState::new(moment(now))).collect();
        let (background_interval, next_poll_at, tick_at) =
            (terms.background_interval, now + HISTORY_DELAY, now + ANNOUNCE_INTERVAL);
        Gateway { outgoing, epoch, subscriptions, zones, background_interval, next_poll_at, tick_at }
    }

    /// Wakes the gateway, because the hub woke the subscribers of a sensor at `at`.
    pub(super) fn wake(&mut self, at: Nanos) {
        self.next_poll_at = self.next_poll_at.min(at + WAKE_DELAY);
    }

    /// Returns the time at which the gateway next has something to do.
    pub(super) fn next_ns(&self, now: Nanos) -> Nanos {
        let left = self.zones.iter().filter_map(|zones| zones.time_left(moment(now))).min();
        let silence = left.map_or(Nanos::MAX, |left| now.saturating_add(left.as_nanos() as Nanos));
        silence.min(self.next_poll_at).min(self.tick_at)
    }

    /// Sends all samples that are queued, and the announcements and silences that are due.
    pub(super) fn run(&mut self, shared: &SharedState, now: Nanos, uplink: &mut Uplink<'_>) {
        self.next_poll_at = Nanos::MAX;
        let stamp = stamp(shared, now);
        let Gateway { outgoing, subscriptions, zones, .. } = self;
        for source in subscriptions.iter_mut() {
            let (sensor, zones) = (source.sensor, &mut zones[source.sensor]);
            while let Some((sample, missed)) = source.take(shared, now) {
                let header = Some(&sample.header);
                lend(&sample, |payload| match payload {
                    PayloadRef::Zones(zones_payload) => {
                        let update = zones.take(&sample.header, zones_payload, missed, moment(now));
                        let payload = PayloadRef::Zones(&update.zones);
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
            self.tick_at = now + ANNOUNCE_INTERVAL;
            self.subscriptions
                .iter_mut()
                .filter(|source| !source.is_attached)
                .for_each(|source| source.attach(shared));
            if let Some(every) = self.background_interval {
                self.outgoing.repeat(every, stamp, uplink);
            }
            if !shared.defect.is_active(Defect::Unannounced) {
                self.announce(shared, now, uplink);
            }
        }
    }

    /// Sends announcements of all sensors.
    pub(super) fn announce(&mut self, shared: &SharedState, now: Nanos, uplink: &mut Uplink<'_>) {
        self.outgoing.announce(stamp(shared, now), uplink);
    }

    /// Returns whether a sample is queued.
    pub(super) fn is_waiting(&self) -> bool {
        self.outgoing.is_waiting()
    }

    /// Removes the sample that has been queued for the longest time, and returns its bytes. With `is_taken`, the
    /// gateway counts the sample as sent, because the router accepts these bytes.
    pub(super) fn take_next(&mut self, shared: &SharedState, now: Nanos, is_taken: bool) -> Option<Vec<u8>> {
        if shared.defect.triggers(Defect::UncountedDrop, 100) {
            self.outgoing.take_next(stamp(shared, now));
        }
        let handed = self.outgoing.take_next(stamp(shared, now))?;
        let (sensor, topic, bytes) = (handed.sensor.0, handed.topic, handed.datagram.to_vec());
        let datagram = Datagram::read(&bytes).expect("a bridge encodes valid datagrams");
        shared.log.record(now, &Event::Transmitted { datagram: &datagram, bytes: &bytes, is_taken });
        if !is_taken {
            self.outgoing.mark_failed(sensor, topic, bytes.len());
        }
        Some(bytes)
    }

    /// Ends the gateway, and detaches its subscriptions.
    pub(super) fn detach(self, shared: &SharedState, is_killed: bool, is_drained: bool) {
        for (sensor, rows) in self.outgoing.counters().enumerate() {
            for (topic, row) in rows.used_topics() {
                shared.log_event(&Event::GatewayCounters { sensor, topic, row });
            }
        }
        for source in self.subscriptions.into_iter().filter(|source| source.is_attached) {
            shared.topics.borrow_mut().detach(source.sensor, source.topic, source.id, is_killed);
            shared.log_event(&Event::Detached { subscriber: source.id, is_drained });
        }
        shared.log_event(&Event::GatewayEnded { epoch: self.epoch, is_killed });
    }
}

impl TopicSubscription {
    /// Attaches to the topic, if it has a free slot.
    fn attach(&mut self, shared: &SharedState) {
        let TopicSubscription { sensor, topic, id, .. } = *self;
        self.is_attached = shared.topics.borrow_mut().attach(sensor, topic, id, false);
        if self.is_attached {
            let (is_prompt, is_listener) = (false, false);
            shared.log_event(&Event::Attached { subscriber: id, sensor, topic, is_prompt, is_listener });
        }
    }

    /// Takes the oldest sample from the queue. Returns the sample and the number of samples that were missed before it.
    fn take(&mut self, shared: &SharedState, now: Nanos) -> Option<(std::rc::Rc<Sample>, u64)> {
        let sample = shared.topics.borrow_mut().take(self.sensor, self.topic, self.id)?;
        let SequenceGap { missed, .. } = self.sequence.note(&sample.header);
        shared.log.record(now, &Event::Taken { subscriber: self.id, sample: &sample, missed });
        Some((sample, missed))
    }
}

/// The gateway's access to the network.
pub(super) struct Uplink<'a> {
    pub(super) shared: &'a SharedState,
    pub(super) now: Nanos,
    pub(super) random: &'a mut fastrand::Rng,
    pub(super) refusal_rate: f64,
    pub(super) network: &'a mut Network,
}

impl Transmit for Uplink<'_> {
    fn transmit(&mut self, bytes: &[u8], _group: u8, _above: u8) -> bool {
        let is_taken = self.refusal_rate <= 0.0 || self.random.f64() >= self.refusal_rate;
        let datagram = Datagram::read(bytes).expect("a gateway encodes valid datagrams");
        self.shared.log.record(self.now, &Event::Transmitted { datagram: &datagram, bytes, is_taken });
        if is_taken {
            self.network.send(self.now, bytes);
        }
        is_taken
    }
}

/// Returns the time of the clocks on the hub's machine.
fn stamp(shared: &SharedState, now: Nanos) -> WallTimestamp {
    WallTimestamp { monotonic_ns: now, wall_ns: now + shared.wall_offset.get() }
}

fn moment(now: Nanos) -> Timestamp {
    Timestamp { monotonic_ns: now, boottime_ns: now }
}

/// ID of the hub in datagrams.
const HUB_ID: u64 = 0x5f3a_12bc_00d1_e2f3;
/// Epoch of a run with number 0. The first run has the next epoch.
const BASE_EPOCH: u32 = 1_780_000_000;
/// First subscriber ID of gateways. The IDs of all other subscribers are lower.
pub(crate) const FIRST_SUBSCRIBER_ID: u32 = 1_000_000;
/// Interval between two announcements.
const ANNOUNCE_INTERVAL: Nanos = ANNOUNCEMENT_INTERVAL.as_nanos() as Nanos;
/// Maximum time until a running hub passes the history to a new subscriber. The hub does not wake the subscriber for
/// the history.
const HISTORY_DELAY: Nanos = 110 * MILLIS;

/// Defines `lend`, which interprets the bytes of a sample as the table of topics specifies.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Passes the payload of `sample` to `to`, and returns the result.
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

/// Buffer for a payload that is encoded as in a datagram. The size of the buffer limits the length of the payload.
pub(crate) struct PayloadBuffer {
    buffer: Vec<u8>,
}

impl PayloadBuffer {
    pub(crate) fn new(terms: &LinkSettings) -> PayloadBuffer {
        // A bridge does not split samples.
        let room = if terms.are_bridges {
            u16::MAX.into()
        } else {
            MAX_PARTS * (terms.max_datagram_len - HEADER_LEN)
        };
        PayloadBuffer { buffer: vec![0; room] }
    }

    /// Returns the payload of `sample`, encoded as in a datagram. Returns `None` if the payload does not fit.
    pub(crate) fn encode(&mut self, sample: &Sample) -> Option<&[u8]> {
        let len = lend(sample, |payload| payload.pack(&mut self.buffer))?;
        self.buffer.get(..len)
    }
}
