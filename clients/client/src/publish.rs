//! Topics that a program publishes itself, such as what it makes of others. They are as a hub's own: consumers follow them
//! by name, in every language, see what they missed, and are woken. One process of a domain publishes beside its hub; its
//! lock says that it lives. Refuses to know what is published.

use std::cell::{Cell, RefCell};
use std::hash::{BuildHasher, RandomState};
use std::rc::{Rc, Weak};

use schema::ipc::{self, DueRings, Node, Payload, TopicPublisher, Waker};
use schema::limits::TopicLimits;
use schema::shortage::{allocate, check_descriptors, check_memory, longest_segment, sensor_bytes};
use schema::{
    DEFAULT_DOMAIN, Domain, Environment, Failure, Header, Kind, ListenLock, Maker, Ring, Topic, Wake,
    check_followed, check_sensor, is_remote, publisher,
};

use crate::clock;
use crate::subscribe::places;

/// Publishes the topic of `name` that carries `P`, in the domain that SCANHUB_DOMAIN names: consumers follow it by
/// [`subscribe::<P>(name)`](crate::subscribe). There need not be a hub. A name is `OWNER.NAME`, as `tracker.near`: those
/// without a dot are the hub's.
///
/// A process that publishes more than one topic, or for more than 32 consumers, opens one [`PublishSession`] for all of them.
///
/// # Errors
///
/// Those of [`PublishSession::open`], [`PublishSession::sensor`] and [`SensorPublisher::topic`].
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::{Failure, Marks, publish, subscribe};
///
/// fn main() -> Result<(), Failure> {
///     let mut near = publish::<Marks>("tracker.near")?;
///     let mut marks = subscribe::<Marks>("front")?;
///     while let Some(seen) = marks.next()? {
///         near.send(|sample| *sample = *seen)?;
///     }
///     Ok(())
/// }
/// ```
pub fn publish<P: Payload + ?Sized>(name: &str) -> Result<Publication<P>, Failure> {
    PublishSession::open(&own_domain()?, &[P::TOPIC], TopicLimits::default())?.sensor(name)?.topic()
}

/// Returns the first live place of the domain that SCANHUB_DOMAIN names, or that which a hub would take.
fn own_domain() -> Result<Domain, Failure> {
    let lives = |domain: &Domain| matches!(publisher(domain.root()), Ok(Some(_)));
    if let Some(live) = places(None)?.into_iter().find(lives) {
        return Ok(live);
    }
    let name = std::env::var("SCANHUB_DOMAIN");
    let name = name.as_deref().unwrap_or(DEFAULT_DOMAIN);
    Domain::of_hub(name, None, &Environment::of_process())
}

/// A process's stay in a domain as one that publishes. It ends when the session and all that was made of it are dropped.
pub struct PublishSession(Rc<Membership>);

struct Membership {
    domain: Domain,
    limits: TopicLimits,
    boot: u64,
    /// A second waker of the same name would take the first one's consumers along at its end.
    sensors: RefCell<Vec<Weak<Awakener>>>,
    node: Node,
    // Behind the node, for whoever takes it next finds no other one.
    lock: Option<ListenLock>,
}

/// Whether there is memory for `topics` of one sensor.
fn check_topics(topics: &[Topic], limits: &TopicLimits) -> Result<(), Failure> {
    check_memory(sensor_bytes(topics, limits), longest_segment(topics, limits))
}

/// Descriptors of a service, and of its first consumer.
const SERVICE_DESCRIPTORS: u64 = 8;

