//! A ROS 2 node that publishes the hub's topics in the wire format of `rmw_zenoh`. The format of messages and tokens is
//! in `schema/ros`.

mod graph;

use std::io::{Write, stderr, stdout};
use std::num::NonZeroU64;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use scanhub_network::lan::WallTimestamp;
use scanhub_network::lan::outgoing::Sample;
use scanhub_network::{SampleSink, Selection, now, report_notice};
use scanhub_ros::RosNames;
use scanhub_ros::rmw_zenoh::{self, Distro, Node, Qos};
use scanhub_schema::{Failure, Topic};
use scanhub_shm::Domain;
use scanhub_verbs::output::{ExitReason, Output};
use serde::Serialize;

use crate::queue::{self, Queue, QueueFiller, Sender, SharedQueue};
use crate::session::{Connection, DeclaredToken, Publisher, Queryable, Reply, ZenohSession};
use graph::{Graph, PublishedTopic};

/// Options of the ROS 2 node.
#[derive(Clone, Debug)]
pub struct Ros2Options {
    /// `SENSOR/TOPIC`, `*/TOPIC` or `SENSOR/*`. With the suffix `:every=N`, only the samples of every Nth telegram are
    /// sent. If the list is empty, the node publishes all topics for which ROS has messages.
    pub topics: Vec<String>,
    /// Possible locations of the hub's domain.
    pub locations: Vec<Domain>,
    /// Domain ID of ROS 2 (`ROS_DOMAIN_ID`).
    pub domain_id: u32,
    /// ROS 2 release of the nodes that receive the topics.
    pub distro: Distro,
    /// Names of topics and frames.
    pub names: RosNames,
    /// Whether the ROS 2 node reports events of the hub. If false, the sender of datagrams reports them.
    pub reports_hub: bool,
}

/// Name of the node.
const NODE: &str = "scanhub";
/// Maximum wait for samples of the hub.
const MAX_WAIT: Duration = Duration::from_millis(50);

/// Publishes the hub's topics until `is_over` is set. Writes the statistics at the end, and whenever `report_requested`
/// is set.
///
/// # Errors
///
/// [`Kind::Usage`](scanhub_schema::Kind) if a topic does not exist, [`Kind::NoTopic`](scanhub_schema::Kind) if the
/// first hub has no such sensor.
pub(crate) fn run(
    options: &Ros2Options,
    json: bool,
    connection: &Arc<Connection>,
    report_requested: &AtomicBool,
    is_over: &AtomicBool,
) -> Result<(), ExitReason> {
    let (mut out, mut notes) = (stdout(), stderr());
    let (mut out, mut notes) = (Output::new(&mut out), Output::new(&mut notes));
    let all = ["*/*".to_owned()];
    let topics = if options.topics.is_empty() { &all[..] } else { &options.topics };
    let selection = Selection::parse(topics, false)?;
    let graph = Graph::new(options.names.clone(), selection.includes(Topic::Status));
    let mut filler = QueueFiller::new(selection, &options.locations, graph);
    options.names.sensors_with_frame().for_each(|sensor| filler.require(sensor));
    let queue = filler.queue().clone();
    // Set at the end of this function, even after an error, so that the sending thread stops waiting for a router.
    let is_done = Arc::new(AtomicBool::new(false));
    let work = {
        let (queue, connection, is_done) = (queue.clone(), connection.clone(), is_done.clone());
        let options = options.clone();
        move || queue::send(&queue, &connection, &is_done, |session| RosSender::open(session, &options))
    };
    let sending = thread::Builder::new().name("ros2 sending".into()).spawn(work);
    let sending = sending.map_err(|error| crate::no_thread(&error))?;
    let mut follow = || {
        while !is_over.load(Ordering::Relaxed) && !sending.is_finished() {
            let more = filler.forward(&mut |notice| match options.reports_hub {
                true => report_notice(notice, json, &mut out, &mut notes),
                false => Ok(()),
            })?;
            if report_requested.swap(false, Ordering::Relaxed) {
                write_counters(&queue.lock(), json, &mut out)?;
            }
            if !more {
                filler.wait(MAX_WAIT)?;
            }
        }
        Ok::<_, ExitReason>(())
    };
    let end = follow();
    is_done.store(true, Ordering::Relaxed);
    queue.ring();
    let sent = queue::join(sending, &queue);
    write_counters(&queue.lock(), json, &mut out)?;
    end.and(Ok(sent?))
}

impl Queue for Graph {
    fn is_waiting(&self) -> bool {
        Graph::is_waiting(self)
    }

    fn set_hub_available(&mut self, hub_is_available: bool, now: WallTimestamp) {
        Graph::report_silence(self, hub_is_available, now);
    }

    fn settle(&mut self, is_sent: bool) {
        Graph::settle(self, is_sent);
    }
}

impl SampleSink for Graph {
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize {
        Graph::follow(self, name, every)
    }

    fn needs(&self, sensor: usize, topic: Topic) -> bool {
        Graph::needs(self, sensor, topic)
    }

    fn sample(&mut self, sensor: usize, sample: &Sample<'_>) {
        Graph::sample(self, sensor, sample, now());
    }
}

