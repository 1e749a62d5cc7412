//! The way out: what the hub publishes waits, of each topic the newest, until the engine takes it. Two threads, so that a
//! slow network makes nobody wait but the one that hands over. Refuses to know what carries it.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::num::NonZeroU64;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use lan::address::{Address, LIVE, PREFIX};
use lan::outgoing::{Outgoing, Sample, Transmit};
use schema::{Domain, Failure, Topic};
use verbs::network::{Carrier, End, Forwarder, Life, Selection, begin_life, now};

use crate::SendOptions;
use crate::engine::{Connection, Engine, Publisher, Token};
use crate::report::Report;

/// The hub, and what waits of it.
pub(crate) struct Sending {
    pub(crate) life: Life,
    forwarder: Forwarder,
    waiting: Waiting,
}

/// What waits, and who is to hear of it.
#[derive(Clone)]
struct Waiting(Arc<Shared>);

struct Shared {
    hub: u64,
    outgoing: Mutex<Outgoing>,
    /// Something waits.
    bell: Condvar,
    /// The hub is there.
    hub_lives: AtomicBool,
}

/// In the place of an interface, in the name of the file that keeps a bridge's number.
const WAY: &str = "bridge";

impl Sending {
    /// Begins a life of the bridge of the domain.
    pub(crate) fn open(options: &SendOptions) -> Result<Sending, Failure> {
        let selection = Selection::parse(&options.topics, false)?;
        let domain = options.places.first().map(Domain::name).unwrap_or_default();
        let life = begin_life(domain, WAY)?;
        let mut waiting = Waiting(Arc::new(Shared {
            hub: life.hub,
            outgoing: Mutex::new(Outgoing::waiting(life.hub, life.epoch)),
            bell: Condvar::new(),
            hub_lives: AtomicBool::new(false),
        }));
        let forwarder = Forwarder::new(selection, &options.places, &mut waiting);
        Ok(Sending { life, forwarder, waiting })
    }

    /// Takes what the hub published, and looks after it; whether there may be more.
    pub(crate) fn forward(&mut self, report: &mut Report<'_>) -> Result<bool, End> {
        let Sending { forwarder, waiting, .. } = self;
        let more = forwarder.forward(waiting)?;
        waiting.ring();
        forwarder.look(Instant::now(), waiting, &mut |notice| report.hub(notice))?;
        waiting.0.hub_lives.store(forwarder.is_there(), Ordering::Relaxed);
        Ok(more)
    }

    /// Waits for the hub, and no longer than `at_most`.
    pub(crate) fn wait(&mut self, at_most: Duration) -> Result<(), Failure> {
        self.forwarder.wait(at_most)
    }

    /// Announces all sensors.
    pub(crate) fn announce(&mut self) {
        self.waiting.outgoing().announce(now(), &mut Nowhere);
        self.waiting.ring();
    }

    /// What waits, as it stands.
    pub(crate) fn outgoing(&self) -> MutexGuard<'_, Outgoing> {
        self.waiting.outgoing()
    }

    /// The other end, for a thread of its own.
    pub(crate) fn handing(&self) -> Handing {
        Handing { waiting: self.waiting.clone(), publishers: HashMap::new(), tokens: HashMap::new() }
    }
}

impl Waiting {
    fn outgoing(&self) -> MutexGuard<'_, Outgoing> {
        // Nobody panics while he has it; if one did, the samples are none the worse for it.
        self.0.outgoing.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn ring(&self) {
        self.0.bell.notify_one();
    }
}

impl Carrier for Waiting {
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize {
        self.outgoing().follow(name, every)
    }

    fn wants(&self, sensor: usize, topic: Topic) -> bool {
        self.outgoing().wants(sensor, topic)
    }

    fn sample(&mut self, sensor: usize, sample: &Sample<'_>) {
        self.outgoing().sample(sensor, sample, now(), &mut Nowhere);
    }
}

/// Where samples wait, none is transmitted.
struct Nowhere;

impl Transmit for Nowhere {
    fn transmit(&mut self, _: &[u8], _: u8, _: u8) -> bool {
        false
    }
}

