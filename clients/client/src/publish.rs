//! Topics that a program publishes, such as results that it computes from other topics. Programs subscribe to them like
//! to topics of a hub: by name, in every language, with a count of missed samples, and without polling. A name has one
//! publisher, which holds a lock while it runs.

use std::hash::{BuildHasher, RandomState};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{
    DoorbellWord, Header, Kind, PublisherKind, Topic, WakeEvent, check_any_sensor, check_sensor, is_remote,
};
use scanhub_shm::resource_limits::{check_descriptors, check_memory, longest_segment, sensor_bytes};
use scanhub_shm::{
    Domain, Environment, ListenLock, NameLock, Payload, PendingWakeups, Role, SharedMemory,
    ThreadSafeService, TopicPublisher, hub_pid, name_taken, publisher_domain,
};

use crate::builder::domain_of_process;
use crate::clock;
use crate::error::Error;

type Node = scanhub_shm::Node<ThreadSafeService>;
type Waker = scanhub_shm::WakeSender<ThreadSafeService>;

/// Publishes the topic of `name` that carries `P`, in the domain that SCANHUB_DOMAIN names. Programs subscribe to it
/// with [`subscribe::<P>(name)`](crate::subscribe) while a hub or a listener runs. Publishing needs neither.
///
/// The form of the name depends on the topic. A topic that no hub publishes, such as people or the angles of a mount,
/// has a name without a dot, such as `mount`. Any number of programs can publish such topics, each under another name.
/// A topic that hubs publish has a name of the form `OWNER.NAME`, such as `tracker.near`. Only one process of a domain
/// can publish such topics.
///
/// A process that publishes more than one topic, or for more than 32 subscribers, opens a [`PublishSession`].
///
/// # Errors
///
/// Returns the errors of [`PublishSession::open_named`] or [`PublishSession::open`], of [`PublishSession::sensor`] and
/// [`SensorPublisher::topic`].
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::{Error, Marks, publish, subscribe};
///
/// fn main() -> Result<(), Error> {
///     let mut near = publish::<Marks>("tracker.near")?;
///     let mut marks = subscribe::<Marks>("front")?;
///     while let Some(seen) = marks.next()? {
///         near.send(|sample| *sample = *seen)?;
///     }
///     Ok(())
/// }
/// ```
pub fn publish<P: Payload + ?Sized>(name: &str) -> Result<Publication<P>, Error> {
    Publication::in_domain(&publish_domain(None)?, name)
}

/// Returns the location at which a program publishes in `domain`, or in the domain that SCANHUB_DOMAIN names if
/// `domain` is `None`: the first location at which a hub runs, otherwise the location that a hub would choose.
///
/// # Errors
///
/// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the name is invalid.
pub fn publish_domain(domain: Option<&str>) -> Result<Domain, Error> {
    let name = domain.map_or_else(domain_of_process, str::to_owned);
    Ok(publisher_domain(&name, None, &Environment::of_process())?)
}

/// Membership of a publishing process in a domain. It ends when the session and every publisher created from it are
/// dropped.
pub struct PublishSession(Arc<Membership>);

struct Membership {
    domain: Domain,
    limits: TopicLimits,
    boot: u64,
    /// Wakers by name. A second waker of the same name would disconnect the subscribers of the first one when it ends.
    sensors: Mutex<Vec<Weak<NameWaker>>>,
    node: Node,
    // This field is after the node, so that it is dropped later. The next holder of the lock then finds no node of this
    // process.
    lock: DomainLock,
}

/// Lock of the publishing process.
enum DomainLock {
    /// Lock for publishing under names with a dot, as for sensors of other machines.
    RemoteSensors { _lock: ListenLock },
    /// Lock for publishing under one name.
    OwnName { name: String, _lock: NameLock },
}

