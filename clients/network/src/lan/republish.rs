//! Sensors of other machines in the domain of this one, so that a consumer follows them as it follows those of a hub.
//! Refuses to know the network: what it gets was checked and is new. Nor does it know where topics are made.

mod arrivals;
mod candidates;
mod sensor;
mod store;
mod stream;

use crate::lan::{Arrival, LIVES};
use scanhub_schema::datagram::{Announce, Head};
use scanhub_schema::{Failure, Topic};

use crate::lan::Stamp;
use crate::lan::incoming::{Announcement, RemoteSample};
use candidates::{Candidate, Candidates};
use sensor::{Outcome, RemoteSensor};
pub use store::{SensorTopics, TopicStore};
pub use stream::{Placed, Stream};

/// The publishing end of all remote sensors of a domain.
pub struct Republisher<S: TopicStore> {
    sensors: Vec<RemoteSensor<S::Sensor>>,
    /// What was not published.
    pub left_out: LeftOut,
    /// Sensors that were put out for others.
    pub displaced: u64,
    no_room: NoRoom,
    /// Whether topics are made only for sensors of a gateway that is known to deliver.
    only_proven: bool,
    candidates: Candidates,
    /// So many may still be put out, and when there will be one more.
    allowance: usize,
    allow_ns: u64,
    greet_ns: u64,
    upkeep_ns: u64,
    pid: u32,
    store: S,
}

/// Samples that came and were not published, by the reason.
#[derive(Clone, Copy, Default)]
pub struct LeftOut {
    /// Nobody announced their sensor yet, so that it has no name.
    pub unnamed: u64,
    /// Of topics that their sensor's announcement does not name.
    pub unannounced: u64,
    /// A newer one was published already.
    pub late: u64,
    /// Of sensors beyond the [`SENSORS`] for which there was room.
    pub capacity: u64,
    /// Announced, but there was no memory or no descriptor for their topic.
    pub shortage: u64,
    /// Samples of sensors whose gateway is not known to deliver yet.
    pub unproven: u64,
    /// Samples whose sensor or topic did not fit into the memory that remote sensors may use.
    pub no_room: u64,
}

/// Samples that did not fit into the memory that remote sensors may use, by gateway.
#[derive(Default)]
struct NoRoom(Vec<(u64, u64)>);

impl NoRoom {
    /// Counts a sample of `hub`. Gateways after the first [`LIVES`] are counted only in [`LeftOut::no_room`], because
    /// anyone who can send can invent more.
    fn count(&mut self, hub: u64) {
        if let Some(at) = self.0.iter().position(|(known, _)| *known == hub) {
            self.0[at].1 += 1;
        } else if self.0.len() < LIVES {
            self.0.push((hub, 1));
        }
    }
}

/// Maximum number of sensors. Anyone who can send to the network can announce some.
pub const SENSORS: usize = 16;

/// To put out a sensor and make the topics of another takes milliseconds, and whoever can send can ask for it: so long it
/// takes until one more may be, after as many as there is room for.
const ALLOW_EVERY_NS: u64 = 250_000_000;

/// So often late joiners get the last status, zones and background.
const GREET_EVERY_NS: u64 = 100_000_000;

/// Between two looks at what dead consumers left, as in the hub.
const UPKEEP_NS: u64 = 5_000_000_000;

impl<S: TopicStore> Republisher<S> {
    /// Makes the publishing end of process `pid`, which makes topics in `store`, at `now_ns`.
    pub fn new(store: S, pid: u32, now_ns: u64) -> Republisher<S> {
        Republisher {
            sensors: Vec::new(),
            left_out: LeftOut::default(),
            displaced: 0,
            no_room: NoRoom::default(),
            only_proven: false,
            candidates: Candidates::default(),
            allowance: SENSORS,
            allow_ns: now_ns,
            greet_ns: now_ns,
            upkeep_ns: now_ns.saturating_add(UPKEEP_NS),
            pid,
            store,
        }
    }

    /// Makes topics only for sensors whose gateway had the key, or has delivered for a second.
    pub fn only_proven(self) -> Republisher<S> {
        Republisher { only_proven: true, ..self }
    }

    /// A life of a gateway began with `head`: sensors that were published of the same epoch are another gateway's.
    pub fn begun(&mut self, head: &Head, now: Stamp) {
        self.sensors
            .iter_mut()
            .filter(|sensor| sensor.is_of(head.hub, head.epoch))
            .for_each(|sensor| sensor.replaced(now));
    }

