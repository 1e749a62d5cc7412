//! Judge of subscribers that attach and leave at any time: each gets the next sample, and none is woken late or needlessly.

use std::collections::BTreeMap;

use scanhub_schema::{Ring, Topic};

use super::{Judge, Say};
use crate::consumer::Number;
use crate::event::Event;
use crate::topics::Sample;

/// Judge: a subscriber gets the samples of every scan that begins after it has attached (`docs/topics.md`). The doorbell rings
/// once all samples of a ring are sent, before those of the next ring and the next telegram, and only if a sample of that ring has a subscriber. The event
/// follows if one of its listeners has a sample.
pub(crate) struct Subscribers {
    sensors: Vec<OfSensor>,
    of_consumer: BTreeMap<Number, usize>,
}

#[derive(Default)]
struct OfSensor {
    consumers: BTreeMap<Number, Attached>,
    /// Number of the last telegram, and of the last scan, of this hub.
    last: Option<u64>,
    scan: Option<u64>,
    /// For each topic, the number in its last sample.
    published: BTreeMap<Topic, u64>,
    /// Topics that had no memory since the last scan.
    lacking: Vec<Topic>,
    /// For each ring, whether a sample has subscribers that were not woken since, and the telegram of the first one that has to
    /// be rung before the next telegram.
    is_due: [bool; RINGS],
    due: [Option<u64>; RINGS],
    /// The telegram whose samples have listeners that were not notified.
    unheard: Option<u64>,
}

struct Attached {
    topic: Topic,
    is_listener: bool,
    /// The last telegram before the subscriber attached.
    after: Option<u64>,
}

impl Subscribers {
    pub(crate) fn new(sensors: usize) -> Subscribers {
        let sensors = (0..sensors).map(|_| OfSensor::default()).collect();
        Subscribers { sensors, of_consumer: BTreeMap::new() }
    }
}

impl Judge for Subscribers {
    fn name(&self) -> &'static str {
        "subscribers"
    }

    fn note(&mut self, _: u64, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            // The numbers of a hub begin with 0.
            Event::HubBegins { .. } | Event::HubEnds { .. } => {
                self.sensors.iter_mut().for_each(OfSensor::forget_hub);
            }
            Event::Attached { consumer, sensor, topic, is_listener, .. } => {
                self.of_consumer.insert(consumer, sensor);
                let of = &mut self.sensors[sensor];
                of.consumers.insert(consumer, Attached { topic, is_listener, after: of.last });
            }
            Event::Left { consumer, .. } => {
                if let Some(sensor) = self.of_consumer.remove(&consumer) {
                    self.sensors[sensor].consumers.remove(&consumer);
                }
            }
            Event::Lacking { sensor, topic } => self.sensors[sensor].lacking.push(topic),
            Event::Published { sensor, sample } => {
                let broken = self.sensors[sensor].publish(sample);
                broken.into_iter().for_each(|words| say.broken(format!("sensor {sensor}: {words}")));
            }
            Event::Rung { sensor, ring } => {
                let of = &mut self.sensors[sensor];
                of.due[ring as usize] = None;
                if !std::mem::take(&mut of.is_due[ring as usize]) {
                    say.broken(format!("sensor {sensor}: {ring:?} was rung, and no subscriber got a sample"));
                }
            }
            Event::Notified { sensor } => self.sensors[sensor].unheard = None,
            _ => {}
        }
    }
}

impl OfSensor {
    fn forget_hub(&mut self) {
        let consumers = std::mem::take(&mut self.consumers);
        let known = |(number, of): (Number, Attached)| (number, Attached { after: None, ..of });
        *self = OfSensor { consumers: consumers.into_iter().map(known).collect(), ..OfSensor::default() };
    }

    /// Takes a sample, and returns what is wrong.
    fn publish(&mut self, sample: &Sample) -> Vec<String> {
        let mut broken = Vec::new();
        let (topic, seq) = (sample.topic, sample.header.seq);
        // A warning has the number of the telegram that is not complete yet.
        let is_next = topic == Topic::Early || self.last < Some(seq);
        if self.due[Ring::Early as usize].is_some() && topic != Topic::Early {
            broken.push(format!("{topic:?} of {seq} was sent while subscribers of a warning slept"));
        }
        for ring in [Ring::First, Ring::Last] {
            if let Some(due) = self.due[ring as usize].filter(|&due| is_next && due < seq) {
                self.due[ring as usize] = None;
                broken.push(format!("{ring:?} was not rung after {due}, before {topic:?} of {seq}"));
            }
        }
        if AFTER_ZONES.contains(&topic) && self.due[Ring::First as usize] == Some(seq) {
            broken.push(format!("First was not rung before {topic:?} of {seq}"));
        }
        if let Some(unheard) = self.unheard.filter(|&unheard| is_next && unheard < seq) {
            self.unheard = None;
            broken.push(format!("listeners got no event after {unheard}, before {topic:?} of {seq}"));
        }
        let is_of_scan = sample.header.hub_time_ns().is_some();
        if topic == Topic::Zones && self.scan != Some(seq) {
            if is_of_scan {
                broken.extend(self.absent(&AFTER_ZONES, self.scan));
                broken.extend(self.absent(&[Topic::Scan], Some(seq)));
                self.lacking.clear();
            }
            // A scan that waited too long has no time of the hub, either.
            self.scan = is_of_scan.then_some(seq);
        }
        self.published.insert(topic, seq);
        if topic != Topic::Early {
            self.last = Some(seq);
        }
        let ring = topic.row().ring;
        if sample.reached > 0 {
            self.is_due[ring as usize] = true;
            // A status waits for the next telegram.
            if is_of_scan {
                self.due[ring as usize].get_or_insert(seq);
            }
        }
        let is_heard = |of: &Attached| of.is_listener && of.topic == topic;
        if is_of_scan && self.consumers.values().any(is_heard) {
            self.unheard.get_or_insert(seq);
        }
        broken
    }

    /// Returns those of `topics` that have no sample of `scan`, although one of their subscribers came before it.
    fn absent(&self, topics: &[Topic], scan: Option<u64>) -> Vec<String> {
        let Some(scan) = scan else { return Vec::new() };
        let is_absent = |of: &&Attached| {
            let is_published = self.published.get(&of.topic) == Some(&scan);
            topics.contains(&of.topic)
                && of.after.is_some_and(|after| after < scan)
                && !is_published
                && !self.lacking.contains(&of.topic)
        };
        let absent = self.consumers.values().filter(is_absent);
        absent
            .map(|of| format!("no {:?} of {scan} for a subscriber that came after {:?}", of.topic, of.after))
            .collect()
    }
}

const RINGS: usize = Ring::ALL.len();
/// Topics whose samples of a scan follow its zones.
const AFTER_ZONES: [Topic; 4] = [Topic::Marks, Topic::Lines, Topic::Motion, Topic::Foreground];
