//! Where topics of remote sensors are made: shared memory, or a model of it. Refuses to know when something is published.

use scanhub_schema::{Failure, Header, Topic, Wake};

/// A place for the topics of sensors.
pub trait TopicStore {
    /// The topics of one sensor. What is dropped is there no more.
    type Sensor: SensorTopics;

    /// Checks that there is room for `topics` of one more sensor.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if there is not.
    fn check_room(&self, topics: &[Topic]) -> Result<(), Failure>;

    /// Returns whether the memory that remote sensors may use has room for `topics` of one more sensor.
    fn fits(&self, topics: &[Topic]) -> bool {
        let _ = topics;
        true
    }

    /// Makes a sensor without topics.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if memory or descriptors are short, or as the place says.
    fn sensor(&self, name: &str) -> Result<Self::Sensor, Failure>;

    /// Removes what dead consumers left.
    fn clean_up(&self);
}

/// The topics of one sensor in a store. Those that are not there are neither sent nor skipped.
pub trait SensorTopics {
    /// Makes `topic`, which is not there.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if memory or descriptors are short, or as the place says.
    fn add(&mut self, topic: Topic) -> Result<(), Failure>;

    /// Takes `topic` away.
    fn remove(&mut self, topic: Topic);

    /// Returns whether the memory that remote sensors may use has room for `topic` with samples as long as `payload`, which
    /// is as in a datagram, and was checked.
    fn fits(&self, topic: Topic, payload: &[u8]) -> bool {
        let _ = (topic, payload);
        true
    }

    /// Uses up `count` numbers of `topic` without a sample.
    fn skip(&mut self, topic: Topic, count: u64);

    /// Publishes a sample with `header` but for its number in the topic, which is the topic's own next one. `payload` is as
    /// in a datagram, and was checked. What fails is counted in [`failed`](Self::failed), and uses its number up.
    fn send(&mut self, topic: Topic, header: &Header, payload: &[u8]);

    /// Gives consumers of `topic` that came since what it keeps for them.
    fn connect(&self, topic: Topic);

    /// Wakes the consumers of all topics.
    fn wake(&self, why: Wake);

    /// Returns the number of samples for which there was no memory.
    fn failed(&self) -> u64;
}
