//! Sends the topics of a hub under scanhub's own Zenoh keys: `scanhub/HUB/SENSOR/TOPIC`. The payloads are the datagrams
//! of a gateway. The newest sample of each topic waits until the links have room for it.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::num::NonZeroU64;
use std::time::Duration;

use scanhub_network::lan::WallTimestamp;
use scanhub_network::lan::address::{Address, LIVE, PREFIX};
use scanhub_network::lan::outgoing::{Outgoing, Sample, Transmit};
use scanhub_network::{GatewayIdentity, SampleSink, Selection, begin_run, now, write_counters};
use scanhub_schema::{Failure, Topic};
use scanhub_shm::Domain;
use scanhub_verbs::output::{ExitReason, Output};

use crate::SendOptions;
use crate::queue::{Queue, QueueFiller, Sender, SharedQueue};
use crate::report::Report;
use crate::session::{DeclaredToken, Publisher, Queryable, Reply, ZenohSession};

/// Sending side of a bridge.
pub(crate) struct BridgeSender {
    pub(crate) identity: GatewayIdentity,
    filler: QueueFiller<Datagrams>,
}

/// Queue of datagrams, with their statistics.
pub(crate) struct Datagrams {
    hub: u64,
    outgoing: Outgoing,
    hub_is_available: bool,
    /// Number of the hub's runs so far.
    hub_runs: u64,
    /// Message that was taken last, until it is settled: sensor number, topic and length in bytes.
    in_flight: Option<(u8, Option<Topic>, usize)>,
}

/// Word in the name of the file that stores the bridge's identity. The file of a gateway has the name of the gateway's
/// network interface instead.
const INTERFACE: &str = "bridge";

impl BridgeSender {
    /// Starts a run of the domain's bridge, with a new epoch.
    pub(crate) fn open(options: &SendOptions) -> Result<BridgeSender, Failure> {
        let selection = Selection::parse(&options.topics, false)?;
        let domain = options.locations.first().map(Domain::name).unwrap_or_default();
        let identity = begin_run(domain, INTERFACE)?;
        let outgoing = Outgoing::with_queue(identity.hub, identity.epoch);
        let datagrams =
            Datagrams { hub: identity.hub, outgoing, hub_is_available: false, hub_runs: 0, in_flight: None };
        Ok(BridgeSender { identity, filler: QueueFiller::new(selection, &options.locations, datagrams) })
    }

    /// Adds new samples of the hub to the queue, and checks whether the hub runs. Returns whether more samples may be
    /// available.
    pub(crate) fn forward(&mut self, report: &mut Report<'_>) -> Result<bool, ExitReason> {
        self.filler.forward(&mut |notice| report.hub(notice))
    }

    /// Waits for samples of the hub, at most for `at_most`.
    pub(crate) fn wait(&mut self, at_most: Duration) -> Result<(), Failure> {
        self.filler.wait(at_most)
    }

    /// Queues the announcements of all sensors.
    pub(crate) fn announce(&mut self) {
        self.queue().lock().announce();
        self.queue().ring();
    }

    /// Writes the statistics of each topic.
    pub(crate) fn write_counters(&self, json: bool, out: &mut Output<'_>) -> Result<(), ExitReason> {
        write_counters(&self.queue().lock().outgoing, &self.identity, "bridge", json, out)
    }

    /// Returns the queue, for the sending thread.
    pub(crate) fn queue(&self) -> &SharedQueue<Datagrams> {
        self.filler.queue()
    }
}

impl Datagrams {
    fn announce(&mut self) {
        self.outgoing.announce(now(), &mut NullTransmit);
    }

    /// Returns the last announcements, statuses and backgrounds whose key matches a query.
    fn replies(&mut self, is_queried: &dyn Fn(&str) -> bool) -> Vec<Reply> {
        let Datagrams { hub, outgoing, hub_is_available: true, .. } = self else { return Vec::new() };
        let kept = outgoing.stored_samples().map(|(sensor, topic)| (sensor.to_owned(), topic));
        let kept: Vec<(String, Option<Topic>)> = kept.collect();
        let mut answers = Vec::new();
        for (sensor, topic) in kept {
            let key = Address { hub: *hub, sensor: &sensor, topic }.to_string();
            if is_queried(&key)
                && let Some(payload) = outgoing.resend_last(&sensor, topic, now())
            {
                answers.push(Reply { key, payload: payload.to_vec(), attachment: None });
            }
        }
        answers
    }
}

impl Queue for Datagrams {
    fn is_waiting(&self) -> bool {
        self.outgoing.is_waiting()
    }

    fn set_hub_available(&mut self, hub_is_available: bool, _: WallTimestamp) {
        if hub_is_available && !self.hub_is_available {
            self.hub_runs += 1;
            // Sensors of the previous run of the hub may no longer exist.
            self.outgoing.drop_kept();
        }
        self.hub_is_available = hub_is_available;
    }

