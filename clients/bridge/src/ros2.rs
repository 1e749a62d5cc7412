//! A hub in a graph of ROS 2: a node whose topics are the hub's, on the wire of `rmw_zenoh`. One thread follows the hub and
//! makes messages, another hands them to the engine, so that a slow network delays nobody. Refuses to know how messages and
//! tokens look.

mod graph;

use std::io::{Write, stderr, stdout};
use std::num::NonZeroU64;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use lan::outgoing::Sample;
use ros::Names;
use ros::zenoh_wire::{self, Distro, Node, Qos};
use schema::{Domain, Failure, Topic};
use serde::Serialize;
use verbs::network::{Carrier, End, Forwarder, Output, Selection, now, tell};

use crate::engine::{Answers, Connection, Engine, Publisher, Token};
use graph::{Graph, Published};

/// What goes into a graph of ROS 2.
#[derive(Clone, Debug)]
pub struct Ros2Options {
    /// `SENSOR/TOPIC`, `*/TOPIC` or `SENSOR/*`, with `:every=N` if it is to be thinned; none: all that ROS has messages for.
    pub topics: Vec<String>,
    /// Where the domain of the hub may be.
    pub places: Vec<Domain>,
    /// `ROS_DOMAIN_ID`.
    pub domain_id: u32,
    /// Whose nodes hear it.
    pub distro: Distro,
    /// How topics and frames are called.
    pub names: Names,
    /// News of the hub are told here; else somebody else tells them.
    pub tells_of_hub: bool,
}

/// The node's name.
const NODE: &str = "scanhub";
/// So long it sleeps at most where nothing wakes it.
const NAP: Duration = Duration::from_millis(50);
/// Between two looks at the link where there is none.
const LINK_EVERY: Duration = Duration::from_millis(5);

/// The graph, between the thread that writes it and the one that empties it.
#[derive(Clone)]
struct Waiting(Arc<Shared>);

struct Shared {
    graph: Mutex<Graph>,
    /// Something waits.
    bell: Condvar,
}

/// Carries the hub's topics until it `is_over`; the account is told then and whenever `tell_account` is set.
///
/// # Errors
///
/// [`Kind::Usage`](schema::Kind) if there is no such topic, [`Kind::NoTopic`](schema::Kind) if the first hub has no such sensor.
pub(crate) fn run(
    options: &Ros2Options,
    json: bool,
    connection: &Connection,
    tell_account: &AtomicBool,
    is_over: &AtomicBool,
) -> Result<(), End> {
    let (mut out, mut notes) = (stdout(), stderr());
    let (mut out, mut notes) = (Output::new(&mut out), Output::new(&mut notes));
    let all = ["*/*".to_owned()];
    let topics = if options.topics.is_empty() { &all[..] } else { &options.topics };
    let selection = Selection::parse(topics, false)?;
    let graph = Graph::new(options.names.clone(), selection.names(Topic::Status));
    let mut waiting = Waiting(Arc::new(Shared { graph: Mutex::new(graph), bell: Condvar::new() }));
    let mut forwarder = Forwarder::new(selection, &options.places, &mut waiting);
    options.names.framed().for_each(|sensor| forwarder.demand(sensor));
    let is_done = AtomicBool::new(false);
    thread::scope(|scope| {
        let handing = Handing { waiting: waiting.clone(), outlets: Vec::new() };
        let work = || handing.run(options, connection, is_over, &is_done);
        let handing = thread::Builder::new().name("ros2 handing".into()).spawn_scoped(scope, work);
        let handing = handing.map_err(|error| crate::no_thread(&error))?;
        let mut follow = || {
            while !is_over.load(Ordering::Relaxed) && !handing.is_finished() {
                let more = forwarder.forward(&mut waiting)?;
                waiting.graph().look(forwarder.is_there(), now());
                waiting.ring();
                forwarder.look(Instant::now(), &mut waiting, &mut |notice| match options.tells_of_hub {
                    true => tell(notice, json, &mut out, &mut notes),
                    false => Ok(()),
                })?;
                if tell_account.swap(false, Ordering::Relaxed) {
                    account(&waiting.graph(), json, &mut out)?;
                }
                if !more {
                    forwarder.wait(NAP)?;
                }
            }
            Ok::<_, End>(())
        };
        let end = follow();
        is_done.store(true, Ordering::Relaxed);
        waiting.ring();
        let handed = handing.join().unwrap_or_else(|_| Err(crate::died()));
        account(&waiting.graph(), json, &mut out)?;
        end.and(Ok(handed?))
    })
}

impl Waiting {
    fn graph(&self) -> MutexGuard<'_, Graph> {
        // Nobody panics while he has it; if one did, the messages are none the worse for it.
        self.0.graph.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn ring(&self) {
        self.0.bell.notify_one();
    }
}

impl Carrier for Waiting {
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize {
        self.graph().follow(name, every)
    }

    fn wants(&self, sensor: usize, topic: Topic) -> bool {
        self.graph().wants(sensor, topic)
    }

    fn sample(&mut self, sensor: usize, sample: &Sample<'_>) {
        self.graph().sample(sensor, sample, now());
    }
}