    /// Takes what was announced by the gateway that is called `hub`: makes what is not there yet of its sensor. Returns the
    /// sensor's name here, when all of it is there for the first time.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if memory or descriptors are; the sensors that are there go on.
    pub fn announced(
        &mut self,
        announcement: &Announcement,
        hub: &str,
        now: Stamp,
    ) -> Result<Option<String>, Failure> {
        let Announcement { head, announce, arrival_ns, is_proven, .. } = announcement;
        let arrival = Arrival { delivers: false, now_ns: *arrival_ns };
        let candidate = if *is_proven { self.candidates.take(head) } else { None };
        let made = self.make(head, hub, announce, arrival, *is_proven, now);
        self.publish_kept(head, announce.boot, candidate);
        made
    }

    /// Publishes `sample`, or counts why not. Makes its sensor as [`announced`](Self::announced) does if its gateway is known
    /// to deliver with this sample. If there is no room for its sensor, another one may be removed for it.
    ///
    /// # Errors
    ///
    /// As [`announced`](Self::announced).
    pub fn sample(
        &mut self,
        sample: &RemoteSample<'_>,
        hub: impl FnOnce() -> String,
        now: Stamp,
    ) -> Result<Option<String>, Failure> {
        let RemoteSample { remote, announced, is_proven, .. } = sample;
        let head = &remote.datagram.head;
        let candidate = if *is_proven { self.candidates.take(head) } else { None };
        let made = match announced {
            Some(announce) if candidate.is_some() || self.may_make_room(head, announce) => {
                let arrival = Arrival { delivers: true, now_ns: remote.arrival_ns };
                self.make(head, &hub(), announce, arrival, *is_proven, now)
            }
            _ => Ok(None),
        };
        self.publish_kept(head, remote.boot, candidate);
        self.publish(sample);
        made
    }

    /// Wakes the consumers of those sensors of which something was published since the last call.
    pub fn wake(&mut self) {
        self.sensors.iter_mut().for_each(RemoteSensor::wake);
    }

    /// What is due at `now_ns`: sensors that are silent, consumers that came or died. Everything that came before `read` was
    /// taken, by the clocks of arrivals. A silence is said as of then: nobody knows yet what still waits.
    pub fn look(&mut self, now_ns: u64, read: Stamp) {
        if now_ns >= self.greet_ns {
            self.greet_ns = now_ns + GREET_EVERY_NS;
            self.sensors.iter_mut().for_each(|sensor| sensor.look(read));
        }
        if now_ns >= self.allow_ns {
            self.allow_ns = now_ns + ALLOW_EVERY_NS;
            self.allowance = SENSORS.min(self.allowance + 1);
        }
        if now_ns >= self.upkeep_ns {
            self.upkeep_ns = now_ns + UPKEEP_NS;
            self.store.clean_up();
        }
    }

    /// Returns the number of samples for which there was no memory.
    pub fn failed(&self) -> u64 {
        self.sensors.iter().map(RemoteSensor::failed).sum()
    }

    /// Returns the gateways with samples that did not fit into the memory that remote sensors may use, at most [`LIVES`], and
    /// the number of these samples.
    pub fn no_room(&self) -> &[(u64, u64)] {
        &self.no_room.0
    }

    /// Returns the names of the sensors here.
    pub fn names(&self) -> Vec<&str> {
        self.sensors.iter().map(|sensor| sensor.name.as_str()).collect()
    }