    fn settle(&mut self, is_sent: bool) {
        if let Some((sensor, topic, len)) = self.in_flight.take().filter(|_| !is_sent) {
            self.outgoing.mark_failed(sensor, topic, len);
        }
    }
}

impl SampleSink for Datagrams {
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize {
        self.outgoing.follow(name, every)
    }

    fn needs(&self, sensor: usize, topic: Topic) -> bool {
        self.outgoing.needs(sensor, topic)
    }

    fn sample(&mut self, sensor: usize, sample: &Sample<'_>) {
        self.outgoing.sample(sensor, sample, now(), &mut NullTransmit);
    }
}

/// A transmitter that sends nothing, so that all samples wait in the queue.
struct NullTransmit;

impl Transmit for NullTransmit {
    fn transmit(&mut self, _: &[u8], _: u8, _: u8) -> bool {
        false
    }
}

/// Sends datagrams under their keys, and replies to queries with the last datagrams.
pub(crate) struct DatagramSender<'a> {
    session: &'a ZenohSession,
    hub: u64,
    topics: Vec<SentTopic>,
    /// Tokens of the hub and its sensors, by key. Empty while the hub is unavailable.
    tokens: HashMap<String, DeclaredToken>,
    /// Run of the hub that the tokens announce.
    hub_runs: u64,
    is_finished: bool,
    _queryable: Queryable,
}

/// A topic of a sensor. If the hub restarts with other links, a sensor number may belong to another sensor.
struct SentTopic {
    number: u8,
    sensor: String,
    topic: Option<Topic>,
    publisher: Option<Publisher>,
}

impl<'a> DatagramSender<'a> {
    /// Opens a sender for `queue`.
    pub(crate) fn open(
        session: &'a ZenohSession,
        queue: &SharedQueue<Datagrams>,
    ) -> Result<DatagramSender<'a>, Failure> {
        let hub = queue.lock().hub;
        let queue = queue.clone();
        let answer = move |is_queried: &dyn Fn(&str) -> bool| queue.lock().replies(is_queried);
        let _queryable = session.answer(&format!("{PREFIX}/{hub:016x}/*/*"), answer)?;
        Ok(DatagramSender {
            session,
            hub,
            topics: Vec::new(),
            tokens: HashMap::new(),
            hub_runs: 0,
            is_finished: false,
            _queryable,
        })
    }

    /// Declares a token for `key`, unless it already exists.
    fn announce(&mut self, key: String) -> Result<(), Failure> {
        if let Entry::Vacant(vacant) = self.tokens.entry(key) {
            let token = self.session.token(vacant.key())?;
            vacant.insert(token);
        }
        Ok(())
    }
}

impl Sender for DatagramSender<'_> {
    type Queue = Datagrams;

    fn declare(&mut self, queue: &SharedQueue<Datagrams>) -> Result<(), Failure> {
        let Datagrams { hub_is_available, hub_runs, .. } = *queue.lock();
        if !self.tokens.is_empty() && (!hub_is_available || hub_runs != self.hub_runs) {
            self.tokens.clear();
            self.topics.clear();
        }
        if hub_is_available && self.tokens.is_empty() {
            self.hub_runs = hub_runs;
            self.announce(format!("{PREFIX}/{:016x}/{LIVE}", self.hub))?;
        }
        Ok(())
    }

    fn take(&mut self, queue: &mut Datagrams, now: WallTimestamp, message: &mut Vec<u8>) -> Option<usize> {
        let queued = queue.outgoing.take_next(now)?;
        message.clear();
        message.extend_from_slice(queued.datagram);
        let ((number, sensor), topic) = (queued.sensor, queued.topic);
        queue.in_flight = Some((number, topic, message.len()));
        let is_same = |it: &SentTopic| (it.number, &*it.sensor, it.topic) == (number, sensor, topic);
        Some(self.topics.iter().position(is_same).unwrap_or_else(|| {
            self.topics.push(SentTopic { number, sensor: sensor.to_owned(), topic, publisher: None });
            self.topics.len() - 1
        }))
    }

    fn send(&mut self, topic: usize, message: &[u8]) -> Result<bool, Failure> {
        if self.topics[topic].publisher.is_none() {
            let SentTopic { ref sensor, topic: of, .. } = self.topics[topic];
            let hub = self.hub;
            let key = Address { hub, sensor, topic: of }.to_string();
            let live = format!("{PREFIX}/{hub:016x}/{sensor}/{LIVE}");
            self.topics[topic].publisher = Some(self.session.publisher(&key)?);
            // Announcements are sent even without a hub, but tokens exist only while the hub is available.
            if !self.tokens.is_empty() {
                self.announce(live)?;
            }
        }
        let publisher = self.topics[topic].publisher.as_ref();
        Ok(publisher.is_some_and(|publisher| self.session.put(publisher, message, None)))
    }

    /// Queues the last announcement. Its counters include everything that was sent.
    fn finish(&mut self, queue: &mut Datagrams) -> bool {
        if self.is_finished {
            return false;
        }
        self.is_finished = true;
        queue.announce();
        true
    }
}
