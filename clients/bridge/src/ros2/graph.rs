//! ROS 2 topics that a bridge publishes for one hub. Each sample becomes a message. The messages of a topic wait in a
//! queue. The maximum length of the queue is the depth in the topic's quality of service. Time is an argument.

use std::collections::VecDeque;
use std::num::NonZeroU64;
use std::ops::Index;

use scanhub_network::lan::WallTimestamp;
use scanhub_network::lan::outgoing::{PayloadRef, Sample};
use scanhub_ros::rmw_zenoh::Qos;
use scanhub_ros::{DIAGNOSTICS, RosNames, TF_STATIC, Type};
use scanhub_schema::{Cloud, Foreground, Header, Pose, Scan, Status, SweepPoints, Topic};

/// ROS 2 topics of one hub, with the messages to send.
#[derive(Debug)]
pub(super) struct Graph {
    names: RosNames,
    hub: Hub,
    sensors: Vec<Sensor>,
    topics: Vec<PublishedTopic>,
    slots: Vec<Slot>,
    /// Slot of each queued message. The message that has waited longest is first.
    waiting: VecDeque<usize>,
    /// Message that [`take_next`](Graph::take_next) returned last. Its memory is reused.
    current: Vec<u8>,
    spare: Vec<Vec<u8>>,
    /// Topic of the last message from [`take_next`](Graph::take_next), until it is settled.
    in_flight: Option<usize>,
    /// Last pose of each frame.
    poses: Vec<(String, Pose)>,
    poses_slot: Option<usize>,
}

/// A ROS 2 topic with its statistics.
#[derive(Debug)]
pub(super) struct PublishedTopic {
    pub(super) name: String,
    pub(super) of: Type,
    pub(super) qos: Qos,
    /// Number of messages that were sent, number of messages that newer messages replaced, and number of messages that
    /// could not be sent.
    pub(super) sent: u64,
    pub(super) replaced: u64,
    pub(super) failed: u64,
}

/// Queue for messages of a topic. A topic that several sensors share has one slot for each sensor.
#[derive(Debug)]
struct Slot {
    topic: usize,
    /// Messages with the time at which they were queued on CLOCK_MONOTONIC, the oldest first.
    messages: VecDeque<(u64, Vec<u8>)>,
}

/// A message to send.
#[derive(Debug)]
pub(super) struct QueuedMessage<'a> {
    /// Index in [`topics`](Graph::topics).
    pub(super) topic: usize,
    pub(super) message: &'a [u8],
}

/// State of the reports about the hub itself.
#[derive(Debug, Default)]
struct Hub {
    /// Slot of the reports; `None` if the topic `status` is not selected.
    slot: Option<usize>,
    /// Wall clock time at which the hub became unavailable, and wall clock time of the last report.
    missed_ns: Option<u64>,
    reported_ns: u64,
}

#[derive(Debug)]
struct Sensor {
    name: String,
    every: [Option<NonZeroU64>; TOPIC_COUNT],
    slots: TopicSlots,
    /// Last scans by `seq`. The points of a foreground are computed from the scan with the same `seq`.
    scans: VecDeque<(u64, Box<Scan>)>,
    /// Foreground that arrived before its scan.
    pending_foreground: Option<(Header, Box<Foreground>)>,
    /// Points of the current sweep, if the sensor has clouds.
    sweep: SweepPoints,
    /// Wall clock time of the last scan, of the last status, and of the last report about a missing status.
    last_scan_ns: Option<u64>,
    last_status_ns: Option<u64>,
    reported_ns: u64,
}