/// What hands over to the engine.
pub(crate) struct Handing {
    waiting: Waiting,
    /// By sensor and topic.
    publishers: HashMap<(u8, Option<Topic>), (String, Publisher)>,
    /// What says that the hub and its sensors are there, by its name.
    tokens: HashMap<String, Token>,
}

/// Between two looks at the link and at the hub where nothing waits.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// The same while there is no link.
const LINK_EVERY: Duration = Duration::from_millis(5);
/// So long it goes on at the end for what still waits.
const LAST: Duration = Duration::from_secs(1);

impl Handing {
    /// Hands over until it `is_over`, and then what still waits.
    pub(crate) fn run(mut self, connection: &Connection, is_over: &AtomicBool) -> Result<(), Failure> {
        let Some(engine) = connection.engine(is_over) else { return Ok(()) };
        let shared = self.waiting.clone();
        let _answers = engine.answer(&format!("{PREFIX}/{:016x}/*/*", shared.0.hub), move |key| {
            let address = Address::parse(key).filter(|address| address.hub == shared.0.hub)?;
            shared.outgoing().again(address.sensor, address.topic, now()).map(<[u8]>::to_vec)
        })?;
        let mut bytes = Vec::new();
        let (mut end_at, mut is_announced) = (None, false);
        loop {
            if is_over.load(Ordering::Relaxed) {
                let end_at = *end_at.get_or_insert_with(|| Instant::now() + LAST);
                let is_done = !self.waiting.outgoing().is_waiting();
                if is_done && is_announced || Instant::now() >= end_at {
                    return Ok(());
                }
                // How many were sent is the last word, behind all that was.
                if is_done {
                    self.waiting.outgoing().announce(now(), &mut Nowhere);
                    is_announced = true;
                }
            }
            self.look(engine)?;
            if !engine.is_linked() {
                thread::sleep(LINK_EVERY);
                continue;
            }
            self.hand(engine, &mut bytes)?;
        }
    }

    /// Hands over the sample that has waited for longest; waits for one if there is none.
    fn hand(&mut self, engine: &Engine, bytes: &mut Vec<u8>) -> Result<(), Failure> {
        let Shared { hub, bell, .. } = &*self.waiting.0;
        let mut outgoing = self.waiting.outgoing();
        if !outgoing.is_waiting() {
            let woken = bell.wait_timeout(outgoing, LOOK_EVERY).unwrap_or_else(PoisonError::into_inner);
            outgoing = woken.0;
        }
        let Some(handed) = outgoing.hand(now()) else { return Ok(()) };
        let (number, topic) = (handed.sensor.0, handed.topic);
        bytes.clear();
        bytes.extend_from_slice(handed.datagram);
        let known = self.publishers.get(&(number, topic)).is_some_and(|(name, _)| name == handed.sensor.1);
        if !known {
            let sensor = handed.sensor.1.to_owned();
            drop(outgoing);
            let address = Address { hub: *hub, sensor: &sensor, topic }.to_string();
            let publisher = engine.publisher(&address)?;
            let live = format!("{PREFIX}/{hub:016x}/{sensor}/{LIVE}");
            if let Entry::Vacant(place) = self.tokens.entry(live) {
                let token = engine.token(place.key())?;
                place.insert(token);
            }
            self.publishers.insert((number, topic), (sensor, publisher));
        } else {
            drop(outgoing);
        }
        let is_taken = self.publishers.get(&(number, topic)).is_some_and(|(_, to)| to.put(bytes));
        if !is_taken {
            self.waiting.outgoing().not_taken(number, topic, bytes.len());
        }
        Ok(())
    }

    /// Says that the hub is there, or that it and its sensors are not.
    fn look(&mut self, engine: &Engine) -> Result<(), Failure> {
        let is_there = self.waiting.0.hub_lives.load(Ordering::Relaxed);
        if is_there != self.tokens.is_empty() {
            return Ok(());
        }
        if !is_there {
            self.tokens.clear();
            self.publishers.clear();
            return Ok(());
        }
        let live = format!("{PREFIX}/{:016x}/{LIVE}", self.waiting.0.hub);
        let token = engine.token(&live)?;
        self.tokens.insert(live, token);
        Ok(())
    }
}
