//! Publishes remote sensors in a domain of this machine, so that programs can subscribe to them as to the sensors of a
//! hub. Samples come from [`Incoming`](super::incoming::Incoming). Topics are created in a [`TopicStore`].

mod remote_sensor;

use std::collections::VecDeque;

use scanhub_schema::datagram::{Announce, Head};
use scanhub_schema::{Failure, Header, Topic, WakeEvent};

use super::WallTimestamp;
use super::gateways::Arrival;
use super::incoming::{Announcement, CheckedPayload, ReceivedSample, RemoteSample};
use remote_sensor::{Outcome, RemoteSensor};

/// Publisher of all remote sensors in a domain.
pub struct Republisher<S: TopicStore> {
    sensors: Vec<RemoteSensor<S::Sensor>>,
    /// Samples that were not published.
    pub dropped: DroppedSamples,
    /// Sensors that were evicted for others.
    pub evicted_active: u64,
    /// Whether topics are created only for sensors of a gateway that is known to deliver.
    only_proven: bool,
    candidates: Candidates,
    /// Number of sensors that may be evicted now. It increases by 1 at `next_credit_ns`.
    eviction_credit: usize,
    next_credit_ns: u64,
    next_history_ns: u64,
    next_cleanup_ns: u64,
    pid: u32,
    store: S,
}

/// Samples that were received and not published, by reason.
#[derive(Clone, Copy, Default)]
pub struct DroppedSamples {
    /// The sensor has no name, because it is not announced yet.
    pub unnamed: u64,
    /// The sensor's announcement does not name the topic.
    pub unannounced: u64,
    /// A newer sample was published before.
    pub late: u64,
    /// The maximum of 16 sensors is reached.
    pub capacity: u64,
    /// There was no memory or no descriptor for the topic.
    pub shortage: u64,
    /// The gateway is not known to deliver yet.
    pub unproven: u64,
    /// The sensor or topic did not fit into the memory that remote sensors may use.
    pub no_room: u64,
}

/// Maximum number of published sensors. It is limited because anyone who can send to the network can announce sensors.
pub(crate) const MAX_SENSORS: usize = 16;

/// Interval at which one more sensor may be evicted, in ns. Evictions that are not used are saved, up to
/// [`MAX_SENSORS`] of them. The rate is limited because an eviction takes milliseconds, and anyone who can send can
/// cause one.
const EVICTION_CREDIT_INTERVAL_NS: u64 = 250_000_000;

/// Interval at which late joiners receive the last status, zones and background.
const HISTORY_INTERVAL_NS: u64 = 100_000_000;

/// Interval between cleanups after dead subscribers, as in the hub.
const CLEANUP_INTERVAL_NS: u64 = 5_000_000_000;

impl<S: TopicStore> Republisher<S> {
    /// Creates the publisher of process `pid` at `now_ns`. The publisher creates topics in `store`.
    pub fn new(store: S, pid: u32, now_ns: u64) -> Republisher<S> {
        Republisher {
            sensors: Vec::new(),
            dropped: DroppedSamples::default(),
            evicted_active: 0,
            only_proven: false,
            candidates: Candidates::default(),
            eviction_credit: MAX_SENSORS,
            next_credit_ns: now_ns,
            next_history_ns: now_ns,
            next_cleanup_ns: now_ns.saturating_add(CLEANUP_INTERVAL_NS),
            pid,
            store,
        }
    }

    /// Makes the publisher create topics only for sensors whose gateway has the key, or has delivered for a second.
    pub fn only_proven(self) -> Republisher<S> {
        Republisher { only_proven: true, ..self }
    }

    /// Handles the start of a gateway's run with the datagram of `head`. Published sensors with the same number and
    /// epoch belong to another gateway, so they are retired.
    pub fn on_run_started(&mut self, head: &Head, now: WallTimestamp) {
        self.sensors
            .iter_mut()
            .filter(|sensor| sensor.belongs_to(head.hub, head.epoch))
            .for_each(|sensor| sensor.retire(now));
    }