/// Slots for the messages of a sensor; `None` for topics that are not sent.
#[derive(Clone, Copy, Debug, Default)]
struct TopicSlots {
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

/// Time after which a waiting message is dropped if its topic has a newer message. On a good network, a subscriber with
/// a depth of five misses no message. On a slow network, old messages do not delay newer ones.
const MAX_QUEUED_NS: u64 = 100_000_000;
const TOPIC_COUNT: usize = Topic::ALL.len();
/// Number of scans of a sensor that are kept until their foregrounds arrive.
const MAX_SCANS: usize = 4;
/// Time without a status after which the state of a sensor is unknown. A hub sends a status once a second.
const SILENT_AFTER_NS: u64 = 3_000_000_000;
/// Time after which a hub that was not found counts as absent.
const ABSENT_AFTER_NS: u64 = 500_000_000;
/// Interval of the reports about absent hubs and silent sensors.
const REPORT_INTERVAL_NS: u64 = 1_000_000_000;

impl Graph {
    /// Creates the graph of a hub. If `reports_hub` is true, the graph publishes once a second whether the hub runs.
    pub(super) fn new(names: RosNames, reports_hub: bool) -> Graph {
        let mut graph = Graph {
            names,
            hub: Hub::default(),
            sensors: Vec::new(),
            topics: Vec::new(),
            slots: Vec::new(),
            waiting: VecDeque::new(),
            current: Vec::new(),
            spare: Vec::new(),
            in_flight: None,
            poses: Vec::new(),
            poses_slot: None,
        };
        graph.hub.slot = reports_hub.then(|| graph.publish_diagnostics());
        graph
    }

    /// Adds the sensor `name`, and returns its index. For each topic, `every` returns N if the samples of every Nth
    /// telegram are sent, and `None` if no samples are sent.
    pub(super) fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize {
        let every = Topic::ALL.map(every);
        let mut slot = |topic: Topic, word: &str, of: Type| {
            every[topic as usize].map(|_| self.publish(self.names.topic(name, word), of, Qos::SensorData))
        };
        let mut slots = TopicSlots {
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
            pending_foreground: None,
            sweep: SweepPoints::default(),
            last_scan_ns: None,
            last_status_ns: None,
            reported_ns: 0,
        });
        self.sensors.len() - 1
    }

    /// Returns whether the graph uses samples of this topic. The graph needs scans for foregrounds too, and the status
    /// for the pose.
    pub(super) fn needs(&self, sensor: usize, topic: Topic) -> bool {
        let is_sent = |topic: Topic| self.sensors[sensor].every[topic as usize].is_some();
        match topic {
            Topic::Scan => is_sent(topic) || is_sent(Topic::Foreground),
            Topic::Status => true,
            Topic::Foreground | Topic::Marks | Topic::Zones | Topic::Cloud | Topic::Tracks => is_sent(topic),
            _ => false,
        }
    }

