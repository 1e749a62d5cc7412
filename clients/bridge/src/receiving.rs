//! Receives samples from other machines over Zenoh. Checks that each sample matches the key under which it arrived,
//! counts it, and publishes it as a topic of this machine. All queues are limited, and rejected input is counted.

use std::collections::VecDeque;
use std::io::{stderr, stdout};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use scanhub_network::lan::address::{ANNOUNCE, Address, LIVE, PREFIX, parse_live};
use scanhub_network::{ClassNames, Origin, ReceiverConfig, RemoteReceiver, now};
use scanhub_schema::datagram::{HEADER_LEN, MAC_LEN};
use scanhub_schema::{Failure, Topic};
use scanhub_verbs::output::{ExitReason, Output};

use crate::PublishOptions;
use crate::session::{Connection, Subscriber, ZenohSession};

/// Input from Zenoh.
enum InboundEvent {
    /// A key, and the payload that arrived under it.
    Sample(Box<str>, Vec<u8>),
    /// Key of a sensor that has appeared.
    Live(Box<str>),
}

/// Sending end of the queue between Zenoh's threads and the receiving thread.
#[derive(Clone)]
struct InboxSender {
    to: SyncSender<InboundEvent>,
    counts: Arc<Counts>,
}

/// Counters of input that was rejected before it was checked.
#[derive(Default)]
struct Counts {
    /// Inputs whose payload is longer than a sample can be, inputs without a payload, and inputs whose key is too long.
    long: AtomicU64,
    /// Inputs that arrived while the queue was full.
    overrun: AtomicU64,
}

/// Maximum number of inputs in the queue. A full queue needs 32 MB if all samples have the maximum length. It has room
/// for the samples that many sensors send in one second.
const QUEUE_CAPACITY: usize = 512;
/// Maximum length of a sample that is not divided into parts, in bytes.
const MAX_SAMPLE_LEN: usize = HEADER_LEN + u16::MAX as usize + MAC_LEN;
/// Maximum length of a key, in bytes. The keys of scanhub have at most 56 bytes.
const MAX_KEY_LEN: usize = 128;
/// Maximum number of inputs that are handled before the receiver does other work.
const BATCH_SIZE: usize = 64;
/// Maximum wait for input.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// Receives samples until `is_over` is set. Reports the statistics at the end, and whenever `report_requested` is set.
pub(crate) fn run(
    options: &PublishOptions,
    json: bool,
    connection: &Connection,
    report_requested: &AtomicBool,
    is_over: &AtomicBool,
) -> Result<(), ExitReason> {
    let (mut out, mut notes) = (stdout(), stderr());
    let config = ReceiverConfig {
        topics: options.topics.clone(),
        announced_topics: options.topics.clone(),
        names: &options.names,
        hubs: &options.hubs,
        key: None,
        state: None,
        publish: Some(&options.domain),
        limits: options.limits,
        memory: options.memory,
        // Zenoh's configuration controls access.
        only_proven: false,
        stats: true,
    };
    let remote_receiver = RemoteReceiver::open(
        config,
        json,
        ClassNames::BRIDGE,
        Output::new(&mut out),
        Output::new(&mut notes),
    )?;
    let Some(session) = connection.session(is_over) else { return Ok(()) };
    let (to, inbox) = sync_channel(QUEUE_CAPACITY);
    let inbox_sender = InboxSender { to, counts: Arc::default() };
    let subscribers = inbox_sender.listen(session, &options.topics)?;
    let query_sender = inbox_sender.clone();
    let query = |address: &Address<'_>| {
        let query_sender = query_sender.clone();
        session
            .query(&address.to_string(), MAX_SAMPLE_LEN, move |key, payload| query_sender.take(key, payload))
    };
    let refused = || connection.refused();
    let asking = QueryQueue::new(Instant::now());
    let counts = inbox_sender.counts;
    let mut receiving = ZenohReceiver {
        remote_receiver,
        queried_topics: topics_to_query(&options.topics),
        query_queue: asking,
        counts,
        foreign: 0,
        query: Box::new(query),
        refused: Box::new(refused),
    };
    receiving.run(&inbox, report_requested, is_over, move || drop(subscribers))
}

