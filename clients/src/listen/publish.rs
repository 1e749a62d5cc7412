//! Sensors of other machines in the domain of this one, so that a consumer follows them as it follows those of a hub.
//! Refuses to know the network: what it gets was checked and is new.

mod arrivals;
mod outlet;
mod topics;

use std::time::{Duration, Instant};

use schema::datagram::{Announce, Head};
use schema::ipc::{self, Node};
use schema::shortage::{allocate, check_descriptors, check_memory, raise_descriptor_limit, sensor_bytes};
use schema::{Domain, Failure, Kind, ListenLock, Topic};

use super::remote::Remote;
use topics::RemoteTopics;

/// The publishing end of all remote sensors of a domain.
pub(super) struct Publication {
    domain: Domain,
    sensors: Vec<RemoteTopics>,
    /// What was not published.
    pub(super) left_out: LeftOut,
    greet_at: Instant,
    upkeep_at: Instant,
    node: Node,
    _lock: ListenLock,
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
    /// Of more than [`SENSORS`] sensors.
    pub(super) capacity: u64,
    /// Announced, but there was no memory or no descriptor for their topic.
    pub(super) shortage: u64,
}

/// The most sensors: each takes up to 6 MB of shared memory, and whoever can send to the network can announce some.
pub(super) const SENSORS: usize = 16;

/// Descriptors of a service, and of its first consumer.
const SERVICE_DESCRIPTORS: u64 = 8;

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
        let lock = ListenLock::acquire(domain.root())?;
        check_memory(sensor_bytes(&Topic::ALL))?;
        let node = ipc::hub_node(domain)?;
        node.try_cleanup_dead_nodes();
        Ok(Publication {
            domain: domain.clone(),
            sensors: Vec::new(),
            left_out: LeftOut::default(),
            greet_at: now,
            upkeep_at: now + UPKEEP,
            node,
            _lock: lock,
        })
    }

    /// `announce` came from the gateway that is called `hub`: makes what is not there yet of its sensor. The name of the
    /// sensor here, when all of it is there for the first time. Whoever had its number before has it no more, even if
    /// there is no room for this one: no sensor's samples are ever another's.
    ///
    /// [`Kind::Short`] if memory, descriptors or places are; the sensors that are there go on.
    pub(super) fn announced(
        &mut self,
        head: &Head,
        hub: &str,
        announce: &Announce,
    ) -> Result<Option<String>, Failure> {
        let name = format!("{hub}.{}", announce.sensor());
        for sensor in self.sensors.iter_mut().filter(|sensor| sensor.is(head) && sensor.name != name) {
            sensor.replaced();
        }
        let at = self.sensors.iter().position(|sensor| sensor.name == name);
        if at.is_none() && self.sensors.len() == SENSORS {
            let what =
                format!("more than {SENSORS} remote sensors are announced: the others are not published");
            return Err(Failure::new(
                Kind::Short,
                what,
                "let another listener with another --domain have them",
            ));
        }
        if let Some(at) = at {
            // What it has goes on, even if there is no room for more.
            self.sensors[at].announced(head, announce);
        }
        let is_missing = |topic: &Topic| {
            let is_announced = announce.topics().iter().any(|announced| announced.topic == topic.number());
            is_announced && at.is_none_or(|at| !self.sensors[at].has(*topic))
        };
        let missing: Vec<_> = Topic::ALL.into_iter().filter(is_missing).collect();
        if at.is_none() || !missing.is_empty() {
            check_memory(sensor_bytes(&missing))?;
            check_descriptors((missing.len() as u64 + 1) * SERVICE_DESCRIPTORS)?;
        }
        let at = match at {
            Some(at) => at,
            None => {
                let mut sensor = RemoteTopics::new(&self.node, &name)?;
                sensor.announced(head, announce);
                self.sensors.push(sensor);
                self.sensors.len() - 1
            }
        };
        if !missing.is_empty() {
            let sensor = &mut self.sensors[at];
            let made = missing.iter().try_for_each(|&topic| sensor.add(&self.node, topic));
            made.and_then(|()| allocate(&self.domain)).inspect_err(|_| {
                // To write into what has no memory behind it would end the process.
                missing.iter().for_each(|&topic| sensor.remove(topic));
            })?;
        }
        let is_told = std::mem::replace(&mut self.sensors[at].is_told, true);
        Ok((!is_told).then_some(name))
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
        if now >= self.upkeep_at {
            self.upkeep_at = now + UPKEEP;
            self.node.try_cleanup_dead_nodes();
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
}