    /// Handles an announcement of the gateway that is called `hub`: creates the missing topics of the announced sensor.
    /// When all of them exist, returns the sensor's name on this machine, but only once.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`](scanhub_schema::Kind) if memory or descriptors are short. Other sensors are
    /// not affected.
    pub fn on_announcement(
        &mut self,
        announcement: &Announcement,
        hub: &str,
        now: WallTimestamp,
    ) -> Result<Option<String>, Failure> {
        let Announcement { head, announce, arrival_ns, is_proven, .. } = announcement;
        let arrival = Arrival { is_sample: false, now_ns: *arrival_ns };
        let candidate = if *is_proven { self.candidates.take(head) } else { None };
        let made = self.create_sensor(head, hub, announce, arrival, *is_proven, now);
        self.publish_stored(head, announce.boot, candidate);
        made
    }

    /// Publishes `sample`, or counts it in [`dropped`](Self::dropped). If the gateway is known to deliver since this
    /// sample, first creates the sensor's topics, as [`on_announcement`](Self::on_announcement) does. If there is no
    /// room for the sensor, another sensor may be evicted. `hub` returns the gateway's name.
    ///
    /// # Errors
    ///
    /// Returns the same errors as [`on_announcement`](Self::on_announcement).
    pub fn sample(
        &mut self,
        sample: &RemoteSample<'_>,
        hub: impl FnOnce() -> String,
        now: WallTimestamp,
    ) -> Result<Option<String>, Failure> {
        let RemoteSample { remote, announced, is_proven, .. } = sample;
        let head = &remote.head;
        let candidate = if *is_proven { self.candidates.take(head) } else { None };
        let made = match announced {
            Some(announce) if candidate.is_some() || self.may_make_room(head, announce) => {
                let arrival = Arrival { is_sample: true, now_ns: remote.arrival_ns };
                self.create_sensor(head, &hub(), announce, arrival, *is_proven, now)
            }
            _ => Ok(None),
        };
        self.publish_stored(head, remote.boot, candidate);
        self.publish(sample);
        made
    }

    /// Wakes the subscribers of sensors that have published something since the last call.
    pub fn wake(&mut self) {
        self.sensors.iter_mut().for_each(RemoteSensor::wake);
    }

    /// Does what is due at `now_ns`: reports silent sensors, connects late joiners, and cleans up after dead
    /// subscribers. Everything that arrived before `read` has been handled, so a silence is reported as of that time.
    pub fn do_periodic_work(&mut self, now_ns: u64, read: WallTimestamp) {
        if now_ns >= self.next_history_ns {
            self.next_history_ns = now_ns + HISTORY_INTERVAL_NS;
            self.sensors.iter_mut().for_each(|sensor| sensor.do_periodic_work(read));
        }
        if now_ns >= self.next_credit_ns {
            self.next_credit_ns = now_ns + EVICTION_CREDIT_INTERVAL_NS;
            self.eviction_credit = MAX_SENSORS.min(self.eviction_credit + 1);
        }
        if now_ns >= self.next_cleanup_ns {
            self.next_cleanup_ns = now_ns + CLEANUP_INTERVAL_NS;
            self.store.clean_up();
        }
    }

    /// Returns the number of samples for which there was no memory.
    pub fn failed(&self) -> u64 {
        self.sensors.iter().map(RemoteSensor::failed).sum()
    }

    /// Returns the names of the published sensors.
    pub fn names(&self) -> Vec<&str> {
        self.sensors.iter().map(|sensor| sensor.name.as_str()).collect()
    }

