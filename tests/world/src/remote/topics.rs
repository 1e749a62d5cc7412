//! Topics of remote sensors, as queues in memory. The listener publishes in them, and the remote robot reads them when
//! it is woken.

use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use scanhub_network::lan::incoming::CheckedPayload;
use scanhub_network::lan::republish::{SensorTopics, TopicStore};
use scanhub_schema::{Failure, Header, Topic, WakeEvent};

/// Queues of all sensors, by the sensor's name. A queue outlives its publisher.
#[derive(Clone, Default)]
pub(crate) struct TopicMemory(Rc<RefCell<BTreeMap<String, SensorQueue>>>);

/// Samples of one sensor that its subscriber has not taken yet.
#[derive(Default)]
struct SensorQueue {
    samples: VecDeque<PublishedSample>,
    is_woken: bool,
}

/// A published sample.
pub(crate) struct PublishedSample {
    pub(crate) topic: Topic,
    pub(crate) header: Header,
    /// Payload, encoded as in a datagram.
    pub(crate) payload: Vec<u8>,
}

/// The topics of one sensor.
pub(crate) struct MemoryTopics {
    name: String,
    /// Next sequence number of each topic that exists.
    next: [Option<u64>; Topic::ALL.len()],
    memory: TopicMemory,
}

impl TopicMemory {
    /// Returns the queued samples of the sensor `name` if its subscriber was woken since the last call.
    pub(crate) fn take(&self, name: &str) -> VecDeque<PublishedSample> {
        let mut all = self.0.borrow_mut();
        let Some(waiting) = all.get_mut(name) else { return VecDeque::new() };
        if std::mem::take(&mut waiting.is_woken) {
            std::mem::take(&mut waiting.samples)
        } else {
            VecDeque::new()
        }
    }
}

impl TopicStore for TopicMemory {
    type Sensor = MemoryTopics;

    fn check_room(&self, _topics: &[Topic]) -> Result<(), Failure> {
        Ok(())
    }

    fn sensor(&self, name: &str) -> Result<MemoryTopics, Failure> {
        self.0.borrow_mut().entry(name.to_owned()).or_default();
        Ok(MemoryTopics { name: name.to_owned(), next: Default::default(), memory: self.clone() })
    }

    fn clean_up(&self) {}
}

impl SensorTopics for MemoryTopics {
    fn add(&mut self, topic: Topic) -> Result<(), Failure> {
        assert_eq!(self.next[topic as usize].replace(0), None, "{topic:?} is there");
        Ok(())
    }

    fn remove(&mut self, topic: Topic) {
        self.next[topic as usize] = None;
    }

    fn skip(&mut self, topic: Topic, count: u64) {
        *self.next[topic as usize].as_mut().expect("it is there") += count;
    }

    fn send(&mut self, topic: Topic, header: &Header, payload: CheckedPayload<'_>) {
        let next = self.next[topic as usize].as_mut().expect("it is there");
        let header = Header { topic_seq: *next, ..*header };
        *next += 1;
        let mut all = self.memory.0.borrow_mut();
        let waiting = all.get_mut(&self.name).expect("it was made");
        waiting.samples.push_back(PublishedSample { topic, header, payload: payload.bytes.to_vec() });
    }

    fn connect(&self, _topic: Topic) {}

    fn wake(&self, _why: WakeEvent) {
        self.memory.0.borrow_mut().get_mut(&self.name).expect("it was made").is_woken = true;
    }

    fn failed(&self) -> u64 {
        0
    }
}