/// Checks that there is memory for `topics` of one sensor.
fn check_topics(topics: &[Topic], limits: &TopicLimits) -> Result<(), Error> {
    Ok(check_memory(sensor_bytes(topics, limits), longest_segment(topics, limits))?)
}

/// Number of descriptors that a service and its first subscriber need.
const SERVICE_DESCRIPTORS: u64 = 8;

impl PublishSession {
    /// Takes the domain's only lock for a process that publishes in addition to the hub, and removes the shared memory
    /// of killed processes. There must be memory for one sensor with `topics`. `limits` apply to all topics of the
    /// session. Only a topic that subscribers have kept alive keeps the number of slots for subscribers with which it
    /// was created.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::DomainHeld`](crate::ErrorKind) if another process, or another session of this one, holds the lock.
    /// The message contains the process ID of the holder. [`ErrorKind::InvalidInput`](crate::ErrorKind) if the limits
    /// are invalid; [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory or descriptors are short;
    /// [`ErrorKind::OtherUser`](crate::ErrorKind) if the directory belongs to another user.
    pub fn open(domain: &Domain, topics: &[Topic], limits: TopicLimits) -> Result<PublishSession, Error> {
        limits.check()?;
        let lock = DomainLock::RemoteSensors { _lock: ListenLock::acquire(domain.root())? };
        check_topics(topics, &limits)?;
        Ok(PublishSession::create(domain, limits, scanhub_shm::join(domain, Role::Publisher)?, lock))
    }

    /// Opens a session for one name, and returns the publisher of `name`. A hub or a listener may run in the same
    /// domain. Use this function for results that a program computes from other topics, for example tracks of people,
    /// and for data that no hub has. The name must have no dot, and must not be the name of a sensor of the hub. Locks,
    /// limits and cleanup are as in [`open`](Self::open).
    ///
    /// # Errors
    ///
    /// Returns [`ErrorKind::NameHeld`](crate::ErrorKind) if another process publishes as `name`: a program, or a hub
    /// with a sensor of this name. The message names the process. Returns [`ErrorKind::InvalidInput`](crate::ErrorKind)
    /// if the name is invalid, or if subscribers still wait for a sensor of this name after its hub has ended.
    /// Otherwise returns the errors of [`open`](Self::open) and [`sensor`](Self::sensor).
    pub fn open_named(
        domain: &Domain,
        name: &str,
        topics: &[Topic],
        limits: TopicLimits,
    ) -> Result<SensorPublisher, Error> {
        limits.check()?;
        check_sensor(name)?;
        let lock =
            DomainLock::OwnName { name: name.to_owned(), _lock: NameLock::acquire(domain.root(), name)? };
        check_topics(topics, &limits)?;
        let of_hub = |(sensor, topic): &(String, Topic)| {
            sensor == name && topic.publisher_kind() == PublisherKind::Link
        };
        if scanhub_shm::published_topics(domain)?.iter().any(of_hub) {
            // A hub that is starting, or that has waited for this name, may have taken the name.
            if let Some(pid) = hub_pid(domain.root())? {
                return Err(name_taken(name, pid).into());
            }
            let what = format!("{name:?} cannot be published: it is a sensor of the hub");
            return Err(Error::new(Kind::Configuration, what, "any other name, for example house"));
        }
        PublishSession::create(domain, limits, scanhub_shm::join(domain, Role::Publisher)?, lock).sensor(name)
    }

    fn create(domain: &Domain, limits: TopicLimits, node: Node, lock: DomainLock) -> PublishSession {
        node.try_cleanup_dead_nodes();
        let boot = RandomState::new().hash_one(std::process::id());
        let (domain, sensors) = (domain.clone(), Mutex::default());
        PublishSession(Arc::new(Membership { domain, limits, boot, sensors, node, lock }))
    }

    /// Returns the limits of the session's topics.
    pub fn limits(&self) -> &TopicLimits {
        &self.0.limits
    }