    /// Creates the missing topics of the sensor in `announce`, from the gateway that is called `hub`. When all of them
    /// exist, returns the sensor's name on this machine, but only once. Another sensor that had the same number before
    /// is retired, even if there is no room for the new one, so that no sample is published under another sensor's
    /// name.
    ///
    /// If there is no room and `arrival` is a sample, evicts another sensor whose rank permits that. An announcement
    /// evicts none.
    fn create_sensor(
        &mut self,
        head: &Head,
        hub: &str,
        announce: &Announce,
        arrival: Arrival,
        is_proven: bool,
        now: WallTimestamp,
    ) -> Result<Option<String>, Failure> {
        let name = format!("{hub}.{}", announce.sensor());
        for sensor in self.sensors.iter_mut().filter(|sensor| sensor.has_sent(head) && sensor.name != name) {
            sensor.retire(now);
        }
        let at = self.sensors.iter().position(|sensor| sensor.name == name);
        if let Some(at) = at {
            // The sensor keeps its topics, even if there is no room for further ones.
            self.sensors[at].on_announcement(head, announce, arrival);
        }
        if self.only_proven && !is_proven {
            self.candidates.add(head);
            return Ok(None);
        }
        while at.is_none() && self.is_full(announce) {
            match self.next_evicted(arrival).filter(|_| arrival.is_sample && self.eviction_credit > 0) {
                Some(evicted) => self.evict(evicted, now),
                None => return Ok(None),
            }
        }
        let is_missing = |topic: &Topic| at.is_none_or(|at| !self.sensors[at].has_topic(*topic));
        let missing: Vec<_> = topics(announce).into_iter().filter(is_missing).collect();
        if at.is_some() && !missing.is_empty() && !self.store.fits(&missing) {
            return Ok(None);
        }
        if at.is_none() || !missing.is_empty() {
            self.store.check_room(&missing)?;
        }
        let at = match at {
            Some(at) => at,
            None => {
                let mut sensor = RemoteSensor::new(&name, self.store.sensor(&name)?, self.pid);
                sensor.on_announcement(head, announce, arrival);
                self.sensors.push(sensor);
                self.sensors.len() - 1
            }
        };
        if !missing.is_empty() {
            let sensor = &mut self.sensors[at];
            // If one topic cannot be created, none of them stays.
            let made = missing.iter().try_for_each(|&topic| sensor.add(topic));
            made.inspect_err(|_| missing.iter().for_each(|&topic| sensor.remove(topic)))?;
        }
        let is_reported = std::mem::replace(&mut self.sensors[at].is_reported, true);
        Ok((!is_reported).then_some(name))
    }

    /// Returns whether the sensor that sent `head` is not published, and another one may be evicted for it.
    fn may_make_room(&self, head: &Head, announce: &Announce) -> bool {
        let is_here = || self.sensors.iter().any(|sensor| sensor.has_sent(head));
        self.eviction_credit > 0 && !is_here() && self.is_full(announce)
    }

    /// Returns whether there is no room for one more sensor with the topics of `announce`.
    fn is_full(&self, announce: &Announce) -> bool {
        self.sensors.len() == MAX_SENSORS || !self.store.fits(&topics(announce))
    }

    /// Publishes the stored samples of `candidate` if its sensor, which sent `head`, has been created. Otherwise, the
    /// sensor stays a candidate. Samples from another run of the hub than `boot` may belong to another sensor, so they
    /// are dropped.
    fn publish_stored(&mut self, head: &Head, boot: u64, candidate: Option<Candidate>) {
        let Some(candidate) = candidate else { return };
        let Some(sensor) = self.sensors.iter_mut().find(|sensor| sensor.has_sent(head)) else {
            return self.candidates.put_back(candidate);
        };
        let samples = candidate.samples().filter(|remote| remote.boot == boot);
        let outcomes = samples.map(|remote| sensor.publish(&remote));
        let published = outcomes.filter(|outcome| *outcome == Outcome::Published).count();
        self.dropped.unproven -= published as u64;
    }

    /// Publishes `sample`, or counts the reason why that is not possible.
    fn publish(&mut self, sample: &RemoteSample<'_>) {
        let RemoteSample { remote, announced, is_proven, .. } = sample;
        let head = &remote.head;
        let reason = if remote.late {
            &mut self.dropped.late
        } else if let Some(sensor) = self.sensors.iter_mut().find(|sensor| sensor.has_sent(head)) {
            match sensor.publish(remote) {
                Outcome::Published => return,
                Outcome::NoTopic if !sensor.is_announced(remote.topic) => &mut self.dropped.unannounced,
                Outcome::NoTopic if self.only_proven && !is_proven => &mut self.dropped.unproven,
                Outcome::NoTopic if self.store.fits(&[remote.topic]) => &mut self.dropped.shortage,
                Outcome::NoTopic | Outcome::NoRoom => &mut self.dropped.no_room,
            }
        } else if let Some(announce) = announced {
            if self.only_proven && !is_proven {
                self.candidates.add(head).store_sample(remote);
                &mut self.dropped.unproven
            } else if self.sensors.len() == MAX_SENSORS {
                &mut self.dropped.capacity
            } else if self.store.fits(&topics(announce)) {
                &mut self.dropped.shortage
            } else {
                &mut self.dropped.no_room
            }
        } else {
            &mut self.dropped.unnamed
        };
        *reason += 1;
    }

