//! What a hub publishes as topics of ROS 2: messages are made as samples come, and wait, of each topic as many as its quality
//! of service says, until somebody takes them away. A sample and the time go in. Refuses to know clocks, threads and Zenoh.

use std::collections::VecDeque;
use std::num::NonZeroU64;
use std::ops::Index;

use scanhub_network::lan::Stamp;
use scanhub_network::lan::outgoing::{PayloadRef, Sample};
use scanhub_ros::zenoh_wire::Qos;
use scanhub_ros::{DIAGNOSTICS, Names, TF_STATIC, Type};
use scanhub_schema::{Cloud, Foreground, Header, Pose, Scan, Status, SweepPoints, Topic};

/// The graph of one hub.
#[derive(Debug)]
pub(super) struct Graph {
    names: Names,
    hub: Hub,
    sensors: Vec<Sensor>,
    topics: Vec<Published>,
    slots: Vec<Slot>,
    /// A slot for each message that waits, the one that waited for longest first.
    waiting: VecDeque<usize>,
    /// What was handed last, and memory for others.
    handed: Vec<u8>,
    spare: Vec<Vec<u8>>,
    /// The topic of the last message from [`hand`](Graph::hand), until it is settled.
    in_flight: Option<usize>,
    /// By frame.
    poses: Vec<(String, Pose)>,
    poses_slot: Option<usize>,
}

/// A topic that has a publisher.
#[derive(Debug)]
pub(super) struct Published {
    pub(super) name: String,
    pub(super) of: Type,
    pub(super) qos: Qos,
    /// Messages that were handed on, those that newer ones took the place of, and those that were not taken.
    pub(super) sent: u64,
    pub(super) replaced: u64,
    pub(super) failed: u64,
}

/// Where messages of a topic wait; topics of several sensors have one for each.
#[derive(Debug)]
struct Slot {
    topic: usize,
    /// With CLOCK_MONOTONIC of when they came, the oldest first.
    messages: VecDeque<(u64, Vec<u8>)>,
}

/// What is to be sent.
#[derive(Debug)]
pub(super) struct Handed<'a> {
    /// Position among the [`topics`](Graph::topics).
    pub(super) topic: usize,
    pub(super) message: &'a [u8],
}

/// What is said of the hub itself.
#[derive(Debug, Default)]
struct Hub {
    /// Nothing if nobody wants to know how anything is.
    slot: Option<usize>,
    /// Wall clock of when it was first missed, and of when it was told of last.
    missed_ns: Option<u64>,
    told_ns: u64,
}

#[derive(Debug)]
struct Sensor {
    name: String,
    every: [Option<NonZeroU64>; TOPICS],
    slots: Slots,
    /// The last scans, by the number of their telegram: foregrounds are points of them.
    scans: VecDeque<(u64, Box<Scan>)>,
    /// A foreground that came before its scan.
    early: Option<(Header, Box<Foreground>)>,
    /// Of a name that has clouds.
    sweep: SweepPoints,
    /// Wall clock of the last scan, and of the last status; when a status was told of last.
    scanned_ns: Option<u64>,
    heard_ns: Option<u64>,
    told_ns: u64,
}

/// Where the messages of a sensor wait; nothing where its topic does not go out.
#[derive(Clone, Copy, Debug, Default)]
struct Slots {
    scan: Option<usize>,
    foreground: Option<usize>,
    marks: Option<usize>,
    zones: Option<usize>,
    verdict: Option<usize>,
    cloud: Option<usize>,
    diagnosis: Option<usize>,
    people: Option<usize>,
    poses: Option<usize>,
}

/// A message that has waited longer than that is left out if there is a newer one of its topic: who keeps the last five of a
/// scanner on a good network misses none, and on a slow one they do not wait for each other.
const FRESH_NS: u64 = 100_000_000;
const TOPICS: usize = Topic::ALL.len();
/// So many scans are kept for their foregrounds.
const SCANS: usize = 4;
/// A hub sends a status each second: after this long without one nobody says how a sensor is.
const SILENT_NS: u64 = 3_000_000_000;
/// A hub that is looked for as long as this is not there.
const ABSENT_NS: u64 = 500_000_000;
/// Between two words about either.
const SAID_EVERY_NS: u64 = 1_000_000_000;

