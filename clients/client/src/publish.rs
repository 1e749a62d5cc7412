//! Topics that a program publishes itself, such as what it makes of others. They are as a hub's own: consumers follow them
//! by name, in every language, see what they missed, and are woken. A name has one publisher: its lock says that it lives.
//! Refuses to know what is published.

mod publication;

use std::cell::{Cell, RefCell};
use std::hash::{BuildHasher, RandomState};
use std::rc::{Rc, Weak};

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, Maker, Ring, Topic, Wake, check_followed, check_sensor, is_remote};
use scanhub_shm::shortage::{check_descriptors, check_memory, longest_segment, sensor_bytes};
use scanhub_shm::{
    DEFAULT_DOMAIN, Domain, Environment, ListenLock, NameLock, holder, name_held, publisher_domain,
};
use scanhub_shm::{DueRings, Node, Payload, TopicPublisher, Waker};

pub use publication::Publication;

/// Publishes the topic of `name` that carries `P`, in the domain that SCANHUB_DOMAIN names: consumers follow it by
/// [`subscribe::<P>(name)`](crate::subscribe) while a hub or a listener is there; publishing needs neither.
///
/// Which names are possible depends on the topic. One that no hub makes, such as people or angles of a mount, has a name of
/// its own, as `mount`: any number of programs publish so, each under another name. A topic that a hub makes is published for
/// somebody else, as `tracker.near` (`OWNER.NAME`), and one process of a domain does that.
///
/// A process that publishes more than one topic, or for more than 32 consumers, opens a [`PublishSession`].
///
/// # Errors
///
/// Those of [`PublishSession::beside`] or [`PublishSession::open`], of [`PublishSession::sensor`] and
/// [`SensorPublisher::topic`].
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
    Publication::in_domain(&home(None)?, name)
}

/// Returns where a program publishes in `domain`, or if none is named in that which SCANHUB_DOMAIN names: its first live place,
/// or that which a hub would take.
///
/// # Errors
///
/// [`Kind::Configuration`](scanhub_schema::Kind) if the name is not possible.
pub fn home(domain: Option<&str>) -> Result<Domain, Failure> {
    let of_process = std::env::var("SCANHUB_DOMAIN");
    let name = domain.unwrap_or(of_process.as_deref().unwrap_or(DEFAULT_DOMAIN));
    publisher_domain(name, None, &Environment::of_process())
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
    lock: Place,
}

/// What says that the process publishes.
enum Place {
    /// For others, under names with a dot.
    Others { _lock: ListenLock },
    /// Under a name of its own.
    Own { name: String, _lock: NameLock },
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
    /// [`Kind::DomainHeld`](scanhub_schema::Kind) if another process (or another session of this one) has it: the message has its
    /// number; [`Kind::Configuration`](scanhub_schema::Kind) if the limits are none of those that can be;
    /// [`Kind::Short`](scanhub_schema::Kind) if memory or descriptors are short; [`Kind::Failed`](scanhub_schema::Kind) if the directory is
    /// another user's.
    pub fn open(domain: &Domain, topics: &[Topic], limits: TopicLimits) -> Result<PublishSession, Failure> {
        limits.check()?;
        let lock = Place::Others { _lock: ListenLock::acquire(domain.root())? };
        check_topics(topics, &limits)?;
        Ok(PublishSession::with(domain, limits, scanhub_shm::hub_node(domain)?, lock))
    }