    /// Returns the index of the sensor that is evicted first to make room for the sensor of `arrival`.
    fn next_evicted(&self, arrival: Arrival) -> Option<usize> {
        let may_go = |at: &usize| self.sensors[*at].rank.may_be_evicted(arrival);
        (0..self.sensors.len()).filter(may_go).min_by_key(|&at| self.sensors[at].rank.active_until_ns())
    }

    /// Publishes that the sensor at index `at` is silent, and removes the sensor.
    fn evict(&mut self, at: usize, now: WallTimestamp) {
        self.sensors.remove(at).retire(now);
        self.evicted_active += 1;
        self.eviction_credit -= 1;
    }
}

/// Returns the topics of `announce` that this version has.
fn topics(announce: &Announce) -> Vec<Topic> {
    let is_announced = |topic: &Topic| announce.topics().iter().any(|one| one.topic == topic.number());
    Topic::ALL.into_iter().filter(is_announced).collect()
}

/// Place where topics of sensors are created: shared memory, or a model of it.
pub trait TopicStore {
    /// Topics of one sensor. Dropping them removes them.
    type Sensor: SensorTopics;

    /// Checks that there is room for `topics` of one more sensor.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`](scanhub_schema::Kind) if there is too little room.
    fn check_room(&self, topics: &[Topic]) -> Result<(), Failure>;

    /// Returns whether the memory that remote sensors may use has room for `topics` of one more sensor.
    fn fits(&self, topics: &[Topic]) -> bool {
        let _ = topics;
        true
    }

    /// Creates a sensor without topics.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`](scanhub_schema::Kind) if memory or descriptors are short, or another error
    /// of the store.
    fn sensor(&self, name: &str) -> Result<Self::Sensor, Failure>;

    /// Cleans up after dead subscribers.
    fn clean_up(&self);
}

/// Topics of one sensor in a store. For a topic that does not exist, `send` and `skip` do nothing.
pub trait SensorTopics {
    /// Creates `topic`, which does not exist.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`](scanhub_schema::Kind) if memory or descriptors are short, or another error
    /// of the store.
    fn add(&mut self, topic: Topic) -> Result<(), Failure>;

    /// Removes `topic`.
    fn remove(&mut self, topic: Topic);

    /// Returns whether the memory that remote sensors may use has room for `topic` with samples as long as `payload`.
    fn fits(&self, topic: Topic, payload: CheckedPayload<'_>) -> bool {
        let _ = (topic, payload);
        true
    }

    /// Uses up `count` numbers of `topic` without a sample.
    fn skip(&mut self, topic: Topic, count: u64);

    /// Publishes a sample with `header`, but with the next number of the topic. A sample that fails is counted in
    /// [`failed`](Self::failed), and uses its number up.
    fn send(&mut self, topic: Topic, header: &Header, payload: CheckedPayload<'_>);

    /// Sends the history of `topic` to late joiners.
    fn connect(&self, topic: Topic);

    /// Wakes the subscribers of all topics.
    fn wake(&self, event: WakeEvent);

    /// Returns the number of samples for which there was no memory.
    fn failed(&self) -> u64;
}

/// The last sensors that were announced before their gateway was known to deliver. They have no topics yet. The last
/// sample of each topic with a history is kept, because a background, for example, is sent only once.
#[derive(Default)]
pub(super) struct Candidates(VecDeque<Candidate>);

/// A sensor that is not published yet, and those of its samples that late joiners would receive.
pub(super) struct Candidate {
    /// Gateway, its run, and the sensor's number.
    source: (u64, u32, u8),
    /// At most one sample of each topic.
    stored: Vec<StoredSample>,
}

/// A sample that is not published yet.
struct StoredSample {
    head: Head,
    topic: Topic,
    bytes: Vec<u8>,
    room: usize,
    boot: u64,
    arrival_ns: u64,
    age_ns: Option<u64>,
}

/// Maximum number of candidates. Their samples take up to 17 kB each.
const MAX_CANDIDATES: usize = 4 * MAX_SENSORS;

impl Candidates {
    /// Adds the sensor that sent `head`, unless it is a candidate already.
    pub(super) fn add(&mut self, head: &Head) -> &mut Candidate {
        let source = source(head);
        let at = match self.0.iter().position(|candidate| candidate.source == source) {
            Some(at) => at,
            None => {
                self.put_back(Candidate { source, stored: Vec::new() });
                self.0.len() - 1
            }
        };
        &mut self.0[at]
    }

