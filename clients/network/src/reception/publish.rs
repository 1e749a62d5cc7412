//! Where remote sensors are published: the shared memory of a domain. Refuses to know which of them, and when.

mod any_publisher;
mod budget;

use std::rc::Rc;

use crate::lan::republish::{Republisher, SensorTopics, TopicStore};
use scanhub_client::{PublishSession, SensorPublisher, clock};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{BEAMS, Contents, Failure, Header, Kind, Telegram, Topic, Wake};
use scanhub_shm::Domain;
use scanhub_shm::shortage::{check_memory, raise_descriptor_limit, sensor_bytes};

use any_publisher::AnyPublisher;
use budget::{Budget, Share};

/// The publishing end of all remote sensors of a domain.
pub(super) type Publication = Republisher<SharedMemory>;

/// The shared memory of a domain. Remote sensors may use a part of it.
pub(super) struct SharedMemory {
    session: PublishSession,
    budget: Rc<Budget>,
}

/// The topics of one sensor in shared memory. How long its samples are is not announced: topics are made for an LMS, and
/// made anew where a sample comes that is longer. Their consumers stay.
pub(super) struct SharedTopics {
    /// One for each of [`Topic::ALL`].
    topics: [Option<Made>; Topic::ALL.len()],
    /// The next number of those that were there, and could not be made anew: there was no memory.
    gone: [Option<u64>; Topic::ALL.len()],
    /// What the next one is made for: what is known of the samples so far.
    limits: TopicLimits,
    /// How often that became more.
    widened: u32,
    /// Samples without memory, of topics that were made anew or are gone.
    failed: u64,
    // Behind the topics: it wakes their consumers.
    sensor: SensorPublisher,
    budget: Rc<Budget>,
    /// Memory of the doorbell and the event.
    _share: Share,
}

/// A topic, and what it was made for.
struct Made {
    publisher: AnyPublisher,
    limits: TopicLimits,
    // Behind the publisher, whose memory it counts.
    share: Share,
}

/// So often topics are made anew for exactly what came, then for the longest samples that there can be: whoever can send
/// could ask for a beam more with each sample.
const WIDENED_EXACTLY: u32 = 4;

/// Takes the lock of the domain's listener. All topics are created with `limits`, and take at most `memory` bytes together.
///
/// Returns [`Kind::Configuration`] if `memory` is too small for a sensor, and [`Kind::DomainHeld`] if another listener has
/// the lock. Returns [`Kind::Short`] if there is no memory for even one sensor, and [`Kind::Failed`] if shared memory
/// refuses.
pub(super) fn open(domain: &Domain, limits: TopicLimits, memory: u64) -> Result<Publication, Failure> {
    // With fewer, fewer consumers can attach.
    let _ = raise_descriptor_limit();
    let needed = sensor_bytes(&Topic::ALL, &limits);
    if memory < needed {
        let (have, need) = (memory.div_ceil(MEGABYTE), needed.div_ceil(MEGABYTE));
        let what = format!("--memory {have} has no room for a sensor with {} subscribers", limits.consumers);
        return Err(Failure::new(Kind::Configuration, what, format!("at least {need}")));
    }
    let session = PublishSession::open(domain, &Topic::ALL, limits)?;
    let store = SharedMemory { session, budget: Rc::new(Budget::new(memory)) };
    Ok(Republisher::new(store, std::process::id(), clock::now_ns()))
}

/// Unit of `--memory`.
const MEGABYTE: u64 = 1 << 20;

impl TopicStore for SharedMemory {
    type Sensor = SharedTopics;

    fn check_room(&self, topics: &[Topic]) -> Result<(), Failure> {
        self.session.check_room(topics)
    }

    fn fits(&self, topics: &[Topic]) -> bool {
        self.budget.has(sensor_bytes(topics, self.session.limits()))
    }

    fn sensor(&self, name: &str) -> Result<SharedTopics, Failure> {
        let (topics, gone) = ([const { None }; Topic::ALL.len()], [None; Topic::ALL.len()]);
        let limits = *self.session.limits();
        Ok(SharedTopics {
            topics,
            gone,
            limits,
            widened: 0,
            failed: 0,
            sensor: self.session.sensor(name)?,
            budget: self.budget.clone(),
            _share: self.budget.take(sensor_bytes(&[], &limits)),
        })
    }

    fn clean_up(&self) {
        self.session.clean_up();
    }
}