    /// Publishes as `name`, beside a hub or a listener if there is one, of which it takes no place: for what is made of the
    /// topics of a domain, such as tracks of people, and for what no hub knows. The name has no dot, and no sensor of the hub
    /// has it. Else as [`open`](Self::open).
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NameHeld`](scanhub_schema::Kind) if another process publishes as `name`: a program, or the hub whose sensor
    /// it is. The message names the process. Returns [`Kind::Configuration`](scanhub_schema::Kind) if the name is invalid, or if
    /// subscribers still wait for a sensor of this name after its hub has ended. Otherwise the errors of
    /// [`open`](Self::open) and [`sensor`](Self::sensor).
    pub fn beside(
        domain: &Domain,
        name: &str,
        topics: &[Topic],
        limits: TopicLimits,
    ) -> Result<SensorPublisher, Failure> {
        limits.check()?;
        check_sensor(name)?;
        let lock = Place::Own { name: name.to_owned(), _lock: NameLock::acquire(domain.root(), name)? };
        check_topics(topics, &limits)?;
        let of_hub = |(sensor, topic): &(String, Topic)| sensor == name && topic.maker() == Maker::Link;
        if scanhub_shm::published(domain)?.iter().any(of_hub) {
            // A hub that is starting, or that has waited for this name, takes it now.
            if let Some(pid) = holder(domain.root())? {
                return Err(name_held(name, pid));
            }
            let what = format!("{name:?} is no name to publish under: it is a sensor of the hub");
            return Err(Failure::new(Kind::Configuration, what, "any other name, for example house"));
        }
        PublishSession::with(domain, limits, scanhub_shm::hub_node(domain)?, lock).sensor(name)
    }

    fn with(domain: &Domain, limits: TopicLimits, node: Node, lock: Place) -> PublishSession {
        node.try_cleanup_dead_nodes();
        let boot = RandomState::new().hash_one(std::process::id());
        let (domain, sensors) = (domain.clone(), RefCell::default());
        PublishSession(Rc::new(Membership { domain, limits, boot, sensors, node, lock }))
    }

    /// Returns what the topics of the session are made for.
    pub fn limits(&self) -> &TopicLimits {
        &self.0.limits
    }

    /// Checks that there is memory for `topics` of one sensor, and descriptors for their first consumers.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) with what is free and what is needed.
    pub fn check_room(&self, topics: &[Topic]) -> Result<(), Failure> {
        check_topics(topics, &self.0.limits)?;
        check_descriptors((topics.len() as u64 + 1) * SERVICE_DESCRIPTORS)
    }

    /// Makes what wakes the consumers of the topics of `name`, which is `OWNER.NAME`: a hub's sensors have no dot, so that
    /// nobody publishes in the place of another. A name that is there already is the same one.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`](scanhub_schema::Kind) if the name is not possible; [`Kind::Short`](scanhub_schema::Kind) if memory or
    /// descriptors are short; [`Kind::Failed`](scanhub_schema::Kind) if the place is taken by another user.
    pub fn sensor(&self, name: &str) -> Result<SensorPublisher, Failure> {
        check_followed(name)?;
        let is_own = matches!(&self.0.lock, Place::Own { name: own, .. } if own == name);
        if !is_own && !is_remote(name) {
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
    /// [`Kind::DomainHeld`](scanhub_schema::Kind) if this process publishes it already; [`Kind::Configuration`](scanhub_schema::Kind) if only
    /// sensors have the topic, and the name has no dot; [`Kind::Short`](scanhub_schema::Kind) if memory or descriptors are short;
    /// [`Kind::Failed`](scanhub_schema::Kind) if the topic exists with another layout.
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
        if P::TOPIC.maker() == Maker::Link && !is_remote(&self.0.name) {
            let what =
                format!("only sensors have the topic {}, and {} is not one", P::TOPIC.name(), self.0.name);
            return Err(Failure::new(
                Kind::Configuration,
                what,
                "publish it as OWNER.NAME, for example tracker.near",
            ));
        }
        check_topics(&[P::TOPIC], limits)?;
        check_descriptors(SERVICE_DESCRIPTORS)?;
        let topic = TopicPublisher::new(node, &self.0.name, limits)?;
        // To write into what has no memory behind it would end the process.
        scanhub_shm::allocate(domain)?;
        Ok(Publication::new(topic, SensorPublisher(self.0.clone())))
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
    /// [`Kind::Failed`](scanhub_schema::Kind) if some were not woken; these look by themselves ten times a second.
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