    /// Adds `candidate`, which is not in the list. If there are too many candidates, the oldest one is dropped.
    pub(super) fn put_back(&mut self, candidate: Candidate) {
        if self.0.len() == MAX_CANDIDATES {
            self.0.pop_front();
        }
        self.0.push_back(candidate);
    }

    /// Removes the sensor that sent `head`, and returns it if it was a candidate.
    pub(super) fn take(&mut self, head: &Head) -> Option<Candidate> {
        let source = source(head);
        let at = self.0.iter().position(|candidate| candidate.source == source)?;
        self.0.remove(at)
    }
}

impl Candidate {
    /// Keeps `remote` in place of the last sample of its topic, if the topic has a history.
    pub(super) fn store_sample(&mut self, remote: &ReceivedSample<'_>) {
        let &ReceivedSample { topic, head, payload, boot, arrival_ns, age_ns, .. } = remote;
        if topic.spec().history_len > 0 {
            self.stored.retain(|kept| kept.topic != topic);
            let CheckedPayload { bytes, room } = payload;
            self.stored.push(StoredSample {
                head,
                topic,
                bytes: bytes.to_vec(),
                room,
                boot,
                arrival_ns,
                age_ns,
            });
        }
    }

    /// Returns the samples that are kept, each as it was received.
    pub(super) fn samples(&self) -> impl Iterator<Item = ReceivedSample<'_>> {
        self.stored.iter().map(|kept| ReceivedSample {
            topic: kept.topic,
            head: kept.head,
            payload: CheckedPayload { bytes: &kept.bytes, room: kept.room },
            boot: kept.boot,
            arrival_ns: kept.arrival_ns,
            age_ns: kept.age_ns,
            late: false,
            // With a key, no sensor is a candidate.
            authenticated: false,
        })
    }
}