impl SharedTopics {
    /// Returns the limits with which `topic` has room for `payload`. `None` if it has room.
    fn wider(&self, topic: Topic, payload: &[u8]) -> Option<TopicLimits> {
        let mut limits = self.topics[topic as usize].as_ref()?.limits;
        if !AnyPublisher::widen(topic, &mut limits, payload) {
            return None;
        }
        let known = TopicLimits {
            beams: limits.beams.max(self.limits.beams),
            contents: limits.contents | self.limits.contents,
            telegram: limits.telegram.max(self.limits.telegram),
            ..limits
        };
        Some(if known != self.limits && self.widened >= WIDENED_EXACTLY {
            TopicLimits { beams: BEAMS, contents: Contents::ALL, telegram: Telegram::MAX, ..known }
        } else {
            known
        })
    }

    /// Creates `topic` again if it has no room for `payload`. A sample that is still too long is counted when it is published.
    fn make_room(&mut self, topic: Topic, payload: &[u8]) {
        let Some(limits) = self.wider(topic, payload) else { return };
        if !has_memory(topic, &limits) {
            return;
        }
        self.widened += u32::from(limits != self.limits);
        self.limits = limits;
        let Some(Made { publisher, limits: before, share }) = self.topics[topic as usize].take() else {
            return;
        };
        let (next, failed) = (publisher.next_number(), publisher.failed());
        // One at a time publishes a topic.
        drop((publisher, share));
        self.failed += failed;
        self.topics[topic as usize] =
            [limits, before].into_iter().find_map(|limits| self.made(topic, limits).ok());
        self.gone[topic as usize] = self.topics[topic as usize].is_none().then_some(0);
        self.skip(topic, next);
    }

    /// Makes `topic` again that is gone, as soon as there is memory.
    fn make_again(&mut self, topic: Topic) {
        let Some(next) = self.gone[topic as usize] else { return };
        if self.budget.has(topic_bytes(topic, &self.limits))
            && has_memory(topic, &self.limits)
            && let Ok(made) = self.made(topic, self.limits)
        {
            self.topics[topic as usize] = Some(made);
            self.gone[topic as usize] = None;
            self.skip(topic, next);
        }
    }

    fn made(&self, topic: Topic, limits: TopicLimits) -> Result<Made, Failure> {
        let publisher = AnyPublisher::new(topic, &self.sensor, &limits)?;
        Ok(Made { publisher, limits, share: self.budget.take(topic_bytes(topic, &limits)) })
    }
}

impl SensorTopics for SharedTopics {
    fn add(&mut self, topic: Topic) -> Result<(), Failure> {
        let is_wide = self.budget.has(topic_bytes(topic, &self.limits));
        let limits = if is_wide { self.limits } else { *self.sensor.limits() };
        self.topics[topic as usize] = Some(self.made(topic, limits)?);
        Ok(())
    }

    fn fits(&self, topic: Topic, payload: &[u8]) -> bool {
        let Some(limits) = self.wider(topic, payload) else { return true };
        let before = self.topics[topic as usize].as_ref().map_or(0, |made| made.share.bytes());
        self.budget.has(topic_bytes(topic, &limits).saturating_sub(before))
    }

    fn remove(&mut self, topic: Topic) {
        self.topics[topic as usize] = None;
        self.gone[topic as usize] = None;
    }

    fn skip(&mut self, topic: Topic, count: u64) {
        if let Some(made) = &mut self.topics[topic as usize] {
            made.publisher.skip(count);
        } else if let Some(next) = &mut self.gone[topic as usize] {
            *next += count;
        }
    }

    fn send(&mut self, topic: Topic, header: &Header, payload: &[u8]) {
        self.make_again(topic);
        self.make_room(topic, payload);
        if let Some(made) = &mut self.topics[topic as usize] {
            made.publisher.publish(header, payload);
        } else if let Some(next) = &mut self.gone[topic as usize] {
            *next += 1;
            self.failed += 1;
        }
    }

    fn connect(&self, topic: Topic) {
        if let Some(made) = &self.topics[topic as usize] {
            made.publisher.connect();
        }
    }

    fn wake(&self, why: Wake) {
        // Those that cannot be woken look by themselves ten times a second.
        let _ = self.sensor.wake(why);
    }

    fn failed(&self) -> u64 {
        self.failed + self.topics.iter().flatten().map(|made| made.publisher.failed()).sum::<u64>()
    }
}

/// Returns the memory of a `topic` that is made as `limits` say, without that of its sensor's event.
fn topic_bytes(topic: Topic, limits: &TopicLimits) -> u64 {
    sensor_bytes(&[topic], limits) - sensor_bytes(&[], limits)
}

/// Whether there is memory for one more `topic` that is made as `limits` say.
fn has_memory(topic: Topic, limits: &TopicLimits) -> bool {
    let needed = sensor_bytes(&[topic], limits);
    check_memory(needed, needed).is_ok()
}