impl Graph {
    /// Makes the graph of a hub of which nothing is known yet; where it `tells_state`, it says each second whether there is one.
    pub(super) fn new(names: Names, tells_state: bool) -> Graph {
        let mut graph = Graph {
            names,
            hub: Hub::default(),
            sensors: Vec::new(),
            topics: Vec::new(),
            slots: Vec::new(),
            waiting: VecDeque::new(),
            handed: Vec::new(),
            spare: Vec::new(),
            in_flight: None,
            poses: Vec::new(),
            poses_slot: None,
        };
        graph.hub.slot = tells_state.then(|| graph.publish_diagnostics());
        graph
    }

    /// Takes the sensor called `name`, of whose topics the samples of every so many telegrams go out; nothing: none do.
    /// Returns its position.
    pub(super) fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize {
        let every = Topic::ALL.map(every);
        let mut slot = |topic: Topic, word: &str, of: Type| {
            every[topic as usize].map(|_| self.publish(self.names.topic(name, word), of, Qos::SensorData))
        };
        let mut slots = Slots {
            scan: slot(Topic::Scan, "scan", scanhub_ros::LASER_SCAN),
            foreground: slot(Topic::Foreground, "foreground", scanhub_ros::POINT_CLOUD),
            marks: slot(Topic::Marks, "marks", scanhub_ros::MARKER_ARRAY),
            zones: slot(Topic::Zones, "zones", scanhub_ros::MARKER_ARRAY),
            verdict: slot(Topic::Zones, "verdict", scanhub_ros::STRING),
            cloud: slot(Topic::Cloud, "cloud", scanhub_ros::POINT_CLOUD),
            diagnosis: None,
            people: slot(Topic::Tracks, "tracks", scanhub_ros::MARKER_ARRAY),
            poses: slot(Topic::Tracks, "poses", scanhub_ros::POSE_ARRAY),
        };
        if every[Topic::Status as usize].is_some() {
            slots.diagnosis = Some(self.publish_diagnostics());
        }
        self.sensors.push(Sensor {
            name: name.to_owned(),
            every,
            slots,
            scans: VecDeque::new(),
            early: None,
            sweep: SweepPoints::default(),
            scanned_ns: None,
            heard_ns: None,
            told_ns: 0,
        });
        self.sensors.len() - 1
    }

    /// Returns whether samples of this topic are wanted: scans for their foregrounds, too, and a status for its pose.
    pub(super) fn wants(&self, sensor: usize, topic: Topic) -> bool {
        let goes_out = |topic: Topic| self.sensors[sensor].every[topic as usize].is_some();
        match topic {
            Topic::Scan => goes_out(topic) || goes_out(Topic::Foreground),
            Topic::Status => true,
            Topic::Foreground | Topic::Marks | Topic::Zones | Topic::Cloud | Topic::Tracks => goes_out(topic),
            _ => false,
        }
    }

    /// Takes a sample of the sensor at this position.
    pub(super) fn sample(&mut self, sensor: usize, sample: &Sample<'_>, now: Stamp) {
        let Some(header) = sample.header else {
            // The word that nothing comes any more is as good as a sample of the verdict.
            if let PayloadRef::Zones(zones) = sample.payload {
                let slot = self.sensors[sensor].slots.verdict;
                self.write(slot, now, |message| scanhub_ros::verdict_word(message, zones.verdict()));
            }
            return;
        };
        match sample.payload {
            PayloadRef::Status(status) => return self.status(sensor, header, status, now),
            PayloadRef::Cloud(cloud) => return self.cloud(sensor, header, cloud, now),
            _ => {}
        }
        let known = &self.sensors[sensor];
        let topic = sample.payload.topic();
        let goes_out = known.every[topic as usize].is_some_and(|every| header.seq % every == 0);
        let (slots, frame) = (known.slots, self.names.frame(&known.name).to_owned());
        match sample.payload {
            PayloadRef::Scan(scan) => {
                if goes_out {
                    self.write(slots.scan, now, |message| {
                        scanhub_ros::laser_scan(message, &frame, header, scan)
                    });
                }
                self.scan(sensor, header, scan, now);
            }
            PayloadRef::Foreground(foreground) if goes_out => {
                self.foreground(sensor, header, foreground, now)
            }
            PayloadRef::Marks(marks) if goes_out => {
                self.write(slots.marks, now, |message| {
                    scanhub_ros::mark_markers(message, &frame, header, marks)
                });
            }
            PayloadRef::Zones(zones) if goes_out => {
                self.write(slots.zones, now, |message| scanhub_ros::zone_markers(message, header, zones));
                self.write(slots.verdict, now, |message| scanhub_ros::verdict_word(message, zones.verdict()));
            }
            PayloadRef::Tracks(tracks) if goes_out => {
                self.write(slots.people, now, |message| {
                    scanhub_ros::people_markers(message, &frame, header, tracks)
                });
                self.write(slots.poses, now, |message| {
                    scanhub_ros::people_poses(message, &frame, header, tracks)
                });
            }
            _ => {}
        }
    }