impl PublishSession {
    /// Takes the domain's one place for a process that publishes beside its hub, and cleans up what dead ones left. There
    /// has to be memory for one sensor with `topics`. All topics of the session will be made as `limits` say; one that
    /// consumers kept alive has the places that it was made with.
    ///
    /// # Errors
    ///
    /// [`Kind::DomainHeld`](schema::Kind) if another process (or another session of this one) has it: the message has its
    /// number; [`Kind::Configuration`](schema::Kind) if the limits are none of those that can be;
    /// [`Kind::Short`](schema::Kind) if memory or descriptors are short; [`Kind::Failed`](schema::Kind) if the directory is
    /// another user's.
    pub fn open(domain: &Domain, topics: &[Topic], limits: TopicLimits) -> Result<PublishSession, Failure> {
        limits.check()?;
        let lock = ListenLock::acquire(domain.root())?;
        check_topics(topics, &limits)?;
        Ok(PublishSession::with(domain, limits, ipc::hub_node(domain)?, Some(lock)))
    }

    /// Publishes beside a hub or a listener that is there, of which it takes no place: for what is made of the topics of a
    /// domain, such as tracks of people. Its names have no dot, and are none of a hub's sensors. Else as [`open`](Self::open).
    ///
    /// # Errors
    ///
    /// [`Kind::NoHub`](schema::Kind) if nobody is there; else as [`open`](Self::open), but for
    /// [`Kind::DomainHeld`](schema::Kind).
    pub fn beside(domain: &Domain, topics: &[Topic], limits: TopicLimits) -> Result<PublishSession, Failure> {
        limits.check()?;
        check_topics(topics, &limits)?;
        Ok(PublishSession::with(domain, limits, ipc::client_node(domain)?, None))
    }

    fn with(domain: &Domain, limits: TopicLimits, node: Node, lock: Option<ListenLock>) -> PublishSession {
        node.try_cleanup_dead_nodes();
        let boot = RandomState::new().hash_one(std::process::id());
        let (domain, sensors) = (domain.clone(), RefCell::default());
        PublishSession(Rc::new(Membership { domain, limits, boot, sensors, node, lock }))
    }

    /// Checks that there is memory for `topics` of one sensor, and descriptors for their first consumers.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](schema::Kind) with what is free and what is needed.
    pub fn check_room(&self, topics: &[Topic]) -> Result<(), Failure> {
        check_topics(topics, &self.0.limits)?;
        check_descriptors((topics.len() as u64 + 1) * SERVICE_DESCRIPTORS)
    }

    /// Makes what wakes the consumers of the topics of `name`, which is `OWNER.NAME`: a hub's sensors have no dot, so that
    /// nobody publishes in the place of another. Who publishes [`beside`](Self::beside) a hub has a name like its sensors, which
    /// none of them has. A name that is there already is the same one.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`](schema::Kind) if the name is not possible; [`Kind::Short`](schema::Kind) if memory or
    /// descriptors are short; [`Kind::Failed`](schema::Kind) if the place is taken by another user.
    pub fn sensor(&self, name: &str) -> Result<SensorPublisher, Failure> {
        check_followed(name)?;
        if self.0.lock.is_none() {
            self.check_beside(name)?;
        } else if !is_remote(name) {
            let what = format!("{name:?} is no name to publish under: it may be a sensor of the hub");
            return Err(Failure::new(Kind::Configuration, what, "OWNER.NAME, for example tracker.near"));
        }
        let mut sensors = self.0.sensors.borrow_mut();
        sensors.retain(|sensor| sensor.strong_count() > 0);
        if let Some(known) = sensors.iter().filter_map(Weak::upgrade).find(|known| known.name == name) {
            return Ok(SensorPublisher(known));
        }
        self.check_room(&[])?;
        let waker = Waker::new(&self.0.node, name)?;
        let (name, due) = (name.to_owned(), Cell::default());
        let sensor = Rc::new(Awakener { name, waker, due, membership: self.0.clone() });
        sensors.push(Rc::downgrade(&sensor));
        Ok(SensorPublisher(sensor))
    }

