//! A process in a domain, across restarts of its hub: membership, what wakes the process, and the news that a hub started
//! or ended. Refuses to know what is followed.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::{Duration, Instant};

use scanhub_schema::{Failure, Kind, Topic};
use scanhub_shm::{Domain, holder, is_starting};
use scanhub_shm::{Node, Payload, Subscriber};

use crate::presence::{Change, Presence, Who};
use crate::readiness::Readiness;
use crate::wait::{Wait, Wakeups};

/// The longest wait: so often the hub is looked for, and the caller's reasons to stop are seen.
const LONGEST_WAIT: Duration = Duration::from_millis(100);

/// How often whoever waits at the descriptor looks for a hub that lives: an event tells of the next one.
const MAKE_SURE_EVERY: Duration = Duration::from_secs(1);

/// Membership in the first of several domains where a hub runs.
pub struct Session {
    presence: Presence,
    joined: Option<Joined>,
    /// A hub came, and it was not yet seen whether its shared memory has the names that were joined.
    is_unsure: bool,
    number: u32,
    wait: Wait,
    /// For who waits at a descriptor of his own.
    readiness: Option<Readiness>,
    subscribed_at: Option<Instant>,
}

struct Joined {
    domain: Domain,
    wakeups: Wakeups,
    node: Node,
}

impl Session {
    /// Makes a session that will join the first live one of `places`, as soon as one is.
    pub fn new(places: Vec<Domain>) -> Session {
        Session {
            presence: Presence::new(places),
            joined: None,
            is_unsure: false,
            number: 0,
            wait: Wait::default(),
            readiness: None,
            subscribed_at: None,
        }
    }

    /// Has the session woken by `wait`; to be said before anything is followed.
    pub fn by(self, wait: Wait) -> Session {
        Session { wait, ..self }
    }

    /// Looks whether a hub runs, and joins its domain if it is at a new place.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if memory or descriptors are; who has joined already goes on without a look.
    pub fn look(&mut self) -> Result<Change, Failure> {
        if self.joined.as_mut().is_some_and(|joined| joined.wakeups.take_rang()) {
            self.presence.heard();
        }
        let change = self.presence.look();
        if let Some(joined) = self.joined.as_mut().filter(|_| change != Change::default()) {
            joined.wakeups.renew();
        }
        let Some(domain) = self.presence.domain() else {
            return match self.presence.short() {
                Some(short) if self.joined.is_none() => Err(short),
                _ => Ok(change),
            };
        };
        self.is_unsure |= change.back.is_some();
        let is_here = self.joined.as_ref().is_some_and(|joined| joined.domain == *domain);
        if is_here && !self.is_unsure {
            return Ok(change);
        }
        // After all had gone, the next hub's shared memory has other names.
        let is_member = |joined: &Joined| scanhub_shm::is_member(&joined.node, domain.root());
        match self.joined.as_ref().filter(|_| is_here).map(is_member).transpose()? {
            Some(true) => {}
            _ => match scanhub_shm::client_node(domain) {
                Ok(node) => {
                    let (domain, wakeups) = (domain.clone(), Wakeups::by(self.wait));
                    self.joined = Some(Joined { domain, wakeups, node });
                    self.number += 1;
                }
                // It is just starting or ending: the next look tells.
                Err(failure) if failure.kind == Kind::NoHub => return Ok(change),
                Err(failure) => return Err(failure),
            },
        }
        self.is_unsure = false;
        Ok(change)
    }

    /// Returns where the hub lives, if there is one.
    pub fn domain(&self) -> Option<&Domain> {
        self.presence.domain()
    }

    /// Returns who publishes there, as of the last look.
    pub fn publishes(&self) -> Option<Who> {
        self.presence.who()
    }

    /// Returns whether there is a hub, and not only a listener that stands for those of other machines.
    pub fn hub_lives(&self) -> bool {
        self.domain().is_some_and(|domain| matches!(holder(domain.root()), Ok(Some(_))))
    }

    /// Returns whether there is a hub that does not have all its topics yet.
    pub fn hub_is_starting(&self) -> bool {
        self.domain().is_some_and(|domain| is_starting(domain.root()) == Ok(true))
    }

    /// Returns what to tell who cannot wait for a hub.
    pub fn no_hub(&self) -> Failure {
        self.presence.no_hub()
    }

    /// Returns [`Session::no_hub`] without the hubs of other users and domains, for readers on other machines.
    pub fn no_hub_here(&self) -> Failure {
        self.presence.no_hub_here()
    }