/// Sender of a graph's messages as a ROS 2 node.
struct RosSender<'a> {
    session: &'a ZenohSession,
    node: Node,
    /// Publishers in the order of [`Graph::topics`].
    publishers: Vec<RosPublisher>,
    _token: DeclaredToken,
}

/// Payload and attachment of the last message of a latched topic, kept for late joiners.
type LastMessage = Arc<Mutex<Option<(Vec<u8>, Vec<u8>)>>>;

/// A publisher of the node. When it is dropped, its tokens and the queryable of a latched topic are withdrawn.
struct RosPublisher {
    publisher: Publisher,
    gid: [u8; 16],
    sequence: i64,
    /// Last message; `None` if the topic is not latched.
    last: Option<LastMessage>,
    _history: Option<Queryable>,
    _tokens: Vec<DeclaredToken>,
}

impl<'a> RosSender<'a> {
    fn open(session: &'a ZenohSession, options: &Ros2Options) -> Result<RosSender<'a>, Failure> {
        let node = Node {
            domain: options.domain_id,
            session: session.id(),
            namespace: options.names.namespace().to_owned(),
            name: NODE.to_owned(),
            distro: options.distro,
        };
        let _token = session.token(&node.token())?;
        Ok(RosSender { session, node, publishers: Vec::new(), _token })
    }
}

impl Sender for RosSender<'_> {
    type Queue = Graph;

    fn declare(&mut self, queue: &SharedQueue<Graph>) -> Result<(), Failure> {
        loop {
            let index = self.publishers.len();
            let graph = queue.lock();
            let Some(&PublishedTopic { ref name, of, qos, .. }) = graph.topics().get(index) else {
                return Ok(());
            };
            let name = name.clone();
            drop(graph);
            let publisher =
                rmw_zenoh::Publisher { number: index as u32 + 1, topic: &name, message_type: &of, qos };
            self.publishers.push(RosPublisher::open(self.session, &self.node, &publisher)?);
        }
    }

    fn take(&mut self, graph: &mut Graph, now: WallTimestamp, message: &mut Vec<u8>) -> Option<usize> {
        // A new topic has no publisher until the next call of `declare`.
        if graph.topics().len() > self.publishers.len() {
            return None;
        }
        let queued = graph.take_next(now)?;
        message.clear();
        message.extend_from_slice(queued.message);
        Some(queued.topic)
    }

    fn send(&mut self, topic: usize, message: &[u8]) -> Result<bool, Failure> {
        Ok(self.publishers[topic].send(self.session, message))
    }

    fn finish(&mut self, _: &mut Graph) -> bool {
        false
    }
}

impl RosPublisher {
    fn open(
        session: &ZenohSession,
        node: &Node,
        of: &rmw_zenoh::Publisher<'_>,
    ) -> Result<RosPublisher, Failure> {
        let key = node.key(of);
        let publisher = session.publisher(&key)?;
        let mut tokens = vec![session.token(&node.publisher_token(of))?];
        let (mut last, mut history) = (None, None);
        if of.qos == Qos::Latched {
            let kept = LastMessage::default();
            let history_key = node.history_key(of);
            let answers = kept.clone();
            // Subscribers query the history key, and expect a reply under the topic's own key.
            history = Some(session.answer(&history_key, move |_| {
                let kept = answers.lock().unwrap_or_else(PoisonError::into_inner).clone();
                let reply =
                    |(payload, attachment)| Reply { key: key.clone(), payload, attachment: Some(attachment) };
                kept.map(reply).into_iter().collect()
            })?);
            tokens.push(session.token(&history_key)?);
            last = Some(kept);
        }
        let (_history, _tokens) = (history, tokens);
        Ok(RosPublisher { publisher, gid: node.gid(of), sequence: 0, last, _history, _tokens })
    }

    /// Sends `message`. Returns whether the links had room for the message.
    fn send(&mut self, session: &ZenohSession, message: &[u8]) -> bool {
        self.sequence += 1;
        let attachment = rmw_zenoh::attachment(self.sequence, now().wall_ns as i64, self.gid);
        if let Some(last) = &self.last {
            let kept = Some((message.to_vec(), attachment.to_vec()));
            *last.lock().unwrap_or_else(PoisonError::into_inner) = kept;
        }
        session.put(&self.publisher, message, Some(&attachment))
    }
}

/// Writes the statistics of each topic to `out`.
fn write_counters(graph: &Graph, json: bool, out: &mut Output<'_>) -> Result<(), ExitReason> {
    for &PublishedTopic { ref name, of, sent, replaced, failed, .. } in graph.topics() {
        if json {
            let line = Ros2Json {
                class: "bridge_ros2",
                topic: name,
                of: of.name,
                sent,
                replaced,
                send_failed: failed,
            };
            out.json(&line)?;
        } else {
            out.line(|line| write!(line, "{name}: {sent} sent, {replaced} replaced, {failed} failed"))?;
        }
    }
    Ok(())
}

/// JSON line of class `bridge_ros2`.
#[derive(Serialize)]
struct Ros2Json<'a> {
    class: &'static str,
    topic: &'a str,
    #[serde(rename = "type")]
    of: &'a str,
    sent: u64,
    replaced: u64,
    send_failed: u64,
}