impl InboxSender {
    /// Subscribes to announcements, samples of `topics`, and the tokens of sensors.
    fn listen(&self, session: &ZenohSession, topics: &[Topic]) -> Result<Vec<Subscriber>, Failure> {
        // If all topics are received, use one key expression for all. A user whose rights cover this expression then
        // needs no other rights.
        let patterns = match topics.len() == Topic::ALL.len() {
            true => vec!["*"],
            false => std::iter::once(ANNOUNCE).chain(topics.iter().map(|topic| topic.name())).collect(),
        };
        let mut subscribers = Vec::new();
        for pattern in patterns {
            let samples = self.clone();
            let receive = move |key: &str, payload| samples.take(key, payload);
            subscribers.push(session.subscribe(
                &format!("{PREFIX}/*/*/{pattern}"),
                MAX_SAMPLE_LEN,
                receive,
            )?);
        }
        let tokens = self.clone();
        subscribers.push(session.watch(&format!("{PREFIX}/*/*/{LIVE}"), move |key| {
            if key.len() <= MAX_KEY_LEN {
                tokens.put(InboundEvent::Live(key.into()));
            }
        })?);
        Ok(subscribers)
    }

    fn take(&self, key: &str, payload: Option<Vec<u8>>) {
        match payload.filter(|_| key.len() <= MAX_KEY_LEN) {
            Some(payload) => self.put(InboundEvent::Sample(key.into(), payload)),
            None => _ = self.counts.long.fetch_add(1, Ordering::Relaxed),
        }
    }

    /// Adds an event without waiting, so that a sender that is too fast does not delay other senders.
    fn put(&self, event: InboundEvent) {
        if self.to.try_send(event).is_err() {
            self.counts.overrun.fetch_add(1, Ordering::Relaxed);
        }
    }
}

type QueryFn<'a> = dyn Fn(&Address<'_>) -> Result<(), Failure> + 'a;

struct ZenohReceiver<'a> {
    remote_receiver: RemoteReceiver<'a>,
    /// Topics for which a new sensor is queried; `None` stands for the sensor's announcement.
    queried_topics: Vec<Option<Topic>>,
    query_queue: QueryQueue,
    counts: Arc<Counts>,
    /// Number of inputs whose key does not belong to scanhub.
    foreign: u64,
    /// Function that queries an address.
    query: Box<QueryFn<'a>>,
    /// Function that returns the number of refused connections.
    refused: Box<dyn Fn() -> u64 + 'a>,
}

impl ZenohReceiver<'_> {
    /// Handles the input in `inbox` until `is_over` is set. Then calls `close`, which ends the subscriptions, and
    /// handles the input that is left in `inbox`.
    fn run(
        &mut self,
        inbox: &Receiver<InboundEvent>,
        report_requested: &AtomicBool,
        is_over: &AtomicBool,
        close: impl FnOnce(),
    ) -> Result<(), ExitReason> {
        self.remote_receiver.begin()?;
        while !is_over.load(Ordering::Relaxed) {
            let more = self.take_batch(inbox)?;
            self.query_next()?;
            self.remote_receiver.wake();
            self.remote_receiver.do_periodic_work(Instant::now(), more)?;
            if report_requested.swap(false, Ordering::Relaxed) {
                self.report_counters()?;
            }
        }
        close();
        inbox.try_iter().take(QUEUE_CAPACITY).try_for_each(|event| self.on_event(&event))?;
        self.query_queue.drop_all();
        self.remote_receiver.wake();
        self.report_counters()
    }

    /// Handles at most [`BATCH_SIZE`] inputs. Returns whether there may be more inputs.
    fn take_batch(&mut self, inbox: &Receiver<InboundEvent>) -> Result<bool, ExitReason> {
        let mut next = inbox.recv_timeout(POLL_INTERVAL).ok();
        for _ in 0..BATCH_SIZE {
            match next.take().or_else(|| inbox.try_recv().ok()) {
                Some(event) => self.on_event(&event)?,
                None => return Ok(false),
            }
        }
        Ok(true)
    }

    fn on_event(&mut self, event: &InboundEvent) -> Result<(), ExitReason> {
        match event {
            InboundEvent::Sample(key, payload) => return self.sample(key, payload),
            InboundEvent::Live(key) => match parse_live(key) {
                Some((hub, sensor)) => self.query_queue.add(hub, sensor),
                None => self.foreign += 1,
            },
        }
        Ok(())
    }

    fn sample(&mut self, key: &str, payload: &[u8]) -> Result<(), ExitReason> {
        let Some(name) = Address::parse(key) else {
            self.foreign += 1;
            return Ok(());
        };
        // Zenoh does not report the sender. Zenoh's access control decides who may send.
        let origin = Origin { sender: 0, address: None, name: Some(name), arrival: now() };
        self.remote_receiver.handle_datagram(payload, origin)
    }

    /// Queries new sensors for their last samples, because the next samples of some topics may not arrive for a long
    /// time.
    fn query_next(&mut self) -> Result<(), ExitReason> {
        while let Some((hub, sensor)) = self.query_queue.next(Instant::now()) {
            let queried = self
                .queried_topics
                .iter()
                .try_for_each(|&topic| (self.query)(&Address { hub, sensor: &sensor, topic }));
            if let Err(failure) = queried {
                self.query_queue.not_requested += 1;
                self.remote_receiver.problem(&failure.to_string())?;
            }
        }
        Ok(())
    }

    fn report_counters(&mut self) -> Result<(), ExitReason> {
        let count = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let Counts { long, overrun } = &*self.counts;
        let others = [
            ("key", self.foreign + self.remote_receiver.foreign),
            ("long", count(long)),
            ("overrun", count(overrun)),
            ("not_requested", self.query_queue.not_requested),
            ("connection", (self.refused)()),
        ];
        self.remote_receiver.report_counters(&others)
    }
}