    /// Counts the domains joined: ports of an earlier one must be opened again.
    pub fn number(&self) -> u32 {
        self.number
    }

    /// Returns a subscriber of `sensor`, or nothing as long as its hub or topic is not there. What wakes it comes first, so
    /// that nothing is sent unheard between the two.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if memory, descriptors or places for consumers are short; [`Kind::Failed`] if the topic has another
    /// layout.
    pub fn subscribe<P: Payload + ?Sized>(&mut self, sensor: &str) -> Result<Option<Subscriber<P>>, Failure> {
        let (Some(_), Some(joined)) = (self.presence.domain(), &mut self.joined) else {
            return Ok(None);
        };
        if !joined.wakeups.add(&joined.node, sensor, P::TOPIC)? {
            return Ok(None);
        }
        if let Some(readiness) = &self.readiness {
            joined.wakeups.descriptors().try_for_each(|event| readiness.add(event))?;
        }
        let subscriber = P::open(&joined.node, sensor)?.map(|topic| P::subscriber(&topic)).transpose()?;
        self.subscribed_at = subscriber.as_ref().map(|_| Instant::now());
        Ok(subscriber)
    }

    /// Returns a moment in the life of a `sensor`'s `topic`: as long as it is the same, nothing new was sent. Nothing where
    /// that is not known. What late joiners get comes without a word, so a moment ends with the next look for the hub, too.
    pub fn moment(&self, sensor: &str, topic: Topic) -> Option<(u32, Instant)> {
        let rung = self.joined.as_ref()?.wakeups.rung(sensor, topic)?;
        Some((rung, self.presence.looked_at()?))
    }

    /// Returns what is readable while there may be something to receive or to see to, the same over all lives of the hub;
    /// from the first call on it takes [`settle`](Self::settle) to make it unreadable.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`] if it is not waited by event, [`Kind::Short`] if descriptors are short.
    pub fn descriptor(&mut self) -> Result<BorrowedFd<'_>, Failure> {
        if self.wait != Wait::Event {
            let hint = "make it wait by event: a bell has no descriptor";
            return Err(Failure::new(Kind::Configuration, "no descriptor to wait on", hint));
        }
        let readiness: &Readiness = match &mut self.readiness {
            Some(readiness) => readiness,
            none => {
                let readiness = Readiness::new()?;
                if let Some(joined) = &self.joined {
                    joined.wakeups.descriptors().try_for_each(|event| readiness.add(event))?;
                }
                none.insert(readiness)
            }
        };
        Ok(readiness.as_fd())
    }

    /// Takes note that nothing waits, and that nothing will have to be looked for before `left`: the descriptor, if it is used,
    /// is not readable before. Returns whether something was sent meanwhile: then look again first.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if the system cannot wait.
    pub fn settle(&mut self, left: Option<Duration>) -> Result<bool, Failure> {
        let Some(readiness) = &self.readiness else { return Ok(false) };
        // What a late joiner is handed comes without an event.
        let is_settled = self.subscribed_at.is_some_and(|at| at.elapsed() >= MAKE_SURE_EVERY);
        let pace =
            if is_settled && self.presence.domain().is_some() { MAKE_SURE_EVERY } else { LONGEST_WAIT };
        readiness.again_in(left.map_or(pace, |left| left.min(pace)))?;
        self.joined.as_mut().map_or(Ok(false), |joined| joined.wakeups.take())
    }

    /// Sleeps until something was sent, at the latest until `until`, and 100 ms at most; returns at once if something
    /// may have been sent since the caller looked. Hold no sample meanwhile.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if the system cannot wait.
    pub fn wait(&mut self, until: Option<Instant>) -> Result<(), Failure> {
        self.wait_for(until.map(|until| until.saturating_duration_since(Instant::now())))
    }

    /// Sleeps as [`wait`](Self::wait) does, for a time instead of until one.
    ///
    /// # Errors
    ///
    /// As [`wait`](Self::wait).
    pub fn wait_for(&mut self, left: Option<Duration>) -> Result<(), Failure> {
        let left = left.map_or(LONGEST_WAIT, |left| left.min(LONGEST_WAIT));
        // This takes events that whoever polls has not seen: for him it is readable until it is settled.
        if let Some(readiness) = &self.readiness {
            readiness.again_in(Duration::ZERO)?;
        }
        match &mut self.joined {
            Some(joined) => joined.wakeups.wait(&joined.node, left),
            None => {
                std::thread::sleep(left);
                Ok(())
            }
        }
    }
}