    fn check_beside(&self, name: &str) -> Result<(), Failure> {
        check_sensor(name)?;
        let is_link = |(sensor, topic): &(String, Topic)| sensor == name && topic.maker() == Maker::Link;
        if ipc::published(&self.0.domain)?.iter().any(is_link) {
            let what = format!("{name:?} is no name to publish under: it is a sensor of the hub");
            return Err(Failure::new(Kind::Configuration, what, "any other name, for example house"));
        }
        Ok(())
    }

    /// Removes what consumers that were killed left in the domain. Call it every few seconds.
    pub fn clean_up(&self) {
        self.0.node.try_cleanup_dead_nodes();
    }
}

/// The topics of one name, and what wakes their consumers.
pub struct SensorPublisher(Rc<Awakener>);

struct Awakener {
    name: String,
    waker: Waker,
    /// What was sent and not rung for.
    due: Cell<DueRings>,
    membership: Rc<Membership>,
}

impl SensorPublisher {
    /// Makes the topic that carries `P`, with all memory that it may need.
    ///
    /// # Errors
    ///
    /// [`Kind::DomainHeld`](schema::Kind) if this process publishes it already; [`Kind::Short`](schema::Kind) if memory or
    /// descriptors are short; [`Kind::Failed`](schema::Kind) if the topic is there with another layout.
    pub fn topic<P: Payload + ?Sized>(&self) -> Result<Publication<P>, Failure> {
        self.topic_for(self.limits())
    }

    /// Makes the topic as [`topic`](Self::topic), for samples as long as `limits` say.
    ///
    /// # Errors
    ///
    /// As [`topic`](Self::topic).
    pub fn topic_for<P: Payload + ?Sized>(&self, limits: &TopicLimits) -> Result<Publication<P>, Failure> {
        let Membership { domain, node, .. } = &*self.0.membership;
        check_topics(&[P::TOPIC], limits)?;
        check_descriptors(SERVICE_DESCRIPTORS)?;
        let topic = TopicPublisher::new(node, &self.0.name, limits)?;
        // To write into what has no memory behind it would end the process.
        allocate(domain)?;
        Ok(Publication { topic, sensor: SensorPublisher(self.0.clone()) })
    }

    /// Returns what the topics of the session are made for.
    pub fn limits(&self) -> &TopicLimits {
        &self.0.membership.limits
    }

    /// Wakes the consumers that got samples of any topic of this name since the last call, for `why`. Once is enough for
    /// samples that are sent together.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`](schema::Kind) if some were not woken; these look by themselves ten times a second.
    pub fn wake(&self, why: Wake) -> Result<(), Failure> {
        let mut due = self.0.due.take();
        Ring::ALL.into_iter().filter(|&ring| due.take(ring)).for_each(|ring| self.0.waker.ring(ring));
        self.0.waker.tell(why)
    }

    /// `reached` consumers got a sample of `topic`.
    fn note(&self, topic: Topic, reached: usize) {
        let mut due = self.0.due.get();
        due.note(topic, reached);
        self.0.due.set(due);
    }
}

/// A topic that is being published.
pub struct Publication<P: Payload + ?Sized> {
    // Before what wakes its consumers, and before the session.
    topic: TopicPublisher<P>,
    sensor: SensorPublisher,
}

impl<P: Payload + ?Sized> Publication<P> {
    /// Returns the header of a sample that is made now: both stamps are this moment, on CLOCK_MONOTONIC, and its number is
    /// the next one.
    pub fn header(&self) -> Header {
        let now_ns = clock::now_ns();
        let number = self.topic.next_number();
        Header {
            seq: number,
            topic_seq: number,
            stamp_first_ns: now_ns,
            stamp_last_ns: now_ns,
            wall_ns: clock::wall_ns(),
            boot: self.sensor.0.membership.boot,
            hub_pid: std::process::id(),
            ..Header::default()
        }
    }

    /// Uses up `count` numbers without a sample: consumers see `count` of them missing.
    pub fn skip(&mut self, count: u64) {
        self.topic.skip(count);
    }