    /// `announce` came from the gateway that is called `hub`, or now a sample of the sensor that it announced: makes what is
    /// not there yet of its sensor. The name of the sensor here, when all of it is there for the first time. Whoever had its
    /// number before has it no more, even if there is no room for this one: no sensor's samples are ever another's.
    ///
    /// A sample puts out another sensor where there is no room, but none that is known to deliver; an announcement does not.
    fn make(
        &mut self,
        head: &Head,
        hub: &str,
        announce: &Announce,
        arrival: Arrival,
        is_proven: bool,
        now: Stamp,
    ) -> Result<Option<String>, Failure> {
        let name = format!("{hub}.{}", announce.sensor());
        for sensor in self.sensors.iter_mut().filter(|sensor| sensor.is(head) && sensor.name != name) {
            sensor.replaced(now);
        }
        let at = self.sensors.iter().position(|sensor| sensor.name == name);
        if let Some(at) = at {
            // Its topics stay, even if there is no room for more.
            self.sensors[at].announced(head, announce, arrival);
        }
        if self.only_proven && !is_proven {
            self.candidates.add(head);
            return Ok(None);
        }
        while at.is_none() && self.is_full(announce) {
            match self.least(arrival).filter(|_| arrival.delivers && self.allowance > 0) {
                Some(least) => self.put_out(least, now),
                None => return Ok(None),
            }
        }
        let is_missing = |topic: &Topic| at.is_none_or(|at| !self.sensors[at].has(*topic));
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
                sensor.announced(head, announce, arrival);
                self.sensors.push(sensor);
                self.sensors.len() - 1
            }
        };
        if !missing.is_empty() {
            let sensor = &mut self.sensors[at];
            // All of them or none.
            let made = missing.iter().try_for_each(|&topic| sensor.add(topic));
            made.inspect_err(|_| missing.iter().for_each(|&topic| sensor.remove(topic)))?;
        }
        let is_told = std::mem::replace(&mut self.sensors[at].is_told, true);
        Ok((!is_told).then_some(name))
    }

    /// What comes with `head` is of no sensor here, and one may be put out for it.
    fn may_make_room(&self, head: &Head, announce: &Announce) -> bool {
        let is_here = || self.sensors.iter().any(|sensor| sensor.is(head));
        self.allowance > 0 && !is_here() && self.is_full(announce)
    }

    /// Returns whether there is no place, or no memory, for one more sensor with the topics of `announce`.
    fn is_full(&self, announce: &Announce) -> bool {
        self.sensors.len() == SENSORS || !self.store.fits(&topics(announce))
    }

    /// Publishes the samples of `candidate`, which sent `head`, if the sensor was made. Otherwise, it stays a candidate. Samples
    /// from another run of the hub than `boot` may belong to another sensor, so they are dropped.
    fn publish_kept(&mut self, head: &Head, boot: u64, candidate: Option<Candidate>) {
        let Some(candidate) = candidate else { return };
        let Some(sensor) = self.sensors.iter_mut().find(|sensor| sensor.is(head)) else {
            return self.candidates.put_back(candidate);
        };
        let samples = candidate.samples().filter(|remote| remote.boot == boot);
        let outcomes = samples.map(|remote| sensor.publish(&remote));
        let published = outcomes.filter(|outcome| *outcome == Outcome::Published).count();
        self.left_out.unproven -= published as u64;
    }

    /// Publishes `sample`, if it can be.
    fn publish(&mut self, sample: &RemoteSample<'_>) {
        let RemoteSample { remote, announced, is_proven, .. } = sample;
        let head = &remote.datagram.head;
        let reason = if remote.late {
            &mut self.left_out.late
        } else if let Some(sensor) = self.sensors.iter_mut().find(|sensor| sensor.is(head)) {
            match sensor.publish(remote) {
                Outcome::Published => return,
                Outcome::NoTopic if !sensor.is_announced(remote.topic) => &mut self.left_out.unannounced,
                Outcome::NoTopic if self.only_proven && !is_proven => &mut self.left_out.unproven,
                Outcome::NoTopic if self.store.fits(&[remote.topic]) => &mut self.left_out.shortage,
                Outcome::NoTopic | Outcome::NoRoom => {
                    self.no_room.count(head.hub);
                    &mut self.left_out.no_room
                }
            }
        } else if let Some(announce) = announced {
            if self.only_proven && !is_proven {
                self.candidates.add(head).keep(remote);
                &mut self.left_out.unproven
            } else if self.sensors.len() == SENSORS {
                &mut self.left_out.capacity
            } else if self.store.fits(&topics(announce)) {
                &mut self.left_out.shortage
            } else {
                self.no_room.count(head.hub);
                &mut self.left_out.no_room
            }
        } else {
            &mut self.left_out.unnamed
        };
        *reason += 1;
    }

    /// Where the sensor stands that is put out for another of which this came.
    fn least(&self, arrival: Arrival) -> Option<usize> {
        let may_go = |at: &usize| self.sensors[*at].standing.may_go(arrival);
        (0..self.sensors.len()).filter(may_go).min_by_key(|&at| self.sensors[at].standing.worth_ns())
    }

    /// Takes the sensor away, after a last word to who follows it.
    fn put_out(&mut self, at: usize, now: Stamp) {
        self.sensors.remove(at).replaced(now);
        self.displaced += 1;
        self.allowance -= 1;
    }
}