/// What hands over to the engine.
struct Handing {
    waiting: Waiting,
    /// By the position of their topics.
    outlets: Vec<Outlet>,
}

/// Payload and attachment.
type Kept = (Vec<u8>, Vec<u8>);

/// A publisher, and what it needs as long as it is there.
struct Outlet {
    publisher: Publisher,
    gid: [u8; 16],
    number: i64,
    /// The last message, for who comes late.
    last: Option<Arc<Mutex<Option<Kept>>>>,
    _history: Option<Answers>,
    _tokens: Vec<Token>,
}

impl Handing {
    /// Hands over until it `is_done`.
    fn run(
        mut self,
        options: &Ros2Options,
        connection: &Connection,
        is_over: &AtomicBool,
        is_done: &AtomicBool,
    ) -> Result<(), Failure> {
        let Some(engine) = connection.engine(is_over) else { return Ok(()) };
        let node = Node {
            domain: options.domain_id,
            session: engine.identity(),
            namespace: options.names.namespace().to_owned(),
            name: NODE.to_owned(),
            distro: options.distro,
        };
        let _token = engine.token(&node.token())?;
        let mut message = Vec::new();
        while !is_done.load(Ordering::Relaxed) {
            self.declare(engine, &node)?;
            // Without a link messages wait: who is connected again gets the newest.
            if !engine.is_linked() {
                thread::sleep(LINK_EVERY);
                continue;
            }
            let Some(topic) = self.next(&mut message) else { continue };
            if self.outlets.get_mut(topic).is_some_and(|outlet| !outlet.send(&message)) {
                self.waiting.graph().not_taken(topic);
            }
        }
        Ok(())
    }

    /// Takes the message that has waited for longest, and says of which topic it is; waits for one if there is none.
    fn next(&self, message: &mut Vec<u8>) -> Option<usize> {
        let mut graph = self.waiting.graph();
        if !graph.is_waiting() {
            let woken = self.waiting.0.bell.wait_timeout(graph, NAP).unwrap_or_else(PoisonError::into_inner);
            graph = woken.0;
        }
        // A topic that came just now has no publisher yet.
        if graph.topics().len() > self.outlets.len() {
            return None;
        }
        let handed = graph.hand(now())?;
        message.clear();
        message.extend_from_slice(handed.message);
        Some(handed.topic)
    }

    /// Makes publishers of the topics that came.
    fn declare(&mut self, engine: &Engine, node: &Node) -> Result<(), Failure> {
        loop {
            let number = self.outlets.len();
            let graph = self.waiting.graph();
            let Some(&Published { ref name, of, qos, .. }) = graph.topics().get(number) else {
                return Ok(());
            };
            let name = name.clone();
            drop(graph);
            let publisher = zenoh_wire::Publisher { number: number as u32 + 1, topic: &name, of: &of, qos };
            self.outlets.push(Outlet::open(engine, node, &publisher)?);
        }
    }
}

impl Outlet {
    fn open(engine: &Engine, node: &Node, of: &zenoh_wire::Publisher<'_>) -> Result<Outlet, Failure> {
        let key = node.key(of);
        let publisher = engine.publisher(&key)?;
        let mut tokens = vec![engine.token(&node.publisher_token(of))?];
        let (mut last, mut history) = (None, None);
        if of.qos == Qos::Latched {
            let kept = Arc::<Mutex<Option<_>>>::default();
            let told = kept.clone();
            let key_of_history = node.history_key(of);
            history = Some(engine.answer_as(&key_of_history, key, move || {
                told.lock().unwrap_or_else(PoisonError::into_inner).clone()
            })?);
            tokens.push(engine.token(&key_of_history)?);
            last = Some(kept);
        }
        Ok(Outlet { publisher, gid: node.gid(of), number: 0, last, _history: history, _tokens: tokens })
    }

    /// Sends `message`; whether the engine took it.
    fn send(&mut self, message: &[u8]) -> bool {
        self.number += 1;
        let attachment = zenoh_wire::attachment(self.number, now().wall_ns as i64, self.gid);
        if let Some(last) = &self.last {
            let kept = Some((message.to_vec(), attachment.to_vec()));
            *last.lock().unwrap_or_else(PoisonError::into_inner) = kept;
        }
        self.publisher.put_with(message, &attachment)
    }
}

/// Tells what became of the messages of each topic.
fn account(graph: &Graph, json: bool, out: &mut Output<'_>) -> Result<(), End> {
    for &Published { ref name, of, sent, replaced, failed, .. } in graph.topics() {
        if json {
            let line =
                Line { class: "bridge_ros2", topic: name, of: of.name, sent, replaced, send_failed: failed };
            out.json(&line)?;
        } else {
            out.line(|line| write!(line, "{name}: {sent} sent, {replaced} replaced, {failed} failed"))?;
        }
    }
    Ok(())
}

/// Class `bridge_ros2`.
#[derive(Serialize)]
struct Line<'a> {
    class: &'static str,
    topic: &'a str,
    #[serde(rename = "type")]
    of: &'a str,
    sent: u64,
    replaced: u64,
    send_failed: u64,
}