    /// Returns the number that the next sample will have: from 0, as they are sent.
    pub fn next_number(&self) -> u64 {
        self.topic.next_number()
    }

    /// Returns the number of consumers that follow the topic.
    pub fn subscribers(&self) -> usize {
        self.topic.subscribers()
    }

    /// Connects consumers that came since the last sample, and hands them what the topic keeps for late joiners. Of a topic
    /// that is seldom sent, call it ten times a second.
    pub fn connect(&self) {
        // One that cannot be connected now is tried again with the next sample.
        let _ = self.topic.connect();
    }

    /// Returns the number of samples that were not sent for lack of memory.
    pub fn failed(&self) -> u64 {
        self.topic.failed()
    }
}

impl<P: Payload + ?Sized> Publication<P> {
    /// Sends a sample of `len` bytes that `fill` writes in place, beginning with all of them 0, and wakes the consumers: for
    /// payloads without a size of their own, such as a scan.
    ///
    /// # Errors
    ///
    /// As [`send`](Publication::send); also [`Kind::Short`](schema::Kind) if it is longer than the topic was made for.
    pub fn send_len(&mut self, len: usize, fill: impl FnOnce(&mut P)) -> Result<(), Failure> {
        let header = self.header();
        self.send_len_with(&header, len, fill)?;
        self.sensor.wake(Wake::Telegram)
    }

    /// Sends as [`send_len`](Self::send_len), with `header` but for the sample's number in the topic, and wakes nobody. Returns
    /// how many consumers got it.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](schema::Kind) if there is no memory for it, or it is longer than the topic was made for: its number is
    /// used up.
    pub fn send_len_with(
        &mut self,
        header: &Header,
        len: usize,
        fill: impl FnOnce(&mut P),
    ) -> Result<usize, Failure> {
        self.topic.send_len(header, len, fill).inspect(|&reached| self.sensor.note(P::TOPIC, reached))
    }
}

impl<P: Payload> Publication<P> {
    /// Sends a sample that `fill` writes in place, beginning with the payload's default, and wakes the consumers.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](schema::Kind) if there is no memory for it: its number is used up. Else as
    /// [`SensorPublisher::wake`].
    pub fn send(&mut self, fill: impl FnOnce(&mut P)) -> Result<(), Failure> {
        let header = self.header();
        self.send_with(&header, fill)?;
        self.sensor.wake(Wake::Telegram)
    }

    /// Sends as [`send`](Self::send), with `header` but for the sample's number in the topic, and wakes nobody: for samples
    /// of several topics that are sent together. Returns how many consumers got it.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](schema::Kind) if there is no memory for it: its number is used up.
    pub fn send_with(&mut self, header: &Header, fill: impl FnOnce(&mut P)) -> Result<usize, Failure> {
        self.topic.send(header, fill).inspect(|&reached| self.sensor.note(P::TOPIC, reached))
    }
}

impl Publication<[u8]> {
    /// Sends `bytes` as a sample and wakes the consumers.
    ///
    /// # Errors
    ///
    /// As [`send`](Publication::send); also [`Kind::Short`](schema::Kind) for more than
    /// [`Telegram::MAX`](schema::Telegram::MAX) bytes.
    pub fn send_bytes(&mut self, bytes: &[u8]) -> Result<(), Failure> {
        let header = self.header();
        self.send_bytes_with(&header, bytes)?;
        self.sensor.wake(Wake::Telegram)
    }

    /// Sends `bytes` with `header`, as [`send_with`](Publication::send_with).
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](schema::Kind) if there is no memory for it, or it is longer than
    /// [`Telegram::MAX`](schema::Telegram::MAX).
    pub fn send_bytes_with(&mut self, header: &Header, bytes: &[u8]) -> Result<usize, Failure> {
        self.topic.send_bytes(header, bytes).inspect(|&reached| self.sensor.note(Topic::Telegram, reached))
    }
}