/// Returns the topics for which a new sensor is queried if the bridge receives `topics`. The first is the announcement
/// (`None`), because no sample is published before the announcement has arrived.
fn topics_to_query(topics: &[Topic]) -> Vec<Option<Topic>> {
    let stored = [Topic::Status, Topic::Background].into_iter().filter(|topic| topics.contains(topic));
    std::iter::once(None).chain(stored.map(Some)).collect()
}

/// Queue of new sensors that must still be queried. Any sender can announce sensors, so the queue is limited, and
/// dropped sensors are counted. Time is an argument.
struct QueryQueue {
    /// Hub and name of each sensor, the oldest first.
    waiting: VecDeque<(u64, Box<str>)>,
    /// Number of sensors queried since `second`, the start of the current second.
    queried: usize,
    second: Instant,
    /// Number of sensors that were not queried, because the queue was full or the query failed. The bridge still
    /// receives their periodic announcements.
    not_requested: u64,
}

/// Maximum number of sensors that are queried in a second.
const MAX_QUERIES_PER_SECOND: usize = 64;
/// Maximum number of sensors that wait for a query. The bridge queries this number of sensors in 16 s. Their names need
/// at most 96 kB.
const MAX_WAITING_SENSORS: usize = 1024;
const SECOND: Duration = Duration::from_secs(1);

impl QueryQueue {
    fn new(now: Instant) -> QueryQueue {
        QueryQueue { waiting: VecDeque::new(), queried: 0, second: now, not_requested: 0 }
    }

    /// Adds the sensor `name` of `hub`.
    fn add(&mut self, hub: u64, name: &str) {
        if self.waiting.iter().any(|(other, its)| (*other, &**its) == (hub, name)) {
            return;
        }
        if self.waiting.len() == MAX_WAITING_SENSORS {
            self.not_requested += 1;
        } else {
            self.waiting.push_back((hub, name.into()));
        }
    }

    /// Returns the sensor to query now, if there is one.
    fn next(&mut self, now: Instant) -> Option<(u64, Box<str>)> {
        if now.saturating_duration_since(self.second) >= SECOND {
            (self.second, self.queried) = (now, 0);
        }
        if self.queried == MAX_QUERIES_PER_SECOND {
            return None;
        }
        let next = self.waiting.pop_front();
        self.queried += usize::from(next.is_some());
        next
    }

    /// Counts all waiting sensors as not queried, at the end of the run.
    fn drop_all(&mut self) {
        self.not_requested += self.waiting.drain(..).count() as u64;
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use scanhub_schema::datagram::{DatagramPayload, Head};
    use scanhub_schema::limits::TopicLimits;
    use scanhub_schema::{Kind, Zones};

    use super::*;

    const HUB: u64 = 0x5f3a_12bc_00d1_e2f3;

    /// Runs a receiver on `events`. `is_over` is set from the start, or by the first query. Returns the output of the
    /// receiver and the number of queries.
    fn run(
        events: Vec<InboundEvent>,
        has_ended: bool,
        query: impl Fn(&str) -> Result<(), Failure>,
    ) -> (String, u64) {
        let (mut out, mut notes) = (Vec::new(), Vec::new());
        let config = ReceiverConfig {
            topics: Topic::ALL.to_vec(),
            announced_topics: Topic::ALL.to_vec(),
            names: &[],
            hubs: &[],
            key: None,
            state: None,
            publish: None,
            limits: TopicLimits::default(),
            memory: 0,
            only_proven: false,
            stats: true,
        };
        let (to_out, to_notes) = (Output::new(&mut out), Output::new(&mut notes));
        let remote_receiver =
            RemoteReceiver::open(config, true, ClassNames::BRIDGE, to_out, to_notes).unwrap();
        let (to, inbox) = sync_channel(QUEUE_CAPACITY);
        let inbox_sender = InboxSender { to, counts: Arc::default() };
        events.into_iter().for_each(|event| inbox_sender.put(event));
        let questions = RefCell::new(0);
        let over = AtomicBool::new(has_ended);
        let query_and_end = |address: &Address<'_>| {
            *questions.borrow_mut() += 1;
            over.store(true, Ordering::Relaxed);
            query(&address.to_string())
        };
        let mut receiving = ZenohReceiver {
            remote_receiver,
            queried_topics: topics_to_query(&Topic::ALL),
            query_queue: QueryQueue::new(Instant::now()),
            counts: inbox_sender.counts.clone(),
            foreign: 0,
            query: Box::new(query_and_end),
            refused: Box::new(|| 0),
        };
        // The inbox accepts no input after `close`.
        receiving.run(&inbox, &AtomicBool::new(false), &over, || drop(inbox_sender)).unwrap();
        drop(receiving);
        (String::from_utf8(out).unwrap(), questions.into_inner())
    }

