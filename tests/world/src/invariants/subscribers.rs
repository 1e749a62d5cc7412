//! Invariant on subscribers that attach and leave at any time: each subscriber receives the next sample, and no
//! subscriber is woken late or without need.

use std::collections::BTreeMap;

use scanhub_schema::{DoorbellWord, Topic};

use super::{Invariant, ViolationReporter};
use crate::event::Event;
use crate::subscriber::SubscriberId;
use crate::topics::Sample;

/// Invariant: a subscriber receives the samples of every scan that begins after the subscriber has attached
/// (`docs/topics.md`). Each sample belongs to a word of the doorbell. The hub rings a word after it has sent all
/// samples of the word, and before it sends samples of the next word or the next telegram. The hub rings a word only if
/// a sample of the word has a subscriber. After the ring, the hub sends the event if one of the event's listeners has a
/// new sample.
pub(crate) struct Subscribers {
    sensors: Vec<SensorSubscribers>,
    sensor_of_subscriber: BTreeMap<SubscriberId, usize>,
}

#[derive(Default)]
struct SensorSubscribers {
    subscribers: BTreeMap<SubscriberId, AttachedSubscriber>,
    /// The `seq` of the last telegram, and of the last scan, of this hub.
    last: Option<u64>,
    scan: Option<u64>,
    /// For each topic, the `seq` of its last sample.
    published: BTreeMap<Topic, u64>,
    /// Topics for whose samples there was no memory since the last scan.
    without_memory: Vec<Topic>,
    /// For each word of the doorbell, whether the hub has sent a sample without ringing the word after it; and the
    /// `seq` of the first telegram for whose samples the hub must still ring the word.
    is_due: [bool; RING_COUNT],
    due: [Option<u64>; RING_COUNT],
    /// The `seq` of the telegram for whose samples the hub has not yet sent the event to its listeners.
    unnotified: Option<u64>,
}

struct AttachedSubscriber {
    topic: Topic,
    is_listener: bool,
    /// The `seq` of the last telegram before the subscriber attached, or `None` if there was none.
    after: Option<u64>,
}

impl Subscribers {
    pub(crate) fn new(sensors: usize) -> Subscribers {
        let sensors = (0..sensors).map(|_| SensorSubscribers::default()).collect();
        Subscribers { sensors, sensor_of_subscriber: BTreeMap::new() }
    }
}

impl Invariant for Subscribers {
    fn name(&self) -> &'static str {
        "subscribers"
    }

    fn on_event(&mut self, _: u64, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            // The sequence numbers of each hub start at 0.
            Event::HubStarted { .. } | Event::HubEnded { .. } => {
                self.sensors.iter_mut().for_each(SensorSubscribers::forget_hub);
            }
            Event::Attached { subscriber, sensor, topic, is_listener, .. } => {
                self.sensor_of_subscriber.insert(subscriber, sensor);
                let of = &mut self.sensors[sensor];
                of.subscribers.insert(subscriber, AttachedSubscriber { topic, is_listener, after: of.last });
            }
            Event::Detached { subscriber, .. } => {
                if let Some(sensor) = self.sensor_of_subscriber.remove(&subscriber) {
                    self.sensors[sensor].subscribers.remove(&subscriber);
                }
            }
            Event::OutOfMemory { sensor, topic } => self.sensors[sensor].without_memory.push(topic),
            Event::Published { sensor, sample } => {
                let broken = self.sensors[sensor].publish(sample);
                broken.into_iter().for_each(|words| reporter.report(format!("sensor {sensor}: {words}")));
            }
            Event::Rung { sensor, ring } => {
                let of = &mut self.sensors[sensor];
                of.due[ring as usize] = None;
                if !std::mem::take(&mut of.is_due[ring as usize]) {
                    reporter.report(format!(
                        "sensor {sensor}: {ring:?} was rung although no subscriber had a new sample"
                    ));
                }
            }
            Event::Notified { sensor } => self.sensors[sensor].unnotified = None,
            _ => {}
        }
    }
}