    /// Checks that there is memory for `topics` of one sensor, and descriptors for their first subscribers.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if there is too little. The message has both amounts.
    pub fn check_room(&self, topics: &[Topic]) -> Result<(), Error> {
        check_topics(topics, &self.0.limits)?;
        Ok(check_descriptors((topics.len() as u64 + 1) * SERVICE_DESCRIPTORS)?)
    }

    /// Creates the publisher of the topics of `name`, which is `OWNER.NAME`. Sensors of a hub have no dot in their
    /// names, so no program publishes in the place of a hub. A second call with the same name returns the same
    /// publisher.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::InvalidInput`](crate::ErrorKind) if the name is invalid;
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory or descriptors are short;
    /// [`ErrorKind::OtherUser`](crate::ErrorKind) if files of another user have the name.
    pub fn sensor(&self, name: &str) -> Result<SensorPublisher, Error> {
        check_any_sensor(name)?;
        let is_own = matches!(&self.0.lock, DomainLock::OwnName { name: own, .. } if own == name);
        if !is_own && !is_remote(name) {
            let what = format!("{name:?} cannot be published: it may be a sensor of the hub");
            return Err(Error::new(Kind::Configuration, what, "OWNER.NAME, for example tracker.near"));
        }
        let mut sensors = locked(&self.0.sensors);
        sensors.retain(|sensor| sensor.strong_count() > 0);
        if let Some(known) = sensors.iter().filter_map(Weak::upgrade).find(|known| known.name == name) {
            return Ok(SensorPublisher(known));
        }
        self.check_room(&[])?;
        let waker = Waker::new(&self.0.node, name)?;
        let (name, due) = (name.to_owned(), Mutex::default());
        let sensor = Arc::new(NameWaker { name, waker, pending_rings: due, membership: self.0.clone() });
        sensors.push(Arc::downgrade(&sensor));
        Ok(SensorPublisher(sensor))
    }

    /// Removes the shared memory of killed processes. Call this method every few seconds.
    pub fn clean_up(&self) {
        self.0.node.try_cleanup_dead_nodes();
    }
}

/// Publisher of the topics of one name. The topics share the waker of their subscribers.
pub struct SensorPublisher(Arc<NameWaker>);

struct NameWaker {
    name: String,
    waker: Waker,
    /// Doorbells that must ring for samples that were sent since the last [`SensorPublisher::wake`].
    pending_rings: Mutex<PendingWakeups>,
    membership: Arc<Membership>,
}

impl SensorPublisher {
    /// Creates the topic that carries `P`, with all memory that it may need.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::DomainHeld`](crate::ErrorKind) if this process publishes the topic already;
    /// [`ErrorKind::InvalidInput`](crate::ErrorKind) if only sensors have the topic, and the name has no dot;
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if memory or descriptors are short;
    /// [`ErrorKind::Incompatible`](crate::ErrorKind) if the topic exists with another layout.
    pub fn topic<P: Payload + ?Sized>(&self) -> Result<Publication<P>, Error> {
        self.topic_for(self.limits())
    }

    /// Creates the topic as [`topic`](Self::topic) does, but for samples up to the length in `limits`.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`topic`](Self::topic).
    pub fn topic_for<P: Payload + ?Sized>(&self, limits: &TopicLimits) -> Result<Publication<P>, Error> {
        let Membership { domain, node, .. } = &*self.0.membership;
        if P::TOPIC.publisher_kind() == PublisherKind::Link && !is_remote(&self.0.name) {
            let what =
                format!("only sensors have the topic {}, and {} is not one", P::TOPIC.name(), self.0.name);
            return Err(Error::new(
                Kind::Configuration,
                what,
                "publish it as OWNER.NAME, for example tracker.near",
            ));
        }
        check_topics(&[P::TOPIC], limits)?;
        check_descriptors(SERVICE_DESCRIPTORS)?;
        let topic = TopicPublisher::new(node, &self.0.name, limits)?;
        // Allocate the memory now. A later write to memory that the kernel cannot provide would kill the process.
        scanhub_shm::allocate(domain)?;
        Ok(Publication::new(topic, SensorPublisher(self.0.clone())))
    }