    /// Handles a sample of the sensor with this index.
    pub(super) fn sample(&mut self, sensor: usize, sample: &Sample<'_>, now: WallTimestamp) {
        let Some(header) = sample.header else {
            // A zones payload without a header means that scans have stopped, and carries the verdict `unknown`.
            if let PayloadRef::Zones(zones) = sample.payload {
                let slot = self.sensors[sensor].slots.verdict;
                self.write(slot, now, |message| scanhub_ros::verdict_message(message, zones.verdict()));
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
        let is_sent = known.every[topic as usize].is_some_and(|every| header.seq % every == 0);
        let (slots, frame) = (known.slots, self.names.frame(&known.name).to_owned());
        match sample.payload {
            PayloadRef::Scan(scan) => {
                if is_sent {
                    self.write(slots.scan, now, |message| {
                        scanhub_ros::laser_scan(message, &frame, header, scan)
                    });
                }
                self.scan(sensor, header, scan, now);
            }
            PayloadRef::Foreground(foreground) if is_sent => self.foreground(sensor, header, foreground, now),
            PayloadRef::Marks(marks) if is_sent => {
                self.write(slots.marks, now, |message| {
                    scanhub_ros::mark_markers(message, &frame, header, marks)
                });
            }
            PayloadRef::Zones(zones) if is_sent => {
                self.write(slots.zones, now, |message| scanhub_ros::zone_markers(message, header, zones));
                self.write(slots.verdict, now, |message| {
                    scanhub_ros::verdict_message(message, zones.verdict())
                });
            }
            PayloadRef::Tracks(tracks) if is_sent => {
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

    /// Queues the reports that are due, once a second. One report states whether the hub runs. For each sensor without
    /// a recent status, another report states that the state of the sensor is unknown.
    pub(super) fn report_silence(&mut self, is_hub_there: bool, now: WallTimestamp) {
        let now_ns = now.wall_ns;
        let missed_ns = *self.hub.missed_ns.get_or_insert(now_ns);
        if is_hub_there {
            self.hub.missed_ns = None;
        }
        let is_absent = !is_hub_there && now_ns.saturating_sub(missed_ns) >= ABSENT_AFTER_NS;
        let is_due = now_ns.saturating_sub(self.hub.reported_ns) >= REPORT_INTERVAL_NS;
        if is_due && (is_hub_there || is_absent) {
            self.hub.reported_ns = now_ns;
            self.write(self.hub.slot, now, |message| {
                scanhub_ros::hub_diagnosis(message, now_ns, is_hub_there)
            });
        }
        for sensor in 0..self.sensors.len() {
            let Sensor { name, slots, last_status_ns, reported_ns, .. } = &mut self.sensors[sensor];
            let last_status_ns = *last_status_ns.get_or_insert(now_ns);
            let is_silent = is_absent || now_ns.saturating_sub(last_status_ns) >= SILENT_AFTER_NS;
            if is_silent && now_ns.saturating_sub(*reported_ns) >= REPORT_INTERVAL_NS {
                *reported_ns = now_ns;
                let (slot, name) = (slots.diagnosis, name.clone());
                self.write(slot, now, |message| scanhub_ros::diagnosis(message, &name, now_ns, None, None));
            }
        }
    }

    /// Returns all topics. New topics are added at the end.
    pub(super) fn topics(&self) -> &[PublishedTopic] {
        &self.topics
    }

    /// Returns whether a message waits.
    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Returns the message that has waited longest, and counts it as sent.
    pub(super) fn take_next(&mut self, now: WallTimestamp) -> Option<QueuedMessage<'_>> {
        loop {
            let slot = &mut self.slots[self.waiting.pop_front()?];
            let topic = slot.topic;
            let (since_ns, message) = slot.messages.pop_front()?;
            let is_fresh =
                now.monotonic_ns.saturating_sub(since_ns) <= MAX_QUEUED_NS || slot.messages.is_empty();
            self.spare.push(std::mem::replace(&mut self.current, message));
            if is_fresh {
                self.topics[topic].sent += 1;
                self.in_flight = Some(topic);
                return Some(QueuedMessage { topic, message: &self.current });
            }
            self.topics[topic].replaced += 1;
        }
    }

    /// Settles the last message from [`take_next`](Graph::take_next). If `is_sent` is false, the message counts as
    /// failed.
    pub(super) fn settle(&mut self, is_sent: bool) {
        if let Some(topic) = self.in_flight.take().filter(|_| !is_sent) {
            let topic = &mut self.topics[topic];
            (topic.sent, topic.failed) = (topic.sent - 1, topic.failed + 1);
        }
    }

    fn status(&mut self, sensor: usize, header: &Header, status: &Status, now: WallTimestamp) {
        let now_ns = now.wall_ns;
        let known = &mut self.sensors[sensor];
        (known.last_status_ns, known.reported_ns) = (Some(now_ns), now_ns);
        let age_ns = known.last_scan_ns.map(|scanned_ns| now_ns.saturating_sub(scanned_ns));
        let (slot, name) = (known.slots.diagnosis, known.name.clone());
        self.write(slot, now, |message| scanhub_ros::diagnosis(message, &name, now_ns, Some(status), age_ns));
        let frame = self.names.frame(&name);
        match self.poses.iter_mut().find(|(of, _)| of == frame) {
            Some((_, pose)) if *pose == status.pose => return,
            Some((_, pose)) => *pose = status.pose,
            None => self.poses.push((frame.to_owned(), status.pose)),
        }
        if self.poses_slot.is_none() {
            let topic = self.names.global_topic(TF_STATIC);
            self.poses_slot = Some(self.publish(topic, scanhub_ros::TF_MESSAGE, Qos::Latched));
        }
        let (slot, poses) = (self.poses_slot, std::mem::take(&mut self.poses));
        self.write(slot, now, |message| scanhub_ros::static_transforms(message, header.wall_ns, &poses));
        self.poses = poses;
    }

    /// Keeps a scan for its foreground. Handles the foreground at once if it arrived before the scan.
    fn scan(&mut self, sensor: usize, header: &Header, scan: &Scan, now: WallTimestamp) {
        let known = &mut self.sensors[sensor];
        known.last_scan_ns = Some(header.wall_ns);
        if known.slots.foreground.is_none() {
            return;
        }
        known.scans.push_back((header.seq, scan.boxed()));
        if known.scans.len() > MAX_SCANS {
            known.scans.pop_front();
        }
        if let Some((of, foreground)) = known.pending_foreground.take_if(|(of, _)| of.seq <= header.seq) {
            self.foreground(sensor, &of, &foreground, now);
        }
    }

    /// Queues the points of a foreground, or keeps the foreground until its scan arrives.
    fn foreground(&mut self, sensor: usize, header: &Header, foreground: &Foreground, now: WallTimestamp) {
        let known = &mut self.sensors[sensor];
        let Some(index) = known.scans.iter().position(|(seq, _)| *seq == header.seq) else {
            if known.scans.back().is_none_or(|(seq, _)| *seq < header.seq) {
                known.pending_foreground = Some((*header, foreground.boxed()));
            }
            return;
        };
        let (slot, scans) = (known.slots.foreground, std::mem::take(&mut known.scans));
        let frame = self.names.frame(&self.sensors[sensor].name).to_owned();
        let (_, scan) = scans.index(index);
        self.write(slot, now, |message| {
            scanhub_ros::foreground_cloud(message, &frame, header, scan, foreground)
        });
        self.sensors[sensor].scans = scans;
    }

    /// Queues a message with all points of a sweep when the last sample of the sweep has arrived.
    fn cloud(&mut self, sensor: usize, header: &Header, cloud: &Cloud, now: WallTimestamp) {
        let known = &mut self.sensors[sensor];
        let (slot, mut sweep) = (known.slots.cloud, std::mem::take(&mut known.sweep));
        if let Some(points) = sweep.take(header, cloud) {
            self.write(slot, now, |message| scanhub_ros::sweep_cloud(message, header, points));
        }
        self.sensors[sensor].sweep = sweep;
    }

    /// Creates a slot for diagnostics messages.
    fn publish_diagnostics(&mut self) -> usize {
        self.publish(self.names.global_topic(DIAGNOSTICS), scanhub_ros::DIAGNOSTIC_ARRAY, Qos::Reliable(10))
    }

    /// Creates a slot for messages of the topic `name`, and the topic itself if it is new.
    fn publish(&mut self, name: String, of: Type, qos: Qos) -> usize {
        let known = self.topics.iter().position(|topic| topic.name == name);
        let topic = known.unwrap_or_else(|| {
            self.topics.push(PublishedTopic { name, of, qos, sent: 0, replaced: 0, failed: 0 });
            self.topics.len() - 1
        });
        self.slots.push(Slot { topic, messages: VecDeque::new() });
        self.slots.len() - 1
    }

    /// Queues a message in `slot`. `write` fills the message. If the slot is full, the message replaces the oldest
    /// message.
    fn write(&mut self, slot: Option<usize>, now: WallTimestamp, write: impl FnOnce(&mut Vec<u8>)) {
        let Some(index) = slot else { return };
        let slot = &mut self.slots[index];
        let topic = &mut self.topics[slot.topic];
        let mut message = if slot.messages.len() < topic.qos.depth() {
            self.waiting.push_back(index);
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
mod tests {
    use scanhub_ros::{Value, read};
    use scanhub_schema::{
        CloudHead, CloudPoint, ForegroundHead, Marks, ScanHead, State, Track, TrackState, Tracks, Verdict,
        Zones,
    };

    use super::*;

    /// Returns the time `ns` after the start of both clocks.
    fn at(ns: u64) -> WallTimestamp {
        WallTimestamp { monotonic_ns: ns, wall_ns: ns }
    }

    const SECOND_NS: u64 = 1_000_000_000;

    fn header(seq: u64) -> Header {
        Header { seq, wall_ns: 100 * SECOND_NS + seq, period_us: 13_320, ..Header::default() }
    }

    fn sample<'a>(header: &'a Header, payload: PayloadRef<'a>) -> Sample<'a> {
        Sample { header: Some(header), missed: 0, payload }
    }

    fn scan(range: u16) -> Box<Scan> {
        Scan::of(ScanHead::lms(181, -90_000, 1000, 10, 13), &[range; 181])
    }

    /// Returns a foreground with only the beam straight ahead.
    fn foreground() -> Box<Foreground> {
        let mut foreground = Foreground::of(181);
        let head = ForegroundHead { unit_um: 10_000, count: 181, beams: 1, ..ForegroundHead::default() };
        let arrays = foreground.begin(head);
        (arrays.bits[11], arrays.ranges[0]) = (0b100, 200);
        foreground
    }

    fn graph(every: impl Fn(Topic) -> Option<u64>) -> Graph {
        let mut graph = Graph::new(RosNames::default(), false);
        let of_links = |topic: Topic| {
            every(topic)
                .filter(|_| topic.publisher_kind() != scanhub_schema::PublisherKind::Tracker)
                .and_then(NonZeroU64::new)
        };
        assert_eq!(graph.follow("front", &of_links), 0);
        graph
    }

    /// Takes all waiting messages, and returns the topic name and the message of each.
    fn take_messages(graph: &mut Graph) -> Vec<(String, Value)> {
        let mut all = Vec::new();
        while let Some(QueuedMessage { topic, message }) = graph.take_next(at(0)) {
            let message = message.to_vec();
            let topic = &graph.topics()[topic];
            all.push((topic.name.clone(), read(&topic.of, &message).expect("a message of its type")));
        }
        all
    }

    fn names(messages: &[(String, Value)]) -> Vec<&str> {
        messages.iter().map(|(name, _)| &**name).collect()
    }

    #[test]
    fn each_hub_topic_has_its_ros_topics() {
        let mut graph = graph(|_| Some(1));
        let topics: Vec<_> = graph.topics().iter().map(|topic| (&*topic.name, topic.qos)).collect();
        let best = Qos::SensorData;
        assert_eq!(
            topics,
            [
                ("/front/scan", best),
                ("/front/foreground", best),
                ("/front/marks", best),
                ("/front/zones", best),
                ("/front/verdict", best),
                ("/front/cloud", best),
                ("/diagnostics", Qos::Reliable(10)),
            ]
        );
        let (first, scan, foreground) = (header(1), scan(300), foreground());
        let zones = Zones { verdict: Verdict::Slow as u8, ..Zones::unknown() };
        let status = Status { state: State::Streaming as u8, ..Status::default() };
        for payload in [
            PayloadRef::Scan(&scan),
            PayloadRef::Foreground(&foreground),
            PayloadRef::Marks(&Marks::default()),
            PayloadRef::Zones(&zones),
            PayloadRef::Status(&status),
        ] {
            graph.sample(0, &sample(&first, payload), at(101 * SECOND_NS));
        }
        let messages = take_messages(&mut graph);
        let expected = ["/front/scan", "/front/foreground", "/front/marks", "/front/zones", "/front/verdict"];
        assert_eq!(names(&messages), [&expected[..], &["/diagnostics", "/tf_static"]].concat());
        assert_eq!(messages[0].1.number("ranges.90"), Some(f64::from(3_f32)));
        assert_eq!(
            (messages[1].1.number("width"), messages[1].1.text("header.frame_id")),
            (Some(1.0), Some("front"))
        );
        assert_eq!(messages[4].1.text("data"), Some("slow"));
        assert_eq!(messages[5].1.text("status.0.message"), Some("streaming"));
        assert_eq!(messages[6].1.text("transforms.0.child_frame_id"), Some("front"));
        // The pose is published when it changes, and the state of the sensor with each status.
        graph.sample(0, &sample(&first, PayloadRef::Status(&status)), at(102 * SECOND_NS));
        assert_eq!(names(&take_messages(&mut graph)), ["/diagnostics"]);
        let moved = Status { pose: Pose { x_m: 0.5, ..Pose::default() }, ..status };
        graph.sample(0, &sample(&first, PayloadRef::Status(&moved)), at(103 * SECOND_NS));
        let messages = take_messages(&mut graph);
        assert_eq!(names(&messages), ["/diagnostics", "/tf_static"]);
        assert_eq!(messages[1].1.number("transforms.0.transform.translation.x"), Some(0.5));
    }

    #[test]
    fn full_queue_replaces_the_oldest_messages() {
        let mut graph = graph(|topic| (topic == Topic::Scan).then_some(1));
        let ranges = |messages: Vec<(String, Value)>| {
            messages
                .iter()
                .map(|(_, scan)| scan.number("ranges.0").unwrap().round() as u64)
                .collect::<Vec<_>>()
        };
        let counts = |graph: &Graph| {
            let PublishedTopic { sent, replaced, failed, .. } = graph.topics()[0];
            (sent, replaced, failed)
        };
        let take = |graph: &mut Graph, now_ns| {
            for seq in 1..=7 {
                let stamp = at(now_ns + seq * 20_000_000);
                graph.sample(0, &sample(&header(seq), PayloadRef::Scan(&scan(100 * seq as u16))), stamp);
            }
        };
        take(&mut graph, 0);
        assert_eq!(ranges(take_messages(&mut graph)), [3, 4, 5, 6, 7]);
        graph.settle(false);
        assert_eq!(counts(&graph), (4, 2, 1));
        // Two of the scans from 60 to 140 ms after the start are old at 190 ms. The newest scan is never dropped
        // because of its age.
        take(&mut graph, 0);
        let first = graph.take_next(at(190_000_000)).map(|handed| handed.message.to_vec()).unwrap();
        assert_eq!(read(&scanhub_ros::LASER_SCAN, &first).unwrap().number("ranges.0"), Some(5.0));
        let last = graph.take_next(at(SECOND_NS)).map(|handed| handed.message.to_vec()).unwrap();
        assert_eq!(read(&scanhub_ros::LASER_SCAN, &last).unwrap().number("ranges.0"), Some(7.0));
        assert!(!graph.is_waiting());
        assert_eq!(counts(&graph), (6, 7, 1));
    }

    #[test]
    fn samples_are_thinned_by_their_telegrams() {
        let mut graph = graph(|topic| (topic == Topic::Scan).then_some(4));
        let mut sent = Vec::new();
        for seq in 0..9 {
            graph.sample(0, &sample(&header(seq), PayloadRef::Scan(&scan(100))), at(0));
            if !take_messages(&mut graph).is_empty() {
                sent.push(seq);
            }
        }
        assert_eq!(sent, [0, 4, 8]);
        assert!(
            graph.needs(0, Topic::Status)
                && !graph.needs(0, Topic::Zones)
                && !graph.needs(0, Topic::Telegram)
        );
    }

    #[test]
    fn foreground_is_published_with_the_scan_of_equal_seq() {
        let mut graph = graph(|topic| (topic == Topic::Foreground).then_some(1));
        assert!(graph.needs(0, Topic::Scan), "it says where beams point");
        let (scan, foreground) = (scan(500), foreground());
        graph.sample(0, &sample(&header(1), PayloadRef::Foreground(&foreground)), at(0));
        assert!(take_messages(&mut graph).is_empty());
        graph.sample(0, &sample(&header(1), PayloadRef::Scan(&scan)), at(0));
        assert_eq!(names(&take_messages(&mut graph)), ["/front/foreground"]);
        for seq in 2..5 {
            graph.sample(0, &sample(&header(seq), PayloadRef::Scan(&scan)), at(0));
        }
        graph.sample(0, &sample(&header(2), PayloadRef::Foreground(&foreground)), at(0));
        let messages = take_messages(&mut graph);
        assert_eq!((messages.len(), messages[0].1.number("header.stamp.sec")), (1, Some(99.0)));
        // A foreground is dropped if its scan was missed or is no longer kept.
        graph.sample(0, &sample(&header(6), PayloadRef::Foreground(&foreground)), at(0));
        graph.sample(0, &sample(&header(7), PayloadRef::Scan(&scan)), at(0));
        graph.sample(0, &sample(&header(1), PayloadRef::Foreground(&foreground)), at(0));
        assert!(take_messages(&mut graph).is_empty());
    }

    #[test]
    fn sensors_do_not_overwrite_each_other_in_one_topic() {
        let names = RosNames::new("robot1", "lidars", vec![("rear".to_owned(), "back".to_owned())]).unwrap();
        let mut graph = Graph::new(names, false);
        for (position, sensor) in ["front", "rear"].into_iter().enumerate() {
            graph.follow(sensor, &|topic| (topic == Topic::Status).then_some(NonZeroU64::MIN));
            graph.sample(
                position,
                &sample(&header(1), PayloadRef::Status(&Status::default())),
                at(SECOND_NS),
            );
        }
        let messages = take_messages(&mut graph);
        let of_sensors: Vec<_> =
            messages.iter().filter_map(|(_, value)| value.text("status.0.name")).collect();
        assert_eq!(of_sensors, ["scanhub: front", "scanhub: rear"]);
        assert_eq!(graph.topics().len(), 2, "{:?}", graph.topics());
        let poses = &messages.iter().find(|(name, _)| name == "/robot1/tf_static").unwrap().1;
        assert_eq!(poses.text("transforms.1.child_frame_id"), Some("back"));
    }

    #[test]
    fn silent_sensor_is_unknown_and_its_diagnostics_stale() {
        let mut graph = graph(|topic| matches!(topic, Topic::Status | Topic::Zones).then_some(1));
        graph.sample(0, &sample(&header(1), PayloadRef::Status(&Status::default())), at(10 * SECOND_NS));
        take_messages(&mut graph);
        graph.report_silence(true, at(12 * SECOND_NS));
        assert!(take_messages(&mut graph).is_empty());
        let unknown = Zones::unknown();
        let silence = Sample { header: None, missed: 0, payload: PayloadRef::Zones(&unknown) };
        graph.sample(0, &silence, at(12 * SECOND_NS));
        let messages = take_messages(&mut graph);
        assert_eq!((names(&messages), messages[0].1.text("data")), (vec!["/front/verdict"], Some("unknown")));
        let mut report_count = 0;
        for tenth in 130..160 {
            graph.report_silence(true, at(tenth * SECOND_NS / 10));
            let messages = take_messages(&mut graph);
            report_count += messages.len();
            assert!(
                messages.iter().all(|(_, value)| value.number("status.0.level") == Some(3.0)),
                "{messages:?}"
            );
        }
        assert_eq!(report_count, 3);
    }

    #[test]
    fn missing_hub_is_reported_every_second() {
        let mut graph = Graph::new(RosNames::default(), true);
        let mut levels_during = |tenths: std::ops::Range<u64>, is_hub_running| {
            let mut levels = Vec::new();
            for tenth in tenths {
                graph.report_silence(is_hub_running, at(tenth * SECOND_NS / 10));
                levels.extend(take_messages(&mut graph).into_iter().map(|(topic, value)| {
                    assert_eq!(
                        (&*topic, value.text("status.0.name")),
                        ("/diagnostics", Some("scanhub: hub"))
                    );
                    (tenth, value.number("status.0.level"))
                }));
            }
            levels
        };
        assert_eq!(levels_during(100..120, false), [(105, Some(3.0)), (115, Some(3.0))]);
        assert_eq!(levels_during(120..140, true), [(125, Some(0.0)), (135, Some(0.0))]);
        // A hub that is back within 500 ms does not count as absent.
        assert_eq!(levels_during(140..144, false), []);
        assert_eq!(levels_during(144..150, true), [(145, Some(0.0))]);
        assert_eq!(levels_during(150..160, false), [(155, Some(3.0))]);
    }

    #[test]
    fn sensor_without_a_hub_is_stale_within_a_second() {
        let mut graph = graph(|topic| (topic == Topic::Status).then_some(1));
        graph.sample(0, &sample(&header(1), PayloadRef::Status(&Status::default())), at(10 * SECOND_NS));
        take_messages(&mut graph);
        for ms in [10_100, 10_500] {
            graph.report_silence(false, at(ms * SECOND_NS / 1000));
            assert!(take_messages(&mut graph).is_empty(), "{ms}");
        }
        graph.report_silence(false, at(11 * SECOND_NS));
        let messages = take_messages(&mut graph);
        let last_status =
            messages.last().map(|(_, value)| (value.text("status.0.name"), value.number("status.0.level")));
        assert_eq!(last_status, Some((Some("scanhub: front"), Some(3.0))), "{messages:?}");
    }

    #[test]
    fn cloud_samples_of_a_sweep_are_one_message() {
        let mut graph = graph(|topic| (topic == Topic::Cloud).then_some(1));
        assert_eq!(graph.topics().len(), 1);
        assert!(graph.needs(0, Topic::Cloud) && !graph.needs(0, Topic::Scan));
        for (topic_seq, flags) in [(4, Cloud::LAST), (5, Cloud::FIRST), (6, 0), (7, Cloud::LAST)] {
            let cloud = Cloud::of(CloudHead { flags, ..CloudHead::default() }, &[CloudPoint::default(); 3]);
            let header = Header { topic_seq, ..header(topic_seq) };
            graph.sample(0, &sample(&header, PayloadRef::Cloud(&cloud)), at(0));
        }
        let messages = take_messages(&mut graph);
        assert_eq!(names(&messages), ["/front/cloud"]);
        assert_eq!(
            (messages[0].1.number("width"), messages[0].1.text("header.frame_id")),
            (Some(9.0), Some("base_link"))
        );
        assert_eq!(messages[0].1.number("header.stamp.nanosec"), Some(7.0));
    }

    #[test]
    fn people_become_markers_and_poses_in_the_map() {
        let mut graph = Graph::new(RosNames::default(), false);
        graph.follow("house", &|topic| {
            (topic.publisher_kind() == scanhub_schema::PublisherKind::Tracker).then_some(NonZeroU64::MIN)
        });
        assert!(graph.needs(0, Topic::Tracks) && !graph.needs(0, Topic::Scan));
        let topics: Vec<_> = graph.topics().iter().map(|topic| (&*topic.name, topic.of)).collect();
        assert_eq!(
            topics,
            [("/house/tracks", scanhub_ros::MARKER_ARRAY), ("/house/poses", scanhub_ros::POSE_ARRAY)]
        );
        let mut tracks = Tracks::default();
        tracks.push(Track { id: 5, state: TrackState::Confirmed as u8, x_m: 2.0, ..Track::default() });
        graph.sample(0, &sample(&header(1), PayloadRef::Tracks(&tracks)), at(101 * SECOND_NS));
        let messages = take_messages(&mut graph);
        assert_eq!(names(&messages), ["/house/tracks", "/house/poses"]);
        assert_eq!(
            (messages[0].1.text("markers.1.text"), messages[0].1.text("markers.1.header.frame_id")),
            (Some("5"), Some("house"))
        );
        assert_eq!(
            (messages[1].1.number("poses.0.position.x"), messages[1].1.text("header.frame_id")),
            (Some(2.0), Some("house"))
        );
    }
}
