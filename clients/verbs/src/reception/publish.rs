//! Where remote sensors are published: the shared memory of a domain. Refuses to know which of them, and when.

mod any_publisher;

use lan::republish::{Republisher, SensorTopics, TopicStore};
use scanhub_client::{PublishSession, SensorPublisher, clock};
use schema::limits::TopicLimits;
use schema::shortage::{check_memory, raise_descriptor_limit, sensor_bytes};
use schema::{BEAMS, Contents, Domain, Failure, Header, Telegram, Topic, Wake};

use any_publisher::AnyPublisher;

/// The publishing end of all remote sensors of a domain.
pub(super) type Publication = Republisher<SharedMemory>;

/// The shared memory of a domain.
pub(super) struct SharedMemory(PublishSession);

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
}

/// A topic, and what it was made for.
struct Made {
    publisher: AnyPublisher,
    limits: TopicLimits,
}

/// So often topics are made anew for exactly what came, then for the longest samples that there can be: whoever can send
/// could ask for a beam more with each sample.
const WIDENED_EXACTLY: u32 = 4;

/// Takes the domain's place for a listener, beside its hub if there is one. All topics are made as `limits` say.
///
/// [`Kind::DomainHeld`](schema::Kind) if another listener has it, [`Kind::Short`](schema::Kind) if there is no memory
/// for even one sensor, [`Kind::Failed`](schema::Kind) if shared memory refuses.
pub(super) fn open(domain: &Domain, limits: TopicLimits) -> Result<Publication, Failure> {
    // With fewer, fewer consumers can attach.
    let _ = raise_descriptor_limit();
    let session = PublishSession::open(domain, &Topic::ALL, limits)?;
    Ok(Republisher::new(SharedMemory(session), std::process::id(), clock::now_ns()))
}

impl TopicStore for SharedMemory {
    type Sensor = SharedTopics;

    fn check_room(&self, topics: &[Topic]) -> Result<(), Failure> {
        self.0.check_room(topics)
    }

    fn sensor(&self, name: &str) -> Result<SharedTopics, Failure> {
        let (topics, gone) = ([const { None }; Topic::ALL.len()], [None; Topic::ALL.len()]);
        let sensor = self.0.sensor(name)?;
        Ok(SharedTopics { topics, gone, limits: *sensor.limits(), widened: 0, failed: 0, sensor })
    }

    fn clean_up(&self) {
        self.0.clean_up();
    }
}

impl SharedTopics {
    /// Makes `topic` anew if it has no room for `payload`. What is too long all the same is counted when it is published.
    fn make_room(&mut self, topic: Topic, payload: &[u8]) {
        let Some(made) = &self.topics[topic as usize] else { return };
        let mut limits = made.limits;
        if !AnyPublisher::widen(topic, &mut limits, payload) {
            return;
        }
        let known = TopicLimits {
            beams: limits.beams.max(self.limits.beams),
            contents: limits.contents | self.limits.contents,
            telegram: limits.telegram.max(self.limits.telegram),
            ..limits
        };
        let limits = if known != self.limits && self.widened >= WIDENED_EXACTLY {
            TopicLimits { beams: BEAMS, contents: Contents::ALL, telegram: Telegram::MAX, ..known }
        } else {
            known
        };
        if !has_memory(topic, &limits) {
            return;
        }
        self.widened += u32::from(limits != self.limits);
        self.limits = limits;
        let Some(Made { publisher, limits: before }) = self.topics[topic as usize].take() else { return };
        let (next, failed) = (publisher.next_number(), publisher.failed());
        // One at a time publishes a topic.
        drop(publisher);
        self.failed += failed;
        self.topics[topic as usize] =
            [limits, before].into_iter().find_map(|limits| self.made(topic, limits).ok());
        self.gone[topic as usize] = self.topics[topic as usize].is_none().then_some(0);
        self.skip(topic, next);
    }

    /// Makes `topic` again that is gone, as soon as there is memory.
    fn make_again(&mut self, topic: Topic) {
        let Some(next) = self.gone[topic as usize] else { return };
        if has_memory(topic, &self.limits)
            && let Ok(made) = self.made(topic, self.limits)
        {
            self.topics[topic as usize] = Some(made);
            self.gone[topic as usize] = None;
            self.skip(topic, next);
        }
    }

    fn made(&self, topic: Topic, limits: TopicLimits) -> Result<Made, Failure> {
        Ok(Made { publisher: AnyPublisher::new(topic, &self.sensor, &limits)?, limits })
    }
}

impl SensorTopics for SharedTopics {
    fn add(&mut self, topic: Topic) -> Result<(), Failure> {
        self.topics[topic as usize] = Some(self.made(topic, self.limits)?);
        Ok(())
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

/// Whether there is memory for one more `topic` that is made as `limits` say.
fn has_memory(topic: Topic, limits: &TopicLimits) -> bool {
    let needed = sensor_bytes(&[topic], limits);
    check_memory(needed, needed).is_ok()
}
