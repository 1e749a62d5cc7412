//! Publication of remote sensors in the shared memory of a domain, within a budget of memory.

use std::cell::Cell;
use std::rc::Rc;

use scanhub_client::{PublishSession, SensorPublisher, clock};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{ArrayFlags, Failure, Header, Kind, MAX_BEAMS, Telegram, Topic, WakeEvent};
use scanhub_shm::resource_limits::{check_memory, raise_descriptor_limit, sensor_bytes};
use scanhub_shm::{Domain, Payload};

use crate::lan::incoming::CheckedPayload;
use crate::lan::republish::{Republisher, SensorTopics, TopicStore};

/// Publisher of all remote sensors in a domain.
pub(super) type Publication = Republisher<SharedMemory>;

/// Shared memory of a domain, with a budget for remote sensors.
pub(super) struct SharedMemory {
    session: PublishSession,
    budget: Rc<Budget>,
}

/// Topics of one sensor in shared memory. Announcements do not contain the length of samples. Topics are therefore
/// created with room for the samples of an LMS, and created again when a longer sample arrives. Their subscribers stay.
pub(super) struct SharedTopics {
    /// Existing topics, by topic.
    topics: [Option<CreatedTopic>; Topic::ALL.len()],
    /// Next number of each topic that could not be created again because memory was short.
    next_numbers: [Option<u64>; Topic::ALL.len()],
    /// Limits with which the next topic is created. Each longer sample raises them.
    limits: TopicLimits,
    /// Number of times that the limits were raised.
    widen_count: u32,
    /// Number of samples for which there was no memory, of topics that were created again or no longer exist.
    failed: u64,
    // This field is after the topics, so that it is dropped later, because it wakes their subscribers.
    sensor: SensorPublisher,
    budget: Rc<Budget>,
    /// Share of the budget for the sensor's doorbell and event.
    _share: Share,
}

/// A topic and the limits that it was created with.
struct CreatedTopic {
    publisher: AnyPublisher,
    limits: TopicLimits,
    // This field is after the publisher, whose memory it counts, so that it is dropped later.
    share: Share,
}

/// Number of times that limits are raised to exactly what a sample needs. After that, they are raised to the maximum,
/// because a sender could otherwise require one more beam with each sample.
const MAX_EXACT_WIDENINGS: u32 = 4;

