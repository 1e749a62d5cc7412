//! Sensors of other machines in the domain of this one, so that a consumer follows them as it follows those of a hub.
//! Refuses to know the network: what it gets was checked and is new. Nor does it know where topics are made.

mod arrivals;
mod sensor;
mod store;
mod stream;

use schema::datagram::{Announce, Arrival, Head};
use schema::{Failure, Topic};

use crate::Stamp;
use crate::incoming::{Announcement, Remote, RemoteSample};
use sensor::RemoteSensor;
pub use store::{SensorTopics, TopicStore};
pub use stream::{Placed, Stream};

/// The publishing end of all remote sensors of a domain.
pub struct Republisher<S: TopicStore> {
    sensors: Vec<RemoteSensor<S::Sensor>>,
    /// What was not published.
    pub left_out: LeftOut,
    /// Sensors that were put out for others.
    pub displaced: u64,
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
}

/// The most sensors: each takes up to 20 MB of shared memory, and whoever can send to the network can announce some.
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
            allowance: SENSORS,
            allow_ns: now_ns,
            greet_ns: now_ns,
            upkeep_ns: now_ns.saturating_add(UPKEEP_NS),
            pid,
            store,
        }
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
    /// [`Kind::Short`](schema::Kind) if memory or descriptors are; the sensors that are there go on.
    pub fn announced(
        &mut self,
        announcement: &Announcement,
        hub: &str,
        now: Stamp,
    ) -> Result<Option<String>, Failure> {
        let Announcement { head, announce, arrival_ns, .. } = announcement;
        self.make(head, hub, announce, Arrival { delivers: false, now_ns: *arrival_ns }, now)
    }

    /// Publishes `sample`, or counts why not. Where there is no room for its sensor, another one may be put out for it; then
    /// as [`announced`](Self::announced).
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
        let RemoteSample { remote, announced, .. } = sample;
        let head = &remote.datagram.head;
        let made = match announced {
            Some(announce) if self.may_make_room(head) => {
                let arrival = Arrival { delivers: true, now_ns: remote.arrival_ns };
                self.make(head, &hub(), announce, arrival, now)
            }
            _ => Ok(None),
        };
        self.publish(remote);
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
        now: Stamp,
    ) -> Result<Option<String>, Failure> {
        let name = format!("{hub}.{}", announce.sensor());
        for sensor in self.sensors.iter_mut().filter(|sensor| sensor.is(head) && sensor.name != name) {
            sensor.replaced(now);
        }
        let at = self.sensors.iter().position(|sensor| sensor.name == name);
        if at.is_none() && self.sensors.len() == SENSORS {
            match self.least(arrival).filter(|_| arrival.delivers && self.allowance > 0) {
                Some(least) => self.put_out(least, now),
                None => return Ok(None),
            }
        }
        if let Some(at) = at {
            // What it has goes on, even if there is no room for more.
            self.sensors[at].announced(head, announce, arrival);
        }
        let is_missing = |topic: &Topic| {
            let is_announced = announce.topics().iter().any(|announced| announced.topic == topic.number());
            is_announced && at.is_none_or(|at| !self.sensors[at].has(*topic))
        };
        let missing: Vec<_> = Topic::ALL.into_iter().filter(is_missing).collect();
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
    fn may_make_room(&self, head: &Head) -> bool {
        let is_full = self.sensors.len() == SENSORS && self.allowance > 0;
        is_full && !self.sensors.iter().any(|sensor| sensor.is(head))
    }

    /// Publishes `remote`, if it can be.
    fn publish(&mut self, remote: &Remote<'_>) {
        let head = &remote.datagram.head;
        let left_out = &mut self.left_out;
        if remote.late {
            left_out.late += 1;
        } else if let Some(sensor) = self.sensors.iter_mut().find(|sensor| sensor.is(head)) {
            match sensor.publish(remote) {
                true => {}
                false if sensor.is_announced(remote.topic) => left_out.shortage += 1,
                false => left_out.unannounced += 1,
            }
        } else if remote.boot != 0 && self.sensors.len() == SENSORS {
            left_out.capacity += 1;
        } else if remote.boot != 0 {
            left_out.shortage += 1;
        } else {
            left_out.unnamed += 1;
        }
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
