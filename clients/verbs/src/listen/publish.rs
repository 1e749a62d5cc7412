//! Sensors of other machines in the domain of this one, so that a consumer follows them as it follows those of a hub.
//! Refuses to know the network: what it gets was checked and is new.

mod arrivals;
mod remote_publisher;
mod topics;

use std::time::{Duration, Instant};

use scanhub_client::PublishSession;
use schema::datagram::{Announce, Arrival, Head};
use schema::shortage::raise_descriptor_limit;
use schema::{Domain, Failure, Topic};

use super::remote::Remote;
use topics::RemoteTopics;

/// The publishing end of all remote sensors of a domain.
pub(super) struct Publication {
    sensors: Vec<RemoteTopics>,
    /// What was not published.
    pub(super) left_out: LeftOut,
    /// Sensors that were put out for others.
    pub(super) displaced: u64,
    /// So many may still be put out, and when there will be one more.
    allowance: usize,
    allow_at: Instant,
    greet_at: Instant,
    upkeep_at: Instant,
    session: PublishSession,
}

/// Samples that came and were not published, by the reason.
#[derive(Clone, Copy, Default)]
pub(super) struct LeftOut {
    /// Nobody announced their sensor yet, so that it has no name.
    pub(super) unnamed: u64,
    /// Of topics that their sensor's announcement does not name.
    pub(super) unannounced: u64,
    /// A newer one was published already.
    pub(super) late: u64,
    /// Of sensors beyond the [`SENSORS`] for which there was room.
    pub(super) capacity: u64,
    /// Announced, but there was no memory or no descriptor for their topic.
    pub(super) shortage: u64,
}

/// The most sensors: each takes up to 6 MB of shared memory, and whoever can send to the network can announce some.
pub(super) const SENSORS: usize = 16;

/// To put out a sensor and make the topics of another takes milliseconds, and whoever can send can ask for it: so long it
/// takes until one more may be, after as many as there is room for.
const ALLOW_EVERY: Duration = Duration::from_millis(250);

/// So often late joiners get the last status, zones and background.
const GREET_EVERY: Duration = Duration::from_millis(100);

/// Between two looks at what dead consumers left, as in the hub.
const UPKEEP: Duration = Duration::from_secs(5);

impl Publication {
    /// Takes the domain's place for a listener, beside its hub if there is one.
    ///
    /// [`Kind::DomainHeld`] if another listener has it, [`Kind::Short`] if there is no memory
    /// for even one sensor, [`Kind::Failed`] if shared memory refuses.
    pub(super) fn open(domain: &Domain, now: Instant) -> Result<Publication, Failure> {
        // With fewer, fewer consumers can attach.
        let _ = raise_descriptor_limit();
        let session = PublishSession::open(domain, &Topic::ALL)?;
        Ok(Publication {
            sensors: Vec::new(),
            left_out: LeftOut::default(),
            displaced: 0,
            allowance: SENSORS,
            allow_at: now,
            greet_at: now,
            upkeep_at: now + UPKEEP,
            session,
        })
    }

    /// `announce` came from the gateway that is called `hub`, or now a sample of the sensor that it announced: makes what is
    /// not there yet of its sensor. The name of the sensor here, when all of it is there for the first time. Whoever had its
    /// number before has it no more, even if there is no room for this one: no sensor's samples are ever another's.
    ///
    /// A sample puts out another sensor where there is no room, but none that is known to deliver; an announcement does not.
    ///
    /// [`Kind::Short`] if memory or descriptors are; the sensors that are there go on.
    pub(super) fn announced(
        &mut self,
        head: &Head,
        hub: &str,
        announce: &Announce,
        arrival: Arrival,
    ) -> Result<Option<String>, Failure> {
        let name = format!("{hub}.{}", announce.sensor());
        for sensor in self.sensors.iter_mut().filter(|sensor| sensor.is(head) && sensor.name != name) {
            sensor.replaced();
        }
        let at = self.sensors.iter().position(|sensor| sensor.name == name);
        if at.is_none() && self.sensors.len() == SENSORS {
            match self.least(arrival).filter(|_| arrival.delivers && self.allowance > 0) {
                Some(least) => self.put_out(least),
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
            self.session.check_room(&missing)?;
        }
        let at = match at {
            Some(at) => at,
            None => {
                let mut sensor = RemoteTopics::new(&self.session, &name)?;
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

    /// A life of a gateway began with `head`: sensors that were published of the same epoch are another gateway's.
    pub(super) fn begun(&mut self, head: &Head) {
        self.sensors
            .iter_mut()
            .filter(|sensor| sensor.is_of(head.hub, head.epoch))
            .for_each(RemoteTopics::replaced);
    }

    /// What comes with `head` is of no sensor here, and one may be put out for it.
    pub(super) fn may_make_room(&self, head: &Head) -> bool {
        let is_full = self.sensors.len() == SENSORS && self.allowance > 0;
        is_full && !self.sensors.iter().any(|sensor| sensor.is(head))
    }

    /// Publishes `remote`, if it can be.
    pub(super) fn sample(&mut self, remote: &Remote<'_>, now: Instant) {
        let head = &remote.datagram.head;
        let left_out = &mut self.left_out;
        if remote.late {
            left_out.late += 1;
        } else if let Some(sensor) = self.sensors.iter_mut().find(|sensor| sensor.is(head)) {
            match sensor.publish(remote, now) {
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

    /// Wakes the consumers of those sensors of which something was published since the last call.
    pub(super) fn wake(&mut self) {
        self.sensors.iter_mut().for_each(RemoteTopics::wake);
    }

    /// What is due now and then: sensors that are silent, consumers that came or died.
    pub(super) fn look(&mut self, now: Instant) {
        if now >= self.greet_at {
            self.greet_at = now + GREET_EVERY;
            self.sensors.iter_mut().for_each(|sensor| sensor.look(now));
        }
        if now >= self.allow_at {
            self.allow_at = now + ALLOW_EVERY;
            self.allowance = SENSORS.min(self.allowance + 1);
        }
        if now >= self.upkeep_at {
            self.upkeep_at = now + UPKEEP;
            self.session.clean_up();
        }
    }

    /// Samples for which there was no memory.
    pub(super) fn loan_failed(&self) -> u64 {
        self.sensors.iter().map(RemoteTopics::loan_failed).sum()
    }

    /// The names of the sensors here.
    pub(super) fn names(&self) -> Vec<&str> {
        self.sensors.iter().map(|sensor| sensor.name.as_str()).collect()
    }

    /// Where the sensor stands that is put out for another of which this came.
    fn least(&self, arrival: Arrival) -> Option<usize> {
        let may_go = |at: &usize| self.sensors[*at].standing.may_go(arrival);
        (0..self.sensors.len()).filter(may_go).min_by_key(|&at| self.sensors[at].standing.worth_ns())
    }

    /// Takes the sensor away, after a last word to who follows it.
    fn put_out(&mut self, at: usize) {
        self.sensors.remove(at).replaced();
        self.displaced += 1;
        self.allowance -= 1;
    }
}