/// Takes the lock of the domain's listener. All topics are created with `limits`, and together take at most `memory`
/// bytes.
///
/// Returns [`Kind::Configuration`] if `memory` is too small for a sensor, and [`Kind::DomainHeld`] if another listener
/// has the lock. Returns [`Kind::ResourceExhausted`] if there is no memory for even one sensor, and [`Kind::Failed`] if
/// shared memory cannot be used.
pub(super) fn open(domain: &Domain, limits: TopicLimits, memory: u64) -> Result<Publication, Failure> {
    // If the limit cannot be raised, fewer subscribers can attach.
    let _ = raise_descriptor_limit();
    let needed = sensor_bytes(&Topic::ALL, &limits);
    if memory < needed {
        let (have, need) = (memory.div_ceil(MEGABYTE), needed.div_ceil(MEGABYTE));
        let what =
            format!("--memory {have} has no room for a sensor with {} subscribers", limits.subscribers);
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
        Ok(self.session.check_room(topics)?)
    }

    fn fits(&self, topics: &[Topic]) -> bool {
        self.budget.has_left(sensor_bytes(topics, self.session.limits()))
    }

    fn sensor(&self, name: &str) -> Result<SharedTopics, Failure> {
        let (topics, next_numbers) = ([const { None }; Topic::ALL.len()], [None; Topic::ALL.len()]);
        let limits = *self.session.limits();
        Ok(SharedTopics {
            topics,
            next_numbers,
            limits,
            widen_count: 0,
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
    /// Returns raised limits with which `topic` has room for `payload`. `None` if the topic has enough room already.
    fn widened_limits(&self, topic: Topic, payload: CheckedPayload<'_>) -> Option<TopicLimits> {
        let mut limits = self.topics[topic as usize].as_ref()?.limits;
        if payload.room <= topic.max_payload_len(&limits) {
            return None;
        }
        AnyPublisher::widen(topic, &mut limits, payload.bytes);
        let known = TopicLimits {
            beams: limits.beams.max(self.limits.beams),
            contents: limits.contents | self.limits.contents,
            telegram: limits.telegram.max(self.limits.telegram),
            ..limits
        };
        Some(if known != self.limits && self.widen_count >= MAX_EXACT_WIDENINGS {
            TopicLimits { beams: MAX_BEAMS, contents: ArrayFlags::ALL, telegram: Telegram::MAX_LEN, ..known }
        } else {
            known
        })
    }

    /// Creates `topic` again if it has no room for `payload`. A sample that is still too long is counted when it is
    /// published.
    fn make_room(&mut self, topic: Topic, payload: CheckedPayload<'_>) {
        let Some(limits) = self.widened_limits(topic, payload) else { return };
        if !has_memory(topic, &limits) {
            return;
        }
        self.widen_count += u32::from(limits != self.limits);
        self.limits = limits;
        let Some(CreatedTopic { publisher, limits: before, share }) = self.topics[topic as usize].take()
        else {
            return;
        };
        let (next, failed) = (publisher.next_number(), publisher.failed());
        // Drop the publisher first, because a topic has only one publisher at a time.
        drop((publisher, share));
        self.failed += failed;
        self.topics[topic as usize] =
            [limits, before].into_iter().find_map(|limits| self.created(topic, limits).ok());
        self.next_numbers[topic as usize] = self.topics[topic as usize].is_none().then_some(0);
        self.skip(topic, next);
    }

    /// Creates `topic` again if it could not be created for lack of memory, and there is memory now.
    fn recreate(&mut self, topic: Topic) {
        let Some(next) = self.next_numbers[topic as usize] else { return };
        if self.budget.has_left(topic_bytes(topic, &self.limits))
            && has_memory(topic, &self.limits)
            && let Ok(made) = self.created(topic, self.limits)
        {
            self.topics[topic as usize] = Some(made);
            self.next_numbers[topic as usize] = None;
            self.skip(topic, next);
        }
    }

    fn created(&self, topic: Topic, limits: TopicLimits) -> Result<CreatedTopic, Failure> {
        let publisher = AnyPublisher::new(topic, &self.sensor, &limits)?;
        Ok(CreatedTopic { publisher, limits, share: self.budget.take(topic_bytes(topic, &limits)) })
    }
}

impl SensorTopics for SharedTopics {
    fn add(&mut self, topic: Topic) -> Result<(), Failure> {
        let is_wide = self.budget.has_left(topic_bytes(topic, &self.limits));
        let limits = if is_wide { self.limits } else { *self.sensor.limits() };
        self.topics[topic as usize] = Some(self.created(topic, limits)?);
        Ok(())
    }

    fn fits(&self, topic: Topic, payload: CheckedPayload<'_>) -> bool {
        let Some(limits) = self.widened_limits(topic, payload) else { return true };
        let before = self.topics[topic as usize].as_ref().map_or(0, |made| made.share.bytes());
        self.budget.has_left(topic_bytes(topic, &limits).saturating_sub(before))
    }

    fn remove(&mut self, topic: Topic) {
        self.topics[topic as usize] = None;
        self.next_numbers[topic as usize] = None;
    }

    fn skip(&mut self, topic: Topic, count: u64) {
        if let Some(made) = &mut self.topics[topic as usize] {
            made.publisher.skip(count);
        } else if let Some(next) = &mut self.next_numbers[topic as usize] {
            *next += count;
        }
    }

    fn send(&mut self, topic: Topic, header: &Header, payload: CheckedPayload<'_>) {
        self.recreate(topic);
        self.make_room(topic, payload);
        if let Some(made) = &mut self.topics[topic as usize] {
            made.publisher.publish(header, payload);
        } else if let Some(next) = &mut self.next_numbers[topic as usize] {
            *next += 1;
            self.failed += 1;
        }
    }

    fn connect(&self, topic: Topic) {
        if let Some(made) = &self.topics[topic as usize] {
            made.publisher.connect();
        }
    }

    fn wake(&self, event: WakeEvent) {
        // Ignore an error: subscribers that cannot be woken poll ten times a second.
        let _ = self.sensor.wake(event);
    }

    fn failed(&self) -> u64 {
        self.failed + self.topics.iter().flatten().map(|made| made.publisher.failed()).sum::<u64>()
    }
}

/// Returns the number of bytes of memory that `topic` takes with these `limits`, without the memory of the sensor's
/// event.
fn topic_bytes(topic: Topic, limits: &TopicLimits) -> u64 {
    sensor_bytes(&[topic], limits) - sensor_bytes(&[], limits)
}

/// Returns whether there is memory for one more `topic` with these `limits`.
fn has_memory(topic: Topic, limits: &TopicLimits) -> bool {
    let needed = sensor_bytes(&[topic], limits);
    check_memory(needed, needed).is_ok()
}

/// Number of bytes of shared memory that may be used, and number of bytes in use.
#[derive(Debug)]
struct Budget {
    bytes: u64,
    used: Cell<u64>,
}

/// Part of a budget that is in use. Dropping the share returns its bytes to the budget.
#[derive(Debug)]
struct Share {
    budget: Rc<Budget>,
    bytes: u64,
}

impl Budget {
    /// Creates a budget of this number of bytes.
    fn new(bytes: u64) -> Budget {
        Budget { bytes, used: Cell::new(0) }
    }

    /// Returns whether `bytes` are left.
    fn has_left(&self, bytes: u64) -> bool {
        self.used.get().saturating_add(bytes) <= self.bytes
    }

    /// Takes `bytes`. The caller has checked that they are left.
    fn take(self: &Rc<Budget>, bytes: u64) -> Share {
        self.used.set(self.used.get() + bytes);
        Share { budget: self.clone(), bytes }
    }
}

impl Share {
    /// Returns the size of the share.
    fn bytes(&self) -> u64 {
        self.bytes
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        self.budget.used.set(self.budget.used.get() - self.bytes);
    }
}

/// Publisher that takes a payload in the form that it has in a datagram.
trait PublishPacked {
    fn publish(&mut self, header: &Header, payload: CheckedPayload<'_>);
}

impl<P: Payload + DatagramPayload + ?Sized> PublishPacked for scanhub_client::Publication<P> {
    fn publish(&mut self, header: &Header, CheckedPayload { bytes, room }: CheckedPayload<'_>) {
        // Ignore an error: the topic counts samples that fail.
        let _ = self.send_len_with(header, room, |sample| {
            let _ = sample.fill(bytes, room);
        });
    }
}

/// Generates the publisher of any topic from the table of topics.
macro_rules! publishers {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Publisher of any topic.
        enum AnyPublisher { $($topic(scanhub_client::Publication<scanhub_schema::payload_type!($payload)>),)* }

        impl AnyPublisher {
            /// Creates `topic` of `sensor` with these `limits`.
            fn new(
                topic: Topic,
                sensor: &SensorPublisher,
                limits: &TopicLimits,
            ) -> Result<AnyPublisher, Failure> {
                Ok(match topic { $(Topic::$topic => AnyPublisher::$topic(sensor.topic_for(limits)?),)* })
            }

            /// Raises `limits` until `topic` has room for `payload`.
            fn widen(topic: Topic, limits: &mut TopicLimits, payload: &[u8]) {
                match topic { $(
                    Topic::$topic => <scanhub_schema::payload_type!($payload)>::widen(limits, payload),
                )* }
            }

            fn publish(&mut self, header: &Header, payload: CheckedPayload<'_>) {
                match self { $(AnyPublisher::$topic(topic) => PublishPacked::publish(topic, header, payload),)* }
            }

            /// Uses up `count` numbers without a sample.
            fn skip(&mut self, count: u64) {
                match self { $(AnyPublisher::$topic(topic) => topic.skip(count),)* }
            }

            /// Returns the number of the next sample.
            fn next_number(&self) -> u64 {
                match self { $(AnyPublisher::$topic(topic) => topic.next_number(),)* }
            }

            /// Connects late joiners, and sends them the history.
            fn connect(&self) {
                match self { $(AnyPublisher::$topic(topic) => topic.connect(),)* }
            }

            /// Returns the number of samples for which there was no memory.
            fn failed(&self) -> u64 {
                match self { $(AnyPublisher::$topic(topic) => topic.failed(),)* }
            }
        }
    };
}

scanhub_schema::for_each_topic!(publishers);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dropped_share_returns_to_the_budget() {
        let budget = Rc::new(Budget::new(100));
        let shares = [budget.take(60), budget.take(40)];
        assert!(budget.has_left(0) && !budget.has_left(1));
        let [first, second] = shares;
        drop(first);
        assert!(budget.has_left(60) && !budget.has_left(61) && !budget.has_left(u64::MAX));
        assert_eq!(second.bytes(), 40);
    }
}