    /// Returns the limits of the session's topics.
    pub fn limits(&self) -> &TopicLimits {
        &self.0.membership.limits
    }

    /// Wakes the subscribers that have received samples of any topic of this name since the last call. `why` is the
    /// event that they receive. One call is enough for samples that are sent together.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::Failed`](crate::ErrorKind) if some subscribers were not woken. They poll ten times a second.
    pub fn wake(&self, why: WakeEvent) -> Result<(), Error> {
        let mut due = std::mem::take(&mut *locked(&self.0.pending_rings));
        DoorbellWord::ALL
            .into_iter()
            .filter(|&ring| due.take_due(ring))
            .for_each(|ring| self.0.waker.ring(ring));
        Ok(self.0.waker.notify(why)?)
    }

    /// Notes that `reached` subscribers have received a sample of `topic`.
    fn note(&self, topic: Topic, reached: usize) {
        locked(&self.0.pending_rings).note_sample(topic, reached);
    }
}

/// Publisher of one topic. It fills in headers and sequence numbers, and wakes the subscribers.
pub struct Publication<P: Payload + ?Sized> {
    // This field is first, so that it is dropped before the waker and the session.
    topic: TopicPublisher<P, SharedMemory<P, ThreadSafeService>>,
    sensor: SensorPublisher,
}

impl<P: Payload + ?Sized> Publication<P> {
    /// Publishes as [`publish`](crate::publish) does, in `domain`.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`publish`](crate::publish).
    pub fn in_domain(domain: &Domain, name: &str) -> Result<Publication<P>, Error> {
        let (topics, limits) = ([P::TOPIC], TopicLimits::default());
        if P::TOPIC.publisher_kind() == PublisherKind::Link {
            return PublishSession::open(domain, &topics, limits)?.sensor(name)?.topic();
        }
        PublishSession::open_named(domain, name, &topics, limits)?.topic()
    }

    fn new(
        topic: TopicPublisher<P, SharedMemory<P, ThreadSafeService>>,
        sensor: SensorPublisher,
    ) -> Publication<P> {
        Publication { topic, sensor }
    }

    /// Returns the header of a sample that is created now: both stamps are the current time on CLOCK_MONOTONIC, and it
    /// has the next sequence number.
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

    /// Returns the header of a sample that was measured at `stamp_ns` on CLOCK_MONOTONIC. The other fields are those of
    /// [`header`](Self::header).
    pub fn header_at(&self, stamp_ns: u64) -> Header {
        let now = self.header();
        let wall_ns = now.wall_ns.wrapping_sub(now.stamp_last_ns.wrapping_sub(stamp_ns));
        Header { stamp_first_ns: stamp_ns, stamp_last_ns: stamp_ns, wall_ns, ..now }
    }

    /// Skips `count` numbers without a sample: subscribers count `count` missed samples.
    pub fn skip(&mut self, count: u64) {
        self.topic.skip_numbers(count);
    }

    /// Returns the sequence number of the next sample, counted from 0.
    pub fn next_number(&self) -> u64 {
        self.topic.next_number()
    }

    /// Returns the number of subscribers of the topic.
    pub fn subscribers(&self) -> usize {
        self.topic.subscribers()
    }

    /// Connects new subscribers, and sends them the samples that the topic stores for late joiners. If samples of the
    /// topic are rare, call this method ten times a second, so that new subscribers do not wait for the next sample.
    pub fn connect(&self) {
        // The next sample tries again to connect a subscriber that cannot be connected now.
        let _ = self.topic.connect();
    }

    /// Returns the number of samples that were not sent for lack of memory.
    pub fn failed(&self) -> u64 {
        self.topic.failed()
    }