/// Returns the topics of `announce` that are known here.
fn topics(announce: &Announce) -> Vec<Topic> {
    let is_announced = |topic: &Topic| announce.topics().iter().any(|one| one.topic == topic.number());
    Topic::ALL.into_iter().filter(is_announced).collect()
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::rc::Rc;

    use scanhub_schema::datagram::{Announced, HEAD, MTU_ETHERNET, PORT, Packed};
    use scanhub_schema::{Header, Wake, Zones};

    use crate::lan::incoming::{Arrived, Incoming};

    use super::*;

    /// A store with places for a number of sensors.
    #[derive(Clone)]
    struct Places {
        free: Rc<Cell<usize>>,
        /// Samples of all sensors.
        sent: Rc<Cell<usize>>,
    }

    /// A sensor in a place, which is free again when this is dropped.
    struct Place(Places);

    impl TopicStore for Places {
        type Sensor = Place;

        fn check_room(&self, _: &[Topic]) -> Result<(), Failure> {
            Ok(())
        }

        fn fits(&self, _: &[Topic]) -> bool {
            self.free.get() > 0
        }

        fn sensor(&self, _: &str) -> Result<Place, Failure> {
            self.free.set(self.free.get() - 1);
            Ok(Place(self.clone()))
        }

        fn clean_up(&self) {}
    }

    impl SensorTopics for Place {
        fn add(&mut self, _: Topic) -> Result<(), Failure> {
            Ok(())
        }

        fn remove(&mut self, _: Topic) {}

        fn skip(&mut self, _: Topic, _: u64) {}

        fn send(&mut self, _: Topic, _: &Header, _: &[u8]) {
            self.0.sent.set(self.0.sent.get() + 1);
        }

        fn connect(&self, _: Topic) {}

        fn wake(&self, _: Wake) {}

        fn failed(&self) -> u64 {
            0
        }
    }

    impl Drop for Place {
        fn drop(&mut self) {
            self.0.free.set(self.0.free.get() + 1);
        }
    }

    /// A network without a key, on which gateway `h5` and others send zones of their sensor `front`.
    struct Network {
        incoming: Incoming,
        republisher: Republisher<Places>,
        sequence: u32,
    }

    impl Network {
        fn new(places: usize) -> Network {
            let store = Places { free: Rc::new(Cell::new(places)), sent: Rc::default() };
            let republisher = Republisher::new(store, 1, 0).only_proven();
            Network { incoming: Incoming::new(&Topic::ALL), republisher, sequence: 0 }
        }

        /// Receives a datagram of gateway `hub` at `ms`. Returns the sensor that is published with it.
        fn receive(
            &mut self,
            hub: u64,
            ms: u64,
            number: u8,
            pack: impl Fn(&mut [u8]) -> Option<usize>,
        ) -> Option<String> {
            self.sequence += 1;
            let mut buffer = [0; MTU_ETHERNET];
            let len = pack(&mut buffer[HEAD..]).unwrap();
            let head = Head {
                topic: number,
                revision: 1,
                hub,
                epoch: 1,
                sequence: self.sequence,
                ..Head::default()
            };
            let bytes = head.seal(&mut buffer, len).unwrap().to_vec();
            let (mut whole, now) = (Vec::new(), Stamp { monotonic_ns: ms * 1_000_000, wall_ns: 0 });
            let name = format!("h{hub}");
            match self.incoming.receive(&bytes, hub, now, &mut whole) {
                Arrived::Announced(announcement) => self.republisher.announced(&announcement, &name, now),
                Arrived::Sample(sample) => self.republisher.sample(&sample, || name, now),
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
    fn publishes_sensor_once_its_gateway_has_delivered_for_a_second() {
        let mut network = Network::new(SENSORS);
        assert_eq!(
            [network.announce(5, 0), network.zones(5, 0), network.announce(5, 900)],
            [None, None, None]
        );
        assert_eq!((network.zones(5, 999), network.republisher.names()), (None, vec![]));
        assert_eq!(network.zones(5, 1_000), Some("h5.front".to_owned()));
        let LeftOut { unproven, shortage, .. } = network.republisher.left_out;
        assert_eq!((unproven, shortage), (1, 0), "the last sample is published late");
        assert_eq!(network.republisher.store.sent.get(), 2);
        // Announced only after its gateway is known to deliver.
        assert_eq!([network.zones(6, 2_000), network.zones(6, 3_000)], [None, None]);
        assert_eq!(network.announce(6, 3_000), Some("h6.front".to_owned()));
    }

    #[test]
    fn counts_samples_without_room_by_gateway() {
        let mut network = Network::new(1);
        network.announce(5, 0);
        assert_eq!([network.zones(5, 0), network.zones(5, 1_000)], [None, Some("h5.front".to_owned())]);
        network.announce(6, 1_000);
        network.zones(6, 1_000);
        network.zones(5, 2_000);
        for ms in [2_000, 2_100, 2_200] {
            assert_eq!(network.zones(6, ms), None);
        }
        assert_eq!((network.republisher.no_room(), network.republisher.left_out.no_room), (&[(6, 3)][..], 3));
        assert_eq!((network.republisher.names(), network.republisher.displaced), (vec!["h5.front"], 0));
        // A silent sensor returns its memory.
        assert_eq!(network.zones(6, 5_000), Some("h6.front".to_owned()));
        assert_eq!((network.republisher.names(), network.republisher.displaced), (vec!["h6.front"], 1));
    }
}