fn source(head: &Head) -> (u64, u32, u8) {
    (head.hub, head.epoch, head.sensor)
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::rc::Rc;

    use scanhub_schema::datagram::{Announced, DatagramPayload, HEADER_LEN, MTU_ETHERNET, PORT};
    use scanhub_schema::{Header, WakeEvent, Zones};

    use crate::lan::incoming::{Incoming, ReceiveOutcome};

    use super::*;

    /// Store with room for a number of sensors.
    #[derive(Clone)]
    struct TestStore {
        free: Rc<Cell<usize>>,
        /// Samples of all sensors.
        sent: Rc<Cell<usize>>,
    }

    /// Sensor in the store. Dropping it frees its room.
    struct TestSensor(TestStore);

    impl TopicStore for TestStore {
        type Sensor = TestSensor;

        fn check_room(&self, _: &[Topic]) -> Result<(), Failure> {
            Ok(())
        }

        fn fits(&self, _: &[Topic]) -> bool {
            self.free.get() > 0
        }

        fn sensor(&self, _: &str) -> Result<TestSensor, Failure> {
            self.free.set(self.free.get() - 1);
            Ok(TestSensor(self.clone()))
        }

        fn clean_up(&self) {}
    }

    impl SensorTopics for TestSensor {
        fn add(&mut self, _: Topic) -> Result<(), Failure> {
            Ok(())
        }

        fn remove(&mut self, _: Topic) {}

        fn skip(&mut self, _: Topic, _: u64) {}

        fn send(&mut self, _: Topic, _: &Header, _: CheckedPayload<'_>) {
            self.0.sent.set(self.0.sent.get() + 1);
        }

        fn connect(&self, _: Topic) {}

        fn wake(&self, _: WakeEvent) {}

        fn failed(&self) -> u64 {
            0
        }
    }

    impl Drop for TestSensor {
        fn drop(&mut self) {
            self.0.free.set(self.0.free.get() + 1);
        }
    }

    /// A network without a key, on which gateway `h5` and others send zones of their sensor `front`.
    struct Network {
        incoming: Incoming,
        republisher: Republisher<TestStore>,
        sequence: u32,
    }

    impl Network {
        fn new(capacity: usize) -> Network {
            let store = TestStore { free: Rc::new(Cell::new(capacity)), sent: Rc::default() };
            let republisher = Republisher::new(store, 1, 0).only_proven();
            Network { incoming: Incoming::new(&Topic::ALL), republisher, sequence: 0 }
        }

        /// Receives a datagram of gateway `hub` at `ms`. Returns the sensor's name if the sensor is published from this
        /// datagram on.
        fn receive(
            &mut self,
            hub: u64,
            ms: u64,
            number: u8,
            pack: impl Fn(&mut [u8]) -> Option<usize>,
        ) -> Option<String> {
            self.sequence += 1;
            let mut buffer = [0; MTU_ETHERNET];
            let len = pack(&mut buffer[HEADER_LEN..]).unwrap();
            let head = Head {
                topic: number,
                revision: 1,
                hub,
                epoch: 1,
                sequence: self.sequence,
                ..Head::default()
            };
            let bytes = head.seal(&mut buffer, len).unwrap().to_vec();
            let (mut whole, now) = (Vec::new(), WallTimestamp { monotonic_ns: ms * 1_000_000, wall_ns: 0 });
            let name = format!("h{hub}");
            match self.incoming.receive(&bytes, hub, now, &mut whole) {
                ReceiveOutcome::Announced(announcement) => {
                    self.republisher.on_announcement(&announcement, &name, now)
                }
                ReceiveOutcome::Sample(sample) => self.republisher.sample(&sample, || name, now),
                _ => panic!("refused"),
            }
            .unwrap()
        }

        fn announce(&mut self, hub: u64, ms: u64) -> Option<String> {
            let mut announce = Announce::new(1, "front", "");
            announce.add(Announced { topic: Topic::Zones.number(), group: 1, port: PORT, next: 1 });
            self.receive(hub, ms, Announce::NUMBER, |room| announce.pack(room))
        }

        fn zones(&mut self, hub: u64, ms: u64) -> Option<String> {
            self.receive(hub, ms, Topic::Zones.number(), |room| Zones::unknown().pack(room))
        }
    }

    #[test]
    fn publishes_sensor_after_a_second_of_samples() {
        let mut network = Network::new(MAX_SENSORS);
        assert_eq!(
            [network.announce(5, 0), network.zones(5, 0), network.announce(5, 900)],
            [None, None, None]
        );
        assert_eq!((network.zones(5, 999), network.republisher.names()), (None, vec![]));
        assert_eq!(network.zones(5, 1_000), Some("h5.front".to_owned()));
        let DroppedSamples { unproven, shortage, .. } = network.republisher.dropped;
        assert_eq!((unproven, shortage), (1, 0), "the last sample is published late");
        assert_eq!(network.republisher.store.sent.get(), 2);
        // The next sensor is announced only after its gateway is known to deliver.
        assert_eq!([network.zones(6, 2_000), network.zones(6, 3_000)], [None, None]);
        assert_eq!(network.announce(6, 3_000), Some("h6.front".to_owned()));
    }

    #[test]
    fn counts_samples_without_room() {
        let mut network = Network::new(1);
        network.announce(5, 0);
        assert_eq!([network.zones(5, 0), network.zones(5, 1_000)], [None, Some("h5.front".to_owned())]);
        network.announce(6, 1_000);
        network.zones(6, 1_000);
        network.zones(5, 2_000);
        for ms in [2_000, 2_100, 2_200] {
            assert_eq!(network.zones(6, ms), None);
        }
        assert_eq!(network.republisher.dropped.no_room, 3);
        assert_eq!((network.republisher.names(), network.republisher.evicted_active), (vec!["h5.front"], 0));
        // A silent sensor is evicted, and its memory is used for the other one.
        assert_eq!(network.zones(6, 5_000), Some("h6.front".to_owned()));
        assert_eq!((network.republisher.names(), network.republisher.evicted_active), (vec!["h6.front"], 1));
    }
}