    /// Sends a sample of `len` bytes, and wakes the subscribers. `fill` writes the sample in place; all bytes are 0
    /// before. Use this method for payloads of variable size, such as a scan.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`send`](Publication::send), and [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if the
    /// sample is longer than the limit of the topic.
    pub fn send_len(&mut self, len: usize, fill: impl FnOnce(&mut P)) -> Result<(), Error> {
        let header = self.header();
        self.send_len_with(&header, len, fill)?;
        self.sensor.wake(WakeEvent::Telegram)
    }

    /// Sends a sample as [`send_len`](Self::send_len) does, but with `header`, whose sequence number in the topic is
    /// replaced, and without waking subscribers. Returns the number of subscribers that have received the sample.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if there is no memory for the sample, or if it is longer than
    /// the limit of the topic. Its sequence number is used up.
    pub fn send_len_with(
        &mut self,
        header: &Header,
        len: usize,
        fill: impl FnOnce(&mut P),
    ) -> Result<usize, Error> {
        let reached = self.topic.send_len(header, len, fill)?;
        self.sensor.note(P::TOPIC, reached);
        Ok(reached)
    }
}

impl<P: Payload> Publication<P> {
    /// Sends a sample, and wakes the subscribers. `fill` writes the sample in place, over the payload's default.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if there is no memory for the sample; its sequence number is
    /// used up. Also returns the errors of [`SensorPublisher::wake`].
    pub fn send(&mut self, fill: impl FnOnce(&mut P)) -> Result<(), Error> {
        let header = self.header();
        self.send_with(&header, fill)?;
        self.sensor.wake(WakeEvent::Telegram)
    }

    /// Sends a sample that was measured at `stamp_ns` on CLOCK_MONOTONIC, such as the angle of a mount. Otherwise does
    /// the same as [`send`](Self::send).
    ///
    /// # Errors
    ///
    /// Returns the errors of [`send`](Self::send).
    pub fn send_at(&mut self, stamp_ns: u64, fill: impl FnOnce(&mut P)) -> Result<(), Error> {
        let header = self.header_at(stamp_ns);
        self.send_with(&header, fill)?;
        self.sensor.wake(WakeEvent::Telegram)
    }

    /// Sends a sample as [`send`](Self::send) does, but with `header`, whose sequence number in the topic is replaced,
    /// and without waking subscribers. Use this method for samples of several topics that are sent together. Returns
    /// the number of subscribers that have received the sample.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if there is no memory for the sample; its sequence number is
    /// used up.
    pub fn send_with(&mut self, header: &Header, fill: impl FnOnce(&mut P)) -> Result<usize, Error> {
        let reached = self.topic.send(header, fill)?;
        self.sensor.note(P::TOPIC, reached);
        Ok(reached)
    }
}

impl Publication<[u8]> {
    /// Sends `bytes` as a sample and wakes the subscribers.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`send`](Publication::send), and [`ErrorKind::ResourceExhausted`](crate::ErrorKind) for
    /// more than [`Telegram::MAX_LEN`](scanhub_schema::Telegram::MAX_LEN) bytes.
    pub fn send_bytes(&mut self, bytes: &[u8]) -> Result<(), Error> {
        let header = self.header();
        self.send_bytes_with(&header, bytes)?;
        self.sensor.wake(WakeEvent::Telegram)
    }

    /// Sends `bytes` with `header`, as [`send_with`](Publication::send_with) does.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if there is no memory for the sample, or if it is longer than
    /// [`Telegram::MAX_LEN`](scanhub_schema::Telegram::MAX_LEN).
    pub fn send_bytes_with(&mut self, header: &Header, bytes: &[u8]) -> Result<usize, Error> {
        let reached = self.topic.send_bytes(header, bytes)?;
        self.sensor.note(Topic::Telegram, reached);
        Ok(reached)
    }
}

/// Locks `mutex`. A thread that panicked while it held the lock has left a valid value.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