    /// Says each second whether the hub is there, and of sensors whose status stays out that nobody says how they are.
    pub(super) fn look(&mut self, is_hub_there: bool, now: Stamp) {
        let now_ns = now.wall_ns;
        let missed_ns = *self.hub.missed_ns.get_or_insert(now_ns);
        if is_hub_there {
            self.hub.missed_ns = None;
        }
        let is_absent = !is_hub_there && now_ns.saturating_sub(missed_ns) >= ABSENT_NS;
        let is_due = now_ns.saturating_sub(self.hub.told_ns) >= SAID_EVERY_NS;
        if is_due && (is_hub_there || is_absent) {
            self.hub.told_ns = now_ns;
            self.write(self.hub.slot, now, |message| {
                scanhub_ros::hub_diagnosis(message, now_ns, is_hub_there)
            });
        }
        for sensor in 0..self.sensors.len() {
            let Sensor { name, slots, heard_ns, told_ns, .. } = &mut self.sensors[sensor];
            let heard_ns = *heard_ns.get_or_insert(now_ns);
            let is_silent = is_absent || now_ns.saturating_sub(heard_ns) >= SILENT_NS;
            if is_silent && now_ns.saturating_sub(*told_ns) >= SAID_EVERY_NS {
                *told_ns = now_ns;
                let (slot, name) = (slots.diagnosis, name.clone());
                self.write(slot, now, |message| scanhub_ros::diagnosis(message, &name, now_ns, None, None));
            }
        }
    }

    /// Returns the topics that have a publisher; new ones append.
    pub(super) fn topics(&self) -> &[Published] {
        &self.topics
    }