impl SensorSubscribers {
    fn forget_hub(&mut self) {
        let subscribers = std::mem::take(&mut self.subscribers);
        let known = |(number, of): (SubscriberId, AttachedSubscriber)| {
            (number, AttachedSubscriber { after: None, ..of })
        };
        *self = SensorSubscribers {
            subscribers: subscribers.into_iter().map(known).collect(),
            ..SensorSubscribers::default()
        };
    }

    /// Handles a sample, and returns its errors.
    fn publish(&mut self, sample: &Sample) -> Vec<String> {
        let mut broken = Vec::new();
        let (topic, seq) = (sample.topic, sample.header.seq);
        // An early warning has the `seq` of a telegram that is not complete yet.
        let is_next = topic == Topic::Early || self.last < Some(seq);
        if self.due[DoorbellWord::Early as usize].is_some() && topic != Topic::Early {
            broken.push(format!("{topic:?} of {seq} was sent before subscribers to warnings were woken"));
        }
        for ring in [DoorbellWord::First, DoorbellWord::Last] {
            if let Some(due) = self.due[ring as usize].filter(|&due| is_next && due < seq) {
                self.due[ring as usize] = None;
                broken.push(format!("{ring:?} was not rung after {due}, before {topic:?} of {seq}"));
            }
        }
        if AFTER_ZONES.contains(&topic) && self.due[DoorbellWord::First as usize] == Some(seq) {
            broken.push(format!("First was not rung before {topic:?} of {seq}"));
        }
        if let Some(unnotified_seq) =
            self.unnotified.filter(|&unnotified_seq| is_next && unnotified_seq < seq)
        {
            self.unnotified = None;
            broken.push(format!("listeners got no event after {unnotified_seq}, before {topic:?} of {seq}"));
        }
        let is_of_scan = sample.header.hub_time_ns().is_some();
        if topic == Topic::Zones && self.scan != Some(seq) {
            if is_of_scan {
                broken.extend(self.missing_topics(&AFTER_ZONES, self.scan));
                broken.extend(self.missing_topics(&[Topic::Scan], Some(seq)));
                self.without_memory.clear();
            }
            // Unknown zones have no hub time, and zones of a backlogged scan have no hub time either.
            self.scan = is_of_scan.then_some(seq);
        }
        self.published.insert(topic, seq);
        if topic != Topic::Early {
            self.last = Some(seq);
        }
        let ring = topic.spec().doorbell_word;
        if sample.receivers > 0 {
            self.is_due[ring as usize] = true;
            // Only samples of a scan must be followed by the ring before the next telegram. A status may be sent at any
            // time.
            if is_of_scan {
                self.due[ring as usize].get_or_insert(seq);
            }
        }
        let has_listener = |of: &AttachedSubscriber| of.is_listener && of.topic == topic;
        if is_of_scan && self.subscribers.values().any(has_listener) {
            self.unnotified.get_or_insert(seq);
        }
        broken
    }

    /// Returns a message for each of `topics` that has no sample of `scan`, although a subscriber to the topic had
    /// attached before the scan.
    fn missing_topics(&self, topics: &[Topic], scan: Option<u64>) -> Vec<String> {
        let Some(scan) = scan else { return Vec::new() };
        let is_absent = |of: &&AttachedSubscriber| {
            let is_published = self.published.get(&of.topic) == Some(&scan);
            topics.contains(&of.topic)
                && of.after.is_some_and(|after| after < scan)
                && !is_published
                && !self.without_memory.contains(&of.topic)
        };
        let absent = self.subscribers.values().filter(is_absent);
        absent
            .map(|of| {
                format!("no {:?} of {scan} for a subscriber that attached after {:?}", of.topic, of.after)
            })
            .collect()
    }
}

const RING_COUNT: usize = DoorbellWord::ALL.len();
/// Topics whose samples of a scan follow its zones.
const AFTER_ZONES: [Topic; 4] = [Topic::Marks, Topic::Lines, Topic::Motion, Topic::Foreground];
