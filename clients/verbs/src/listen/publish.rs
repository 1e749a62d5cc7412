//! Where remote sensors are published: the shared memory of a domain. Refuses to know which of them, and when.

mod any_publisher;

use lan::republish::{Republisher, SensorTopics, TopicStore};
use scanhub_client::{PublishSession, SensorPublisher, clock};
use schema::limits::TopicLimits;
use schema::shortage::raise_descriptor_limit;
use schema::{Domain, Failure, Header, Topic, Wake};

use any_publisher::AnyPublisher;

/// The publishing end of all remote sensors of a domain.
pub(super) type Publication = Republisher<SharedMemory>;

/// The shared memory of a domain.
pub(super) struct SharedMemory(PublishSession);

/// The topics of one sensor in shared memory.
pub(super) struct SharedTopics {
    /// One for each of [`Topic::ALL`].
    topics: [Option<AnyPublisher>; Topic::ALL.len()],
    // Behind the topics: it wakes their consumers.
    sensor: SensorPublisher,
}

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
        let topics = [const { None }; Topic::ALL.len()];
        Ok(SharedTopics { topics, sensor: self.0.sensor(name)? })
    }

    fn clean_up(&self) {
        self.0.clean_up();
    }
}

impl SensorTopics for SharedTopics {
    fn add(&mut self, topic: Topic) -> Result<(), Failure> {
        self.topics[topic as usize] = Some(AnyPublisher::new(topic, &self.sensor)?);
        Ok(())
    }

    fn remove(&mut self, topic: Topic) {
        self.topics[topic as usize] = None;
    }

    fn skip(&mut self, topic: Topic, count: u64) {
        if let Some(topic) = &mut self.topics[topic as usize] {
            topic.skip(count);
        }
    }

    fn send(&mut self, topic: Topic, header: &Header, payload: &[u8]) {
        if let Some(topic) = &mut self.topics[topic as usize] {
            topic.publish(header, payload);
        }
    }

    fn connect(&self, topic: Topic) {
        if let Some(topic) = &self.topics[topic as usize] {
            topic.connect();
        }
    }

    fn wake(&self, why: Wake) {
        // Those that cannot be woken look by themselves ten times a second.
        let _ = self.sensor.wake(why);
    }

    fn failed(&self) -> u64 {
        self.topics.iter().flatten().map(AnyPublisher::failed).sum()
    }
}