    /// Returns whether something is to be sent.
    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Returns the message that has waited for longest, and counts it as sent.
    pub(super) fn hand(&mut self, now: Stamp) -> Option<Handed<'_>> {
        loop {
            let slot = &mut self.slots[self.waiting.pop_front()?];
            let topic = slot.topic;
            let (since_ns, message) = slot.messages.pop_front()?;
            let is_fresh = now.monotonic_ns.saturating_sub(since_ns) <= FRESH_NS || slot.messages.is_empty();
            self.spare.push(std::mem::replace(&mut self.handed, message));
            if is_fresh {
                self.topics[topic].sent += 1;
                self.in_flight = Some(topic);
                return Some(Handed { topic, message: &self.handed });
            }
            self.topics[topic].replaced += 1;
        }
    }

    /// Settles the last message from [`hand`](Graph::hand): it was sent, or else it failed.
    pub(super) fn settle(&mut self, is_sent: bool) {
        if let Some(topic) = self.in_flight.take().filter(|_| !is_sent) {
            let topic = &mut self.topics[topic];
            (topic.sent, topic.failed) = (topic.sent - 1, topic.failed + 1);
        }
    }

    fn status(&mut self, sensor: usize, header: &Header, status: &Status, now: Stamp) {
        let now_ns = now.wall_ns;
        let known = &mut self.sensors[sensor];
        (known.heard_ns, known.told_ns) = (Some(now_ns), now_ns);
        let age_ns = known.scanned_ns.map(|scanned_ns| now_ns.saturating_sub(scanned_ns));
        let (slot, name) = (known.slots.diagnosis, known.name.clone());
        self.write(slot, now, |message| scanhub_ros::diagnosis(message, &name, now_ns, Some(status), age_ns));
        let frame = self.names.frame(&name);
        match self.poses.iter_mut().find(|(of, _)| of == frame) {
            Some((_, pose)) if *pose == status.pose => return,
            Some((_, pose)) => *pose = status.pose,
            None => self.poses.push((frame.to_owned(), status.pose)),
        }
        if self.poses_slot.is_none() {
            let topic = self.names.shared(TF_STATIC);
            self.poses_slot = Some(self.publish(topic, scanhub_ros::TF_MESSAGE, Qos::Latched));
        }
        let (slot, poses) = (self.poses_slot, std::mem::take(&mut self.poses));
        self.write(slot, now, |message| scanhub_ros::static_transforms(message, header.wall_ns, &poses));
        self.poses = poses;
    }

    /// Keeps a scan for its foreground, which may have come before it.
    fn scan(&mut self, sensor: usize, header: &Header, scan: &Scan, now: Stamp) {
        let known = &mut self.sensors[sensor];
        known.scanned_ns = Some(header.wall_ns);
        if known.slots.foreground.is_none() {
            return;
        }
        known.scans.push_back((header.seq, scan.boxed()));
        if known.scans.len() > SCANS {
            known.scans.pop_front();
        }
        if let Some((of, foreground)) = known.early.take_if(|(of, _)| of.seq <= header.seq) {
            self.foreground(sensor, &of, &foreground, now);
        }
    }

    /// The points of a foreground, if its scan is there; else it waits for it.
    fn foreground(&mut self, sensor: usize, header: &Header, foreground: &Foreground, now: Stamp) {
        let known = &mut self.sensors[sensor];
        let Some(place) = known.scans.iter().position(|(seq, _)| *seq == header.seq) else {
            if known.scans.back().is_none_or(|(seq, _)| *seq < header.seq) {
                known.early = Some((*header, foreground.boxed()));
            }
            return;
        };
        let (slot, scans) = (known.slots.foreground, std::mem::take(&mut known.scans));
        let frame = self.names.frame(&self.sensors[sensor].name).to_owned();
        let (_, scan) = scans.index(place);
        self.write(slot, now, |message| {
            scanhub_ros::foreground_cloud(message, &frame, header, scan, foreground)
        });
        self.sensors[sensor].scans = scans;
    }

    /// A message of a whole sweep, with the last of its samples.
    fn cloud(&mut self, sensor: usize, header: &Header, cloud: &Cloud, now: Stamp) {
        let known = &mut self.sensors[sensor];
        let (slot, mut sweep) = (known.slots.cloud, std::mem::take(&mut known.sweep));
        if let Some(points) = sweep.take(header, cloud) {
            self.write(slot, now, |message| scanhub_ros::sweep_cloud(message, header, points));
        }
        self.sensors[sensor].sweep = sweep;
    }

    /// A new place for messages of how something is.
    fn publish_diagnostics(&mut self) -> usize {
        self.publish(self.names.shared(DIAGNOSTICS), scanhub_ros::DIAGNOSTIC_ARRAY, Qos::Reliable(10))
    }

    /// A new place for messages of the topic called `name`.
    fn publish(&mut self, name: String, of: Type, qos: Qos) -> usize {
        let known = self.topics.iter().position(|topic| topic.name == name);
        let topic = known.unwrap_or_else(|| {
            self.topics.push(Published { name, of, qos, sent: 0, replaced: 0, failed: 0 });
            self.topics.len() - 1
        });
        self.slots.push(Slot { topic, messages: VecDeque::new() });
        self.slots.len() - 1
    }

    /// Has a message for `slot` written; where there are as many as are kept, it takes the place of the oldest.
    fn write(&mut self, slot: Option<usize>, now: Stamp, write: impl FnOnce(&mut Vec<u8>)) {
        let Some(place) = slot else { return };
        let slot = &mut self.slots[place];
        let topic = &mut self.topics[slot.topic];
        let mut message = if slot.messages.len() < topic.qos.depth() {
            self.waiting.push_back(place);
            self.spare.pop().unwrap_or_default()
        } else {
            topic.replaced += 1;
            slot.messages.pop_front().map(|(_, message)| message).unwrap_or_default()
        };
        message.clear();
        write(&mut message);
        slot.messages.push_back((now.monotonic_ns, message));
    }
}

#[cfg(test)]
mod tests;