    fn zones(sequence: u32) -> InboundEvent {
        let mut buffer = [0; 100];
        let len = Zones::unknown().pack(&mut buffer[scanhub_schema::datagram::HEADER_LEN..]).unwrap();
        let head = Head {
            topic: Topic::Zones.number(),
            revision: 1,
            hub: HUB,
            epoch: 1,
            sequence,
            ..Head::default()
        };
        InboundEvent::Sample(
            format!("{PREFIX}/{HUB:016x}/front/zones").into(),
            head.seal(&mut buffer, len).unwrap().to_vec(),
        )
    }

    #[test]
    fn counters_include_samples_queued_at_the_end() {
        let (output, _) = run((0..QUEUE_CAPACITY as u32 + 7).map(zones).collect(), true, |_| Ok(()));
        assert!(output.contains(&format!("\"received\":{QUEUE_CAPACITY},")), "{output}");
        assert!(output.contains("\"overrun\":7"), "{output}");
    }

    #[test]
    fn another_version_is_reported_once_and_counted() {
        let corrupted = |at: usize, value: u8| {
            let InboundEvent::Sample(key, mut bytes) = zones(0) else { panic!("a sample") };
            bytes[at] = value;
            InboundEvent::Sample(key, bytes)
        };
        // The byte after the magic number is the version.
        let (output, _) = run(vec![corrupted(4, 9), corrupted(4, 9), zones(0)], true, |_| Ok(()));
        assert_eq!(output.matches("another version").count(), 1, "{output}");
        assert!(output.contains("\"version\":2,") && output.contains("\"received\":1,"), "{output}");
    }

    #[test]
    fn failed_query_is_reported_and_reception_continues() {
        let events = vec![InboundEvent::Live(format!("{PREFIX}/{HUB:016x}/front/{LIVE}").into()), zones(0)];
        let (output, query_count) =
            run(events, false, |key| Err(Failure::new(Kind::Failed, format!("Zenoh refuses {key}"), "")));
        assert_eq!(query_count, 1);
        assert!(output.contains("Zenoh refuses") && output.contains("\"not_requested\":1"), "{output}");
        assert!(output.contains("\"received\":1,"), "{output}");
    }

    /// Returns the names of all sensors that are queried at `now`.
    fn queries_at(asking: &mut QueryQueue, now: Instant) -> Vec<String> {
        std::iter::from_fn(|| asking.next(now)).map(|(_, name)| name.into()).collect()
    }

    #[test]
    fn queries_are_limited_to_64_per_second() {
        let begin = Instant::now();
        let mut asking = QueryQueue::new(begin);
        let names: Vec<_> = (0..150).map(|n| format!("s{n}")).collect();
        names.iter().for_each(|name| asking.add(5, name));
        asking.add(5, "s149");
        assert_eq!(queries_at(&mut asking, begin), names[..64]);
        assert_eq!(queries_at(&mut asking, begin + SECOND / 2), names[..0]);
        assert_eq!(queries_at(&mut asking, begin + SECOND), names[64..128]);
        assert_eq!(
            (queries_at(&mut asking, begin + 2 * SECOND), asking.not_requested),
            (names[128..].to_vec(), 0)
        );
        asking.add(5, "s0");
        assert_eq!(queries_at(&mut asking, begin + 3 * SECOND), ["s0"], "it came again");
    }

    #[test]
    fn sensors_beyond_the_queue_capacity_are_counted() {
        let begin = Instant::now();
        let mut asking = QueryQueue::new(begin);
        (0..10_000).for_each(|hub| asking.add(hub, "front"));
        assert_eq!(asking.not_requested, 10_000 - MAX_WAITING_SENSORS as u64);
        let all: usize = (0..100).map(|second| queries_at(&mut asking, begin + second * SECOND).len()).sum();
        assert_eq!(all, MAX_WAITING_SENSORS);
    }
}
